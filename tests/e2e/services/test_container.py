"""The image is built by its recipe, from a Debian that was made just now, and the service in it answers."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from slrig.kernels import best_cpu_level
from tests.e2e.conftest import write_rig
from tests.npm import lacking

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
BUILD_LIMIT_S = 1800.0
DEBIAN = "localhost/debian"
ANSWER = """
slrig serve /etc/slrig/rig.toml --port 8999 >/dev/null 2>&1 & service=$!
tries=0
until python3 -c "import urllib.request as r; r.urlopen('http://127.0.0.1:8999/livez')" 2>/dev/null; do
  [ $((tries += 1)) -lt 60 ] && kill -0 $service || exit 3
  sleep 1
done
kill $service && wait $service
"""


class Builder:
    """buildah with a store of its own, and what the machine trusts to fetch packages with."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stores = ("--root", str(folder / "store"), "--runroot", str(folder / "run"))
        (folder / "policy.json").write_text('{"default": [{"type": "insecureAcceptAnything"}]}')
        self.trust: tuple[str, ...] = ()
        if authority := os.environ.get("PIP_CERT"):
            (folder / "pip.conf").write_text("[global]\ncert = /authority.pem\n")
            volumes = f"{authority}:/authority.pem:ro", f"{folder}/pip.conf:/etc/pip.conf:ro"
            self.trust = tuple(f"--volume={each}" for each in volumes)

    def run(self, command: str, *arguments: str) -> str:
        ended = subprocess.run(  # noqa: S603
            ["buildah", *self._stores, command, *arguments],  # noqa: S607
            cwd=ROOT, capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False,
            env={**os.environ, "BUILDAH_ISOLATION": "chroot"},
        )  # fmt: skip
        assert ended.returncode == 0, f"{ended.stdout[-3000:]}\n{ended.stderr[-3000:]}"
        return ended.stdout.strip()

    def build(self, recipe: Path, context: Path, name: str, *arguments: str) -> None:
        policy = f"--signature-policy={self.folder}/policy.json"
        self.run("bud", policy, "--network=host", *arguments, "-t", name, "-f", str(recipe), str(context))


@pytest.fixture(scope="module")
def builder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Builder]:
    if os.geteuid() != 0:
        pytest.skip("needs root, to make a Debian")
    if shutil.which("buildah") is None or shutil.which("mmdebstrap") is None:
        lacking("needs buildah and mmdebstrap: apt install buildah mmdebstrap")
    folder = tmp_path_factory.mktemp("image")
    made = subprocess.run(  # noqa: S603
        ["mmdebstrap", "--variant=minbase", "--mode=root", "trixie", folder / "debian.tar"],  # noqa: S607
        capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr[-3000:]
    builder = Builder(folder)
    (folder / "Debian").write_text("FROM scratch\nADD debian.tar /\n")
    builder.build(folder / "Debian", folder, DEBIAN)
    yield builder
    builder.run("rm", "--all")
    builder.run("rmi", "--all", "--force")
    shutil.rmtree(folder, ignore_errors=True)


def test_image_runs_the_service_as_nobody_special_and_without_tools(builder: Builder, tmp_path: Path) -> None:
    # Without the library for OAK cameras, which takes as long to fetch as all others, and few kernels.
    given = {"DEBIAN": DEBIAN, "EXTRAS": "screen", "KERNELS": f"--usual --level {best_cpu_level()}"}
    options = ("--format=docker", *(f"--build-arg={name}={value}" for name, value in given.items()), *builder.trust)
    builder.build(ROOT / "config" / "deploy" / "Containerfile", ROOT, "slrig", *options)
    described = json.loads(builder.run("inspect", "--type=image", "slrig"))["Docker"]["config"]
    assert described["User"] == "slrig"
    assert described["Healthcheck"]["Test"][:2] == ["CMD", "python3"]
    assert set(described["Volumes"]) == {"/var/lib/slrig"}
    assert set(described["ExposedPorts"]) == {"8731/tcp"}
    policy = f"--signature-policy={builder.folder}/policy.json"
    container = builder.run("from", policy, "slrig")
    inside = builder.run(
        "run", container, "sh", "-c", "id -u; slrig --version; which pip pip3 gcc cc make || echo none; slrig warm"
    )
    assert inside.split("\n")[0] == "990"
    assert inside.split("\n")[1].startswith("slrig ")
    assert inside.split("\n")[2] == "none"
    assert "kernels are ready, as they came with slrig" in inside.split("\n")[-1]
    rig = write_rig(tmp_path / "rig")
    builder.run("run", "--network=host", f"--volume={rig.parent}:/etc/slrig:ro", container, "sh", "-euc", ANSWER)

"""A wheel with compiled kernels, in an empty environment, used from an empty folder: nothing is compiled there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple
from zipfile import ZipFile

import httpx2
import pytest

from slrig.kernels import best_cpu_level

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [pytest.mark.slow, pytest.mark.skipif(best_cpu_level() is None, reason="kernels fit this processor alone")]


class Installed(NamedTuple):
    """An environment with the wheel alone. wheel : built from `checkout`. program : its `slrig`; cache : where a
    compiled kernel would be kept.
    """

    checkout: Path
    wheel: Path
    program: Path
    folder: Path
    cache: Path
    environment: dict[str, str]

    def run(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command: list[str | Path] = [self.program, *arguments]
        return subprocess.run(  # noqa: S603 - our own
            command, cwd=self.folder, env=self.environment, capture_output=True, text=True, timeout=600, check=True
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    root = tmp_path_factory.mktemp("wheel")
    # What is built lies in the checkout of the script, and this one is to stay as it is.
    copy = root / "checkout"
    for each in ("config", "drivers", "simulated_rig", "slrig"):
        shutil.copytree(ROOT / each, copy / each, ignore=shutil.ignore_patterns("__pycache__", "compiled"))
    for each in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / each, copy)
    best = best_cpu_level()
    assert best is not None
    uv = [sys.executable, "-m", "uv"]
    build: list[str | Path] = [
        sys.executable,
        copy / "config" / "deploy" / "wheel.py",
        "--level",
        best,
        "--output",
        root / "dist",
    ]
    subprocess.run(build, check=True)  # noqa: S603 - our own
    (wheel,) = (root / "dist").glob("slrig-*-manylinux*.whl")
    subprocess.run([*uv, "venv", "-q", "--python", sys.executable, root / "venv"], check=True)  # noqa: S603 - our own
    subprocess.run([*uv, "pip", "install", "-q", "--python", root / "venv", wheel], check=True)  # noqa: S603 - our own
    folder, cache = root / "empty", root / "cache"
    folder.mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "SLRIG", "NUMBA"))}
    own = {"HOME": str(root / "home"), "NUMBA_CACHE_DIR": str(cache), "SLRIG_MIN_FREE_BYTES": "0"}
    return Installed(copy, wheel, root / "venv" / "bin" / "slrig", folder, cache, kept | own)


_BUILD_AGAIN = "import sys, wheel; from pathlib import Path; wheel.build(Path(sys.argv[1]))"


def test_the_same_files_make_the_same_wheel_at_another_time_with_other_permissions(
    installed: Installed, tmp_path: Path
) -> None:
    for each in (installed.checkout / "slrig").rglob("*.*"):
        os.utime(each, (1e9, 1e9))
        each.chmod(0o600)
    environment = os.environ | {"PYTHONPATH": str(installed.checkout / "config" / "deploy"), "TZ": "Asia/Tokyo"}
    command: list[str | Path] = [sys.executable, "-c", _BUILD_AGAIN, tmp_path]
    subprocess.run(command, check=True, env=environment, umask=0o077)  # noqa: S603 - our own
    assert (tmp_path / installed.wheel.name).read_bytes() == installed.wheel.read_bytes()
    # numba names an expression of arrays by its address: a kernel with one is another one each time it is compiled.
    (kernels,) = (installed.checkout / "slrig" / "compiled").glob("*.zip")
    with ZipFile(kernels) as archive:
        assert [name for name in archive.namelist() if b"__numba_array_expr" in archive.read(name)] == []


def test_the_demonstration_compiles_nothing_and_makes_the_same_mesh_as_the_checkout(
    installed: Installed, tmp_path: Path
) -> None:
    ended = installed.run("demo", "sphere")
    assert "preparing kernels" not in ended.stderr
    assert "rms" in ended.stdout
    assert not [*installed.cache.rglob("*.nbc")]
    (bundle,) = Path(installed.environment["HOME"]).glob(".local/share/slrig/demo/scans/*/bundle")
    checkout: list[str | Path] = [sys.executable, "-m", "slrig.cli", "reconstruct", bundle, "--output", tmp_path]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(checkout, check=True, cwd=tmp_path, env=environment)  # noqa: S603 - our own
    mesh = installed.folder / "scans" / "demo" / "mesh.ply"
    assert (tmp_path / "mesh.ply").read_bytes() == mesh.read_bytes()


def test_a_calibration_compiles_nothing(installed: Installed, tmp_path: Path) -> None:
    rig = ("--rig", "rendered-calibration-small", "--data", tmp_path / "data")
    assert "8 used of 8" in installed.run("calibrate", "run", "--scripted", *rig).stdout
    assert not [*installed.cache.rglob("*.nbc")]


def test_an_example_is_written_and_served_with_the_page(installed: Installed, tmp_path: Path) -> None:
    installed.run("init", "--example", "mesh_file", "--output", tmp_path / "own.toml")
    installed.run("demo", tmp_path / "own.toml", "--output", tmp_path / "own", "--data", tmp_path / "kept")
    assert not [*installed.cache.rglob("*.nbc")]
    command: list[str | Path] = [
        installed.program,
        "serve",
        "demo",
        "--port",
        "0",
        "--data",
        tmp_path / "data",
        "--until-eof",
    ]
    with subprocess.Popen(  # noqa: S603 - our own
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=installed.environment, cwd=tmp_path
    ) as service:
        assert service.stdin is not None
        assert service.stdout is not None
        url = service.stdout.readline().split(" at ")[1].split(",")[0]
        assert "<title>" in httpx2.get(f"{url}/").text
        service.stdin.close()
    assert service.returncode == 0
    assert (tmp_path / "data" / "demo.toml").is_file()

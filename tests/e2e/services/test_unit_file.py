"""slrig.service under a real systemd: the service scans within its limits, and the limits hold."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
import sys
import sysconfig
import uuid
from pathlib import Path

import pytest

from tests.e2e.conftest import KEY, write_rig
from tests.npm import lacking

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
DEPLOY = ROOT / "config" / "deploy"
HERE = Path(__file__).parent / "unit_file"
BOOT_LIMIT_S = 240.0

CHECK = """
[Unit]
DefaultDependencies=no
[Service]
Type=oneshot
TimeoutStartSec=infinity
ExecStart=/bin/sh /opt/check.sh
"""

INSTEAD = """
[Service]
Type=oneshot
Restart=no
ExecStart=
ExecStart=/opt/slrig/bin/python {command}
StandardError=truncate:/run/out/{output}
"""
"""What takes the place of the service in units that are otherwise its own."""

COMPILED = """
[Service]
Environment=NUMBA_CACHE_DIR=
ReadWritePaths=/opt/seen
"""
"""For the kernels that this machine has compiled already: a second compilation takes two minutes."""


def cgroups() -> Path:
    """Where control groups of the second kind lie, if this user may make some. Skips where not."""
    if os.geteuid() != 0 or not Path("/lib/systemd/systemd").is_file() or shutil.which("unshare") is None:
        pytest.skip("needs root and systemd's programs: apt install systemd")
    for line in Path("/proc/mounts").read_text().splitlines():
        _, place, kind, *_ = line.split()
        if kind == "cgroup2" and os.access(place, os.W_OK):
            return Path(place)
    pytest.skip("needs control groups of the second kind")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unit")
    added, out = folder / "added", folder / "out"
    out.mkdir()
    units = added / "etc" / "systemd" / "system"
    for name, command, output in (
        ("slrig", None, None),
        ("probe", "/opt/probe.py", "probe.json"),
        ("screen", "/opt/probe.py screen", "screen.txt"),
    ):
        changes = units / f"{name}.service.d"
        changes.mkdir(parents=True)
        shutil.copy(DEPLOY / "slrig.service", units / f"{name}.service")
        (changes / "test.conf").write_text(
            COMPILED if command is None else INSTEAD.format(command=command, output=output)
        )
    shutil.copy(DEPLOY / "slrig-screen.conf", units / "screen.service.d" / "screen.conf")
    (units / "check.service").write_text(CHECK)
    (units / "check.target").write_text("[Unit]\nDefaultDependencies=no\nWants=check.service\n")
    (added / "etc" / "sysusers.d").mkdir()
    shutil.copy(DEPLOY / "slrig.sysusers", added / "etc" / "sysusers.d" / "slrig.conf")
    write_rig(added / "etc" / "slrig")
    (added / "etc" / "slrig" / "service.env").write_text(f'SLRIG_API_KEY="{KEY}"\nSLRIG_MIN_FREE_BYTES=0\n')
    programs = added / "opt" / "slrig" / "bin"
    programs.mkdir(parents=True)
    for name in ("check.sh", "probe.py"):
        shutil.copy(HERE / name, added / "opt")
    seen = {each: f"/opt/seen{each}" for each in (sys.base_prefix, sysconfig.get_path("purelib"), str(ROOT))}
    python = f"{seen[sys.base_prefix]}/bin/python{sys.version_info.major}.{sys.version_info.minor}"
    path = f"{seen[str(ROOT)]}:{seen[sysconfig.get_path('purelib')]}"
    for name, arguments in (("python", ""), ("slrig", "-m slrig.cli ")):
        program = programs / name
        # Where the interpreter's own library is found, too: the folder it was built for is hidden from the service.
        paths = f"LD_LIBRARY_PATH={seen[sys.base_prefix]}/lib PYTHONPATH={path}"
        program.write_text(f'#!/bin/sh\n{paths} exec {python} {arguments}"$@"\n')
        program.chmod(0o755)
    cgroup = cgroups() / f"slrig-{uuid.uuid4().hex[:8]}"
    try:
        booted = subprocess.run(  # noqa: S603
            ["sh", HERE / "boot.sh", cgroup, added, out, *seen],  # noqa: S607
            capture_output=True, text=True, timeout=BOOT_LIMIT_S, check=False,
        )  # fmt: skip
    finally:
        for each in sorted(cgroup.rglob("*"), reverse=True) if cgroup.exists() else ():
            if each.is_dir():
                each.rmdir()
        cgroup.rmdir()
    if not (out / "stopped.txt").is_file():
        if "mount" in booted.stderr or "unshare" in booted.stderr:
            pytest.skip(f"namespaces cannot be had here: {booted.stderr[-300:]}")
        pytest.fail(f"systemd did not come to its end: {booted.stdout[-2000:]} {booted.stderr[-2000:]}")
    return out


def test_service_scans_within_the_limits_of_its_unit(found: Path) -> None:
    scanned = (found / "scan.txt").read_text()
    assert scanned.endswith("exit code 0\n"), scanned
    assert (found / "scan" / "mesh.ply").stat().st_size > 10_000
    assert "ActiveState=active" in (found / "started.txt").read_text()
    assert set((found / "stopped.txt").read_text().split()) >= {"Result=success", "ExecMainStatus=0"}


def test_data_are_the_services_own(found: Path) -> None:
    modes = (found / "modes.txt").read_text().splitlines()
    assert [line.split()[:2] for line in modes] == [["700", "slrig"], ["700", "slrig"], ["600", "slrig"]]
    assert {"20(dialout)", "44(video)"} <= set(re.findall(r"\d+\(\w+\)", (found / "id.txt").read_text()))
    assert "(plugdev)" in (found / "id.txt").read_text()


def test_unit_permits_what_the_service_needs_and_no_more(found: Path) -> None:
    probe = json.loads((found / "probe.json").read_text())
    assert probe["kernels"] == [3.0, 3.0]
    done = {name for name, end in probe["sockets"].items() if end == "done"}
    assert done == {"AF_INET", "AF_INET6", "AF_UNIX", "AF_NETLINK"}
    # There is no device behind a node that may be opened.
    nodes = probe["nodes"]
    assert nodes.pop("denied-mem") == "EPERM"
    assert "allowed-ttyS" in nodes
    assert "EPERM" not in nodes.values()
    done = {place for place, end in probe["writing"].items() if end == "done"}
    assert done == {"/var/lib/slrig", "/tmp", "/dev/shm"}  # noqa: S108 - both the service's own
    assert (probe["homes"], probe["realtime"], probe["namespace"]) == ("EACCES", "EPERM", "EPERM")
    assert probe["first_process"] == "ENOENT"
    assert set(probe["capabilities"]) == {"0" * 16}
    assert probe["no_file"] >= min(65536, resource.getrlimit(resource.RLIMIT_NOFILE)[1])


def test_screen_gets_in_where_the_session_lets_it(found: Path) -> None:
    if not (found / "screen.txt").is_file():
        lacking("needs an X server and its access list: apt install xvfb x11-xserver-utils xauth")
    assert "no X server answers" in (found / "screen-before.txt").read_text()
    assert (found / "screen.txt").read_text() == "in\n"

"""What Linux has and other systems have not is hidden from the program: it starts, serves, and says what it cannot do.

It takes no system's place: paths, processes and locks are Linux' here. It finds what would end slrig at its start.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.conftest import Start, write_rig

ROOT = Path(__file__).resolve().parents[2]

# Python runs a module of this name at the start of every process, so that the reconstruction's process has less, too.
HIDING = """
import os, signal, sys
import filelock # has its own way on each system; here it is that of Linux
sys.modules.update(dict.fromkeys(["fcntl", "grp", "pwd", "resource", "syslog", "termios", "tty"]))
for name in ("SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGPIPE"):
    delattr(signal, name)
for name in ("O_CLOEXEC", "O_DIRECTORY", "fork", "getloadavg", "getuid", "geteuid", "killpg", "mkfifo",
             "pread", "pwrite", "sched_getaffinity", "setsid"): # not uname, which numpy asks under Linux
    delattr(os, name)
"""
EVERY_MODULE = """
import importlib, pkgutil, sys
import slrig, drivers, simulated_rig
own = [each.name for package in (slrig, drivers, simulated_rig)
       for each in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
# Run by themselves: by Alembic, by python -m, and on a microcontroller.
apart = (".migrations.env", ".__main__", "device.main", "device.box")
# A pool's machines are Linux: dask's own libraries load what that has.
apart_too = "slrig.compute."
loaded = [importlib.import_module(name).__name__ for name in own
          if not name.endswith(apart) and not name.startswith(apart_too)]
print(len(loaded))
"""


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every process that is started from now on finds less than Linux has."""
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(HIDING)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), str(ROOT)]))


def run(*arguments: str) -> str:
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False, cwd=ROOT)  # noqa: S603
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.mark.usefixtures("elsewhere")
def test_less_is_there_than_linux_has() -> None:
    code = "import os, signal\ntry: import fcntl\nexcept ImportError: print(hasattr(signal, 'SIGHUP'))"
    assert run("-c", code) == "False\n"


@pytest.mark.slow
@pytest.mark.usefixtures("elsewhere")
def test_every_module_loads() -> None:
    assert int(run("-c", EVERY_MODULE)) > 300


@pytest.mark.slow
@pytest.mark.usefixtures("elsewhere")
def test_devices_says_which_drivers_are_for_linux_only() -> None:
    assert "devices" in run("-m", "slrig.cli", "--help")
    shown = run("-m", "slrig.cli", "devices")
    assert "v4l2: Linux only: it needs the kernel's video interface, and this is" in shown
    assert "use the driver 'opencv'" in shown
    assert "dlpc350: Linux only: it needs the kernel's /dev/hidraw*" in shown
    states = {line.split()[0]: line.strip() for line in shown.splitlines() if " slrig " in line}
    assert "not on this system" in states["v4l2"]
    assert states["opencv"].endswith("ok")
    found = json.loads(run("-m", "slrig.cli", "devices", "--json"))
    assert [each["driver"] for each in found["elsewhere"]] == ["dlpc350", "dlpc900", "v4l2"]
    assert found["faults"] == []
    assert all(driver["fault"] is None for driver in found["drivers"] if driver["package"] == "slrig")


@pytest.mark.slow
@pytest.mark.usefixtures("elsewhere")
def test_service_holds_its_rig_and_ends_in_good_order(start: Start, tmp_path: Path) -> None:
    service = start(write_rig(tmp_path / "rig"), fresh=True)
    with service.client() as client:
        assert client.get("/livez")["checks"]
        scan = client.scans.start()
        states = [getattr(event, "state", None) for event in client.follow(scan["links"]["events"])]
        assert states[-1] == "succeeded", service.log.read_text()
        assert [each["driver"] for each in client.get("/device")["elsewhere"]] == ["dlpc350", "dlpc900", "v4l2"]
    assert service.stop() == 0

"""What Linux has and other systems have not is hidden from the program: it starts, serves, and says what it cannot do.

It takes no system's place: paths, processes and locks are Linux' here. It finds what would end slrig at its start.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import scanned, serving, slrig, write_rig

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
import importlib, pkgutil, signal
import slrig, drivers, simulated_rig
try: import fcntl
except ImportError: assert not hasattr(signal, "SIGHUP")
own = [each.name for package in (slrig, drivers, simulated_rig)
       for each in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
# Run by themselves: by python -m, and on a microcontroller.
apart = (".__main__", "device.main", "device.box")
own = [name for name in own if not name.endswith(apart)]
print(len([importlib.import_module(name) for name in own]))
"""


@pytest.mark.slow
def test_everything_loads_and_serves_where_less_is_there_than_linux_has(tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(HIDING)
    less: dict[str, Any] = {"PYTHONPATH": os.pathsep.join([str(site), str(ROOT)])}
    environment = {**os.environ, **less}
    loaded = subprocess.check_output([sys.executable, "-c", EVERY_MODULE], cwd=ROOT, env=environment)  # noqa: S603 - ours
    assert int(loaded) > 300

    shown = slrig("devices", **less).stdout
    assert "v4l2: Linux only: it needs the kernel's video interface, and this is" in shown
    assert "use the driver 'opencv'" in shown
    assert "dlpc350: Linux only: it needs the kernel's /dev/hidraw*" in shown
    states = {line.split()[0]: line.strip() for line in shown.splitlines() if " slrig " in line}
    assert "not on this system" in states["v4l2"]
    assert states["opencv"].endswith("ok")

    with serving(write_rig(tmp_path / "rig"), tmp_path / "data", **less) as service, service.client() as client:
        assert scanned(client)["state"] == "succeeded", service.log.read_text()
        found = client.get("/device")
        assert [each["driver"] for each in found["elsewhere"]] == ["dlpc350", "dlpc900", "v4l2"]
        assert found["faults"] == []
        assert all(driver["fault"] is None for driver in found["drivers"] if driver["package"] == "slrig")

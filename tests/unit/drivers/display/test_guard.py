"""The process that keeps an output black: it holds none of its parent's streams, and says why it did not start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.display.guard import GuardProcess
from slrig.errors import DeviceError

STAYS = """import sys
sys.stderr.write("warning\\n")
print("ready", flush=True)
sys.stdin.read()
"""
PARENT = """import os, sys
from drivers.display.guard import GuardProcess
guard = GuardProcess("stays", "", "HDMI-1")
print(guard._process.pid, flush=True)
os._exit(0)  # killed: it cannot release its guard
"""


@pytest.fixture(autouse=True)
def guards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # It outlives its parent for ten minutes.
    (tmp_path / "stays.py").write_text(STAYS.replace("sys.stdin.read()", "import time; time.sleep(600)"))
    (tmp_path / "fails.py").write_text("raise RuntimeError('no server')")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(__file__).parents[4]}")


def test_who_reads_the_output_of_a_command_does_not_wait_for_its_guard() -> None:
    run = subprocess.run([sys.executable, "-c", PARENT], capture_output=True, timeout=60, check=False)  # noqa: S603
    os.kill(int(run.stdout), signal.SIGKILL)
    assert (run.returncode, run.stderr) == (0, b"")


def test_guard_that_does_not_start_gives_its_error() -> None:
    with pytest.raises(DeviceError, match=r"HDMI-1 black .* \(RuntimeError: no server\)"):
        GuardProcess("fails", "", "HDMI-1")

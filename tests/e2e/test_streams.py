"""Whoever reads all that a command prints, as `| tee` and a CI do, has it when the command has ended: no guard, worker
or service that it started holds its streams open.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.e2e.conftest import write_rig

pytestmark = pytest.mark.slow

PATIENCE_S = {"killed": 6.0}
"""Else 2 s. A worker that is being loaded looks after its service only then."""
SERVE = ["serve", "rig.toml", "--port", "0", "--data", "data"]
COMMANDS = {
    "devices": ["devices"],
    "doctor": ["doctor", "rig.toml"],
    "conform": ["conform", "rig.toml"],
    "latency": ["latency", "rig.toml", "--flashes", "8"],
    "patterns": ["patterns", "rig.toml"],
    "verify": ["verify", "rig.toml"],
    "report": ["report", "bench.zip", "--rig", "rig.toml"],
    "terminated": SERVE,
    "killed": SERVE,
}


@pytest.mark.parametrize("name", COMMANDS)
def test_streams_of_a_command_end_with_it(tmp_path: Path, name: str) -> None:
    write_rig(tmp_path)
    said: list[bytes] = []
    command = subprocess.Popen(  # noqa: S603 - our own command
        [sys.executable, "-m", "slrig.cli", *COMMANDS[name]], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, cwd=tmp_path,
    )  # fmt: skip
    assert command.stdout is not None
    assert command.stderr is not None
    if COMMANDS[name][0] == "serve":
        said.append(command.stdout.readline())
        command.send_signal(signal.SIGTERM if name == "terminated" else signal.SIGKILL)
    readers = [
        threading.Thread(target=lambda s=s: said.append(s.read()), daemon=True)
        for s in (command.stdout, command.stderr)
    ]
    for reader in readers:
        reader.start()
    code = command.wait(300)
    for reader in readers:
        reader.join(PATIENCE_S.get(name, 2.0))
    assert [reader for reader in readers if reader.is_alive()] == []
    command.stdout.close()
    command.stderr.close()
    # What it says, and to refuse, is of other tests.
    assert code in {0, 1, 2, -signal.SIGKILL}, b"".join(said)
    if name == "report":
        with ZipFile(tmp_path / "bench.zip") as packed:
            found = {"doctor.json", "latency.json", "conformance.json", "scan-2/report.json", "service.log"}
            assert found <= set(packed.namelist())

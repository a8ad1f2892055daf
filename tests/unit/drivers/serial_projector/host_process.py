"""A host in a process of its own: lights a pattern, or plays, on the port that it is given, and stays so.

python -m tests.unit.drivers.serial_projector.host_process PORT WATCHDOG_S show|play|crash
"""

from __future__ import annotations

import sys
from pathlib import Path

from drivers.serial_projector import open_projector
from tests.unit.drivers.serial_projector.conftest import SEQUENCE


def main() -> None:
    """Be a host."""
    port, watchdog_s, doing = sys.argv[1:]
    projector = open_projector({"port": port, "watchdog_s": float(watchdog_s)}, Path())
    projector.load(SEQUENCE)
    if doing == "play":
        projector.play(0.05, 0.1)
    else:
        projector.show(3)
    sys.stdout.write("lit\n")
    sys.stdout.flush()
    if doing == "crash":
        message = "something that nobody caught"
        raise RuntimeError(message)
    sys.stdin.read()


if __name__ == "__main__":
    main()

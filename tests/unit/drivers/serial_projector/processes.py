"""A trigger box and a host of it, each in a process of its own.

python -m tests.unit.drivers.serial_projector.processes box
    says its port, then every change of light (`light <pattern or -> <CLOCK_MONOTONIC ns>`), until its input ends.
python -m tests.unit.drivers.serial_projector.processes show|play|crash PORT WATCHDOG_S
    lights a pattern, or plays, on that port, says so, and stays until its input ends.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from drivers.serial_projector import open_projector
from tests.unit.drivers.serial_projector.conftest import CRC32, SEQUENCE
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import SerialLine


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def be_a_box() -> None:
    def told(pattern: int | None) -> None:
        say(f"light {'-' if pattern is None else pattern} {time.monotonic_ns()}")

    line = SerialLine(CoreEngine(Scene(watch=[told]), description(CRC32)))
    say(f"port {line.path}")
    sys.stdin.read()
    line.close()


def be_a_host(doing: str, port: str, watchdog_s: str) -> None:
    projector = open_projector({"port": port, "watchdog_s": float(watchdog_s)}, Path())
    projector.load(SEQUENCE)
    if doing == "play":
        projector.play(0.05, 0.1)
    else:
        projector.show(3)
    say("lit")
    if doing == "crash":
        message = "an error that is not caught"
        raise RuntimeError(message)
    sys.stdin.read()


if __name__ == "__main__":
    be_a_box() if sys.argv[1] == "box" else be_a_host(*sys.argv[1:])

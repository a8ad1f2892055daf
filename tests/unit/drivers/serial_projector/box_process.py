"""A trigger box in a process of its own: says its port, then every change of light, until its input ends.

port <path>
light <pattern or -> <CLOCK_MONOTONIC ns>
"""

from __future__ import annotations

import sys
import time

from tests.unit.drivers.serial_projector.conftest import CRC32
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import SerialLine


def main() -> None:
    """Be a box."""

    def told(pattern: int | None) -> None:
        sys.stdout.write(f"light {'-' if pattern is None else pattern} {time.monotonic_ns()}\n")
        sys.stdout.flush()

    line = SerialLine(CoreEngine(Scene(watch=[told]), description(CRC32)))
    sys.stdout.write(f"port {line.path}\n")
    sys.stdout.flush()
    sys.stdin.read()
    line.close()


if __name__ == "__main__":
    main()

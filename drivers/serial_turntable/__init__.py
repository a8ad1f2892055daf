"""Turntables on a serial line: a controller that takes G-code as GRBL 1.1 does, or a board with a protocol of lines.

The protocol of lines, version 1
--------------------------------
ASCII, 115 200 baud unless the rig file states otherwise, lines end with a line feed; a preceding carriage return is
ignored. Numbers are degrees with up to three decimals. The host sends one command and waits for its answer; only STOP
may be sent while the board turns.

    ID?             slrig-turntable 1 <motor steps per turn of the table, an integer>
    TURN <angle>    turn to this absolute angle from the position at the start: 370 is ten degrees beyond a full turn.
                    When it has stopped: OK <angle reached>, the nearest full step
    STOP            stop, if it turns, and answer OK <current angle>; a TURN that is stopped is not answered
    anything else   ERR <description>; also for a TURN that cannot be executed

When it starts or is reset, the board sends START: its current position is angle 0. The host sends STOP, because an
earlier host may have been killed during a turn, then ID?, both repeated until ID? is answered, then STOP to read the
angle. Other lines are ignored, so a board may print messages.

A session, `>` to the board, `<` from it:

    < START
    > STOP
    < OK 0.000
    > ID?
    < slrig-turntable 1 3200
    > STOP
    < OK 0.000
    > TURN 45.000
    < OK 45.000
    > TURN 10.000
    < OK 10.012
    > SPIN
    < ERR unknown command SPIN
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.bundle import validate
from slrig.devices import Clock, SystemClock, Turntable

__all__ = ["open_grbl", "open_turntable"]


def open_turntable(options: Mapping[str, object], folder: Path, *, clock: Clock | None = None) -> Turntable:
    """Open a turntable that speaks the protocol of lines, from a rig file's `[positioner]` table without its `driver`.

    Parameters
    ----------
    options
        `drivers.serial_turntable.options.LineOptions`.
    folder
        Folder of the rig file, not used.
    clock
        For settling and time-outs; default: the system's.

    Raises the errors of `drivers.serial_port.SerialPort`, ConfigError with all faults of the options, and
    UnsupportedByDeviceError or DeviceError if another controller or none answers.
    """
    from drivers.serial_port import SerialPort
    from drivers.serial_turntable.controllers import LineController
    from drivers.serial_turntable.options import LineOptions
    from drivers.serial_turntable.turntable import SerialTurntable

    del folder
    table = validate(LineOptions, options, "the [positioner] table of a serial turntable")
    port = SerialPort(table.port, baud=table.baud, device="turntable", driver="serial_turntable")
    return SerialTurntable(port, table, lambda lines: LineController(lines, table), clock or SystemClock())


def open_grbl(options: Mapping[str, object], folder: Path, *, clock: Clock | None = None) -> Turntable:
    """Open a turntable behind GRBL; its options are `drivers.serial_turntable.options.GrblOptions`.

    Parameters and errors are those of `open_turntable`.
    """
    from drivers.serial_port import SerialPort
    from drivers.serial_turntable.controllers import GrblController
    from drivers.serial_turntable.options import GrblOptions
    from drivers.serial_turntable.turntable import SerialTurntable

    del folder
    table = validate(GrblOptions, options, "the [positioner] table of a turntable behind GRBL")
    port = SerialPort(table.port, baud=table.baud, device="turntable", driver="grbl_turntable")
    return SerialTurntable(port, table, lambda lines: GrblController(lines, table), clock or SystemClock())

"""The protocol of lines that anybody can put on a board: see the package's docstring."""

from __future__ import annotations

import re

from drivers.serial_turntable.lines import ControllerLink
from drivers.serial_turntable.options import LineOptions
from slrig.errors import DeviceError, UnsupportedByDeviceError

_VERSION = 1
_AGAIN_S = 0.5
_REPLY_S = 2.0
"""A board answers at once whatever it need not turn for."""
_IDENTITY = re.compile(r"slrig-turntable (\d+) (\d+)")
_ANGLE = re.compile(r"OK (-?\d+(?:\.\d+)?)")


class LineController:
    """Implements `Controller`. Its unit is a degree.

    Raises
    ------
    DeviceGoneError
        The port is gone.
    UnsupportedByDeviceError
        It speaks another version.
    DeviceError
        Nothing that speaks this protocol answers.
    """

    def __init__(self, lines: ControllerLink, options: LineOptions) -> None:
        self._lines = lines
        self.step = 360 / self._steps_per_turn(lines.after(options.open_s))

    def place(self) -> float:
        """See `Controller`."""
        return self._reached("STOP", self._lines.after(_REPLY_S))

    def go(self, place: float, until_ns: int) -> float:
        """See `Controller`."""
        return self._reached(f"TURN {place:.3f}", until_ns)

    def halt(self) -> None:
        """See `Controller`."""
        self._lines.send("STOP")

    def _steps_per_turn(self, until_ns: int) -> int:
        heard: str | None = None
        while self._lines.clock.now_ns() < until_ns:
            # A host that was killed may have left the board turning, and then it heeds nothing but STOP.
            self._lines.send("STOP")
            again_ns = self._lines.after(_AGAIN_S)
            while (line := self._lines.next(again_ns)) is not None:
                heard = line
                if _ANGLE.fullmatch(line):
                    break
            self._lines.send("ID?")
            again_ns = self._lines.after(_AGAIN_S)
            while (line := self._lines.next(again_ns)) is not None:
                heard, found = line, _IDENTITY.fullmatch(line)
                if found is None or not int(found[2]):
                    continue
                if int(found[1]) != _VERSION:
                    message = f"{self._lines.label} speaks version {found[1]} of its protocol, this driver {_VERSION}"
                    raise UnsupportedByDeviceError(message)
                return int(found[2])
        said = "nothing answered" if heard is None else f"found {heard!r}"
        message = (
            f"asked {self._lines.label} for its identity (ID?), expected 'slrig-turntable 1 STEPS', {said}; see its "
            "baud rate, its power and its firmware"
        )
        raise DeviceError(message)

    def _reached(self, command: str, until_ns: int) -> float:
        """Send a command; return the angle that its answer tells."""
        for early in self._lines.come():
            self._heed(early, command)
        self._lines.send(command)
        while (line := self._lines.next(until_ns)) is not None:
            self._heed(line, command)
            reached = _ANGLE.fullmatch(line)
            if reached is not None:
                return float(reached[1])
        self.halt()
        message = (
            f"{self._lines.label} did not answer {command!r} in time, and was told to stop; see to its power and "
            "cable, or give it longer (turn_s)"
        )
        raise DeviceError(message)

    def _heed(self, line: str, command: str) -> None:
        """Raise DeviceError if a line says that something is wrong."""
        if line == "START":
            message = f"{self._lines.label} restarted, and no longer knows where it stands; see to its power"
            raise DeviceError(message)
        refused, _, words = line.partition(" ")
        if refused == "ERR":
            message = f"{self._lines.label} answered {command!r} with: {words or 'an error that it does not name'}"
            raise DeviceError(message)

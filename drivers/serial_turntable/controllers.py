"""G-code as GRBL 1.1 takes it, and how it tells where it is and what is wrong.

A line is answered `ok` when it is understood, not when it has been obeyed: a turn is over when the status report, which
the byte `?` asks for, says Idle at the place that was asked for. Source: GRBL's own documents of its
interface, commands and numbers (github.com/gnea/grbl, version 1.1).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NoReturn

from drivers.serial_turntable.options import AXES, GrblOptions, LineOptions
from drivers.serial_turntable.turntable import ControllerLink
from slrig.errors import DeviceError, UnsupportedByDeviceError

_VERSION = 1
_IDENTITY = re.compile(r"slrig-turntable (\d+) (\d+)")
_ANGLE = re.compile(r"OK (-?\d+(?:\.\d+)?)")


_RESET, _STATUS_REQUEST, _HOLD = b"\x18", b"?", b"!"
_RETRY_S = 0.5
"""After this a byte or a line that nothing answered is sent again: far longer than any answer takes."""
_REPLY_S = 2.0
"""GRBL answers a line at once, unless its look-ahead is full, which one move never does."""
_POLL_S = 0.1
"""GRBL's documentation asks for 5 Hz at the least and 10 Hz at the most."""
_STILL_S = 1.0
"""A controller that is Idle elsewhere for so long does not begin to move any more."""
_PRINT_STEP = 0.001
"""Places are printed with three decimals."""
_HOLD_POLLS = 10
_BANNER = re.compile(r"grbl(hal)? ?v?\d", re.IGNORECASE)
_REPORT = re.compile(r"<([A-Za-z]+(?::\d+)?)\|(.*)>")
_SETTING = re.compile(r"\$(\d+)=(\d+(?:\.\d+)?)")
_NUMBERED = re.compile(r"(error|ALARM):\s*(\d+)")
_ERRORS = {
    1: "it found a number without a letter: the line came damaged",
    2: "it found a letter without a number: the line came damaged",
    3: "it does not know this $ command",
    5: "homing is switched off ($22)",
    7: "its EEPROM could not be read, and its settings are the factory's now: set them again",
    8: "it takes $ commands at rest only",
    9: "it is locked, by an alarm or a jog",
    11: "the line is longer than it takes",
    13: "its safety door is open",
    15: "the place lies beyond the axis' travel ($130 to $132)",
    20: "it does not know such G-code: is it GRBL 1.1?",
    22: "it has no feed rate: give speed_deg_s",
    25: "a word came twice: the line came damaged",
    26: "it found no axis: it lacks the one that `axis` names",
    36: "it cannot use a word of it: it lacks the axis that `axis` names",
}
_ALARMS = {
    1: "a limit switch was hit; a turntable has none: switch them off ($21=0)",
    2: "the place lies beyond the axis' travel: switch soft limits off ($20=0)",
    3: "it was reset while it turned, and has lost steps",
    6: "homing was broken off",
    7: "homing was broken off by the safety door",
    8: "homing did not get off its switch",
    9: "homing found no switch: a turntable needs no homing ($22=0)",
    10: "it lost its place: see to its emergency stop",
}


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

    def position(self) -> float:
        """See `Controller`."""
        return self._send_command("STOP", self._lines.after(_REPLY_S))

    def move_to(self, place: float, until_ns: int) -> float:
        """See `Controller`."""
        return self._send_command(f"TURN {place:.3f}", until_ns)

    def halt(self) -> None:
        """See `Controller`."""
        self._lines.send("STOP")

    def _steps_per_turn(self, until_ns: int) -> int:
        heard: str | None = None
        while self._lines.clock.now_ns() < until_ns:
            # A host that was killed may have left the board turning, and then it heeds nothing but STOP.
            self._lines.send("STOP")
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
                heard = line
                if _ANGLE.fullmatch(line):
                    break
            self._lines.send("ID?")
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
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

    def _send_command(self, command: str, until_ns: int) -> float:
        """Send a command; return the angle that its answer tells."""
        for early in self._lines.read_waiting():
            self._check_line(early, command)
        self._lines.send(command)
        while (line := self._lines.next_line(until_ns)) is not None:
            self._check_line(line, command)
            reached = _ANGLE.fullmatch(line)
            if reached is not None:
                return float(reached[1])
        self.halt()
        message = (
            f"{self._lines.label} did not answer {command!r} in time, and was told to stop; see to its power and "
            "cable, or give it longer (turn_s)"
        )
        raise DeviceError(message)

    def _check_line(self, line: str, command: str) -> None:
        """Raise DeviceError if a line says that something is wrong."""
        if line == "START":
            message = f"{self._lines.label} restarted, and no longer knows where it stands; see to its power"
            raise DeviceError(message)
        refused, _, words = line.partition(" ")
        if refused == "ERR":
            message = f"{self._lines.label} answered {command!r} with: {words or 'an error that it does not name'}"
            raise DeviceError(message)


@dataclass(frozen=True, slots=True)
class _GrblStatus:
    state: str
    place: float


class GrblController:
    """Implements `Controller` on GRBL 1.1 and what takes the same (grblHAL, FluidNC).

    Raises
    ------
    DeviceGoneError
        The port is gone.
    UnsupportedByDeviceError
        It is no GRBL, lacks the axis, or is set so that a table cannot turn round and round.
    DeviceError
        Nothing answers.
    """

    def __init__(self, lines: ControllerLink, options: GrblOptions) -> None:
        self._lines = lines
        self._axis = options.axis
        self._index = AXES.index(options.axis)
        self._feed = None if options.speed_deg_s is None else options.speed_deg_s * 60 * options.units_per_deg
        self._reset(lines.after(options.open_s))
        if self._status(lines.after(_REPLY_S)).state == "Alarm":
            # Locked at its start where homing is on; a table has nowhere to run into.
            self._send_command("$X")
        told = filter(None, map(_SETTING.match, self._send_command("$$")))
        settings = {int(each[1]): float(each[2]) for each in told}
        for key, wanted in ((13, "to report mm"), (20, "without soft limits, for a table turns round")):
            if settings.get(key):
                message = f"{lines.label} has ${key}={settings[key]:g}; set it {wanted}: ${key}=0"
                raise UnsupportedByDeviceError(message)
        steps = settings.get(100 + self._index)
        self.step = 1 / steps if steps else 0.0

    def position(self) -> float:
        """See `Controller`. Raises DeviceError, also where it has restarted or told an alarm meanwhile."""
        for line in self._lines.read_waiting():
            self._check_line(line, "before a turn")
        return self._status(self._lines.after(_REPLY_S)).place

    def move_to(self, place: float, until_ns: int) -> float:
        """See `Controller`."""
        # G53: places of the machine itself, as status reports have them, whatever offsets somebody has set.
        motion = "G0" if self._feed is None else f"G1 F{self._feed:.3f}"
        self._send_command(f"G21 G90 G53 {motion} {self._axis}{place:.4f}")
        still_ns: int | None = None
        while True:
            found = self._status(until_ns)
            now_ns = self._lines.clock.now_ns()
            if found.state == "Idle":
                still_ns = self._lines.after(_STILL_S) if still_ns is None else still_ns
                if abs(found.place - place) <= self.step / 2 + _PRINT_STEP or now_ns >= still_ns:
                    return found.place
            elif found.state in {"Alarm", "Check", "Sleep"}:
                message = f"{self._lines.label} is in the state {found.state} and does not turn; reset it"
                raise DeviceError(message)
            else:
                still_ns = None
            if now_ns >= until_ns:
                self.halt()
                message = (
                    f"{self._lines.label} did not get to {place:.3f} {self._axis} within turn_s; it was at "
                    f"{found.place:.3f}, in the state {found.state}, and was stopped; let it turn faster, or give more"
                )
                raise DeviceError(message)
            self._lines.wait(_POLL_S)

    def halt(self) -> None:
        """See `Controller`. Held first, which slows down, then reset, which forgets what was left of the turn."""
        self._lines.send_byte(_HOLD)
        for _ in range(_HOLD_POLLS):
            self._lines.send_byte(_STATUS_REQUEST)
            held = re.search(rb"<(Hold:0|Idle|Alarm)\b", self._lines.port.read(_POLL_S))
            if held is not None:
                break
        self._lines.send_byte(_RESET)

    def _reset(self, until_ns: int) -> None:
        """Reset it, which keeps its place while it stands, until it greets; a board that just restarts is deaf."""
        heard: list[str] = []
        while self._lines.clock.now_ns() < until_ns:
            self._lines.send_byte(_RESET)
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
                heard.append(line)
                if _BANNER.match(line):
                    # What was sent to a deaf board may still be greeted, and is so before this is answered.
                    self._lines.send("")
                elif line == "ok" and any(map(_BANNER.match, heard)):
                    return
        said = f"it said {heard[-1]!r}" if heard else "nothing answered"
        message = (
            f"asked {self._lines.label} to greet as GRBL does, {said}; see its baud rate, its power and whether its "
            "firmware is GRBL 1.1, grblHAL or FluidNC (Marlin is not served)"
        )
        raise UnsupportedByDeviceError(message) if heard else DeviceError(message)

    def _send_command(self, text: str) -> list[str]:
        """Send a line; return what came before its `ok`."""
        for early in self._lines.read_waiting():
            self._check_line(early, text)
        self._lines.send(text)
        until_ns = self._lines.after(_REPLY_S)
        told: list[str] = []
        while (line := self._lines.next_line(until_ns)) is not None:
            if line == "ok":
                return told
            self._check_line(line, text)
            told.append(line)
        message = (
            f"{self._lines.label} did not answer {text!r} in {_REPLY_S:g} s; see to its power, cable and baud rate"
        )
        raise DeviceError(message)

    def _status(self, until_ns: int) -> _GrblStatus:
        """Where it is, asked again while nothing that can be read comes."""
        # At least once, and past the deadline of a turn as well, which is to tell where it was.
        until_ns = max(until_ns, self._lines.after(_REPLY_S))
        while self._lines.clock.now_ns() < until_ns:
            self._lines.send_byte(_STATUS_REQUEST)
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
                self._check_line(line, "?")
                report = _REPORT.fullmatch(line)
                if report is not None:
                    return _GrblStatus(report[1], self._parse_position(report[2]))
        message = f"{self._lines.label} does not tell where it is any more; see to its power and cable"
        raise DeviceError(message)

    def _parse_position(self, fields: str) -> float:
        told = dict(field.partition(":")[::2] for field in fields.split("|"))
        if "MPos" not in told:
            message = f"{self._lines.label} does not report places of the machine (MPos): set $10=1"
            raise UnsupportedByDeviceError(message)
        places = told["MPos"].split(",")
        if len(places) <= self._index:
            message = (
                f"{self._lines.label} has no axis {self._axis}, only {', '.join(AXES[: len(places)])}; name another as "
                "`axis`, with units_per_deg"
            )
            raise UnsupportedByDeviceError(message)
        try:
            return float(places[self._index])
        except ValueError as error:
            message = f"{self._lines.label} reported {fields!r}, which holds no place; see to its cable"
            raise DeviceError(message) from error

    def _check_line(self, line: str, asked: str) -> None:
        """Raise DeviceError if a line says that something is wrong."""
        if _BANNER.match(line):
            message = (
                f"{self._lines.label} restarted by itself ({line!r}) and no longer knows where it stands; see to its "
                "power and its emergency stop"
            )
            raise DeviceError(message)
        numbered = _NUMBERED.fullmatch(line)
        if numbered is not None:
            self._raise_refusal(numbered[1], int(numbered[2]), asked)

    def _raise_refusal(self, kind: str, number: int, asked: str) -> NoReturn:
        words = (_ERRORS if kind == "error" else _ALARMS).get(number, "see GRBL's list of its numbers")
        message = f"{self._lines.label} answered {kind}:{number} to {asked!r}: {words}"
        raise DeviceError(message)

"""Controllers of a turntable: GRBL 1.1, and boards with the protocol of lines (see the docstring of the package).

GRBL answers a line with `ok` when it is understood, not when it is executed: a turn is over when the status report,
requested by the byte `?`, is Idle at the requested position. Source: GRBL's own documents of its interface, commands
and numbers (github.com/gnea/grbl, version 1.1).
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
"""After this time an unanswered byte or line is repeated: much longer than any answer takes."""
_REPLY_S = 2.0
"""Longest time for an answer that needs no movement."""
_POLL_S = 0.1
"""GRBL's documentation recommends 5 to 10 Hz."""
_STILL_S = 1.0
"""A controller that is Idle at another position for this time will not move any more."""
_PRINT_STEP = 0.001
"""Positions are printed with three decimals."""
_HOLD_POLLS = 10
_BANNER = re.compile(r"grbl(hal)? ?v?\d", re.IGNORECASE)
_REPORT = re.compile(r"<([A-Za-z]+(?::\d+)?)\|(.*)>")
_SETTING = re.compile(r"\$(\d+)=(\d+(?:\.\d+)?)")
_NUMBERED = re.compile(r"(error|ALARM):\s*(\d+)")
_ERRORS = {
    1: "it found a number without a letter: the line was damaged",
    2: "it found a letter without a number: the line was damaged",
    3: "unknown $ command",
    5: "homing is switched off ($22)",
    7: "its EEPROM could not be read, and its settings are the factory's now: set them again",
    8: "it accepts $ commands only at rest",
    9: "it is locked, by an alarm or a jog",
    11: "the line is longer than it takes",
    13: "its safety door is open",
    15: "the position is beyond the axis' travel ($130 to $132)",
    20: "unknown G-code: is it GRBL 1.1?",
    22: "it has no feed rate: give speed_deg_s",
    25: "a repeated word: the line was damaged",
    26: "it found no axis: it lacks the one that `axis` names",
    36: "it cannot use a word of it: it lacks the axis that `axis` names",
}
_ALARMS = {
    1: "a limit switch was hit; a turntable has none: switch them off ($21=0)",
    2: "the position is beyond the axis' travel: switch soft limits off ($20=0)",
    3: "it was reset while it turned, and has lost steps",
    6: "homing was broken off",
    7: "homing was broken off by the safety door",
    8: "homing did not get off its switch",
    9: "homing found no switch: a turntable needs no homing ($22=0)",
    10: "it lost its position: check its emergency stop",
}


class LineController:
    """Implements `TurntableController` for the protocol of lines. Its unit is a degree.

    Raises DeviceGoneError (the port is gone), UnsupportedByDeviceError (it speaks another version) and DeviceError (no
    answer).
    """

    def __init__(self, lines: ControllerLink, options: LineOptions) -> None:
        self._lines = lines
        self.step = 360 / self._steps_per_turn(lines.after(options.open_s))

    def position(self) -> float:
        """See `TurntableController`."""
        return self._send_command("STOP", self._lines.after(_REPLY_S))

    def move_to(self, position: float, until_ns: int) -> float:
        """See `TurntableController`."""
        return self._send_command(f"TURN {position:.3f}", until_ns)

    def halt(self) -> None:
        """See `TurntableController`."""
        self._lines.send("STOP")

    def _steps_per_turn(self, until_ns: int) -> int:
        received: str | None = None
        while self._lines.clock.now_ns() < until_ns:
            # A killed host may have left the board turning, in which it accepts only STOP.
            self._lines.send("STOP")
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
                received = line
                if _ANGLE.fullmatch(line):
                    break
            self._lines.send("ID?")
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
                received, found = line, _IDENTITY.fullmatch(line)
                if found is None or not int(found[2]):
                    continue
                if int(found[1]) != _VERSION:
                    message = f"{self._lines.label} speaks version {found[1]} of its protocol, this driver {_VERSION}"
                    raise UnsupportedByDeviceError(message)
                return int(found[2])
        answer = "got no answer" if received is None else f"found {received!r}"
        message = (
            f"requested the identity of {self._lines.label} (ID?), expected 'slrig-turntable 1 STEPS', {answer}; check "
            "its baud rate, its power and its firmware"
        )
        raise DeviceError(message)

    def _send_command(self, command: str, until_ns: int) -> float:
        """Send a command; return the angle in its answer."""
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
            f"{self._lines.label} did not answer {command!r} in time, and was stopped; check its power and "
            "cable, or give it longer (turn_s)"
        )
        raise DeviceError(message)

    def _check_line(self, line: str, command: str) -> None:
        """Raise DeviceError if a line reports an error."""
        if line == "START":
            message = f"{self._lines.label} restarted, and lost its position; check its power"
            raise DeviceError(message)
        verb, _, reason = line.partition(" ")
        if verb == "ERR":
            message = f"{self._lines.label} answered {command!r} with: {reason or 'an unnamed error'}"
            raise DeviceError(message)


@dataclass(frozen=True, slots=True)
class _GrblStatus:
    state: str
    position: float


class GrblController:
    """Implements `TurntableController` for GRBL 1.1 and compatible firmware (grblHAL, FluidNC).

    Raises DeviceGoneError (the port is gone), UnsupportedByDeviceError (it is not GRBL, lacks the axis, or has settings
    that do not allow endless rotation) and DeviceError (no answer).
    """

    def __init__(self, lines: ControllerLink, options: GrblOptions) -> None:
        self._lines = lines
        self._axis = options.axis
        self._index = AXES.index(options.axis)
        self._feed = None if options.speed_deg_s is None else options.speed_deg_s * 60 * options.units_per_deg
        self._reset(lines.after(options.open_s))
        if self._status(lines.after(_REPLY_S)).state == "Alarm":
            # With homing on it is locked at its start; a turntable has no end stops.
            self._send_command("$X")
        matches = filter(None, map(_SETTING.match, self._send_command("$$")))
        settings = {int(each[1]): float(each[2]) for each in matches}
        for key, wanted in ((13, "to report mm"), (20, "without soft limits, for endless rotation")):
            if settings.get(key):
                message = f"{lines.label} has ${key}={settings[key]:g}; set it {wanted}: ${key}=0"
                raise UnsupportedByDeviceError(message)
        steps = settings.get(100 + self._index)
        self.step = 1 / steps if steps else 0.0

    def position(self) -> float:
        """See `TurntableController`. Raises DeviceError also if it has restarted or reported an alarm meanwhile."""
        for line in self._lines.read_waiting():
            self._check_line(line, "before a turn")
        return self._status(self._lines.after(_REPLY_S)).position

    def move_to(self, position: float, until_ns: int) -> float:
        """See `TurntableController`."""
        # G53: machine coordinates, as in status reports, independent of offsets.
        motion = "G0" if self._feed is None else f"G1 F{self._feed:.3f}"
        self._send_command(f"G21 G90 G53 {motion} {self._axis}{position:.4f}")
        still_ns: int | None = None
        while True:
            found = self._status(until_ns)
            now_ns = self._lines.clock.now_ns()
            if found.state == "Idle":
                still_ns = self._lines.after(_STILL_S) if still_ns is None else still_ns
                if abs(found.position - position) <= self.step / 2 + _PRINT_STEP or now_ns >= still_ns:
                    return found.position
            elif found.state in {"Alarm", "Check", "Sleep"}:
                message = f"{self._lines.label} is in state {found.state} and does not turn; reset it"
                raise DeviceError(message)
            else:
                still_ns = None
            if now_ns >= until_ns:
                self.halt()
                message = (
                    f"{self._lines.label} did not reach {position:.3f} {self._axis} within turn_s; it was at "
                    f"{found.position:.3f}, in state {found.state}, and was stopped; turn it faster or raise turn_s"
                )
                raise DeviceError(message)
            self._lines.wait(_POLL_S)

    def halt(self) -> None:
        """See `TurntableController`. Feed hold first, which decelerates, then reset, which drops the rest of the
        turn.
        """
        self._lines.send_byte(_HOLD)
        for _ in range(_HOLD_POLLS):
            self._lines.send_byte(_STATUS_REQUEST)
            if re.search(rb"<(Hold:0|Idle|Alarm)\b", self._lines.port.read(_POLL_S)) is not None:
                break
        self._lines.send_byte(_RESET)

    def _reset(self, until_ns: int) -> None:
        """Reset it until it greets. Its position is kept at rest; a board that just restarted does not listen yet."""
        received: list[str] = []
        while self._lines.clock.now_ns() < until_ns:
            self._lines.send_byte(_RESET)
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
                received.append(line)
                if _BANNER.match(line):
                    # Earlier resets may cause more greetings, which arrive before this is answered.
                    self._lines.send("")
                elif line == "ok" and any(map(_BANNER.match, received)):
                    return
        answer = f"found {received[-1]!r}" if received else "got no answer"
        message = (
            f"reset {self._lines.label}, expected GRBL's greeting, {answer}; check its baud rate, its power and that "
            "its firmware is GRBL 1.1, grblHAL or FluidNC (Marlin is not supported)"
        )
        raise UnsupportedByDeviceError(message) if received else DeviceError(message)

    def _send_command(self, text: str) -> list[str]:
        """Send a line; return the lines before its `ok`."""
        for early in self._lines.read_waiting():
            self._check_line(early, text)
        self._lines.send(text)
        until_ns = self._lines.after(_REPLY_S)
        answer: list[str] = []
        while (line := self._lines.next_line(until_ns)) is not None:
            if line == "ok":
                return answer
            self._check_line(line, text)
            answer.append(line)
        message = f"{self._lines.label} did not answer {text!r} in {_REPLY_S:g} s; check its power, cable and baud rate"
        raise DeviceError(message)

    def _status(self, until_ns: int) -> _GrblStatus:
        """Request the status until a valid report arrives."""
        # At least once, also after the deadline of a turn, whose error states the position.
        until_ns = max(until_ns, self._lines.after(_REPLY_S))
        while self._lines.clock.now_ns() < until_ns:
            self._lines.send_byte(_STATUS_REQUEST)
            again_ns = self._lines.after(_RETRY_S)
            while (line := self._lines.next_line(again_ns)) is not None:
                self._check_line(line, "?")
                report = _REPORT.fullmatch(line)
                if report is not None:
                    return _GrblStatus(report[1], self._parse_position(report[2]))
        message = f"{self._lines.label} no longer reports its position; check its power and cable"
        raise DeviceError(message)

    def _parse_position(self, fields: str) -> float:
        report = dict(field.partition(":")[::2] for field in fields.split("|"))
        if "MPos" not in report:
            message = f"{self._lines.label} does not report machine positions (MPos): set $10=1"
            raise UnsupportedByDeviceError(message)
        positions = report["MPos"].split(",")
        if len(positions) <= self._index:
            message = (
                f"{self._lines.label} has no axis {self._axis}, only {', '.join(AXES[: len(positions)])}; name another "
                "as `axis`, with units_per_deg"
            )
            raise UnsupportedByDeviceError(message)
        try:
            return float(positions[self._index])
        except ValueError as error:
            message = f"{self._lines.label} reported {fields!r}, which has no position; check its cable"
            raise DeviceError(message) from error

    def _check_line(self, line: str, command: str) -> None:
        """Raise DeviceError if a line reports an error."""
        if _BANNER.match(line):
            message = (
                f"{self._lines.label} restarted on its own ({line!r}) and lost its position; check its power and its "
                "emergency stop"
            )
            raise DeviceError(message)
        numbered = _NUMBERED.fullmatch(line)
        if numbered is not None:
            self._raise_refusal(numbered[1], int(numbered[2]), command)

    def _raise_refusal(self, kind: str, number: int, command: str) -> NoReturn:
        reason = (_ERRORS if kind == "error" else _ALARMS).get(number, "see GRBL's documentation of its numbers")
        message = f"{self._lines.label} answered {kind}:{number} to {command!r}: {reason}"
        raise DeviceError(message)

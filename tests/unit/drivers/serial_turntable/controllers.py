"""Stand-ins for controllers of turntables, written from the documents of GRBL 1.1 and of drivers.serial_turntable."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

from drivers.serial_turntable import open_grbl, open_turntable
from slrig.devices import Turntable
from slrig.errors import DeviceGoneError
from tests.virtual_clock import VirtualClock


@dataclass
class Board(ABC):
    """What sits at the end of the line. Implements `drivers.serial_port.BytePort`.

    heard : all lines and realtime bytes.
    """

    clock: VirtualClock = field(default_factory=VirtualClock, init=False)
    heard: list[str] = field(default_factory=list, init=False)
    silent: bool = field(default=False, init=False)
    on_line: Callable[[str], bytes | None] = field(default_factory=lambda: lambda _line: None, init=False)
    """Called first with each line; what it returns is sent instead of an answer."""

    def __post_init__(self) -> None:
        self._rest, self._sent = b"", b""
        self._unplugged, self._never = False, threading.Event()

    def opened(self, **options: Any) -> Turntable:
        """The driver at the other end of the line, on the board's clock."""
        factory = open_grbl if isinstance(self, GrblBoard) else open_turntable
        with mock.patch("drivers.serial_port.SerialPort", return_value=self):
            return factory({"port": "wire", **options}, Path(), clock=self.clock)

    def say(self, data: bytes) -> None:
        if not self.silent and not self._unplugged:
            self._sent += data

    def unplug(self) -> None:
        self._unplugged = True

    def close(self) -> None:
        """See `BytePort`. The board goes on, and may be opened again."""
        self._sent = b""

    def read(self, timeout_s: float) -> bytes:
        self._require_plugged()
        if not self._sent:
            self.clock.wait_until(self.clock.now_ns() + round(timeout_s * 1e9), self._never)
        data, self._sent = self._sent, b""
        return data

    def write(self, data: bytes) -> None:
        self._require_plugged()
        for value in data:
            byte = bytes([value])
            if self.realtime(byte):
                continue
            self._rest += byte
            if byte == b"\n":
                line, self._rest = self._rest.decode("ascii").strip(), b""
                self.heard.append(line)
                instead = self.on_line(line)
                self.say(self.obey(line) if instead is None else instead)

    def _require_plugged(self) -> None:
        if self._unplugged:
            message = "the turntable on wire was unplugged"
            raise DeviceGoneError(message)

    def realtime(self, byte: bytes) -> bool:
        """Whether a byte is obeyed at once."""
        del byte
        return False

    @abstractmethod
    def obey(self, line: str) -> bytes:
        """The answer to a line."""


@dataclass
class GrblBoard(Board):
    """A controller with GRBL 1.1. settings : of `$$`; axes : how many it reports; slow : reports that a move takes."""

    axes: int = 3
    slow: int = 2
    settings: dict[int, str] = field(default_factory=lambda: {10: "1", 13: "0", 20: "0", 22: "0", 100: "250.000"})
    locked: bool = False
    deaf: int = 0
    """Resets that a board that still boots does not hear."""
    stuck: bool = False
    on_report: Callable[[int], bytes | None] = lambda _count: None

    def __post_init__(self) -> None:
        self.places, self.target, self.left = [0.0] * self.axes, 0.0, 0
        self.state = "Alarm" if self.locked else "Idle"
        self.moved, self.reports = 0, 0
        self.axis, self.start = 0, 0.0
        super().__post_init__()

    def banner(self) -> bytes:
        lock = b"[MSG:'$H'|'$X' to unlock]\r\n" if self.state == "Alarm" else b""
        return b"\r\nGrbl 1.1h ['$' for help]\r\n" + lock

    def realtime(self, byte: bytes) -> bool:
        if byte == b"\x18":
            self.heard.append("reset")
            if self.deaf:
                self.deaf -= 1
                return True
            self._rest = b""
            if self.left:
                self.left, self.state = 0, "Alarm"
                self.say(b"ALARM:3\r\n")
            self.say(self.banner())
        elif byte == b"!":
            self.heard.append("hold")
            if self.left:
                self.state = "Hold:0"
        elif byte == b"?":
            self.report()
        else:
            return False
        return True

    def report(self) -> None:
        self.reports += 1
        instead = self.on_report(self.reports)
        if self.state in {"Run", "Idle"} and self.left and not self.stuck:
            self.left -= 1
            share = 1 - self.left / self.slow
            self.places[self.axis] = self.start + share * (self.target - self.start)
            self.state = "Run" if self.left else "Idle"
        elif self.stuck and self.left and self.state == "Idle":
            self.state = "Run"
        if instead is not None:
            self.say(instead)
            return
        name = "MPos" if int(self.settings.get(10, "1")) & 1 else "WPos"
        places = ",".join(f"{place:.3f}" for place in self.places)
        self.say(f"<{self.state}|{name}:{places}|FS:0,0|Ov:100,100,100>\r\n".encode())

    def obey(self, line: str) -> bytes:
        if line == "":
            return b"ok\r\n"
        if line == "$X":
            self.state = "Idle"
            return b"[MSG:Caution: Unlocked]\r\nok\r\n"
        if line == "$$":
            return "".join(f"${key}={value}\r\n" for key, value in self.settings.items()).encode() + b"ok\r\n"
        if self.state == "Alarm":
            return b"error:9\r\n"
        words = {word[0]: float(word[1:]) for word in line.split() if word[0] not in "G"}
        codes = {word for word in line.split() if word[0] == "G"}
        axes = [letter for letter in "XYZABC"[: self.axes] if letter in words]
        if not axes:
            return b"error:26\r\n"
        if not {"G53", "G90", "G21"} <= codes:
            return b"error:20\r\n"
        if "G1" in codes and not words.get("F"):
            return b"error:22\r\n"
        self.axis = "XYZABC".index(axes[0])
        steps = float(self.settings.get(100 + self.axis, "250"))
        self.start, self.target = self.places[self.axis], round(words[axes[0]] * steps) / steps
        self.left, self.moved = (self.slow if self.start != self.target else 0), self.moved + 1
        return b"ok\r\n"


@dataclass
class LineBoard(Board):
    """A board with the protocol of lines. at_deg : where it stands; an angle is reached to the nearest step."""

    steps: int = 3200
    at_deg: float = 0.0
    off_deg: float = 0.0
    """How far beyond what was asked for it stops."""
    turning: bool = False
    """In a turn of a host before: it heeds STOP alone."""

    def obey(self, line: str) -> bytes:
        verb, _, rest = line.partition(" ")
        self.turning = self.turning and verb != "STOP"
        if self.turning:
            return b""
        if verb == "ID?":
            return f"slrig-turntable 1 {self.steps}\n".encode()
        if verb == "TURN":
            self.at_deg = round(float(rest) * self.steps / 360) * 360 / self.steps + self.off_deg
        elif verb != "STOP":
            return f"ERR unknown command {verb}\n".encode()
        return f"OK {self.at_deg:.3f}\n".encode()

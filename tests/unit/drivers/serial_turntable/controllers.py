"""Stand-ins for controllers of turntables, on pseudo-terminals: written from the protocols' documents alone.

`GrblBoard` follows what GRBL 1.1 publishes of its interface and commands: realtime bytes are obeyed as they come, lines
are answered in order, a status report is made when it is asked for. `LineBoard` follows the docstring of
drivers.serial_turntable. Motion is counted in reports, or in looks, not in time: `slow` says how many it takes.
"""

from __future__ import annotations

import os
import pty
import select
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field


class SkippingClock:
    """Time that passes, and jumps where somebody waits. Implements `slrig.devices.Clock`."""

    def __init__(self) -> None:
        self.skipped_ns = 0
        self.waits_s: list[float] = []
        self.on_wait: Callable[[], None] = lambda: None

    def now_ns(self) -> int:
        return time.monotonic_ns() + self.skipped_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        self.on_wait()
        if not stop.is_set():
            left_ns = max(t_ns - self.now_ns(), 0)
            self.waits_s.append(left_ns / 1e9)
            self.skipped_ns += left_ns


@dataclass
class Board(ABC):
    """What sits at the end of the line; its own thread serves it. `heard` : all lines and realtime bytes."""

    heard: list[str] = field(default_factory=list, init=False)
    silent: bool = field(default=False, init=False)
    on_line: Callable[[str], bytes | None] = field(default_factory=lambda: lambda _line: None, init=False)
    """Asked first about each line; what it returns is sent instead of an answer."""

    def __post_init__(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._woken, self._wake = os.pipe()
        self._open, self._rest = True, b""
        self._unplugged = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def say(self, data: bytes) -> None:
        if not self.silent and not self._unplugged.is_set():
            os.write(self._master, data)

    def unplug(self) -> None:
        """The cable is pulled; in the board's own thread."""
        self._unplugged.set()
        os.close(self._master)
        os.close(self._slave)

    def close(self) -> None:
        os.write(self._wake, b"x")
        self._thread.join(10)
        if not self._unplugged.is_set():
            self.unplug()
        os.close(self._wake)
        os.close(self._woken)

    def realtime(self, byte: bytes) -> bool:
        """Whether a byte is obeyed at once."""
        del byte
        return False

    @abstractmethod
    def obey(self, line: str) -> bytes:
        """The answer to a line."""

    def _serve(self) -> None:
        while not self._unplugged.is_set():
            ready, _, _ = select.select([self._master, self._woken], [], [])
            if self._master not in ready:
                return
            for value in os.read(self._master, 4096):
                byte = bytes([value])
                if self.realtime(byte) or self._unplugged.is_set():
                    continue
                self._rest += byte
                if byte == b"\n":
                    line, self._rest = self._rest.decode("ascii").strip(), b""
                    self.heard.append(line)
                    instead = self.on_line(line)
                    answer = self.obey(line) if instead is None else instead
                    if answer:
                        self.say(answer)


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
        self.moved, self.reports, self.resets = 0, 0, 0
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
            self.resets += 1
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
        if self._unplugged.is_set():
            return
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
    """In a turn that nobody waits for: it heeds STOP alone."""

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

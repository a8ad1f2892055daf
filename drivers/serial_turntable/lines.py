"""Lines of text from a controller, in bounded time; what is no line of printable ASCII is passed over."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

from drivers.serial_port import SLICE_S, BytePort
from slrig.devices import Clock
from slrig.errors import DeviceStateError

NS_PER_S = 1_000_000_000
_MAX_LINE_BYTES = 1024
"""Bytes without an end of line that are kept: no controller sends so long a line."""


@dataclass(slots=True)
class ControllerLink:
    """A controller's port, line by line. `closing` ends a wait from another thread. label : what errors call it."""

    port: BytePort
    clock: Clock
    label: str
    closing: threading.Event = field(default_factory=threading.Event)
    _rest: bytes = b""
    _come: deque[str] = field(default_factory=deque)

    def send(self, text: str) -> None:
        """Send a line. Raises DeviceGoneError."""
        self.port.write(text.encode("ascii") + b"\n")

    def send_byte(self, byte: bytes) -> None:
        """Send a byte that is obeyed at once. Raises DeviceGoneError."""
        self.port.write(byte)

    def after(self, seconds: float) -> int:
        """The time in so many seconds, ns."""
        return self.clock.now_ns() + round(seconds * NS_PER_S)

    def wait(self, seconds: float) -> None:
        """Let time pass. Raises DeviceStateError: it was closed meanwhile."""
        self.clock.wait_until(self.after(seconds), self.closing)
        self._require_open()

    def next(self, until_ns: int) -> str | None:
        """The next line, or None when it is time. Raises DeviceGoneError; DeviceStateError: it was closed meanwhile."""
        while True:
            self._require_open()
            if self._come:
                return self._come.popleft()
            left_s = (until_ns - self.clock.now_ns()) / NS_PER_S
            self._take(self.port.read(min(max(left_s, 0.0), SLICE_S)))
            if left_s <= 0 and not self._come:
                return None

    def come(self) -> list[str]:
        """What has come in already. Raises DeviceGoneError."""
        lines: list[str] = []
        while (line := self.next(0)) is not None:
            lines.append(line)
        return lines

    def _take(self, data: bytes) -> None:
        *whole, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        self._rest = rest[-_MAX_LINE_BYTES:]
        for raw in whole:
            line = raw.decode("ascii", "replace").strip()
            if line and line.isascii() and line.isprintable():
                self._come.append(line)

    def _require_open(self) -> None:
        if self.closing.is_set():
            message = f"{self.label} was closed while it was waited for; open the rig again"
            raise DeviceStateError(message)

"""A DLPC900 at the other end of the wire: what the controller does with reports, as DLPU018 says, and strictly."""

from __future__ import annotations

import struct
import threading
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model import Pixels, Size
from tests.contract.dlpc350_device import FakeEngine, profile_of, repeated

_SETTINGS = {0x0B01: 3, 0x1008: 1, 0x1009: 1, 0x1A05: 1, 0x1A1D: 5, 0x1A30: 1}
_ANY_TIME = {0x0200: 1, 0x1A07: 1}
_PATTERN_COMMANDS = {0x1A31, 0x1A32, 0x1A34, 0x1A2A, 0x1A2B, 0x1A2C, 0x1A2D}
_UNANSWERED = {0x1A2B, 0x1A2D, 0x1A32}
_SIZES = {1: Size(1920, 1080), 2: Size(2560, 1600)}


@dataclass
class _Entry:
    """An entry of the pattern table, µs."""

    exposure_us: int
    dark_us: int
    leds: int
    picture: int
    plane: int
    cleared: bool


class Fake900(FakeEngine):
    """A controller that is sent its pictures.

    mirrors : 1 DLP6500, 2 DLP9000. version : of its firmware. refusing : error codes by commands that are refused. The
    others as `FakeEngine` has them.
    """

    _PATTERN_MODE = b"\3"

    def __init__(self, *, mirrors: int = 1, version: tuple[int, int] = (6, 1), **usual: Any) -> None:
        super().__init__({}, **usual)
        for command, length in (_SETTINGS | _ANY_TIME).items():
            self.registers.setdefault(command, bytes(length))
        self.registers |= {0x1A1D: bytes(5), 0x1A1B: b"\1"}
        self.mirrors, self.version = mirrors, version
        self.error = 0
        self.refusing: dict[int, int] = {}
        self.second_ready = mirrors != 1
        self.entries: dict[int, _Entry] = {}
        self._effective: dict[int, _Entry] = {}
        self._configured = (0, 0)
        self._order: list[int] = []
        self._shown_of_order = 0
        self._halves: dict[tuple[int, int], NDArray[np.uint32]] = {}
        self._loading: dict[int, tuple[int, int, bytearray]] = {}
        self._pictures: dict[int, NDArray[np.uint32]] = {}

    @property
    def size(self) -> Size:
        return _SIZES[self.mirrors]

    def _told(self, command: int) -> bytes | None:
        match command:
            case 0x0100:
                return bytes([self.error])
            case 0x0205:
                return struct.pack("<HBB12x", 3, self.version[1], self.version[0])
            case 0x0206:
                return bytes([self.mirrors]) + b"out of the box".ljust(32, b"\0")
            case 0x1A0A:
                return bytes([self._hardware | (16 if self.second_ready else 0)])
        # These are the other controller's, and starting and stopping cannot be read.
        return None if command in {0x1A1A, 0x1A24, 0x1A42, 0x1AFF, 0x1A22, 0x1A23, 0x1A29} else super()._told(command)

    def _set(self, command: int, data: bytes) -> bytes | None:
        if command in _PATTERN_COMMANDS:
            self.error = self.refusing.get(command, 0) or self._pattern_command(command, data)
            refused = self.error and command not in _UNANSWERED
            return None if refused else b""
        self.error = 0
        if command == 0x1A24:
            return self._started(data)
        if command == 0x1A1B and len(data) == 1 and not self.running:
            self._after(self.times.mode, partial(self._enter, data))
            return b""
        if len(data) != (_SETTINGS | _ANY_TIME).get(command) or (self.running and command in _SETTINGS):
            self.error = 5 if self.running else 6
            return None
        if command == 0x1A1D and not -20 <= struct.unpack("<Bhh", data)[1] <= struct.unpack("<Bhh", data)[2] <= 20_000:
            self.error = 13
            return None
        self.registers[command] = data
        self._relight()
        return b""

    def _pattern_command(self, command: int, data: bytes) -> int:
        """Do it, and return the error code."""
        if self.running or self.registers[0x1A1B] != self._PATTERN_MODE:
            return 5
        match command:
            case 0x1A34:
                return self._define(data)
            case 0x1A31:
                entries, shown = struct.unpack("<HI", data)
                if not 1 <= entries <= 400 or set(range(entries)) - self.entries.keys():
                    return 15
                if entries != self._configured[0]:
                    self._halves.clear()
                self._configured = (entries, shown)
                self._effective = {index: self.entries[index] for index in range(entries)}
                self._order, self._shown_of_order = list(range(entries)), shown
            case 0x1A32:
                count, shown = struct.unpack_from("<HI", data)
                order = list(struct.unpack_from(f"<{count}H", data, 6))
                if any(index >= self._configured[0] for index in order):
                    return 15
                self._order, self._shown_of_order = order, shown
            case 0x1A2A | 0x1A2C:
                number, size = struct.unpack("<HI", data)
                half = 0 if command == 0x1A2A else 1
                if number > 17:
                    return 17
                # The last one comes first: any other order begins at the start, and what there was is lost.
                if (half, number + 1) not in self._halves or (half, number) in self._halves:
                    self._halves = {key: held for key, held in self._halves.items() if key[0] != half}
                self._loading[half] = (number, size, bytearray())
            case _:
                return self._load(0 if command == 0x1A2B else 1, data)
        return 0

    def _define(self, data: bytes) -> int:
        if len(data) != 12:
            return 6
        (index,) = struct.unpack_from("<H", data)
        flags, (place,) = data[5], struct.unpack_from("<H", data, 10)
        entry = _Entry(
            int.from_bytes(data[2:5], "little"),
            int.from_bytes(data[6:9], "little"),
            flags >> 4 & 7,
            place & 0x7FF,
            place >> 11,
            bool(flags & 1),
        )
        if flags & 0x8E or data[9] & 2 or entry.plane > 23:
            return 16
        if entry.exposure_us < 105:
            return 14
        self.entries[index] = entry
        return 0

    def _load(self, half: int, data: bytes) -> int:
        if half not in self._loading:
            return 7
        number, size, came = self._loading[half]
        if int.from_bytes(data[:2], "little") != len(data) - 2 or len(data) - 2 > 504:
            return 6
        came += data[2:]
        if len(came) < size:
            return 0
        del self._loading[half]
        columns = self.size.width_px // (1 if self.mirrors == 1 else 2)
        picture = unpacked(bytes(came[:size]), Size(columns, self.size.height_px))
        if picture is None:
            return 9
        self._halves[half, number] = picture
        self._pictures.clear()
        return 0

    def _profile(self, entry: _Entry) -> Pixels:
        # All planes at once are cut to a line: a start that takes longer than its answer may is no engine's.
        if entry.picture not in self._pictures:
            halves = [self._halves[half, entry.picture] for half in range(1 if self.mirrors == 1 else 2)]
            self._pictures[entry.picture] = repeated(np.hstack(halves))
        return profile_of(self._pictures[entry.picture] >> np.uint32(entry.plane) & np.uint32(1))

    def _enter(self, mode: bytes) -> None:
        super()._enter(mode)
        self._halves.clear()

    def _started(self, data: bytes) -> bytes | None:
        answer = super()._started(data)
        self.error = 5 if answer is None else 0
        return answer

    def _is_set(self) -> bool:
        halves = 1 if self.mirrors == 1 else 2
        needed = {(half, self._effective[index].picture) for index in self._order for half in range(halves)}
        return bool(self._order) and not needed - self._halves.keys()

    def _begin(self) -> None:
        steps = [self._effective[index] for index in self._order]
        for step in steps:
            self._profile(step)
        self._play(self._show, steps, self._shown_of_order or 2**32)

    def _show(self, halt: threading.Event, steps: list[_Entry], shown: int) -> bool:
        triggered = False
        for number in range(shown):
            entry = steps[number % len(steps)]
            if not self._change(halt, self._profile(entry) if entry.leds else None):
                return False
            if not triggered:
                self._pulse(self._clock.now_ns())
            triggered = True
            if self._halted(halt, entry.exposure_us / 1e6):
                return False
            if entry.cleared and entry.dark_us:
                triggered = False
                if not self._change(halt, None):
                    return False
            if self._halted(halt, entry.dark_us / 1e6):
                return False
        return True


def unpacked(content: bytes, size: Size) -> NDArray[np.uint32] | None:
    """A picture out of its header and its enhanced run-length encoding (DLPU018 2-106, 2-109); None: faulty."""
    signature, width, height, count = struct.unpack_from("<4sHHI", content)
    if signature != b"Spld" or (width, height) != (size.width_px, size.height_px) or content[25:27] != b"\2\1":
        return None
    if content[12:20] != b"\xff" * 8 or count != len(content) - 48 or count % 4:
        return None
    data = content[48:]
    pixels = np.zeros(width * height, np.uint32)
    at = filled = 0

    def number() -> int:
        nonlocal at
        first = data[at]
        at += 1
        if first < 128:
            return first
        at += 1
        return first & 0x7F | data[at - 1] << 7

    def pixel() -> int:
        nonlocal at
        at += 3
        return int.from_bytes(data[at - 3 : at], "big")

    while True:
        repeat = number()
        if repeat:
            pixels[filled : filled + repeat] = pixel()
            filled += repeat
            continue
        raw = number()
        if raw != 1:
            for _ in range(raw):
                pixels[filled] = pixel()
                filled += 1
            continue
        copied = number()
        if copied == 0:
            return pixels.reshape(height, width) if filled == pixels.size else None
        pixels[filled : filled + copied] = pixels[filled - width : filled - width + copied]
        filled += copied

"""A DLPC350 at the other end of the wire: what the controller does with reports, as TI's documents say, and strictly.

It wakes up in video mode with every LED on and the sequencer running; a stop leaves the last pattern lit; settings are
refused while a sequence runs, and a start before the tables were validated; light comes only when the picture was
loaded. It takes its time where TI's own programs wait: `Times`.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.devices import Clock, SystemClock
from slrig.model import Pixels

REPORT = 64
WHITE: Pixels = np.full((1, 1), 255, np.uint8)
SEQUENCER = "fake engine"
"""The name of the thread on which a fake engine plays."""

_SETTINGS = {
    0x0B01: 3,
    0x1008: 1,
    0x1009: 1,
    0x1A05: 1,
    0x1A1D: 3,
    0x1A22: 1,
    0x1A23: 1,
    0x1A29: 8,
    0x1A30: 1,
    0x1A31: 4,
}
"""Registers by command, with their lengths; written only while no sequence runs."""
_AT_ANY_TIME = {0x0200: 1, 0x1A07: 1, 0x1A1B: 1, 0x1A32: 1, 0x1A33: 1}
_INVALIDATES = {0x1A1B, 0x1A1D, 0x1A22, 0x1A23, 0x1A29, 0x1A30, 0x1A31, 0x1A34}


@dataclass
class Faults:
    """What goes wrong. silent, refused : commands that are not answered, or refused."""

    silent: set[int] = field(default_factory=set)
    refused: set[int] = field(default_factory=set)
    stale_answer: bool = False


@dataclass
class Times:
    """How long an engine takes, s. TI's programs wait 0.1 to 1.1 s for a mode and for a stop, 0.11 s and longer for a
    check, and look at the status 0.01 s after a start.

    mode : until it is in the mode that it was told; until then it says the one before, and takes no patterns. stop :
    until a sequence ends that was told to stop; until then it goes on, and nothing can be set or started. check : until
    the tables are checked; it says "busy" from `check_begins` on, and before that what the last check found. start :
    until the sequencer runs.
    """

    mode: float = 0.0
    stop: float = 0.0
    check_begins: float = 0.0
    check: float = 0.0
    start: float = 0.0


class Sequencer(ABC):
    """What fake engines have in common: a light, and a thread that plays. It wakes up with the light on. bent :
    registers that read back otherwise than they were set.
    """

    def __init__(self, clock: Clock | None) -> None:
        self.commands: list[tuple[int, bytes]] = []
        self.bent: dict[int, bytes] = {}
        self.shown: list[Pixels | None] = []
        self.lit: Pixels | None = None
        self._clock = clock or SystemClock()
        self._mirrors: Pixels | None = WHITE
        self._halt: threading.Event | None = None
        self._lock = threading.RLock()

    def _after(self, seconds: float, act: Callable[[], object]) -> None:
        """Do it at once, or on a thread when the time has come."""

        def wait() -> None:
            self._clock.wait_until(due_ns, threading.Event())
            with self._lock:
                act()

        due_ns = self._clock.now_ns() + round(seconds * 1e9)
        threading.Thread(target=wait, name=SEQUENCER, daemon=True).start() if seconds else act()

    @property
    def running(self) -> bool:
        return self._halt is not None

    def unplug(self) -> None:
        """Without power, there is no light."""
        self._stop()
        self._mirrors = None
        self._relight()

    def _play(self, run: Callable[..., object], *what: object) -> None:
        """Play on a thread: `run` gets what ends it, and returns whether nothing did."""
        self._halt = halt = threading.Event()

        def play() -> None:
            if run(halt, *what):
                with self._lock:
                    self._halt = None if self._halt is halt else self._halt

        threading.Thread(target=play, name=SEQUENCER, daemon=True).start()

    def _stop(self) -> None:
        halt, self._halt = self._halt, None
        if halt is not None:
            halt.set()

    @abstractmethod
    def _relight(self) -> None: ...

    def _is_fresh(self, lit: Pixels | None) -> bool:
        """Take note of light; whether it has changed."""
        if lit is self.lit:
            return False
        self.lit = lit
        self.shown.append(lit)
        return True


class FakeEngine(Sequencer):
    """A controller with pictures in its flash: BMP files by their place.

    light, pulse : called at every change of light (None: dark), and at every edge of the trigger output (ns). load_s :
    how long a picture takes from the flash. keeps : whether a start takes it from the buffer where it is still there;
    TI's documents say nothing of it. times : how long it takes for all else. clock : the one that its sequencer runs
    by. led_inverted : whether light falls as the registers of the currents rise; None: it is full unless all of them
    are 255.
    """

    _PATTERN_MODE = b"\1"

    def __init__(
        self,
        pictures: Mapping[int, bytes],
        *,
        light: Callable[[Pixels | None], object] = lambda _: None,
        pulse: Callable[[int], None] = lambda _: None,
        tag: str = "",
        load_s: float = 0.0,
        standby: bool = False,
        keeps: bool = False,
        times: Times | None = None,
        led_inverted: bool | None = None,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(clock)
        self.faults = Faults()
        self.times = times or Times()
        self.tag = tag
        self.registers: dict[int, bytes] = {
            **{command: bytes(length) for command, length in (_SETTINGS | _AT_ANY_TIME).items()},
            0x0200: bytes([standby]),
            0x0B01: bytes([0x97, 0x78, 0x7D]),
            0x1008: b"\1",
            0x1A07: b"\x08",
        }
        self._planes = {index: _planes(picture) for index, picture in pictures.items()}
        self._light, self._pulse, self._load_s = light, pulse, load_s
        self._keeps, self._led_inverted = keeps, led_inverted
        self._buffered: list[int] = []
        self._mailboxes = {1: bytearray(64), 2: bytearray(128 * 3)}
        self._action = b"\0"
        self._stopping = False
        self._checked, self._validated = 0, False
        self._hardware = 1
        self._pending: tuple[bytearray, int] | None = None
        self._relight()

    def take(self, report: bytes) -> bytes | None:
        """Take one report of the host, and return the answer that it makes, if it completes a message."""
        if self._pending is None:
            self._pending = bytearray(), 4 + int.from_bytes(report[2:4], "little")
        message, length = self._pending
        message += report
        if len(message) < length:
            return None
        self._pending = None
        flags, sequence = message[0], message[1]
        command = int.from_bytes(message[4:6], "little")
        data = bytes(message[6:length])
        with self._lock:
            self.commands.append((command, data)) if not flags & 0x80 else None
            if command in self.faults.silent:
                return None
            answer = None if command in self.faults.refused else self._done(command, data, read=bool(flags & 0x80))
        if not flags & 0x40:
            return None
        head = bytes([flags | (0x20 if answer is None else 0), sequence]) + len(answer or b"").to_bytes(2, "little")
        return (head + (answer or b"")).ljust(REPORT, b"\0")

    def _done(self, command: int, data: bytes, *, read: bool) -> bytes | None:
        """The answer to a command; None: refused."""
        if self.registers[0x0200] == b"\1" and command not in {0x0200, 0x1A0A}:
            return None
        if read:
            return self.bent.get(command) or self._told(command)
        return self._set(command, data)

    def _told(self, command: int) -> bytes | None:
        match command:
            case 0x1A0A:
                return bytes([self._hardware])
            case 0x1A0C:
                # Video is shown by the sequencer, too.
                return bytes([2 if self.running or self.registers[0x1A1B] == b"\0" else 0])
            case 0x1A1A:
                return bytes([self._checked])
            case 0x1A24:
                return self._action
            case 0x1A42:
                return bytes([len(self._planes)])
            case 0x1AFF:
                return self.tag.encode().ljust(32, b"\0")
        return self.registers.get(command)

    def _set(self, command: int, data: bytes) -> bytes | None:
        if command == 0x1A24:
            return self._started(data)
        of_patterns = command in {0x1A1A, 0x1A33, 0x1A34}
        in_pattern_mode = self.registers[0x1A1B] == self._PATTERN_MODE
        if (of_patterns and not in_pattern_mode) or (self.running and (command in _SETTINGS or of_patterns)):
            return None
        if command in _INVALIDATES:
            self._validated = False
        if command == 0x1A1A:
            self._after(self.times.check_begins, partial(self._check, 0x80))
            self._after(self.times.check_begins + self.times.check, lambda: self._check(self._validation()))
        elif command == 0x1A1B and len(data) == 1:
            self._after(self.times.mode, partial(self._enter, data))
        elif command == 0x1A34:
            box = self._mailboxes.get(self.registers[0x1A33][0])
            start = self.registers[0x1A32][0]
            if box is None or start + len(data) > len(box):
                return None
            box[start : start + len(data)] = data
        elif len(data) == (_SETTINGS | _AT_ANY_TIME).get(command):
            self.registers[command] = data
            self._relight()
        else:
            return None
        return b""

    def _enter(self, mode: bytes) -> None:
        self.registers[0x1A1B] = mode

    def _check(self, found: int) -> None:
        self._checked, self._validated = found, found == 0

    def _started(self, data: bytes) -> bytes | None:
        if data == b"\0":
            if not self._stopping:
                self._stopping = True
                self._after(self.times.stop if self.running else 0.0, self._stopped)
        elif data == b"\2" and not self.running and self.registers[0x1A1B] == self._PATTERN_MODE and self._is_set():
            self._action = data
            self._after(self.times.start, lambda: self._begin() if self._action == data and not self.running else None)
        else:
            return None
        return b""

    def _is_set(self) -> bool:
        """Whether there is a sequence to begin."""
        return self._validated

    def _begin(self) -> None:
        self._play(self._run)

    def _stopped(self) -> None:
        self._stop()
        self._action, self._stopping = b"\0", False

    def _entries(self) -> list[int]:
        count = self.registers[0x1A31][0] + 1
        table = self._mailboxes[2]
        return [int.from_bytes(table[3 * i : 3 * i + 3], "little") for i in range(count)]

    def _images(self) -> list[int]:
        images = list(self._mailboxes[1][: self.registers[0x1A31][3] + 1])
        # Two are taken the other way round.
        return images[::-1] if len(images) == 2 else images

    def _validation(self) -> int:
        exposure_us, period_us = struct.unpack("<II", self.registers[0x1A29])
        entries, images = self._entries(), self._images()
        found = 0
        if not 235 <= exposure_us <= period_us <= 200_000_000:
            found |= 1
        swaps = sum(entry >> 18 & 1 for entry in entries)
        known = all(entry >> 2 & 0x3F < 24 and entry >> 8 & 0xF == 1 and entry & 3 in (0, 3) for entry in entries)
        flashed = all(image in self._planes for image in images)
        if not (known and flashed and swaps == len(images) and entries[0] >> 18 & 1):
            found |= 2
        if exposure_us != period_us and not all(entry >> 17 & 1 for entry in entries):
            found |= 8
        if 0 < period_us - exposure_us < 230:
            found |= 16
        return found

    def _run(self, halt: threading.Event) -> bool:
        entries, images = self._entries(), self._images()
        exposure_us, period_us = struct.unpack("<II", self.registers[0x1A29])
        swaps = -1
        # Two pictures are loaded beforehand, of more than two only the first one.
        loaded_ns = self._clock.now_ns() + round(self._load_s * 1e9 * min(len(images), 2))
        kept = self._keeps and self._buffered == images
        self._buffered = images
        if self._halted(halt, 0.0 if kept else self._load_s):
            return False
        for entry in entries:
            if entry >> 18 & 1:
                swaps += 1
                if len(images) > 2 and swaps > 0:
                    if self._clock.now_ns() < loaded_ns:
                        self._hardware |= 8
                        swaps -= 1
                    loaded_ns = self._clock.now_ns() + round(self._load_s * 1e9)
            if not self._step(halt, self._planes[images[swaps]], entry, exposure_us / 1e6):
                return False
            if entry >> 17 & 1 and not self._change(halt, None):
                return False
            if self._halted(halt, (period_us - exposure_us) / 1e6):
                return False
        return True

    def _step(self, halt: threading.Event, planes: tuple[Pixels, ...], entry: int, exposure_s: float) -> bool:
        plane = planes[entry >> 2 & 0x3F]
        shown = 255 - plane if entry >> 16 & 1 else plane
        if not self._change(halt, shown if entry >> 12 & 7 else None):
            return False
        self._pulse(self._clock.now_ns())
        return not self._halted(halt, exposure_s)

    def _halted(self, halt: threading.Event, seconds: float) -> bool:
        """Let time pass, from now on: a thread that comes late must not hurry, for an engine's periods are even."""
        self._clock.wait_until(self._clock.now_ns() + round(seconds * 1e9), halt)
        return halt.is_set()

    def _change(self, halt: threading.Event, mirrors: Pixels | None) -> bool:
        with self._lock:
            if halt.is_set():
                return False
            self._mirrors = mirrors
            self._relight()
        return True

    def _relight(self) -> None:
        """Light is what the mirrors send of the LEDs that are on."""
        awake = self.registers[0x0200] == b"\0"
        on = self.registers[0x1A07][0] & 0xF and any(value != 255 for value in self.registers[0x0B01])
        lit = self._mirrors if awake and on else None
        if lit is not None and self._led_inverted is not None:
            share = max(self.registers[0x0B01]) / 255
            lit = np.rint(lit * (1 - share if self._led_inverted else share)).astype(np.uint8)
        if self._is_fresh(lit):
            self._light(lit)


@lru_cache(maxsize=8)
def _planes(picture: bytes) -> tuple[Pixels, ...]:
    """The 24 planes of a BMP file: green's bits, red's, blue's, each from the least significant one."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None or pixels.shape != (1140, 912, 3):
        message = "a picture of the flash is none of 912 x 1140 pixels"
        raise ValueError(message)
    blue, green, red = (np.asarray(channel) for channel in cv2.split(pixels))
    return tuple(
        profile_of(channel >> np.uint8(bit) & np.uint8(1)) for channel in (green, red, blue) for bit in range(8)
    )


def profile_of(plane: NDArray[Any]) -> Pixels:
    """A plane as the one row or column that it repeats; whole where it does not."""
    return repeated((plane > 0).astype(np.uint8) * np.uint8(255))


def repeated(values: NDArray[Any]) -> NDArray[Any]:
    """A picture as the one pixel, row or column that it repeats; whole where it does not."""
    if (values == values[0, 0]).all():
        return values[:1, :1]
    if (values == values[:1]).all():
        return values[:1]
    return values[:, :1] if (values == values[:, :1]).all() else values


class Cable:
    """An engine on a pair of sockets that keep reports apart, as a hidraw node does. `host` is the driver's end."""

    def __init__(self, engine: FakeEngine) -> None:
        self.engine = engine
        near, self._far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.host = near.detach()
        self._serving = threading.Thread(target=self._serve, daemon=True)
        self._serving.start()

    def unplug(self) -> None:
        self.engine.unplug()
        with suppress(OSError):
            self._far.shutdown(socket.SHUT_RDWR)
        self._serving.join(5)

    def _serve(self) -> None:
        with self._far:
            while report := _received(self._far):
                answer = self.engine.take(_without_number(report))
                if answer is not None:
                    with suppress(OSError):
                        if self.engine.faults.stale_answer:
                            self._far.send(bytes([answer[0], (answer[1] - 1) % 256]) + answer[2:])
                        self._far.send(answer)


def _received(far: socket.socket) -> bytes:
    try:
        return far.recv(REPORT + 1)
    except OSError:
        return b""


def _without_number(report: bytes) -> bytes:
    """The host writes a zero, as the report's number, before each."""
    if len(report) != REPORT + 1 or report[0] != 0:
        message = f"expected a zero and {REPORT} bytes, found {len(report)} bytes beginning with {report[:1].hex()}"
        raise ValueError(message)
    return report[1:]


class UhidEngine:
    """An engine as a HID device of the kernel (`/dev/uhid`, include/uapi/linux/uhid.h): it has a real hidraw node."""

    _DESTROY, _OUTPUT, _CREATE, _INPUT = 1, 6, 11, 12
    _DESCRIPTOR = bytes.fromhex("0600ff 0901 a101 0901 1500 26ff00 7508 9540 8102 0902 9540 9102 c0".replace(" ", ""))

    def __init__(
        self,
        engine: FakeEngine,
        *,
        product: int = 0x6401,
        serial: str = "LC4500-1",
        port: str = "usb-0000:00:14.0-2/input0",
    ) -> None:
        self.engine = engine
        self._handle = os.open("/dev/uhid", os.O_RDWR | os.O_CLOEXEC)
        create = struct.pack(
            "<I128s64s64sHHIIII4096s",
            self._CREATE,
            b"Texas Instruments DLPC350",
            port.encode(),
            serial.encode(),
            len(self._DESCRIPTOR),
            3,
            0x0451,
            product,
            0x100,
            0,
            self._DESCRIPTOR,
        )
        os.write(self._handle, create)
        self._gone = threading.Event()
        self._serving = threading.Thread(target=self._serve, daemon=True)
        self._serving.start()

    def unplug(self) -> None:
        if not self._gone.is_set():
            self._gone.set()
            self.engine.unplug()
            os.write(self._handle, struct.pack("<I", self._DESTROY))
            os.close(self._handle)

    def _serve(self) -> None:
        with suppress(OSError):
            while not self._gone.is_set():
                event = os.read(self._handle, 4380)
                if struct.unpack_from("<I", event)[0] != self._OUTPUT:
                    continue
                size = struct.unpack_from("<H", event, 4 + 4096)[0]
                answer = self.engine.take(_without_number(event[4 : 4 + size]))
                if answer is not None:
                    os.write(self._handle, struct.pack("<IH", self._INPUT, len(answer)) + answer.ljust(4096, b"\0"))

"""A DLPC3478 at an address of a bus: what it does with commands, as TI's guides and sources say, and strictly."""

from __future__ import annotations

import errno
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slrig.devices import Clock
from slrig.model import Pixels
from tests.contract.dlpc350_device import Sequencer

_LENGTHS = {0x05: 1, 0x50: 1, 0x52: 1, 0x54: 6, 0x90: 1, 0x92: 5, 0x98: 25, 0x9E: 2, 0xDE: 4, 0xDF: 2, 0xE0: 4}
_READS = bytes.fromhex("06 51 53 55 5d 91 93 99 9d 9f d0 d1 d2 d3 d4 dd e3 e4")
_ASKED = {0x93: 1, 0x99: 1, 0x9D: 6, 0xD3: 1, 0xDD: 4}
_RANGES_US = {0: (200, 7600), 1: (600, 7600)}
"""Light of 1 bit in one colour, and in three (sequence database 0.5.71)."""
_BEFORE_US, _AFTER_US = 171, 31


@dataclass(frozen=True)
class _Entry:
    set: int
    count: int
    leds: int
    light_us: int
    before_us: int
    after_us: int
    first: int


class Fake347x(Sequencer):
    """Implements `drivers.dlpc347x.bus.I2cPort`.

    light, pulse : told of every change of light (None: dark), and of every edge of TRIG_OUT_2, and when (ns).
    controller : its number. entry_bytes : of an entry, without its control: 23 in firmware of 2019. most_entries : of
    the order. counts_first : a sequence is played as often as it is to be repeated, and not once more. room : in the
    flash, bytes. clock : as `FakeEngine` has it.
    """

    def __init__(
        self,
        *,
        light: Callable[[Pixels | None, int], object] = lambda _, __: None,
        pulse: Callable[[int], None] = lambda _: None,
        controller: int = 0x0B,
        entry_bytes: int = 24,
        most_entries: int = 64,
        counts_first: bool = False,
        room: int = 65536,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(clock)
        self.gone = False
        self.registers = {0x05: b"\0", 0x50: b"\1", 0x52: b"\7", 0x54: struct.pack("<3H", 900, 900, 900), 0x90: b"\1"}
        self.triggers = {0: struct.pack("<Bi", 1, 0), 1: struct.pack("<Bi", 0, 0)}
        self.order: list[bytes] = []
        self.flash = bytearray(b"\xff" * room)
        self.written_bytes = self.erased = 0
        self._light, self._pulse = light, pulse
        self._controller, self._entry_bytes, self._most_entries = controller, entry_bytes, most_entries
        self._counts_first = counts_first
        self._communication = self._sequence = self._system = 0
        self._short = 0x81 & ~1
        self._length = self._at = 0
        self._kind = b""
        self._answer = b""
        self._leds = 7
        self._relight()

    def close(self) -> None:
        """See `I2cPort`. The engine goes on."""

    def unplug(self) -> None:
        """Without power, there is no light, and no answer."""
        self.gone = True
        super().unplug()

    def write(self, data: bytes) -> None:
        if self.gone:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")
        with self._lock:
            command, parameters = data[0], data[1:]
            self._short |= 1
            if command in _READS:
                if len(parameters) != _ASKED.get(command, 0):
                    self._refuse(4)
                self._answer = self._told(command, parameters)
                return
            self.commands.append((command, parameters))
            lengths = {0x98: self._entry_bytes + 1, 0xE1: self._length, 0xE2: self._length}
            if command not in _LENGTHS | lengths:
                self._refuse(0)
            elif len(parameters) != (_LENGTHS | lengths)[command]:
                self._refuse(5)
            else:
                self._set(command, parameters)

    def read(self, length: int) -> bytes:
        """See `I2cPort`. Beyond what it has to say, the bus reads ones."""
        if self.gone:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")
        return self._answer[:length].ljust(length, b"\xff")

    def _refuse(self, bit: int) -> None:
        self._communication |= 1 << bit

    def _told(self, command: int, asked: bytes) -> bytes:
        if command in self.bent:
            return self.bent[command]
        match command:
            case 0xD0:
                told = (
                    self._short | bool(self._communication) << 1 | bool(self._system) << 3 | bool(self._sequence) << 6
                )
                return bytes([told])
            case 0xD1:
                system, self._system = self._system | self._sequence << 19, 0
                self._sequence = 0
                return struct.pack("<I", system)
            case 0xD2:
                return struct.pack("<HBB", 1, 0, 8)
            case 0xD3:
                told, self._communication = self._communication, 0
                return bytes([told, 0])
            case 0xD4:
                return bytes([self._controller])
            case 0x5D:
                return struct.pack("<3H", 1000, 800, 600)
            case 0x93:
                flags, late = struct.unpack("<Bi", self.triggers[asked[0]])
                return struct.pack("<Bi", flags >> 1, late)
            case 0x99:
                return self.order[asked[0]] if asked[0] < len(self.order) else b""
            case 0x9D:
                mode, depth, light_us = struct.unpack("<BBI", asked)
                least, most = _RANGES_US[depth]
                return struct.pack("<BIII", mode == 1 and least <= light_us <= most, least, _BEFORE_US, _AFTER_US)
            case 0x9F:
                ready = self.registers[0x05] == b"\4" and self.flash[:4] == b"PATN"
                return bytes([ready, len(self.order), 0, 0, 0, 0, 0])
            case 0xDD:
                return bytes([struct.unpack("<I", asked)[0] > len(self.flash)])
            case 0xE3 | 0xE4:
                self._at = 0 if command == 0xE3 else self._at
                part = bytes(self.flash[self._at : self._at + self._length]) if self._kind == b"\xd0\0\0\0" else b""
                self._at += self._length
                return part if self._length <= 256 else b""
        return self.registers.get(command - 1, b"")

    def _set(self, command: int, data: bytes) -> None:
        match command:
            case 0x98:
                self._ordered(data)
            case 0x9E:
                self._controlled(data)
            case 0x92:
                self.triggers[data[0] & 1] = data
            case 0x05:
                self._stop()
                self.registers[command] = data
            case 0xDE:
                self._kind = data
            case 0xDF:
                (self._length,) = struct.unpack("<H", data)
                if self._length > 1024:
                    self._refuse(1)
            case 0xE0:
                if self.running or data != b"\xaa\xbb\xcc\xdd" or self._kind != b"\xd0\0\0\0":
                    self._refuse(2)
                    return
                self.flash[:] = b"\xff" * len(self.flash)
                self.erased += 1
            case 0xE1 | 0xE2:
                self._at = 0 if command == 0xE1 else self._at
                old = self.flash[self._at : self._at + len(data)]
                # Bits of flash are only ever cleared by a write.
                new = bytes(a & b for a, b in zip(old, data, strict=True))
                self.flash[self._at : self._at + len(data)] = new
                self._at += len(data)
                self.written_bytes += len(data)
            case _:
                if command == 0x54 and any(
                    each > most for each, most in zip(struct.unpack("<3H", data), (1000, 800, 600), strict=True)
                ):
                    self._refuse(1)
                    return
                self.registers[command] = data
                self._relight()

    def _ordered(self, data: bytes) -> None:
        if self.registers[0x05] != b"\4" or self.running:
            self._refuse(2)
            return
        self.order = [] if data[0] == 1 else self.order
        entry = _unpacked(data[1:])
        if len(self.order) == self._most_entries:
            self._sequence = 6
        elif entry.leds not in {0, 1, 2, 4, 7} or entry.count == 0:
            self._refuse(1)
        elif not _RANGES_US[entry.leds == 7][0] <= entry.light_us <= 7600:
            self._sequence = 1
        elif entry.before_us < _BEFORE_US or entry.after_us < _AFTER_US:
            self._sequence = 2 if entry.before_us < _BEFORE_US else 3
        else:
            self.order.append(data[1:])

    def _controlled(self, data: bytes) -> None:
        if data[0] == 1:
            self._stop()
        elif data[0] == 0 and self.registers[0x05] == b"\4" and self.order and not self.running:
            times = data[1] + (0 if self._counts_first else 1)
            steps = [(entry, self._lines(entry)) for entry in map(_unpacked, self.order)]
            self._play(self._run, steps, 2**31 if data[1] == 255 else times)
        else:
            self._refuse(2)

    def _lines(self, entry: _Entry) -> list[Pixels]:
        """The patterns of an entry, out of the flash."""
        sets = struct.unpack_from("<4xI", self.flash)[0]
        (start,) = struct.unpack_from("<I", self.flash, sets + 4 + 4 * entry.set)
        count, columns, depth, size = struct.unpack_from("<BBBxI", self.flash, start)
        assert depth == 1
        assert entry.first + entry.count <= count
        lines = []
        for index in range(entry.first, entry.first + entry.count):
            at = start + 8 + index * (size // count)
            bits = np.unpackbits(np.frombuffer(bytes(self.flash[at : at + size // count]), np.uint8), bitorder="little")
            lit = bits[:1280] if columns else bits[48:768]
            values = lit * np.uint8(255)
            lines.append(
                values[:1].reshape(1, 1)
                if (lit == lit[0]).all()
                else values[np.newaxis]
                if columns
                else values[:, np.newaxis]
            )
        return lines

    def _run(self, halt: threading.Event, steps: list[tuple[_Entry, list[Pixels]]], times: int) -> bool:
        # By a clock of its own: a thread that comes late tells of what was, for an engine's times are even.
        at_ns = self._clock.now_ns()
        for _ in range(times):
            for entry, lines in steps:
                for line in lines:
                    at_ns += entry.before_us * 1000
                    if not self._change(halt, at_ns, line, entry.leds):
                        return False
                    if self.triggers[1][0] & 2:
                        self._pulse(at_ns)
                    at_ns += entry.light_us * 1000
                    if not self._change(halt, at_ns, line, 0):
                        return False
                    at_ns += entry.after_us * 1000
        self._clock.wait_until(at_ns, halt)
        return True

    def _change(self, halt: threading.Event, at_ns: int, mirrors: Pixels, leds: int) -> bool:
        self._clock.wait_until(at_ns, halt)
        with self._lock:
            if halt.is_set():
                return False
            self._mirrors, self._leds = mirrors, leds
            self._relight(at_ns)
        return True

    def _relight(self, at_ns: int | None = None) -> None:
        lit = self._mirrors if self._leds & self.registers[0x52][0] else None
        if self._is_fresh(lit):
            self._light(lit, self._clock.now_ns() if at_ns is None else at_ns)


def _unpacked(data: bytes) -> _Entry:
    """An entry: set, patterns, LEDs, inverted (8), light, dark before, dark after (4 each), and the first pattern."""
    number, count, leds, inverted, light_us, before_us, after_us = struct.unpack_from("<BBBQIII", data)
    assert inverted == 0
    return _Entry(number, count, leds, light_us, before_us, after_us, data[23] if len(data) > 23 else 0)

"""Commands of the DLPC347x: each method is one command with its answer.

Numbers, lengths and bits: the programmer's guides (DLPC3479: DLPU081B; DLPC3470 and DLPC3478: DLPU075B), and TI's own
sources of 2019 (dlpc347x.c, in github.com/isabella232/LightField under dlp-4710/dlpc347x). If they contradict each
other, the guide is followed, since it is newer: an entry of the order has 25 bytes there and 24 in TI's source (the
number of the first pattern was added), and the kind of flash data has 4 bytes instead of 1.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from enum import IntEnum
from typing import Annotated, Literal

from pydantic import Field

from drivers.dlpc347x.bus import ADDRESS, I2cBus
from drivers.dlpc347x.flash import HEAD_BYTES, FlashedLine, block_size
from drivers.pattern_engine.options import LedColour, LightOptions
from drivers.pattern_engine.patience import PATIENCE_S, ask_until
from slrig.devices import Clock, SystemClock
from slrig.errors import DeviceError, UnsupportedByDeviceError


class Dlpc347xEngineOptions(LightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc347x"`."""

    device: Annotated[str, Field(pattern="^/")]
    """Bus of the engine, as /dev/i2c-1. It is required, because a bus cannot be searched safely."""

    led: Literal["white", "red", "green", "blue"] = "white"
    """LEDs that light the patterns: white is one after the other within a pattern, and takes at least 0.6 ms."""

    address: Annotated[int, Field(ge=0x08, le=0x77)] = ADDRESS
    """The engine's 7-bit address on the bus. TI's guides include the direction bit: 36h is 27 here."""

    mirror_columns: bool = False
    """Mirror the columns of patterns in the flash, if column 0 is lit on the wrong side."""

    mirror_rows: bool = False
    """The same for rows."""

    start_s: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Longest time from the command to start until a shown pattern is lit. Not documented; `slrig latency`
    measures it."""

    trigger_delay_us: Annotated[int, Field(ge=0, le=7600)] = 0
    """Delay of TRIG_OUT_2 after the light."""


INITIALISED, COMMUNICATION, SYSTEM, ERASING, FLASH, SEQUENCE, MAIN = (1 << bit for bit in (0, 1, 3, 4, 5, 6, 7))
"""Bits of the short status."""
REFUSALS = (
    "unknown command",
    "invalid parameter",
    "processing error",
    "a batch file failed",
    "no answer possible",
    "the command has more or fewer parameters in its firmware: update it to TI's latest",
    "bus time-out",
)
"""By bit of the communication status."""
FAULTS = {
    0: "its mirrors failed",
    1: "the interface of its mirrors failed",
    2: "the training of its mirrors failed",
    11: "the red LED failed",
    12: "the green LED failed",
    13: "the blue LED failed",
    16: "the sequence was aborted",
    17: "the sequence failed",
    18: "its supply is low",
    29: "its watchdog ran out",
}
"""By bit of the system status' four bytes."""
SEQUENCE_FAULTS = {
    1: "the light is not supported",
    2: "the dark before the light is too short or too long",
    3: "the dark after the light is too short or too long",
    4: "the delay of TRIG_OUT_1 is not supported",
    5: "the delay of TRIG_OUT_2 is not supported",
    6: "the order has too few entries",
}
"""By number in bits 19 to 23 of the system status."""
ERASE_TIMEOUT_S = 20.0
MAX_READ_BYTES, MAX_WRITE_BYTES = 256, 256
"""Bytes of flash in one transfer: up to 256 can be read and 1024 written; adapters on USB take fewer."""
PATTERN_DATA = bytes([0xD0, 0, 0, 0])
"""The kind of flash data ("entire sensing pattern data", dlpc347x.h)."""
_ENTRY = struct.Struct("<BBBQIIIB")
_INTERNAL_MODE, _INTERNAL = 4, 1


class Dlpc347xCommand(IntEnum):
    """Write commands. The next number reads the value back."""

    MODE = 0x05  # 4: patterns from flash
    LED_CONTROL = 0x50  # 0: by the currents that are set
    LED_ENABLE = 0x52  # bits 0-2 red, green, blue
    LED_CURRENT = 0x54  # red, green, blue: 2 bytes each; more is more current ("directly controls the LED current")
    TRIGGER_IN = 0x90  # bit 0: patterns wait for it
    TRIGGER_OUT = 0x92  # bit 0: 2, not 1; bit 1 on; bit 2 inverted; delay (4, µs)
    ORDER = 0x98
    CONTROL = 0x9E  # 0 start, 1 stop; how often it is repeated
    FLASH_KIND = 0xDE
    FLASH_LENGTH = 0xDF
    FLASH_ERASE = 0xE0
    FLASH_WRITE = 0xE1  # and E2h for what follows


class Dlpc347xRead(IntEnum):
    """Read-only commands."""

    LED_MOST = 0x5D
    LIGHT = 0x9D  # mode, depth, light (4, µs): bit 0 supported; least light, dark before, dark after (4 each, µs)
    STATE = 0x9F  # ready, entries of the order, and five more
    SHORT = 0xD0
    SYSTEM = 0xD1
    VERSION = 0xD2  # patch (2), minor, major
    COMMUNICATION = 0xD3  # 2: of this bus
    CONTROLLER = 0xD4
    FLASH_CHECK = 0xDD  # bytes (4): 0 is well
    FLASH = 0xE3  # and E4h for what follows


@dataclass(frozen=True, slots=True)
class LightLimits:
    """Limits of a light as reported by the engine, µs."""

    supported: bool
    least_us: int
    before_us: int
    after_us: int


@dataclass(frozen=True, slots=True)
class OrderEntry:
    """Entry of the order: patterns of a set from one on, lit alike, none of them inverted. Times in µs."""

    place: FlashedLine
    count: int
    leds: int
    light_us: int
    before_us: int
    after_us: int

    @property
    def encoded(self) -> bytes:
        """Encoded entry, as it is read back; it is sent with one byte before it."""
        return _ENTRY.pack(self.place.set, self.count, self.leds, 0, *astuple(self)[3:], self.place.index)

    @property
    def duration_us(self) -> int:
        """Duration of all its patterns."""
        return self.count * (self.before_us + self.light_us + self.after_us)


class Dlpc347xEngine:
    """The controller behind a bus. Every method raises the bus's DeviceError and DeviceGoneError.

    clock : the rig's; default: the system's.
    """

    def __init__(self, bus: I2cBus, clock: Clock | None) -> None:
        self._bus = bus
        self._clock = clock or SystemClock()
        self._repeats = 0

    @property
    def name(self) -> str:
        """Name of the engine, for messages."""
        return self._bus.name

    def close(self) -> None:
        """Close the bus. Idempotent."""
        self._bus.close()

    def send(self, command: int, data: bytes = b"") -> None:
        """Send a command, and check that it was accepted. Raises UnsupportedByDeviceError, with the engine's reason, if
        not; DeviceError if the engine failed.
        """
        self._bus.write(command, data)
        short = self._short_status()
        if short & COMMUNICATION:
            status = self._bus.read(Dlpc347xRead.COMMUNICATION, 2, b"\2")[0]
            causes = "; ".join(text for bit, text in enumerate(REFUSALS) if status >> bit & 1) or f"{status:#04x}"
            message = f"{self.name} refuses the command {command:02x}h {data.hex(' ')}: {causes}"
            raise UnsupportedByDeviceError(message)
        if short & (SYSTEM | SEQUENCE | FLASH):
            raise self._system_fault(short)

    def settle(
        self, command: Dlpc347xCommand, data: bytes, query: bytes = b"", *, expected: bytes | None = None
    ) -> None:
        """Set a value and read it back until it agrees. query : parameters of the read; expected : its answer, if it
        differs from `data`. Raises UnsupportedByDeviceError if it never agrees.
        """
        wanted = data if expected is None else expected
        self.send(command, data)
        self._require(command.name.lower().replace("_", " "), command, wanted, query)

    def _require(self, name: str, command: Dlpc347xCommand, wanted: bytes, query: bytes) -> None:
        got = ask_until(self._clock, lambda: self._bus.read(command + 1, len(wanted), query), wanted.__eq__)
        if got != wanted:
            message = (
                f"{self.name}: requested {name} {wanted.hex(' ')}, the engine gives {got.hex(' ')} after "
                f"{PATIENCE_S:g} s; switch it off and on, and update its firmware to TI's latest"
            )
            raise UnsupportedByDeviceError(message)

    def wait_until_initialised(self, timeout_s: float) -> None:
        """Wait until the main program takes commands, and clear earlier errors."""
        self._wait(INITIALISED | MAIN, INITIALISED | MAIN, timeout_s, "finish its initialisation")
        # Reading the errors clears them (DLPU075B, "Read System Status").
        self._bus.read(Dlpc347xRead.COMMUNICATION, 2, b"\2")
        self._bus.read(Dlpc347xRead.SYSTEM, 4)

    def controller(self) -> int:
        """Return the number of the controller type."""
        return self._bus.read(Dlpc347xRead.CONTROLLER, 1)[0]

    def version(self) -> str:
        """Return the version of its firmware."""
        patch, minor, major = struct.unpack("<HBB", self._bus.read(Dlpc347xRead.VERSION, 4))
        return f"{major}.{minor}.{patch}"

    def take_patterns_from_flash(self) -> None:
        """Select patterns from flash, without external trigger."""
        self.settle(Dlpc347xCommand.MODE, bytes([_INTERNAL_MODE]))
        self.settle(Dlpc347xCommand.TRIGGER_IN, b"\0")

    def set_current(self, share: float) -> None:
        """Set the current of every LED, as a fraction of its maximum in the engine's flash."""
        most = struct.unpack("<3H", self._bus.read(Dlpc347xRead.LED_MOST, 6))
        self.settle(Dlpc347xCommand.LED_CONTROL, b"\0")
        self.settle(Dlpc347xCommand.LED_CURRENT, struct.pack("<3H", *(round(share * each) for each in most)))

    def set_trigger_out(self, *, active_low: bool, delay_us: int) -> None:
        """Set TRIG_OUT_2, which is on while a pattern is lit; TRIG_OUT_1, of whole sets, is off."""
        for number, on, late in ((0, False, 0), (1, True, delay_us)):
            inverted = on and active_low
            sent, got = (
                struct.pack("<Bi", flags, late) for flags in (number | on << 1 | inverted << 2, on | inverted << 1)
            )
            self.settle(Dlpc347xCommand.TRIGGER_OUT, sent, bytes([number]), expected=got)

    def light_limits(self, leds: LedColour, light_us: int) -> LightLimits:
        """Query if a 1-bit pattern can be lit for this time, and the dark time that it needs."""
        depth = int(leds is LedColour.WHITE)
        answer = self._bus.read(Dlpc347xRead.LIGHT, 13, struct.pack("<BBI", _INTERNAL, depth, light_us))
        return LightLimits(bool(answer[0] & 1), *struct.unpack_from("<3I", answer, 1))

    def order(self, entries: Sequence[OrderEntry], repeats: int) -> None:
        """Set the order that `start` shows, and its number of repeats. It is not documented if repeats include the
        first time.
        """
        for number, entry in enumerate(entries):
            self.send(Dlpc347xCommand.ORDER, bytes([number == 0]) + entry.encoded)
        for number, entry in enumerate(entries):
            self._require(f"entry {number} of the order", Dlpc347xCommand.ORDER, entry.encoded, bytes([number]))
        self._repeats = repeats
        ready = bytes([1, len(entries)])
        state = ask_until(
            self._clock, lambda: self._bus.read(Dlpc347xRead.STATE, 7), lambda state: state.startswith(ready)
        )
        if not state.startswith(ready):
            message = f"{self.name} is not ready for {len(entries)} entries, its state is {state.hex(' ')}"
            raise DeviceError(message + "; switch it off and on, and write its flash: slrig patterns RIG")

    def switch_leds(self, *, by_sequence: bool) -> None:
        """Have the sequence switch the LEDs, or switch them all off; verify by reading back."""
        self.settle(Dlpc347xCommand.LED_ENABLE, bytes([7 if by_sequence else 0]))

    def restart(self) -> None:
        """Stop the order, and start it from its beginning."""
        self.stop()
        self.start()

    def start(self) -> None:
        """Start the order."""
        self.send(Dlpc347xCommand.CONTROL, bytes([0, self._repeats]))

    def stop(self) -> None:
        """Stop the order."""
        self.send(Dlpc347xCommand.CONTROL, b"\1\0")

    def flash(self) -> bytes:
        """Return the block of patterns in its flash; empty if there is none."""
        self.send(Dlpc347xCommand.FLASH_KIND, PATTERN_DATA)
        size = block_size(head) if len(head := self._read_flash(HEAD_BYTES)) == HEAD_BYTES else 0
        if not HEAD_BYTES < size < 1 << 20:
            return b""
        self.send(Dlpc347xCommand.FLASH_KIND, PATTERN_DATA)
        return self._read_flash(size)

    def write_flash(self, block: bytes) -> None:
        """Replace the patterns in its flash, and verify them (DLPU075B §3, "update internal pattern data": kind, check,
        erase, length, start, continue).
        """
        self.send(Dlpc347xCommand.FLASH_KIND, PATTERN_DATA)
        if status := self._bus.read(Dlpc347xRead.FLASH_CHECK, 1, struct.pack("<I", len(block)))[0]:
            message = f"{self.name}: its flash has no room for {len(block)} bytes of patterns ({status:#04x}); "
            raise UnsupportedByDeviceError(message + "scan one axis only, or with a shorter line_shift_period_px")
        self.send(Dlpc347xCommand.FLASH_ERASE, bytes.fromhex("AABBCCDD"))
        self._wait(ERASING, 0, ERASE_TIMEOUT_S, "erase its flash")
        length = 0
        for start in range(0, len(block), MAX_WRITE_BYTES):
            part = block[start : start + MAX_WRITE_BYTES]
            length = self._set_length(len(part), length)
            self.send(Dlpc347xCommand.FLASH_WRITE + (start > 0), part)
        if self.flash() != block:
            message = f"{self.name}: its flash differs from the written data; write it again: slrig patterns RIG"
            raise DeviceError(message)

    def _read_flash(self, size: int) -> bytes:
        data, length = b"", 0
        while len(data) < size:
            length = self._set_length(min(size - len(data), MAX_READ_BYTES), length)
            data += self._bus.read(Dlpc347xRead.FLASH + (len(data) > 0), length)
        return data

    def _set_length(self, length: int, before: int) -> int:
        if length != before:
            self.send(Dlpc347xCommand.FLASH_LENGTH, struct.pack("<H", length))
        return length

    def _short_status(self) -> int:
        return self._bus.read(Dlpc347xRead.SHORT, 1)[0]

    def _wait(self, mask: int, wanted: int, timeout_s: float, action: str) -> None:
        short = ask_until(self._clock, self._short_status, lambda short: short & mask == wanted, timeout_s)
        if short & mask != wanted:
            message = f"{self.name} did not {action} in {timeout_s:g} s (status {short:#04x}); switch it off and on"
            raise DeviceError(message)

    def _system_fault(self, short: int) -> DeviceError:
        system = int.from_bytes(self._bus.read(Dlpc347xRead.SYSTEM, 4), "little")
        if sequence := system >> 19 & 0x1F:
            reason = SEQUENCE_FAULTS.get(sequence, f"sequence error {sequence}")
            return UnsupportedByDeviceError(f"{self.name} refuses the sequence: {reason}")
        faults = "; ".join(text for bit, text in FAULTS.items() if system >> bit & 1)
        faults = faults or ("its flash failed" if short & FLASH else f"status {short:#04x}, {system:#010x}")
        return DeviceError(f"{self.name} reports: {faults}; switch it off and on")

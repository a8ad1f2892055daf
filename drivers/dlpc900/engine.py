"""Commands of the DLPC900 in addition to `drivers.pattern_engine.usb`: its pattern table, timing, and pictures over
USB.

Each command is in the guide (DLPU018 revisions F and J, with the number of its table) and in TI's own program (API.c,
`CmdList`, in github.com/RhojAnn/DLPC900_CLI under lib). The driver does not depend on their contradictions: bit 0 of
byte 9 of a definition means "no TRIG_OUT_2" in the guide and "TRIG_OUT_2" in API.c; TRIG_OUT_2 is not used. Revision F
calls the second number of the configuration repetitions; revision J calls it the number of patterns to show, and TI's
program uses it so (`on_updateLUT_Button_clicked`: as many as there are entries is once).

TI's program requests no acknowledgement of picture data and of the order (API.c, `LCR_SendMsg`), and neither does this
driver. It reads the error code after each, because the code is that of the last command only (as pycrafter6500.py,
`checkforerrors`).

Bit 0 of byte 5 of a definition clears the mirrors after the exposure. Revision J restricts it to external triggers;
TI's program requires it for every pattern of one bit (API.c, `LCR_AddToPatLut`). It is set, as in the guide's example
of patterns on the fly and in pycrafter6500.py: otherwise a pattern could stay through its dark time.

Timing rules are checked before they are sent; each error names its rule (DLPU018 revision F). Shortest exposures of a
1-bit pattern with all blocks of mirrors: table 2-103. Field widths: table 2-137. Delays of the trigger output: table
2-112. The guide states no shortest dark time; dark is shown as a pattern, so a pattern's shortest exposure is assumed.
Without dark time, TRIG_OUT_1 does not change between patterns (section 2.4.4.1), and the cameras are not triggered.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.pattern_engine.options import UsbLightOptions
from drivers.pattern_engine.patience import ask_until
from drivers.pattern_engine.projector import Plane, Timing, check_duty, light_duration_us, pattern_plane, plane_keys
from drivers.pattern_engine.usb import CommandRefusedError, MainStatus, UsbCommand, UsbEngine, UsbLink
from slrig.devices import Clock
from slrig.errors import DeviceError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size

PLANES = 24
MAX_ENTRIES = 400
"""Entries of the pattern table (DLPU018 revision J, table 2-139)."""
MAX_PICTURES = 18
"""Picture indices are 0 to 17 (DLPU018 table 2-139)."""
_HEADER = struct.Struct("<4sHHI8sIBBB21x")
_ENHANCED = 2


@dataclass(frozen=True, slots=True)
class MemoryPlane:
    """Location of a pattern in the engine's memory."""

    picture: int
    plane: int


@dataclass(frozen=True, slots=True)
class PatternMemory:
    """Pictures for the engine. places : location of each pattern, and at the end of a dark one; pictures : (H, W)
    uint32, bit n of a pixel is plane n.
    """

    places: tuple[MemoryPlane, ...]
    pictures: tuple[NDArray[np.uint32], ...]


def pack_sequence(sequence: PatternSequence) -> PatternMemory:
    """Return the pictures that hold a sequence, each pattern once, and a dark one. Raises UnsupportedByDeviceError if a
    pattern has shades of grey, or there are too many.
    """
    dark = np.zeros(sequence.projector.shape, np.bool_)
    planes = [*(pattern_plane(sequence, index) for index in range(len(sequence))), dark]
    found: dict[bytes, MemoryPlane] = {}
    groups: list[tuple[bool, list[Plane]]] = []
    places = []
    for plane in planes:
        key, _ = plane_keys(plane)
        if key not in found:
            by_rows = bool((plane[:, :1] == plane).all()) and not (plane == plane[0, 0]).all()
            at = next((at for at, (rows, group) in enumerate(groups) if rows == by_rows and len(group) < PLANES), None)
            if at is None:
                at = len(groups)
                groups.append((by_rows, []))
            found[key] = MemoryPlane(at, len(groups[at][1]))
            groups[at][1].append(plane)
        places.append(found[key])
    if len(places) > MAX_ENTRIES or len(groups) > MAX_PICTURES:
        message = (
            f"the sequence has {len(sequence)} patterns in {len(groups)} pictures, the engine takes "
            f"{MAX_ENTRIES - 1} in {MAX_PICTURES}; scan one axis only, or with a shorter line_shift_period_px"
        )
        raise UnsupportedByDeviceError(message)
    return PatternMemory(tuple(places), tuple(_merge_planes(group, sequence.projector) for _, group in groups))


def _merge_planes(planes: Sequence[Plane], size: Size) -> NDArray[np.uint32]:
    pixels = np.zeros(size.shape, np.uint32)
    for number, plane in enumerate(planes):
        pixels |= plane.astype(np.uint32) << np.uint32(number)
    return pixels


def encode_picture(picture: NDArray[np.uint32]) -> bytes:
    """Encode a picture, or one half of it, with its header, for sending."""
    rows, columns = picture.shape
    lines = []
    before: NDArray[np.uint32] | None = None
    for line in picture:
        same = before is not None and np.array_equal(line, before)
        lines.append(b"\0\1" + _encode_count(columns) if same else _encode_line(line))
        before = line
    data = b"".join(lines) + b"\0\1\0"
    data += bytes(-len(data) % 4)
    return _HEADER.pack(b"Spld", columns, rows, len(data), b"\xff" * 8, 0, 0, _ENHANCED, 1) + data


def _encode_line(line: NDArray[np.uint32]) -> bytes:
    """Encode runs of two pixels and more, and single pixels between them uncompressed."""
    starts = np.flatnonzero(np.diff(line, prepend=~line[:1]))
    lengths = np.diff(starts, append=line.size)
    out = bytearray()
    single: list[int] = []
    for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        if length == 1:
            single.append(start)
            continue
        out += _encode_raw(line[single]) + _encode_count(length) + _encode_pixel(line[start])
        single = []
    return bytes(out + _encode_raw(line[single]))


def _encode_raw(pixels: NDArray[np.uint32]) -> bytes:
    if pixels.size == 0:
        return b""
    # A single pixel is a run of one: "0 1" has another meaning.
    head = b"\1" if pixels.size == 1 else b"\0" + _encode_count(pixels.size)
    return head + b"".join(_encode_pixel(pixel) for pixel in pixels)


def _encode_pixel(pixel: np.uint32) -> bytes:
    return int(pixel).to_bytes(3, "big")


def _encode_count(count: int) -> bytes:
    return bytes([count]) if count < 128 else bytes([0x80 | count & 0x7F, count >> 7])


MAX_US = 2**24 - 1
"""Limit of exposure and dark time, 24 bits each."""
TRIGGER_DELAY_RANGE_US = (-20, 20_000)


_CLEARED = 1
ON_THE_FLY = 3
"""Display mode: pictures are sent over USB (DLPU018 table 2-97)."""
MAX_MESSAGE_BYTES = 504
"""Picture bytes in one message (DLPU018 table 5-3)."""
SECOND_READY, INCOMPATIBLE = 16, 2
"""Bits of the hardware status (DLPU018 table 2-2)."""
ERRORS = {
    2: "a device failed",
    3: "the command is unknown",
    4: "controller and mirrors do not fit",
    5: "not in this mode",
    6: "a parameter is invalid",
    7: "a parameter refers to something that does not exist",
    8: "its memory is full",
    9: "the picture's encoding is unknown",
    10: "the bit position is invalid",
    11: "the picture does not exist",
    12: "the dark time is not supported",
    13: "the delay is not supported",
    14: "the exposure is not supported",
    15: "the pattern's number is invalid",
    16: "the definition of the pattern is invalid",
    17: "the picture's position in its memory is invalid",
    255: "internal error",
}
"""DLPU018 table 2-12."""


def play_timing(exposure_s: float, period_s: float, *, margin_s: float, duty_limit: float, least_us: int) -> Timing:
    """Return the timing for an exposure of `exposure_s` per period; see `light_duration_us` and `check_duty`. Raises
    UnsupportedByDeviceError if the engine does not support it, or the duty limit forbids it.
    """
    wanted_us = light_duration_us(exposure_s, period_s, margin_s=margin_s, least_us=least_us, dark_us=least_us)
    timing = Timing(wanted_us, round(period_s * 1e6))
    dark_us = timing.period_us - timing.exposure_us
    if max(timing.exposure_us, dark_us) > MAX_US:
        message = (
            f"requested {timing.exposure_us} µs of light and {dark_us} µs of dark after it: the longest is {MAX_US} "
            "µs each; shorten exposure_s, or the period"
        )
        raise UnsupportedByDeviceError(message)
    check_duty(timing, duty_limit)
    return timing


class Dlpc900Command(IntEnum):
    """USB commands."""

    ERROR_CODE = 0x0100  # 2-11: of the last command
    VERSION = 0x0205  # 2-7: four bytes are the application's: patch (2), minor, major
    HARDWARE = 0x0206  # 2-9: which mirrors
    CONFIGURATION = 0x1A31  # 2-132: entries (2), patterns to show (4)
    ORDER = 0x1A32  # 2-134: entries (2), patterns to show (4), indices (2 each)
    DEFINITION = 0x1A34  # 2-136: see `encode_definition`
    PICTURE_1 = 0x1A2A  # 2-138: index (2), bytes with the header (4); of the first controller
    DATA_1 = 0x1A2B  # 2-140: bytes (2), data
    PICTURE_2 = 0x1A2C  # of the second controller
    DATA_2 = 0x1A2D


class Dlpc900Mirrors(IntEnum):
    """Mirror arrays by their hardware number (DLPU018 table 2-10)."""

    DLP6500 = 1
    DLP9000 = 2
    DLP670S = 3
    DLP500YX = 4

    @property
    def size(self) -> Size:
        """Columns and rows (data sheet of the DLPC900, DLPS037, features)."""
        return {1: Size(1920, 1080), 2: Size(2560, 1600), 3: Size(2716, 1600), 4: Size(2048, 1200)}[self]

    @property
    def controllers(self) -> int:
        """Number of controllers that share the columns (DLPS037, features)."""
        return 1 if self is Dlpc900Mirrors.DLP6500 else 2

    @property
    def least_us(self) -> int:
        """Shortest exposure of a 1-bit pattern (DLPU018 table 2-103)."""
        return {1: 105, 2: 105, 3: 100, 4: 62}[self]


def encode_definition(index: int, place: MemoryPlane, *, exposure_us: int, dark_us: int, leds: int) -> bytes:
    """Return an entry of the pattern table, of a 1-bit pattern without external trigger.

    Fields: number (2 bytes), exposure (3, µs), LEDs in bits 4 to 6 and clearing of the mirrors in bit 0, dark time
    after it (3, µs), zero, and picture (11 bits) and plane (5 bits).
    """
    return (
        struct.pack("<H", index)
        + exposure_us.to_bytes(3, "little")
        + bytes([leds << 4 | _CLEARED])
        + dark_us.to_bytes(3, "little")
        + b"\0"
        + struct.pack("<H", place.picture | place.plane << 11)
    )


class Dlpc900Engine(UsbEngine):
    """A DLPC900 behind a link."""

    def __init__(self, link: UsbLink, clock: Clock | None) -> None:
        super().__init__(link, clock)
        self._reports_stop = True

    def version(self) -> tuple[int, int]:
        """Return major and minor number of its firmware."""
        answer = self._link.read(Dlpc900Command.VERSION, 4)
        return answer[3], answer[2]

    def mirrors(self) -> Dlpc900Mirrors:
        """Return its mirror array. Raises UnsupportedByDeviceError if it is unknown."""
        number = self._link.read(Dlpc900Command.HARDWARE, 1)[0]
        try:
            return Dlpc900Mirrors(number)
        except ValueError as error:
            known = ", ".join(mirrors.name for mirrors in Dlpc900Mirrors)
            message = f"{self.name} has mirrors of type {number}, this driver supports {known}; use one of these"
            raise UnsupportedByDeviceError(message) from error

    def set_trigger_out(self, *, active_low: bool, delay_us: int) -> None:
        """Set TRIG_OUT_1 (DLPU018 table 2-112): polarity, and delay of both edges after the light's."""
        self.settle(UsbCommand.TRIGGER_OUT_1, struct.pack("<Bhh", active_low, delay_us, delay_us))

    def define(self, entry: bytes) -> None:
        """Set an entry of the pattern table, effective from the next `configure` on."""
        self._send(Dlpc900Command.DEFINITION, entry)

    def configure(self, entries: int, count: int) -> None:
        """Use the first entries of the table in their order, and show this number of patterns."""
        self._send(Dlpc900Command.CONFIGURATION, struct.pack("<HI", entries, count))

    def order(self, indices: Sequence[int], count: int) -> None:
        """Show this number of patterns, cycling through these entries."""
        self._link.send(Dlpc900Command.ORDER, struct.pack(f"<HI{len(indices)}H", len(indices), count, *indices))
        self._check_error_code("take the order of the patterns")

    def upload(self, number: int, parts: Sequence[bytes]) -> None:
        """Send a picture, a part for each controller. Pictures are sent last first (table 2-139)."""
        for part, begin, data in zip(
            parts,
            (Dlpc900Command.PICTURE_1, Dlpc900Command.PICTURE_2),
            (Dlpc900Command.DATA_1, Dlpc900Command.DATA_2),
            strict=False,
        ):
            self._send(begin, struct.pack("<HI", number, len(part)))
            for start in range(0, len(part), MAX_MESSAGE_BYTES):
                piece = part[start : start + MAX_MESSAGE_BYTES]
                self._link.send(data, struct.pack("<H", len(piece)) + piece)
                self._check_error_code(f"take picture {number}")

    def wait_until_stopped(self) -> None:
        """See `UsbEngine`. 0x1A24 cannot be read here, the guide names the status instead (DLPU018, "Pattern Display
        Start/Stop"). Continues if that does not change, and waits no more then: the status without a sequence is not
        documented. Commands that a running sequence refuses raise with the engine's own reason.
        """
        if self._reports_stop:
            self._reports_stop = ask_until(
                self._clock, lambda: not self.byte(UsbCommand.MAIN_STATUS) & MainStatus.RUNNING, bool
            )

    def faults(self) -> str:
        """Return the faults in the hardware status as text; empty if none."""
        faults = [super().faults()]
        if self.byte(UsbCommand.HARDWARE_STATUS) & INCOMPATIBLE:
            faults.append(ERRORS[4])
        return "; ".join(filter(None, faults))

    def require_healthy(self) -> None:
        """Raise DeviceError, with its cause, if the hardware status has faults."""
        if faults := self.faults():
            message = f"{self.name} reports: {faults}; switch it off and on"
            raise DeviceError(message)

    def _send(self, command: Dlpc900Command, data: bytes) -> None:
        """Send a command. Raises UnsupportedByDeviceError, with the engine's error, if it is refused."""
        try:
            self._link.write(command, data)
        except CommandRefusedError as error:
            raise self._refusal_error(f"take {command.name.lower().replace('_', ' ')} {data.hex(' ')}") from error

    def _check_error_code(self, action: str) -> None:
        if self.byte(Dlpc900Command.ERROR_CODE):
            raise self._refusal_error(action)

    def _refusal_error(self, action: str) -> UnsupportedByDeviceError:
        code = self.byte(Dlpc900Command.ERROR_CODE)
        reason = ERRORS.get(code, f"error code {code}")
        return UnsupportedByDeviceError(
            f"{self.name} did not {action}: {reason}; report this message to the driver's maintainer"
        )


class Dlpc900EngineOptions(UsbLightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc900"`."""

    start_s: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Longest time from the engine's report that its sequencer runs until a shown pattern is lit. Not documented;
    `slrig latency` measures it."""

    trigger_delay_us: Annotated[int, Field(ge=TRIGGER_DELAY_RANGE_US[0], le=TRIGGER_DELAY_RANGE_US[1])] = 0
    """Delay of TRIG_OUT_1 after the light."""

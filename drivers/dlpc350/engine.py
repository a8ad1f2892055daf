"""What the DLPC350 understands beside `drivers.pattern_engine.usb`: its tables, and how it checks them.

Sources as there. The order of commands is that of TI's DLP SDK (lcr4500.cpp, `CreateSendStartSequenceLut`) and of TI's
demonstration of a pattern sequence.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import groupby

from drivers.dlpc350.flash import FlashedPlane
from drivers.pattern_engine.options import LedColour
from drivers.pattern_engine.patterns import Timing, check_duty, light_duration_us
from drivers.pattern_engine.usb import UsbCommand, UsbEngine
from slrig.errors import UnsupportedByDeviceError

INTERNAL = 0
_BIT_DEPTH = 1


MIN_EXPOSURE_US = {1: 235, 2: 700, 3: 1570, 4: 1700, 5: 2000, 6: 2500, 7: 4500, 8: 8333}
"""Shortest exposure by bit depth."""
MAX_EXPOSURE_US = 200_000_000
DARK_US = 230
"""A pattern that does not last its whole period is dark for so long at least: the mirrors are cleared."""
BUFFERS = 2
"""Pictures of 24 bit planes that are loaded before a sequence starts; of more than that, only the first is."""
MAX_PATTERNS = 128
"""Entries of the pattern table (DLPU010, "Pattern Display LUT")."""
VALIDATION_FAULTS = {
    1: "the exposure or the period is not one that it can do",
    2: "a pattern number in the table is not one that it has",
    4: "the trigger output would be held on through a dark between",
    8: "the dark between is missing in the table",
    16: "exposure and period differ by less than 230 µs",
}
_BUSY = 0x80
_EDGE_NS = 107.2
_EDGE_ZERO = 0xBB
_EDGES = (0, 0xD5)


@dataclass(frozen=True, slots=True)
class PatternTables:
    """What the engine is sent. counts : patterns per picture, in the order in which the pictures are taken."""

    patterns: bytes
    images: bytes
    counts: tuple[int, ...]

    @property
    def length(self) -> int:
        """Number of patterns."""
        return sum(self.counts)


def build_tables(places: Sequence[FlashedPlane], colours: Sequence[LedColour], *, dark_between: bool) -> PatternTables:
    """Return the tables that show these places one after the other, each lit by LEDs of its own."""
    words: list[int] = []
    previous: int | None = None
    for place, colour in zip(places, colours, strict=True):
        words.append(
            INTERNAL
            | place.plane << 2
            | _BIT_DEPTH << 8
            | colour << 12
            | place.inverted << 16
            | dark_between << 17
            | (place.image != previous) << 18
        )
        previous = place.image
    runs = [(image, len(list(run))) for image, run in groupby(places, key=lambda place: place.image)]
    images = [image for image, _ in runs]
    if len(images) == 2:
        images.reverse()
    return PatternTables(
        b"".join(word.to_bytes(3, "little") for word in words), bytes(images), tuple(count for _, count in runs)
    )


def play_timing(exposure_s: float, period_s: float, *, margin_s: float, duty_limit: float) -> Timing:
    """How long to light patterns of which cameras take `exposure_s`, one per period; see `light_duration_us` and `check_duty`.
    Raises UnsupportedByDeviceError: the engine does not have this timing, or the duty limit forbids it.
    """
    period_us = round(period_s * 1e6)
    wanted_us = light_duration_us(exposure_s, period_s, margin_s=margin_s, least_us=MIN_EXPOSURE_US[1])
    # What the dark between does not fit into is lit to its end.
    timing = Timing(wanted_us if wanted_us <= period_us - DARK_US else period_us, period_us)
    check_timing(timing)
    check_duty(timing, duty_limit)
    return timing


def check_timing(timing: Timing, *, bit_depth: int = 1) -> None:
    """Raise UnsupportedByDeviceError if the engine does not have this timing; the message names the rule."""
    exposure_us, period_us = timing.exposure_us, timing.period_us
    asked = f"asked for an exposure of {exposure_us} µs and a period of {period_us} µs"
    least_us = MIN_EXPOSURE_US[bit_depth]
    if exposure_us < least_us:
        message = f"{asked}: the shortest exposure of a {bit_depth}-bit pattern is {least_us} µs; lengthen exposure_s"
        raise UnsupportedByDeviceError(message)
    if max(exposure_us, period_us) > MAX_EXPOSURE_US:
        message = f"{asked}: the longest is {MAX_EXPOSURE_US} µs ({MAX_EXPOSURE_US / 1e6:g} s); shorten exposure_s"
        raise UnsupportedByDeviceError(message)
    if exposure_us > period_us or 0 < period_us - exposure_us < DARK_US:
        message = (
            f"{asked}: the exposure equals the period, or is shorter by {DARK_US} µs at least, the time that clearing "
            f"the mirrors takes; here it is {period_us - exposure_us} µs shorter; lengthen the period"
        )
        raise UnsupportedByDeviceError(message)


def check_loading(counts: Sequence[int], period_us: int, image_load_s: float) -> None:
    """Check that each picture is there when its first pattern is due.

    Parameters
    ----------
    counts
        How many patterns are shown of each picture before the next one takes its place.
    image_load_s
        How long a picture takes from the flash.

    Raises
    ------
    UnsupportedByDeviceError
        A picture would come too late; the message names the rule.
    """
    if len(counts) <= BUFFERS:
        return
    least = min(counts[:-1])
    if least * period_us < image_load_s * 1e6:
        message = (
            f"the sequence needs {len(counts)} pictures from the engine's flash, one after the other: only {BUFFERS} "
            f"are loaded beforehand, and each further one must come while the one before it is shown, which takes "
            f"{image_load_s:g} s (image_load_s); {least} patterns every {period_us} µs take "
            f"{least * period_us / 1e6:g} s; lengthen the period to {image_load_s / least:.4f} s, or scan one axis only"
        )
        raise UnsupportedByDeviceError(message)


class Dlpc350Command(IntEnum):
    """USB commands."""

    VALIDATE = 0x1A1A
    PATTERN_SOURCE = 0x1A22  # 3 flash, 0 video input
    TRIGGER_MODE = 0x1A23  # 1: internal or external trigger
    EXPOSURE_PERIOD = 0x1A29  # 4 bytes each, µs
    PATTERN_CONFIGURATION = 0x1A31  # entries - 1, repeat, patterns to show - 1, pictures - 1
    MAILBOX_OFFSET = 0x1A32
    MAILBOX = 0x1A33  # 0 closed, 1 image table, 2 pattern table
    MAILBOX_DATA = 0x1A34
    IMAGES_IN_FLASH = 0x1A42
    FIRMWARE_TAG = 0x1AFF


class Dlpc350Engine(UsbEngine):
    """A DLPC350 behind a link."""

    def set_trigger_out(self, *, active_low: bool, delay_us: float) -> None:
        """Set TRIG_OUT_1: its edges, later than the pattern's light by the delay, in steps of 107.2 ns."""
        edge = min(max(_EDGE_ZERO + round(delay_us * 1e3 / _EDGE_NS), _EDGES[0]), _EDGES[1])
        self._link.write(UsbCommand.TRIGGER_OUT_1, bytes([active_low, edge, edge]))

    def set_timing(self, timing: Timing) -> None:
        """Set exposure and period of all patterns; compare what is read back."""
        self.settle(Dlpc350Command.EXPOSURE_PERIOD, struct.pack("<II", timing.exposure_us, timing.period_us))

    def set_tables(self, tables: PatternTables, before: PatternTables | None = None) -> None:
        """Send the tables of a sequence that is shown once. before : those that the engine has, if that is known; only
        what differs is sent.
        """
        if before is None or tables.patterns != before.patterns:
            self._send_mailbox(2, tables.patterns)
        if before is None or tables.images != before.images:
            self._send_mailbox(1, tables.images)
        if before is None or (tables.length, len(tables.images)) != (before.length, len(before.images)):
            entries = tables.length - 1
            self._link.write(Dlpc350Command.PATTERN_CONFIGURATION, bytes([entries, 0, entries, len(tables.images) - 1]))

    def _send_mailbox(self, mailbox: int, data: bytes) -> None:
        self.set_byte(Dlpc350Command.MAILBOX, mailbox)
        try:
            self.set_byte(Dlpc350Command.MAILBOX_OFFSET, 0)
            self._link.write(Dlpc350Command.MAILBOX_DATA, data)
        finally:
            self.set_byte(Dlpc350Command.MAILBOX, 0)

    def validate(self, timeout_s: float) -> None:
        """Let the engine check what it was told.

        Raises
        ------
        UnsupportedByDeviceError
            It found something wrong, and says what.
        DeviceError
            It did not come to an end in time.
        """
        self.set_byte(Dlpc350Command.VALIDATE, 0)
        until = time.monotonic() + timeout_s
        while (found := self.byte(Dlpc350Command.VALIDATE)) & _BUSY:
            self._wait(until, "come to an end with checking the sequence")
        if found:
            causes = (
                "; ".join(words for bit, words in VALIDATION_FAULTS.items() if found & bit) or f"status {found:#04x}"
            )
            message = f"{self.name} refuses the sequence: {causes}; report this message to the driver's maintainer"
            raise UnsupportedByDeviceError(message)

    def firmware_tag(self) -> str:
        """The name that was given to what lies in the flash, at most 32 characters."""
        return (
            self._link.read(Dlpc350Command.FIRMWARE_TAG, 1)[:32].split(b"\0", 1)[0].decode("ascii", "replace").strip()
        )

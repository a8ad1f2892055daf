"""Commands of the DLPC350 in addition to `drivers.pattern_engine.usb`: pattern tables, their timing and validation.

The order of commands is that of TI's DLP SDK (lcr4500.cpp, `CreateSendStartSequenceLut`) and of TI's demonstration of a
pattern sequence. Timing rules are checked before they are sent; each error names its rule. Sources: lcr4500.cpp
(`Pattern::Exposure`), DLPU010 ("Pattern Display Exposure and Frame Period") and, for the time that a picture takes from
the flash, the LightCrafter 4500 user's guide (DLPU011, "Pattern Sequence Background"): 200 ms at worst.

An entry of the pattern table is 24 bits (DLPU010, "Pattern Display LUT Data"; TI's `DLPC350_AddToPatLut`):

    0-1   trigger: 0 internal, 1 and 2 external, 3 continues from the previous pattern
    2-7   number of the pattern: of the plane, for a bit depth of 1
    8-11  bit depth
    12-14 LEDs: red, green, blue
    16    inverted
    17    cleared to black afterwards, which takes 230 µs; needed if the exposure is shorter than the period
    18    first loads the next picture of the image table; also set in the very first entry
    19    shares the trigger output of the previous entry

The image table has one byte per picture, in the order of use. A table of two pictures is sent in reverse order, as in
TI's own sources (`DLPC350_SendImageLut`, "special case of 2 entries").
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import groupby
from typing import Annotated

from pydantic import Field

from drivers.dlpc350.flash import FlashedPlane
from drivers.pattern_engine.options import LedColour, UsbLightOptions
from drivers.pattern_engine.patience import PATIENCE_S, ask_until
from drivers.pattern_engine.projector import Timing, check_duty, light_duration_us
from drivers.pattern_engine.usb import UsbCommand, UsbEngine, UsbLink
from slrig.devices import Clock
from slrig.errors import UnsupportedByDeviceError


class Dlpc350EngineOptions(UsbLightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc350"`."""

    patterns: Annotated[str, Field(min_length=1)]
    """Folder with the list of the pictures in the engine's flash (`images.json`) and these pictures, relative to the
    rig file's folder. It need not exist: a scan then writes the missing pictures into its folder `to_flash`."""

    led_current_inverted: bool | None = None
    """True if 255 switches an LED off and 0 gives it the maximum current, with the polarity register at "normal", as in
    TI's own program for the LightCrafter 4500; false on boards built according to the manual. `slrig doctor` determines
    it. Until it is set, the average light is at most 5 % of the board's maximum for either polarity, and nothing is
    played."""

    image_load_s: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Maximum time from the command to start until light when the engine loads a picture from its flash. Default: TI's
    worst case; TI's program shows it for each picture ("Image Load Time")."""

    image_kept_s: Annotated[float, Field(ge=0, le=1)] | None = None
    """The same if the previous pattern was in the same picture. Default: image_load_s, since no document excludes that
    the engine loads it again; `slrig latency`, which shows two patterns of one picture, measures it."""

    trigger_delay_us: Annotated[float, Field(ge=-20.05, le=2.78)] = 0.0
    """Delay of TRIG_OUT_1 after the light."""

    standby: bool = False
    """Put the engine into standby when it is closed; it is woken when opened."""

    def load_s(self, *, same_picture: bool) -> float:
        """Return the maximum time from start to light. same_picture : the previous pattern is in the same picture."""
        return self.image_kept_s if same_picture and self.image_kept_s is not None else self.image_load_s


INTERNAL = 0
_BIT_DEPTH = 1


_MIN_EXPOSURE_US = 235
"""Shortest exposure of a pattern of 1 bit."""
MAX_EXPOSURE_US = 200_000_000
DARK_US = 230
"""Shortest dark time of a pattern that does not last its whole period: the mirrors are cleared."""
BUFFERS = 2
"""Number of pictures loaded before a sequence starts; only the first if the sequence needs more."""
MAX_PATTERNS = 128
"""Entries of the pattern table (DLPU010, "Pattern Display LUT")."""
VALIDATION_FAULTS = {
    1: "the exposure or the period is not supported",
    2: "a pattern number in the table does not exist",
    4: "the trigger output would stay on during a dark time",
    8: "the dark time is missing in the table",
    16: "exposure and period differ by less than 230 µs",
}
_BUSY = 0x80
_STOP_AGAIN_S = 0.1
PAUSE_S = 0.01
"""From the command to validate until its result is first read, and from the result until the start. The register of
the result reads "not busy" before the engine begins."""
_FIRST_PAUSE_S = 0.1
"""The first of these after the engine was opened."""
_EDGE_NS = 107.2
_EDGE_ZERO = 0xBB
_EDGES = (0, 0xD5)


@dataclass(frozen=True, slots=True)
class PatternTables:
    """Tables to send. counts : patterns per picture, in the order of use of the pictures."""

    patterns: bytes
    images: bytes
    counts: tuple[int, ...]

    @property
    def length(self) -> int:
        """Number of patterns."""
        return sum(self.counts)


def build_tables(places: Sequence[FlashedPlane], colours: Sequence[LedColour], *, dark_between: bool) -> PatternTables:
    """Return the tables that show these planes in turn, each lit by its own LEDs."""
    entries: list[int] = []
    previous: int | None = None
    for place, colour in zip(places, colours, strict=True):
        entries.append(
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
        b"".join(entry.to_bytes(3, "little") for entry in entries), bytes(images), tuple(count for _, count in runs)
    )


def play_timing(exposure_s: float, period_s: float, *, margin_s: float, duty_limit: float) -> Timing:
    """Return the timing for an exposure of `exposure_s` per period; see `light_duration_us` and `check_duty`. Raises
    UnsupportedByDeviceError if the engine does not support it, or the duty limit forbids it.
    """
    period_us = round(period_s * 1e6)
    wanted_us = light_duration_us(exposure_s, period_s, margin_s=margin_s, least_us=_MIN_EXPOSURE_US)
    # If the dark time does not fit, the light lasts for the whole period.
    timing = Timing(wanted_us if wanted_us <= period_us - DARK_US else period_us, period_us)
    check_timing(timing)
    check_duty(timing, duty_limit)
    return timing


def check_timing(timing: Timing) -> None:
    """Raise UnsupportedByDeviceError if the engine does not support this timing; the message names the rule."""
    exposure_us, period_us = timing.exposure_us, timing.period_us
    requested = f"requested an exposure of {exposure_us} µs and a period of {period_us} µs"
    if exposure_us < _MIN_EXPOSURE_US:
        message = f"{requested}: the shortest exposure of a 1-bit pattern is {_MIN_EXPOSURE_US} µs; lengthen exposure_s"
        raise UnsupportedByDeviceError(message)
    if max(exposure_us, period_us) > MAX_EXPOSURE_US:
        message = f"{requested}: the longest is {MAX_EXPOSURE_US} µs ({MAX_EXPOSURE_US / 1e6:g} s); shorten exposure_s"
        raise UnsupportedByDeviceError(message)
    if exposure_us > period_us or 0 < period_us - exposure_us < DARK_US:
        message = (
            f"{requested}: the exposure must equal the period, or be at least {DARK_US} µs shorter for clearing "
            f"the mirrors; here it is {period_us - exposure_us} µs shorter; lengthen the period"
        )
        raise UnsupportedByDeviceError(message)


def check_loading(counts: Sequence[int], period_us: int, image_load_s: float) -> None:
    """Check that each picture is loaded before its first pattern.

    counts : number of patterns shown of each picture. image_load_s : loading time of a picture from the flash. Raises
    UnsupportedByDeviceError if a picture would be late; the message names the rule.
    """
    if len(counts) <= BUFFERS:
        return
    least = min(counts[:-1])
    if least * period_us < image_load_s * 1e6:
        message = (
            f"the sequence needs {len(counts)} pictures from the engine's flash, one after the other: only {BUFFERS} "
            f"are loaded beforehand, and each further one must load while the previous one is shown, which takes "
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

    def __init__(self, link: UsbLink, clock: Clock | None) -> None:
        super().__init__(link, clock)
        self._pause_s = _FIRST_PAUSE_S

    def wait_until_stopped(self) -> None:
        """See `UsbEngine`. Repeats the stop. Raises DeviceError if the sequence does not end."""
        for _ in range(round(PATIENCE_S / _STOP_AGAIN_S)):
            if ask_until(self._clock, lambda: self.byte(UsbCommand.START_STOP) == 0, bool, _STOP_AGAIN_S):
                return
            self.stop()
        raise self._late("stop the sequence")

    def set_trigger_out(self, *, active_low: bool, delay_us: float) -> None:
        """Set TRIG_OUT_1: polarity, and delay of its edges after the pattern's light, in steps of 107.2 ns."""
        edge = min(max(_EDGE_ZERO + round(delay_us * 1e3 / _EDGE_NS), _EDGES[0]), _EDGES[1])
        self._link.write(UsbCommand.TRIGGER_OUT_1, bytes([active_low, edge, edge]))

    def set_timing(self, timing: Timing) -> None:
        """Set exposure and period of all patterns; verify by reading back."""
        self.settle(Dlpc350Command.EXPOSURE_PERIOD, struct.pack("<II", timing.exposure_us, timing.period_us))

    def set_tables(self, tables: PatternTables, before: PatternTables | None = None) -> None:
        """Send the tables of a sequence that is shown once. before : the engine's current tables, if known; then only
        the differences are sent.
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
        """Let the engine validate the sequence; it can be started then. Raises UnsupportedByDeviceError with the faults
        found; DeviceError on time-out.
        """
        self.set_byte(Dlpc350Command.VALIDATE, 0)
        self._wait(self._pause_s)
        self._pause_s = PAUSE_S
        found = ask_until(
            self._clock, lambda: self.byte(Dlpc350Command.VALIDATE), lambda found: not found & _BUSY, timeout_s
        )
        if found & _BUSY:
            raise self._late("finish the validation of the sequence")
        if found:
            causes = "; ".join(text for bit, text in VALIDATION_FAULTS.items() if found & bit) or f"status {found:#04x}"
            message = f"{self.name} refuses the sequence: {causes}; report this message to the driver's maintainer"
            raise UnsupportedByDeviceError(message)
        self._wait(PAUSE_S)

    def _wait(self, seconds: float) -> None:
        self._clock.wait_until(self._clock.now_ns() + round(seconds * 1e9), threading.Event())

    def firmware_tag(self) -> str:
        """Return the tag of the flash contents, at most 32 characters."""
        return (
            self._link.read(Dlpc350Command.FIRMWARE_TAG, 1)[:32].split(b"\0", 1)[0].decode("ascii", "replace").strip()
        )

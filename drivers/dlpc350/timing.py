"""The engine's rules of exposure and period, held before the engine is asked; each error names its rule.

Source: TI's sources for the LightCrafter 4500 (DLP SDK, lcr4500.cpp: `Pattern::Exposure` and
`CreateSendStartSequenceLut`), DLPU010 ("Pattern Display Exposure and Frame Period") and, for the time that a picture
takes from the flash, the LightCrafter 4500 user's guide (DLPU011, "Pattern Sequence Background"): 200 ms at the worst.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.pattern_engine.timing import Timing, check_duty, light_duration_us
from slrig.errors import UnsupportedByDeviceError

MIN_EXPOSURE_US = {1: 235, 2: 700, 3: 1570, 4: 1700, 5: 2000, 6: 2500, 7: 4500, 8: 8333}
"""Shortest exposure by bit depth."""
MAX_EXPOSURE_US = 200_000_000
DARK_US = 230
"""A pattern that does not last its whole period is dark for so long at least: the mirrors are cleared."""
BUFFERS = 2
"""Pictures of 24 bit planes that are loaded before a sequence starts; of more than that, only the first is."""
MAX_PATTERNS = 128
"""Entries of the pattern table (DLPU010, "Pattern Display LUT")."""
MAX_IMAGES = 64
"""Entries of the image table."""


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

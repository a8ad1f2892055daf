"""The engine's rules of exposure and dark time, held before the engine is asked; each error names its rule.

Source: DLPU018 revision F. Shortest exposures of a 1-bit pattern with all blocks of mirrors: table 2-103. Widths of the
fields: table 2-137. Delays of the trigger output: table 2-112. The guide states no shortest dark time; dark is shown as
a pattern is, so it is taken to need a pattern's shortest exposure. Without dark between, TRIG_OUT_1 stays as it is from
one pattern to the next (section 2.4.4.1), and no camera hears of the next one.
"""

from __future__ import annotations

from drivers.pattern_engine.timing import Timing, check_duty, light_duration_us
from slrig.errors import UnsupportedByDeviceError

MAX_US = 2**24 - 1
"""Exposure and dark time have 24 bits each."""
TRIGGER_DELAY_RANGE_US = (-20, 20_000)
MAX_ENTRIES = 400
"""Entries of the pattern table (DLPU018 revision J, table 2-139)."""


def play_timing(exposure_s: float, period_s: float, *, margin_s: float, duty_limit: float, least_us: int) -> Timing:
    """How long to light patterns of which cameras take `exposure_s`, one per period; see `light_duration_us` and `check_duty`.
    Raises UnsupportedByDeviceError: the engine does not have this timing, or the duty limit forbids it.
    """
    wanted_us = light_duration_us(exposure_s, period_s, margin_s=margin_s, least_us=least_us, dark_us=least_us)
    timing = Timing(wanted_us, round(period_s * 1e6))
    dark_us = timing.period_us - timing.exposure_us
    if max(timing.exposure_us, dark_us) > MAX_US:
        message = (
            f"asked for {timing.exposure_us} µs of light and {dark_us} µs of dark after it: the longest is {MAX_US} "
            "µs each; shorten exposure_s, or the period"
        )
        raise UnsupportedByDeviceError(message)
    check_duty(timing, duty_limit)
    return timing

"""Which exposure and which lines to write into a rig file, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from slrig.doctor.findings import Finding, camera_named, ms, note
from slrig.doctor.flicker import Flicker
from slrig.doctor.light import Seen

_WHOLE = 0.02
_STEADY = 0.004
_MOST_PERIODS = 64
_PERIODS_PX = (8, 12, 16, 24, 32)
"""From the default on: what is sharper than that gains nothing by a shorter period (`tests/bench/line_sweep.py`)."""
_LEAST_GAIN = 1.1


@dataclass(frozen=True, slots=True)
class ExposureAdvice:
    """An exposure for one camera, and why. usable_s : the shortest and the longest that leave enough of the light."""

    exposure_s: float
    reason: str
    usable_s: tuple[float, float]


@dataclass(frozen=True, slots=True)
class LineAdvice:
    """Which distance of lines suits a rig's blur, projector pixels.

    steps : how many line frames; gain : how many times less noise a point has than with the rig's own lines.
    """

    period_px: int
    steps: int
    gain: float
    reason: str

    @property
    def less_noise(self) -> str:
        """The gain in words."""
        return f"{self.gain:.1f} times less noise" if self.gain < 10 else "less than a tenth of the noise"


def line_advice(blur_px: float, own_period_px: int, own_steps: int) -> LineAdvice | None:
    """Return the lines that leave least noise where they are blurred by a Gaussian; None where the rig's own do nearly
    as well.

    A point's deviation goes by period/(contrast · √steps), and the first harmonic keeps exp(−2 (π σ/period)²) of its
    contrast: of all periods 2 π σ is best. Periods longer than the default have eight steps: as many frames.

    blur_px : σ, of projector, camera and pixels, projector pixels.
    """
    if not math.isfinite(blur_px):
        return None

    def deviation(period_px: int, steps: int) -> float:
        return period_px * math.exp(2 * (math.pi * blur_px / period_px) ** 2) / math.sqrt(steps)

    chosen = min(((period_px, _steps(period_px)) for period_px in _PERIODS_PX), key=lambda each: deviation(*each))
    gain = deviation(own_period_px, own_steps) / deviation(*chosen)
    if gain < _LEAST_GAIN:
        return None
    reason = f"measured: bars are blurred by {blur_px:.1f} projector pixels (standard deviation)"
    return LineAdvice(*chosen, gain, reason)


def _steps(period_px: int) -> int:
    """About eight, which divide the period: as many frames as the default has.

    >>> [_steps(period_px) for period_px in (8, 12, 16, 24)]
    [8, 6, 8, 8]
    """
    return max(steps for steps in range(3, 9) if period_px % steps == 0)


def exposure_advice(
    seen: Seen, limits_s: tuple[float, float], *, refresh_hz: float | None, flickers: Sequence[Flicker]
) -> ExposureAdvice:
    """Return the rig's own exposure where that is good, else the longest that is usable and averages all flicker out.

    limits_s : what the camera can do. A display's refresh comes first, then the projector's flicker, then the room's.
    """
    longest_s = min(seen.longest_s, limits_s[1])
    shortest_s = max(min(seen.shortest_s, longest_s), limits_s[0])
    usable_s = (shortest_s, longest_s)
    name, period_s = _period(refresh_hz, flickers)
    own_s = seen.own_exposure_s
    in_range = shortest_s <= own_s <= 1.02 * longest_s
    if in_range and (period_s is None or is_whole(own_s, period_s)) and _left(own_s, flickers) <= _STEADY:
        return ExposureAdvice(own_s, "kept: it exposes well", usable_s)
    if period_s is None:
        return ExposureAdvice(longest_s, "the longest that does not saturate", usable_s)
    counts = [k for k in range(1, _MOST_PERIODS + 1) if shortest_s <= k * period_s <= 1.001 * longest_s]
    if not counts:
        return ExposureAdvice(
            longest_s, f"the longest that does not saturate, less than {name} ({ms(period_s)})", usable_s
        )
    steady = [k for k in counts if _left(k * period_s, flickers) <= _STEADY]
    chosen = steady[-1] if steady else min(counts, key=lambda k: _left(k * period_s, flickers))
    return ExposureAdvice(chosen * period_s, f"{chosen} × {name} ({ms(period_s)})", usable_s)


def unsnapped(seen: Seen, refresh_hz: float | None) -> list[Finding]:
    """Say so where a rig's exposure is no multiple of the display's refresh period."""
    if refresh_hz is None or is_whole(seen.own_exposure_s, 1 / refresh_hz):
        return []
    period = ms(1 / refresh_hz)
    found = (
        f"its exposure of {ms(seen.own_exposure_s)} is no multiple of the display's refresh period, {period}: it may "
        "see a part of the picture twice, or part of a colour cycle"
    )
    remedy = f"expose for a multiple of {period}; where that saturates, close the lens's aperture"
    return [note("exposure.refresh", camera_named(seen.name), found, remedy)]


def is_whole(exposure_s: float, period_s: float) -> bool:
    """Whether an exposure is a whole number of periods, one or more.

    >>> is_whole(0.0333, 1 / 60), is_whole(0.02, 1 / 60), is_whole(0.001, 1 / 60)
    (True, False, False)
    """
    periods = exposure_s / period_s
    return round(periods) >= 1 and abs(periods - round(periods)) <= _WHOLE


def _period(refresh_hz: float | None, flickers: Sequence[Flicker]) -> tuple[str, float | None]:
    if refresh_hz is not None:
        return "the refresh period", 1 / refresh_hz
    for source, name in (
        ("projector", "the period of the projector's flicker"),
        ("room", "the period of the room light's flicker"),
    ):
        # The slowest: whole periods of it are whole periods of its harmonics.
        slowest = min((each.frequency_hz for each in flickers if each.source == source), default=None)
        if slowest is not None:
            return name, 1 / slowest
    return "", None


def _left(exposure_s: float, flickers: Sequence[Flicker]) -> float:
    return sum(each.left(exposure_s) for each in flickers)

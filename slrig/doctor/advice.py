"""Advice for a rig file: exposures and lines, each with its reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from slrig.doctor.light import Finding, LightMeasurement, camera_label, format_ms, note
from slrig.doctor.timing import LightFlicker

_PERIOD_TOLERANCE = 0.02
_NEGLIGIBLE_FLICKER = 0.004
_MAX_PERIODS = 64
_PERIODS_PX = (8, 12, 16, 24, 32)
"""From the default on: shorter periods gain nothing, however sharp the picture (`slrig/scan/README.md`)."""
_MIN_GAIN = 1.1


@dataclass(frozen=True, slots=True)
class ExposureAdvice:
    """Exposure for one camera, and the reason. usable_s : shortest and longest usable exposure."""

    exposure_s: float
    reason: str
    usable_s: tuple[float, float]


@dataclass(frozen=True, slots=True)
class LineAdvice:
    """Distance of lines, or period of sinusoids, that suits the blur of a rig, projector pixels.

    steps : number of their frames. gain : factor by which points have less noise than with the rig's own lines.
    sines : True for sinusoids.
    """

    period_px: int
    steps: int
    gain: float
    reason: str
    sines: bool = False

    @property
    def options(self) -> dict[str, int]:
        """The keys for `[scan]`, with their values."""
        if self.sines:
            return {"sine_period_px": self.period_px, "sine_steps": self.steps}
        return {"line_shift_period_px": self.period_px, "line_steps": self.steps}

    @property
    def gain_text(self) -> str:
        """The gain as a phrase."""
        return f"{self.gain:.1f} times less noise" if self.gain < 10 else "less than a tenth of the noise"


def advise_lines(blur_px: float, own_period_px: int, own_steps: int, *, sines: bool = False) -> LineAdvice | None:
    """Return the lines, or sinusoids of as many steps, that leave least noise under a Gaussian blur; None if the rig's
    own are nearly as good.

    The standard deviation of a point is proportional to period/(contrast · √steps), and the first harmonic keeps
    exp(−2 (π σ/period)²) of its contrast, so the best period is 2 π σ. Periods longer than the default have at most
    eight steps, so that they take no more frames.

    blur_px : σ of projector, camera and pixels together, projector pixels.
    """
    if not math.isfinite(blur_px):
        return None

    def deviation(period_px: int, steps: int) -> float:
        return period_px * math.exp(2 * (math.pi * blur_px / period_px) ** 2) / math.sqrt(steps)

    offered = ((period_px, own_steps if sines else _line_steps(period_px)) for period_px in _PERIODS_PX)
    best = min(offered, key=lambda each: deviation(*each))
    gain = deviation(own_period_px, own_steps) / deviation(*best)
    if gain < _MIN_GAIN:
        return None
    reason = f"measured: bars are blurred by {blur_px:.1f} projector pixels (standard deviation)"
    return LineAdvice(*best, gain, reason, sines)


def _line_steps(period_px: int) -> int:
    """Return the greatest divisor of the period up to eight: at most as many frames as the default has.

    >>> [_line_steps(period_px) for period_px in (8, 12, 16, 24)]
    [8, 6, 8, 8]
    """
    return max(steps for steps in range(3, 9) if period_px % steps == 0)


def advise_exposure(
    light: LightMeasurement,
    limits_s: tuple[float, float],
    *,
    refresh_hz: float | None,
    flickers: Sequence[LightFlicker],
) -> ExposureAdvice:
    """Return the rig's own exposure if it is good, otherwise the longest usable one that averages flicker out.

    A display's refresh takes precedence, then the projector's flicker, then the room's.

    limits_s : shortest and longest exposure of the camera.
    """
    longest_s = min(light.longest_s, light.taken_s, limits_s[1])
    which = "that does not saturate" if longest_s == light.longest_s else "that the camera takes"
    shortest_s = max(min(light.shortest_s, longest_s), limits_s[0])
    usable_s = (shortest_s, longest_s)
    name, period_s = _period_to_average(refresh_hz, flickers)
    own_s = light.own_exposure_s

    def flicker_share(exposure_s: float) -> float:
        return sum(each.remaining_share(exposure_s) for each in flickers)

    is_usable = shortest_s <= own_s <= 1.02 * longest_s
    is_synchronous = period_s is None or is_whole_periods(own_s, period_s)
    if is_usable and is_synchronous and flicker_share(own_s) <= _NEGLIGIBLE_FLICKER:
        return ExposureAdvice(own_s, "unchanged: it exposes well", usable_s)
    if period_s is None:
        return ExposureAdvice(longest_s, f"the longest {which}", usable_s)
    counts = [k for k in range(1, _MAX_PERIODS + 1) if shortest_s <= k * period_s <= 1.001 * longest_s]
    if not counts:
        reason = f"the longest {which}, less than {name} ({format_ms(period_s)})"
        return ExposureAdvice(longest_s, reason, usable_s)
    steady = [k for k in counts if flicker_share(k * period_s) <= _NEGLIGIBLE_FLICKER]
    count = steady[-1] if steady else min(counts, key=lambda k: flicker_share(k * period_s))
    return ExposureAdvice(count * period_s, f"{count} × {name} ({format_ms(period_s)})", usable_s)


def check_refresh_multiple(light: LightMeasurement, refresh_hz: float | None) -> list[Finding]:
    """Note an exposure that is not a multiple of the display's refresh period."""
    if refresh_hz is None or is_whole_periods(light.own_exposure_s, 1 / refresh_hz):
        return []
    period = format_ms(1 / refresh_hz)
    message = (
        f"its exposure of {format_ms(light.own_exposure_s)} is not a multiple of the display's refresh period, "
        f"{period}: it may record a part of the picture twice, or part of a colour cycle"
    )
    remedy = f"expose for a multiple of {period}; if that saturates, close the lens's aperture"
    return [note("exposure.refresh", camera_label(light.name), message, remedy)]


def is_whole_periods(exposure_s: float, period_s: float) -> bool:
    """True if an exposure is a whole number of periods, one or more.

    >>> is_whole_periods(0.0333, 1 / 60), is_whole_periods(0.02, 1 / 60), is_whole_periods(0.001, 1 / 60)
    (True, False, False)
    """
    periods = exposure_s / period_s
    return round(periods) >= 1 and abs(periods - round(periods)) <= _PERIOD_TOLERANCE


def _period_to_average(refresh_hz: float | None, flickers: Sequence[LightFlicker]) -> tuple[str, float | None]:
    if refresh_hz is not None:
        return "the refresh period", 1 / refresh_hz
    for source, name in (
        ("projector", "the period of the projector's flicker"),
        ("room", "the period of the room light's flicker"),
    ):
        # Whole periods of the slowest are whole periods of its harmonics.
        slowest_hz = min((each.frequency_hz for each in flickers if each.source == source), default=None)
        if slowest_hz is not None:
            return name, 1 / slowest_hz
    return "", None

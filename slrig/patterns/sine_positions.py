"""Sinusoids of three periods that number every position of an axis, the position that their phases give, and the lines
at which curves of equal position are drawn.

No two positions a period or more apart have similar phases: over a span of N periods, one more than the axis needs, the
other two sinusoids have N − 1 and N − √N periods. From one period to the next the phase of the third moves by 1/√N of a
turn, and every √N periods, when it comes round, that of the second has moved as far. All three are about as short, so
each contributes to the position, and light that other parts of the scene send back is spread evenly by all
(M. Gupta, S. K. Nayar, "Micro Phase Shifting", CVPR 2012).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from slrig.errors import PatternError
from slrig.model import FloatArray, LineShift, Sine, Size, sine_groups

_MIN_PERIODS = 3
"""Of the shortest sinusoid: with fewer the other two are one."""
_LEVELS, _MAX_LEVELS = 8, 64
_MIN_APART_TURNS = 1e-3  # of the phase of some period, between two positions with the same finest phase


class SinePosition(NamedTuple):
    """Position of phases.

    position_px : (…) float64, NaN where a phase is NaN. residual_turns : (…) float64, root mean square of the phases
    less those of the position.
    """

    position_px: FloatArray
    residual_turns: FloatArray


def sine_periods_px(extent_px: int, period_px: float) -> tuple[float, float, float]:
    """Return the periods of three sinusoids that number the positions 0 … extent − 1; the first is `period_px`.

    The phases of positions a period or more apart differ by at least 0.68/√N of a turn (Euclidean distance), N the
    number of periods of the first. The span is a period longer than the axis, so that its ends differ as well.

    >>> [round(period_px, 3) for period_px in sine_periods_px(1280, 12)]
    [12.0, 12.112, 13.224]
    """
    count = max(_MIN_PERIODS, math.ceil(extent_px / period_px) + 1)
    span_px = count * period_px
    return float(period_px), span_px / (count - 1), span_px / (count - max(2, round(math.sqrt(count))))


def sine_turns(light: ArrayLike) -> FloatArray:
    """Return the phase of evenly shifted sinusoids, turns from 0 to 1: c/period at position c.

    light : (steps, …) of shifts 0 … steps − 1, in any unit. Φ = arg Σ I_k exp(2πi k/steps)/2π.

    >>> sine_turns([1.0, 0.5, 0.0, 0.5])
    array(0.)
    """
    samples = np.asarray(light, dtype=np.float64)
    shifts = np.exp(2j * np.pi * np.arange(len(samples)) / len(samples))
    return np.asarray(np.angle(np.tensordot(shifts, samples, axes=1)) / (2 * np.pi) % 1.0)


def sine_position_px(turns: ArrayLike, periods_px: ArrayLike, extent_px: int) -> SinePosition:
    """Return the position on an axis that agrees best with the phases of several sinusoids.

    The shortest period gives a candidate per period. About each, at x₀, the others are resolved to the nearest turn,
    r_i = Φ_i − x₀/p_i, and least squares over all phases move it by Σ(r_i/p_i)/Σ(1/p_i²). The candidate with the
    smallest residuals is the position.

    turns : (sinusoids, …) phases c/period, whole turns do not matter. Positions are sought up to a quarter of the
    shortest period beyond the axis.

    >>> periods_px = sine_periods_px(1280, 12)
    >>> found = sine_position_px([700.25 / period_px for period_px in periods_px], periods_px, 1280)
    >>> round(float(found.position_px), 6)
    700.25
    """
    phases = np.asarray(turns, dtype=np.float64)
    rates = (1 / np.asarray(periods_px, dtype=np.float64)).reshape(-1, *(1,) * (phases.ndim - 1))
    finest = int(rates.argmax())
    period_px = 1 / float(rates.max())
    best_px, least = np.full(phases.shape[1:], np.nan), np.full(phases.shape[1:], np.inf)
    for number in range(-1, math.ceil(extent_px / period_px) + 1):
        start_px = period_px * (phases[finest] % 1.0 + number)
        residual = phases - start_px * rates
        residual -= np.rint(residual)
        moved_px = (residual * rates).sum(axis=0) / (rates**2).sum()
        cost = ((residual - moved_px * rates) ** 2).mean(axis=0)
        position_px = start_px + moved_px
        inside = (position_px >= -period_px / 4) & (position_px <= extent_px - 1 + period_px / 4)
        better = inside & (cost < least)
        best_px, least = np.where(better, position_px, best_px), np.where(better, cost, least)
    return SinePosition(best_px, np.where(np.isnan(best_px), np.nan, np.sqrt(least)))


def level_lines(sines: Sequence[Sine]) -> tuple[LineShift, ...]:
    """Lines one position wide, together at every position: the levels of the map of positions that sinusoids give.

    Their period is half of the finest sinusoid's, so that noise of the positions does not number them wrong.
    """
    half_px = sines[sine_groups(sines)[0][0]].period_px / 2
    period = min(_LEVELS * int(np.ceil((half_px + 2) / _LEVELS)), _MAX_LEVELS)
    return tuple(LineShift(sines[0].axis, shift, period, 1) for shift in range(period))


def require_numbered(sines: Sequence[Sine], size: Size) -> None:
    """Check that sinusoids without Gray code have a different set of phases at each position of the projector.

    sines : of one axis, at least one period with three shifts. Raises PatternError if they repeat.
    """
    axis, extent_px = sines[0].axis, size.along(sines[0].axis)
    finest_px = sines[sine_groups(sines)[0][0]].period_px
    others_px = np.array(sorted({each.period_px for each in sines} - {finest_px}))
    distance_px = finest_px * np.arange(1, int(np.ceil(extent_px / finest_px)))
    turns = distance_px[:, np.newaxis] / others_px
    apart = np.abs(turns - np.rint(turns)).max(axis=1, initial=0.0)
    if not (apart < _MIN_APART_TURNS).any():
        return
    repeat_px = distance_px[np.argmax(apart < _MIN_APART_TURNS)]
    periods = ", ".join(f"{each:g}" for each in sorted({each.period_px for each in sines}))
    message = (
        f"sinusoids of {periods} px repeat every {repeat_px:g} {axis}s, the projector has {extent_px} ({size}): they "
        "alone do not distinguish the periods. Add the frames of a Gray code, or of periods that do not repeat "
        f"within {extent_px}, one as long as the projector for example; or correct the periods"
    )
    raise PatternError(message)

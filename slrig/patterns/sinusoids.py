"""Positions that sinusoids number, and the lines at which curves of equal position are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slrig.errors import PatternError
from slrig.model import LineShift, Sine, Size, sine_groups

_LEVELS, _MAX_LEVELS = 8, 64
_MIN_APART_TURNS = 1e-3  # of the phase of some period, between two positions with the same finest phase


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
        "cannot tell the periods apart by themselves. Add the frames of a Gray code, or of periods that do not repeat "
        f"within {extent_px}, one as long as the projector for example; or correct the periods"
    )
    raise PatternError(message)

"""What a scan plays, which of it is used, and what is said of light that tells little."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slrig.errors import PatternError
from slrig.model import LEAST_SHARE, Axis, Calibration, Gray, LineShift, Pinhole, Size
from slrig.scan.light_axis import FAIR_SHARE, chosen_axis, played_axes, weakness
from slrig.scan.plan import PatternPlan
from slrig.scan.plan_check import pattern_sequence

BOTH = tuple(Axis)


def standing(x_mm: float, y_mm: float) -> Pinhole:
    matrix = np.array([[900.0, 0, 320], [0, 900.0, 240], [0, 0, 1.0]])
    return Pinhole(Size(640, 480), matrix, np.zeros(5), np.eye(3), -np.array([x_mm, y_mm, 0.0]))


def rig(*places_mm: tuple[float, float], projector: bool) -> Calibration:
    """Cameras a, b, … at these places, and a projector at the middle."""
    cameras = {name: standing(*place) for name, place in zip("abc", places_mm, strict=False)}
    return Calibration(cameras, standing(0.0, 0.0) if projector else None)


BESIDE = rig((100.0, 0.0), projector=True)
ABOVE = rig((0.0, 100.0), projector=True)
PAIR = rig((-60.0, 0.0), (60.0, 0.0), projector=False)
VERTICAL_PAIR = rig((0.0, -60.0), (0.0, 60.0), projector=False)


@pytest.mark.parametrize(
    ("calibration", "axis"),
    [(BESIDE, Axis.COLUMN), (ABOVE, Axis.ROW), (PAIR, Axis.COLUMN), (VERTICAL_PAIR, Axis.ROW), (None, Axis.COLUMN)],
)
def test_by_itself_a_scan_plays_the_axis_that_tells_depth(calibration: Calibration | None, axis: Axis) -> None:
    assert played_axes(None, calibration, "ab") == (axis,)
    assert played_axes(True, calibration, "ab") == BOTH


def test_the_cameras_of_the_rig_count_and_not_all_of_the_calibration() -> None:
    three = rig((0.0, 0.0), (50.0, 0.0), (0.0, 90.0), projector=False)
    assert played_axes(None, three, "abc") == (Axis.ROW,)
    assert played_axes(None, three, "ab") == (Axis.COLUMN,)
    assert played_axes(None, three, "xy") == (Axis.COLUMN,)


def test_an_axis_that_was_asked_for_is_played_and_used() -> None:
    assert played_axes(None, PAIR, "ab", axis=Axis.ROW) == (Axis.ROW,)
    assert played_axes(None, None, "ab", axis=Axis.ROW) == (Axis.ROW,)
    assert played_axes(True, PAIR, "ab", axis=Axis.ROW) == BOTH
    assert played_axes(False, BESIDE, "a", axis=Axis.COLUMN) == (Axis.COLUMN,)
    with pytest.raises(PatternError, match="leave one of them out"):
        played_axes(False, PAIR, "ab", axis=Axis.ROW)
    with pytest.raises(PatternError, match=r"rows alone.* beside the projector"):
        played_axes(None, BESIDE, "a", axis=Axis.ROW)


def test_columns_that_were_asked_for_are_played_unless_they_tell_nothing() -> None:
    slanting = rig((math.sin(math.radians(13)), math.cos(math.radians(13))), projector=True)
    assert played_axes(False, slanting, "a") == (Axis.COLUMN,)
    # Without a projector nobody knows yet how the stripes will lie.
    assert played_axes(False, VERTICAL_PAIR, "ab") == (Axis.COLUMN,)
    with pytest.raises(PatternError, match=r"columns alone.* above or below the projector.*--rows"):
        played_axes(False, ABOVE, "a")


def test_of_both_axes_the_better_one_is_used_and_of_one_that() -> None:
    for calibration, better in ((ABOVE, Axis.ROW), (VERTICAL_PAIR, Axis.ROW), (BESIDE, Axis.COLUMN)):
        devices = list(calibration.cameras.values())
        assert chosen_axis(BOTH, devices, calibration.projector) is better
        assert chosen_axis((better,), devices, calibration.projector) is better
    assert chosen_axis((Axis.COLUMN,), list(VERTICAL_PAIR.cameras.values()), None) is Axis.COLUMN
    with pytest.raises(PatternError, match=r"rows alone.* beside the projector"):
        chosen_axis((Axis.ROW,), list(BESIDE.cameras.values()), BESIDE.projector)


def test_a_weak_crossing_is_told_in_degrees_with_its_price_and_its_cure() -> None:
    assert weakness(Axis.COLUMN, BOTH, FAIR_SHARE) is None
    told = weakness(Axis.COLUMN, (Axis.COLUMN,), 0.25)
    assert told is not None
    assert "at 14° only" in told
    assert "4.0 times" in told
    assert "Scan with both axes: rows (--rows)" in told
    assert "45°" in (weakness(Axis.ROW, BOTH, LEAST_SHARE) or "")
    assert "more than 100 times" in (weakness(Axis.ROW, BOTH, 0.0) or "")


@pytest.mark.parametrize(
    ("rows", "calibration", "axes"),
    [(None, ABOVE, {Axis.ROW}), (None, BESIDE, {Axis.COLUMN}), (None, None, {Axis.COLUMN}), (True, ABOVE, set(Axis))],
)
def test_a_sequence_holds_the_patterns_of_these_axes_and_no_others(
    rows: bool | None, calibration: Calibration | None, axes: set[Axis]
) -> None:
    sequence = pattern_sequence(PatternPlan(rows=rows), Size(64, 48), calibration, "a")
    coded = [pattern for pattern in sequence.patterns if isinstance(pattern, Gray | LineShift)]
    assert {pattern.axis for pattern in coded} == axes
    assert {pattern.axis for pattern in coded if isinstance(pattern, LineShift)} == axes
    assert len(coded) == len(sequence) - 4

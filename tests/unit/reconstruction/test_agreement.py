"""Cameras that contradict each other are told from cameras that are as good as they say."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.model import FloatArray
from slrig.reconstruction.agreement import FEWEST_POINTS, Disagreement, disagreement
from slrig.reconstruction.merging import MergedCurves
from slrig.reconstruction.triangulation import SheetCurves

NOISE_MM = 0.02


def met(offset_mm: float, *, points: int = 5000, outlying: float = 0.0) -> MergedCurves:
    """Two cameras whose noise is stated, and whose points are offset_mm apart; some see two different things."""
    rng = np.random.default_rng(4)
    apart = offset_mm + rng.normal(0, NOISE_MM, points)
    apart[: round(outlying * points)] = 20.0
    none: SheetCurves = None  # type: ignore[assignment] # nothing of the curves is asked
    return MergedCurves(none, np.zeros(0, dtype=np.int32), apart / NOISE_MM, apart)


def share(value_mm: float) -> FloatArray:
    return np.full(100, value_mm)


@pytest.mark.parametrize("outlying", [0.0, 0.2])
def test_cameras_that_agree_within_their_noise_say_nothing(outlying: float) -> None:
    assert disagreement(met(0.0, outlying=outlying), None) is None
    assert disagreement(met(0.0, outlying=outlying), share(0.1)) is None


@pytest.mark.parametrize("offset_mm", [0.5, -0.5])
def test_cameras_that_contradict_each_other_are_told_by_how_much(offset_mm: float) -> None:
    found = disagreement(met(offset_mm, outlying=0.1), None)
    assert found is not None
    assert found.apart_mm == pytest.approx(0.5, rel=0.02)
    # 25 deviations apart, on the scale on which noise alone has 1.
    assert found.over_sigma == pytest.approx(1.4826 * 25, rel=0.03)
    assert found.sigma_mm == found.apart_mm
    assert "0.50" in str(found)
    assert "calibrate again" in str(found)


def test_an_error_that_the_calibration_states_is_no_contradiction() -> None:
    assert disagreement(met(0.2), share(0.15)) is None
    assert isinstance(disagreement(met(0.2), share(0.02)), Disagreement)


def test_few_points_that_both_see_say_nothing() -> None:
    assert disagreement(met(0.5, points=FEWEST_POINTS - 1), None) is None
    nothing = met(0.0)
    same = MergedCurves(nothing.curves, nothing.camera, 0 * nothing.residual_sigma, 0 * nothing.residual_mm)
    assert disagreement(same, None) is None

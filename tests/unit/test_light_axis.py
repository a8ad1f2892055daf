"""The axis of light that tells depth, against how far a point's image moves when its depth changes."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from slrig.model import Axis, FloatArray, Pinhole, Size, share_across, told_depth, triangulated_axis

MIDDLE_MM = np.array([0.0, 0.0, 600.0])


def standing(
    x_mm: float, y_mm: float, *, roll_deg: float = 0.0, focal_px: tuple[float, float] = (900.0, 900.0)
) -> Pinhole:
    """A device that looks along z from (x, y, 0), turned about its view."""
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, math.radians(roll_deg)]))
    matrix = np.array([[focal_px[0], 0, 320], [0, focal_px[1], 240], [0, 0, 1.0]])
    return Pinhole(Size(640, 480), matrix, np.zeros(5), turn, -turn @ np.array([x_mm, y_mm, 0.0]))


def moved_px(seen_by: Pinhole, other: Pinhole) -> FloatArray:
    """(2,): by how much the image of a point moves in a device when the point moves along the other device's ray."""

    def pixel(point_mm: FloatArray) -> FloatArray:
        x, y, z = seen_by.rotation @ point_mm + seen_by.translation_mm
        return np.array([x / z, y / z])

    return np.abs(pixel(MIDDLE_MM + 1e-3 * (MIDDLE_MM - other.centre_mm)) - pixel(MIDDLE_MM))


@pytest.mark.parametrize(("projector_known", "roll_deg"), [(True, 0.0), (True, 30.0), (False, 90.0), (False, 200.0)])
@pytest.mark.parametrize(("x_mm", "y_mm"), [(120.0, 0.0), (-110.0, 40.0), (10.0, 130.0), (0.0, -90.0), (-70.0, -75.0)])
def test_the_axis_is_the_one_along_which_depth_shows(
    x_mm: float, y_mm: float, roll_deg: float, *, projector_known: bool
) -> None:
    one, two = standing(0.0, 0.0, roll_deg=roll_deg), standing(x_mm, y_mm)
    cameras, projector = ([two], one) if projector_known else ([one, two], None)
    across, down = moved_px(one, two)
    assert triangulated_axis(cameras, projector) is (Axis.COLUMN if across > down else Axis.ROW)
    for axis, moved in ((Axis.COLUMN, across), (Axis.ROW, down)):
        assert share_across(axis, cameras, projector) == pytest.approx(moved / math.hypot(across, down), abs=1e-9)


def test_finer_rows_do_not_make_a_sheet_of_them_steeper() -> None:
    diamond = standing(0.0, 0.0, focal_px=(900.0, 1800.0))
    assert triangulated_axis([standing(100.0, 60.0)], diamond) is Axis.COLUMN
    assert share_across(Axis.ROW, [standing(100.0, 60.0)], diamond) == pytest.approx(60 / math.hypot(100, 60))


def test_with_a_projector_all_cameras_decide_by_what_they_resolve() -> None:
    projector = standing(0.0, 0.0)
    assert triangulated_axis([standing(0.0, 50.0), standing(300.0, 0.0)], projector) is Axis.COLUMN
    # Seven times the resolution outweighs six times the baseline.
    sharp = standing(0.0, 50.0, focal_px=(6300.0, 6300.0))
    assert triangulated_axis([sharp, standing(300.0, 0.0)], projector) is Axis.ROW
    two = [standing(0.0, 60.0), standing(80.0, 0.0)]
    assert share_across(Axis.ROW, two, projector) == pytest.approx(0.6)


def test_axis_gives_depth_to_cameras_with_a_baseline_across_it() -> None:
    cameras, projector = [standing(10.0, 90.0), standing(80.0, 80.0), standing(120.0, 0.0)], standing(0.0, 0.0)
    assert told_depth(Axis.COLUMN, cameras, projector) == [False, True, True]
    assert told_depth(Axis.ROW, cameras, projector) == [True, True, False]
    assert told_depth(Axis.ROW, cameras[2:], projector) == [True]


def test_of_several_cameras_the_longest_baseline_of_the_first_decides() -> None:
    cameras = [standing(0.0, 0.0), standing(80.0, 0.0), standing(0.0, 120.0)]
    assert triangulated_axis(cameras, None) is Axis.ROW
    assert triangulated_axis(cameras[:2], None) is Axis.COLUMN
    assert share_across(Axis.ROW, cameras, None) == 1.0
    # Without a baseline columns are as good as rows.
    assert triangulated_axis(cameras[:1], None) is triangulated_axis(cameras[:1] * 2, None) is Axis.COLUMN

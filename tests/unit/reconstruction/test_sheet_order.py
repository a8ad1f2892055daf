"""Selection of points of curves, order of stripes along the sheet, and standard deviations in space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Axis
from slrig.reconstruction.triangulation import SheetCurves, order_along_sheet, select_points
from slrig.reconstruction.uncertainty import sampling_mm, sigma_along_normal
from tests.unit.reconstruction.builders import CAMERA, PROJECTOR


def curves_of(
    *curves: list[tuple[int, list[float]]], bridges: bool = True, position_px: list[float] | None = None
) -> SheetCurves:
    """Curves as lists of (stripe, rows); points are told apart by x = 100·stripe + index within the stripe."""
    along: list[float] = []
    stripe: list[int] = []
    rank: list[int] = []
    bridge: list[bool] = []
    counts = [0]
    for curve in curves:
        for place, (number, rows) in enumerate(curve):
            along += rows
            stripe += [number] * len(rows)
            rank += range(len(rows))
            bridge += [False] * (len(rows) - 1) + [bridges and place < len(curve) - 1]
        counts.append(len(along))
    count = len(along)
    points = np.zeros((count, 3))
    points[:, 0] = 100.0 * np.array(stripe) + np.array(rank)
    return SheetCurves(
        offsets=np.array(counts, dtype=np.int32),
        position_px=np.array(position_px or [8.0 * index for index in range(len(curves))]),
        points_mm=points,
        deviation_mm=points + 1000,
        along_px=np.array(along, dtype=np.float64),
        pixels_px=points[:, :2] + 0.5,
        stripe=np.array(stripe, dtype=np.int32),
        bridge_after=np.array(bridge, dtype=np.bool_),
        source=(np.arange(count) % 3).astype(np.uint8),
    )


def point_ids(curves: SheetCurves) -> list[int]:
    return [int(x) for x in curves.points_mm[:, 0]]


def keeping(count: int, *left_out: int) -> NDArray[np.bool_]:
    keep = np.ones(count, dtype=np.bool_)
    keep[list(left_out)] = False
    return keep


def test_points_are_left_out_with_all_that_belongs_to_them() -> None:
    curves = curves_of([(0, [1.0, 2.0, 3.0])], [(1, [1.0, 2.0])])
    kept = select_points(curves, keeping(5, 1, 3))
    assert point_ids(kept) == [0, 2, 101]
    assert kept.offsets.tolist() == [0, 2, 3]
    np.testing.assert_array_equal(kept.deviation_mm[:, 0], [1000, 1002, 1101])
    np.testing.assert_array_equal(kept.pixels_px[:, 0], [0.5, 2.5, 101.5])
    assert kept.along_px.tolist() == [1.0, 3.0, 2.0]
    assert kept.stripe.tolist() == [0, 0, 1]
    assert kept.source.tolist() == [0, 2, 1]
    assert kept.position_px.tolist() == [0.0, 8.0]


Curve = list[tuple[int, list[float]]]
TWO: list[Curve] = [[(0, [1.0, 2.0, 3.0]), (1, [7.0, 8.0, 9.0])]]
THREE: list[Curve] = [[(0, [1.0, 2.0]), (1, [5.0]), (2, [9.0, 10.0])]]
PAIR: list[Curve] = [[(0, [1.0, 2.0]), (1, [5.0, 6.0])], [(2, [1.0, 2.0]), (3, [5.0, 6.0])]]


@pytest.mark.parametrize(
    ("curves", "left_out", "bridges"),
    [
        (TWO, [], [2]),
        (TWO, [2], [1]),
        (TWO, [1, 2, 3], [0]),
        (TWO, [3], [2]),
        (THREE, [2], [1]),
        # What follows the bridge is left out, so the curve ends before it.
        (PAIR, [2, 3], [3]),
        (PAIR, [4, 5], [1]),
    ],
)
def test_a_bridge_is_carried_to_the_last_point_before_it_that_stays_and_never_out_of_a_curve(
    curves: list[Curve], left_out: list[int], bridges: list[int]
) -> None:
    made = curves_of(*curves)
    kept = select_points(made, keeping(len(made.points_mm), *left_out))
    assert np.flatnonzero(kept.bridge_after).tolist() == bridges


@pytest.mark.parametrize(
    ("curves", "points", "bridges"),
    [
        (
            [[(0, [50.0, 51.0, 52.0]), (1, [10.0, 11.0]), (2, [30.0, 31.0])], [(3, [5.0, 6.0])]],
            [100, 101, 200, 201, 0, 1, 2, 300, 301],
            [1, 3],
        ),
        # A stripe that runs upwards is turned.
        ([[(0, [9.0, 8.0, 7.0, 6.0]), (1, [1.0, 2.0, 3.0])]], [100, 101, 102, 3, 2, 1, 0], [2]),
        # Row noise of one point is no reason to fold the curve.
        ([[(0, [1.0, 2.2, 2.1, 3.0, 4.0])]], [0, 1, 2, 3, 4], []),
        ([[(0, [4.0])], [], [(1, [9.0]), (2, [2.0])]], [0, 200, 100], [1]),
        ([], [], []),
    ],
)
def test_stripes_of_a_curve_follow_one_another_by_row(
    curves: list[Curve], points: list[int], bridges: list[int]
) -> None:
    made = curves_of(*curves)
    ordered = order_along_sheet(made)
    assert point_ids(ordered) == points
    assert ordered.offsets.tolist() == made.offsets.tolist()
    assert np.flatnonzero(ordered.bridge_after).tolist() == bridges
    np.testing.assert_array_equal(ordered.deviation_mm, ordered.points_mm + 1000)
    # What is in order is left as it is.
    again = order_along_sheet(ordered)
    assert point_ids(again) == points
    np.testing.assert_array_equal(again.bridge_after, ordered.bridge_after)


def test_keeping_everything_or_nothing() -> None:
    curves = curves_of([(0, [1.0, 2.0]), (1, [5.0, 6.0])], [(2, [1.0])])
    same = select_points(curves, keeping(5))
    assert point_ids(same) == point_ids(curves)
    np.testing.assert_array_equal(same.bridge_after, curves.bridge_after)
    none = select_points(curves, np.zeros(5, dtype=np.bool_))
    assert none.offsets.tolist() == [0, 0, 0]
    assert len(none.points_mm) == len(none.bridge_after) == 0


def test_only_the_part_of_an_error_along_the_normal_counts() -> None:
    deviation = np.array([[0.3, 0.0, 0.4], [0.3, 0.0, 0.4], [0.3, 0.0, -0.4], [0.3, 0.0, 0.4]])
    normals = np.array([[0, 0, 1], [1, 0, 0], [0.6, 0, 0.8], [np.nan] * 3], dtype=np.float32)
    np.testing.assert_allclose(sigma_along_normal(deviation, normals), [0.4, 0.3, 0.14, 0.5], atol=1e-7)


@pytest.mark.parametrize("depth_mm", [300.0, 900.0])
def test_sampling_is_what_a_pixel_or_a_line_covers(depth_mm: float) -> None:
    ahead = CAMERA.centre_mm + depth_mm * CAMERA.rotation[2]
    pixel = depth_mm / 1400.0
    np.testing.assert_allclose(sampling_mm(ahead[None], CAMERA, None, Axis.COLUMN, 1.0), [pixel])
    before_projector = float(PROJECTOR.rotation[2] @ ahead + PROJECTOR.translation_mm[2])
    line = before_projector / 680.0
    np.testing.assert_allclose(sampling_mm(ahead[None], CAMERA, PROJECTOR, Axis.COLUMN, 4.0), [max(pixel, 4 * line)])
    np.testing.assert_allclose(sampling_mm(ahead[None], CAMERA, PROJECTOR, Axis.COLUMN, 0.1), [max(pixel, 0.1 * line)])


@pytest.mark.parametrize(
    ("axis", "camera_px", "projector_px"), [(Axis.COLUMN, 1400.0, 680.0), (Axis.ROW, 1395.0, 1368.0)]
)
def test_sampling_is_measured_along_the_axis_that_is_scanned(axis: Axis, camera_px: float, projector_px: float) -> None:
    # Rows twice as fine as columns, as on a diamond array of mirrors.
    fine_rows = replace(PROJECTOR, matrix=PROJECTOR.matrix * np.array([[1.0], [2.0], [1.0]]))
    ahead = CAMERA.centre_mm + 500.0 * CAMERA.rotation[2]
    depth = float(PROJECTOR.rotation[2] @ ahead + PROJECTOR.translation_mm[2])
    found = [sampling_mm(ahead[None], CAMERA, device, axis, 3.0) for device in (None, fine_rows)]
    np.testing.assert_allclose(found, [[3 * 500.0 / camera_px], [3 * depth / projector_px]])

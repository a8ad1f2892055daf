"""Camera ray with light sheet: points projected by OpenCV come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.model import Axis, FloatArray, Pinhole, Refusal, Size, Source
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.triangulation import triangulate_camera_projector
from tests.unit.reconstruction.builders import (
    BALL,
    CAMERA,
    PROJECTOR,
    ensemble_of,
    looking,
    opencv_pixels,
    seen_on_ball,
)


def scattered_points(*, count: int = 300) -> FloatArray:
    """World points before all devices, near the ball's surface and away from it."""
    return np.random.default_rng(1).uniform([-55, -40, -60], [55, 40, 120], (count, 3))


def one_point_each(points_mm: FloatArray, *, axis: Axis = Axis.COLUMN) -> tuple[StripeEnsemble, FloatArray]:
    """A curve per point, at its exact projector position; the points in that order."""
    lit = opencv_pixels(PROJECTOR, points_mm)
    position = lit[:, 0 if axis is Axis.COLUMN else 1]
    order = np.argsort(position)
    pixels = opencv_pixels(CAMERA, points_mm)[order]
    return ensemble_of(list(pixels[:, None, :]), position[order].tolist()), points_mm[order]


@pytest.mark.parametrize("axis", list(Axis))
def test_points_seen_through_two_distorted_lenses_come_back(axis: Axis) -> None:
    ensemble, truth = one_point_each(scattered_points(), axis=axis)
    curves, _ = triangulate_camera_projector(ensemble, CAMERA, PROJECTOR, axis)
    assert len(curves.points_mm) == len(truth)
    np.testing.assert_allclose(curves.points_mm, truth, rtol=0, atol=1e-6)
    along = opencv_pixels(PROJECTOR, truth)[:, 1 if axis is Axis.COLUMN else 0]
    np.testing.assert_allclose(curves.along_px, along, rtol=0, atol=1e-6)
    assert (curves.source == Source.CAMERA_PROJECTOR).all()


def test_a_strongly_distorted_projector_is_met_exactly() -> None:
    # The same sheet as a plane would be wrong by millimetres at the corners.
    strong = replace(PROJECTOR, distortion=np.array([-0.45, 0.21, 4e-3, -3e-3, 0.0]))
    points = scattered_points()
    lit = opencv_pixels(strong, points)
    order = np.argsort(lit[:, 0])
    ensemble = ensemble_of(list(opencv_pixels(CAMERA, points)[order][:, None, :]), lit[order, 0].tolist())
    curves, _ = triangulate_camera_projector(ensemble, CAMERA, strong, Axis.COLUMN)
    np.testing.assert_allclose(curves.points_mm, points[order], rtol=0, atol=1e-6)
    plain, _ = triangulate_camera_projector(ensemble, CAMERA, replace(strong, distortion=np.zeros(5)), Axis.COLUMN)
    assert np.abs(plain.points_mm - points[order][: len(plain.points_mm)]).max() > 1.0


def test_curves_on_a_ball_lie_on_the_ball_in_order_of_rows() -> None:
    rows = np.arange(60.0, 180.0, 1.7)
    columns = [100.0, 131.5, 160.0, 190.25]
    curves, _ = triangulate_camera_projector(seen_on_ball(CAMERA, columns, rows), CAMERA, PROJECTOR, Axis.COLUMN)
    assert np.abs(BALL.distance_mm(curves.points_mm)).max() < 1e-6
    assert curves.position_px.tolist() == columns
    assert np.diff(curves.offsets).tolist() == [len(rows)] * 4
    np.testing.assert_allclose(curves.along_px, np.tile(rows, 4), atol=1e-6)
    assert curves.curve_of_point().tolist() == np.repeat(range(4), len(rows)).tolist()


def test_the_deviation_is_how_far_the_point_moves_with_its_stripe() -> None:
    rows = np.arange(70.0, 170.0, 9.0)
    ensemble = seen_on_ball(CAMERA, [120.0, 170.0], rows)
    rng = np.random.default_rng(2)
    angle = rng.uniform(-0.5, 0.5, len(ensemble.points_px))
    ensemble = ensemble._replace(
        normals=np.stack([np.cos(angle), np.sin(angle)], axis=1),
        sigma_px=rng.uniform(0.01, 0.05, len(ensemble.points_px)),
    )
    curves, _ = triangulate_camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    moved = []
    for sign in (1, -1):
        aside = ensemble.points_px + sign * ensemble.sigma_px[:, None] * ensemble.normals
        moved.append(
            triangulate_camera_projector(ensemble._replace(points_px=aside), CAMERA, PROJECTOR, Axis.COLUMN)[
                0
            ].points_mm
        )
    np.testing.assert_allclose(curves.deviation_mm, (moved[0] - moved[1]) / 2, rtol=1e-3, atol=1e-7)
    # Depth resolution of the rig: Z²/(f b) per pixel.
    assert 0.5 < np.linalg.norm(curves.deviation_mm, axis=1).mean() / (0.03 * 520**2 / (1400 * 150)) < 2.0


def test_points_where_the_projectors_distortion_is_not_monotonic_are_refused() -> None:
    # x (1 - 0.5 r²) turns back at r = 0.82; points beyond have positions in the image all the same, but no light.
    camera = looking((-90.0, 0.0, -500.0), (0.0, 150.0, 0.0), size=Size(640, 480), focal_px=(300.0, 300.0),
                     distortion=(0.0, 0.0, 0.0, 0.0, 0.0))  # fmt: skip
    barrel = looking((60.0, 0.0, -500.0), (60.0, 0.0, 0.0), size=Size(320, 240), focal_px=(200.0, 200.0),
                     distortion=(-0.5, 0.0, 0.0, 0.0, 0.0))  # fmt: skip
    for down, lit in ((np.linspace(0.2, 0.7, 9), True), (np.linspace(0.9, 1.2, 9), False)):
        points = barrel.centre_mm + 500 * np.column_stack([np.full(9, 0.1), down, np.ones(9)])
        at = opencv_pixels(barrel, points)
        assert ((at > 0) & (at < [319, 239])).all()
        order = np.argsort(at[:, 0])
        ensemble = ensemble_of(list(opencv_pixels(camera, points)[order][:, None, :]), at[order, 0].tolist())
        curves, cause = triangulate_camera_projector(ensemble, camera, barrel, Axis.COLUMN)
        assert set(cause.tolist()) == {Refusal.NONE if lit else Refusal.NO_INTERSECTION}
        np.testing.assert_allclose(curves.points_mm, points[order][: 9 * lit], rtol=0, atol=1e-6)


def test_a_ray_that_runs_along_its_light_sheet_meets_it_nowhere() -> None:
    # Both without distortion, and the projector straight ahead of the camera: the baseline lies in the sheet.
    straight = Pinhole(CAMERA.size, np.array([[1000.0, 0, 320], [0, 1000.0, 240], [0, 0, 1]]), np.zeros(5), np.eye(3),
                       np.array([0.0, 0.0, 400.0]))  # fmt: skip
    ahead = replace(straight, translation_mm=np.array([0.0, 0.0, 300.0]))
    ensemble = ensemble_of([np.array([[320.0, 200.0], [320.0, 300.0], [350.0, 240.0]])], [320.0])
    curves, cause = triangulate_camera_projector(ensemble, straight, ahead, Axis.COLUMN)
    # The third ray leaves the sheet at the camera's own centre.
    assert cause.tolist() == [Refusal.NO_INTERSECTION, Refusal.NO_INTERSECTION, Refusal.BEHIND_DEVICE]
    assert len(curves.points_mm) == 0


def test_points_lit_by_no_row_of_the_projector_are_left_out() -> None:
    # A projector half as high would not have lit rows below its last.
    rows = np.arange(60.0, 180.0, 5.0)
    cut = replace(PROJECTOR, size=replace(PROJECTOR.size, height_px=121))
    curves, cause = triangulate_camera_projector(seen_on_ball(CAMERA, [140.0, 160.0], rows), CAMERA, cut, Axis.COLUMN)
    kept = rows[rows < 120 + 2]
    np.testing.assert_allclose(curves.along_px, np.tile(kept, 2), atol=1e-6)
    expected = np.where(rows < 120 + 2, Refusal.NONE, Refusal.OFF_PROJECTOR)
    assert cause.tolist() == np.tile(expected, 2).tolist()


def test_unmeasured_pixels_give_no_points() -> None:
    ensemble = seen_on_ball(CAMERA, [140.0], np.arange(60.0, 180.0, 5.0))
    ensemble.points_px[3] = np.nan
    curves, cause = triangulate_camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    assert cause.tolist() == [Refusal.NO_INTERSECTION if index == 3 else Refusal.NONE for index in range(24)]
    assert len(curves.points_mm) == 23
    assert np.isfinite(curves.points_mm).all()


def test_bridges_remain_and_stripes_follow_by_row() -> None:
    rows = np.concatenate([np.arange(60.0, 80.0), np.arange(120.0, 150.0), np.arange(95.0, 110.0)])
    ensemble = seen_on_ball(CAMERA, [140.0], rows)
    curves, _ = triangulate_camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    np.testing.assert_allclose(curves.along_px, np.sort(rows), atol=1e-6)
    assert curves.stripe.tolist() == [0] * 20 + [2] * 15 + [1] * 30
    assert np.flatnonzero(curves.bridge_after).tolist() == [19, 34]

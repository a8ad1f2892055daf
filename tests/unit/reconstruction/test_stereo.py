"""Camera ray with the same code in another camera; the projector's calibration plays no part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.model import FloatArray, Pinhole, Size
from slrig.reconstruction.triangulation import triangulate_camera_pair, triangulate_camera_pairs
from tests.unit.reconstruction.builders import (
    BALL,
    CAMERA,
    OTHER_CAMERA,
    PROJECTOR,
    lit_rows,
    looking,
    opencv_pixels,
    seen_on_ball,
)

# Rigs with a calibrated projector need none of these kernels.
pytestmark = pytest.mark.slow

ROWS = np.arange(60.0, 180.0, 1.3)
COLUMNS = [110.0, 138.5, 166.0, 190.0]
# The baseline to this one runs obliquely: epipolar lines cross the stripes at about 45°.
OBLIQUE_CAMERA = looking(
    (80.0, 190.0, -490.0), (0.0, 0.0, 0.0), size=Size(640, 480), focal_px=(1380.0, 1390.0),
    distortion=(-0.15, 0.05, -5e-4, 6e-4, 0.0),
)  # fmt: skip


def test_the_other_curve_is_crossed_between_its_points() -> None:
    other = seen_on_ball(OTHER_CAMERA, COLUMNS, ROWS + 0.55)
    curves, _ = triangulate_camera_pair(seen_on_ball(CAMERA, COLUMNS, ROWS), other, CAMERA, OTHER_CAMERA)
    assert len(curves.points_mm) == len(COLUMNS) * (len(ROWS) - 1)
    assert np.abs(BALL.distance_mm(curves.points_mm)).max() < 2e-3


def test_curves_run_by_the_rows_of_the_first_camera() -> None:
    backwards = seen_on_ball(CAMERA, COLUMNS, ROWS[::-1].copy())
    curves, _ = triangulate_camera_pair(backwards, seen_on_ball(OTHER_CAMERA, COLUMNS, ROWS), CAMERA, OTHER_CAMERA)
    assert (np.diff(curves.along_px)[np.diff(curves.curve_of_point()) == 0] > 0).all()
    np.testing.assert_array_equal(curves.along_px, curves.pixels_px[:, 1])


def test_codes_of_a_single_camera_give_no_points() -> None:
    first, second = (
        seen_on_ball(CAMERA, [110.0, 138.5, 166.0], ROWS),
        seen_on_ball(OTHER_CAMERA, [138.5, 150.0, 166.0, 190.0], ROWS),
    )
    curves, _ = triangulate_camera_pair(first, second, CAMERA, OTHER_CAMERA)
    assert curves.position_px.tolist() == [110.0, 138.5, 166.0]
    assert np.diff(curves.offsets)[0] == 0
    assert (np.diff(curves.offsets)[1:] > 80).all()
    assert np.abs(BALL.distance_mm(curves.points_mm)).max() < 1e-4


def test_bridges_are_not_crossed() -> None:
    gap = (ROWS < 100) | (ROWS > 130)
    second = seen_on_ball(OTHER_CAMERA, [138.5], ROWS[gap])
    curves, _ = triangulate_camera_pair(seen_on_ball(CAMERA, [138.5], ROWS), second, CAMERA, OTHER_CAMERA)
    met = opencv_pixels(CAMERA, lit_rows(138.5, ROWS, BALL))[:, 1]
    hidden = met[~gap]
    assert len(curves.points_mm) > 50
    assert not ((curves.pixels_px[:, 1] > hidden.min() - 0.1) & (curves.pixels_px[:, 1] < hidden.max() + 0.1)).any()


def test_beyond_the_other_cameras_curve_there_is_no_point() -> None:
    second = seen_on_ball(OTHER_CAMERA, [138.5], ROWS[30:60])
    curves, matched = triangulate_camera_pair(seen_on_ball(CAMERA, [138.5], ROWS), second, CAMERA, OTHER_CAMERA)
    assert 28 <= len(curves.points_mm) <= 30
    assert np.count_nonzero(matched) == np.count_nonzero(matched[30:60]) == len(curves.points_mm)


@pytest.mark.parametrize("other", [OTHER_CAMERA, OBLIQUE_CAMERA], ids=["beside", "oblique"])
def test_the_deviation_adds_the_errors_of_both_cameras(other: Pinhole) -> None:
    first = seen_on_ball(CAMERA, COLUMNS, ROWS[2:-2], sigma_px=0.02)
    second = seen_on_ball(other, COLUMNS, ROWS + 0.2, sigma_px=0.02)
    curves, _ = triangulate_camera_pair(first, second, CAMERA, other)
    assert len(curves.points_mm) == len(first.points_px)

    def moved(mine: float, theirs: float) -> FloatArray:
        a = first._replace(points_px=first.points_px + mine * first.normals)
        b = second._replace(points_px=second.points_px + theirs * second.normals)
        return triangulate_camera_pair(a, b, CAMERA, other)[0].points_mm

    own = (moved(0.02, 0.0) - moved(-0.02, 0.0)) / 2
    others = (moved(0.0, 0.02) - moved(0.0, -0.02)) / 2
    wanted = np.sqrt((own**2).sum(axis=1) + (others**2).sum(axis=1))
    stated = np.linalg.norm(curves.deviation_mm, axis=1)
    np.testing.assert_allclose(stated, wanted, rtol=0.1)
    towards = np.abs((curves.deviation_mm * own).sum(axis=1)) / (stated * np.linalg.norm(own, axis=1))
    assert towards.min() > 0.9


def test_a_camera_without_parallax_gives_nothing() -> None:
    # Both at one place: every ray meets every other at the centre only.
    turned = replace(CAMERA, matrix=CAMERA.matrix * [[1.05], [1.05], [1.0]])
    curves, _ = triangulate_camera_pair(
        seen_on_ball(CAMERA, COLUMNS, ROWS), seen_on_ball(turned, COLUMNS, ROWS), CAMERA, turned
    )
    assert len(curves.points_mm) == 0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_several_cameras_the_most_exact_meets_a_point_and_others_fill_in_what_it_does_not_see(
    order: tuple[int, int],
) -> None:
    near = replace(OTHER_CAMERA, translation_mm=OTHER_CAMERA.translation_mm + np.array([1.0, 0.0, 0.0]))
    others = [
        # More points, and each is less exact.
        (seen_on_ball(near, COLUMNS, ROWS[ROWS > 80] + 0.55, sigma_px=0.2), near),
        (seen_on_ball(OTHER_CAMERA, COLUMNS, ROWS[ROWS < 150] + 0.55), OTHER_CAMERA),
    ]
    first = seen_on_ball(CAMERA, COLUMNS, ROWS)
    curves, partner, matched = triangulate_camera_pairs(first, CAMERA, [others[index] for index in order])
    assert matched.mean() > 0.97
    assert len(partner) == len(curves.points_mm) == np.count_nonzero(matched)
    assert np.abs(BALL.distance_mm(curves.points_mm)).max() < 2e-3
    rows = opencv_pixels(PROJECTOR, curves.points_mm)[:, 1]
    assert (partner[rows < 147] == order.index(1)).all()
    assert (partner[rows > 152] == order.index(0)).all()
    within = np.diff(curves.curve_of_point()) == 0
    assert (np.diff(curves.along_px)[within] > 0).all()

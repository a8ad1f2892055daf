"""Where vertices fall, against OpenCV's own projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slrig.model import Pinhole, Size
from slrig.scan import placing
from slrig.scan.placing import placed_vertices, resampled

ROTATION = np.asarray(cv2.Rodrigues(np.array((0.1, -0.2, 0.05)))[0], dtype=np.float64)
CAMERA = Pinhole(
    Size(640, 480),
    np.array([[500, 0.0, 310], [0, 510, 250], [0, 0, 1]], dtype=np.float64),
    np.array((-0.2, 0.06, 0.001, -0.002, 0.01)),
    ROTATION,
    np.array((10.0, -20.0, 30.0)),
)
POINTS = np.random.default_rng(3).uniform((-100, -100, 300), (100, 100, 500), (1000, 3)).astype(np.float32)


@pytest.mark.parametrize("at_once", [64, 10_000])
@pytest.mark.parametrize("per_px", [2.0, 0.4])
def test_vertices_fall_where_opencv_has_them(monkeypatch: pytest.MonkeyPatch, at_once: int, per_px: float) -> None:
    monkeypatch.setattr(placing, "_AT_ONCE", at_once)
    pixels, _ = cv2.projectPoints(
        POINTS.astype(np.float64), cv2.Rodrigues(ROTATION)[0], CAMERA.translation_mm, CAMERA.matrix, CAMERA.distortion
    )
    device = resampled(CAMERA, per_px, Size(round(640 * per_px), round(480 * per_px)))
    placed = placed_vertices(POINTS, device)
    # The left border of the first pixel, at -0.5, is one place in both.
    assert placed[:, :2] == pytest.approx((pixels.reshape(-1, 2) + 0.5) * per_px - 0.5, abs=1e-3)
    assert placed[:, 2] == pytest.approx((POINTS @ ROTATION.T + CAMERA.translation_mm)[:, 2], rel=1e-6)
    assert placed.dtype == np.float32


def test_a_point_behind_the_camera_has_no_pixel_and_no_depth_before_it() -> None:
    behind = (np.array([[0.0, 0.0, -50.0]]) - CAMERA.translation_mm) @ ROTATION
    (column, row, depth), *others = placed_vertices(behind, CAMERA)
    assert not others
    assert np.isnan((column, row)).all()
    assert depth == pytest.approx(-50)
    assert placed_vertices(behind[:0], CAMERA).shape == (0, 3)

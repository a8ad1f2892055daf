"""Lens distortion and poses of the rendered rig, against OpenCV and arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from simulated_rig.optics import distort, field_radius, lens_array, look_at, undistort, world_directions
from slrig.model import FloatArray, Pinhole, Size
from tests.unit.reconstruction.builders import opencv_pixels

STRONG = np.array([-0.21, 0.13, 0.0011, -0.0007, -0.04])


def device(distortion: FloatArray = STRONG) -> Pinhole:
    rotation, translation = look_at(np.array([-150.0, 20, -560]), np.array([3.0, -4, 5]), np.array([0.05, 1, 0]))
    matrix = np.array([[1100.0, 0, 322.7], [0, 1108.0, 231.9], [0, 0, 1]])
    return Pinhole(Size(640, 480), matrix, distortion, rotation, translation)


def test_a_ray_through_a_pixel_is_projected_back_to_it_by_opencv() -> None:
    pinhole = device()
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-0.5, 639.5, 23), np.linspace(-0.5, 479.5, 17)))
    rays = world_directions(u, v, lens_array(pinhole), pinhole.rotation)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    back = opencv_pixels(pinhole, pinhole.centre_mm + 432.1 * rays)
    np.testing.assert_allclose(back, np.column_stack([u, v]), atol=1e-8)


def test_distortion_is_that_of_opencv() -> None:
    lens = lens_array(device())
    points = np.random.default_rng(4).uniform(-0.35, 0.35, (50, 2))
    plain = Pinhole(Size(640, 480), device().matrix, STRONG, np.eye(3), np.zeros(3))
    expected = opencv_pixels(plain, np.column_stack([points, np.ones(50)]))
    found = np.array([distort(x, y, lens) for x, y in points])
    np.testing.assert_allclose(found * lens[:2] + lens[2:4], expected, atol=1e-9)


def test_undistorting_inverts_distorting_under_numba_and_in_plain_python() -> None:
    lens = lens_array(device())
    for x, y in np.random.default_rng(5).uniform(-0.35, 0.35, (30, 2)):
        xd, yd = distort(x, y, lens)
        assert undistort(xd, yd, lens) == pytest.approx((x, y), abs=1e-12)
        assert undistort.py_func(xd, yd, lens) == pytest.approx((x, y), abs=1e-12)


def test_looking_at_a_point_puts_it_on_the_axis_with_the_world_upright() -> None:
    position, target = np.array([100.0, -50, -400]), np.array([10.0, 20, 30])
    rotation, translation = look_at(position, target, np.array([0.0, 1, 0]))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(
        rotation @ target + translation, [0.0, 0.0, float(np.linalg.norm(target - position))], atol=1e-9
    )
    assert (rotation @ np.array([0.0, 1, 0]))[1] > 0.9
    assert (rotation @ np.array([1.0, 0, 0]))[0] > 0.9


@pytest.mark.parametrize("down", [(0.0, 0, 1), (0.0, 0, 0)])
def test_looking_along_down_is_refused(down: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="must differ"):
        look_at(np.array([0.0, 0, -5]), np.zeros(3), np.array(down))


def test_the_field_reaches_the_farthest_corner() -> None:
    pinhole = device(np.zeros(5))
    corner = np.hypot((-0.5 - 322.7) / 1100, (479.5 - 231.9) / 1108)
    assert field_radius(pinhole) == pytest.approx(corner * 1.05)

"""Pixels to rays and back, and stripes along epipolar lines, against OpenCV."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.model import FloatArray, Pinhole, Size
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.triangulation import optical_depths_mm, pixel_rays, project, runs_down, stripe_crossing
from tests.unit.reconstruction.builders import (
    CAMERA,
    OTHER_CAMERA,
    PROJECTOR,
    ensemble_of,
    looking,
    opencv_pixels,
    opencv_rays,
)

LENSES = ((0.3, 0.1, 3e-3, -3e-3, 0.0), (0.3, -0.1, -3e-3, 3e-3, 0.0), (-0.3, 0.1, -3e-3, -3e-3, 0.0))
DEVICES = pytest.mark.parametrize(
    "device",
    [CAMERA, OTHER_CAMERA, PROJECTOR, *(replace(CAMERA, distortion=np.array(lens)) for lens in LENSES)],
    ids=["camera", "other", "projector", "pincushion", "waved pincushion", "barrel"],
)


def pixels_of(size: Size, *, count: int = 400, margin_px: float = 30.0) -> FloatArray:
    """Pixels all over the image and a little beyond it."""
    low, high = -margin_px, np.array([size.width_px, size.height_px]) + margin_px
    return np.random.default_rng(5).uniform(low, high, (count, 2))


def points_before(device: Pinhole, *, count: int = 400) -> FloatArray:
    """World points in the device's field of view."""
    rng = np.random.default_rng(6)
    depth = rng.uniform(200.0, 900.0, count)
    return np.asarray(device.centre_mm + depth[:, None] * opencv_rays(device, pixels_of(device.size, count=count)))


@DEVICES
def test_rays_are_those_of_opencv(device: Pinhole) -> None:
    pixels = pixels_of(device.size)
    np.testing.assert_allclose(pixel_rays(device, pixels), opencv_rays(device, pixels), rtol=0, atol=1e-12)


@DEVICES
def test_projections_are_those_of_opencv(device: Pinhole) -> None:
    points = points_before(device)
    np.testing.assert_allclose(project(device, points), opencv_pixels(device, points), rtol=0, atol=1e-9)


def test_a_ray_has_unit_depth() -> None:
    pixels = pixels_of(CAMERA.size)
    depth = optical_depths_mm(CAMERA, CAMERA.centre_mm + 37.5 * pixel_rays(CAMERA, pixels))
    np.testing.assert_allclose(depth, 37.5, rtol=1e-12)


def test_skew_shears_columns_by_rows_and_is_undone() -> None:
    # OpenCV's models have no skew: u = fx x + s y + cx by hand.
    matrix = CAMERA.matrix.copy()
    matrix[0, 1] = 12.5
    skewed = replace(CAMERA, matrix=matrix)
    points = points_before(CAMERA)
    straight = opencv_pixels(CAMERA, points)
    expected = straight.copy()
    expected[:, 0] += 12.5 * (straight[:, 1] - matrix[1, 2]) / matrix[1, 1]
    np.testing.assert_allclose(project(skewed, points), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pixel_rays(skewed, expected), opencv_rays(CAMERA, straight), rtol=0, atol=1e-12)


def test_a_point_behind_the_device_has_no_pixel() -> None:
    ahead = points_before(CAMERA, count=3)
    behind = 2 * CAMERA.centre_mm - ahead
    seen = project(CAMERA, np.concatenate([ahead, behind]))
    assert np.isfinite(seen[:3]).all()
    assert np.isnan(seen[3:]).all()


def test_unmeasured_stays_unmeasured() -> None:
    assert np.isnan(pixel_rays(CAMERA, np.array([[np.nan, 3.0]]))).all()
    assert np.isnan(project(CAMERA, np.array([[np.nan, 0.0, 0.0]]))).all()
    assert np.isnan(optical_depths_mm(CAMERA, np.array([[np.nan, 0.0, 0.0]]))).all()


@pytest.mark.parametrize("beyond_px", [30.0, 80.0, 700.0])
def test_a_pixel_that_the_lens_cannot_light_has_no_ray(beyond_px: float) -> None:
    # x (1 - 0.3 x²) never exceeds 0.7027: farther out there is no direction that lands on the pixel.
    barrel = replace(CAMERA, distortion=np.array([-0.3, 0.0, 0.0, 0.0, 0.0]))
    edge = barrel.matrix[0, 2] + 0.7027 * barrel.matrix[0, 0]
    row = barrel.matrix[1, 2]
    assert np.isfinite(pixel_rays(barrel, np.array([[edge - beyond_px, row]]))).all()
    assert np.isnan(pixel_rays(barrel, np.array([[edge + beyond_px, row]]))).all()


ABOVE = looking(
    (-70.0, 240.0, -500.0), (0.0, 0.0, 0.0), size=Size(640, 480), focal_px=(1380.0, 1390.0),
    distortion=(-0.15, 0.05, -5e-4, 6e-4, 0.0),
)  # fmt: skip


def epipolar_directions(other: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2), unit: along the image in CAMERA of the other camera's rays to points, by small steps along these."""
    step = 1e-4 * (points_mm - other.centre_mm)
    along = opencv_pixels(CAMERA, points_mm + step) - opencv_pixels(CAMERA, points_mm - step)
    return np.asarray(along / np.linalg.norm(along, axis=1)[:, None])


def stripes(points_mm: FloatArray, normals: FloatArray) -> StripeEnsemble:
    return ensemble_of([opencv_pixels(CAMERA, points_mm)], [1.0])._replace(normals=normals)


@pytest.mark.parametrize("other", [OTHER_CAMERA, ABOVE], ids=["beside", "above"])
@pytest.mark.parametrize("angle_deg", [0.0, 4.0, 35.0, 90.0, 160.0])
def test_the_crossing_is_the_angle_between_stripe_and_epipolar_line(other: Pinhole, angle_deg: float) -> None:
    points = np.random.default_rng(4).uniform([-80, -60, -40], [80, 60, 60], (501, 3))
    along = epipolar_directions(other, points)
    angle = np.radians(angle_deg + np.random.default_rng(5).permutation(np.linspace(-3, 3, 501)))
    tangents = np.stack(
        [along[:, 0] * np.cos(angle) - along[:, 1] * np.sin(angle),
         along[:, 0] * np.sin(angle) + along[:, 1] * np.cos(angle)], axis=1,
    )  # fmt: skip
    normals = np.stack([tangents[:, 1], -tangents[:, 0]], axis=1)
    expected = np.median(np.abs(np.sin(angle)))
    assert stripe_crossing(stripes(points, normals), CAMERA, other) == pytest.approx(expected, abs=5e-4)


def test_without_a_point_the_crossing_is_1() -> None:
    assert stripe_crossing(ensemble_of([], []), CAMERA, OTHER_CAMERA) == 1.0


@pytest.mark.parametrize(("normal", "down"), [((1.0, 0.0), True), ((0.8, -0.6), True), ((-0.5, 0.87), False)])
def test_stripes_run_across_their_normals(normal: tuple[float, float], *, down: bool) -> None:
    assert runs_down(ensemble_of([np.array([[5.0, 6.0], [7.0, 8.0]])], [3.0], normal=normal)) is down

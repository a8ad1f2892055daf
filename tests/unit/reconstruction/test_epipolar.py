"""Stripes and epipolar lines in one image, against points of the other camera's rays as OpenCV projects them."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.model import FloatArray, Pinhole, Size
from slrig.reconstruction.epipolar import runs_down, stripe_crossing
from slrig.reconstruction.linking import StripeEnsemble
from tests.unit.reconstruction.builders import CAMERA, OTHER_CAMERA, ensemble_of, looking, opencv_pixels

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


def test_without_a_point_nothing_speaks_against_the_pair() -> None:
    assert stripe_crossing(ensemble_of([], []), CAMERA, OTHER_CAMERA) == 1.0


@pytest.mark.parametrize(("normal", "down"), [((1.0, 0.0), True), ((0.8, -0.6), True), ((-0.5, 0.87), False)])
def test_stripes_run_across_their_normals(normal: tuple[float, float], *, down: bool) -> None:
    assert runs_down(ensemble_of([np.array([[5.0, 6.0], [7.0, 8.0]])], [3.0], normal=normal)) is down

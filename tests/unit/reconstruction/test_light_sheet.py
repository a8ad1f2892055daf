"""Rays and light sheets by blocks of points, against one point at a time, through lenses of every strength."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, IntArray, Pinhole, Refusal, Size, lens
from slrig.model.lens_kernels import undistort
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.triangulation import intersect_light_sheets, normalised_from_pixel, pack_device
from tests.core import parametrize_core
from tests.unit.reconstruction.builders import ensemble_of, looking

LENGTHS = (1, 3, 255, 256, 257, 600)  # of curves: blocks that are full, and what is left over
FOLDS_AT = 0.8  # of the width of the camera's image, from its middle


def one_by_one(
    ensemble: StripeEnsemble, camera: Pinhole, projector: Pinhole, axis: Axis
) -> tuple[FloatArray, NDArray[np.uint8], IntArray]:
    """Points (n, 3), NaN where there is none, causes (n,), and the steps taken along the ray (n,), by the plain way."""
    points = np.full((len(ensemble.points_px), 3), np.nan)
    cause = np.full(len(points), Refusal.NO_INTERSECTION, dtype=np.uint8)
    steps = np.zeros(len(points), dtype=np.int32)
    for curve, position in enumerate(ensemble.position_px):
        for i in range(*ensemble.offsets[curve : curve + 2]):
            xd, yd, _ = np.linalg.solve(camera.matrix, [*ensemble.points_px[i], 1.0])
            ray = np.array([*undistort(camera.distortion, xd, yd, xd, yd, 1e-7), 1.0]) @ camera.rotation
            s, steps[i] = depth_on_sheet(camera.centre_mm, ray, projector, position, axis)
            points[i] = camera.centre_mm + s * ray
            x, y, depth = projector.rotation @ points[i] + projector.translation_mm
            _, _, xx, xy, yy = lens.distort(projector.distortion, x / depth, y / depth)
            if s <= 0 or depth <= 0:
                cause[i] = Refusal.BEHIND_DEVICE
            elif xx * yy > xy * xy:
                cause[i] = Refusal.NONE
    return points, cause, steps


def depth_on_sheet(
    origin_mm: FloatArray, ray: FloatArray, projector: Pinhole, position: float, axis: Axis
) -> tuple[float, int]:
    """By Newton's method from the plane at the principal point, and after how many steps; NaN if it does not settle."""
    across = int(axis is Axis.ROW)
    middle = projector.matrix[:2, 2].copy()
    middle[across] = position
    tangent = normalised_from_pixel(pack_device(projector), *middle)[across]
    from_plane = projector.rotation[across] - tangent * projector.rotation[2]
    ahead = projector.rotation @ ray
    s = -(from_plane @ origin_mm + projector.translation_mm[across] - tangent * projector.translation_mm[2])
    s /= from_plane @ ray
    for step in range(1, 26):
        place = projector.rotation @ (origin_mm + s * ray) + projector.translation_mm
        x, y = place[:2] / place[2]
        xd, yd, xx, xy, yy = lens.distort(projector.distortion, x, y)
        missed = (projector.matrix @ [xd, yd, 1.0])[across] - position
        moved = np.array([[xx, xy], [xy, yy]]) @ (ahead[:2] - np.array([x, y]) * ahead[2]) / place[2]
        s -= missed / (projector.matrix[:2, :2] @ moved)[across]
        if abs(missed) < 1e-5 or np.isnan(s):
            return float(s), step
    return np.nan, 25


def rig(seed: int, axis: Axis) -> tuple[Pinhole, Pinhole]:
    """A camera whose lens turns back within its image, and a projector of about the same lens that does not.

    The projector is beside the camera or above it, so that the axis tells depth.
    """
    rng = np.random.default_rng(seed)
    focal_px = rng.uniform(300, 500)
    barrel = -((focal_px / (640 * FOLDS_AT)) ** 2) / 3 * rng.uniform(0.9, 1.5)
    beside_mm = (60.0, -20.0, -510.0) if axis is Axis.COLUMN else (-80.0, -150.0, -510.0)
    camera = looking(
        (-90.0, 10.0, -520.0), (0.0, 0.0, 0.0), size=Size(640, 480), focal_px=(focal_px, 1.01 * focal_px),
        distortion=(barrel, *rng.uniform(-1, 1, 4) * [0.02, 5e-3, 5e-3, 0.0]), roll_rad=rng.uniform(-0.5, 0.5),
    )  # fmt: skip
    projector = looking(
        beside_mm, (0.0, 0.0, 0.0), size=Size(320, 240), focal_px=(400.0, 404.0),
        distortion=(barrel, *rng.uniform(-1, 1, 4) * [0.1, 5e-3, 5e-3, 0.05]), roll_rad=rng.uniform(-0.5, 0.5),
    )  # fmt: skip
    skewed = camera.matrix.copy()
    skewed[0, 1] = 3.0
    return replace(camera, matrix=skewed), projector


def scattered(seed: int) -> StripeEnsemble:
    """Pixels all over the camera's image and beyond it, on sheets all over the projector's."""
    rng = np.random.default_rng(seed)
    pixels = [rng.uniform([-40, -40], [680, 520], (count, 2)) for count in LENGTHS]
    return ensemble_of(pixels, np.sort(rng.uniform(0, 240, len(LENGTHS))).tolist())


@pytest.mark.parametrize("axis", list(Axis))
@parametrize_core("seed", range(2))
def test_blocks_of_points_give_what_each_point_gives(seed: int, axis: Axis) -> None:
    camera, projector = rig(seed, axis)
    ensemble = scattered(seed)
    points, _, _, cause = intersect_light_sheets(ensemble, camera, projector, axis)
    with np.errstate(all="ignore"):
        expected, why, steps = one_by_one(ensemble, camera, projector, axis)
    # Easy points, slow ones, and such as have no ray lie side by side.
    assert np.mean(why == Refusal.NONE) > 0.2
    assert np.mean(why == Refusal.NO_INTERSECTION) > 0.01
    # What wanders about for long, or to where the projector is, comes to rest by the last bits of the numbers.
    beside = np.abs(expected @ projector.rotation[2] + projector.translation_mm[2]) < 10
    sure = (steps < 10) & ~beside
    assert np.mean(sure) > 0.9
    assert steps[sure].max() > 6
    np.testing.assert_array_equal(cause[sure], why[sure])
    met = sure & (why == Refusal.NONE)
    np.testing.assert_allclose(points[met], expected[met], rtol=1e-11, atol=1e-9)

"""What holds for every lens and every ball."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slrig.model import Axis, Pinhole, Size
from slrig.reconstruction.optics import project, rays
from slrig.reconstruction.triangulation import camera_projector, ordered_along_sheet, selected
from tests.unit.reconstruction.builders import (
    CAMERA,
    PROJECTOR,
    Sphere,
    ensemble_of,
    lit_rows,
    looking,
    opencv_pixels,
)

small = st.floats(-1.0, 1.0)
# The first call of a kernel compiles it.
unhurried = settings(deadline=None, max_examples=20)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def devices(draw: st.DrawFn) -> Pinhole:
    """Lenses of every make, as long as they do not fold within the image."""
    return looking(
        (200 * draw(small), 100 * draw(small), -500 + 100 * draw(small)), (20 * draw(small), 0.0, 0.0),
        size=Size(640, 480), focal_px=(1100 + 300 * draw(small), 1100 + 300 * draw(small)),
        distortion=(0.3 * draw(small), 0.1 * draw(small), 3e-3 * draw(small), 3e-3 * draw(small), 0.0),
        roll_rad=draw(small),
    )  # fmt: skip


@unhurried
@given(devices(), seeds)
def test_a_ray_projects_back_to_its_pixel(device: Pinhole, seed: int) -> None:
    pixels = np.random.default_rng(seed).uniform([0, 0], [639, 479], (20, 2))
    again = project(device, device.centre_mm + 500 * rays(device, pixels))
    np.testing.assert_allclose(again, pixels, atol=1e-7)


@unhurried
@given(seeds, st.floats(40, 280), st.floats(180, 2000))
def test_what_the_camera_sees_of_a_ball_is_triangulated_onto_it(seed: int, column_px: float, radius_mm: float) -> None:
    ball = Sphere((0.0, 0.0, radius_mm), radius_mm)
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.uniform(90, 150, 30))
    points = lit_rows(column_px, rows, ball)
    ensemble = ensemble_of([opencv_pixels(CAMERA, points)], [column_px])
    curves, _ = camera_projector(ensemble, CAMERA, PROJECTOR, Axis.COLUMN)
    assert len(curves.points_mm) == len(points)
    np.testing.assert_allclose(curves.points_mm, points, atol=1e-6)
    # Leaving points out or ordering again changes no point.
    keep = np.asarray(rng.random(len(points)) < 0.6)
    fewer = ordered_along_sheet(selected(curves, keep))
    np.testing.assert_array_equal(fewer.points_mm, curves.points_mm[keep])
    assert not fewer.bridge_after.any()

"""What holds for every lens."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slrig.model import Pinhole, Size
from slrig.reconstruction.optics import project, rays
from tests.unit.reconstruction.builders import looking

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

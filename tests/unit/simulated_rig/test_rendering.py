"""Stripes as a camera of the rendered rig sees them, against the closed form of their light.

Camera and projector look the same way from the same distance at a facing plate, so the projector column is a multiple
of the camera's plus a constant.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from simulated_rig.light import Response, light_table
from simulated_rig.options import SimulatedCameraOptions, SimulatedProjectorOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import Scene, build_surface
from slrig.model import FloatArray
from tests.core import parametrize_core
from tests.unit.simulated_rig.building import line_profile

FOCAL_PX = 3000.0
COLUMNS_PER_PX = 1.16
PERIOD = 16
LAMP_BLUR_PX = 0.3


def light_of_stripe(distance_px: FloatArray, blur_px: float) -> FloatArray:
    """Light at distances from a line one projector column wide: its square, both lenses' Gaussians, the pixel's square.

    h(x) = x Φ(x/s) + s φ(x/s) is the Gaussian integrated twice; each square is a difference of it.
    """
    s = np.hypot(blur_px, LAMP_BLUR_PX / COLUMNS_PER_PX)
    wide, narrow = (1 / COLUMNS_PER_PX + 1) / 2, (1 / COLUMNS_PER_PX - 1) / 2

    def integrated_twice(x: FloatArray) -> FloatArray:
        return np.asarray(x * ndtr(x / s) + s * np.exp(-((x / s) ** 2) / 2) / np.sqrt(2 * np.pi))

    terms = ((1, wide), (-1, narrow), (-1, -narrow), (1, -wide))
    return np.asarray(sum(sign * integrated_twice(distance_px + shift) for sign, shift in terms))


def stripes(samples_per_axis: int, blur_px: float) -> tuple[FloatArray, FloatArray]:
    """(columns,) light over white of the image's middle row under a line pattern, and the true centres of its lines."""
    lamp = SimulatedProjectorOptions.model_validate({
        "size_px": [512, 64], "focal_px": [COLUMNS_PER_PX * FOCAL_PX] * 2, "blur_px": LAMP_BLUR_PX, "leak": 0.0,
        "position_mm": [20.0, 0.0, -500.0], "target_mm": [20.0, 0.0, 0.0], "principal_px": [400.0, 32.0],
    })  # fmt: skip
    eye = SimulatedCameraOptions.model_validate({
        "name": "eye", "size_px": [200, 21], "focal_px": [FOCAL_PX] * 2, "principal_px": [100.0, 10.0],
        "position_mm": [-10.0, 0.0, -500.0], "target_mm": [-10.0, 0.0, 0.0], "blur_px": blur_px,
    })  # fmt: skip
    plate = {"shape": "plane", "size_mm": [800.0, 800.0]}
    stage = SceneState(
        build_surface(Scene.model_validate({"object": [plate]}), Path()), lamp.pinhole(), working_distance_mm=500
    )
    view = CameraView(
        eye.pinhole(), stage, blur_px=blur_px, ambient=0.0, samples_per_axis=samples_per_axis, jitter=False, seed=1,
        workers=1,
    )  # fmt: skip
    response = Response(gamma=1.0, leak=0.0, blur_px=LAMP_BLUR_PX)
    white, lines = (
        view.image([(1.0, light_table(profile, lamp.size, response))])[10].astype(np.float64)
        for profile in (np.full((1, 1), 255, np.uint8), line_profile(lamp.size, 5, period=PERIOD))
    )
    # 30 mm between the lenses: column = 1.16 (u - 100 - 3000 * 30 / 500) + 400, on the plate.
    centres = 100 + FOCAL_PX * 30 / 500 + (np.arange(5, 512, PERIOD) - 400) / COLUMNS_PER_PX
    return lines / white, centres


@parametrize_core("blur_px", [0.6, 0.9])
@pytest.mark.parametrize("samples_per_axis", [3, 4])
def test_the_lens_takes_away_what_would_alias(samples_per_axis: int, blur_px: float) -> None:
    """Lines of a column each, at 1.16 columns per pixel: a blur after the pixels would keep each stripe's displacement.

    The stripes meet the pixels at every phase, since 16 / 1.16 px is no simple fraction.
    """
    seen, centres = stripes(samples_per_axis, blur_px)
    at = np.arange(len(seen))
    expected = light_of_stripe(at[:, None] - centres, blur_px).sum(axis=1)
    middle = slice(10, 190)
    np.testing.assert_allclose(seen[middle], expected[middle], rtol=0, atol=2e-3 * expected.max())
    centres = centres[(centres > 10) & (centres < 189)]
    assert len(centres) > 10
    # Half a period is more than six standard deviations of a stripe.
    weights = seen * (np.abs(at - centres[:, None]) < PERIOD / COLUMNS_PER_PX / 2)
    found = (weights * at).sum(axis=1) / weights.sum(axis=1)
    assert np.abs(found - centres).max() < 0.001

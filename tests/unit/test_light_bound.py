"""The Cramér-Rao bound of rendered stripes: a closed form, and an estimator that attains it.

Camera and projector look the same way from the same distance at a facing plate, with the same focal length, so one
projector column is one camera pixel and the projector column is the camera's plus a constant.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulated_rig.light import Response
from simulated_rig.options import SimulatedCameraOptions, SimulatedProjectorOptions
from simulated_rig.rendering import CameraView, SceneState, SensorModel
from simulated_rig.scene import Scene, build_surface
from slrig.model import FloatArray, Pixels
from tests.light_bound import ExposedView, StripeBound, stripe_bound
from tests.unit.simulated_rig.building import line_profile

PERIOD = 24
SAMPLES = 4
BLUR_PX = 2.0
# A square pixel of the projector, its blur, and the camera's square pixel as its samples stand for it.
SIGMA_PX = math.sqrt(1 / 12 + BLUR_PX**2 + (1 - 1 / SAMPLES**2) / 12)
QUIET = {"full_well_e": 1e6, "bit_depth": 16, "saturation_s": 1.0, "pedestal_dn": 500.0}
WHITE_NOISE = {**QUIET, "read_noise_e": 3000.0}


def exposed_view(
    sensor: dict[str, float],
    *,
    exposure_s: float = 0.02,
    leak: float = 0.0,
    phase_px: float = 0.0,
    **thing: Any,
) -> ExposedView:
    """A plate before the rig; `phase_px` moves the camera's image."""
    lamp = SimulatedProjectorOptions.model_validate({
        "size_px": [256, 192], "focal_px": [400.0, 400.0], "principal_px": [128.0, 96.0], "blur_px": BLUR_PX,
        "position_mm": [20.0, 0.0, -500.0], "target_mm": [20.0, 0.0, 0.0], "leak": leak,
    })  # fmt: skip
    eye = SimulatedCameraOptions.model_validate({
        "name": "eye", "size_px": [120, 60], "focal_px": [400.0, 400.0], "principal_px": [60.0 + phase_px, 30.0],
        "position_mm": [-20.0, 0.0, -500.0], "target_mm": [-20.0, 0.0, 0.0],
    })  # fmt: skip
    plate: dict[str, Any] = {"shape": "plane", "size_mm": [800.0, 800.0], "albedo": 0.8} | thing
    stage = SceneState(
        build_surface(Scene.model_validate({"object": [plate]}), Path()), lamp.pinhole(), working_distance_mm=500
    )
    view = CameraView(
        eye.pinhole(), stage, blur_px=0.0, ambient=0.0, samples_per_axis=SAMPLES, jitter=False, seed=1, workers=1
    )
    numbers = dict(sensor)
    camera = SensorModel(bit_depth=int(numbers.pop("bit_depth")), **numbers)
    return ExposedView(view, lamp.size, Response(1.0, leak, BLUR_PX), camera, exposure_s, 1.0)


def lines() -> tuple[Pixels, FloatArray]:
    centres = np.arange(0, 256, PERIOD, dtype=np.float64)
    return line_profile(exposed_view(WHITE_NOISE).projector, 0, period=PERIOD), centres


def bound_of(exposed: ExposedView) -> StripeBound:
    return stripe_bound(exposed, *lines())


def height_e(exposed: ExposedView) -> float:
    """Mean over the stripes of their middle's height; with no phase it lies on a pixel centre."""
    return float(np.sort(exposed.electrons(lines()[0]), axis=1)[:, -3:].mean())


def test_white_noise_gives_the_closed_form_of_a_gaussian_stripe() -> None:
    exposed = exposed_view(WHITE_NOISE)
    bound = bound_of(exposed)
    expected = 1.062 * (3000.0 / height_e(exposed)) * math.sqrt(SIGMA_PX)
    assert len(bound.row) > 200
    assert np.median(bound.row_px) == pytest.approx(expected, rel=0.02)
    assert np.ptp(bound.row_px) < 0.1 * expected
    np.testing.assert_allclose(bound.width_px, SIGMA_PX, rtol=0.01)
    np.testing.assert_allclose(bound.tilt_cosine, 1.0, rtol=1e-6)
    assert np.median(bound.snr) == pytest.approx(height_e(exposed) / 3000.0, rel=0.01)


@pytest.mark.slow
def test_an_estimator_on_the_sensor_s_own_frames_attains_the_bound_and_none_beats_it() -> None:
    sensor = {"full_well_e": 20000.0, "bit_depth": 10, "saturation_s": 1.0, "read_noise_e": 12.0, "pedestal_dn": 30.0}
    exposed, ahead, behind = (
        exposed_view(sensor, exposure_s=0.2, phase_px=phase, leak=0.01) for phase in (0.2, 0.25, 0.15)
    )
    profile, _ = lines()
    bound = bound_of(exposed)
    mean, after, before = (each.electrons(profile).astype(np.float64) for each in (exposed, ahead, behind))
    # A displacement through the camera's principal point: another way than the bound's own.
    change = (after - before) / 0.1
    per_dn = 1 / exposed.sensor.dn_per_electron(1.0)
    variance = mean + 12.0**2 + per_dn**2 / 12
    rng = np.random.default_rng(4)
    frames = [(exposed.frame(profile, rng) - 30.0) * per_dn - mean for _ in range(60)]
    kept = np.abs(bound.column_px - 60) < 40
    efficient, plain = [], []
    for r, c in zip(bound.row[kept], bound.column_px[kept], strict=True):
        own = slice(round(c) - 11, round(c) + 12)
        weights = change[r, own] / variance[r, own]
        efficient.append([weights @ f[r, own] / (weights @ change[r, own]) for f in frames])
        even = change[r, own]
        plain.append([even @ f[r, own] / (even @ even) for f in frames])
    attained = np.std(efficient, axis=1) / bound.row_known_px[kept]
    assert len(attained) > 150
    assert np.sqrt(np.mean(attained**2)) == pytest.approx(1.0, abs=0.02)
    assert np.sqrt(np.mean((np.std(plain, axis=1) / bound.row_known_px[kept]) ** 2)) > 1.03


@pytest.mark.slow
def test_crossings_are_where_the_true_map_says_and_stripes_at_the_border_are_left_out() -> None:
    exposed = exposed_view(WHITE_NOISE, phase_px=0.3)
    bound = bound_of(exposed)
    # The projector stands 40 mm to the right: 32 pixels at 500 mm. Its principal column is 128, the camera's 60.3.
    np.testing.assert_allclose(bound.column_px, bound.line_px - 128.0 + 32.0 + 60.3, atol=1e-6)
    assert set(bound.line_px) == {48.0, 72.0, 96.0, 120.0, 144.0}
    assert bound.column_px.min() > 1.5
    assert bound.column_px.max() < 117.5

"""Gamma of cameras, and frames that only seem to have one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from slrig.model import FloatArray
from slrig.reconstruction.camera_response import estimate_gamma, linearisation_gain
from slrig.reconstruction.decoded_image import linearise_frames
from slrig.reconstruction.decoding import DecodingLimits
from slrig.reconstruction.frames import AxisFrames, FrameStacks
from tests.core import parametrize_core
from tests.unit.reconstruction.builders import code_frames, grid

SHAPE = (240, 400)
BITS = 7
FULL = 255.0


@cache
def seen_by(
    gamma: float, *, signal_blur_px: float = 0.0, unsharp: float = 0.0, room: float = 0.02, quality: float = 0.8,
    paired: bool = True,
) -> AxisFrames:  # fmt: skip
    """A printed plate under a code that a lens blurs, in whole grey levels of a camera.

    signal_blur_px : of the projector's signal, before a gamma of 2.2 of its own.
    """
    random = np.random.default_rng(2)
    x, y = grid(SHAPE)
    print_ = quality * np.where((x // 37 + y // 29) % 2 == 0, 1.0, 0.4)

    def camera(shown: FloatArray) -> NDArray[np.float32]:
        signal = gaussian_filter1d(shown, signal_blur_px, axis=1) if signal_blur_px else shown
        light = gaussian_filter(print_ * (signal ** (2.2 if signal_blur_px else 1.0) + room), 0.9)
        light += 0.003 * random.standard_normal(SHAPE)
        value = FULL * np.maximum(light, 0) ** (1 / gamma)
        value += unsharp * (value - gaussian_filter(value, 1.0))
        return np.clip(np.rint(value), 0, FULL).astype(np.float32)

    # A slanting code, so that its edges lie anywhere in a pixel.
    codes = [np.clip(0.5 + np.sin(np.pi * 2**bit * (x + 0.13 * y) / 200) * 64 / 2**bit, 0, 1) for bit in range(BITS)]
    return code_frames(
        bits=np.array([camera(each) for each in codes]),
        inverses=np.array([camera(1 - each) for each in codes]) if paired else None,
        white=camera(np.ones(SHAPE)),
        black=camera(np.zeros(SHAPE)),
        full_scale=FULL,
    )


@parametrize_core(
    ("gamma", "seen"),
    [(1.8, {}), (2.6, {}), (2.2, {"room": 0.2}), (2.6, {"room": 0.2}), (1.8, {"quality": 0.3})],
    ids=["1.8", "2.6", "2.2, bright room", "2.6, bright room", "1.8, dark plate"],
    core=[1, 2],
)
def test_gamma_is_estimated_from_edges_of_the_code(gamma: float, seen: dict[str, Any]) -> None:
    assert estimate_gamma(seen_by(gamma, **seen)) == pytest.approx(gamma, rel=0.05)


@parametrize_core(
    "seen",
    [{}, {"unsharp": 1.5}, {"signal_blur_px": 1.5}, {"room": 0.2, "unsharp": 1.0}],
    ids=["as it is", "sharpened", "behind a scaler", "in a bright room"],
    core=[0, 1],
)
def test_values_in_proportion_to_light_stay_as_they_are(seen: dict[str, Any]) -> None:
    assert estimate_gamma(seen_by(1.0, **seen)) == 1.0


def test_a_projector_that_dims_white_pictures_does_not_change_gamma() -> None:
    linear = seen_by(1.0)
    assert estimate_gamma(replace(linear, white=0.7 * linear.white)) == 1.0


def test_frames_without_edges_have_gamma_1() -> None:
    bent = seen_by(2.2)
    assert estimate_gamma(replace(bent, inverses=None)) == 1.0
    assert estimate_gamma(replace(bent, exposure_ratio=4.0)) == 1.0
    assert bent.inverses is not None
    dark = np.stack([bent.bits, bent.inverses]) / np.float32(20)
    assert estimate_gamma(replace(bent, bits=dark[0], inverses=dark[1])) == 1.0


def test_straight_frames_are_those_of_a_straight_camera() -> None:
    bent, linear = seen_by(2.2), seen_by(1.0)
    frames, response = linearise_frames(FrameStacks.from_frames(bent), DecodingLimits())
    noise = response.noise
    assert response.gamma == pytest.approx(2.2, rel=0.03)
    # A level of the camera is up to two of light: 1/2.2 of the full scale is one in the middle.
    np.testing.assert_allclose(frames.white, linear.white, atol=8)
    np.testing.assert_allclose(frames.bits, linear.bits, atol=8)
    assert noise.loss is not None
    assert not noise.loss.any()


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.4])
def test_errors_grow_as_the_slope_of_light_over_values(gamma: float) -> None:
    random = np.random.default_rng(8)
    value = random.uniform(20, 240, 200_000)
    seen = value + random.normal(0, 0.5, value.shape)
    light, wanted = (FULL * (each / FULL) ** gamma for each in (seen, value))
    grown = float(np.mean((light - wanted) ** 2)) / 0.25
    assert linearisation_gain([wanted.astype(np.float32)], gamma, FULL) == pytest.approx(grown, rel=0.02)

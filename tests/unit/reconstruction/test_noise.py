"""The noise model, recovered from frames with known noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import FloatArray, NoiseModel
from slrig.reconstruction.camera_response import estimate_noise
from slrig.reconstruction.frames import AxisFrames
from tests.core import parametrize_core
from tests.unit.reconstruction.builders import code_frames, grid

SHAPE = (240, 320)
BITS = 9
CAMERAS = pytest.mark.parametrize(
    ("read_variance", "slope"), [(1.5, 0.02), (0.5, 0.1), (6.0, 0.05)], ids=["typical", "shot", "read"]
)


def frames_with_noise(
    read_variance: float, slope: float, *, paired: bool, seed: int = 3, texture: float = 0.0, full_scale: float = 4095.0
) -> AxisFrames:
    """A lit plate, bright in the middle, under a code blurred by the optics."""
    rng = np.random.default_rng(seed)
    x, y = grid(SHAPE)
    contrast = 150 * (0.25 + np.exp(-(((x - 160) / 110) ** 2) - ((y - 120) / 90) ** 2))
    contrast *= 1 + texture * rng.standard_normal(SHAPE)
    black = 12 + 0.01 * y

    def seen(light: FloatArray | float) -> FloatArray:
        mean = black + contrast * light
        return np.asarray(mean + np.sqrt(read_variance + slope * mean) * rng.standard_normal(SHAPE))

    bits, inverses = [], []
    for bit in range(BITS):
        # A bit that is soft at its edges: the sum with its inverse is white plus black all the same.
        light = 0.5 + 0.5 * np.sin(2 * np.pi * x * 2**bit / 640 + 0.3)
        bits.append(seen(light))
        inverses.append(seen(1 - light))
    return code_frames(
        bits=np.array(bits, dtype=np.float32),
        inverses=np.array(inverses, dtype=np.float32) if paired else None,
        white=seen(1.0).astype(np.float32),
        black=seen(0.0).astype(np.float32),
        full_scale=full_scale,
    )


@CAMERAS
@parametrize_core("paired", [True, False], ids=["inverses", "neighbours"])
def test_the_variance_of_dark_and_bright_pixels_is_recovered(
    read_variance: float, slope: float, *, paired: bool
) -> None:
    found = [estimate_noise(frames_with_noise(read_variance, slope, paired=paired, seed=seed)) for seed in range(2)]
    assert np.mean([model.slope for model in found]) == pytest.approx(slope, rel=0.1)
    for level in (12.0, 60.0, 180.0):
        variance = np.mean([variance_at(model, level) for model in found])
        assert variance == pytest.approx(read_variance + slope * level, rel=0.1)


def test_noise_of_dark_levels_is_measured_with_integers_of_a_bright_surface() -> None:
    # Of eight bits and few frames; no level of the sums is dark.
    rng, (x, y) = np.random.default_rng(5), grid(SHAPE)
    white, black = 140 + 40 * np.sin(x / 40) * np.cos(y / 50), 2 + 0.002 * y

    def seen(light: FloatArray | float) -> NDArray[np.float32]:
        mean = black + (white - black) * light
        noisy = mean + np.sqrt(0.1 + 0.025 * mean) * rng.standard_normal(SHAPE)
        return np.asarray(np.rint(np.maximum(noisy, 0)), dtype=np.float32)

    lights = [0.5 + 0.5 * np.sign(np.sin(np.pi * x / 320 * 2**bit + 0.3)) for bit in range(8)]
    bits, inverses = (np.array([seen(one + sign * light) for light in lights]) for one, sign in ((0, 1), (1, -1)))
    found = estimate_noise(
        code_frames(bits=bits, inverses=inverses, white=seen(1.0), black=seen(0.0), full_scale=255.0)
    )
    assert variance_at(found, 10.0) == pytest.approx(0.1 + 0.025 * 10 + 1 / 12, rel=0.25)
    assert variance_at(found, 100.0) == pytest.approx(0.1 + 0.025 * 100 + 1 / 12, rel=0.15)


def test_clipped_pixels_do_not_look_quiet() -> None:
    frames = frames_with_noise(2.0, 0.04, paired=True)
    assert frames.inverses is not None
    clipped = code_frames(
        bits=np.clip(frames.bits, 0, 150),
        inverses=np.clip(frames.inverses, 0, 150),
        white=np.clip(frames.white, 0, 150),
        black=frames.black,
        full_scale=150.0,
    )
    assert (frames.white > 150).mean() > 0.05
    assert variance_at(estimate_noise(clipped), 60.0) == pytest.approx(2.0 + 0.04 * 60.0, rel=0.12)


@pytest.mark.parametrize("paired", [True, False], ids=["inverses", "neighbours"])
def test_frames_without_noise_still_have_that_of_quantisation(*, paired: bool) -> None:
    found = estimate_noise(frames_with_noise(0.0, 0.0, paired=paired))
    assert found.read_variance == pytest.approx(1 / 12)
    assert found.slope == pytest.approx(0.0, abs=1e-4)


def test_an_image_too_small_for_an_estimate_gets_the_floor() -> None:
    flat = np.full((4, 4), 9, dtype=np.float32)
    frames = code_frames(bits=np.stack([flat] * 3), inverses=np.stack([flat] * 3), white=flat, black=flat)
    assert estimate_noise(frames) == NoiseModel(1 / 12, 0.0)


@pytest.mark.parametrize("deviation", [0.8, 20.0])
@pytest.mark.parametrize("paired", [True, False], ids=["inverses", "neighbours"])
def test_one_brightness_gives_one_variance(deviation: float, *, paired: bool) -> None:
    # A plate that fills the view evenly: its levels differ by noise alone, and that tells nothing of a slope.
    rng = np.random.default_rng(0)
    bits, inverses = rng.normal(500.0, deviation, (2, 9, 120, 160)).astype(np.float32)
    white, black = rng.normal(500.0, deviation, (2, 120, 160)).astype(np.float32)
    found = estimate_noise(
        code_frames(bits=bits, inverses=inverses if paired else None, white=white, black=black, full_scale=4095.0)
    )
    for level in (50.0, 500.0, 1000.0):
        assert variance_at(found, level) == pytest.approx(deviation**2, rel=0.1)


def variance_at(model: NoiseModel, level: float) -> float:
    return float(model.variance(np.array([[level]], dtype=np.float32))[0, 0])


@CAMERAS
def test_noise_of_dark_levels_is_measured_on_an_evenly_lit_wall(read_variance: float, slope: float) -> None:
    rng = np.random.default_rng(8)
    repeats = 2

    def seen(mean: FloatArray, frames: int = 1) -> NDArray[np.float32]:
        scatter = rng.standard_normal((frames, *SHAPE)).mean(axis=0)
        return np.asarray(mean + np.sqrt(read_variance + slope * mean) * scatter, dtype=np.float32)

    dark, bright = np.full(SHAPE, 15.0), np.full(SHAPE, 190.0)
    lit = [np.where(grid(SHAPE)[0] % 2 ** (BITS - bit) < 2 ** (BITS - bit - 1), bright, dark) for bit in range(BITS)]
    frames = replace(
        code_frames(
            bits=np.array([seen(each) for each in lit], dtype=np.float32),
            inverses=np.array([seen(dark + bright - each) for each in lit], dtype=np.float32),
            white=seen(bright, repeats),
            black=seen(dark, repeats),
            full_scale=4095.0,
        ),
        reference_repeats=float(repeats),
    )
    model = estimate_noise(frames)
    for level in (15.0, 100.0, 190.0):
        assert variance_at(model, level) == pytest.approx(read_variance + slope * level, rel=0.12)

"""Blur of the camera, estimated from lines that are blurred on a fine grid."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from slrig.model import Axis, FloatArray, LineShift
from slrig.reconstruction.blur import BlurEstimate, estimate_blur
from slrig.reconstruction.phase import PositionMap
from tests.unit.reconstruction.builders import code_frames

FINE = 4
SHAPE = (120, 160)
PERIOD_PX = 8
EXPECTED_PX = 0.65


def blur_of(
    blur_px: float,
    slopes: FloatArray,
    focus_px: float = 0.9,
    noise_dn: float = 1.0,
    expected_px: float = EXPECTED_PX,
    print_ratio: float = 1.0,
) -> BlurEstimate:
    """Of a surface that rises by `slopes` from its left to its right, behind a projector's blur of focus_px."""
    rng = np.random.default_rng(4)
    slope = np.interp(np.arange(SHAPE[1] * FINE) / FINE, np.linspace(0, SHAPE[1], len(slopes)), slopes)
    position = np.tile(100 + np.cumsum(slope) / FINE, (SHAPE[0] * FINE, 1))
    albedo: FloatArray = np.tile(1 + 0.3 * np.sin(np.arange(SHAPE[0] * FINE) / FINE / 9)[:, None], (1, SHAPE[1] * FINE))
    albedo *= np.where(np.arange(SHAPE[1] * FINE) // FINE // 16 % 2, 1.0, 1.0 / print_ratio)
    swing = np.exp(-0.5 * (2 * np.pi / PERIOD_PX * focus_px) ** 2)

    def seen(light: FloatArray | float) -> NDArray[np.float32]:
        image = gaussian_filter(100 * albedo * light, blur_px * FINE)[FINE // 2 :: FINE, FINE // 2 :: FINE]
        return np.asarray(20 + image + noise_dn * rng.standard_normal(SHAPE), dtype=np.float32)

    patterns = tuple(LineShift(Axis.COLUMN, shift, PERIOD_PX) for shift in range(PERIOD_PX))
    lines = [
        seen(0.3 + 0.3 * swing * np.cos(2 * np.pi / PERIOD_PX * (position - pattern.centre_px))) for pattern in patterns
    ]
    white, black = seen(1.0), seen(0.0)
    frames = code_frames(bits=white[None], lines=np.array(lines), line_patterns=patterns, white=white, black=black)
    at = position[FINE // 2 :: FINE, FINE // 2 :: FINE].astype(np.float32)
    seen_at = PositionMap(at, np.full_like(at, 0.02))
    return estimate_blur(frames, seen_at, np.ones(SHAPE, dtype=np.bool_), expected_px)


@pytest.mark.parametrize(("blur_px", "focus_px"), [(0.4, 0.3), (0.65, 1.5), (1.4, 1.5)])
def test_blur_is_estimated_independent_of_the_projectors(blur_px: float, focus_px: float) -> None:
    blur = blur_of(blur_px, np.array([0.5, 1.9, 0.8, 1.5]), focus_px)
    assert blur.from_lines
    assert blur.sigma_px**2 == pytest.approx(blur_px**2, abs=0.1)


def test_few_slopes_suffice_for_a_camera_out_of_focus() -> None:
    blur = blur_of(1.25, np.array([0.7, 1.3]))
    assert blur.from_lines
    assert blur.sigma_px**2 == pytest.approx(1.25**2, rel=0.1)


def test_edges_of_a_print_do_not_bias_the_blur() -> None:
    """With them 17 % less of the variance is told."""
    blur = blur_of(1.25, np.array([0.5, 1.9, 0.8, 1.5]), print_ratio=7.0)
    assert blur.sigma_px**2 == pytest.approx(1.25**2, rel=0.05)


def test_an_even_slope_returns_the_expected_blur() -> None:
    blur = blur_of(1.0, np.array([1.1, 1.1]))
    assert blur == (EXPECTED_PX, False)


def test_a_known_blur_is_returned() -> None:
    assert blur_of(1.0, np.array([0.5, 1.9]), expected_px=0.0) == (0.0, False)

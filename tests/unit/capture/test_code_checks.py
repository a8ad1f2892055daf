"""Damage that light alone does not contradict: told by roughness, by the sum of line frames, and by the noise of pairs.

A camera whose values are made for displays: values are (light)^0.45, and everything lies between black and white.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.capture.checks import NOISE_FLOOR_DN, Reference, Samples, noise_dn, reference, repeated
from slrig.capture.code_checks import line_sum, rougher
from slrig.capture.sampling import Sampler
from slrig.model import Size

Image = NDArray[np.float64]
SIZE = Size(200, 240)
SAMPLER = Sampler.of(SIZE)
NOISE_DN = 1.0
PERIOD = 8
RANDOM = np.random.default_rng(4)


def seen(light: NDArray[np.floating[Any]]) -> Image:
    """(H, W): what the camera sees of light that varies along the columns, 0 to 1, in a room that is not dark."""
    values = 230 * (0.03 + 0.9 * np.broadcast_to(light, SIZE.shape)) ** 0.45
    return np.asarray(values + RANDOM.normal(0, NOISE_DN, SIZE.shape))


def sampled(image: Image) -> Samples:
    return SAMPLER.take(np.clip(np.rint(image), 0, 255).astype(np.uint8))


def stripes(width_px: int, shift: float = 0.0, *, period_px: int = PERIOD, blur_px: float = 1.2) -> Samples:
    """(W,): lit stripes of the projector, two of whose columns are five of the camera's, blurred."""
    fine = (np.arange(0, 40 * SIZE.width_px) / 40 / 2.5 - shift) % period_px < width_px
    reach = np.arange(-400, 401) / 40
    kernel = np.exp(-0.5 * (reach / (2.5 * blur_px)) ** 2)
    light = np.convolve(np.pad(fine.astype(float), 400, mode="wrap"), kernel / kernel.sum(), mode="valid")
    return np.asarray(light[::40], dtype=np.float32)


def garbled(
    image: Image,
) -> Image:
    """A third of the rows are any bytes."""
    out = image.copy()
    out[80:160] = RANDOM.integers(0, 256, out[80:160].shape)
    return out


@pytest.fixture(scope="module")
def ref() -> Reference:
    one = np.ones(SIZE.width_px)
    white, black = sampled(seen(one)), sampled(seen(0 * one))
    return reference(white, black, threshold_dn=20, full_scale=255, row=SAMPLER.row)


@pytest.mark.parametrize("period_px", [2, 4, 16, 64])
def test_a_garbled_frame_is_rougher_than_its_inverse(ref: Reference, period_px: int) -> None:
    bit = seen(stripes(period_px // 2, period_px=period_px))
    inverse = sampled(seen(1 - stripes(period_px // 2, period_px=period_px)))
    assert rougher(sampled(bit), [inverse], ref, noise=NOISE_DN) is None
    assert rougher(inverse, [sampled(bit)], ref, noise=NOISE_DN) is None
    told = rougher(sampled(garbled(bit)), [inverse], ref, noise=NOISE_DN)
    assert told is not None
    assert "damaged in transfer" in told
    assert rougher(inverse, [sampled(garbled(bit))], ref, noise=NOISE_DN) is None


def test_light_that_flickers_from_pixel_to_pixel_is_no_damage(ref: Reference) -> None:
    """A projector that dithers: all is lit in one frame of a pair, and nothing in the other."""
    lit = seen(np.ones(SIZE.width_px)) * (1 + RANDOM.normal(0, 0.13, SIZE.shape))
    assert rougher(sampled(lit), [sampled(seen(np.zeros(SIZE.width_px)))], ref, noise=NOISE_DN) is None


def lines(width_px: int = 1) -> list[Samples]:
    return [sampled(seen(stripes(width_px, shift))) for shift in range(PERIOD)]


@pytest.mark.parametrize("width_px", [1, 3])
def test_line_frames_add_up_alike_everywhere_whatever_the_response(ref: Reference, width_px: int) -> None:
    assert line_sum(lines(width_px), ref, noise=NOISE_DN) is None


def test_a_garbled_line_frame_is_blamed_by_the_sum(ref: Reference) -> None:
    frames = lines()
    frames[3] = sampled(garbled(seen(stripes(1, 3))))
    found = line_sum(frames, ref, noise=NOISE_DN)
    assert found is not None
    blamed, words = found
    assert 3 in blamed
    assert len(blamed) < PERIOD
    assert "do not add up" in words


def test_a_line_frame_that_shows_its_neighbours_lines_is_a_repetition_in_the_dark_too(ref: Reference) -> None:
    """Two exposures of one pattern: in dark such a camera has several times the noise that bright pixels tell."""
    again = sampled(seen(stripes(1, 2)) + RANDOM.normal(0, 3.0, SIZE.shape))
    assert repeated(again, lines(), ref, noise=0.5, factor=40.0) == 2
    assert repeated(sampled(seen(stripes(1, 2))), [sampled(seen(stripes(1, 3)))], ref, noise=0.5, factor=40.0) is None


def test_a_damaged_white_frame_does_not_pass_for_noise(ref: Reference) -> None:
    damaged = Reference(
        RANDOM.uniform(120, 250, len(ref.white)).astype(np.float32), ref.black, ref.contrast, ref.lit, ref.judged,
        ref.row, ref.band,
    )  # fmt: skip
    first, second = (
        [sampled(seen(stripes(16, period_px=32))), sampled(seen(1 - stripes(16, period_px=32)))],
        [sampled(seen(stripes(32, period_px=64))), sampled(seen(1 - stripes(32, period_px=64)))],
    )
    assert noise_dn(first[0], first[1], damaged) > 10 * NOISE_DN
    by_pairs = noise_dn(second[0], second[1], damaged, sums=[first[0] + first[1]])
    assert NOISE_FLOOR_DN < by_pairs < 3 * NOISE_DN

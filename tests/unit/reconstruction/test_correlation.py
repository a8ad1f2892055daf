"""Noise correlation of neighbouring pixels, with a known spectrum and without."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import convolve

from slrig.model import FloatArray, NoiseModel
from slrig.reconstruction.camera_response import PixelSum, edge_pixel_sum, estimate_noise, noise_correlation
from slrig.reconstruction.frames import AxisFrames
from tests.core import parametrize_core
from tests.unit.reconstruction.builders import code_frames, grid

SHAPE = (300, 400)
BITS = 9
EVERYWHERE = np.ones(SHAPE, dtype=np.bool_)
STENCIL = np.outer([1.0, 2.0, 3.0, 2.0, 1.0], [1.0, 2.0, 3.0, 2.0, 1.0])
Kernel = tuple[tuple[float, ...], ...]
ALONE: Kernel = ((1.0,),)
SMOOTH: Kernel = ((1 / 16, 2 / 16, 1 / 16), (2 / 16, 4 / 16, 2 / 16), (1 / 16, 2 / 16, 1 / 16))
PHASES = PixelSum(STENCIL, (0.12, 0.02))


@cache
def noisy(kernel: Kernel, *, bits: int = BITS, rows: float = 0.0) -> AxisFrames:
    """A plate under a code, with white noise run through a kernel, and with noise of whole rows."""
    random = np.random.default_rng(5)
    x, _ = grid(SHAPE)

    def seen(light: FloatArray | float) -> NDArray[np.float32]:
        noise = 2.0 * convolve(random.standard_normal(SHAPE), np.array(kernel), mode="wrap")
        noise += rows * random.standard_normal((SHAPE[0], 1))
        return np.asarray(30.0 + 0.02 * x + 120.0 * light + noise, dtype=np.float32)

    lit = [(x // (200 / 2**bit) % 2).astype(np.float64) for bit in range(bits)]
    return code_frames(
        bits=np.array([seen(each) for each in lit]),
        inverses=np.array([seen(1 - each) for each in lit]),
        white=seen(1.0),
        black=seen(0.0),
        full_scale=255.0,
    )


def by_sums(kernel: FloatArray, summed: PixelSum) -> float:
    """Σ |w * k|² over Σ|w|² Σ k²: what noise of that kernel does to the sum."""
    reach = len(summed.weights) // 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    across, down = summed.cycles_per_px
    turned = np.pad(summed.weights * np.exp(-2j * np.pi * (across * x + down * y)), len(kernel))
    both = convolve(turned.real, kernel, mode="constant") + 1j * convolve(turned.imag, kernel, mode="constant")
    return float(np.sum(np.abs(both) ** 2) / (np.sum(summed.weights**2) * np.sum(kernel**2)))


@pytest.mark.parametrize("summed", [PHASES, PixelSum(STENCIL), edge_pixel_sum(1.0)], ids=["phases", "values", "edges"])
@pytest.mark.parametrize(
    "kernel",
    [SMOOTH, pytest.param(((0, 0, 0), (0.25, 0.5, 0.25), (0, 0, 0)), marks=pytest.mark.slow)],
    ids=["interpolated", "along rows"],
)
def test_sums_err_more_by_noise_that_neighbours_share(kernel: Kernel, summed: PixelSum) -> None:
    frames = noisy(kernel)
    expected = by_sums(np.array(kernel), summed)
    assert expected > 1.4
    assert noise_correlation(frames, estimate_noise(frames), EVERYWHERE, summed) == pytest.approx(expected, rel=0.08)


@parametrize_core("summed", [PHASES, PixelSum(STENCIL), edge_pixel_sum(1.0)], ids=["phases", "values", "edges"])
def test_independent_noise_stays_as_it_is(summed: PixelSum) -> None:
    frames = noisy(ALONE)
    assert noise_correlation(frames, estimate_noise(frames), EVERYWHERE, summed) == 1.0


def test_noise_common_to_a_row_is_measured() -> None:
    frames = noisy(ALONE, rows=1.0)
    # Of the sums' variance, rows add Σ over rows of (Σ over columns of w)², a quarter as strong as pixels' noise.
    rows = np.sum(STENCIL.sum(axis=1) ** 2) / np.sum(STENCIL**2)
    found = noise_correlation(frames, estimate_noise(frames), EVERYWHERE, PixelSum(STENCIL))
    assert found == pytest.approx((4 + rows) / 5, rel=0.1)


def test_lamps_that_a_bit_shares_with_its_inverse_err_frames_but_not_their_difference() -> None:
    frames = noisy(ALONE)
    assert frames.inverses is not None
    lamp = 3.0 * np.random.default_rng(6).standard_normal((BITS, 1, 1)).astype(np.float32)
    lit = replace(frames, bits=frames.bits + lamp, inverses=frames.inverses + lamp)
    noise = NoiseModel(4.0, 0.0)
    assert noise_correlation(lit, noise, EVERYWHERE, edge_pixel_sum(1.0)) == 1.0
    assert noise_correlation(lit, noise, EVERYWHERE, PixelSum(STENCIL)) > 10.0


def lit_by_walls(frames: AxisFrames) -> AxisFrames:
    """Up to half as much light again from walls around, of which each bit lights another share."""
    assert frames.inverses is not None
    x, y = grid(SHAPE)
    glow = (60.0 * np.exp(-(((x - 150) / 120) ** 2) - ((y - 100) / 90) ** 2)).astype(np.float32)
    share = np.random.default_rng(7).uniform(0, 1, (BITS, 1, 1)).astype(np.float32)
    bits, inverses = frames.bits + share * glow, frames.inverses + (1 - share) * glow
    return replace(frames, bits=bits, inverses=inverses, white=frames.white + glow)


@parametrize_core("summed", [PHASES, PixelSum(STENCIL), edge_pixel_sum(1.0)], ids=["phases", "values", "edges"])
@pytest.mark.parametrize(
    "kernel", [pytest.param(ALONE, marks=pytest.mark.slow), SMOOTH], ids=["independent", "interpolated"]
)
def test_light_from_walls_around_is_no_noise_that_neighbours_share(kernel: Kernel, summed: PixelSum) -> None:
    frames = lit_by_walls(noisy(kernel))
    expected = by_sums(np.array(kernel), summed)
    assert noise_correlation(frames, estimate_noise(frames), EVERYWHERE, summed) == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_light_from_elsewhere_is_no_noise_of_edges_whichever_bits_there_are() -> None:
    x, y = grid(SHAPE)
    frames = noisy(SMOOTH)
    assert frames.inverses is not None
    # A tenth of white, and smooth: another one for each bit.
    glow = [12.0 * np.sin(x / 300 + bit) * np.cos(y / 240 - bit) for bit in range(BITS)]
    lit = replace(frames, bits=(frames.bits + np.array(glow)).astype(np.float32))
    summed, noise = edge_pixel_sum(1.0), estimate_noise(frames)
    expected = noise_correlation(frames, noise, EVERYWHERE, summed)
    assert noise_correlation(lit, noise, EVERYWHERE, summed) == pytest.approx(expected, rel=0.1)
    assert lit.inverses is not None
    fewer = replace(
        lit, bits=lit.bits[:5], inverses=lit.inverses[:5], gray=replace(lit.gray, bits=5, cell_px=16 * lit.gray.cell_px)
    )
    assert noise_correlation(fewer, noise, EVERYWHERE, summed) == noise_correlation(lit, noise, EVERYWHERE, summed)


def test_a_model_that_is_too_small_is_corrected_and_one_too_large_is_not() -> None:
    frames = noisy(ALONE)
    assert noise_correlation(frames, NoiseModel(2.0, 0.0), EVERYWHERE, PHASES) == pytest.approx(2.0, rel=0.05)
    assert noise_correlation(frames, NoiseModel(8.0, 0.0), EVERYWHERE, PHASES) == 1.0


def test_edges_of_the_code_do_not_count_where_they_break_the_sum() -> None:
    frames = noisy(ALONE)
    assert frames.inverses is not None
    bits = np.array(frames.bits)
    broken = bits.copy()
    # A camera that bends its values has the middle of an edge too bright.
    at_edges = np.abs(np.diff(bits, axis=2, append=bits[:, :, -1:])) > 60
    broken[at_edges] = 110
    inverses = np.where(at_edges, 110, frames.inverses).astype(np.float32)
    found = noise_correlation(replace(frames, bits=broken, inverses=inverses), NoiseModel(4.0, 0.0), EVERYWHERE, PHASES)
    assert found == 1.0


def test_unsuitable_frames_give_no_correlation() -> None:
    frames = noisy(SMOOTH)
    noise = estimate_noise(frames)
    assert noise_correlation(replace(frames, inverses=None), noise, EVERYWHERE, PHASES) == 1.0
    assert noise_correlation(frames, noise, ~EVERYWHERE, PHASES) == 1.0
    assert noise_correlation(noisy(ALONE, bits=2), noise, EVERYWHERE, PHASES) == 1.0
    clipped = replace(frames, full_scale=100.0)
    assert noise_correlation(clipped, noise, EVERYWHERE, PHASES) == 1.0

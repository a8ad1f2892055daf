"""Compression loss against the actual loss of JPEG, and frames that were never JPEG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.reconstruction.camera_response import PixelSum, compression_loss, equivalent_white_variance

SIDE = 400
EVERYWHERE = np.ones((SIDE, SIDE), dtype=np.bool_)
Image = NDArray[np.float32]


def stripes(*, noise_dn: float = 1.5, period_px: float = 7.3, seed: int = 1) -> Image:
    """Bent bright lines on a surface that is brighter on one side, whole grey levels."""
    y, x = np.mgrid[:SIDE, :SIDE]
    phase = 2 * np.pi * (x + 0.05 * y + 6 * np.sin(y / 40)) / period_px
    light = 20 + (60 + 0.25 * x) * np.exp(3 * (np.cos(phase) - 1))
    noise = noise_dn * np.random.default_rng(seed).standard_normal(light.shape)
    return np.asarray(np.clip(np.rint(light + noise), 1, 250), dtype=np.float32)


def decoded(image: Image, quality: int, *, colour: bool = False, limited: bool = False) -> Image:
    """As it comes out of a JPEG: grey or in colour, with luma from 0 to 255 or from 16 to 235."""
    given: NDArray[Any] = np.rint(16 + image * (219 / 255)) if limited else image
    given = given.astype(np.uint8)
    if colour:
        given = np.dstack([(0.8 * given).astype(np.uint8), given, (0.9 * given).astype(np.uint8)])
    done, data = cv2.imencode(".jpg", given, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    seen = cv2.imdecode(data, cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE)
    assert seen is not None
    grey = cv2.cvtColor(seen, cv2.COLOR_BGR2GRAY) if colour else seen
    if limited:
        grey = np.clip(np.rint((grey - 16.0) * 255 / 219), 0, 255)
    return np.asarray(grey, dtype=np.float32)


def loss_in_fact(image: Image, seen: Image) -> NDArray[np.float64]:
    tiles = (seen - image).reshape(SIDE // 8, 8, SIDE // 8, 8).swapaxes(1, 2).reshape(-1, 8, 8)
    waves = [cv2.dct(np.ascontiguousarray(tile)) for tile in tiles]
    return np.asarray(np.mean(np.square(waves), axis=0, dtype=np.float64))


@pytest.mark.parametrize(
    ("quality", "colour", "limited"),
    [(95, False, False), (50, False, False), (90, True, False), (75, False, True)],
)
def test_the_loss_is_measured_in_the_decoded_pixels(quality: int, colour: bool, limited: bool) -> None:
    seen = decoded(stripes(), quality, colour=colour, limited=limited)
    before = decoded(stripes(), 100, colour=colour, limited=limited)
    estimated, found = compression_loss([seen], [seen], EVERYWHERE, 255.0), loss_in_fact(before, seen)
    for cycles_per_px in ((0.0, 0.0), (1 / 7.3, 0.0)):
        summed = PixelSum(np.outer([1, 2, 3, 2, 1], [1, 2, 3, 2, 1]) / 81, cycles_per_px)
        ratio = equivalent_white_variance(estimated, summed) / equivalent_white_variance(found, summed)
        assert 0.4 < ratio < 1.25


def drawn(steps: int) -> Image:
    """Few grey levels and no noise, the same in every block: coefficients have few values, too."""
    y, x = np.mgrid[:SIDE, :SIDE]
    return np.asarray(40 + 30 * ((x + y) % 8 // (8 // steps)), dtype=np.float32)


@pytest.mark.parametrize(
    "image",
    [
        stripes(),
        stripes(noise_dn=0.0),
        stripes(noise_dn=0.0, period_px=8.0),
        stripes(noise_dn=0.4),
        drawn(2),
        drawn(4),
        np.full((SIDE, SIDE), 80, dtype=np.float32),
        np.random.default_rng(3).integers(1, 255, (SIDE, SIDE)).astype(np.float32),
        cv2.GaussianBlur(stripes(), (0, 0), 1.0),
    ],
    ids=["noise", "none", "none, by blocks", "little", "two levels", "four levels", "flat", "random", "smooth"],
)
def test_frames_without_loss_have_zero_loss(image: Image) -> None:
    assert not compression_loss([image], [image], EVERYWHERE, 255.0).any()


def test_clipped_blocks_and_blocks_outside_the_mask_are_ignored() -> None:
    seen = decoded(stripes(), 75)
    assert compression_loss([seen], [seen], EVERYWHERE, 255.0).any()
    assert not compression_loss([seen], [seen], ~EVERYWHERE, 255.0).any()
    assert not compression_loss([seen], [seen], EVERYWHERE, 30.0).any()


def test_steps_are_looked_for_in_the_code_where_lines_are_cut_off_at_zero() -> None:
    dark = np.maximum(stripes() - 40, 0)
    seen, code = decoded(dark, 75), decoded(stripes(), 75)
    assert not compression_loss([seen], [seen], EVERYWHERE, 255.0).any()
    estimated, found = compression_loss([seen], [code], EVERYWHERE, 255.0), loss_in_fact(dark, seen)
    assert 0.5 < np.mean(estimated) / np.mean(found) < 1.5


@pytest.mark.parametrize("cycles_per_px", [(0.0, 0.0), (0.13, 0.02)])
def test_errors_of_pixels_propagate_to_their_weighted_sum(cycles_per_px: tuple[float, float]) -> None:
    """Errors of known spectrum, drawn block by block and weighed."""
    random = np.random.default_rng(7)
    loss = random.uniform(0, 9, (8, 8)) * (np.add.outer(np.arange(8), np.arange(8)) < 5)
    waves = random.standard_normal((100, 100, 8, 8)) * np.sqrt(loss)
    tiles = np.array([[cv2.idct(tile) for tile in row] for row in waves])
    errors = tiles.swapaxes(1, 2).reshape(800, 800)
    weights = np.outer([1, 3, 4, 3, 1], [0.5, 2, 3, 2, 0.5])
    y, x = np.mgrid[:800, :800]
    turned = errors * np.exp(-2j * np.pi * (cycles_per_px[0] * x + cycles_per_px[1] * y))
    sums = cv2.filter2D(turned.real, -1, weights) + 1j * cv2.filter2D(turned.imag, -1, weights)
    found = float(np.mean(np.abs(sums[8:-8, 8:-8]) ** 2))
    estimated = equivalent_white_variance(loss, PixelSum(weights, cycles_per_px)) * float(np.sum(weights**2))
    assert estimated == pytest.approx(found, rel=0.05)


def test_independent_pixels_are_their_own_equivalent() -> None:
    assert equivalent_white_variance(np.full((8, 8), 2.5), PixelSum(np.ones((3, 3)), (0.1, 0.0))) == pytest.approx(2.5)

"""The centroid of a pixel's light, against light that is blurred numerically on a fine grid."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from slrig.model import FloatArray
from slrig.reconstruction.centroid import at_pixel_centres, third_order_px
from slrig.reconstruction.phase import PositionMap
from tests.unit.reconstruction.builders import grid

FINE = 20
PIXELS = 60
BLUR_PX = 0.55
PERIOD_PX = 8.0


def seen_through_blur(
    albedo: FloatArray, position: FloatArray, blur_px: float = BLUR_PX
) -> tuple[FloatArray, FloatArray]:
    """Phase position and brightness at each pixel of a row, from albedo and position on the fine grid.

    The light of eight shifts, each a raised cosine over the projector, is blurred as a whole: no formula of the code
    under test is used.
    """
    shifts = np.arange(8)
    light = 1 + np.cos(2 * np.pi / PERIOD_PX * (position[:, None] - shifts))
    lines = gaussian_filter1d(albedo[:, None] * light, blur_px * FINE, axis=0, mode="nearest")[FINE // 2 :: FINE]
    white = gaussian_filter1d(albedo, blur_px * FINE, mode="nearest")[FINE // 2 :: FINE]
    phase = np.angle((lines * np.exp(2j * np.pi / PERIOD_PX * shifts)).sum(axis=1)) * PERIOD_PX / (2 * np.pi)
    true = position[FINE // 2 :: FINE]
    return phase + PERIOD_PX * np.rint((true - phase) / PERIOD_PX), white


def fine_x() -> FloatArray:
    return (np.arange(PIXELS * FINE) - FINE // 2) / FINE


def as_map(row: FloatArray) -> NDArray[np.float32]:
    return np.tile(row, (5, 1)).astype(np.float32)


NOISELESS = np.zeros((5, PIXELS), dtype=np.float32)


@pytest.mark.parametrize(("dark", "bright"), [(1.0, 2.0), (1.0, 7.0), (7.0, 1.0)])
@pytest.mark.parametrize("slope", [1.2, -0.7])
def test_an_edge_of_the_albedo_bends_the_position_half_as_much(dark: float, bright: float, slope: float) -> None:
    x = fine_x()
    position = 40 + slope * x
    measured, white = seen_through_blur(np.where(x < 30.3, dark, bright), position)
    true = position[FINE // 2 :: FINE]
    centred = at_pixel_centres(
        PositionMap(as_map(measured), as_map(0 * measured)), as_map(white * 20), NOISELESS, BLUR_PX
    )
    before, after = np.abs(measured - true)[5:-5], np.abs(centred.position[2] - true)[5:-5]
    assert before.max() > 0.1 * abs(slope)
    # Differences over two pixels see a step of the albedo smoother than the blur makes it: a part stays.
    assert after.max() < 0.6 * before.max()
    assert np.sqrt((after**2).mean()) < 0.6 * np.sqrt((before**2).mean())


def test_smooth_texture_of_seven_to_one_bends_it_a_tenth_as_much() -> None:
    x = fine_x()
    position = 40 + 1.2 * x
    measured, white = seen_through_blur(7 ** (0.5 + 0.5 * np.sin(x / 1.5)), position)
    true = position[FINE // 2 :: FINE]
    centred = at_pixel_centres(
        PositionMap(as_map(measured), as_map(0 * measured)), as_map(white * 20), NOISELESS, BLUR_PX
    )
    before, after = np.abs(measured - true)[5:-5], np.abs(centred.position[2] - true)[5:-5]
    assert before.max() > 0.1
    assert np.sqrt((after**2).mean()) < 0.2 * np.sqrt((before**2).mean())


def test_an_even_surface_stays_as_it_is() -> None:
    position = as_map(40 + 1.3 * np.arange(30.0))
    sigma = np.full_like(position, 0.02)
    centred = at_pixel_centres(PositionMap(position, sigma), np.full_like(position, 100), 0 * position, BLUR_PX)
    np.testing.assert_array_equal(centred.position, position)
    np.testing.assert_array_equal(centred.sigma, sigma)


def test_noise_of_white_and_black_hardly_enters() -> None:
    random = np.random.default_rng(4)
    shape = (80, 90)
    position = (40 + 1.2 * np.arange(90.0) + np.zeros(shape)).astype(np.float32)
    white = (100 + random.normal(0, 3, shape)).astype(np.float32)
    told = at_pixel_centres(
        PositionMap(position, 0 * position), white, np.full(shape, 3, dtype=np.float32), BLUR_PX
    ).position
    untold = at_pixel_centres(PositionMap(position, 0 * position), white, 0 * white, BLUR_PX).position
    assert np.std(told - position) < 0.6 * np.std(untold - position)
    # A texture well above the noise is undone all the same.
    white = (100 * np.exp(0.3 * np.sin(np.arange(90.0) / 2)) + random.normal(0, 1, shape)).astype(np.float32)
    found = at_pixel_centres(PositionMap(position, 0 * position), white, np.ones(shape, dtype=np.float32), BLUR_PX)
    wanted = BLUR_PX**2 * 1.2 * 0.15 * np.cos(np.arange(90.0) / 2)
    inner = slice(5, -5)
    moved = (position - found.position)[:, inner]
    assert np.sqrt(np.mean((moved - wanted[inner]) ** 2)) < 0.3 * np.sqrt(np.mean(wanted[inner] ** 2))


@pytest.mark.parametrize("blur_px", [1.2, 1.5])
@pytest.mark.parametrize("slope", [0.7, 1.2])
def test_what_the_first_order_leaves_at_an_edge_out_of_focus_is_stated(blur_px: float, slope: float) -> None:
    x = fine_x()
    position = 40 + slope * x
    measured, white = seen_through_blur(np.where(x < 30.3, 1.0, 7.0), position, blur_px)
    seen = PositionMap(as_map(measured), as_map(0 * measured))
    centred = at_pixel_centres(seen, as_map(20 * white), NOISELESS, blur_px)
    usable = np.ones(seen.position.shape, dtype=np.bool_)
    stated = third_order_px(seen, centred, usable, blur_px, PERIOD_PX)[2]
    left = (centred.position[2] - position[FINE // 2 :: FINE]) / slope
    at_edge = slice(24, 37)
    assert 0.5 < np.sqrt(np.mean(stated[at_edge] ** 2) / np.mean(left[at_edge] ** 2)) < 1.2
    assert stated[45:].max() < 1e-3
    assert not third_order_px(seen, centred, ~usable, blur_px, PERIOD_PX).any()


@pytest.mark.parametrize("blur_px", [0.4, 0.65, 0.9])
def test_edges_of_a_print_tell_how_wide_the_blur_is(blur_px: float) -> None:
    x = np.arange(PIXELS * FINE) / FINE - 0.5
    position = 40 + 1.1 * x
    measured, white = seen_through_blur(np.where(np.floor(x / 7.3) % 2 == 0, 1.0, 5.0), position, blur_px)
    seen = PositionMap(np.tile(measured, (25, 1)).astype(np.float32), np.full((25, PIXELS), 0.02, dtype=np.float32))
    contrast, quiet = np.tile(20 * white, (25, 1)).astype(np.float32), np.full((25, PIXELS), 0.1, dtype=np.float32)
    clear = np.ones(contrast.shape, dtype=np.bool_)
    expected_px = 0.65
    told, untold = (
        at_pixel_centres(seen, contrast, quiet, expected_px, **known).position[12, 5:-5]
        for known in ({"clear": clear}, {})
    )
    # As much blur as displaces positions so far.
    far = np.abs(seen.position[12, 5:-5] - untold)
    ratio = np.abs(seen.position[12, 5:-5] - told)[far > 0.05] / far[far > 0.05]
    assert expected_px * np.sqrt(np.median(ratio)) == pytest.approx(blur_px, rel=0.15)
    # Where nothing is clear of shadows, what is expected stands.
    unclear = at_pixel_centres(seen, contrast, quiet, expected_px, clear=~clear).position[12, 5:-5]
    np.testing.assert_array_equal(unclear, untold)


def test_shading_that_follows_the_surface_tells_no_blur() -> None:
    x, y = grid((40, 90))
    flutes = 3 * np.sin(x / 4)
    # Light from the side: brighter where the surface turns to it.
    contrast = (100 * np.exp(0.3 * np.cos(x / 4))).astype(np.float32)
    random = np.random.default_rng(2)
    position = (40 + 1.1 * x + 0.1 * y + 0.1 * flutes + random.normal(0, 0.01, x.shape)).astype(np.float32)
    seen, quiet = PositionMap(position, np.full_like(position, 0.01)), np.full_like(position, 0.1)
    known = at_pixel_centres(seen, contrast, quiet, BLUR_PX).position
    told = at_pixel_centres(seen, contrast, quiet, BLUR_PX, clear=np.ones(x.shape, dtype=np.bool_)).position
    np.testing.assert_array_equal(told, known)

"""The centroid of a pixel's light: against light that is blurred on a fine grid, its kernels against plain numpy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import correlate, gaussian_filter1d

from slrig.kernels import in_bands
from slrig.model import FloatArray
from slrig.reconstruction.phase import (
    PositionMap,
    _edge_stencil,
    _edges_kernel,
    _shift_kernel,
    centroid_residual_px,
    resample_to_pixel_centres,
)
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
    centred = resample_to_pixel_centres(
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
    centred = resample_to_pixel_centres(
        PositionMap(as_map(measured), as_map(0 * measured)), as_map(white * 20), NOISELESS, BLUR_PX
    )
    before, after = np.abs(measured - true)[5:-5], np.abs(centred.position[2] - true)[5:-5]
    assert before.max() > 0.1
    assert np.sqrt((after**2).mean()) < 0.2 * np.sqrt((before**2).mean())


def test_noise_of_white_and_black_hardly_enters() -> None:
    random = np.random.default_rng(4)
    shape = (80, 90)
    position = (40 + 1.2 * np.arange(90.0) + np.zeros(shape)).astype(np.float32)
    white = (100 + random.normal(0, 3, shape)).astype(np.float32)
    estimated = resample_to_pixel_centres(
        PositionMap(position, 0 * position), white, np.full(shape, 3, dtype=np.float32), BLUR_PX
    ).position
    fixed = resample_to_pixel_centres(PositionMap(position, 0 * position), white, 0 * white, BLUR_PX).position
    assert np.std(estimated - position) < 0.6 * np.std(fixed - position)
    # A texture well above the noise is undone all the same.
    white = (100 * np.exp(0.3 * np.sin(np.arange(90.0) / 2)) + random.normal(0, 1, shape)).astype(np.float32)
    found = resample_to_pixel_centres(
        PositionMap(position, 0 * position), white, np.ones(shape, dtype=np.float32), BLUR_PX
    )
    wanted = BLUR_PX**2 * 1.2 * 0.15 * np.cos(np.arange(90.0) / 2)
    inner = slice(5, -5)
    moved = (position - found.position)[:, inner]
    assert np.sqrt(np.mean((moved - wanted[inner]) ** 2)) < 0.3 * np.sqrt(np.mean(wanted[inner] ** 2))


@pytest.mark.parametrize("blur_px", [1.2, 1.5])
@pytest.mark.parametrize("slope", [0.7, 1.2])
def test_the_residual_at_an_edge_out_of_focus_is_stated(blur_px: float, slope: float) -> None:
    x = fine_x()
    position = 40 + slope * x
    measured, white = seen_through_blur(np.where(x < 30.3, 1.0, 7.0), position, blur_px)
    seen = PositionMap(as_map(measured), as_map(0 * measured))
    centred = resample_to_pixel_centres(seen, as_map(20 * white), NOISELESS, blur_px)
    usable = np.ones(seen.position.shape, dtype=np.bool_)
    stated = centroid_residual_px(seen, centred, usable, blur_px, PERIOD_PX, ~usable)[2]
    left = (centred.position[2] - position[FINE // 2 :: FINE]) / slope
    at_edge = slice(24, 37)
    assert 0.5 < np.sqrt(np.mean(stated[at_edge] ** 2) / np.mean(left[at_edge] ** 2)) < 1.2
    assert stated[45:].max() < 1e-3
    assert not centroid_residual_px(seen, centred, ~usable, blur_px, PERIOD_PX, ~usable).any()


@pytest.mark.parametrize("blur_px", [0.4, 0.65, 0.9])
def test_edges_of_a_print_determine_the_blur(blur_px: float) -> None:
    x = np.arange(PIXELS * FINE) / FINE - 0.5
    position = 40 + 1.1 * x
    measured, white = seen_through_blur(np.where(np.floor(x / 7.3) % 2 == 0, 1.0, 5.0), position, blur_px)
    seen = PositionMap(np.tile(measured, (25, 1)).astype(np.float32), np.full((25, PIXELS), 0.02, dtype=np.float32))
    contrast, quiet = np.tile(20 * white, (25, 1)).astype(np.float32), np.full((25, PIXELS), 0.1, dtype=np.float32)
    clear = np.ones(contrast.shape, dtype=np.bool_)
    expected_px = 0.65
    estimated, fixed = (
        resample_to_pixel_centres(seen, contrast, quiet, expected_px, **known).position[12, 5:-5]
        for known in ({"clear": clear}, {})
    )
    # As much blur as displaces positions so far.
    far = np.abs(seen.position[12, 5:-5] - fixed)
    ratio = np.abs(seen.position[12, 5:-5] - estimated)[far > 0.05] / far[far > 0.05]
    assert expected_px * np.sqrt(np.median(ratio)) == pytest.approx(blur_px, rel=0.15)
    # Where nothing is clear of shadows, what is expected stands.
    unclear = resample_to_pixel_centres(seen, contrast, quiet, expected_px, clear=~clear).position[12, 5:-5]
    np.testing.assert_array_equal(unclear, fixed)


def test_shading_that_follows_the_surface_does_not_determine_the_blur() -> None:
    x, y = grid((40, 90))
    flutes = 3 * np.sin(x / 4)
    # Light from the side: brighter where the surface turns to it.
    contrast = (100 * np.exp(0.3 * np.cos(x / 4))).astype(np.float32)
    random = np.random.default_rng(2)
    position = (40 + 1.1 * x + 0.1 * y + 0.1 * flutes + random.normal(0, 0.01, x.shape)).astype(np.float32)
    seen, quiet = PositionMap(position, np.full_like(position, 0.01)), np.full_like(position, 0.1)
    known = resample_to_pixel_centres(seen, contrast, quiet, BLUR_PX).position
    estimated = resample_to_pixel_centres(
        seen, contrast, quiet, BLUR_PX, clear=np.ones(x.shape, dtype=np.bool_)
    ).position
    np.testing.assert_array_equal(estimated, known)


SIXTH_ORDER = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60
SHAPE = (47, 61)


def seen_print(seed: int) -> tuple[PositionMap, NDArray[np.float32], NDArray[np.float32]]:
    """A curved surface with a step, holes and noise; white minus black of squares on it, and its deviation."""
    random = np.random.default_rng(seed)
    x, y = grid(SHAPE)
    position = 40 + 0.9 * x + 0.3 * y + 0.002 * (x - 30) ** 2 + 12 * (x > 50) + random.normal(0, 0.03, SHAPE)
    position[random.random(SHAPE) < 0.003] = np.nan
    sigma = 0.02 + 0.01 * random.random(SHAPE)
    squares = np.where((np.floor(x / 7.3) + np.floor(y / 9.1)) % 2 == 0, 20.0, 120.0)
    contrast = cv2.GaussianBlur(squares, (0, 0), 0.7) + random.normal(0, 1.0, SHAPE)
    contrast[random.random(SHAPE) < 0.003] = 0
    deviation = np.where(x > 20, 1.0, 1.5)
    single = [np.asarray(each, dtype=np.float32) for each in (position, sigma, contrast, deviation)]
    return PositionMap(single[0], single[1]), single[2], single[3]


def logarithm(contrast: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.log(np.where(contrast > 0, contrast, np.nan)).astype(np.float32)


def shift_along_rows(position: FloatArray, light: FloatArray, variance: FloatArray) -> FloatArray:
    def beside(values: FloatArray) -> list[FloatArray]:
        padded = np.pad(values, ((0, 0), (3, 3)), constant_values=np.nan)
        return [padded[:, k : k + values.shape[1]] for k in range(7)]

    p, log = beside(position), beside(light)
    flat = np.abs(p[0] - 2 * p[3] + p[6]) < 1
    fine = sum(weight * each for weight, each in zip(SIXTH_ORDER, log, strict=True) if weight)
    wide = (log[6] - log[0]) / 6
    more, plain = fine - wide, (log[4] - log[2]) / 2
    estimated = wide + more**5 / (more**4 + 16 * (np.sum(SIXTH_ORDER**2) * variance) ** 2)
    slope = np.where(flat, (p[6] - p[0]) / 6, (p[4] - p[2]) / 2)
    rise = np.where(flat & np.isfinite(fine), estimated, plain**5 / (plain**4 + 16 * (0.5 * variance) ** 2))
    of_one = np.abs(p[2] - 2 * p[3] + p[4]) < 4
    return np.where(of_one, np.nan_to_num(slope * rise), 0)


def shift_of(
    position: NDArray[np.float32], contrast: NDArray[np.float32], deviation: NDArray[np.float32]
) -> NDArray[np.float32]:
    shift = np.zeros_like(position)
    in_bands(_shift_kernel, len(position), position, logarithm(contrast), contrast, deviation, shift)
    return shift


def test_the_shift_is_that_of_the_rule() -> None:
    for seed in range(3):
        (position, _), contrast, deviation = seen_print(seed)
        p, light = position.astype(float), logarithm(contrast).astype(float)
        variance = (deviation.astype(float) / np.maximum(contrast, 1e-6)) ** 2
        wanted = shift_along_rows(p, light, variance) + shift_along_rows(p.T, light.T, variance.T).T
        wanted[[0, -1]] = 0
        wanted[:, [0, -1]] = 0
        assert np.quantile(np.abs(wanted), 0.9) > 0.1
        np.testing.assert_allclose(shift_of(position, contrast, deviation), wanted, rtol=1e-4, atol=2e-5)


def test_the_blur_by_edges_matches_the_formula() -> None:
    stencil, expected = _edge_stencil(), 0.42
    for seed in range(3):
        (position, sigma), contrast, deviation = seen_print(seed)
        shift = shift_of(position, contrast, deviation)
        p = position.astype(float)
        whole = correlate(np.isfinite(p).astype(int), np.ones((11, 11)), mode="constant") == stencil.size
        sums = np.zeros((len(p), 5))
        given = position, sigma, shift, contrast, deviation, whole.view(np.uint8), stencil, expected
        in_bands(_edges_kernel, len(p), *given, sums)

        off_r = correlate(shift.astype(float), stencil, mode="constant")
        off_p = correlate(np.nan_to_num(p), stencil, mode="constant") - stencil.sum() * p
        steepness = np.hypot(*(np.gradient(p, axis=axis) for axis in (0, 1)))
        # The smoothed derivative of noise, and smoothed noise, for a Gaussian of 1 px.
        least = 2 * steepness * deviation / np.where(contrast > 0, contrast, np.nan) / np.sqrt(8 * np.pi)
        noise = sigma / (2 * np.sqrt(np.pi))
        strong = whole & (shift != 0) & (np.abs(off_r) > least)
        asked = np.zeros_like(strong)
        asked[::4, ::4] = True
        strong &= asked
        near = strong & (np.abs(off_p / off_r - expected) < 1.5)
        weight = 1 / noise**2
        wanted = [off_r * off_p, off_r**2, off_p**2, 1 / weight]
        assert strong.sum() > near.sum() > 15
        np.testing.assert_array_equal(sums[:, 4], strong.sum(axis=1))
        for estimated, each in zip(sums[:, :4].T, wanted, strict=True):
            np.testing.assert_allclose(
                estimated, np.sum(np.where(near, weight * each, 0), axis=1), rtol=1e-3, atol=1e-3
            )


def test_the_weights_do_not_respond_to_a_quadratic_surface() -> None:
    stencil = _edge_stencil()
    x, y = grid(stencil.shape)
    for each in (np.ones_like(x), x, y, x * x, x * y, y * y):
        assert abs(np.sum(stencil * each)) < 1e-9
    assert np.sum(stencil * np.exp(-((x - 5) ** 2 + (y - 5) ** 2) / 2)) > 0.1

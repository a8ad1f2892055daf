"""Effect of blur on curved surfaces, against light that is blurred on a fine grid; the kernel against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from slrig.model import FloatArray
from slrig.reconstruction.blur import correct_curvature
from slrig.reconstruction.phase import PositionMap

FINE = 8
PIXELS = 36
BLUR_PX = 0.65
PERIOD_PX = 8.0
INNER = (slice(6, -6),) * 2


def fine_grid() -> tuple[FloatArray, FloatArray]:
    at = (np.arange(PIXELS * FINE) - (FINE - 1) / 2) / FINE - PIXELS / 2
    return tuple(np.meshgrid(at, at))  # type: ignore[return-value]


def at_pixels(fine: FloatArray) -> FloatArray:
    """Between the two middle rows and columns of each pixel's samples."""
    middle = slice(FINE // 2 - 1, None, FINE), slice(FINE // 2, None, FINE)
    return np.asarray(sum(fine[rows, columns] for rows in middle for columns in middle) / 4)


def seen_through_blur(position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Phase position at each pixel, and the true one; no formula of the code under test is used."""
    shifts = np.arange(8)
    lights = (1 + np.cos(2 * np.pi / PERIOD_PX * (position - shift)) for shift in shifts)
    lines = np.stack([at_pixels(gaussian_filter(light, BLUR_PX * FINE)) for light in lights])
    turns = np.exp(2j * np.pi / PERIOD_PX * shifts)[:, None, None]
    phase = np.angle((lines * turns).sum(axis=0)) * PERIOD_PX / (2 * np.pi)
    true = at_pixels(position)
    return phase + PERIOD_PX * np.rint((true - phase) / PERIOD_PX), true


def freed(position: FloatArray, sigma_px: float = 0.001, usable: NDArray[np.bool_] | None = None) -> FloatArray:
    everywhere = np.ones(position.shape, dtype=np.bool_) if usable is None else usable
    seen = PositionMap(position.astype(np.float32), np.full(position.shape, sigma_px, dtype=np.float32))
    return correct_curvature(seen, everywhere, BLUR_PX**2, PERIOD_PX).position.astype(np.float64)


@pytest.mark.parametrize(("right", "down"), [(1.1, 0.2), (0.3, -0.9), (2.4, 0.5)])
@pytest.mark.parametrize("bend", [(0.02, 0.0, 0.0), (0.0, 0.0, 0.02), (-0.015, 0.01, -0.01)])
def test_a_curved_surface_is_not_displaced(right: float, down: float, bend: tuple[float, float, float]) -> None:
    x, y = fine_grid()
    xx, xy, yy = bend
    measured, true = seen_through_blur(40 + right * x + down * y + xx * x * x + xy * x * y + yy * y * y)
    before = np.abs(measured - true)[INNER].max()
    after = np.abs(freed(measured) - true)[INNER].max()
    assert before > 0.004
    assert after < 0.12 * before


def test_noise_of_an_even_surface_stays_as_it_is() -> None:
    y, x = np.indices((200, 200)).astype(np.float64)
    noise = np.random.default_rng(3).normal(0, 0.02, x.shape)
    plane = 300 + 1.1 * x + 0.3 * y
    moved = freed(plane + noise, 0.02) - plane - noise
    assert np.sqrt((moved**2).mean()) < 0.02 * 0.02
    assert abs(moved.mean()) < 2e-5


def test_a_surface_bends_up_to_its_border() -> None:
    x, y = fine_grid()
    measured, true = seen_through_blur(40 + 1.1 * x + 0.2 * y - 0.015 * x * x + 0.01 * x * y - 0.01 * y * y)
    usable = np.zeros(measured.shape, dtype=np.bool_)
    usable[INNER] = True
    usable[17:19, 17:19] = False
    after, before = np.abs(freed(measured, usable=usable) - true), np.abs(measured - true)
    corner = (0, 0, -1, -1), (0, -1, 0, -1)  # farther from a whole window than a neighbour
    np.testing.assert_allclose(after[INNER][corner], before[INNER][corner], atol=5e-6)
    usable[6, 6] = usable[6, -7] = usable[-7, 6] = usable[-7, -7] = False
    assert before[usable].max() > 0.004
    assert after[usable].max() < 0.2 * before[usable].max()


def test_a_neighbour_on_another_surface_is_ignored() -> None:
    y, x = np.indices((30, 40)).astype(np.float64)
    position = 40 + 1.1 * x + 0.02 * x * x + 0.01 * y * y
    position[:, 20] = np.nan
    position[:, 21:24] += 0.5  # too narrow for a window of its own
    usable = np.ones(position.shape, dtype=np.bool_)
    usable[:, 24] = False
    given = position.astype(np.float32).astype(np.float64)
    stays = np.isnan(given) | (freed(given, usable=usable) == given)
    assert stays[:, 20:25].all()
    assert not stays[3:-3, :20].any()
    assert not stays[3:-3, 25:29].any()


def test_the_kernel_matches_plain_least_squares() -> None:
    random = np.random.default_rng(8)
    y, x = np.indices((24, 26)).astype(np.float64)
    # A step in slope, so that both windows are taken, and noise, so that some is in doubt.
    position = 200 + 1.3 * x - 0.4 * y + 0.002 * x * y + 0.2 * np.abs(x - 13) + 0.004 * (y - 9) ** 2
    position = (position + random.normal(0, 0.01, x.shape)).astype(np.float32).astype(np.float64)
    found = freed(position, 0.01)
    inner = (3, 3), (3, 20), (9, 6), (12, 12), (12, 13), (12, 16), (14, 17), (19, 19), (20, 22)
    beside = (0, 12), (1, 1), (1, 12), (2, 12), (2, 22), (12, 25), (22, 1), (22, 13), (23, 13), (23, 14)
    for row, column in (*inner, *beside):
        assert found[row, column] == pytest.approx(plainly_freed(position, row, column, 0.01), abs=4e-5)


def plainly_freed(position: FloatArray, row: int, column: int, sigma_px: float) -> float:
    variance, taken = BLUR_PX**2, (np.nan, np.nan)
    # The middle of the nearest window that is whole, a pixel clear of the image's border.
    middle = [min(max(at, 3), extent - 4) for at, extent in zip((row, column), position.shape, strict=True)]
    for reach in (2, 4):
        window = tuple(slice(at - reach, at + reach + 1) for at in middle)
        if any(min(at, extent - 1 - at) <= reach for at, extent in zip(middle, position.shape, strict=True)):
            continue
        dy, dx = (each.ravel() for each in np.indices((2 * reach + 1,) * 2) - reach)
        terms = terms_of(dx, dy)
        coefficients = np.linalg.lstsq(terms, position[window].ravel())[0]
        _, gx, gy, cxx, cxy, cyy = coefficients
        slope, bends = np.array([gx, gy]), np.array([[2 * cxx, cxy], [cxy, 2 * cyy]])
        turn = (2 * np.pi / PERIOD_PX) ** 2 * variance
        shift = 0.5 * variance * (np.trace(bends) - turn * slope @ bends @ slope)
        spread = np.linalg.inv(terms.T @ terms)
        noise = variance * sigma_px * np.sqrt(spread[3, 3] + spread[5, 5] + 2 * spread[3, 5])
        if [row, column] != middle:
            there = terms_of(column - middle[1], row - middle[0])
            off = abs(position[row, column] - there @ coefficients)
            if off > 3 * sigma_px * np.sqrt(1 + there @ spread @ there):
                return float(position[row, column])
        if reach == 2 or abs(shift - taken[0]) <= 3 * taken[1]:
            taken = float(shift), float(noise)
    shift, noise = taken
    return float(position[row, column] - shift * shift**4 / (shift**4 + 16 * noise**4))


def terms_of(dx: NDArray[np.int_] | int, dy: NDArray[np.int_] | int) -> FloatArray:
    """Those of a quadratic surface, last."""
    return np.stack([np.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy], axis=-1).astype(np.float64)

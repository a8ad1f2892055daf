"""The kernels of the centroid, against the same written in plain numpy."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate

from slrig.kernels import in_bands
from slrig.model import FloatArray
from slrig.reconstruction.centroid import _beyond_quadratic, _edges_kernel, _shift_kernel
from slrig.reconstruction.phase import PositionMap
from tests.unit.reconstruction.builders import grid

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
    told = wide + more**5 / (more**4 + 16 * (np.sum(SIXTH_ORDER**2) * variance) ** 2)
    slope = np.where(flat, (p[6] - p[0]) / 6, (p[4] - p[2]) / 2)
    rise = np.where(flat & np.isfinite(fine), told, plain**5 / (plain**4 + 16 * (0.5 * variance) ** 2))
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


def test_what_edges_tell_of_the_blur_is_that_of_the_rule() -> None:
    stencil, expected = _beyond_quadratic(), 0.42
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
        for told, each in zip(sums[:, :4].T, wanted, strict=True):
            np.testing.assert_allclose(told, np.sum(np.where(near, weight * each, 0), axis=1), rtol=1e-3, atol=1e-3)


def test_the_weights_see_nothing_of_a_quadratic_surface() -> None:
    stencil = _beyond_quadratic()
    x, y = grid(stencil.shape)
    for each in (np.ones_like(x), x, y, x * x, x * y, y * y):
        assert abs(np.sum(stencil * each)) < 1e-9
    assert np.sum(stencil * np.exp(-((x - 5) ** 2 + (y - 5) ** 2) / 2)) > 0.1

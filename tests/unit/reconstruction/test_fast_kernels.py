"""Kernels that were written for speed, each against the plain way to the same numbers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slrig.model import FloatArray
from slrig.reconstruction.chaining import chain_points
from slrig.reconstruction.sheet_curves import SheetCurves
from slrig.reconstruction.steger import (
    _TAYLOR_BOX,
    EDGE,
    RIDGE,
    _centred_weights,
    kernels,
    newton_step,
    taylor_step,
)
from slrig.reconstruction.stripes import LinePoints, chained, gathered

KINDS = pytest.mark.parametrize("kind", [RIDGE, EDGE])


def filtered(image: FloatArray, sigma_px: float) -> list[FloatArray]:
    """r, rx, ry, rxx, rxy, ryy by OpenCV, in double precision."""
    zero, one, two = (kernel.astype(np.float64) for kernel in kernels(sigma_px))
    pairs = ((zero, zero), (one, zero), (zero, one), (two, zero), (one, one), (zero, two))
    return [np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, across, along)) for across, along in pairs]


@KINDS
@pytest.mark.parametrize(("sigma_px", "shape"), [(1.03, (41, 70)), (2.5, (40, 33)), (1.4, (70, 6))])
def test_first_step_is_taken_from_six_separable_filters(kind: int, sigma_px: float, shape: tuple[int, int]) -> None:
    # Narrower than the kernel's reach, too: beyond the border the image is reflected, more than once if need be.
    rng = np.random.default_rng(5)
    image = rng.normal(0, 1, shape).astype(np.float32)
    noise = rng.uniform(0.0, 0.1, shape).astype(np.float32)
    lit = rng.uniform(0, 1, shape) > 0.2
    r, rx, ry, rxx, rxy, ryy = filtered(image.astype(np.float64), sigma_px)
    offset, response = taylor_step(image, noise, lit, np.float32(0.5), *kernels(sigma_px), kind)
    kept = 0
    for y, x in np.ndindex(shape):
        if kind == RIDGE:
            values, vectors = np.linalg.eigh([[rxx[y, x], rxy[y, x]], [rxy[y, x], ryy[y, x]]])
            largest = int(np.argmax(np.abs(values)))
            normal, strength = vectors[:, largest], -values[largest]
            t = -float(normal @ [rx[y, x], ry[y, x]]) / values[largest]
        else:
            strength = np.hypot(rx[y, x], ry[y, x])
            normal, t = np.array([rx[y, x], ry[y, x]]) / strength, -r[y, x] / strength
        reach = np.abs(t * normal).max()
        # What lies at the very edge of a limit may fall on either side of it in single precision.
        if abs(reach - _TAYLOR_BOX) < 1e-3 or abs(strength - 0.5 * noise[y, x]) < 1e-4 or abs(strength) < 1e-3:
            continue
        if lit[y, x] and strength > 0.5 * noise[y, x] and reach < _TAYLOR_BOX:
            kept += 1
            assert response[y, x] == pytest.approx(strength, rel=1e-3)
            np.testing.assert_allclose(offset[y, x], t * normal, atol=2e-3)
        else:
            assert response[y, x] == 0
    assert kept > 10


@KINDS
@pytest.mark.parametrize("shape", [(20, 60), (20, 7)])
def test_unlit_margins_change_nothing_between_them(kind: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(6)
    image, noise = rng.normal(0, 1, shape).astype(np.float32), np.full(shape, 0.1, dtype=np.float32)
    everywhere = taylor_step(image, noise, np.ones(shape, dtype=np.bool_), np.float32(0.5), *kernels(1.2), kind)
    for begin, end in ((0, 3), (2, 4), (shape[1] - 1, shape[1]), (shape[1] // 2, shape[1] - 1)):
        lit = np.zeros(shape, dtype=np.bool_)
        lit[3:-1, begin:end] = rng.uniform(0, 1, (16, end - begin)) > 0.3
        offset, response = taylor_step(image, noise, lit, np.float32(0.5), *kernels(1.2), kind)
        np.testing.assert_array_equal(response, np.where(lit, everywhere[1], 0))
        np.testing.assert_array_equal(offset, np.where(lit[..., None], everywhere[0], 0))


@KINDS
@pytest.mark.parametrize("beyond", [(0, 0), (0, 3), (4, 0), (2, 2)])
def test_second_step_ends_with_the_image(kind: int, beyond: tuple[int, int]) -> None:
    # Its window, 11 pixels wide, ends with the image's last pixel: no others may count, nor be read.
    rng = np.random.default_rng(9)
    wide = cv2.GaussianBlur(rng.normal(0, 1, (40, 40)).astype(np.float32), (0, 0), 2.0)
    rows, columns = np.arange(10, 30, dtype=np.int32), rng.integers(10, 30, 20).astype(np.int32)
    offset = np.zeros((40, 40, 2), dtype=np.float32)
    wanted = newton_step(wide, offset, columns, rows, 1.3, kind)
    assert wanted[4].any()
    for i in range(len(rows)):
        top, left = rows[i] - 5 - beyond[0], columns[i] - 5 - beyond[1]
        cut = np.ascontiguousarray(wide[top : rows[i] + 6, left : columns[i] + 6])
        at = np.array([5 + beyond[1]], dtype=np.int32), np.array([5 + beyond[0]], dtype=np.int32)
        x, y, normals, response, kept = newton_step(cut, offset[: len(cut), : cut.shape[1]].copy(), *at, 1.3, kind)
        assert kept[0] == wanted[4][i]
        if kept[0]:
            np.testing.assert_allclose([x[0] + left, y[0] + top], [wanted[0][i], wanted[1][i]], atol=1e-10)
            np.testing.assert_allclose(normals[0], wanted[2][i], atol=1e-10)
            assert response[0] == pytest.approx(wanted[3][i], rel=1e-10)


@pytest.mark.parametrize("centre", [-0.6, 0.0, 0.37])
@pytest.mark.parametrize("sigma_px", [1.0, 2.5])
def test_weights_about_a_point_between_pixels(centre: float, sigma_px: float) -> None:
    at = np.arange(-9, 10) - centre
    bell = np.exp(-(at**2) / (2 * sigma_px**2))
    bell /= bell.sum()
    out = np.zeros((3, 19))
    _centred_weights(out, centre, sigma_px, np.exp(-(np.arange(-9.0, 10) ** 2) / (2 * sigma_px**2)))
    np.testing.assert_allclose(out[0], bell, atol=1e-14)
    np.testing.assert_allclose(out[1], at / sigma_px**2 * bell, atol=1e-14)
    np.testing.assert_allclose(out[2], (at**2 / sigma_px**2 - 1) / sigma_px**2 * bell, atol=1e-14)


@KINDS
def test_second_step_is_taken_from_kernels_centred_on_the_first(kind: int) -> None:
    sigma_px, radius = 1.3, 5
    rng = np.random.default_rng(8)
    image = cv2.GaussianBlur(rng.normal(0, 1, (50, 60)).astype(np.float32), (0, 0), 1.0)
    offset = rng.uniform(-0.6, 0.6, (50, 60, 2)).astype(np.float32)
    columns, rows = rng.integers(0, 60, 300).astype(np.int32), rng.integers(0, 50, 300).astype(np.int32)
    x, y, normals, strength, kept = newton_step(image, offset, columns, rows, sigma_px, kind)
    at = np.arange(-radius, radius + 1.0)
    for i in np.flatnonzero(kept):
        start = offset[rows[i], columns[i]].astype(np.float64)
        weights = []
        for middle in start:
            away = at - middle
            bell = np.exp(-(away**2) / (2 * sigma_px**2))
            bell /= bell.sum()
            weights.append([bell, away / sigma_px**2 * bell, (away**2 / sigma_px**2 - 1) / sigma_px**2 * bell])
        wx, wy = weights
        rows_of, columns_of = slice(rows[i] - radius, rows[i] + radius + 1), slice(columns[i] - 5, columns[i] + 6)
        window = image[rows_of, columns_of].astype(np.float64)
        gradient = np.array([wy[0] @ window @ wx[1], wy[1] @ window @ wx[0]])
        if kind == RIDGE:
            rxy = wy[1] @ window @ wx[1]
            hessian = [[wy[0] @ window @ wx[2], rxy], [rxy, wy[2] @ window @ wx[0]]]
            values, vectors = np.linalg.eigh(hessian)
            largest = int(np.argmax(np.abs(values)))
            normal, wanted = vectors[:, largest], -values[largest]
            t = float(normal @ gradient) / wanted
        else:
            wanted = float(np.hypot(*gradient))
            normal, t = gradient / wanted, -float(wy[0] @ window @ wx[0]) / wanted
        assert strength[i] == pytest.approx(wanted, rel=1e-9)
        np.testing.assert_allclose([x[i] - columns[i], y[i] - rows[i]], start + t * normal, atol=1e-9)
        assert abs(float(normals[i] @ normal)) == pytest.approx(1, abs=1e-9)
    assert 20 < kept.sum() < 280


def test_frames_are_chained_each_by_itself() -> None:
    rng = np.random.default_rng(6)
    y = np.arange(3.0, 40)
    lines = [np.stack([20 + shift + 0.2 * y + rng.normal(0, 0.05, len(y)), y], axis=1) for shift in (0.0, 4.0, 0.4)]
    normals = np.tile([1.0, -0.2] / np.hypot(1.0, 0.2), (2 * len(y), 1))

    def frame(*points: FloatArray) -> LinePoints:
        count = len(y) * len(points)
        strength, strong = rng.uniform(1, 2, count), rng.uniform(0, 1, count) > 0.3
        placed = np.concatenate([np.zeros((0, 2)), *points])
        return LinePoints(placed, normals[:count], strength, strong, rng.uniform(0.1, 0.2, count))

    frames = [frame(lines[0], lines[1]), frame(), frame(lines[0], lines[2])]
    stripes = chained(frames, (50, 60))
    alone = [chained([each], (50, 60)) for each in frames]
    assert set(stripes.frame.tolist()) == {0, 2}
    assert stripes.frame.tolist() == [k for k, each in enumerate(alone) for _ in range(len(each))]
    assert np.diff(stripes.offsets).tolist() == [int(n) for each in alone for n in np.diff(each.offsets)]
    for name in ("points_px", "normals", "sigma_px"):
        np.testing.assert_array_equal(getattr(stripes, name), np.concatenate([getattr(each, name) for each in alone]))


@pytest.mark.parametrize("strengths", [(1.0, 2.0), (2.0, 1.0), (2.0, 2.0)])
def test_of_two_points_in_one_pixel_the_stronger_is_chained(strengths: tuple[float, float]) -> None:
    line = np.stack([np.full(9, 20.0), np.arange(30.0, 39.0)], axis=1)
    points = np.concatenate([line[:5], [[20.1, 34.2]], line[5:]])
    strength = np.full(10, 3.0)
    strength[4:6] = strengths
    normals, strong = np.tile([1.0, 0.0], (10, 1)), np.ones(10, dtype=np.bool_)
    order, offsets = chain_points(points, normals, strength, strong, (41, 43))
    left_out = 4 if strengths[1] > strengths[0] else 5
    assert sorted(order.tolist()) == [i for i in range(10) if i != left_out]
    assert offsets.tolist() == [0, 9]


def test_gathering_is_indexing() -> None:
    rng = np.random.default_rng(2)
    points, normals, sigma = rng.normal(0, 1, (90, 2)), rng.normal(0, 1, (90, 2)), rng.normal(0, 1, 90)
    order = rng.permutation(90)[:50].astype(np.int32)
    for got, wanted in zip(gathered(order, points, normals, sigma), (points, normals, sigma), strict=True):
        np.testing.assert_array_equal(got, wanted[order])
    curves = SheetCurves(
        offsets=np.array([0, 90], dtype=np.int32), position_px=np.zeros(1), points_mm=rng.normal(0, 1, (90, 3)),
        deviation_mm=rng.normal(0, 1, (90, 3)), along_px=sigma, pixels_px=points,
        stripe=rng.integers(0, 9, 90).astype(np.int32), bridge_after=np.zeros(90, dtype=bool),
        source=rng.integers(0, 3, 90).astype(np.uint8),
    )  # fmt: skip
    keep = rng.uniform(0, 1, 90) > 0.5
    for index in (keep, order.astype(np.intp)):
        taken = curves.taken(index, offsets=curves.offsets, bridge_after=np.zeros(0, dtype=bool))
        for name in ("points_mm", "deviation_mm", "along_px", "pixels_px", "stripe", "source"):
            wanted, got = getattr(curves, name)[index], getattr(taken, name)
            assert got.dtype == wanted.dtype
            np.testing.assert_array_equal(got, wanted)

"""Thresholds of stripes, and the kernels of the detector against plain correlation."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, gaussian_filter
from scipy.special import ndtr

from slrig.model import FloatArray
from slrig.reconstruction.stripes import (
    _NEWTON_BOX,
    _SUPPORT,
    _TAYLOR_BOX,
    EDGE,
    RIDGE,
    LinePoints,
    StripeLimits,
    Stripes,
    chain_stripes,
    edge_points,
    gaussian_kernels,
    newton_step,
    stripe_points,
    taylor_step,
)
from tests.core import parametrize_core
from tests.unit.reconstruction.builders import gaussian_stripe, grid

SHAPE = (80, 90)
KINDS = pytest.mark.parametrize("kind", [RIDGE, EDGE], ids=["ridge", "edge"])


def found(
    image: NDArray[np.float32],
    *,
    noise: float = 0.01,
    limits: StripeLimits | None = None,
    lit: NDArray[np.bool_] | None = None,
) -> Stripes:
    return chain_stripes([points_of(image, noise=noise, limits=limits, lit=lit)], image.shape)


def points_of(
    image: NDArray[np.float32],
    *,
    noise: float = 0.01,
    limits: StripeLimits | None = None,
    lit: NDArray[np.bool_] | None = None,
) -> LinePoints:
    return stripe_points(
        image, np.full(image.shape, noise, dtype=np.float32),
        np.ones(image.shape, dtype=np.bool_) if lit is None else lit, limits or StripeLimits(), filter_px=1.2,
    )  # fmt: skip


def taylor_oracle(r: FloatArray, kind: int) -> tuple[float, float, float]:
    """(offset x, offset y, strength) of one pixel from r, rx, ry, rxx, rxy, ryy: Steger's equations, by eigh."""
    value, rx, ry, rxx, rxy, ryy = r
    if kind == RIDGE:
        values, vectors = np.linalg.eigh([[rxx, rxy], [rxy, ryy]])
        largest = int(np.argmax(np.abs(values)))
        normal, strength = vectors[:, largest], -values[largest]
        t = -float(normal @ [rx, ry]) / values[largest]
    else:
        strength = math.hypot(rx, ry)
        if strength < 1e-9:
            return 0.0, 0.0, 0.0
        normal = np.array([rx, ry]) / strength
        t = -value / strength
    offset = t * normal
    if strength <= 0 or np.abs(offset).max() > _TAYLOR_BOX:
        return 0.0, 0.0, 0.0
    return float(offset[0]), float(offset[1]), float(strength)


@KINDS
@parametrize_core(("sigma", "shape"), [(1.0, (70, 45)), (2.5, (40, 33)), (1.4, (70, 6))], core=[0, 2])
def test_the_first_step_is_stegers_equation(kind: int, sigma: float, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(9)
    # More than one block of rows; narrower than the kernel, too: borders are reflected about the outermost pixels.
    image = gaussian_filter(rng.normal(0, 1, shape), 0.8).astype(np.float32)
    noise = rng.uniform(0.01, 0.05, image.shape).astype(np.float32)
    lit = np.asarray(rng.random(image.shape) < 0.9)
    sampled = gaussian_kernels(sigma)
    offset, strength = taylor_step(image, noise, lit, np.float32(2.0), *sampled, kind)
    zero, one, two = (kernel.astype(np.float64) for kernel in sampled)
    orders = ((zero, zero), (one, zero), (zero, one), (two, zero), (one, one), (zero, two))
    filtered = np.stack([
        correlate1d(correlate1d(image.astype(np.float64), across, axis=1, mode="mirror"), along, axis=0, mode="mirror")
        for across, along in orders
    ])  # fmt: skip
    kept = 0
    for y, x in np.ndindex(*image.shape):
        wanted = taylor_oracle(filtered[:, y, x], kind)
        # Offsets at the very edge of the box may fall on either side in single precision.
        if abs(max(abs(wanted[0]), abs(wanted[1])) - _TAYLOR_BOX) < 1e-3 or abs(wanted[2] - 2 * noise[y, x]) < 1e-5:
            continue
        if not lit[y, x] or wanted[2] < 2 * noise[y, x]:
            wanted = (0.0, 0.0, 0.0)
        np.testing.assert_allclose([*offset[y, x], strength[y, x]], wanted, rtol=1e-3, atol=3e-4)
        kept += wanted[2] > 0
    assert 10 < kept < 0.6 * image.size


def newton_oracle(
    image: FloatArray, start: FloatArray, pixel: tuple[int, int], sigma: float, kind: int
) -> tuple[FloatArray, FloatArray, float] | None:
    """(point, normal, strength): derivatives by correlation with kernels centred on the start, then one step."""
    column, row = pixel
    radius = math.ceil(_SUPPORT * sigma)
    if not (radius <= column < image.shape[1] - radius and radius <= row < image.shape[0] - radius):
        return None
    xs, ys = np.arange(column - radius, column + radius + 1.0), np.arange(row - radius, row + radius + 1.0)
    window = image[row - radius : row + radius + 1, column - radius : column + radius + 1]

    def weights(at: FloatArray) -> list[FloatArray]:
        bell = np.exp(-(at**2) / (2 * sigma**2))
        bell = bell / bell.sum()
        return [bell, at / sigma**2 * bell, (at**2 / sigma**4 - 1 / sigma**2) * bell]

    wx, wy = weights(xs - start[0]), weights(ys - start[1])
    r, rx, rxx = (float(wy[0] @ window @ wx[k]) for k in range(3))
    ry, rxy, ryy = float(wy[1] @ window @ wx[0]), float(wy[1] @ window @ wx[1]), float(wy[2] @ window @ wx[0])
    if kind == RIDGE:
        values, vectors = np.linalg.eigh([[rxx, rxy], [rxy, ryy]])
        largest = int(np.argmax(np.abs(values)))
        if values[largest] >= 0:
            return None
        normal, strength = vectors[:, largest], float(-values[largest])
        t = float(normal @ [rx, ry]) / strength
    else:
        strength = math.hypot(rx, ry)
        normal = np.array([rx, ry]) / strength
        t = -r / strength
    point = start + t * normal
    if np.abs(point - [column, row]).max() > _NEWTON_BOX:
        return None
    return point, normal, strength


@KINDS
@pytest.mark.parametrize("sigma", [1.0, 1.7])
def test_the_second_step_is_a_correlation_with_kernels_centred_on_the_point(kind: int, sigma: float) -> None:
    rng = np.random.default_rng(12)
    image = rng.normal(0, 1, (40, 50)).astype(np.float32)
    offset = rng.uniform(-0.6, 0.6, (40, 50, 2)).astype(np.float32)
    drawn = rng.permutation(2000)[:900]
    columns, rows = (drawn % 50).astype(np.int32), (drawn // 50).astype(np.int32)
    x, y, normals, strength, bend, kept = newton_step(image, offset, columns, rows, sigma, kind)
    assert (bend != 0).any() == (kind == EDGE)
    for i in range(900):
        pixel = (int(columns[i]), int(rows[i]))
        start = np.array(pixel) + offset[pixel[1], pixel[0]].astype(np.float64)
        wanted = newton_oracle(image.astype(np.float64), start, pixel, sigma, kind)
        assert bool(kept[i]) == (wanted is not None)
        if wanted is not None:
            np.testing.assert_allclose([x[i], y[i]], wanted[0], rtol=0, atol=1e-9)
            assert abs(float(normals[i] @ wanted[1])) == pytest.approx(1, abs=1e-9)
            assert strength[i] == pytest.approx(wanted[2], rel=1e-9)
    assert 40 < kept.sum() < 860


@KINDS
@pytest.mark.parametrize("shape", [(20, 60), (20, 7)])
def test_unlit_margins_do_not_change_the_rest(kind: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(6)
    image, noise = rng.normal(0, 1, shape).astype(np.float32), np.full(shape, 0.1, dtype=np.float32)
    everywhere = taylor_step(
        image, noise, np.ones(shape, dtype=np.bool_), np.float32(0.5), *gaussian_kernels(1.2), kind
    )
    for begin, end in ((0, 3), (2, 4), (shape[1] - 1, shape[1]), (shape[1] // 2, shape[1] - 1)):
        lit = np.zeros(shape, dtype=np.bool_)
        lit[3:-1, begin:end] = rng.uniform(0, 1, (16, end - begin)) > 0.3
        offset, response = taylor_step(image, noise, lit, np.float32(0.5), *gaussian_kernels(1.2), kind)
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
    assert wanted[5].any()
    for i in range(len(rows)):
        top, left = rows[i] - 5 - beyond[0], columns[i] - 5 - beyond[1]
        cut = np.ascontiguousarray(wide[top : rows[i] + 6, left : columns[i] + 6])
        at = np.array([5 + beyond[1]], dtype=np.int32), np.array([5 + beyond[0]], dtype=np.int32)
        x, y, normals, response, _, kept = newton_step(cut, offset[: len(cut), : cut.shape[1]].copy(), *at, 1.3, kind)
        assert kept[0] == wanted[5][i]
        if kept[0]:
            np.testing.assert_allclose([x[0] + left, y[0] + top], [wanted[0][i], wanted[1][i]], atol=1e-10)
            np.testing.assert_allclose(normals[0], wanted[2][i], atol=1e-10)
            assert response[0] == pytest.approx(wanted[3][i], rel=1e-10)


def test_a_faint_stretch_belongs_to_a_strong_stripe_but_not_to_itself() -> None:
    x, y = grid(SHAPE)
    height = np.where(y < 40, 1.0, 0.3)
    noise = 0.3 / (5.0 * 1.2 * math.sqrt(3 / math.pi) / 2)  # the faint half answers with 4 to 8 sigmas
    limits = StripeLimits(weak_fraction=0.0)
    both = found((height * gaussian_stripe(x - 45.2, 1.2)).astype(np.float32), noise=noise, limits=limits)
    assert len(both) == 1
    assert both.points_px[:, 1].max() > 70
    alone = found((0.3 * gaussian_stripe(x - 45.2, 1.2)).astype(np.float32), noise=noise, limits=limits)
    assert len(alone) == 0


def test_a_stripe_much_fainter_than_the_others_is_a_ghost() -> None:
    x, _ = grid(SHAPE)
    image = gaussian_stripe(x - 25.2, 1.2) + np.float32(0.05) * gaussian_stripe(x - 60.2, 1.2)
    stripes = found(image, noise=1e-4)
    assert len(stripes) == 1
    assert abs(stripes.points_px[:, 0] - 25.2).max() < 0.01
    assert len(found(image, noise=1e-4, limits=StripeLimits(weak_fraction=0.01))) == 2


def test_dark_stripes_and_flat_light_are_no_stripes() -> None:
    x, _ = grid(SHAPE)
    dark = found(1 - gaussian_stripe(x - 45.2, 1.2))
    # Beside a dark bar the light rises again, without a ridge at the bar itself.
    assert not (np.abs(dark.points_px[:, 0] - 45.2) < 1.5).any()
    assert len(found(np.full(SHAPE, 0.7, dtype=np.float32))) == 0


def test_noise_alone_makes_no_stripe() -> None:
    image = np.random.default_rng(1).normal(0, 0.05, (200, 200)).astype(np.float32)
    assert len(found(image, noise=0.05)) == 0


def test_nothing_is_found_where_the_kernel_leaves_the_image() -> None:
    x, y = grid(SHAPE)
    stripes = found(gaussian_stripe(x - 2.0, 1.2) + gaussian_stripe(y - 40.0, 1.2))
    assert stripes.points_px[:, 0].min() > 4
    assert stripes.points_px[:, 0].max() < SHAPE[1] - 5


def test_unmeasured_pixels_give_no_points() -> None:
    x, _ = grid(SHAPE)
    image = gaussian_stripe(x - 45.2, 1.2)
    image[35:45] = np.nan
    rows = found(image).points_px[:, 1]
    assert np.isfinite(rows).all()
    assert not ((rows > 32) & (rows < 47)).any()
    assert (rows < 30).any()
    assert (rows > 50).any()


def test_stripes_of_several_frames_stand_in_the_frames_order() -> None:
    x, _ = grid(SHAPE)
    one, two = gaussian_stripe(x - 30.2, 1.2), gaussian_stripe(x - 20.4, 1.2) + gaussian_stripe(x - 55.3, 1.2)
    parts = [points_of(image) for image in (one, np.zeros_like(one), two)]
    stripes = chain_stripes(parts, SHAPE)
    assert stripes.frame.tolist() == [0, 2, 2]
    assert stripes.offsets.dtype == stripes.frame.dtype == np.int32
    np.testing.assert_array_equal(np.diff(stripes.offsets), 70)
    assert stripes.offsets[0] == 0
    for chain, column_px in enumerate([30.2, *sorted([20.4, 55.3], key=lambda c: abs(stripes.points_px[70, 0] - c))]):
        mine = slice(stripes.offsets[chain], stripes.offsets[chain + 1])
        np.testing.assert_allclose(stripes.points_px[mine, 0], column_px, atol=0.01)
    # Every value goes with its point.
    every = {
        tuple(point): (*normal, sigma)
        for part in parts
        for point, normal, sigma in zip(part.points_px, part.normals, part.sigma_px, strict=True)
    }
    for point, normal, sigma in zip(stripes.points_px, stripes.normals, stripes.sigma_px, strict=True):
        assert every[tuple(point)] == (*normal, sigma)


def edge_errors(light: NDArray[np.float64], truth_px: NDArray[np.float64], noise: float) -> FloatArray:
    """Errors of the edges of a bit less its inverse, (n,), over their standard deviations: across, px.

    light : (H, W), -1 to 1; truth_px : (H, W), distance of each pixel centre from the nearest edge along the row.
    """
    rng = np.random.default_rng(8)
    image = (light + rng.normal(0, noise, light.shape)).astype(np.float32)
    lit = np.zeros(light.shape, dtype=np.bool_)
    lit[6:-6, 6:-6] = True
    points = edge_points(image, np.full(light.shape, noise, np.float32), lit, StripeLimits(), filter_px=1.0)
    columns, rows = np.rint(points.points_px).astype(int).T
    off = truth_px[rows, columns] + points.points_px[:, 0] - columns
    return np.asarray(off * np.abs(points.normals[:, 0]) / points.sigma_px)


@parametrize_core(
    ("first_px", "growth", "blur_px"),
    [(40.0, 0.0, 0.6), (40.0, 0.0, 0.1), (3.0, 0.0, 0.6), (3.3, 0.0, 0.2), (6.0, 0.02, 0.6), (2.4, 0.01, 0.3)],
    ids=["wide", "sharp", "narrow", "narrow and sharp", "wider and wider", "narrow, wider and wider"],
    core=[0, 3],
)
def test_the_deviation_of_an_edge_holds_for_narrow_sharp_and_uneven_stripes(
    first_px: float, growth: float, blur_px: float
) -> None:
    columns = np.arange(200.0)
    edges = np.cumsum(first_px * (1 + growth) ** np.arange(200)) - 20.0
    edges = edges[edges < 240]
    # Slightly slanted, so that edges pass through all parts of a pixel.
    off = columns[:, None] - edges - 0.06 * np.arange(160)[:, None, None]

    def integral(u: FloatArray) -> FloatArray:
        """Of the normal distribution."""
        return u * ndtr(u) + np.exp(-(u**2) / 2) / math.sqrt(2 * math.pi)

    passed = blur_px * (integral((off + 0.5) / blur_px) - integral((off - 0.5) / blur_px))
    light = 2 * passed @ (-1.0) ** np.arange(len(edges)) - 1
    truth_px = np.take_along_axis(off, np.abs(off).argmin(axis=2)[..., None], axis=2)[..., 0]
    error = edge_errors(light, truth_px, 0.012)
    assert 0.5 <= np.percentile(np.abs(error), 68.27) <= 1.4
    assert np.percentile(np.abs(error), 95.45) <= 3.0

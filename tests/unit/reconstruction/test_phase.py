"""The projector position from the light of all line frames, and points of a surface fitted to it.

What is wanted follows from the equations alone: the first Fourier coefficient of n samples, the law of propagation of
errors, and surfaces whose crossing with a line is known.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import chi2

from slrig.kernels import in_bands
from slrig.model import Axis, FloatArray, LineShift, NoiseModel
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.phase import (
    FittedPoints,
    PositionMap,
    allocate_points,
    asymmetry_sigma_px,
    fit_arguments,
    has_phase,
    position_map,
)
from slrig.reconstruction.surface_fit import MIN_POINTS, fit_kernel, stencils
from tests.unit.reconstruction.builders import bars, cells_of, code_frames, grid, nearest_lines

SHAPE = (60, 80)
QUIET = NoiseModel(1e-4, 0.0)
PATTERNS = pytest.mark.parametrize(("period_px", "width_px"), [(4, 1), (4, 2), (6, 1), (8, 1), (8, 3), (8, 4), (16, 2)])


def lines(period_px: int = 8, width_px: int = 1, axis: Axis = Axis.COLUMN) -> tuple[LineShift, ...]:
    return tuple(LineShift(axis, shift, period_px, width_px) for shift in range(period_px))


def frames_of(
    images: FloatArray, patterns: tuple[LineShift, ...], *, black: float = 10.0, white: float = 160.0
) -> AxisFrames:
    dark = np.full(images.shape[1:], black, dtype=np.float32)
    return code_frames(
        bits=dark[None], black=dark, white=np.full_like(dark, white), lines=images.astype(np.float32),
        line_patterns=patterns, full_scale=65535.0,
    )  # fmt: skip


def seen(
    position: FloatArray,
    patterns: tuple[LineShift, ...],
    *,
    blur_px: float = 0.9,
    height: float | FloatArray = 150.0,
    noise: NoiseModel | None = None,
    seed: int = 1,
    cell_px: int | None = None,
    code: CodeMap | None = None,
) -> PositionMap:
    """The map of a surface lit by these lines."""
    images = 10 + height * np.stack([bars(position, line, blur_px) for line in patterns])
    if noise is not None:
        images = images + np.sqrt(noise.read_variance + noise.slope * images) * np.random.default_rng(seed).normal(
            0, 1, images.shape
        )
    cell = cell_px or patterns[0].period_px // 2
    middle, _ = nearest_lines(patterns, cell, 400)
    return position_map(frames_of(images, patterns), noise or QUIET, code or cells_of(position, cell), middle)


@PATTERNS
def test_the_map_is_the_phase_of_the_first_fourier_coefficient(period_px: int, width_px: int) -> None:
    rng = np.random.default_rng(3)
    samples = rng.uniform(0, 200, (period_px, 6, 7)).astype(np.float32)
    truth = rng.uniform(40, 200, (6, 7))
    code, patterns = cells_of(truth, 2), lines(period_px, width_px)
    middle, _ = nearest_lines(patterns, 2, 200)
    noise = NoiseModel(2.0, 0.05)
    found = position_map(frames_of(samples.astype(np.float64), patterns), noise, code, middle)
    # numpy's transform has the other sign of the exponent; the lines' first centre turns the phase.
    term = np.conj(np.fft.fft(samples, axis=0)[1]) * np.exp(1j * np.pi * (width_px - 1) / period_px)
    within = np.angle(term) * period_px / (2 * np.pi)
    wanted = within + period_px * np.rint((middle[code.lowest] - within) / period_px)
    np.testing.assert_allclose(found.position, wanted, rtol=0, atol=1e-4)
    # Propagation of errors by finite differences.
    variance = np.zeros(truth.shape)
    for k in range(period_px):
        turned = term + 1e-4 * np.exp(2j * np.pi * (k + (width_px - 1) / 2) / period_px)
        slope = np.angle(turned / term) / 1e-4 * period_px / (2 * np.pi)
        variance += slope**2 * (2.0 + 0.05 * samples[k])
    np.testing.assert_allclose(found.sigma, np.sqrt(variance), rtol=2e-3)
    assert found.position.dtype == found.sigma.dtype == np.float32


@PATTERNS
@pytest.mark.parametrize("noise", [NoiseModel(1.0, 0.0), NoiseModel(0.5, 0.04)], ids=["read", "shot"])
def test_noise_moves_no_position_on_average_and_its_size_is_stated(
    period_px: int, width_px: int, noise: NoiseModel
) -> None:
    x, y = grid((200, 200))
    position = 30.0 + 0.137 * x + 0.031 * y
    # Light of a blurred line: harmonics that n samples mistake for the first are gone.
    found = seen(position, lines(period_px, width_px), blur_px=1.1, noise=noise, height=220.0)
    z = (found.position - position) / found.sigma
    assert abs(z.mean()) < 5 / math.sqrt(z.size)
    low, high = (float(chi2.ppf(share, z.size)) / z.size for share in (1e-7, 1 - 1e-7))
    # The stated variance is that of the noisy samples themselves: to second order, not exact.
    assert low * 0.98 < np.mean(z**2) < high * 1.02


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.6])
def test_the_projectors_response_and_albedo_do_not_bend_the_map(gamma: float) -> None:
    x, y = grid(SHAPE)
    position = 30.0 + 0.61 * x - 0.2 * y
    albedo = np.where((x // 5 + y // 7) % 2, 25.0, 200.0)
    # Lines are lit or not; what a half-lit level would give is never asked for. Light is dimmed everywhere alike.
    found = seen(position, lines(), height=albedo * 0.9**gamma)
    np.testing.assert_allclose(found.position, position, atol=2e-3)
    # Nor does steady light of any pattern from elsewhere.
    images = 10 + albedo * np.stack([bars(position, line, 0.9) for line in lines()]) + 40 * np.sin(x / 3) ** 2
    middle, _ = nearest_lines(lines(), 4, 100)
    beside = position_map(frames_of(images, lines()), QUIET, cells_of(position, 4), middle)
    np.testing.assert_allclose(beside.position, position, atol=2e-3)


@pytest.mark.parametrize(("width_px", "steps"), [(1, 8), (4, 8), (2, 4)])
def test_light_by_way_of_a_mirror_widens_the_deviation_by_what_it_displaces(width_px: int, steps: int) -> None:
    x, y = grid((120, 240))
    position = 60.0 + 1.1 * x + 0.05 * y
    patterns = tuple(LineShift(Axis.COLUMN, shift, 8, width_px) for shift in range(0, 8, 8 // steps))
    noise = NoiseModel(0.7, 0.01)
    # The right half also shows the lines in a mirror, which reverses their order.
    share = np.where(x < 120, 0.0, 0.15)
    images = 10 + 150 * np.stack(
        [bars(position, line, 0.9) + share * bars(400.0 - 0.9 * x, line, 0.9) for line in patterns]
    )
    noisy = images + np.sqrt(noise.read_variance + noise.slope * images) * np.random.default_rng(5).normal(
        0, 1, images.shape
    )
    middle, _ = nearest_lines(patterns, 4, 500)
    code, usable = cells_of(position, 4), np.ones(x.shape, dtype=np.bool_)
    exact, measured = (position_map(frames_of(each, patterns), noise, code, middle) for each in (images, noisy))
    stated = asymmetry_sigma_px(frames_of(noisy, patterns), measured, measured, usable, noise)
    weights = stencils()[0][0, :25].reshape(5, 5)
    displaced = ndimage.correlate((exact.position - position).astype(np.float64), weights.astype(np.float64))
    inside = (x > 140) & (x < 230) & (y > 10) & (y < 110)
    assert (stated[x < 100] > 0).mean() < 0.02
    if steps == 4:
        # Four steps have no harmonic beside the first.
        assert not stated.any()
        return
    stated_px = np.hypot(1.1, 0.05) * stated[inside].astype(np.float64)
    ratio = np.sqrt(np.mean(displaced[inside] ** 2) / np.mean(stated_px**2))
    assert 0.6 < ratio < 1.5


def test_a_pixel_with_a_clipped_line_has_no_position() -> None:
    x, _ = grid(SHAPE)
    position = 30.0 + 0.6 * x
    found = seen(position, lines(), height=np.where(x < 20, 150.0, 300_000.0))
    clipped = np.max([10 + 300_000.0 * bars(position, line, 0.9) for line in lines()], axis=0) >= 65535.0
    np.testing.assert_array_equal(np.isnan(found.position), clipped & (x >= 20))
    assert clipped[x >= 20].any()


def test_lines_at_the_projectors_border_do_not_wrap() -> None:
    x, y = grid(SHAPE)
    # Columns 0.4 … 1.6, and the same one period before the last cell.
    for first in (-0.45, 196.0):
        position = first + 0.05 * x + 0.001 * y
        np.testing.assert_allclose(seen(position, lines()).position, position, atol=2e-3)


def test_refused_pixels_have_no_position() -> None:
    x, _ = grid(SHAPE)
    position = 20.0 + x
    code = cells_of(np.where((x >= 10) & (x < 15), np.nan, position), 4)
    found = seen(position, lines(), code=code)
    for each in (found.position, found.sigma):
        np.testing.assert_array_equal(np.isnan(each), (x >= 10) & (x < 15))


def test_a_code_cell_that_is_one_off_near_its_border_gives_the_right_period() -> None:
    x, y = grid(SHAPE)
    position = 20.0 + 0.37 * x + 0.21 * y
    part = (position + 0.5) / 4 % 1
    for side, near in ((-1, part < 0.4), (1, part > 0.6)):
        exact = cells_of(position, 4)
        off = np.where(near, exact.lowest + side, exact.lowest).astype(np.int32)
        code = CodeMap(off, off.copy(), exact.refusal)
        np.testing.assert_allclose(seen(position, lines(), code=code).position, position, atol=5e-3)


@pytest.mark.parametrize(("below", "above"), [(0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (0, 3), (1, 2), (3, 0)])
def test_an_interval_of_code_cells_never_gives_a_position_of_another_period(below: int, above: int) -> None:
    x, y = grid(SHAPE)
    position = 40.0 + 0.37 * x + 0.21 * y
    # Just inside a cell: at its very border the cell beyond would be in the interval too.
    part = (position + 0.5) % 4
    position = np.where(part < 0.2, position + 0.2, np.where(part > 3.8, position - 0.2, position))
    exact = cells_of(position, 4)
    code = CodeMap(exact.lowest - below, exact.highest + above, exact.refusal)
    found = seen(position, lines(), code=code).position
    # Where the interval holds the phase twice nothing tells which: better no position than a wrong one.
    assert not (np.abs(found - position) > 1).any()
    if below + above <= 1:
        assert np.isfinite(found).all()


def test_without_all_line_frames_the_position_is_the_middle_of_the_code_interval() -> None:
    lowest = np.array([[3, 4, -1]], dtype=np.int32)
    highest = np.array([[3, 5, -1]], dtype=np.int32)
    code = CodeMap(lowest, highest, np.array([[0, 0, 3]], dtype=np.uint8))
    dark = np.zeros((1, 3), dtype=np.float32)
    middle, _ = nearest_lines(lines(), 4, 40)
    for shown in ((), lines()[:5], lines()[1:]):
        frames = code_frames(
            bits=dark[None], white=dark, black=dark, lines=np.zeros((len(shown), 1, 3), dtype=np.float32),
            line_patterns=shown,
        )  # fmt: skip
        assert not has_phase(frames)
        found = position_map(frames, QUIET, code, middle)
        np.testing.assert_array_equal(found.position, [[13.5, 19.5, np.nan]])
        assert np.isnan(found.sigma).all()


def fitted_points(
    seen: PositionMap, usable: NDArray[np.bool_], starts_px: FloatArray, targets_px: FloatArray
) -> FittedPoints:
    """Points of the image at which a local surface of the position map has the wanted positions."""
    fitted = allocate_points(len(starts_px))
    in_bands(
        fit_kernel, len(starts_px), *fit_arguments(seen, usable), np.ascontiguousarray(starts_px),
        np.asarray(targets_px, dtype=np.float64), fitted, rows_at_least=MIN_POINTS,
    )  # fmt: skip
    return fitted


SLOPES = pytest.mark.parametrize(
    ("slope", "angle_rad"),
    [(0.3, 0.0), (1.0, math.pi / 6), (1.0, math.pi / 2), (-0.7, 0.2), (-1.0, 1.4), (2.0, 2.5), (5.0, 0.1)],
)


def exact_map(surface: FloatArray, sigma: float = 1e-3) -> PositionMap:
    return PositionMap(surface.astype(np.float32), np.full(surface.shape, sigma, dtype=np.float32))


def plane(slope: float, angle_rad: float, x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(600 + slope * (math.cos(angle_rad) * x + math.sin(angle_rad) * y))


def anywhere(count: int, seed: int = 4) -> FloatArray:
    """Points at least four pixels inside the image."""
    return np.random.default_rng(seed).uniform([4, 4], [SHAPE[1] - 5, SHAPE[0] - 5], (count, 2))


@SLOPES
def test_the_crossing_of_a_curved_surface_is_exact(slope: float, angle_rad: float) -> None:
    x, y = grid(SHAPE)
    bend = 0.02 * slope

    def surface(at_x: FloatArray, at_y: FloatArray) -> FloatArray:
        bowl = 0.5 * (at_x - 40) ** 2 - 0.3 * (at_x - 40) * (at_y - 30) + 0.2 * (at_y - 30) ** 2
        return plane(slope, angle_rad, at_x, at_y) + 0.5 * bend * bowl

    def gradient(at_x: FloatArray, at_y: FloatArray) -> FloatArray:
        step = 1e-4
        along_x = surface(at_x + step, at_y) - surface(at_x - step, at_y)
        along_y = surface(at_x, at_y + step) - surface(at_x, at_y - step)
        return np.stack([along_x, along_y], axis=1) / (2 * step)

    starts = anywhere(500)
    steepness = np.linalg.norm(gradient(*starts.T), axis=1)
    kept = steepness > 0.5 * abs(slope)
    starts, steepness = starts[kept], steepness[kept]
    targets = surface(*starts.T) + steepness * np.random.default_rng(5).uniform(-0.6, 0.6, len(starts))
    usable = np.ones(SHAPE, dtype=np.bool_)
    points, normals, _, found, _ = fitted_points(exact_map(surface(x, y)), usable, starts, targets)
    assert found.mean() > 0.95
    misses = (surface(*points[found].T) - targets[found]) / steepness[found]
    np.testing.assert_allclose(misses, 0, atol=1e-3)
    there = gradient(*points[found].T)
    across = there / np.linalg.norm(there, axis=1, keepdims=True)
    np.testing.assert_allclose(np.sum(normals[found] * across, axis=1), 1, atol=1e-3)


def usable_pixels(kind: str, shape: tuple[int, int]) -> NDArray[np.bool_]:
    x, y = grid(shape)
    match kind:
        case "whole":
            return np.ones(shape, dtype=np.bool_)
        case "one-sided":
            return np.asarray(x % 7 >= 3)
        case "corner":
            return np.asarray((x % 7 >= 3) & (y % 7 >= 3))
        case _:
            return np.asarray(np.random.default_rng(8).random(shape) > 0.25)


@pytest.mark.parametrize("kind", ["whole", "one-sided", "corner", "holes"])
@pytest.mark.parametrize(("slope", "angle_rad"), [(0.6, 0.0), (1.2, math.pi / 6), (-0.9, math.pi / 2), (4.0, 0.3)])
def test_the_stated_deviation_is_that_of_the_noise(kind: str, slope: float, angle_rad: float) -> None:
    shape = (240, 320)
    x, y = grid(shape)
    truth = plane(slope, angle_rad, x, y)
    deviation = (0.03 + 0.02 * np.sin(x / 60)).astype(np.float32)
    noisy = truth + deviation * np.random.default_rng(9).normal(0, 1, shape)
    here = PositionMap(noisy.astype(np.float32), deviation)
    rows, columns = (each.ravel() for each in np.mgrid[5:235:3, 5:315:3])
    starts = np.stack([columns, rows], axis=1) + np.random.default_rng(10).uniform(-0.49, 0.49, (len(rows), 2))
    targets = plane(slope, angle_rad, *starts.T)
    points, _, sigma_px, found, _ = fitted_points(here, usable_pixels(kind, shape), starts, targets)
    assert found.sum() > 1000
    errors = (plane(slope, angle_rad, *points[found].T) - targets[found]) / abs(slope)
    assert abs(errors.mean()) < 5 * errors.std() / math.sqrt(found.sum() / 10)
    assert np.sqrt(np.mean((errors / sigma_px[found]) ** 2)) == pytest.approx(1.0, abs=0.1)


def test_scatter_about_the_surface_is_stated_even_if_the_noise_does_not_explain_it() -> None:
    x, y = grid((240, 320))
    truth = plane(0.8, 0.3, x, y)
    noisy = truth + 0.05 * np.random.default_rng(9).normal(0, 1, truth.shape)
    starts = np.stack([x[5:-5:3, 5:-5:3].ravel(), y[5:-5:3, 5:-5:3].ravel()], axis=1)
    targets = plane(0.8, 0.3, *starts.T)
    usable = np.ones(truth.shape, dtype=np.bool_)
    points, _, sigma_px, found, noise_px = fitted_points(exact_map(noisy, 0.01), usable, starts, targets)
    errors = (plane(0.8, 0.3, *points[found].T) - targets[found]) / 0.8
    assert np.sqrt(np.mean(errors**2) / np.mean(sigma_px[found] ** 2)) == pytest.approx(1.0, abs=0.1)
    # What the noise alone makes of it is told beside: of a fifth of the scatter a fifth of the error.
    assert np.sqrt(np.mean(errors**2) / np.mean(noise_px[found] ** 2)) == pytest.approx(5.0, abs=0.5)
    assert (noise_px[found] <= sigma_px[found]).all()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("distance_px", [1, 2])
def test_pixels_behind_a_barrier_are_another_surface(turned: bool, distance_px: int) -> None:
    x, y = grid(SHAPE)
    if turned:
        x, y = y, x
    near = 300 + 0.9 * x + 0.1 * y
    barrier = x == 30
    there = exact_map(np.where(x > 30, near + 35, near))
    starts = anywhere(1500)
    side = starts[:, 1] if turned else starts[:, 0]
    beside = np.asarray(np.rint(side) == 30 - distance_px)
    other = starts[:, 0] if turned else starts[:, 1]
    starts, targets = starts[beside], (300 + 0.9 * side + 0.1 * other)[beside]
    points, _, _, found, _ = fitted_points(there, ~barrier, starts, targets)
    assert found.all()
    assert len(found) > 15
    np.testing.assert_allclose(points, starts, atol=1e-3)


def test_pixels_that_fix_no_plane_give_no_point() -> None:
    x, y = grid(SHAPE)
    there = exact_map(plane(1.0, 0.4, x, y))
    starts = np.array([[30.0, 30.0]])
    targets = plane(1.0, 0.4, *starts.T)
    for usable in (x == 30, y == 30, x - y == 0, (np.abs(x - 30) <= 1) & (y == 30), (x == 30) & (y == 30)):
        assert not fitted_points(there, np.asarray(usable), starts, targets)[3].any()
    cross = (np.abs(x - 30) + np.abs(y - 30)) <= 1
    assert fitted_points(there, np.asarray(cross), starts, targets)[3].all()


def test_unmeasured_pixels_give_no_point() -> None:
    x, y = grid(SHAPE)
    truth = plane(1.0, 0.4, x, y)
    starts = np.array([[30.2, 30.1], [40.0, 20.0]])
    targets = plane(1.0, 0.4, *starts.T)
    usable = np.ones(SHAPE, dtype=np.bool_)
    for bad_start, bad_target, bad_position, bad_sigma in np.eye(4, dtype=np.bool_):
        here = exact_map(np.where((x == 31) & (y == 30) & bad_position, np.nan, truth))
        here.sigma[30, 31] = np.nan if bad_sigma else here.sigma[30, 31]
        begin, aim = starts.copy(), targets.copy()
        begin[0, 0] = np.nan if bad_start else begin[0, 0]
        aim[0] = np.nan if bad_target else aim[0]
        _, _, sigma_px, found, _ = fitted_points(here, usable, begin, aim)
        assert found.tolist() == [False, True], (bad_start, bad_target, bad_position, bad_sigma)
        assert np.isfinite(sigma_px[1])
    nothing = fitted_points(exact_map(truth), usable, np.zeros((0, 2)), np.zeros(0))
    assert [len(each) for each in nothing] == [0, 0, 0, 0, 0]


def test_flat_ground_far_lines_and_the_images_border_give_no_point() -> None:
    x, y = grid(SHAPE)
    usable = np.ones(SHAPE, dtype=np.bool_)
    middle = np.array([[30.0, 30.0]])
    assert not fitted_points(exact_map(np.full(SHAPE, 12.0)), usable, middle, np.array([12.0]))[3].any()
    steep = exact_map(plane(1.0, 0.0, x, y))
    for far, expected in ((0.9, True), (1.2, False), (-1.2, False), (40.0, False)):
        assert fitted_points(steep, usable, middle, np.array([630.0 + far]))[3].tolist() == [expected]
    corners = np.array([[0.0, 30.0], [30.0, 0.0], [SHAPE[1] - 1.0, 30.0], [30.0, SHAPE[0] - 1.0], [-7.0, 900.0]])
    found = fitted_points(steep, usable, corners, plane(1.0, 0.0, *corners.T))[3]
    assert not found.any()

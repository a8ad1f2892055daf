"""How well stripes and code edges are located: without noise, at the physical limit, and where albedo misleads.

The bound is that of Fisher information: 1.062 (s/A) √σ px per image row for a Gaussian bar of height A and width σ in
white noise s, over the 2√π σ_f rows that a filter of scale σ_f averages along the stripe.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from slrig.model import FloatArray
from slrig.reconstruction.stripes import (
    StripeLimits,
    Stripes,
    chain_stripes,
    edge_points,
    normalise,
    stripe_points,
    stripe_width_px,
)
from tests.unit.reconstruction.builders import gaussian_stripe, grid, rms

SHAPE = (90, 100)
QUIET = 1e-3
Distance = Callable[[FloatArray, FloatArray], FloatArray]

ANGLES = pytest.mark.parametrize("angle_rad", [0.0, 0.07, math.pi / 4, 1.2, math.pi / 2])
OFFSETS = (0.0, 0.13, 0.25, 0.5, 0.74)


def straight(angle_rad: float, offset_px: float) -> Distance:
    """Distance from a line whose normal has this angle, `offset_px` from the image's middle pixel."""
    nx, ny = math.cos(angle_rad), math.sin(angle_rad)
    return lambda x, y: np.asarray((x - 50) * nx + (y - 45) * ny - offset_px)


def circle(radius_px: float) -> Distance:
    """Distance from a circle round the image's middle."""
    return lambda x, y: np.asarray(np.hypot(x - 50.3, y - 45.1) - radius_px)


def blurred_step(distance_px: FloatArray, sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(erf(distance_px / (math.sqrt(2) * sigma_px)), dtype=np.float32)


def located(
    image: NDArray[np.float32],
    *,
    sigma_px: float,
    noise: float = QUIET,
    edge: bool = False,
    limits: StripeLimits | None = None,
) -> Stripes:
    deviation = np.full(image.shape, noise, dtype=np.float32)
    lit = np.ones(image.shape, dtype=np.bool_)
    find = edge_points if edge else stripe_points
    return chain_stripes([find(image, deviation, lit, limits or StripeLimits(), filter_px=sigma_px)], image.shape)


def errors_px(stripes: Stripes, distance: Distance) -> FloatArray:
    return distance(stripes.points_px[:, 0], stripes.points_px[:, 1])


@ANGLES
@pytest.mark.parametrize("edge", [False, True], ids=["stripe", "edge"])
def test_straight_lines_are_found_to_a_two_hundredth_of_a_pixel(angle_rad: float, *, edge: bool) -> None:
    for offset in OFFSETS:
        distance = straight(angle_rad, offset)
        away = distance(*grid(SHAPE))
        image, sigma_px = (blurred_step(away, 1.1), 1.0) if edge else (gaussian_stripe(away, 1.2), 1.2)
        stripes = located(image, sigma_px=sigma_px, edge=edge)
        assert len(stripes) == 1
        assert len(stripes.points_px) >= 75
        assert rms(errors_px(stripes, distance)) < 0.005
        # The normal of an edge points to where the bit is lit.
        across = stripes.normals @ [math.cos(angle_rad), math.sin(angle_rad)]
        np.testing.assert_allclose(across if edge else np.abs(across), 1.0, atol=1e-4)
        assert stripes.frame.tolist() == [0]


@pytest.mark.parametrize(("width_px", "scale_px"), [(0.7, 1.0), (1.0, 1.0), (1.0, 1.6), (1.6, 1.2), (2.0, 2.0)])
def test_scale_and_width_need_not_match(width_px: float, scale_px: float) -> None:
    for offset in OFFSETS:
        distance = straight(0.21, offset)
        stripes = located(gaussian_stripe(distance(*grid(SHAPE)), width_px), sigma_px=scale_px)
        assert rms(errors_px(stripes, distance)) < 0.01


@pytest.mark.parametrize("radius_px", [12.0, 20.0, 32.0])
def test_a_curved_stripe_is_displaced_towards_its_centre_as_smoothing_predicts(radius_px: float) -> None:
    # A bar of curvature 1/R smoothed with scale σ_f has its ridge σ_f²/2R nearer to the centre.
    distance = circle(radius_px)
    stripes = located(gaussian_stripe(distance(*grid(SHAPE)), 1.2), sigma_px=1.2)
    errors = errors_px(stripes, distance)
    assert len(stripes) == 1
    assert errors.mean() == pytest.approx(-(1.2**2) / (2 * radius_px), rel=0.03)
    assert rms(errors - errors.mean()) < 0.001
    assert len(errors) == pytest.approx(2 * math.pi * radius_px, rel=0.2)


def many_lines(angle_rad: float) -> tuple[Distance, FloatArray]:
    """Parallel lines 17.37 px apart, so that every sub-pixel offset occurs: distance to the nearest, of every pixel."""
    nx, ny = math.cos(angle_rad), math.sin(angle_rad)
    apart = 17.37

    def distance(x: FloatArray, y: FloatArray) -> FloatArray:
        along = x * nx + y * ny
        return np.asarray(along - apart * np.rint(along / apart))

    return distance, distance(*grid((260, 420)))


@pytest.mark.parametrize(("snr", "sigma_px", "angle_rad"), [(59.0, 1.0, 0.03), (21.0, 1.2, 0.12), (59.0, 1.6, 0.5)])
def test_noise_costs_no_more_than_the_bound_and_its_size_is_stated(
    snr: float, sigma_px: float, angle_rad: float
) -> None:
    distance, from_line = many_lines(angle_rad)
    noise = 1 / snr
    clean = gaussian_stripe(from_line, sigma_px)
    image = clean + np.random.default_rng(11).normal(0, noise, clean.shape).astype(np.float32)
    stripes = located(image, sigma_px=sigma_px, noise=noise)
    errors = errors_px(stripes, distance)
    assert len(errors) > 3500
    bound = 1.062 * noise * math.sqrt(sigma_px) / math.sqrt(2 * math.sqrt(math.pi) * sigma_px)
    assert 0.9 * bound < rms(errors) < 1.15 * bound
    assert float(np.sqrt(np.mean(stripes.sigma_px**2))) == pytest.approx(rms(errors), rel=0.1)


@pytest.mark.parametrize("snr", [59.0, 21.0])
def test_noise_on_a_code_edge_costs_no_more_than_its_bound(snr: float) -> None:
    # Fisher information of an erf step of ±1: ∫(dI/dμ)² = 2/(√π σ) per row.
    sigma_px = 1.1
    errors, stated = [], []
    noise = 2 / snr
    for seed in range(12):
        distance = straight(0.1 + 0.11 * seed, 0.21 * seed)
        clean = blurred_step(distance(*grid((150, 150))), sigma_px)
        image = clean + np.random.default_rng(seed).normal(0, noise, clean.shape).astype(np.float32)
        stripes = located(image, sigma_px=sigma_px, noise=noise, edge=True)
        longest = int(np.argmax(np.diff(stripes.offsets)))
        mine = slice(stripes.offsets[longest], stripes.offsets[longest + 1])
        errors.append(errors_px(stripes, distance)[mine])
        stated.append(stripes.sigma_px[mine])
    found = rms(np.concatenate(errors))
    bound = noise * math.sqrt(math.sqrt(math.pi) * sigma_px / 2) / math.sqrt(2 * math.sqrt(math.pi) * sigma_px)
    assert 0.85 * bound < found < 1.15 * bound
    assert rms(np.concatenate(stated)) == pytest.approx(found, rel=0.1)


@pytest.mark.parametrize("width_px", [0.9, 1.2, 1.6, 2.2])
def test_the_width_of_stripes_is_measured(width_px: float) -> None:
    _, from_line = many_lines(0.2)
    clean = gaussian_stripe(from_line, width_px)
    image = clean + np.random.default_rng(2).normal(0, 0.02, clean.shape).astype(np.float32)
    noise, lit = np.full(image.shape, 0.02, dtype=np.float32), np.ones(image.shape, dtype=np.bool_)
    assert stripe_width_px(image, noise, lit) == pytest.approx(width_px, rel=0.05)


def test_too_few_stripes_to_measure_give_the_width_looked_for() -> None:
    empty = np.zeros(SHAPE, dtype=np.float32)
    assert stripe_width_px(empty, empty + np.float32(0.02), np.ones(SHAPE, dtype=np.bool_)) == pytest.approx(1.2)


@pytest.mark.parametrize("dark", [0.1, 0.5])
def test_a_step_of_albedo_does_not_move_the_stripe_once_normalised(dark: float) -> None:
    x, y = grid(SHAPE)
    # The print's border crosses the stripe at a shallow angle and passes within a pixel of its centre.
    albedo = np.where((x - 50) + 0.02 * (y - 45) > 0.6, 200.0, 200.0 * dark).astype(np.float32)
    distance = straight(0.0, 0.25)
    black = np.full(SHAPE, 12, dtype=np.float32)
    seen = black + albedo * gaussian_stripe(distance(x, y), 1.3)
    noise = np.full(SHAPE, 0.5, dtype=np.float32)
    raw = located(np.asarray((seen - black) / 200, dtype=np.float32), sigma_px=1.3)
    image, deviation = normalise(seen, black, albedo, noise)
    stripes = chain_stripes([stripe_points(image, deviation, albedo > 0, StripeLimits(), filter_px=1.3)], SHAPE)
    assert rms(errors_px(raw, distance)) > 0.1
    assert rms(errors_px(stripes, distance)) < 0.005


def test_normalised_light_is_relative_to_white_and_fades_where_nothing_is_lit() -> None:
    rng = np.random.default_rng(4)
    contrast = np.array([[200.0, 50.0, 0.0, 1e-3]], dtype=np.float32)
    black = np.full((1, 4), 10, dtype=np.float32)
    light = rng.uniform(0, 1, (1, 4)).astype(np.float32)
    noise = np.full((1, 4), 0.1, dtype=np.float32)
    image, deviation = normalise(black + light * contrast, black, contrast, noise)
    np.testing.assert_allclose(image[0, :2], light[0, :2], rtol=1e-4)
    np.testing.assert_allclose(deviation[0, :2], [0.1 / 200, 0.1 / 50], rtol=1e-4)
    np.testing.assert_allclose(image[0, 2:], 0.0, atol=1e-4)
    assert (deviation[0, 2:] < 0.1).all()

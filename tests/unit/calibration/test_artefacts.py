"""Spheres and planes: fits against known truth, VDI/VDE 2634-2, and detection of both in a scan."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slrig.calibration.artefacts import (
    MAX_REJECTED_FRACTION,
    Decision,
    decide,
    dispersion_mm,
    find_balls,
    find_plane,
    fit_plane,
    fit_sphere,
)
from slrig.errors import NothingToReconstructError
from slrig.model import FloatArray


def cap(
    count: int, *, centre_mm: tuple[float, float, float], radius_mm: float, sigma_mm: float, seed: int
) -> FloatArray:
    """Points on the part of a ball that a camera at the origin sees, 60 degrees wide to each side."""
    rng = np.random.default_rng(seed)
    towards = -np.array(centre_mm) / np.linalg.norm(centre_mm)
    directions = rng.standard_normal((40 * count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    directions = directions[directions @ towards > 0.5][:count]
    radii = radius_mm + sigma_mm * rng.standard_normal(len(directions))
    return np.asarray(np.array(centre_mm) + directions * radii[:, None])


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.floats(5.0, 40.0), st.floats(-200.0, 200.0), st.floats(300.0, 900.0))
def test_an_exact_ball_is_fitted_exactly(seed: int, radius_mm: float, x_mm: float, z_mm: float) -> None:
    points = cap(300, centre_mm=(x_mm, 12.0, z_mm), radius_mm=radius_mm, sigma_mm=0.0, seed=seed)
    found = fit_sphere(points)
    np.testing.assert_allclose(found.centre_mm, (x_mm, 12.0, z_mm), atol=1e-7)
    assert found.radius_mm == pytest.approx(radius_mm, abs=1e-7)
    assert np.ptp(found.distances_mm) + dispersion_mm(found.distances_mm) < 1e-6


def test_probing_of_pure_noise_is_what_theory_says() -> None:
    # Trimming 0.3 % of normal noise leaves a range of about 5.9 deviations; 95 % lie within 3.92.
    sigma_mm = 0.01
    points = cap(20_000, centre_mm=(0.0, 0.0, 500.0), radius_mm=20.0, sigma_mm=sigma_mm, seed=3)
    found = fit_sphere(points)
    assert np.ptp(found.distances_mm) / sigma_mm == pytest.approx(5.9, abs=0.15)
    assert dispersion_mm(found.distances_mm) / sigma_mm == pytest.approx(3.92, abs=0.08)
    assert np.std(found.distances_mm) / sigma_mm == pytest.approx(1.0, abs=0.03)
    assert abs(2 * found.radius_mm - 40.0) < 0.002
    assert found.rejected / len(points) == pytest.approx(MAX_REJECTED_FRACTION, abs=1e-4)


def test_a_bowed_plane_has_the_range_of_its_bow() -> None:
    x, y = np.meshgrid(np.linspace(-100, 100, 120), np.linspace(-60, 60, 90))
    bow = 0.04 * (x / 100) ** 2
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    points = np.column_stack([x.ravel(), y.ravel(), bow.ravel()]) @ turn.T + (10.0, 20.0, 600.0)
    found = fit_plane(points)
    assert np.ptp(found.distances_mm) == pytest.approx(0.04, rel=0.02)
    assert abs(found.normal @ turn[:, 2]) == pytest.approx(1.0, abs=1e-6)


def test_far_outliers_are_left_out_and_counted() -> None:
    points = cap(4000, centre_mm=(0.0, 0.0, 500.0), radius_mm=20.0, sigma_mm=0.001, seed=7)
    points[:10] *= 1.01
    found = fit_sphere(points)
    assert found.rejected == 12
    assert np.ptp(found.distances_mm) < 0.01


def test_too_few_points_are_refused() -> None:
    with pytest.raises(NothingToReconstructError, match="found 99"):
        fit_plane(np.zeros((99, 3)))


@pytest.mark.parametrize(
    ("error_mm", "uncertainty_mm", "expected"),
    [
        (0.01, 0.005, Decision.PASSES),
        (-0.015, 0.005, Decision.PASSES),
        (0.0151, 0.005, Decision.UNDECIDED),
        (-0.0249, 0.005, Decision.UNDECIDED),
        (0.0251, 0.005, Decision.FAILS),
        (0.0, 0.03, Decision.UNDECIDED),
    ],
)
def test_the_rule_of_decision(error_mm: float, uncertainty_mm: float, expected: Decision) -> None:
    assert decide(error_mm, 0.02, uncertainty_mm) is expected


def ball(count: int, x_mm: float, seed: int) -> tuple[FloatArray, FloatArray]:
    centre = (x_mm, 5.0, 500.0)
    points = cap(count, centre_mm=centre, radius_mm=15.0, sigma_mm=0.01, seed=seed)
    outwards = points - np.array(centre)
    return points, outwards / np.linalg.norm(outwards, axis=1)[:, None]


def wall(tilt_deg: float = 0.0, sigma_mm: float = 0.01) -> tuple[FloatArray, FloatArray]:
    x, y = np.meshgrid(np.linspace(-120, 120, 200), np.linspace(-80, 80, 140))
    turn = np.deg2rad(tilt_deg)
    noise = sigma_mm * np.random.default_rng(1).standard_normal(x.size)
    flat = np.column_stack([x.ravel(), y.ravel(), noise])
    rotation = np.array([(np.cos(turn), 0, np.sin(turn)), (0, 1, 0), (-np.sin(turn), 0, np.cos(turn))])
    normals = np.tile(rotation @ (0, 0, -1), (x.size, 1))
    return flat @ rotation.T + (0.0, 0.0, 560.0), normals


def turned_a_little(normals: FloatArray, seed: int) -> FloatArray:
    """Normals of a noisy mesh: off by a few degrees."""
    off = normals + 0.05 * np.random.default_rng(seed).standard_normal(normals.shape)
    return np.asarray(off / np.linalg.norm(off, axis=1)[:, None])


@cache
def scene() -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Two balls 100 mm apart before a wall, and whose each point is: 0 wall, 1, 2 balls."""
    parts = [wall(), ball(6000, -50.0, 2), ball(4000, 50.0, 3)]
    owner = np.concatenate([np.full(len(part[0]), index) for index, part in enumerate(parts)])
    normals = np.concatenate([turned_a_little(part[1], index) for index, part in enumerate(parts)])
    return np.concatenate([part[0] for part in parts]), normals, owner


def test_two_balls_before_a_wall_are_found() -> None:
    points, normals, owner = scene()
    (first, _), (second, _) = find_balls(points, normals, 30.0, 2)
    assert (owner[first] == 1).mean() > 0.999
    assert (owner[second] == 2).mean() > 0.999
    assert len(first) > 0.98 * 6000
    ends = [fit_sphere(points[each]).centre_mm for each in (first, second)]
    assert abs(np.linalg.norm(ends[0] - ends[1]) - 100.0) < 0.003


def test_a_missing_ball_is_reported() -> None:
    points, normals, _ = scene()
    with pytest.raises(NothingToReconstructError, match=r"expected 3 balls of 30 mm, found 2"):
        find_balls(points, normals, 30.0, 3)
    with pytest.raises(NothingToReconstructError, match=r"expected 1 ball of 80 mm, found 0"):
        find_balls(points, normals, 80.0, 1)


@pytest.mark.parametrize("tilt_deg", [pytest.param(0.0, marks=pytest.mark.slow), 25.0])
def test_the_wall_is_found_behind_the_balls(tilt_deg: float) -> None:
    points, normals, owner = scene()
    points, normals = points.copy(), normals.copy()
    points[owner == 0], normals[owner == 0] = wall(tilt_deg)
    chosen, turned = find_plane(points, normals, 240.0)
    assert turned == 0
    assert (owner[chosen] == 0).all()
    assert len(chosen) > 0.99 * (owner == 0).sum()
    true = np.array((np.sin(np.deg2rad(tilt_deg)), 0, np.cos(np.deg2rad(tilt_deg))))
    assert abs(fit_plane(points[chosen]).normal @ true) > 1 - 1e-8


def test_a_missing_plane_is_reported() -> None:
    points, normals = ball(400, 0.0, 1)
    with pytest.raises(NothingToReconstructError, match="expected a plane"):
        find_plane(points[:90], normals[:90], 240.0)
    with pytest.raises(NothingToReconstructError, match="expected a plane"):
        find_plane(np.zeros((0, 3)), np.zeros((0, 3)), 240.0)


def test_a_rod_at_the_ball_is_counted_separately_from_outliers() -> None:
    points, normals = ball(3000, 0.0, 1)
    centre = np.array((0.0, 5.0, 500.0))
    # A rod of half the ball's radius, from the ball's side outwards.
    angle, along = np.meshgrid(np.linspace(np.pi, 2 * np.pi, 40), np.linspace(12.0, 30.0, 60))
    outwards = np.column_stack([np.zeros(angle.size), np.cos(angle.ravel()), np.sin(angle.ravel())])
    rod = centre + 7.5 * outwards + np.outer(along.ravel(), (1.0, 0.0, 0.0))
    touching = int((np.abs(np.linalg.norm(rod - centre, axis=1) - 15.0) < 0.05 * 15.0).sum())
    # Of the ball's own points some lie half a millimetre off, fifty times their noise.
    far = np.arange(0, 3000, 10)
    points[far] += 0.5 * normals[far]
    ((found, turned),) = find_balls(np.vstack([points, rod]), np.vstack([normals, outwards]), 30.0, 1)
    assert np.array_equal(found, np.arange(3000))
    assert turned == pytest.approx(touching, abs=40)
    assert touching > 100

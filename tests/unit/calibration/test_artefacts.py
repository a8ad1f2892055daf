"""Spheres and planes: fits against truth that a test made, and the figures of VDI/VDE 2634-2."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slrig.calibration.artefacts import (
    REJECTED_SHARE,
    Decision,
    decision,
    dispersion_mm,
    fitted_plane,
    fitted_sphere,
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
def test_an_exact_ball_is_found_exactly(seed: int, radius_mm: float, x_mm: float, z_mm: float) -> None:
    points = cap(300, centre_mm=(x_mm, 12.0, z_mm), radius_mm=radius_mm, sigma_mm=0.0, seed=seed)
    found = fitted_sphere(points)
    np.testing.assert_allclose(found.centre_mm, (x_mm, 12.0, z_mm), atol=1e-7)
    assert found.radius_mm == pytest.approx(radius_mm, abs=1e-7)
    assert np.ptp(found.distances_mm) + dispersion_mm(found.distances_mm) < 1e-6


def test_probing_of_pure_noise_is_what_theory_says() -> None:
    # Trimming 0.3 % of normal noise leaves a range of about 5.9 deviations; 95 % lie within 3.92.
    sigma_mm = 0.01
    points = cap(20_000, centre_mm=(0.0, 0.0, 500.0), radius_mm=20.0, sigma_mm=sigma_mm, seed=3)
    found = fitted_sphere(points)
    assert np.ptp(found.distances_mm) / sigma_mm == pytest.approx(5.9, abs=0.15)
    assert dispersion_mm(found.distances_mm) / sigma_mm == pytest.approx(3.92, abs=0.08)
    assert np.std(found.distances_mm) / sigma_mm == pytest.approx(1.0, abs=0.03)
    assert abs(2 * found.radius_mm - 40.0) < 0.002
    assert found.rejected / len(points) == pytest.approx(REJECTED_SHARE, abs=1e-4)


def test_a_bowed_plane_has_the_range_of_its_bow() -> None:
    x, y = np.meshgrid(np.linspace(-100, 100, 120), np.linspace(-60, 60, 90))
    bow = 0.04 * (x / 100) ** 2
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    points = np.column_stack([x.ravel(), y.ravel(), bow.ravel()]) @ turn.T + (10.0, 20.0, 600.0)
    found = fitted_plane(points)
    assert np.ptp(found.distances_mm) == pytest.approx(0.04, rel=0.02)
    assert abs(found.normal @ turn[:, 2]) == pytest.approx(1.0, abs=1e-6)


def test_far_outliers_are_left_out_and_counted() -> None:
    points = cap(4000, centre_mm=(0.0, 0.0, 500.0), radius_mm=20.0, sigma_mm=0.001, seed=7)
    points[:10] *= 1.01
    found = fitted_sphere(points)
    assert found.rejected == 12
    assert np.ptp(found.distances_mm) < 0.01


def test_too_few_points_are_refused() -> None:
    with pytest.raises(NothingToReconstructError, match="found 99"):
        fitted_plane(np.zeros((99, 3)))


@pytest.mark.parametrize(
    ("error_mm", "uncertainty_mm", "told"),
    [
        (0.01, 0.005, Decision.PASSES),
        (-0.015, 0.005, Decision.PASSES),
        (0.0151, 0.005, Decision.UNDECIDED),
        (-0.0249, 0.005, Decision.UNDECIDED),
        (0.0251, 0.005, Decision.FAILS),
        (0.0, 0.03, Decision.UNDECIDED),
    ],
)
def test_the_rule_of_decision(error_mm: float, uncertainty_mm: float, told: Decision) -> None:
    assert decision(error_mm, 0.02, uncertainty_mm) is told

"""The lens: against OpenCV, and against its own slopes by numbers; compiled and in plain numpy."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from slrig.model import FloatArray, lens, lens_kernels

STRONG = np.array([-0.31, 0.17, 3e-3, -2e-3, 0.05])
POINTS = np.random.default_rng(7).uniform(-0.4, 0.4, (60, 2))
WAYS = pytest.mark.parametrize("way", [lens, lens_kernels], ids=["plain", "compiled"])


def sent(terms: FloatArray, points: FloatArray) -> FloatArray:
    """Where OpenCV's lens sends normalised points (n, 2)."""
    ahead = np.column_stack([points, np.ones(len(points))])[:, None]
    return np.asarray(cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), np.eye(3), terms)[0]).reshape(-1, 2)


@WAYS
def test_the_lens_is_that_of_opencv(way: Any) -> None:
    found = [way.distorted(STRONG, x, y)[:2] for x, y in POINTS]
    np.testing.assert_allclose(found, sent(STRONG, POINTS), rtol=0, atol=1e-15)
    assert way.distorted(np.zeros(5), 0.31, -0.22) == (0.31, -0.22, 1.0, 0.0, 1.0)


@WAYS
def test_slopes_are_those_of_the_lens(way: Any) -> None:
    h = 1e-6
    for x, y in POINTS:
        _, _, xx, xy, yy = way.distorted(STRONG, x, y)
        across, along = (
            (sent(STRONG, np.array([[x, y]]) + step) - sent(STRONG, np.array([[x, y]]) - step))[0] / (2 * h)
            for step in ((h, 0.0), (0.0, h))
        )
        np.testing.assert_allclose([xx, xy], across, rtol=0, atol=1e-9)
        np.testing.assert_allclose([xy, yy], along, rtol=0, atol=1e-9)


@WAYS
@pytest.mark.parametrize(("a", "b"), [(1.0, 0.0), (0.0, 1.0), (-3.0, 0.7)])
def test_derivatives_by_the_terms_are_what_each_term_moves(way: Any, a: float, b: float) -> None:
    # The lens is linear in its terms: without one of them it moves a point by as much less, whatever its size.
    for x, y in POINTS:
        moved = [(sent(term, np.array([[x, y]])) - [x, y])[0] @ [a, b] for term in np.eye(5)]
        np.testing.assert_allclose(way.by_terms(a, b, x, y), moved, rtol=0, atol=1e-15)


def test_arrays_are_sent_as_their_points_are_to_the_bit() -> None:
    x, y = POINTS.reshape(6, 10, 2).transpose(2, 0, 1)
    one_by_one = np.array([lens_kernels.distorted(STRONG, *point) for point in POINTS])
    np.testing.assert_array_equal(np.stack(lens.distorted(STRONG, x, y), axis=-1).reshape(-1, 5), one_by_one)


def test_the_way_back_ends_where_it_began_and_is_none_from_where_the_lens_sends_nothing() -> None:
    for x, y in POINTS:
        xd, yd, *_ = lens.distorted(STRONG, float(x), float(y))
        found = lens_kernels.undistorted(STRONG, xd, yd, xd, yd, 1e-7)
        np.testing.assert_allclose(found, (x, y), rtol=0, atol=1e-13)
    # x (1 - 0.3 x²) never exceeds 0.7027.
    barrel = np.array([-0.3, 0.0, 0.0, 0.0, 0.0])
    assert np.isfinite(lens_kernels.undistorted(barrel, 0.70, 0.0, 0.70, 0.0, 1e-7)).all()
    assert np.isnan(lens_kernels.undistorted(barrel, 0.71, 0.0, 0.71, 0.0, 1e-7)).all()

"""Orientation and sharpness of a projected picture, from images whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from slrig.doctor.measures.pictures import (
    apart_deg,
    bar_blur_px,
    bar_contrast,
    edge_blur,
    expected_orientation,
    orientation,
)
from slrig.model import FloatArray, Pinhole, Size

SHAPE = (120, 160)
EVERYWHERE = np.ones(SHAPE, np.bool_)


def positions(jacobian: list[list[float]]) -> tuple[FloatArray, FloatArray]:
    """Projector column and row of every camera pixel, rounded to cells of 4, on a slightly bent surface."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    exact = [a * (x - 80) + b * (y - 60) + 200 + 2 * np.sin(y / 20) for a, b in jacobian]
    column, row = (4 * np.floor(each / 4) + 1.5 for each in exact)
    return column, row


@pytest.mark.parametrize(
    ("jacobian", "mirrored", "turn_deg"),
    [
        ([[1.25, 0.0], [0.0, 1.25]], False, 0.0),
        ([[0.0, 0.8], [-0.8, 0.0]], False, 90.0),
        ([[-1.0, 0.0], [0.0, -1.0]], False, 180.0),
        ([[-1.0, 0.0], [0.0, 1.0]], True, 180.0),
        ([[1.0, 0.0], [0.0, -1.0]], True, 0.0),
    ],
)
def test_a_picture_is_mirrored_or_turned(jacobian: list[list[float]], mirrored: bool, turn_deg: float) -> None:
    column_px, row_px = positions(jacobian)
    # Codes that are read wrong do not turn it.
    rng = np.random.default_rng(0)
    wrong = rng.random(SHAPE) < 0.05
    column_px[wrong] = rng.uniform(0, 400, np.count_nonzero(wrong))
    found = orientation(column_px, row_px, EVERYWHERE)
    assert found is not None
    assert found.mirrored is mirrored
    assert abs((found.turn_deg - turn_deg + 180) % 360 - 180) < 5
    assert found.camera_px == pytest.approx(abs(np.linalg.det(jacobian)) ** -0.5, rel=0.05)


def test_too_few_codes_tell_nothing() -> None:
    column_px, row_px = positions([[1.0, 0.0], [0.0, 1.0]])
    few = np.zeros(SHAPE, np.bool_)
    few[:5, :5] = True
    assert orientation(column_px, row_px, few) is None
    assert orientation(np.zeros(SHAPE), row_px, EVERYWHERE) is None


def device(x_mm: float, turn_deg: float) -> Pinhole:
    rotation = Rotation.from_euler("ZY", [-turn_deg, np.rad2deg(x_mm / 500)], degrees=True).as_matrix()
    matrix = np.array([[600.0, 0.0, 80.0], [0.0, 600.0, 60.0], [0.0, 0.0, 1.0]])
    return Pinhole(Size(160, 120), matrix, np.zeros(5), rotation, -rotation @ np.array([x_mm, 0.0, -500.0]))


@pytest.mark.parametrize("turn_deg", [0.0, 35.0, 180.0])
def test_a_calibration_foresees_how_a_picture_lies(turn_deg: float) -> None:
    foreseen = expected_orientation(device(-60.0, 0.0), device(90.0, turn_deg))
    upright = expected_orientation(device(-60.0, 0.0), device(90.0, 0.0))
    assert foreseen is not None
    assert upright is not None
    assert not foreseen.mirrored
    assert foreseen.camera_px == pytest.approx(1.0, rel=0.1)
    assert apart_deg(foreseen, upright) == pytest.approx(turn_deg, abs=1)
    assert abs(upright.turn_deg) < 3


def bars(period_px: float, blur_px: float, camera_px: float, *, noise_dn: float = 0.0) -> FloatArray:
    """Bit − inverse of bars over white − black of 100 DN, by a camera whose pixels are 1/camera_px projector pixels."""
    fine = 8
    x = np.arange(200 * fine) / (fine * camera_px)
    wave = np.where((x % period_px) < period_px / 2, 1.0, -1.0)
    blurred = gaussian_filter(wave, blur_px * camera_px * fine, mode="wrap")
    seen = blurred.reshape(-1, fine).mean(axis=1)
    rng = np.random.default_rng(0)
    return np.asarray(100 * np.tile(seen, (50, 1)) + noise_dn * 2**0.5 * rng.standard_normal((50, 200)))


@pytest.mark.parametrize(
    ("blur_px", "camera_px", "noise_dn"),
    [(0.5, 1.6, 0.0), (0.5, 0.8, 5.0), (1.0, 0.8, 5.0), (2.5, 1.6, 5.0), (6.0, 0.8, 0.0)],
)
def test_bars_tell_their_blur(blur_px: float, camera_px: float, noise_dn: float) -> None:
    contrast = np.full((50, 200), 100.0)
    found = [
        bar_contrast(
            bars(period_px, blur_px, camera_px, noise_dn=noise_dn), contrast, noise_dn=noise_dn, period_px=period_px
        )
        for period_px in (4.0, 8.0, 16.0, 32.0, 64.0)
    ]
    truth = np.hypot(blur_px, 12**-0.5 / camera_px)
    assert bar_blur_px(found) == pytest.approx(truth, rel=0.06, abs=0.03)


def test_bars_that_are_gone_or_sharp_say_so() -> None:
    contrast = np.full((50, 200), 100.0)
    gone = bar_contrast(bars(8.0, 8.0, 1.0), contrast, noise_dn=0.0, period_px=8.0)
    assert bar_blur_px([gone]) == float("inf")
    sharp = bar_contrast(np.full((50, 200), 100.0), contrast, noise_dn=0.0, period_px=64.0)
    assert bar_blur_px([sharp]) is None


def squares(side_px: int, blur_px: float, noise_dn: float) -> FloatArray:
    y, x = np.mgrid[:300, :300]
    board = np.where(((x + y // 9) // side_px + y // side_px) % 2 == 0, 160.0, 60.0)
    seen = gaussian_filter(board, blur_px)
    return np.asarray(seen + noise_dn * np.random.default_rng(0).standard_normal(seen.shape))


@pytest.mark.parametrize(("blur_px", "noise_dn"), [(0.6, 1.0), (1.5, 0.0), (3.5, 1.0)])
def test_edges_tell_their_blur(blur_px: float, noise_dn: float) -> None:
    found = edge_blur(squares(60, blur_px, noise_dn), np.ones((300, 300), np.bool_), noise_dn=max(noise_dn, 0.3))
    assert found is not None
    # The sharpest fifth of the edges lies a little below the truth in noise.
    assert found.sigma_px == pytest.approx(blur_px, rel=0.12, abs=0.15)


def test_no_edges_tell_nothing() -> None:
    rng = np.random.default_rng(0)
    even = 100 + rng.standard_normal((300, 300))
    assert edge_blur(even, np.ones((300, 300), np.bool_), noise_dn=1.0) is None
    # Texture too fine to have even sides.
    fine = squares(8, 3.0, 0.5)
    assert edge_blur(fine, np.ones((300, 300), np.bool_), noise_dn=0.5) is None

"""Levels, response, flicker, refresh, orientation and sharpness, from frames and instants whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from slrig.doctor.measures.frequencies import passed, refresh_hz, swings
from slrig.doctor.measures.levels import camera_exponent, light_levels, response_curve
from slrig.doctor.measures.pictures import (
    apart_deg,
    bar_blur_px,
    bar_contrast,
    edge_blur,
    expected_orientation,
    orientation,
)
from slrig.model import FloatArray, Pinhole, Pixels, Size

SHAPE = (60, 80)
PICTURE = (120, 160)
EVERYWHERE = np.ones(PICTURE, np.bool_)


def frames(level: FloatArray, *, noise_dn: float, count: int = 4, seed: int = 0, full_scale: int = 255) -> list[Pixels]:
    rng = np.random.default_rng(seed)
    return [
        np.clip(np.rint(level + noise_dn * rng.standard_normal(level.shape)), 0, full_scale).astype(np.uint8)
        for _ in range(count)
    ]


def lit_part(white_dn: float, black_dn: float) -> tuple[FloatArray, FloatArray]:
    """White and black of a projector that lights rows 10 to 49 and columns 20 to 59."""
    black = np.full(SHAPE, black_dn)
    white = black.copy()
    white[10:50, 20:60] = white_dn
    return white, black


def test_levels_are_those_of_the_lit_part() -> None:
    white, black = lit_part(120.0, 20.0)
    levels = light_levels(frames(white, noise_dn=1.5), frames(black, noise_dn=1.5, seed=1), full_scale=255)
    assert levels.lit_share == pytest.approx(40 * 40 / (60 * 80))
    assert levels.box == (10, 49, 20, 59)
    assert levels.contrast_dn == pytest.approx(100, abs=1)
    assert levels.ambient_dn == pytest.approx(20, abs=1)
    assert levels.noise_dn == pytest.approx(1.5, rel=0.1)
    assert levels.saturated_share == 0
    half = frames((white + black) / 2, noise_dn=1.5, seed=2)[0]
    assert levels.level(half) == pytest.approx(0.5, abs=0.005)
    # 90 % of full scale, from the 99th percentile of four frames' mean.
    assert levels.longest_exposure_s(0.01) == pytest.approx(0.01 * 0.9 * 255 / 122, rel=0.02)
    assert levels.shortest_exposure_s(0.01) == pytest.approx(0.01 * 10 / (100 / 1.5), rel=0.1)


def test_saturation_is_counted_among_what_is_lit() -> None:
    white, black = lit_part(120.0, 20.0)
    white[10:20, 20:60] = 400.0
    levels = light_levels(frames(white, noise_dn=1.0), frames(black, noise_dn=1.0, seed=1), full_scale=255)
    assert levels.saturated_share == pytest.approx(0.25)
    assert not levels.usable[10:20].any()
    assert levels.longest_exposure_s(0.01) == 0.005
    # Noise alone lights nothing.
    even = np.full(SHAPE, 90.0)
    levels = light_levels(frames(even, noise_dn=4.0), frames(even, noise_dn=4.0, seed=1), full_scale=255)
    assert levels.lit_share < 0.002


@pytest.mark.parametrize("gamma", [0.7, 1.0, 2.2])
@pytest.mark.parametrize(("black_knee", "white_knee"), [(0.0, 255.0), (30.0, 220.0)])
def test_response_is_found_by_its_gamma_and_its_knees(gamma: float, black_knee: float, white_knee: float) -> None:
    values = np.linspace(0, 255, 33)
    light = np.clip((values - black_knee) / (white_knee - black_knee), 0, 1) ** gamma
    light += 0.002 * np.random.default_rng(0).standard_normal(33)
    curve = response_curve(list(values), list(light))
    assert curve.gamma == pytest.approx(gamma, abs=0.08)
    assert curve.black_knee == pytest.approx(black_knee, abs=6)
    assert curve.white_knee == pytest.approx(white_knee, abs=6)
    assert (np.diff(curve.light) >= 0).all()
    assert curve.residual < 0.004
    # Light that falls with the grey value.
    falling = values / 255
    falling[20] -= 0.2
    assert response_curve(list(values), list(falling)).reversal == pytest.approx(0.2 - 1 / 32, abs=1e-6)
    exposures_s = [0.004, 0.008, 0.016]
    assert camera_exponent(exposures_s, [e**0.45 for e in exposures_s]) == pytest.approx(0.45)


def sampled(t_s: FloatArray, exposure_s: float, *parts: tuple[float, float], noise: float = 0.2) -> FloatArray:
    """Light of mean 100 that swings by (hertz, amplitude), averaged over exposures about the instants."""
    light = 100 + noise * np.random.default_rng(1).standard_normal(len(t_s))
    for frequency_hz, amplitude in parts:
        left = np.sinc(frequency_hz * exposure_s)
        light += amplitude * left * np.sin(2 * np.pi * frequency_hz * t_s + 0.7)
    return np.asarray(light)


def test_swings_are_found_in_uneven_samples_whatever_the_mean_rate() -> None:
    t_s = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.05, 128))
    found = swings(t_s, sampled(t_s, 0.002, (100.0, 5.0), (180.0, 2.0)), exposure_s=0.002)
    assert [swing.frequency_hz for swing in found] == pytest.approx([100.0, 180.0], abs=0.02)
    assert [swing.amplitude for swing in found] == pytest.approx([5.0, 2.0], abs=0.2)
    assert all(not swing.aliases_hz for swing in found)
    assert swings(t_s, sampled(t_s, 0.002), exposure_s=0.002) == (), "noise alone"
    assert swings(t_s, np.full(128, 7.0), exposure_s=0.002) == ()
    assert passed(120.0, 1 / 60) == pytest.approx(0.0, abs=1e-12), "whole periods"
    assert found[0].amplitude * passed(found[0].frequency_hz, 0.01) == pytest.approx(0.0, abs=0.01)
    assert found[0].amplitude * passed(found[0].frequency_hz, 0.005) == pytest.approx(5 * 2 / np.pi, abs=0.2)


def test_even_samples_list_the_aliases() -> None:
    # 30 frames per second show 100 Hz as 10 Hz, as they show 20, 40, 50, 70, 80 … Hz.
    t_s = np.arange(128) / 30
    [swing] = swings(t_s, sampled(t_s, 0.002, (100.0, 5.0)), exposure_s=0.002)
    told_hz = (swing.frequency_hz, *swing.aliases_hz)
    for candidate_hz in (50.0, 80.0, 100.0, 130.0):
        assert min(abs(each - candidate_hz) for each in told_hz) < 0.1


@pytest.mark.parametrize("rate_hz", [23.976, 59.94, 60.0, 120.0, 240.0])
def test_refresh_rate_is_found_from_random_instants(rate_hz: float) -> None:
    rng = np.random.default_rng(3)
    asked_s = np.cumsum(rng.uniform(0.02, 0.08, 48))
    shown_ns = np.ceil(asked_s * rate_hz) / rate_hz * 1e9 + rng.normal(0, 1e5, 48)
    found = refresh_hz([round(t) for t in shown_ns])
    assert found == pytest.approx(rate_hz, rel=5e-4)


def test_instants_on_no_grid_give_no_refresh_rate() -> None:
    asked_ns = np.cumsum(np.random.default_rng(3).uniform(2e7, 8e7, 48))
    assert refresh_hz([round(t) for t in asked_ns]) is None
    assert refresh_hz([5, 5, 5]) is None


def positions(jacobian: list[list[float]]) -> tuple[FloatArray, FloatArray]:
    """Projector column and row of every camera pixel, rounded to cells of 4, on a slightly bent surface."""
    y, x = np.mgrid[: PICTURE[0], : PICTURE[1]].astype(np.float64)
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
    wrong = rng.random(PICTURE) < 0.05
    column_px[wrong] = rng.uniform(0, 400, np.count_nonzero(wrong))
    found = orientation(column_px, row_px, EVERYWHERE)
    assert found is not None
    assert found.mirrored is mirrored
    assert abs((found.turn_deg - turn_deg + 180) % 360 - 180) < 5
    assert found.camera_px == pytest.approx(abs(np.linalg.det(jacobian)) ** -0.5, rel=0.05)


def test_too_few_codes_give_no_orientation() -> None:
    column_px, row_px = positions([[1.0, 0.0], [0.0, 1.0]])
    few = np.zeros(PICTURE, np.bool_)
    few[:5, :5] = True
    assert orientation(column_px, row_px, few) is None
    assert orientation(np.zeros(PICTURE), row_px, EVERYWHERE) is None


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
def test_bars_give_the_blur(blur_px: float, camera_px: float, noise_dn: float) -> None:
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
def test_edges_give_the_blur(blur_px: float, noise_dn: float) -> None:
    found = edge_blur(squares(60, blur_px, noise_dn), np.ones((300, 300), np.bool_), noise_dn=max(noise_dn, 0.3))
    assert found is not None
    # The sharpest fifth of the edges lies a little below the truth in noise.
    assert found.sigma_px == pytest.approx(blur_px, rel=0.12, abs=0.15)


def test_without_edges_there_is_no_blur() -> None:
    rng = np.random.default_rng(0)
    even = 100 + rng.standard_normal((300, 300))
    assert edge_blur(even, np.ones((300, 300), np.bool_), noise_dn=1.0) is None
    # Texture too fine to have even sides.
    fine = squares(8, 3.0, 0.5)
    assert edge_blur(fine, np.ones((300, 300), np.bool_), noise_dn=0.5) is None

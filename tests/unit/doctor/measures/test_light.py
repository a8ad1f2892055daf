"""Levels, response, flicker and refresh, from frames and instants whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.doctor.measures.frequencies import passed, refresh_hz, swings
from slrig.doctor.measures.levels import camera_exponent, light_levels, response_curve
from slrig.model import FloatArray, Pixels

SHAPE = (60, 80)


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
def test_a_response_is_told_by_its_gamma_and_its_knees(gamma: float, black_knee: float, white_knee: float) -> None:
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


def test_swings_are_told_from_uneven_samples_whatever_the_mean_rate() -> None:
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


def test_even_samples_say_what_they_cannot_tell_apart() -> None:
    # 30 frames per second show 100 Hz as 10 Hz, as they show 20, 40, 50, 70, 80 … Hz.
    t_s = np.arange(128) / 30
    [swing] = swings(t_s, sampled(t_s, 0.002, (100.0, 5.0)), exposure_s=0.002)
    told_hz = (swing.frequency_hz, *swing.aliases_hz)
    for candidate_hz in (50.0, 80.0, 100.0, 130.0):
        assert min(abs(each - candidate_hz) for each in told_hz) < 0.1


@pytest.mark.parametrize("rate_hz", [23.976, 59.94, 60.0, 120.0, 240.0])
def test_a_refresh_is_told_from_instants_at_random_moments(rate_hz: float) -> None:
    rng = np.random.default_rng(3)
    asked_s = np.cumsum(rng.uniform(0.02, 0.08, 48))
    shown_ns = np.ceil(asked_s * rate_hz) / rate_hz * 1e9 + rng.normal(0, 1e5, 48)
    found = refresh_hz([round(t) for t in shown_ns])
    assert found == pytest.approx(rate_hz, rel=5e-4)


def test_instants_that_lie_on_no_grid_tell_no_refresh() -> None:
    asked_ns = np.cumsum(np.random.default_rng(3).uniform(2e7, 8e7, 48))
    assert refresh_hz([round(t) for t in asked_ns]) is None
    assert refresh_hz([5, 5, 5]) is None

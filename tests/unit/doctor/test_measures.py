"""Levels, response, flicker, refresh, orientation and sharpness, from frames and instants whose truth is known."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from slrig.config import read_rig
from slrig.devices import Synchronisation
from slrig.doctor.advice import ExposureAdvice, LineAdvice, advise_exposure, advise_lines, check_refresh_multiple
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.light import Finding, LightMeasurement, Severity, fault, ok
from slrig.doctor.measures import (
    LightLevels,
    angle_between_deg,
    bar_blur_px,
    bar_contrast,
    edge_blur,
    expected_orientation,
    fit_camera_exponent,
    fit_orientation,
    fit_response_curve,
    light_levels,
)
from slrig.doctor.rig_file import write_rig_file
from slrig.doctor.timing import LightFlicker, estimate_refresh_hz, exposure_attenuation, find_oscillations
from slrig.errors import ConfigError, StorageError
from slrig.model import FloatArray, Pinhole, Pixels, Size
from tests.core import parametrize_core

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
    assert levels.lit_box == (10, 49, 20, 59)
    assert levels.contrast_dn == pytest.approx(100, abs=1)
    assert levels.ambient_dn == pytest.approx(20, abs=1)
    assert levels.noise_dn == pytest.approx(1.5, rel=0.1)
    assert levels.saturated_share == 0
    half = frames((white + black) / 2, noise_dn=1.5, seed=2)[0]
    assert levels.relative_level(half) == pytest.approx(0.5, abs=0.005)
    # 90 % of full scale, from the 99th percentile of four frames' mean.
    assert levels.longest_exposure_s(0.01) == pytest.approx(0.01 * 0.9 * 255 / 122, rel=0.02)
    assert levels.shortest_exposure_s(0.01) == pytest.approx(0.01 * 10 / (100 / 1.5), rel=0.1)


def test_saturation_is_counted_among_lit_pixels() -> None:
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
    curve = fit_response_curve(list(values), list(light))
    assert curve.gamma == pytest.approx(gamma, abs=0.08)
    assert curve.black_knee == pytest.approx(black_knee, abs=6)
    assert curve.white_knee == pytest.approx(white_knee, abs=6)
    assert (np.diff(curve.light) >= 0).all()
    assert curve.residual < 0.004
    # Light that falls with the grey value.
    falling = values / 255
    falling[20] -= 0.2
    assert fit_response_curve(list(values), list(falling)).reversal == pytest.approx(0.2 - 1 / 32, abs=1e-6)
    exposures_s = [0.004, 0.008, 0.016]
    assert fit_camera_exponent(exposures_s, [e**0.45 for e in exposures_s]) == pytest.approx(0.45)


def sample_light(t_s: FloatArray, exposure_s: float, *parts: tuple[float, float], noise: float = 0.2) -> FloatArray:
    """Light of mean 100 that swings by (hertz, amplitude), averaged over exposures about the instants."""
    light = 100 + noise * np.random.default_rng(1).standard_normal(len(t_s))
    for frequency_hz, amplitude in parts:
        left = np.sinc(frequency_hz * exposure_s)
        light += amplitude * left * np.sin(2 * np.pi * frequency_hz * t_s + 0.7)
    return np.asarray(light)


@pytest.mark.slow
def test_oscillations_are_found_in_uneven_samples_at_any_mean_rate() -> None:
    t_s = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.05, 128))
    found = find_oscillations(t_s, sample_light(t_s, 0.002, (100.0, 5.0), (180.0, 2.0)), exposure_s=0.002)
    assert [swing.frequency_hz for swing in found] == pytest.approx([100.0, 180.0], abs=0.02)
    assert [swing.amplitude for swing in found] == pytest.approx([5.0, 2.0], abs=0.2)
    assert all(not swing.aliases_hz for swing in found)
    assert find_oscillations(t_s, sample_light(t_s, 0.002), exposure_s=0.002) == (), "noise alone"
    assert find_oscillations(t_s, np.full(128, 7.0), exposure_s=0.002) == ()
    assert exposure_attenuation(120.0, 1 / 60) == pytest.approx(0.0, abs=1e-12), "whole periods"
    assert found[0].amplitude * exposure_attenuation(found[0].frequency_hz, 0.01) == pytest.approx(0.0, abs=0.01)
    assert found[0].amplitude * exposure_attenuation(found[0].frequency_hz, 0.005) == pytest.approx(
        5 * 2 / np.pi, abs=0.2
    )


def test_even_samples_list_the_aliases() -> None:
    # 30 frames per second show 100 Hz as 10 Hz, as they show 20, 40, 50, 70, 80 … Hz.
    t_s = np.arange(128) / 30
    [swing] = find_oscillations(t_s, sample_light(t_s, 0.002, (100.0, 5.0)), exposure_s=0.002)
    told_hz = (swing.frequency_hz, *swing.aliases_hz)
    for candidate_hz in (50.0, 80.0, 100.0, 130.0):
        assert min(abs(each - candidate_hz) for each in told_hz) < 0.1


@pytest.mark.parametrize("rate_hz", [23.976, 59.94, 60.0, 120.0, 240.0])
def test_refresh_rate_is_found_from_random_instants(rate_hz: float) -> None:
    rng = np.random.default_rng(3)
    asked_s = np.cumsum(rng.uniform(0.02, 0.08, 48))
    shown_ns = np.ceil(asked_s * rate_hz) / rate_hz * 1e9 + rng.normal(0, 1e5, 48)
    found = estimate_refresh_hz([round(t) for t in shown_ns])
    assert found == pytest.approx(rate_hz, rel=5e-4)


def test_instants_on_no_grid_give_no_refresh_rate() -> None:
    asked_ns = np.cumsum(np.random.default_rng(3).uniform(2e7, 8e7, 48))
    assert estimate_refresh_hz([round(t) for t in asked_ns]) is None
    assert estimate_refresh_hz([5, 5, 5]) is None


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
    found = fit_orientation(column_px, row_px, EVERYWHERE)
    assert found is not None
    assert found.is_mirrored is mirrored
    assert abs((found.turn_deg - turn_deg + 180) % 360 - 180) < 5
    assert found.camera_px == pytest.approx(abs(np.linalg.det(jacobian)) ** -0.5, rel=0.05)


def test_too_few_codes_give_no_orientation() -> None:
    column_px, row_px = positions([[1.0, 0.0], [0.0, 1.0]])
    few = np.zeros(PICTURE, np.bool_)
    few[:5, :5] = True
    assert fit_orientation(column_px, row_px, few) is None
    assert fit_orientation(np.zeros(PICTURE), row_px, EVERYWHERE) is None


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
    assert not foreseen.is_mirrored
    assert foreseen.camera_px == pytest.approx(1.0, rel=0.1)
    assert angle_between_deg(foreseen, upright) == pytest.approx(turn_deg, abs=1)
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


@parametrize_core(
    ("blur_px", "camera_px", "noise_dn"),
    [(0.5, 1.6, 0.0), (0.5, 0.8, 5.0), (1.0, 0.8, 5.0), (2.5, 1.6, 5.0), (6.0, 0.8, 0.0)],
    core=[0, 4],
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


# ---- Which exposure is proposed, for lights that are known


def levels() -> LightLevels:
    rng = np.random.default_rng(0)
    images = [[rng.normal(mean, 1.0, (20, 20)).astype(np.uint8) for _ in range(3)] for mean in (120, 10)]
    return light_levels(images[0], images[1], full_scale=255)


def measurement(own_exposure_s: float, *, shortest_s: float = 0.002, longest_s: float = 0.04) -> LightMeasurement:
    return LightMeasurement("left", own_exposure_s, levels(), 0.02, levels(), shortest_s, longest_s, 0.0)


def test_each_exposure_that_was_tried_limits_the_shortest() -> None:
    # Noise that grows with the light makes the limit of a longer one too long.
    short = measurement(0.001).limited(1.0)
    assert short.shortest_s == pytest.approx(levels().shortest_exposure_s(0.001))
    assert measurement(0.5).limited(1.0).shortest_s == pytest.approx(levels().shortest_exposure_s(0.02))


LIMITS_S = (1e-5, 1.0)
MAINS = LightFlicker("room", 100.0, 0.05)
WHEEL = LightFlicker("projector", 180.0, 0.4)


@pytest.mark.parametrize(
    ("own_s", "refresh_hz", "flickers", "expected_s"),
    [
        # A good exposure is kept.
        (0.02, None, (), 0.02),
        (1 / 60, 60.0, (), 1 / 60),
        (0.02, None, (MAINS,), 0.02),
        # One that saturates, or drowns in noise, gives way to the longest.
        (0.08, None, (), 0.04),
        (0.0005, None, (), 0.04),
        # Whole periods: of the refresh, of a colour wheel, of the mains.
        (0.02, 60.0, (), 2 / 60),
        (0.019, None, (WHEEL,), 7 / 180),
        (0.017, None, (MAINS,), 0.04),
        # Refresh and mains together: 50 ms would serve both and saturates; 2/60 s leaves less than 1/60 s.
        (0.02, 60.0, (MAINS,), 2 / 60),
    ],
)
def test_an_exposure_is_kept_or_snapped(
    own_s: float, refresh_hz: float | None, flickers: tuple[LightFlicker, ...], expected_s: float
) -> None:
    advice = advise_exposure(measurement(own_s), LIMITS_S, refresh_hz=refresh_hz, flickers=flickers)
    assert advice.exposure_s == pytest.approx(expected_s, rel=1e-6)
    assert ("unchanged" in advice.reason) is (expected_s == own_s)


def test_advice_gives_its_reason_and_keeps_to_the_limits() -> None:
    def advise(own_s: float, longest_s: float, limits_s: tuple[float, float] = LIMITS_S, **more: Any) -> ExposureAdvice:
        return advise_exposure(
            measurement(own_s, longest_s=longest_s), limits_s, **{"refresh_hz": 60.0, "flickers": (), **more}
        )

    # Three refreshes serve the mains, too.
    advice = advise(0.02, 0.06, flickers=(MAINS,))
    assert advice.exposure_s == pytest.approx(0.05)
    assert advice.reason == "3 × the refresh period (16.7 ms)"
    # Light is too bright for one period.
    advice = advise(0.02, 0.01)
    assert advice.exposure_s == 0.01
    assert "less than the refresh period (16.7 ms)" in advice.reason
    advice = advise(0.08, 0.04, (1e-3, 0.03), refresh_hz=None)
    assert (advice.exposure_s, advice.usable_s) == (0.03, (0.002, 0.03))


def test_exposure_that_misses_the_refresh_is_noted() -> None:
    assert check_refresh_multiple(measurement(0.02), None) == []
    assert check_refresh_multiple(measurement(1 / 30), 60.0) == []
    [finding] = check_refresh_multiple(measurement(0.02), 60.0)
    assert (finding.name, finding.severity) == ("exposure.refresh", Severity.NOTE)


def test_a_remedy_belongs_to_faults_and_notes_only() -> None:
    assert ok("light.part", "camera 'left'", "all is lit").remedy == ""
    with pytest.raises(ValueError, match="a remedy belongs to every note and fault"):
        fault("light.none", "camera 'left'", "nothing is lit", "")
    with pytest.raises(ValueError, match="a remedy belongs to every note and fault"):
        Finding("light.part", "camera 'left'", Severity.OK, "all is lit", "do nothing")


# ---- Rig files with the values of an examination: whole, readable, and otherwise what they were


OLD = """
# A comment of a person.
name = "bench \\u007f \\"two\\""
calibration = "calibrations/bench.json"

[projector]
driver = "screen"
output = "DP-2"
odd-key = {"a b" = [1, 2.5, true], when = 2026-02-03T04:05:06Z}
nested = [[1, 2], ["x"]]
[projector.timing]
latency_s = 0.03

[[camera]]
name = "left"
driver = "v4l2"
device = "usb-1"
exposure_s = 0.5
[camera.controls]
focus = 7
[[camera.list]]
value = 1
[[camera.list]]
value = 1e-07

[[camera]]
name = "right"
driver = "v4l2"
device = "usb-2"
gain = 2.0

[scan]
line_shift_period_px = 12
exposure_s = 0.25
"""


def diagnosis(
    *,
    synchronisation: Synchronisation | None = None,
    cameras: tuple[str, ...] = ("left",),
    lines: LineAdvice | None = None,
) -> Diagnosis:
    return Diagnosis(
        rig="bench",
        findings=(
            fault("timing.late", "projector", "light comes late, by\nfar", "write it down"),
            ok("light.part", "camera 'left'", "all is lit"),
        ),
        exposures={
            name: ExposureAdvice(1 / 60 + index / 100, "1 × the refresh period", (0.002, 0.03))
            for index, name in enumerate(cameras)
        },
        lines=lines,
        synchronisation=synchronisation,
        refresh_hz=60.0,
        response=None,
        flickers=(),
    )


@pytest.fixture
def old(tmp_path: Path) -> Path:
    (tmp_path / "calibrations").mkdir()
    (tmp_path / "calibrations" / "bench.json").write_text("{}")
    path = tmp_path / "old.toml"
    path.write_text(OLD)
    return path


def test_the_new_file_is_the_old_one_with_the_measured_values(old: Path) -> None:
    new = old.with_name("new.toml")
    measured = Synchronisation(0.0412345678, 0.0031, {"left": 3.0004e-5})
    write_rig_file(diagnosis(synchronisation=measured), old, new, force=False)
    expected = tomllib.loads(OLD)
    expected["camera"][0]["exposure_s"] = 0.0166667
    # One exposure of all scans would hide that of the camera.
    del expected["scan"]["exposure_s"]
    expected["synchronisation"] = {
        "latency_s": 0.041235,
        "latency_error_s": 0.0031,
        "line_time_s": {"left": 3.0004e-5},
    }
    assert tomllib.loads(new.read_text()) == expected
    read = read_rig(new)
    assert read.synchronisation is not None
    assert read.cameras[0].exposure_s == 0.0166667
    assert read.calibration == old.parent / "calibrations" / "bench.json"
    # Every value has a comment that says why, and what a person wrote is as it was.
    lines = new.read_text().splitlines()
    for value in (
        "exposure_s = 0.0166667 # 1 × the refresh period; usable are 2 ms to 30 ms",
        "latency_s = 0.041235 # measured by flashes",
        "latency_error_s = 0.0031 # and the longest further delay",
    ):
        assert any(line.startswith(value) for line in lines)
    assert [line for line in OLD.splitlines() if line not in lines] == ["exposure_s = 0.5", "exposure_s = 0.25"]
    # What was measured once more, the same, changes nothing.
    write_rig_file(diagnosis(synchronisation=measured), new, old, force=True)
    assert old.read_text() == new.read_text()


def test_a_measured_period_of_the_trigger_is_written_without_a_latency(old: Path) -> None:
    new = old.with_name("new.toml")
    write_rig_file(replace(diagnosis(), trigger_period_s=0.01440004), old, new, force=False)
    assert tomllib.loads(new.read_text())["synchronisation"] == {"trigger_period_s": 0.0144}
    assert "# measured by wire" in new.read_text()


def test_lines_that_suit_the_blur_take_the_place_of_those_there(old: Path) -> None:
    old.write_text(old.read_text() + "line_width_px = 2\ngray_cell_px = 2\n")
    advice = advise_lines(3.5, 12, 12)
    assert advice is not None
    new = old.with_name("new.toml")
    write_rig_file(diagnosis(lines=advice), old, new, force=False)
    assert tomllib.loads(new.read_text())["scan"] == {"line_shift_period_px": 24, "line_steps": 8}
    assert "line_shift_period_px = 24 # measured: bars are blurred by 3.5 projector pixels" in new.read_text()


def test_sinusoids_that_suit_the_blur_leave_lines_as_they_are(old: Path) -> None:
    old.write_text(old.read_text() + "line_width_px = 2\n")
    advice = advise_lines(3.5, 8, 4, sines=True)
    assert advice is not None
    new = old.with_name("new.toml")
    write_rig_file(diagnosis(lines=advice), old, new, force=False)
    lines = {"line_shift_period_px": 12, "line_width_px": 2}
    assert tomllib.loads(new.read_text())["scan"] == {**lines, "sine_period_px": 24, "sine_steps": 4}


@pytest.mark.parametrize(
    ("blur_px", "period_px"),
    [(0.0, None), (0.6, None), (1.5, None), (2.2, 16), (3.0, 16), (5.0, 32), (math.inf, None), (math.nan, None)],
)
def test_lines_are_advised_where_they_gain(blur_px: float, period_px: int | None) -> None:
    advice = advise_lines(blur_px, 8, 8)
    assert (None if advice is None else advice.period_px) == period_px
    if advice is not None:
        # Against lines that are played, blurred and measured: a sine of their contrast under the same noise.
        assert advice.gain == pytest.approx(
            scatter_px(blur_px, 8, 8) / scatter_px(blur_px, advice.period_px, advice.steps), rel=0.1
        )


def scatter_px(blur_px: float, period_px: int, steps: int) -> float:
    """Of the places that lines of half a period tell under noise, by drawing it: standard deviation, px."""
    fine, noise = 64, 1e-5
    at = np.arange(0, period_px, 1 / fine)
    light = gaussian_filter(np.tile((at < period_px / 2).astype(float), 9), blur_px * fine)
    light = light[4 * at.size : 5 * at.size]
    frames = np.stack([np.roll(light, step * at.size // steps)[::fine] for step in range(steps)])[:, :, None]
    drawn = frames + np.random.default_rng(1).normal(0, noise, (*frames.shape[:2], 4000))
    turns = np.exp(2j * np.pi * np.arange(steps) / steps)[:, None, None]
    waves = (drawn * turns).sum(axis=0)
    true = (frames * turns).sum(axis=0)
    return float(np.std(np.angle(waves / true))) * period_px / (2 * np.pi)


def test_paths_count_from_the_new_folder(old: Path) -> None:
    folder = old.parent / "elsewhere"
    folder.mkdir()
    write_rig_file(diagnosis(), old, folder / "new.toml", force=False)
    read = read_rig(folder / "new.toml")
    assert read.calibration is not None
    assert read.calibration.resolve() == (old.parent / "calibrations" / "bench.json").resolve()
    # What names no file stays.
    assert read.cameras[0].options["device"] == "usb-1"


def test_a_head_has_one_exposure_the_shortest(tmp_path: Path) -> None:
    old = tmp_path / "old.toml"
    old.write_text('name = "head"\n[head]\ndriver = "simulated"\n')
    write_rig_file(diagnosis(cameras=("left", "right")), old, tmp_path / "new.toml", force=False)
    read = read_rig(tmp_path / "new.toml")
    assert read.head is not None
    assert read.head.exposure_s == 0.0166667


def test_a_file_is_overwritten_only_by_force(old: Path) -> None:
    new = old.with_name("new.toml")
    new.write_text("precious")
    with pytest.raises(ConfigError, match="exists and is unchanged; choose another name"):
        write_rig_file(diagnosis(), old, new, force=False)
    assert new.read_text() == "precious"
    write_rig_file(diagnosis(), old, new, force=True)
    assert read_rig(new).cameras[0].exposure_s == 0.0166667
    with pytest.raises(StorageError, match="create the folder first"):
        write_rig_file(diagnosis(), old, old.parent / "absent" / "new.toml", force=False)
    assert sorted(each.name for each in old.parent.iterdir()) == ["calibrations", "new.toml", "old.toml"]

"""Positions by sinusoids on pixels of known projector position, against the Cramér-Rao bound of their light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from slrig.errors import PatternError
from slrig.model import (
    Axis,
    Black,
    FloatArray,
    Gray,
    NoiseModel,
    Pattern,
    Refusal,
    Sine,
    Size,
    White,
    sine_groups,
)
from slrig.patterns import cell_positions, index_of_word, level_lines, line_positions, require_numbered
from slrig.reconstruction.decoded_image import CodeTables, ReconstructionLimits
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames, axis_frames, axis_patterns
from slrig.reconstruction.fusion import fuse_exposures
from slrig.reconstruction.pipeline import camera_curves
from slrig.reconstruction.second_axis import decode_second_axis
from slrig.reconstruction.sinusoids import SinusoidMap, decode_sinusoids, locate_sinusoids, mean_light
from tests.unit.reconstruction.builders import grid, rms, seen_by_camera

PROJECTOR_PX = 1024
NOISE = NoiseModel(1.0, 0.02)
DARK, BRIGHT, BLUR_PX = 12.0, 150.0, 0.7


def played(*periods: tuple[float, int], singles: Sequence[float] = ()) -> tuple[Sine, ...]:
    """Some periods, each with its number of steps, and single frames of others."""
    stepped = [Sine(Axis.COLUMN, period, shift, steps) for period, steps in periods for shift in range(steps)]
    return (*stepped, *(Sine(Axis.COLUMN, period, 0, 1) for period in singles))


FOUR_STEPS = played((16.0, 4))
THREE_PERIODS = played((16.0, 4), (1024 / 57, 4), (1024 / 50, 4))
TWO_PERIODS = played((64.0, 3), (1024.0, 3))
MICRO = played((18.62, 3), singles=(19.21, 20.08, 20.9, 21.6))


def slope(height: int = 12, width: int = 300) -> FloatArray:
    x, y = grid((height, width))
    return np.asarray(200 + 1.1 * x + 0.13 * y + 3 * np.sin(x / 30))


def light(pattern: Sine, position_px: FloatArray, gamma: float) -> FloatArray:
    """Light of the pattern, blurred behind the projector's gamma."""
    offsets = np.linspace(-4, 4, 33)
    weights = np.exp(-(offsets**2) / 2) / np.exp(-(offsets**2) / 2).sum()
    turns = (position_px[..., None] + BLUR_PX * offsets) / pattern.period_px - pattern.shift / pattern.steps
    return np.asarray(((0.5 + 0.5 * np.cos(2 * np.pi * turns)) ** gamma) @ weights)


def albedo(shape: tuple[int, ...]) -> FloatArray:
    x, y = grid((shape[0], shape[1]))
    return np.asarray(BRIGHT * (1 + 0.3 * np.cos(x / 23 + y / 31)))


def frames_of(
    patterns: tuple[Sine, ...], position_px: FloatArray, *, gamma: float = 1.0, cell_px: int | None = None,
    noise: NoiseModel = NOISE, has_reference: bool = True, brighter: float = 1.0,
) -> tuple[AxisFrames, CodeMap]:  # fmt: skip
    """Noisy frames of 8 bits, and the code of each pixel."""
    rng = np.random.default_rng(3)

    def shot(of_light: FloatArray) -> NDArray[np.uint8]:
        mean = DARK + brighter * albedo(of_light.shape) * of_light
        spread = np.sqrt(noise.read_variance + noise.slope * mean)
        return np.clip(np.rint(mean + rng.normal(0, 1, mean.shape) * spread), 0, 255).astype(np.uint8)

    images = [shot(light(each, position_px, gamma)) for each in patterns]
    white, black = (shot(np.full_like(position_px, each)).astype(np.float32) for each in (1.0, 0.0))
    cell = np.full(position_px.shape, -1, np.int32)
    if cell_px is not None:
        cell = np.floor((position_px + 0.5) / cell_px).astype(np.int32)
    frames = AxisFrames(
        Axis.COLUMN, white, black, [] if cell_px is None else [white], None, Gray(Axis.COLUMN, 0, 8, cell_px or 1),
        [], (), 255.0, sinusoids=images, sine_patterns=patterns, has_reference=has_reference,
    )  # fmt: skip
    return frames, CodeMap(cell, cell.copy(), np.zeros(cell.shape, np.uint8))


def bound_px(patterns: tuple[Sine, ...], position_px: FloatArray, gamma: float, noise: NoiseModel) -> FloatArray:
    """Cramér-Rao bound of each pixel: brightness and modulation of each period with three shifts are unknown."""
    whole = sine_groups(patterns)
    singles = [i for i in range(len(patterns)) if not any(i in each for each in whole)]
    of_light, information = albedo(position_px.shape), np.zeros(position_px.shape)
    for members in [[*whole[0], *singles], *whole[1:]]:
        fisher = np.zeros((*position_px.shape, 3, 3))
        for pattern in (patterns[i] for i in members):
            here = light(pattern, position_px, gamma)
            ahead, behind = (light(pattern, position_px + step, gamma) for step in (1e-3, -1e-3))
            changes = np.stack([of_light * (ahead - behind) / 2e-3, np.ones_like(here), here], axis=-1)
            weight = 1 / (noise.read_variance + 1 / 12 + noise.slope * (DARK + of_light * here))
            fisher += weight[..., None, None] * changes[..., :, None] * changes[..., None, :]
        information += 1 / np.linalg.inv(fisher)[..., 0, 0]
    return np.asarray(1 / np.sqrt(information))


def located(frames: AxisFrames, code: CodeMap, noise: NoiseModel = NOISE) -> SinusoidMap:
    return locate_sinusoids(frames, noise.add_variance(1 / 12), code, PROJECTOR_PX)


SEQUENCES: dict[str, tuple[tuple[Sine, ...], int | None]] = {
    "4 + Gray": (FOUR_STEPS, 8), "4 + aligned Gray": (FOUR_STEPS, 16), "3 + Gray": (played((16.0, 3)), 8),
    "three periods": (THREE_PERIODS, None), "2x3": (TWO_PERIODS, None), "micro": (MICRO, None),
}  # fmt: skip
"""Patterns, and the cell of their Gray code."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_positions_reach_the_bound_of_their_light(name: str, gamma: float) -> None:
    patterns, cell_px = SEQUENCES[name]
    position_px = slope()
    frames, code = frames_of(patterns, position_px, gamma=gamma, cell_px=cell_px, has_reference=cell_px is not None)
    found = located(frames, code)
    error_px = found.measured.position - position_px
    known = np.isfinite(error_px)
    assert known.mean() > 0.995
    assert rms(error_px[known]) <= 1.1 * rms(bound_px(patterns, position_px, gamma, NOISE)[known])
    assert 0.8 <= np.quantile(np.abs(error_px / found.measured.sigma)[known], 0.6827) <= 1.25


@pytest.mark.slow
def test_a_pixel_has_the_least_squares_of_all_its_frames() -> None:
    position_px = slope(16, 20)
    frames, code = frames_of(THREE_PERIODS, position_px)
    found, noise = located(frames, code), NOISE.add_variance(1 / 12)
    group = np.repeat([0, 1, 2], 4)

    def residuals(unknown: FloatArray, values: FloatArray) -> FloatArray:
        phase = [2 * np.pi * (unknown[0] / each.period_px - each.shift / each.steps) for each in THREE_PERIODS]
        mean = unknown[1 + 2 * group] + unknown[2 + 2 * group] * np.cos(phase)
        return np.asarray((values - mean) / np.sqrt(noise.read_variance + noise.slope * mean))

    for y, x in ((2, 3), (8, 11), (14, 17)):
        values = np.array([float(image[y, x]) for image in frames.sinusoids])
        start = np.array([position_px[y, x], *[values.mean(), np.ptp(values) / 2] * 3])
        assert found.measured.position[y, x] == pytest.approx(
            least_squares(residuals, start, args=(values,)).x[0], abs=2e-3
        )


@pytest.mark.slow
def test_clipped_pixels_have_no_position() -> None:
    frames, code = frames_of(FOUR_STEPS, slope(), cell_px=8, brighter=1.6)
    clipped = np.max([np.asarray(image) for image in frames.sinusoids], axis=0) >= 255
    found = located(frames, code)
    assert 0.1 < clipped.mean() < 0.9
    np.testing.assert_array_equal(found.code.refusal == Refusal.SATURATED, clipped)
    assert np.isnan(found.measured.position[clipped]).all()


@pytest.mark.slow
def test_pixels_too_dark_for_the_number_of_their_period_are_refused() -> None:
    position_px, noise = slope(40), NoiseModel(30.0, 0.02)
    frames, code = frames_of(TWO_PERIODS, position_px, noise=noise, brighter=0.3, has_reference=False)
    found = located(frames, code, noise)
    error_px = np.abs(found.measured.position - position_px)
    assert 0.1 < np.isfinite(error_px).mean() < 0.9
    assert (error_px > 30).mean() < 0.01


@pytest.mark.slow
def test_three_shifts_alone_do_not_tell_gamma() -> None:
    frames, code = frames_of(played((1024.0, 3)), slope(), gamma=2.2, has_reference=False)
    assert np.isnan(located(frames, code).response.gamma)


def test_sinusoids_that_repeat_within_the_projector_are_refused() -> None:
    with pytest.raises(PatternError, match="repeat every 80 columns"):
        require_numbered(played((16.0, 3), (20.0, 3)), Size(1024, 768))
    require_numbered(TWO_PERIODS, Size(1024, 768))


def test_periods_without_three_shifts_are_refused() -> None:
    with pytest.raises(PatternError, match="no period has three shifts"):
        axis_patterns(played(singles=(16.0, 20.0)), "eye", Axis.COLUMN)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_mean_light_is_that_of_the_power_of_a_sinusoid(gamma: float) -> None:
    phase = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    of_phase = (0.5 + 0.5 * np.cos(phase)) ** gamma
    expected = of_phase.mean(), 2 * (of_phase * np.cos(phase)).mean()
    assert mean_light(gamma) == pytest.approx(expected, abs=1e-5)


CODE = tuple(Gray(Axis.COLUMN, bit, 3, 16, 0, inverted) for bit in range(3) for inverted in (False, True))
ENDS = (White(), Black())


@pytest.mark.slow
@pytest.mark.parametrize(
    "patterns",
    [pytest.param((*ENDS, *CODE, *FOUR_STEPS), id="white, black, Gray", marks=pytest.mark.slow),
     pytest.param((*CODE, *FOUR_STEPS), id="Gray"), pytest.param(played((16.0, 4), (128 / 7, 4)), id="two periods"),
     pytest.param((*ENDS, *played((16.0, 3), (128.0, 3))), id="2x3 with white and black", marks=pytest.mark.slow)],
)  # fmt: skip
def test_curves_of_sinusoids_lie_at_their_projector_positions(patterns: tuple[Pattern, ...]) -> None:
    x, y = grid((45, 200))
    position_px = 10 + 0.5 * x + 0.03 * y
    capture = seen_by_camera(position_px, patterns, Size(128, 96))
    frames = axis_frames(capture, "eye", Axis.COLUMN)
    stages: list[str] = []
    curves = camera_curves(frames, tables_of(frames, 128), ReconstructionLimits(), report_step=stages.append)
    ensemble = curves.ensemble
    assert len(ensemble.position_px) > 90
    seen_px = 10 + 0.5 * ensemble.points_px[:, 0] + 0.03 * ensemble.points_px[:, 1]
    error_px = seen_px - np.repeat(ensemble.position_px, np.diff(ensemble.offsets))
    assert len(error_px) > 0.9 * 45 * 90
    assert np.abs(error_px).max() < 0.5
    assert abs(error_px.mean()) < 0.02
    # In camera pixels, each half a projector pixel.
    assert 0.7 <= np.quantile(np.abs(error_px / 0.5 / ensemble.sigma_px), 0.6827) <= 1.25


def tables_of(frames: AxisFrames, extent_px: int) -> CodeTables:
    """Tables of positions and levels."""
    size, positions = Size(extent_px, 96), Gray(Axis.COLUMN, 0, 7)
    levels = line_positions(level_lines(frames.sine_patterns), positions, size)
    return CodeTables(index_of_word(frames.gray), cell_positions(positions, size), levels)


@pytest.mark.slow
def test_a_second_axis_of_sinusoids_has_their_positions() -> None:
    x, y = grid((30, 80))
    position_px = 20 + 0.6 * x + 0.1 * y
    frames = axis_frames(seen_by_camera(position_px, (*ENDS, *CODE, *FOUR_STEPS), Size(128, 96)), "eye", Axis.COLUMN)
    second = decode_second_axis(frames, NoiseModel(0.8, 0.0), tables_of(frames, 128), ReconstructionLimits().decoding)
    error_px = second.positions.position_px - position_px
    assert np.isfinite(error_px).mean() > 0.99
    assert rms(error_px[np.isfinite(error_px)]) < 0.1


@pytest.mark.slow
def test_a_bracket_of_sinusoids_measures_what_its_longest_exposure_clips() -> None:
    x, y = grid((30, 120))
    position_px = 10 + 0.8 * x + 0.03 * y
    long, short = (
        seen_by_camera(position_px, played((16.0, 4), (128 / 7, 4)), Size(128, 96), white=white)
        for white in (320.0, 80.0)
    )
    shots = [replace(each, exposure_s=0.04) for each in long.shots]
    shots += [replace(each, exposure_s=0.01) for each in short.shots]
    clipped = np.max([each.image for each in long.shots], axis=0) == 255
    fused = fuse_exposures(replace(long, shots=tuple(shots)), "eye", Axis.COLUMN)
    limits = ReconstructionLimits().decoding
    found = decode_sinusoids(fused.frames, fused.noise, np.zeros(2, np.int32), 128, limits)
    error_px = (found.measured.position - position_px)[:, 5:-5]
    assert clipped.mean() > 0.2
    assert np.isfinite(error_px[clipped[:, 5:-5]]).mean() > 0.95
    assert rms(error_px[np.isfinite(error_px)]) < 0.15

"""Fusion of exposures: continuous where they meet, with minimal noise, as stated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import (
    Axis,
    Black,
    CameraFormat,
    Capture,
    FloatArray,
    Gray,
    LineShift,
    NoiseModel,
    Pattern,
    Refusal,
    Shot,
    Sine,
    Size,
    White,
)
from slrig.patterns.codes import cell_positions, index_of_word
from slrig.patterns.sequence import phase_patterns
from slrig.patterns.sine_positions import sine_position_px, sine_turns
from slrig.reconstruction.camera_response import estimate_noise
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode
from slrig.reconstruction.frames import AxisFrames, axis_frames
from slrig.reconstruction.fusion import FusedFrames, exposure_use, fuse_exposures
from slrig.reconstruction.phase import position_map

PERIOD, BITS = 8, 5
PROJECTOR = Size(128, 96)
SHAPE = (96, 160)
EXPOSURES_S = (0.005, 0.02, 0.08)
COLUMN = Axis.COLUMN


def patterns() -> list[Pattern]:
    code = [Gray(Axis.COLUMN, b, BITS, 4, inverted=i) for b in range(BITS) for i in (False, True)]
    return [White(), Black(), *code, *(LineShift(Axis.COLUMN, s, PERIOD) for s in range(PERIOD)), White(), Black()]


@dataclass(frozen=True)
class Plate:
    """A plate before an 8-bit camera: column x of the projector at each pixel, and how brightly it shines, in DN per
    second under white. light : what an exposure really gets, by its nominal time. line : the mean light of line frames.
    """

    brightness: FloatArray
    read_variance: float = 0.6
    slope: float = 0.0255
    pedestal: float = 0.0
    ambient: float = 0.02
    light: Callable[[float], float] = lambda exposure_s: exposure_s
    line: float = 0.12

    @property
    def column_px(self) -> FloatArray:
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
        return np.asarray(6.0 + 0.7 * x + 0.03 * y)

    def shown(self, pattern: Pattern) -> FloatArray:
        """(H, W) float64, 0 to 1: softened as a lens does."""
        x = self.column_px
        if isinstance(pattern, White | Black):
            return np.full(SHAPE, float(isinstance(pattern, White)))
        if isinstance(pattern, LineShift):
            return np.asarray(self.line * (1 + np.cos(2 * np.pi * (x - pattern.centre_px) / PERIOD)))
        if isinstance(pattern, Sine):
            return np.asarray(0.5 + 0.5 * np.cos(2 * np.pi * (x / pattern.period_px - pattern.shift / pattern.steps)))
        assert isinstance(pattern, Gray)
        cell = np.floor((x + 0.5) / pattern.cell_px).astype(np.int64)
        lit = (cell ^ cell >> 1) >> (pattern.bits - 1 - pattern.bit) & 1
        return np.asarray(1 - lit if pattern.inverted else lit, dtype=np.float64)

    def mean(self, pattern: Pattern, exposure_s: float) -> FloatArray:
        """(H, W) float64, DN: without noise, and not clipped."""
        lit = self.brightness * (self.ambient + self.shown(pattern))
        return np.asarray(self.pedestal + lit * self.light(exposure_s))

    def image(self, pattern: Pattern, exposure_s: float, rng: np.random.Generator | None) -> NDArray[np.uint8]:
        value = self.mean(pattern, exposure_s)
        if rng is not None:
            value = value + np.sqrt(self.read_variance + self.slope * value) * rng.standard_normal(SHAPE)
        return np.clip(np.rint(value), 0, 255).astype(np.uint8)

    def capture(
        self, exposures_s: Sequence[float] = EXPOSURES_S, *, seed: int | None = None, shown: Sequence[Pattern] = ()
    ) -> Capture:
        rng = None if seed is None else np.random.default_rng(seed)
        shown = shown or patterns()
        shots = tuple(
            Shot(i, "eye", self.image(pattern, exposure_s, rng), exposure_s)
            for exposure_s in exposures_s
            for i, pattern in enumerate(shown)
        )
        return Capture(PROJECTOR, tuple(shown), {"eye": CameraFormat(Size(*SHAPE[::-1]), 8)}, shots)


def steps() -> FloatArray:
    """Dark, usual and mirror-bright thirds, each of a slope: 1 : 40."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    return np.asarray(np.exp(np.interp(x, [0, 159], np.log([700.0, 28_000.0])) + 0.1 * np.sin(y / 9)))


PLATE = Plate(steps())
# Without a pedestal the noise of the dark is cut off at zero.
NOISY = Plate(steps(), pedestal=5.0)


def fused(plate: Plate = PLATE, *, seed: int | None = 1, exposures_s: Sequence[float] = EXPOSURES_S) -> FusedFrames:
    return fuse_exposures(plate.capture(exposures_s, seed=seed), "eye", COLUMN)


def position_of(frames: AxisFrames, noise: NoiseModel, plate: Plate) -> tuple[FloatArray, FloatArray]:
    """Error of the phase's position, px, and its stated standard deviation."""
    cell = np.clip(np.floor((plate.column_px + 0.5) / 4).astype(np.int32), 0, 31)
    code = CodeMap(cell, cell, np.zeros(SHAPE, dtype=np.uint8))
    seen = position_map(frames, noise, code, cell_positions(frames.gray, PROJECTOR))
    return np.asarray(seen.position - plate.column_px), np.asarray(seen.sigma, dtype=np.float64)


def test_values_clipped_in_a_long_exposure_come_from_short_ones() -> None:
    fusion = fused()
    weights = dict(zip(fusion.exposures_s.tolist(), fusion.weights, strict=True))
    np.testing.assert_allclose(fusion.weights.sum(axis=0), 1, rtol=1e-6)
    brightest = PLATE.mean(White(), 1.0) * 1.0
    assert (weights[0.08][brightest * 0.08 > 270] == 0).all()
    assert (weights[0.08][brightest * 0.08 < 220] > 0.5).all()
    assert (weights[0.02][brightest * 0.02 > 270] == 0).all()
    assert (weights[0.005] > 0).all()
    # In units of the longest exposure there is no step where another one takes over.
    truth = PLATE.brightness * 0.08
    assert np.abs(fusion.frames.contrast / truth - 1)[truth > 40].max() < 0.12
    assert np.abs(np.median(fusion.frames.contrast / truth, axis=0) - 1).max() < 0.04
    assert fusion.frames.exposure_ratio == pytest.approx(16, rel=0.01)
    assert fusion.frames.reference_repeats == 2.0


def without(capture: Capture, keep: Callable[[Shot], bool]) -> Capture:
    return replace(capture, shots=tuple(shot for shot in capture.shots if keep(shot)))


def unpaired(capture: Capture) -> Capture:
    return without(capture, lambda shot: not getattr(capture.patterns[shot.pattern], "inverted", False))


def decoded(frames: AxisFrames, noise: NoiseModel) -> NDArray[np.uint8]:
    return decode(frames, noise, index_of_word(frames.gray), 32, DecodingLimits()).refusal


def test_a_pixel_that_every_exposure_clips_is_refused_as_saturated_and_one_that_any_shows_is_not() -> None:
    plate = Plate(steps() * np.where(np.arange(SHAPE[1]) < 150, 1.0, 20.0), line=0.4)
    fusion = fuse_exposures(unpaired(plate.capture(seed=1)), "eye", COLUMN)
    refusal = decoded(fusion.frames, fusion.noise)
    assert (refusal[:, 150:] == Refusal.SATURATED).all()
    assert np.mean(refusal[:, :150] == Refusal.NONE) > 0.98
    # A bit and its inverse may be told apart where one of them is clipped; the position of the lines cannot.
    paired = fused(plate)
    error, _ = position_of(paired.frames, paired.noise, plate)
    assert np.isnan(error[:, 150:]).all()
    assert np.isfinite(error[:, :150]).all()
    alone = axis_frames(unpaired(plate.capture((0.08,), seed=1)), "eye", COLUMN)
    assert np.mean(decoded(alone, estimate_noise(alone))[:, :150] == Refusal.NONE) < 0.6


@pytest.mark.parametrize(
    "plate",
    [
        Plate(steps(), pedestal=12.0, line=0.5),
        # A projector that refreshes gives of the shortest less than it should.
        Plate(steps(), light=lambda exposure_s: exposure_s * (0.8 if exposure_s < 0.01 else 1.0), line=0.5),
    ],
    ids=["a pedestal", "exposures that are off"],
)
def test_the_same_exposures_in_all_frames_of_a_pixel_keep_lines_where_they_are(plate: Plate) -> None:
    capture = plate.capture()
    fusion = fuse_exposures(capture, "eye", COLUMN)
    peak = plate.brightness * plate.light(0.08)
    bright = (peak > 900) & (peak < 3500)
    assert np.count_nonzero(bright) > 3000
    error, _ = position_of(fusion.frames, fusion.noise, plate)
    # What is left is that of rounding to whole numbers. Were each sample from the longest exposure at which it itself
    # is not clipped, it were more than four times as much.
    assert np.sqrt(np.mean(error[bright] ** 2)) < 0.006


def scattered(count: int) -> tuple[list[FusedFrames], dict[str, NDArray[np.bool_]]]:
    """Captures of one plate with other noise, and its parts by the longest exposure that shows them."""
    white = NOISY.brightness * (1 + NOISY.ambient)
    parts = {
        "dark": white * 0.08 < 200,
        "usual": (white * 0.08 > 270) & (white * 0.02 < 220),
        "bright": white * 0.02 > 270,
    }
    return [fused(NOISY, seed=seed) for seed in range(count)], parts


def test_stated_noise_matches_actual_noise() -> None:
    tries, parts = scattered(10)
    for part in parts.values():
        assert np.count_nonzero(part) > 2000
    line = np.array([each.frames.lines[3] for each in tries], dtype=np.float64)
    found = line.var(axis=0, ddof=1)
    stated = np.mean([each.noise.variance(each.frames.lines[3]) for each in tries], axis=0)
    positions, sigmas = zip(*(position_of(each.frames, each.noise, NOISY) for each in tries), strict=True)
    scatter, sigma = np.std(positions, axis=0, ddof=1), np.mean(sigmas, axis=0)
    for name, part in parts.items():
        assert np.sqrt(stated[part].mean() / found[part].mean()) == pytest.approx(1, abs=0.08), name
        ratio = np.median(sigma[part]) / np.sqrt(np.mean(scatter[part] ** 2))
        assert ratio == pytest.approx(1, abs=0.12), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("exposures_s", "most"),
    # A short exposure's read noise weighs heavily where there is little light: it may not make the sum worse.
    [
        pytest.param((0.04, 0.08), 0.88, marks=pytest.mark.slow),
        pytest.param((0.02, 0.08), 1.0, marks=pytest.mark.slow),
        ((0.005, 0.02, 0.08), 1.0),
    ],
)
def test_fused_exposures_have_less_noise_than_the_best_of_them(exposures_s: Sequence[float], most: float) -> None:
    dark = NOISY.brightness * 0.08 < 200
    together = np.array([fused(NOISY, seed=seed, exposures_s=exposures_s).frames.lines[3] for seed in range(8)])
    longest = (NOISY.capture((0.08,), seed=seed) for seed in range(8))
    alone = np.array([axis_frames(each, "eye", COLUMN).lines[3] for each in longest])
    assert together.var(axis=0, ddof=1)[dark].mean() < most * alone.var(axis=0, ddof=1)[dark].mean()


def test_light_that_does_not_follow_the_exposure_is_measured() -> None:
    # A projector that refreshes: of 5 ms, two thirds of the light that they should have.
    plate = Plate(steps(), light=lambda exposure_s: exposure_s * (0.67 if exposure_s < 0.01 else 1.0))
    fusion = fused(plate)
    np.testing.assert_allclose(fusion.light, [1, 0.25, 0.0625 * 0.67], rtol=0.02)
    uses = exposure_use(fusion, np.ones(SHAPE, dtype=np.bool_))
    assert [round(each.light, 1) for each in uses] == [0.7, 1.0, 1.0]
    truth = plate.brightness * 0.08
    assert np.abs(np.median(fusion.frames.contrast / truth, axis=0) - 1).max() < 0.04


def test_too_few_clear_pixels_leave_it_to_the_clock() -> None:
    fusion = fused(Plate(np.full(SHAPE, 90.0)), seed=1)
    np.testing.assert_allclose(fusion.light, [1, 0.25, 0.0625])


def test_the_use_of_each_exposure_is_listed_from_short_to_long() -> None:
    fusion = fused()
    everywhere = np.ones(SHAPE, dtype=np.bool_)
    uses = exposure_use(fusion, everywhere)
    assert [each.exposure_s for each in uses] == list(EXPOSURES_S)
    assert sum(each.longest_of for each in uses) == pytest.approx(1)
    assert sum(each.weight for each in uses) == pytest.approx(1)
    white = PLATE.mean(White(), 1.0)
    assert uses[2].longest_of == pytest.approx(np.mean(white * 0.08 < 0.97 * 255), abs=0.05)
    dark = exposure_use(fusion, white * 0.08 < 200)
    assert (dark[0].longest_of, dark[1].longest_of, dark[2].longest_of) == (0, 0, 1)
    assert exposure_use(fusion, ~everywhere)[0].weight == 0


def test_the_order_in_which_exposures_come_and_how_exactly_they_are_named_does_not_matter() -> None:
    capture = PLATE.capture(seed=2)
    fusion = fuse_exposures(capture, "eye", COLUMN)
    jittered = tuple(replace(s, exposure_s=(s.exposure_s or 0) * (1 + 1e-4 * (s.pattern % 3))) for s in capture.shots)
    again = fuse_exposures(replace(capture, shots=jittered[::-1]), "eye", COLUMN)
    for name in ("white", "black", "bits", "lines"):
        np.testing.assert_array_equal(getattr(fusion.frames, name), getattr(again.frames, name))


REFUSED: Mapping[str, tuple[Callable[[Capture], Capture], Sequence[str]]] = {
    "a hole": (
        lambda c: without(c, lambda s: s.exposure_s != 0.02 or c.patterns[s.pattern] != Gray(Axis.COLUMN, 2, BITS, 4)),
        ["camera 'eye'", "bracket", "for every pattern", "0.02"],
    ),
    "an unknown exposure": (
        lambda c: replace(
            c, shots=tuple(replace(s, exposure_s=None) if s.exposure_s == 0.02 else s for s in c.shots)
        ),
        ["bracket", "stated", "None"],
    ),
    "a missing bit": (
        lambda c: without(c, lambda s: getattr(c.patterns[s.pattern], "bit", None) != 1),
        ["camera 'eye'", "bits [1] of 5", "shoot them again"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_an_incomplete_bracket_is_refused(case: str) -> None:
    change, words = REFUSED[case]
    with pytest.raises(PatternError) as caught:
        fuse_exposures(change(PLATE.capture()), "eye", COLUMN)
    for word in words:
        assert word in str(caught.value)


def test_a_bracket_without_inverses_is_fused_as_well() -> None:
    fusion = fuse_exposures(unpaired(PLATE.capture(seed=4)), "eye", COLUMN)
    assert fusion.frames.inverses is None
    assert np.mean(decoded(fusion.frames, fusion.noise) == Refusal.NONE) > 0.95


def test_a_bracket_of_sinusoids_is_fused_as_well() -> None:
    shown = phase_patterns(PROJECTOR, period_px=PERIOD, steps=4, rows=False)
    frames = fuse_exposures(PLATE.capture(seed=5, shown=shown), "eye", COLUMN).frames
    by_period = np.reshape(frames.sinusoids, (3, 4, *SHAPE))
    periods_px = [each.period_px for each in frames.sine_patterns[::4]]
    found = sine_position_px([sine_turns(each) for each in by_period], periods_px, PROJECTOR.width_px)
    error_px = found.position_px - PLATE.column_px
    assert np.sqrt(np.mean(error_px**2)) < 0.05

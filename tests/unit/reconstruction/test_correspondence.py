"""Sub-pixel correspondences against surfaces of known position, and the crossings' kernel against plain numpy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from slrig.model import Axis, FloatArray, Gray, LineShift, NoiseModel, Pattern, Size
from slrig.patterns.codes import cell_positions, edge_positions, index_of_word, line_positions
from slrig.patterns.sequence import profile
from slrig.reconstruction.correspondence import (
    CorrespondenceLimits,
    ProjectorPositions,
    edge_crossings,
    near_print_edges,
    projector_positions,
)
from slrig.reconstruction.decoded_image import CodeTables
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode
from slrig.reconstruction.frames import AxisFrames
from tests.unit.reconstruction.builders import code_frames

PROJECTOR = Size(256, 64)
SHAPE = (32, 220)
NOISE = NoiseModel(1.0, 0.05)
QUIET = NoiseModel(1e-6, 0.0)
BLACK, WHITE = 10.0, 160.0


@dataclass(frozen=True)
class Wall:
    """A wall whose projector position is across·x + down·y + start, seen with a Gaussian blur along x.

    rise : slope of ln L along x. black_px : from where to where along x it is printed black, a twelfth as bright.
    """

    across: float = 0.55
    down: float = 0.013
    start: float = 20.3
    blur_px: float = 0.8
    rise: float = 0.0
    black_px: tuple[float, float] | None = None

    def position(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return self.across * x + self.down * y + self.start

    def light(self, pattern: Pattern) -> FloatArray:
        """(H, W) float64, 0 for no light: the exact integral of a step function of x times exp(rise x), blurred.

        The Gaussian of exp(a x) · Φ's steps at x_k is exp(a x + a²s²/2) · Σ jump_k Φ((x + a s² - x_k)/s).
        """
        lit = np.pad(profile(pattern, PROJECTOR).ravel() / 255.0, 1)
        edges = np.arange(PROJECTOR.width_px + 1) - 0.5
        rows, columns = SHAPE
        x, moved = np.arange(columns), self.rise * self.blur_px**2
        image = np.zeros(SHAPE)
        for y in range(rows):
            at = (edges - self.down * y - self.start) / self.across
            places = np.sort(np.concatenate([at, self.black_px or ()]))
            middle = np.concatenate([[places[0] - 1], (places[1:] + places[:-1]) / 2, [places[-1] + 1]])
            value = lit[np.searchsorted(at, middle)]
            if self.black_px is not None:
                value = np.where((middle > self.black_px[0]) & (middle < self.black_px[1]), value / 12, value)
            jump = np.diff(value)
            places, jump = places[jump != 0], jump[jump != 0]
            image[y] = ndtr((x[:, None] + moved - places) / self.blur_px) @ jump
        return np.asarray(image * np.exp(self.rise * (x - columns / 2) + self.rise * moved / 2))

    def frames(
        self, *, noise: NoiseModel = QUIET, seed: int = 1, period_px: int = 0, paired: bool = True
    ) -> AxisFrames:
        rng = np.random.default_rng(seed)
        cell = period_px // 2 or 1
        gray = Gray(Axis.COLUMN, 0, int(np.log2(PROJECTOR.width_px // cell)), cell_px=cell)
        patterns = tuple(LineShift(Axis.COLUMN, shift, period_px) for shift in range(period_px))

        def shot(light: FloatArray) -> NDArray[np.float32]:
            mean = BLACK + (WHITE - BLACK) * light
            return (mean + np.sqrt(noise.variance(mean.astype(np.float32))) * rng.normal(size=SHAPE)).astype(np.float32)

        bits = [self.light(replace(gray, bit=bit)) for bit in range(gray.bits)]
        opposite = [self.light(replace(gray, bit=bit, inverted=True)) for bit in range(gray.bits)]
        return code_frames(
            bits=np.stack([shot(each) for each in bits]),
            inverses=np.stack([shot(each) for each in opposite]) if paired else None,
            white=shot(bits[0] + opposite[0]),
            black=shot(np.zeros(SHAPE)),
            lines=np.stack([shot(self.light(each)) for each in patterns]) if patterns else None,
            line_patterns=patterns, cell_px=cell,
        )  # fmt: skip

    def found(
        self, *, noise: NoiseModel = NOISE, period_px: int = 0, seed: int = 1, paired: bool = True
    ) -> tuple[ProjectorPositions, FloatArray]:
        """The correspondences, and by how much each is off."""
        frames = self.frames(noise=noise, seed=seed, period_px=period_px, paired=paired)
        blur_px = self.blur_px
        seen = projector_positions(
            frames, tables(frames), INSIDE, CorrespondenceLimits(), camera_blur_px=blur_px, noise=noise
        )
        return seen, seen.position_px - self.position(*seen.pixels_px.T)


def tables(frames: AxisFrames) -> CodeTables:
    gray, lines = frames.gray, frames.line_patterns
    position = line_positions(lines, gray, PROJECTOR) if lines else edge_positions(gray, PROJECTOR)
    return CodeTables(index_of_word(gray), cell_positions(gray, PROJECTOR), position)


def decoded(frames: AxisFrames, noise: NoiseModel) -> CodeMap:
    known = tables(frames)
    return decode(frames, noise, known.index_of_word, len(known.cell_position), DecodingLimits())


INSIDE = np.zeros(SHAPE, dtype=np.bool_)
INSIDE[2:-2, 8:-8] = True


def crossings_by_numpy(
    frames: AxisFrames, code: CodeMap, edge_position: FloatArray, asked: NDArray[np.bool_], noise: NoiseModel
) -> Iterator[tuple[int, int, float, float, float]]:
    """Row, column, fraction, deviation and position of every crossing along rows: one pixel after the other."""
    assert frames.inverses is not None
    known = asked & (code.refusal == 0)
    for row in range(SHAPE[0]):
        for column in range(1, SHAPE[1] - 2):
            if not known[row, column : column + 2].all():
                continue
            here: list[tuple[int, int, float, float, float]] = []
            for bit, (shown, other) in enumerate(zip(frames.bits, frames.inverses, strict=True)):
                four = slice(column - 1, column + 3)
                values = shown[row, four].astype(float) - other[row, four].astype(float)
                if (values > 0).tolist() not in ([True, True, False, False], [False, False, True, True]):
                    continue
                cells = [each[row, column + step] for each in (code.lowest, code.highest) for step in (0, 1)]
                named = {float(edge_position[bit, cell]) for cell in cells}
                if len(named) > 1 or np.isnan(next(iter(named))):
                    continue
                variance = noise.variance(shown[row, four]) + noise.variance(other[row, four])
                if abs(values[3] - values[0]) < 8 * np.sqrt(2 * variance.max()):
                    continue
                at = root(values)
                # Propagation of errors by finite differences through the whole estimate.
                steps = [(root(values + 0.01 * unit) - root(values - 0.01 * unit)) / 0.02 for unit in np.eye(4)]
                straight = values[1] / (values[1] - values[2])
                sigma = np.sqrt(np.sum(np.square(steps) * variance) + (at - straight) ** 2)
                here.append((row, column, at, float(sigma), named.pop()))
            if len(here) == 1:
                yield here[0]


def root(values: FloatArray) -> float:
    """Where the cubic through values at -1, 0, 1, 2 passes zero between 0 and 1."""
    roots = np.roots(np.polyfit([-1.0, 0.0, 1.0, 2.0], values, 3))
    real = roots.real[np.abs(roots.imag) < 1e-9]
    return float(real[np.argmin(np.abs(real - 0.5))])


@pytest.mark.slow
@pytest.mark.parametrize("down", [False, True])
def test_crossings_are_those_of_plain_numpy(down: bool) -> None:
    frames = Wall(blur_px=0.9).frames(noise=NOISE)
    code, edges = decoded(frames, NOISE), tables(frames).position_table
    asked = INSIDE & (np.arange(SHAPE[1]) % 41 > 2) & (np.arange(SHAPE[0])[:, None] < 7)
    wanted = np.array(list(crossings_by_numpy(frames, code, edges, asked, NOISE)))
    assert len(wanted) > 300
    if down:
        assert frames.inverses is not None
        frames = replace(
            frames, white=frames.white.T, black=frames.black.T, bits=[image.T for image in frames.bits],
            inverses=[image.T for image in frames.inverses],
        )  # fmt: skip
        code, asked = CodeMap(code.lowest.T, code.highest.T, code.refusal.T), asked.T
    found = edge_crossings(frames, NOISE, code, edges, asked, down=down, least_sigma=8.0)
    row, column = (found.column, found.row) if down else (found.row, found.column)
    order = np.lexsort([column, row])
    got = np.column_stack([row, column, found.fraction, found.sigma_px, found.position_px])[order]
    assert len(got) == len(wanted)
    np.testing.assert_array_equal(got[:, [0, 1, 4]], wanted[:, [0, 1, 4]])
    np.testing.assert_allclose(got[:, 2], wanted[:, 2], atol=2e-5)
    np.testing.assert_allclose(got[:, 3], wanted[:, 3], rtol=2e-3)
    along = found.pixels_px[:, 1 if down else 0][order]
    np.testing.assert_allclose(along, wanted[:, 1] + wanted[:, 2], atol=2e-5)


@pytest.mark.parametrize(
    ("period_px", "paired", "most_px"),
    [
        (8, True, 0.03),
        pytest.param(0, True, 0.03, marks=pytest.mark.slow),
        pytest.param(0, False, 0.05, marks=pytest.mark.slow),
    ],
)
def test_positions_are_right_within_their_stated_deviation(period_px: int, paired: bool, most_px: float) -> None:
    # Without inverses the middle of white and black stands for them.
    seen, off = Wall().found(period_px=period_px, paired=paired)
    assert seen.by_phase == (period_px > 0)
    assert len(off) > 3000
    assert np.sqrt(np.mean(off**2)) < most_px
    assert abs(off.mean()) < 0.002
    assert 0.8 < np.sqrt(np.mean((off / seen.sigma_px) ** 2)) < 1.25
    assert np.abs(off).max() < 0.25


@pytest.mark.parametrize("blur_px", [0.65, 1.3])
def test_the_deviation_of_a_crossing_includes_the_error_of_the_cubic(blur_px: float) -> None:
    # Next to no noise: the cubic's own error is all there is. Of a sharp edge the deviation holds half.
    seen, off = Wall(blur_px=blur_px).found(noise=NoiseModel(1e-3, 0.0))
    assert np.sqrt(np.mean(off**2)) < 0.015
    assert np.sqrt(np.mean((off / seen.sigma_px) ** 2)) < 2.4


@pytest.mark.parametrize("period_px", [0, 8])
def test_a_surface_brighter_on_one_side_displaces_nothing(period_px: int) -> None:
    # ln L rises by 0.03 per px: uncorrected, light comes from 0.8² · 0.03 = 0.02 px to the right.
    wall = Wall(rise=0.03, start=60.3, across=0.5)
    asked = np.zeros(SHAPE, dtype=np.bool_)
    asked[2:-2, 60:140] = True
    frames = wall.frames(period_px=period_px)
    offs = []
    for blur_px in (0.8, 0.0):
        seen = projector_positions(
            frames, tables(frames), asked, CorrespondenceLimits(), camera_blur_px=blur_px, noise=NoiseModel(0.01, 0.0)
        )
        offs.append(float(np.mean(seen.position_px - wall.position(*seen.pixels_px.T))))
    assert offs[1] == pytest.approx(0.5 * 0.8**2 * 0.03, rel=0.1)
    assert abs(offs[0]) < 0.1 * abs(offs[1])


def test_pixels_near_an_edge_of_the_print_are_left_out() -> None:
    edges = (100.2, 130.7)
    seen, off = Wall(black_px=edges, blur_px=1.1).found(noise=NoiseModel(0.1, 0.005), period_px=8)
    x = seen.pixels_px[:, 0]
    for edge in edges:
        assert np.abs(x - edge).min() > 2 * 1.1
    within = (x > 100) & (x < 130)
    assert np.count_nonzero(within) > 500
    assert np.count_nonzero(~within) > 3000
    assert abs(off[within].mean()) < 0.02
    assert 0.8 < np.sqrt(np.mean((off / seen.sigma_px) ** 2)) < 1.25


def test_even_paper_has_no_edges_of_print_however_dark_and_noisy() -> None:
    rng = np.random.default_rng(3)
    contrast = (8.0 + 2.0 * rng.normal(size=(120, 120))).astype(np.float32)
    near = near_print_edges(contrast, np.full_like(contrast, 2.0), 0.8, CorrespondenceLimits())
    assert near.mean() < 0.01
    contrast[:, 60:] += 150
    near = near_print_edges(contrast, np.full_like(contrast, 2.0), 0.8, CorrespondenceLimits())
    assert near[:, 58:62].all()
    assert not near[:, 75:].any()


def test_unresolved_finest_bits_are_left_out() -> None:
    # A blur of 3.2 px leaves a fortieth of bars 3.6 px wide; the coarser bits' edges still stand.
    seen, off = Wall(blur_px=3.2).found()
    cells = np.rint(seen.position_px + 0.5).astype(int)
    assert np.count_nonzero(cells % 2) == 0
    assert np.count_nonzero(cells % 4 == 0) > 500
    assert np.abs(off).max() < 0.5
    assert np.sqrt(np.mean(off**2)) < 0.1


def test_a_surface_unlit_or_outside_the_region_has_no_correspondences() -> None:
    frames = Wall().frames(noise=NOISE)
    unlit = [np.full_like(image, BLACK) for image in frames.bits]
    dark = replace(frames, white=frames.black, bits=unlit, inverses=unlit)
    for given, asked in ((dark, INSIDE), (frames, np.zeros_like(INSIDE))):
        seen = projector_positions(given, tables(given), asked, CorrespondenceLimits(), camera_blur_px=0.8, noise=NOISE)
        assert seen.pixels_px.shape == (0, 2)
        assert seen.position_px.shape == seen.sigma_px.shape == (0,)
    assert not projector_positions(
        dark, tables(dark), INSIDE, CorrespondenceLimits(), camera_blur_px=0.8, noise=NOISE
    ).lit.any()


def test_positions_near_the_border_of_the_projector_are_left_out() -> None:
    seen, _ = Wall(start=200.0, across=0.4).found(period_px=8)
    assert seen.position_px.max() <= PROJECTOR.width_px - 1 - 3
    assert seen.position_px.max() > PROJECTOR.width_px - 12

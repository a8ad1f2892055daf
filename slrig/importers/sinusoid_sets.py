"""Sinusoids of several periods that number positions without a Gray code, found from sampled images: pure functions.

N equal steps of a period add up to the same light, and leave nothing but a first harmonic: this tells which images are
of one period. Where its phase grows over the image tells the axis. Phases, or differences of phases, that turn once at
most over all that is visible number the next finer ones, so that all become whole multiples of one another. The extent
of the projector gives the multiples a length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import BundleError
from slrig.importers.detection import Light
from slrig.importers.orders import SLSTUDIO_PERIODS, ProjectorCode, slstudio_micro_sequence
from slrig.model import MIN_LINE_STEPS, MIN_SINE_PERIOD_PX, Axis, Black, FloatArray, Pattern, Sine, Size, White
from slrig.patterns import sine_periods_px

Phasors = NDArray[np.complex128]

_MAX_STEPS = 16
_THIN = 4000  # samples, where many tell no more
_LIT, _MIN_LIT = 0.2, 300  # of the range of light that few samples exceed; least number of samples
_HALF_LIT, _MIN_HALF_LIT = 0.25, 0.12  # of the range from its middle; share of the samples of a sinusoid
_SAME = 0.15  # of the variation of an image, that it differs from its copy
_FLAT = 0.25  # of the usual variation between samples, of white and black
_EXPONENTS = 1.0, 0.5, 0.3, 2.0  # of light, near the one that undoes the response of camera and projector
_CLIPPED, _MIN_CLEAR = 0.99, 0.3  # of the brightest sample; least share of samples that are never brighter
_MAX_CHOICES = 16  # of images that may be white and black
_EVEN_TURNS = 2.0  # over the image, of phases that are as frequent
_FREE_LIGHT = 0.2  # of the square of an image's light over the usual one, as much as one of the residual
_MORE_PERIODS = 0.01  # cost of a period, over the share of light that its steps do not explain
_SURE_REST, _MAX_REST = 0.03, 0.18  # of the square of the first harmonic, per degree of freedom
_UNEQUAL = 0.05  # cost of another number of steps
_MAX_TURN = 0.3  # of a phase, over a distance that tells how fast it grows
_MIN_STEADY = 0.6  # coherence, of the growth of a phase over a distance
_BLUR = 5  # samples; of a phase that grows by less than the limit over them
_MIN_VISIBLE_TURNS, _MAX_VISIBLE_TURNS = 0.06, 1.08  # of a phase that numbers others
_BINS = 256
_PACE_ERROR = 0.1  # of how much faster a phase grows than another
_MIN_COHERENT = 0.6  # of a phase with positions
_MAX_UNIT = 8  # periods over the screen, of the phase that numbers others
_MAX_STRETCH, _RARE_UNIT, _RARE_NUMBER, _MAX_SETS = 0.15, 1.0, 0.25, 12
_BENT_TURNS = 0.02  # error of a phase over all that is visible
_MAX_COST = 4.0
_SURE_TURNS = 0.006  # error of the phase at the first pixel, with what harmonics do to it
_RIVAL = 0.45  # of costs of two readings that count as equally good
_REFUTED, _MAX_OFF_CENTRE = 3.0, 0.45  # costs of a visible range
_OFF_CENTRE = 0.15  # of the projector's extent, that the middle of what is visible is usually from its own
_MAX_BEYOND = 0.03  # of the samples, that may be beyond the projector
_MIN_SPAN_USED = 0.25  # share of a span that the projector shows
_MAX_PERIOD_PX = 64  # of the finest sinusoid of a program's set
_MICRO_FIT = 0.93  # correlation of images with the light at the best position


@dataclass(frozen=True, slots=True)
class SinusoidAxis:
    """Sinusoids of one axis. shown : pattern of each image. periods_px : of each period; visible_px : first and last
    position that is visible; span_px : which all periods divide. other_periods_px : that fit as well. is_start_unsure :
    True if the first images may begin with other shifts. is_mixed : True if some are shifted against others.
    """

    axis: Axis
    shown: Mapping[int, Sine]
    periods_px: tuple[float, ...]
    visible_px: tuple[float, float]
    span_px: float = math.nan
    other_periods_px: tuple[tuple[float, ...], ...] = ()
    is_start_unsure: bool = False
    is_mixed: bool = False


@dataclass(frozen=True, slots=True)
class SinusoidSet:
    """What images show. references : white and black. copies : image and the one before that it repeats."""

    axes: tuple[SinusoidAxis, ...]
    references: Mapping[int, Pattern]
    copies: Mapping[int, int]


@dataclass(frozen=True, slots=True)
class _Period:
    """Images of one period, in the order of its shifts. phase : (k,) of length 1, at the samples; rate : turns per
    pixel of the image, to the right and down.
    """

    images: tuple[int, ...]
    phase: Phasors
    rate: tuple[float, float]

    @property
    def axis(self) -> Axis:
        return Axis.COLUMN if abs(self.rate[0]) > abs(self.rate[1]) else Axis.ROW

    @property
    def growth(self) -> float:
        """Turns per pixel along its axis."""
        return self.rate[0 if self.axis is Axis.COLUMN else 1]


def _flat_images(light: FloatArray) -> list[int]:
    """Return which of (n, k) images may be white or black: their share of the mean light is the same everywhere."""
    found: set[int] = set()
    for exponent in _EXPONENTS[:2]:
        shown = light**exponent
        low, high = np.percentile(shown / shown.mean(axis=0), (16, 84), axis=1)
        spread = high - low
        found |= set(np.flatnonzero(spread < _FLAT * float(np.percentile(spread, 75))).tolist())
    return sorted(found)


def find_sinusoids(samples: Sequence[Light], projector: Size, *, step_px: int) -> SinusoidSet | str:
    """Return sinusoids of several periods that images show, or why they are none, in words.

    samples : (3, h, w) of each image, a sample every step_px pixels.
    """
    stack = np.stack([each.reshape(3, -1) for each in samples]).astype(np.float64)
    span = np.ptp(stack, axis=0).min(axis=0)
    top = float(stack.max())
    lit = span > _LIT * np.percentile(span, 99)
    clear = lit & (stack < _CLIPPED * top).all(axis=(0, 1))
    lit = clear if np.count_nonzero(clear) > _MIN_CLEAR * np.count_nonzero(lit) else lit
    slots = np.flatnonzero(lit).astype(np.int32)
    if len(slots) < _MIN_LIT:
        return "too little of them is lit"
    stack = np.maximum(stack[..., slots], 0.5) / top
    thin = stack[:, 0, :: max(1, len(slots) // _THIN)]
    low, high = thin.min(axis=0), thin.max(axis=0)
    half = np.abs((thin - low) / (high - low) - 0.5) < _HALF_LIT
    if float(np.median(half.mean(axis=1))) < _MIN_HALF_LIT:
        return "their light changes in steps, not smoothly"
    copies = _copies(thin)
    images = [index for index in range(len(samples)) if index not in copies]
    found = _find_periods(thin, images, projector)
    if found is None:
        return "they are no equal steps of any periods, or one is missing"
    runs, exponent, micro = found
    shown = [k for run in runs for k in run]
    middle = np.median(thin / thin[shown].mean(axis=0), axis=1)
    references = {index: White() if middle[index] > 1 else Black() for index in images if index not in shown}
    if micro is not None:
        return SinusoidSet((micro,), references, copies)
    light = stack**exponent
    light *= _light_factors(thin**exponent, runs)[:, None, None]
    light /= light[shown].mean(axis=0)
    grid = _Grid(slots, samples[0].shape[1:], step_px)
    periods = []
    for run in runs:
        phase = _phasors(light[list(run)])
        rate = [_rate(grid, phase[0], _growth(phase[0], phase[plane]), along) for plane, along in ((1, 1), (2, 0))]
        periods.append(_Period(run, phase[0], (rate[0], rate[1])))
    periods = _even_periods(periods, grid)
    axes: list[SinusoidAxis] = []
    for axis in Axis:
        own = [each for each in periods if each.axis is axis]
        if own:
            others_px = [each.span_px for each in axes]
            numbered = _number(own, axis, grid, projector.along(axis), others_px)
            if isinstance(numbered, str):
                return numbered
            axes.append(numbered)
    return SinusoidSet(tuple(axes), references, copies)


def _copies(light: FloatArray) -> dict[int, int]:
    """Return which of (n, k) images is the same as the one before, and that one."""
    share = light / light.mean(axis=0)
    spread = share.std(axis=1)
    usual = float(np.percentile(spread, 75))
    return {
        index: index - 1
        for index in range(1, len(share))
        if spread[index] > _FLAT * usual and np.std(share[index] - share[index - 1]) < _SAME * spread[index]
    }


def _find_periods(
    light: FloatArray, images: Sequence[int], projector: Size
) -> tuple[list[tuple[int, ...]], float, SinusoidAxis | None] | None:
    """Return the images of each period, the exponent of light with which these are the most even, and SLStudio's micro
    phase shift if they show it; None if there are no periods. Images that are left are white and black.

    light : (n, k) of all images.
    """
    flat = [images[k] for k in _flat_images(light[list(images)])]
    # Of one period that is visible in part, an image may be about as dark everywhere as black.
    choices = [ends for number in range(len(flat), -1, -1) for ends in combinations(flat, number)][:_MAX_CHOICES]
    best: tuple[float, list[tuple[int, ...]], float] = (math.inf, [], 1.0)
    for ends in choices:
        used = [index for index in images if index not in ends]
        shown = [light[used] ** exponent for exponent in _EXPONENTS]
        for each in shown:
            if (micro := _find_micro(each, used, projector)) is not None:
                return [tuple(used)], 1.0, micro
        for exponent, each in zip(_EXPONENTS, shown, strict=True):
            rest, runs = _split(each)
            against = rest + _UNEQUAL * (len({len(run) for run in runs}) - 1)
            if rest < _MAX_REST and against < best[0]:
                best = against, [tuple(used[k] for k in run) for run in runs], exponent
            if best[0] < _SURE_REST:
                return best[1], best[2], None
    return (best[1], best[2], None) if best[1] else None


def _light_factors(light: FloatArray, runs: Sequence[tuple[int, ...]]) -> FloatArray:
    """(n,) factors of images by which evenly shifted ones add up to the same everywhere. light : (n, k)."""
    factors = np.ones(len(light))
    shown = [k for run in runs for k in run]
    for _ in range(3):
        mean = (light[shown] * factors[shown, None]).mean(axis=0)
        for run in runs:
            own = light[list(run)] / mean
            factors[list(run)] = _solved(own @ own.T / own.shape[1], own.mean(axis=1), _FREE_LIGHT / 8)
    return factors


def _even_periods(periods: Sequence[_Period], grid: _Grid) -> list[_Period]:
    """Return periods with the phases that a straight response of camera and projector gives.

    Over some periods every phase is as frequent: harmonics of N steps make some more frequent, N times per turn. What
    evens the slowest phase that turns a few times evens slower ones of as many steps: its harmonics are as little
    blurred.
    """
    even = []
    for period in periods:
        steps = len(period.images)
        turning = [each for each in periods if len(each.images) == steps
                   and abs(each.growth) * grid.extent_px(each.axis) > _EVEN_TURNS]  # fmt: skip
        if not turning:
            even.append(period)
            continue
        usual = period if period in turning else min(turning, key=lambda each: abs(each.growth))
        turns = np.angle(period.phase) / (2 * np.pi)
        for number in (steps, 2 * steps):
            share = np.mean(usual.phase.conj() ** number)
            turns = turns + np.real(share * period.phase**number / (1j * np.pi * number))
        phase = np.exp(2j * np.pi * turns)
        right, down = (_rate(grid, phase, rate, along) for rate, along in zip(period.rate, (1, 0), strict=True))
        even.append(_Period(period.images, phase, (right, down)))
    return even


def _split(light: FloatArray) -> tuple[float, list[tuple[int, ...]]]:
    """Return images as steps of periods, and the largest share of light that one of these does not explain.

    All steps of a period follow each other, or one step of each period; of all images, or of each half.
    """
    count, light = len(light), light / light.mean(axis=0)
    gram, mean = light @ light.T / light.shape[1], light.mean(axis=1)
    ways: list[list[tuple[int, ...]]] = []
    best: list[tuple[float, list[tuple[int, ...]]]] = [(math.inf if end else 0.0, []) for end in range(count + 1)]
    for end in range(1, count + 1):
        for steps in range(MIN_LINE_STEPS, min(_MAX_STEPS, end) + 1):
            before, runs = best[end - steps]
            if before < best[end][0]:
                rest, run = min((_rest(gram, mean, each), each) for each in _shifts(range(end - steps, end)))
                value = before + steps / count * rest + _MORE_PERIODS
                if value < best[end][0]:
                    best[end] = value, [*runs, run]
    ways.append(best[count][1])
    for parts in (1, 2):
        part = count // parts
        for number in range(2, part // MIN_LINE_STEPS + 1):
            if part % number == 0 and count % parts == 0 and part // number <= _MAX_STEPS:
                starts = [start * part + k for start in range(parts) for k in range(number)]
                ways.append([tuple(range(each, each // part * part + part, number)) for each in starts])
    found = [(max(_rest(gram, mean, run) for run in way), way) for way in ways if way]
    return min(found, key=lambda each: each[0] + _MORE_PERIODS * len(each[1])) if found else (math.inf, [])


def _shifts(run: range) -> Iterator[tuple[int, ...]]:
    """Yield a run as evenly shifted images, and as pairs half a period apart, in the order of their shifts."""
    yield tuple(run)
    if len(run) % 2 == 0:
        yield (*run[::2], *run[1::2])


def _solved(gram: FloatArray, mean: FloatArray, stiffness: float) -> FloatArray:
    """(n,) factors by which the sum of images is the most even; near 1, by stiffness times their square difference."""
    count = len(gram)
    system = gram / count**2 + stiffness / count * np.eye(count)
    return np.asarray(np.linalg.solve(system, mean / count + stiffness / count))


def _rest(gram: FloatArray, mean: FloatArray, run: Sequence[int]) -> float:
    """Share of the light of evenly shifted images that is neither even nor the first harmonic, by degrees of freedom.

    gram : (n, n) mean products of images; mean : (n,).
    """
    own, level, count = gram[np.ix_(run, run)], mean[list(run)], len(run)
    weight = _solved(own, level, _FREE_LIGHT)
    moved = _FREE_LIGHT * float(((weight - 1) ** 2).mean())
    product = own * np.outer(weight, weight)
    turn = np.exp(2j * np.pi * np.arange(count) / count)
    first = 2 / count * float(np.real(turn @ product @ turn.conj()))
    even = float(product.sum()) / count**2
    uneven = even - 2 * float(weight @ level) / count + 1
    other = float(np.trace(product)) - count * even - first
    return (count * max(uneven + moved, 0.0) + max(other, 0.0)) / (count - 2) / max(first / 2, 1e-9)


def _phasors(light: FloatArray) -> Phasors:
    """(…, k) first harmonic of evenly shifted images (n, …, k), of length 1."""
    found = np.tensordot(np.exp(2j * np.pi * np.arange(len(light)) / len(light)), light, axes=1)
    return np.asarray(found / np.maximum(np.abs(found), 1e-9))


@dataclass(frozen=True, slots=True)
class _Grid:
    """Where samples are. slots : (k,) places in a grid of a shape, a sample every step_px pixels."""

    slots: NDArray[np.int32]
    shape: tuple[int, ...]
    step_px: int

    def extent_px(self, axis: Axis) -> float:
        """Pixels of the image over which samples are."""
        along = self.slots % self.shape[1] if axis is Axis.COLUMN else self.slots // self.shape[1]
        return float(np.ptp(np.percentile(along, (1, 99)))) * self.step_px

    def spread(self, phase: Phasors) -> Phasors:
        """Return (k,) values on the grid, 0 elsewhere."""
        grid = np.zeros(self.shape[0] * self.shape[1], np.complex128)
        grid[self.slots] = phase
        return grid.reshape(self.shape)


def _growth(phase: Phasors, beside: Phasors) -> float:
    """Return the mean growth from phases to others, in turns."""
    return float(np.angle(np.sum(beside * phase.conj()))) / (2 * np.pi)


def _rate(grid: _Grid, phase: Phasors, rate: float, along: int) -> float:
    """Return how many turns a phase grows per pixel, by its growth over distances that double.

    rate : about. along : 1 to the right, 0 down.
    """
    whole, lag = grid.spread(phase), 1
    while lag < whole.shape[along] // 2:
        ahead = np.take(whole, range(lag, whole.shape[along]), along)
        product = ahead * np.take(whole, range(whole.shape[along] - lag), along).conj()
        distance, total, size = lag * grid.step_px, complex(product.sum()), float(np.abs(product).sum())
        if abs(rate * distance) > _MAX_TURN or abs(total) < _MIN_STEADY * size or not size:
            break
        turn = float(np.angle(total)) / (2 * np.pi)
        rate = (turn + round(rate * distance - turn)) / distance
        lag *= 2
    return rate


@dataclass(frozen=True, slots=True)
class _Signal:
    """A phase, or a difference of phases. phase : (k,) of length 1; rate : turns per pixel along the axis."""

    phase: Phasors
    rate: float


def _number(
    periods: Sequence[_Period], axis: Axis, grid: _Grid, extent: int, others_px: Sequence[float]
) -> SinusoidAxis | str:
    """Return the sinusoids of an axis with their periods, or why these are not determined."""
    if len(periods) == 1:
        return (
            f"{len(periods[0].images)} of them are steps of one period of {axis}s, and nothing numbers its periods: "
            "record other periods or a Gray code too"
        )
    visible = grid.extent_px(axis)
    # A camera is taken to stand upright: phases grow to the right and down.
    phases = [each.phase if each.growth > 0 else each.phase.conj() for each in periods]
    fine = [_calm(phase, abs(each.growth), grid) for phase, each in zip(phases, periods, strict=True)]
    beats = [_difference(a, b, grid, axis) for a, b in combinations(fine, 2)]
    slowest = min(each.rate for each in fine)
    helping = [each for each in beats if _MIN_VISIBLE_TURNS / visible < each.rate < 0.8 * slowest]
    best: tuple[float, FloatArray, FloatArray] | None = None
    for depth, group in enumerate((fine, beats, beats)):
        signals = [_difference(a, b, grid, axis) for a, b in combinations(group, 2)] if depth == 2 else group
        anchors = [each for each in signals if _MIN_VISIBLE_TURNS < each.rate * visible < _MAX_VISIBLE_TURNS]
        for anchor in sorted(anchors, key=lambda each: -each.rate):
            found = _unwrapped(anchor, fine, helping)
            if best is None or found[0] > best[0]:
                best = found
        if best is not None and best[0] > _MIN_COHERENT:
            break
    rates = " : ".join(f"{each.rate / slowest:.3g}" for each in sorted(fine, key=lambda each: each.rate))
    if best is None or best[0] < _MIN_COHERENT:
        return (
            f"{len(periods)} periods of {axis}s, as {rates} in number, turn more than once over what is visible, as do "
            "their differences: nothing numbers them"
        )
    return _place_periods(periods, phases, axis, best[1], best[2], extent, others_px)


def _calm(phase: Phasors, rate: float, grid: _Grid) -> _Signal:
    """Return a phase with less noise, where it grows slowly."""
    if abs(rate) * grid.step_px * _BLUR < _MAX_TURN:
        whole = grid.spread(phase)
        parts = [cv2.blur(np.ascontiguousarray(part), (_BLUR, _BLUR)) for part in (whole.real, whole.imag)]
        phase = (parts[0] + 1j * parts[1]).ravel()[grid.slots]
        phase = phase / np.maximum(np.abs(phase), 1e-9)
    return _Signal(phase, rate)


def _difference(one: _Signal, other: _Signal, grid: _Grid, axis: Axis) -> _Signal:
    phase = one.phase * other.phase.conj()
    rate = _rate(grid, phase, one.rate - other.rate, 1 if axis is Axis.COLUMN else 0)
    return _calm(phase if rate > 0 else phase.conj(), abs(rate), grid)


def _unwrapped(
    anchor: _Signal, fine: Sequence[_Signal], helping: Sequence[_Signal]
) -> tuple[float, FloatArray, FloatArray]:
    """Number phases from slow to fast ones, beginning with one that turns once at most.

    Return the least coherence of a phase with positions, positions in turns of the first, and of each of `fine` how
    often it turns over one of these.
    """
    turns = np.angle(anchor.phase) / (2 * np.pi) % 1
    # The screen ends where the fewest samples are; of a wide gap, in its middle.
    counts = np.tile(np.bincount((turns * _BINS).astype(int) % _BINS, minlength=_BINS), 3)
    narrow, wide = (np.convolve(counts, np.ones(size) / size, mode="same")[_BINS:-_BINS] for size in (5, 65))
    position = (turns - (int(np.argmin(narrow + 0.1 * wide)) + 0.5) / _BINS) % 1
    for signal in sorted((each for each in (*helping, *fine) if each is not anchor), key=lambda each: each.rate):
        if signal.rate < 1.2 * anchor.rate:
            continue
        fit, ratio, start = _fitted(signal, position, signal.rate / anchor.rate, 0.25)
        if fit < _MIN_COHERENT / 2:
            continue
        own = np.angle(signal.phase) / (2 * np.pi) - start
        position = (own + np.rint(ratio * position - own)) / ratio
    low, high = np.percentile(position, (0.5, 99.5))
    inside = (position >= low) & (position <= high)
    # The last phase has put positions right: those of slower ones follow.
    fits = [
        _fitted(_Signal(each.phase[inside], each.rate), position[inside], each.rate / anchor.rate, 0.3) for each in fine
    ]
    return min(each[0] for each in fits), position, np.array([each[1] for each in fits])


def _fitted(signal: _Signal, position: FloatArray, ratio: float, width: float) -> tuple[float, float, float]:
    """Return how well turns of a phase are a multiple of positions, the multiple, and the turns at 0.

    ratio : near which the multiple is, by a share of `width`.
    """
    thin = slice(None, None, max(1, len(position) // _THIN))
    place, phase = position[thin], signal.phase[thin]
    span = max(float(np.ptp(np.percentile(place, (2, 98)))), 0.05)
    centre, reach, pace = ratio, width * ratio, 0.15 / span
    for error in (_PACE_ERROR, math.inf, math.inf):
        tried = centre + np.arange(-math.ceil(reach / pace), math.ceil(reach / pace) + 1) * pace
        values = np.array([np.mean(phase * np.exp(-2j * np.pi * each * place)) for each in tried])
        at = int(np.argmax(np.abs(values) * np.exp(-0.5 * ((tried / ratio - 1) / error) ** 2)))
        centre, reach, pace = float(tried[at]), 4 * pace, pace / 6
    fit = float(abs(values[at]))
    return fit, centre, float(np.angle(values[at])) / (2 * np.pi)


def _whole_numbers(ratio: FloatArray, visible: float) -> list[tuple[float, tuple[int, ...]]]:
    """Return whole numbers that are as ratios, each set with what speaks against it, likely ones first.

    ratio : (f,) periods over the length of the slowest phase, known up to a common factor near 1. visible : share of
    this length in which phases were measured: what harmonics do to a phase bends its growth by as much more.
    """
    sigma = _BENT_TURNS / visible
    found: dict[tuple[int, ...], float] = {}
    for unit in range(1, _MAX_UNIT + 1):
        for factor in unit * np.arange(1 - _MAX_STRETCH, 1 + _MAX_STRETCH, 0.2 / (unit * float(ratio.max()))):
            counts = np.rint(factor * ratio)
            key = tuple(counts.astype(int).tolist())
            if min(key) < 1 or math.gcd(*key) > 1 or key in found or len(set(key)) < len(key):
                continue
            # The factor that fits best by least squares.
            fit = float(ratio @ counts / (ratio @ ratio))
            rest = (counts / fit - ratio) / sigma
            # Programs like multiples of 2, 3 and 5.
            is_common = 30**20 % math.lcm(*key) == 0
            found[key] = 0.25 * float(rest @ rest) + _RARE_UNIT * (unit - 1) + _RARE_NUMBER * (not is_common)
    return sorted((cost, key) for key, cost in found.items())[:_MAX_SETS]


def _place_periods(
    periods: Sequence[_Period],
    phases: Sequence[Phasors],
    axis: Axis,
    position: FloatArray,
    ratio: FloatArray,
    extent: int,
    others_px: Sequence[float],
) -> SinusoidAxis | str:
    """Return sinusoids of whole numbers of periods over a span, by the extent of the projector.

    phases : (k,) of each, growing to the right or down. position : (k,) in any unit, from any place. ratio : turns over
    this unit.
    """
    steps = np.array([len(each.images) for each in periods])
    signs = np.array([1 if each.growth > 0 else -1 for each in periods])
    low, high = (float(each) for each in np.percentile(position, (1, 99)))
    inside = np.flatnonzero((position >= low) & (position <= high))[:: max(1, len(position) // _THIN)]
    found: list[tuple[float, float, tuple[int, ...], tuple[float, ...], tuple[float, float]]] = []
    for misfit, key in _whole_numbers(ratio, high - low):
        counts = np.array(key)
        scale = float(ratio[counts.argmax()]) / counts.max()
        place = position[inside] * scale
        offset = np.array([np.angle(np.mean(phase[inside] * np.exp(-2j * np.pi * count * place))) / (2 * np.pi)
                           for phase, count in zip(phases, key, strict=True)])  # fmt: skip
        sigma = _SURE_TURNS + _BENT_TURNS / 2 / (counts * (high - low) * scale)
        weight = counts / sigma**2
        shifts = np.arange(0, 1, 1 / (24 * counts.max()))
        ordered = np.sort(place)
        spans = _spans(counts, extent, others_px)
        for (span_px, against), (start, rare) in product(spans, _starts(signs, steps)):
            turns = offset[:, None] - counts[:, None] * shifts + start[:, None]
            turns -= np.rint(turns)
            # A shift between those that are tried fits best, by least squares.
            finer = (weight @ turns) / float(weight @ counts)
            cost = 0.5 * (((turns - counts[:, None] * finer) / sigma[:, None]) ** 2).mean(axis=0)
            # Positions count from the first pixel. At steps in depth a few are wrong.
            middle = (low + high) / 2 * scale + shifts + finer
            begin = shifts + finer - np.floor(middle)
            off = middle % 1 * span_px / extent - 0.5
            cost += np.minimum(0.5 * (off / _OFF_CENTRE) ** 2, _MAX_OFF_CENTRE)
            ends = (np.searchsorted(ordered, end - begin) for end in (0.0, extent / span_px))
            cost += _REFUTED * (np.subtract(*ends) > (_MAX_BEYOND - 1) * len(ordered))
            at = int(np.argmin(cost))
            visible = float((low * scale + begin[at]) * span_px), float((high * scale + begin[at]) * span_px)
            found.append((float(cost[at]) + against + rare + misfit, span_px, key, tuple(start.tolist()), visible))
    if not found:
        return f"the numbers of periods of {axis}s are no whole numbers over any length"
    found.sort()
    value, span_px, best, begins, visible = found[0]
    if span_px / max(best) < MIN_SINE_PERIOD_PX:
        return f"{max(best)} periods over {span_px:g} {axis}s are too many for its pixels"
    if value > _MAX_COST:
        return f"the places of the periods of {axis}s contradict each other, or the projector's extent of {extent}"
    lengths = tuple(span_px / count for count in best)
    shown: dict[int, Sine] = {}
    for period, length_px, sign, begin in zip(periods, lengths, signs.tolist(), begins, strict=True):
        count = len(period.images)
        # A quarter of a period is a step of twice or four times as many.
        finer = next(k for k in (1, 2, 4) if abs(begin * k * count - round(begin * k * count)) < 1e-6)
        for k, image in enumerate(period.images):
            shift = (round(finer * count * begin) + sign * finer * k) % (finer * count)
            shown[image] = Sine(axis, float(length_px), shift, finer * count)
    close = [each for each in found[1:] if each[0] < value + _RIVAL]
    others = dict.fromkeys(tuple(each[1] / count for count in each[2]) for each in close)
    return SinusoidAxis(
        axis, shown, lengths, visible, span_px,
        other_periods_px=tuple(each for each in others if not np.allclose(each, lengths)),
        is_start_unsure=any(each[1:3] == (span_px, best) and each[3] != begins for each in close),
        is_mixed=len(set(signs.tolist())) > 1,
    )  # fmt: skip


def _starts(signs: NDArray[np.int_], steps: NDArray[np.int_]) -> Iterator[tuple[FloatArray, float]]:
    """Yield shifts in turns, (f,), with which the first images of some periods may begin, and how rare they are."""
    for start, rare in ((0.0, 0.0), (0.25, 0.3), (0.75, 0.5), (0.5, 0.4)):
        yield np.full(len(steps), start), rare
    # Programs that count steps from one.
    yield signs / steps % 1, 0.5


def _spans(counts: NDArray[np.int_], extent: int, others_px: Sequence[float]) -> Iterator[tuple[float, float]]:
    """Yield lengths of which periods are whole fractions, for a projector, and what speaks against each.

    others_px : lengths of the other axis.
    """
    least = math.lcm(*counts.tolist())
    is_whole = extent % least == 0
    is_slstudio = sorted(counts.tolist()) == [1, SLSTUDIO_PERIODS]
    yield float(extent), -0.4 if is_slstudio else 0.0 if is_whole else 0.2
    # Periods of whole pixels over a little more than the projector, over a power of two, or over twice as much.
    longer = {2.0 * extent: 0.4, float(-(-extent // least) * least): 0.1 if least > extent / 2 else 0.3}
    power = 1 << (extent - 1).bit_length()
    longer |= {float(power): 0.3} if power % least == 0 else {}
    for span, against in longer.items():
        if span != extent and extent / span >= _MIN_SPAN_USED:
            excess = max(0.0, math.log2(span / extent) - 1)
            yield span, against + 0.1 * is_whole + 0.3 * excess
    # The same periods as along the other axis.
    yield from ((span, 0.1) for span in others_px if span > extent and span not in longer)
    most = int(counts.max())
    for period_px in range(math.ceil(MIN_SINE_PERIOD_PX), _MAX_PERIOD_PX + 1):
        near = most * period_px / np.array(sine_periods_px(extent, period_px))
        if len(near) == len(counts) and np.allclose(np.sort(near), np.sort(counts), atol=1e-6):
            # Others choose squares by the same rule, over the whole projector; few of these fit whole pixels too.
            is_common = math.isqrt(most) ** 2 == most
            yield float(most * period_px), -0.6 if not is_common else 0.1 if extent < 0.2 * most**2 else 0.35


def _find_micro(light: FloatArray, images: Sequence[int], projector: Size) -> SinusoidAxis | None:
    """Return SLStudio's micro phase shift, whose periods have too few steps for a phase of each, if images show it.

    light : (n, k) of images. Each pixel's light must be that of a position.
    """
    try:
        every = slstudio_micro_sequence(ProjectorCode(projector), len(images))
    except BundleError:
        return None
    patterns = [each for each in every if isinstance(each, Sine)]
    shown = light - light.mean(axis=0)
    shown = shown / np.maximum(np.linalg.norm(shown, axis=0), 1e-6)
    places = np.arange(0, projector.width_px, 0.5)
    waves = np.stack([np.cos(2 * np.pi * (places / each.period_px - each.shift / each.steps)) for each in patterns])
    waves -= waves.mean(axis=0)
    fit = (waves / np.linalg.norm(waves, axis=0)).T.astype(np.float32) @ shown
    if float(np.median(fit.max(axis=0))) < _MICRO_FIT:
        return None
    first, last = np.percentile(places[fit.argmax(axis=0)], (1, 99))
    shown_by = dict(zip(images, patterns, strict=True))
    return SinusoidAxis(
        Axis.COLUMN, shown_by, tuple(each.period_px for each in patterns[2:]), (float(first), float(last))
    )

"""Projector position at every pixel from frames of sinusoids, of one period or several, with or without Gray code.

Frame k has the light w(2πx/P_k − θ_k) at the projector position x, w = cos for a linear projector. A pixel shows
I_k = A + B w(2πx/P_k − θ_k). All frames share x. Frames of one period with three or more shifts are a group, with A and
B of its own; a period with fewer shifts takes those of the finest group (micro phase shifting: Gupta and Nayar 2012,
DOI 10.1109/CVPR.2012.6247753). The phase of the finest group leaves positions one period apart. Those that the Gray
code and the other frames contradict least are fitted to all frames, by least squares weighted with the noise, and the
best one counts.

A projector or camera that is not linear bends the light to w(φ) = Σ r_j cos jφ, the series of (½ + ½ cos φ)^γ with
r_1 = 1, whose higher terms a blur reduces (`waveform`). γ is the one for which all frames agree best. What is left
widens the standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, Gray, IntArray, NoiseModel, Refusal, Sine, sine_groups
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode, lit_pixels, unread_code
from slrig.reconstruction.frames import AxisFrames, rows_per_band, sine_weights, stack_rows
from slrig.reconstruction.phase import PositionMap

_SATURATED = int(Refusal.SATURATED)
_AMBIGUOUS_LINE = int(Refusal.AMBIGUOUS_LINE)
_BEYOND_PROJECTOR = int(Refusal.BEYOND_PROJECTOR)

_TURN = 2 * np.pi
_MAX_SIGMA_RAD = 0.5  # of the finest phase: with more, a period may be missed
_MIN_ADVANTAGE = 12.0  # of χ² over the second best position: 0.25 % chose wrong at that limit
_MAX_EXCESS = 30.0  # χ² over twice its degrees of freedom: light of two surfaces, or frames of another scene
_CANDIDATES = 3  # positions that are fitted to all frames
_ITERATIONS = 6
_CONVERGED_RAD = 1e-4  # of a step: the next one would be its square
_MAX_STEP_RAD = 0.6
_EDGE_SHARE = 1 / 32  # of the period: standard deviation of the edges of the code, by blur and light from elsewhere
_REACH = 2  # px either way: neighbours that decide between two positions
_PASSES = 24  # from neighbour to neighbour
_SIGMAS = 3.0  # of the position, which its cells cover

_NODES = 2048  # of a table of one turn: interpolation errs by 1e-6
_TERMS = 15
_FIXED_POINT = 5
_MIN_GAMMA, _MAX_GAMMA = 0.35, 3.5
_GAMMAS = 13
_REFINEMENTS = 6
_MIN_SAMPLES, _MAX_SAMPLES = 200, 6000
_MIN_GAIN = 12.0  # of the sum of χ²
_MIN_NOISE_SHARE = 0.3
_CAP = 25.0  # of χ²: pixels of two surfaces count no more
_COUNTED = 0.9
_MIN_APART_SIGMA = 8.0  # of two positions
_MIN_APART = 1.5  # ratio of periods whose modulations show the blur
_MAX_BLUR = 0.3  # of the finest period


class SineModel(NamedTuple):
    """Frames of sinusoids, n of b groups, as the kernel reads them.

    frequency : (n,) float64, radians per projector px; angle : (n,) float64, θ; group : (n,) int32, whose A and B it
    has, 0 the finest; single : (n,) bool, not of a period with A and B of its own; period_px : (b,) float64; start :
    (b, 3, n) float64, weights of the frames for A, B cos and B sin of each group; light, slope : (n, nodes + 1)
    float64, w and its derivative by the phase.
    """

    frequency: FloatArray
    angle: FloatArray
    group: IntArray
    single: NDArray[np.bool_]
    period_px: FloatArray
    start: FloatArray
    light: FloatArray
    slope: FloatArray


@dataclass(frozen=True, slots=True)
class SinusoidResponse:
    """Relation of light to the values of the pattern.

    gamma : light is the value to this power; NaN if the frames do not determine it. blur_px : standard deviation of the
    blur of both lenses, projector px. misfit : standard deviation of the residuals beyond noise, of B. noise_share :
    variance that it leaves over that of the noise model, where it leaves less than noise; 1 otherwise.
    """

    gamma: float = 1.0
    blur_px: float = 0.0
    misfit: float = 0.0
    noise_share: float = 1.0


def sine_model(patterns: Sequence[Sine], response: SinusoidResponse, /) -> SineModel:
    """Return the model of these frames. At least one period has three shifts."""
    whole = sine_groups(patterns)
    count = len(patterns)
    angle = _TURN * np.array([each.shift / each.steps for each in patterns])
    frequency = _TURN / np.array([each.period_px for each in patterns])
    group, single = np.zeros(count, dtype=np.int32), np.ones(count, dtype=np.bool_)
    start = np.zeros((len(whole), 3, count))
    for index, members in enumerate(whole):
        group[members], single[members] = index, False
        start[index][:, members] = sine_weights([patterns[i] for i in members])
    left = np.exp(-0.5 * (frequency * response.blur_px) ** 2)
    waves = [waveform(response.gamma, each) for each in left]
    # A period without A and B of its own has those of the finest group, at its own blur.
    scale = np.where(single, left / left[whole[0][0]], 1.0)[:, np.newaxis]
    light, slope = (np.stack(each) * scale for each in zip(*waves, strict=True))
    return SineModel(
        frequency, angle, group, single, np.array([patterns[each[0]].period_px for each in whole]), start, light, slope
    )


def finest_period_px(patterns: Sequence[Sine], /) -> float:
    """Period whose phase the positions are candidates of: the finest one with three shifts."""
    return patterns[sine_groups(patterns)[0][0]].period_px


def waveform(gamma: float, left: float, /) -> tuple[FloatArray, FloatArray]:
    """(nodes + 1,) float64 each: w over one turn, and its derivative by the phase.

    left : share of the first harmonic that blur leaves; a Gaussian leaves left^(j²) of the j-th. The series of
    (½ + ½ cos φ)^γ has r_(j+1)/r_j = (γ − j)/(γ + j + 1). NaN as gamma is 1.
    """
    phase = _TURN / _NODES * np.arange(_NODES + 1)
    light, slope = np.zeros_like(phase), np.zeros_like(phase)
    for j, size in _harmonics(gamma, left):
        light += size * np.cos(j * phase)
        slope -= j * size * np.sin(j * phase)
    return light, slope


def _harmonics(gamma: float, left: float) -> list[tuple[int, float]]:
    """Number and size of each harmonic, over the first one."""
    gamma, size, found = 1.0 if np.isnan(gamma) else gamma, 1.0, []
    for j in range(1, _TERMS + 1):
        found.append((j, size * left ** (j * j - 1)))
        size *= (gamma - j) / (gamma + j + 1)
    return found


def mean_light(gamma: float, /) -> tuple[float, float]:
    """Mean and first harmonic of (½ + ½ cos φ)^γ."""
    light = (0.5 + 0.5 * np.cos(_TURN / _NODES * (np.arange(_NODES) + 0.5))) ** gamma
    first = 2 * light * np.cos(_TURN / _NODES * (np.arange(_NODES) + 0.5))
    return float(light.mean()), float(first.mean())


class SinusoidMap(NamedTuple):
    """Result of `locate_sinusoids`.

    measured : position and its standard deviation; code : interval of cells of one projector px that it covers, and the
    causes of refused pixels; response : as it was found; swing : (H, W) float32, B of the finest period.
    """

    measured: PositionMap
    code: CodeMap
    response: SinusoidResponse
    swing: NDArray[np.float32]


class _Intervals(NamedTuple):
    """Interval of positions of each pixel, (H, W) float32 each, projector px: its middle, half of its width, and how
    much further than that positions are tried.
    """

    middle: NDArray[np.float32]
    half: NDArray[np.float32]
    beyond: NDArray[np.float32]


class _Found(NamedTuple):
    """Output of `_locate_kernel`, (H, W) each: position, another one that is not much worse or NaN, standard deviation,
    B and A of the finest period, B of the coarsest, χ², and how much more the second best position has, float32;
    refusal, uint8.
    """

    position: NDArray[np.float32]
    other: NDArray[np.float32]
    sigma: NDArray[np.float32]
    swing: NDArray[np.float32]
    level: NDArray[np.float32]
    coarsest: NDArray[np.float32]
    misfit: NDArray[np.float32]
    advantage: NDArray[np.float32]
    refusal: NDArray[np.uint8]

    @classmethod
    def unknown(cls, refusal: NDArray[np.uint8]) -> _Found:
        """No positions yet."""
        part = np.full((8, *refusal.shape), np.nan, dtype=np.float32)
        return cls._make([*part, refusal.copy()])

    def rows(self, rows: slice) -> _Found:
        """Select rows, as views."""
        return _Found(
            self.position[rows], self.other[rows], self.sigma[rows], self.swing[rows], self.level[rows],
            self.coarsest[rows], self.misfit[rows], self.advantage[rows], self.refusal[rows],
        )  # fmt: skip


def decode_sinusoids(
    frames: AxisFrames, noise: NoiseModel, index_of_word: IntArray, extent_px: int, limits: DecodingLimits, /
) -> SinusoidMap:
    """Read the Gray code, if there is one, and measure the projector position at each pixel.

    index_of_word : as for `decode`; extent_px : of the projector along the axis.
    """
    if len(frames.bits):
        code = decode(frames, noise, index_of_word, code_cell_count(frames.gray, extent_px), limits)
    else:
        code = unread_code(lit_pixels(frames, noise, limits))
    return locate_sinusoids(frames, noise, code, extent_px)


def code_cell_count(gray: Gray, extent_px: int, /) -> int:
    """Number of cells of a code on a projector of this extent."""
    return (extent_px - 1 + gray.offset_px) // gray.cell_px + 1


def locate_sinusoids(frames: AxisFrames, noise: NoiseModel, code: CodeMap, extent_px: int, /) -> SinusoidMap:
    """Measure the projector position at each pixel.

    code : lit pixels, with their interval of cells of the Gray code of `frames` if there is one. extent_px : of the
    projector along the axis.
    """
    intervals = _intervals(frames, code, extent_px)
    response = _estimate_response(frames, noise, code, intervals, extent_px)
    found = _locate(
        frames.sinusoids, frames.sine_patterns, response, noise, intervals, code.refusal, extent_px, frames.clipped_at
    )
    _decide_by_neighbours(found)
    position, sigma = found.position, found.sigma
    doubtful = np.isfinite(found.other)
    found.refusal[doubtful] = _AMBIGUOUS_LINE
    refused = found.refusal != 0
    position[refused], sigma[refused] = np.nan, np.nan
    reach = np.float32(_SIGMAS) * sigma
    lowest, highest = (
        np.where(refused, -1, np.clip(np.rint(np.nan_to_num(each)), 0, extent_px - 1)).astype(np.int32)
        for each in (position - reach, position + reach)
    )
    return SinusoidMap(PositionMap(position, sigma), CodeMap(lowest, highest, found.refusal), response, found.swing)


def _intervals(frames: AxisFrames, code: CodeMap, extent_px: int) -> _Intervals:
    """The whole projector, or the cells that the code leaves of it and half a period either way."""
    shape = code.refusal.shape
    if not len(frames.bits):
        whole = ((extent_px - 1) / 2, extent_px / 2, 0.0)
        return _Intervals(*(np.broadcast_to(np.float32(each), shape) for each in whole))
    cell_px, period_px = frames.gray.cell_px, finest_period_px(frames.sine_patterns)
    middle = np.float32(cell_px / 2) * (code.lowest + code.highest + 1).astype(np.float32)
    middle -= np.float32(frames.gray.offset_px + 0.5)
    # Two cells are those on either side of the edge of a bit in doubt.
    half = np.float32(cell_px / 2) * np.maximum(code.highest - code.lowest, 1).astype(np.float32)
    return _Intervals(middle, half, np.broadcast_to(np.float32(period_px / 2), shape))


def _locate(
    images: Any, patterns: Sequence[Sine], response: SinusoidResponse, noise: NoiseModel, intervals: _Intervals,
    refusal: NDArray[np.uint8], extent_px: int, clipped_at: float,
) -> _Found:  # fmt: skip
    """Fill in all pixels that are not refused."""
    shape, model = refusal.shape, sine_model(patterns, response)
    found = _Found.unknown(refusal)
    edge_px = _EDGE_SHARE * finest_period_px(patterns)
    noise = noise.scale_variance(response.noise_share)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        stack = stack_rows(images, rows)
        _locate_kernel(
            0, last - first, stack, model, _Intervals(*(each[rows] for each in intervals)), float(extent_px), edge_px,
            *_variances(noise.rows(rows), stack), response.misfit**2, np.float32(clipped_at),
            found.rows(rows),
        )  # fmt: skip

    in_bands(band, shape[0], rows_at_most=rows_per_band(images, shape[1]))
    return found


def _variances(noise: NoiseModel, stack: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(rows, W) float32 each: variance of a dark sample, and its growth with the level."""
    shape = stack.shape[1:]
    read, slope = np.float32(noise.read_variance), np.float32(noise.slope)
    if noise.read_share is None or noise.shot_share is None:
        return np.full(shape, read), np.full(shape, slope)
    return read * noise.read_share, slope * noise.shot_share


def _estimate_response(
    frames: AxisFrames, noise: NoiseModel, code: CodeMap, intervals: _Intervals, extent_px: int
) -> SinusoidResponse:
    """Find γ, for which the frames of a sample of pixels agree best, the blur by their modulation, and the misfit.

    A group of three shifts alone agrees with any γ: then its level A has to be the mean of the light between black and
    white. Without these, γ is NaN.
    """
    patterns, clear = frames.sine_patterns, code.refusal == 0
    for image in frames.sinusoids:
        clear &= image < frames.clipped_at
    rows, columns = np.nonzero(clear)
    if len(rows) < _MIN_SAMPLES:
        return SinusoidResponse(gamma=np.nan)
    chosen = slice(None, None, -(-len(rows) // _MAX_SAMPLES))
    rows, columns = rows[chosen], columns[chosen]

    def pick(image: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(image[rows, columns][np.newaxis])

    images = [pick(image) for image in frames.sinusoids]
    white, black = pick(frames.white), pick(frames.black)
    where, refusal = _Intervals(*(pick(each) for each in intervals)), np.zeros(white.shape, dtype=np.uint8)
    if noise.read_share is not None and noise.shot_share is not None:
        noise = replace(noise, read_share=pick(noise.read_share), shot_share=pick(noise.shot_share))
    whole = sine_groups(patterns)
    freedom = len(patterns) - 2 * len(whole) - 1
    if freedom == 0 and not frames.has_reference:
        return SinusoidResponse(gamma=np.nan)
    swing, contrast = _finest_swing(images, patterns), np.maximum(white - black, 1e-3)

    def disagreement(gamma: float) -> tuple[FloatArray, FloatArray, SinusoidResponse]:
        """χ² of each pixel, and χ² per squared share of B."""
        given = noise, where, refusal, extent_px, frames.clipped_at
        if frames.has_reference:
            unblurred = contrast * mean_light(gamma)[1]
        else:
            unblurred = _locate(images, patterns, SinusoidResponse(gamma), *given).coarsest.astype(np.float64)
        share = _median(swing / unblurred)
        response = SinusoidResponse(gamma, _blur_px(share, patterns, gamma, has_reference=frames.has_reference))
        found = _locate(images, patterns, response, *given)
        fitted = found.refusal == 0
        # Positions that the other frames hardly distinguish agree with any γ.
        apart = np.sqrt(found.misfit + found.advantage) + np.sqrt(found.misfit)
        variance = noise.variance(found.level).astype(np.float64)
        squared = found.misfit.astype(np.float64)
        if not freedom:
            mean, _ = mean_light(gamma)
            variance /= 3
            variance += mean**2 * noise.variance(white) + (1 - mean) ** 2 * noise.variance(black)
            squared = (found.level - black - mean * (white - black)) ** 2 / variance
        squared = np.where(apart > _MIN_APART_SIGMA, squared, np.nan)
        return np.where(fitted, squared, np.inf)[0], (found.swing**2 / variance)[0], response

    def cost(gamma: float) -> float:
        squared, _, _ = disagreement(gamma)
        return float(
            np.minimum(np.nan_to_num(squared, nan=max(freedom, 1), posinf=np.inf), _CAP * max(freedom, 1)).sum()
        )

    gammas = np.geomspace(_MIN_GAMMA, _MAX_GAMMA, _GAMMAS)
    costs = [cost(each) for each in gammas]
    at = int(np.clip(np.argmin(costs), 1, _GAMMAS - 2))
    low, best, high = np.log(gammas[at - 1 : at + 2])
    least = costs[at]
    for _ in range(_REFINEMENTS):
        inner = [(low + best) / 2, best, (best + high) / 2]
        values = [cost(float(np.exp(inner[0]))), least, cost(float(np.exp(inner[2])))]
        middle = int(np.argmin(values))
        spread = (high - low) / 4
        best, least = inner[middle], values[middle]
        low, high = best - spread, best + spread
    gamma = float(np.exp(best)) if cost(1.0) - least > _MIN_GAIN else 1.0
    squared, per_share, response = disagreement(gamma)
    if np.count_nonzero(np.isfinite(squared)) < _MIN_SAMPLES:
        return SinusoidResponse(gamma=np.nan)
    misfit, noise_share = _misfit(squared, per_share, max(freedom, 1))
    # White and black have noise of their own, and do not measure that of the sinusoids.
    return replace(response, misfit=misfit, noise_share=noise_share if freedom else 1.0)


def _misfit(squared: FloatArray, per_share: FloatArray, freedom: int) -> tuple[float, float]:
    """Share of B which, added to the noise, explains χ²; and the share of the noise that does, if that is less than 1.

    Compared is the mean of the lesser nine tenths of χ², since the median of sums of whole numbers is coarse.
    """
    # A quarter of a second to load, and only sinusoids need it.
    from scipy.special import gammainc, gammaincinv

    usable = np.isfinite(squared) & np.isfinite(per_share)
    squared, per_share = squared[usable], per_share[usable]
    limit = float(gammaincinv(freedom / 2, _COUNTED))
    expected = freedom * float(gammainc(freedom / 2 + 1, limit)) / _COUNTED

    def mean_of_lesser(values: FloatArray) -> float:
        count = int(_COUNTED * len(values))
        return float(np.partition(values, count)[:count].mean())

    low, high, least = 0.0, 1.0, mean_of_lesser(squared)
    if least <= expected:
        return 0.0, max(least / expected, _MIN_NOISE_SHARE)
    for _ in range(30):
        share = (low + high) / 2
        low, high = (share, high) if mean_of_lesser(squared / (1 + share**2 * per_share)) > expected else (low, share)
    return high, 1.0


def _finest_swing(images: Sequence[NDArray[Any]], patterns: Sequence[Sine]) -> FloatArray:
    """First harmonic of the frames of the finest period."""
    model, stack = sine_model(patterns, SinusoidResponse()), np.array(images, dtype=np.float64)
    return np.asarray(np.hypot(*np.einsum("ck,kyx->cyx", model.start[0, 1:], stack)))


def _median(values: FloatArray) -> float:
    """Median of the finite values; 1 without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 1.0


def _blur_px(share: float, patterns: Sequence[Sine], gamma: float, *, has_reference: bool) -> float:
    """Standard deviation of the blur that leaves the finest period this share of its modulation without blur, by white
    and black or else by the coarsest period; 0 if neither shows it.
    """
    whole = sine_groups(patterns)
    finest, coarsest = (patterns[members[0]].period_px for members in (whole[0], whole[-1]))
    squared = (_TURN / finest) ** 2
    if not has_reference:
        if coarsest < _MIN_APART * finest:
            return 0.0
        squared -= (_TURN / coarsest) ** 2
    left = 1.0
    for _ in range(_FIXED_POINT):
        left = min(share / _aliased([patterns[i] for i in whole[0]], gamma, left), 1.0)
    return float(min(np.sqrt(-2 * np.log(max(left, 1e-3)) / squared), _MAX_BLUR * finest))


def _aliased(patterns: Sequence[Sine], gamma: float, left: float) -> float:
    """Median modulation over that of the first harmonic: n even steps take harmonics kn ± 1 for the first."""
    steps = len(patterns)
    if steps != patterns[0].steps:
        return 1.0
    return float(np.sqrt(sum(size**2 for j, size in _harmonics(gamma, left) if j % steps in (1, steps - 1))))


@kernel(in_every_scan=False)
def _locate_kernel(
    first: int, last: int, images: Any, model: Any, intervals: Any, extent: float, edge: float, read: Any, slope: Any,
    misfit: float, clipped_at: float, found: Any,
) -> None:  # fmt: skip
    count, _, columns = images.shape
    blocks = len(model.start)
    period = model.period_px[0]
    is_joint = blocks > 1 or model.single.any()
    freedom = count - 2 * blocks - 1
    values = np.zeros(count)
    sums, best, trial = np.zeros((blocks, 7)), np.zeros((blocks, 2)), np.zeros((blocks, 2))
    own, information = np.zeros(blocks), np.zeros(blocks)
    candidates = np.zeros((_CANDIDATES, 2))
    for y in range(first, last):
        for x in range(columns):
            if found.refusal[y, x] != 0:
                continue
            brightest = np.float32(0.0)
            for k in range(count):
                values[k] = images[k, y, x]
                brightest = max(brightest, images[k, y, x])
            if brightest >= clipped_at:
                found.refusal[y, x] = _SATURATED
                continue
            found.refusal[y, x] = _AMBIGUOUS_LINE
            dark, growth = float(read[y, x]), float(slope[y, x])
            misfit_0 = 0.0
            for b in range(blocks):
                own[b], information[b], misfit_b = _fit_group(values, model, b, best, dark, growth, misfit, sums)
                if b == 0:
                    misfit_0 = misfit_b
            if not information[0] > (_TURN / period / _MAX_SIGMA_RAD) ** 2:
                continue
            middle, half = float(intervals.middle[y, x]), float(intervals.half[y, x])
            reach = half + float(intervals.beyond[y, x])
            low, high = max(middle - reach, -0.5), min(middle + reach, extent - 0.5)
            position = own[0] + period * np.ceil((low - own[0]) / period)
            if position > high:
                found.refusal[y, x] = _BEYOND_PROJECTOR
                continue
            candidates[:, 0], candidates[:, 1] = np.nan, np.inf
            while position <= high:
                cost = _contradiction(position, values, model, own, information, best, dark, growth, misfit)
                cost += (max(abs(position - middle) - half, 0.0) / edge) ** 2
                _insert(candidates, position, cost)
                position += period
            least, second = np.inf, np.inf
            chosen = other = np.nan
            known, left = information[0], misfit_0
            for c in range(_CANDIDATES):
                if not candidates[c, 1] < np.inf:
                    break
                here, cost = candidates[c, 0], candidates[c, 1]
                certain, unlike = information[0], misfit_0
                if is_joint:
                    trial[:] = best
                    at, certain, unlike = _fit(values, model, -1, here, trial, dark, growth, misfit, sums)
                    if abs(at - here) > 0.5 * period:
                        continue
                    here = at
                    cost = unlike + (max(abs(here - middle) - half, 0.0) / edge) ** 2
                if cost < least:
                    second, other = least, chosen
                    least, chosen, known, left = cost, here, certain, unlike
                elif cost < second:
                    second, other = cost, here
            if np.isnan(chosen) or not known > 0 or left > _MAX_EXCESS + 2 * freedom:
                continue
            found.position[y, x] = chosen
            if second - least < _MIN_ADVANTAGE:
                found.other[y, x] = other
            found.sigma[y, x] = 1 / np.sqrt(known)
            found.level[y, x], found.swing[y, x] = best[0, 0], best[0, 1]
            found.coarsest[y, x] = best[blocks - 1, 1]
            found.misfit[y, x], found.advantage[y, x] = left, second - least
            found.refusal[y, x] = 0


@kernel_part
def _insert(candidates: Any, position: float, cost: float) -> None:
    """Keep the positions of least cost, in order."""
    for c in range(len(candidates)):
        if cost < candidates[c, 1]:
            for later in range(len(candidates) - 1, c, -1):
                candidates[later] = candidates[later - 1]
            candidates[c, 0], candidates[c, 1] = position, cost
            return


@kernel_part(borrows=True)
def _fit_group(
    values: Any, model: Any, group: int, levels: Any, dark: float, growth: float, misfit: float, sums: Any
) -> Any:
    """Fit A, B and the position within a period to the frames of one group. Returns as `_fit`."""
    level = cosine = sine = 0.0
    for k in range(len(values)):
        level += model.start[group, 0, k] * values[k]
        cosine += model.start[group, 1, k] * values[k]
        sine += model.start[group, 2, k] * values[k]
    levels[group, 0], levels[group, 1] = level, max(np.sqrt(cosine * cosine + sine * sine), 1e-3)
    start = np.arctan2(sine, cosine) / _TURN * model.period_px[group]
    return _fit(values, model, group, start, levels, dark, growth, misfit, sums)


@kernel_part(borrows=True)
def _fit(
    values: Any, model: Any, only: int, position: float, levels: Any, dark: float, growth: float, misfit: float,
    sums: Any,
) -> Any:  # fmt: skip
    """Weighted least squares of A and B of each group, and of the position that all frames share (Gauss-Newton).

    only : the group to fit by its own frames; -1 for all frames. levels : (groups, 2), A and B, updated. Returns the
    position, the inverse of its variance, 0 if it is not determined, and χ².
    """
    is_last = False
    for turn in range(_ITERATIONS + 1):
        sums[:] = 0
        information = step = unlike = fastest = 0.0
        for k in range(len(values)):
            b = model.group[k]
            if only >= 0 and (b != only or model.single[k]):
                continue
            frequency = model.frequency[k]
            fastest = max(fastest, frequency)
            light, slope = _light(model, k, position)
            mean = levels[b, 0] + levels[b, 1] * light
            weight = 1 / (dark + growth * max(mean, 0.0) + misfit * levels[b, 1] * levels[b, 1])
            residual, moved = values[k] - mean, levels[b, 1] * slope * frequency
            sums[b, 0] += weight
            sums[b, 1] += weight * light
            sums[b, 2] += weight * light * light
            sums[b, 3] += weight * moved
            sums[b, 4] += weight * moved * light
            sums[b, 5] += weight * residual
            sums[b, 6] += weight * residual * light
            information += weight * moved * moved
            step += weight * moved * residual
            unlike += weight * residual * residual
        for b in range(len(sums)):
            if only >= 0 and b != only:
                continue
            s, t, u = sums[b, 0], sums[b, 1], sums[b, 2]
            determinant = s * u - t * t
            if not determinant > 1e-9 * s * u:
                return position, 0.0, unlike
            first = (sums[b, 3] * u - sums[b, 4] * t) / determinant
            second = (sums[b, 4] * s - sums[b, 3] * t) / determinant
            information -= first * sums[b, 3] + second * sums[b, 4]
            step -= first * sums[b, 5] + second * sums[b, 6]
        if not information > 0:
            return position, 0.0, unlike
        if is_last or turn == _ITERATIONS:
            break
        step = min(max(step / information, -_MAX_STEP_RAD / fastest), _MAX_STEP_RAD / fastest)
        position += step
        for b in range(len(sums)):
            if only >= 0 and b != only:
                continue
            s, t, u = sums[b, 0], sums[b, 1], sums[b, 2]
            determinant = s * u - t * t
            first, second = sums[b, 5] - step * sums[b, 3], sums[b, 6] - step * sums[b, 4]
            levels[b, 0] += (first * u - second * t) / determinant
            levels[b, 1] = max(levels[b, 1] + (second * s - first * t) / determinant, 1e-3)
        is_last = abs(step) * fastest < _CONVERGED_RAD
    return position, information, unlike


@kernel_part(borrows=True)
def _light(model: Any, k: int, position: float) -> Any:
    """W of a frame at a position, and its derivative by the phase, between nodes of their tables."""
    turns = (model.frequency[k] * position - model.angle[k]) / _TURN
    node = (turns - np.floor(turns)) * _NODES
    at = min(int(node), _NODES - 1)
    share = node - at
    light = model.light[k, at] + share * (model.light[k, at + 1] - model.light[k, at])
    return light, model.slope[k, at] + share * (model.slope[k, at + 1] - model.slope[k, at])


@kernel_part(borrows=True)
def _contradiction(
    position: float, values: Any, model: Any, own: Any, information: Any, levels: Any, dark: float, growth: float,
    misfit: float,
) -> float:  # fmt: skip
    """Distance of the other groups and single frames from a position, in variances, to the first order of errors."""
    cost = 0.0
    for b in range(1, len(own)):
        apart = position - own[b]
        apart -= model.period_px[b] * np.rint(apart / model.period_px[b])
        cost += apart * apart / (1 / max(information[b], 1e-12) + 1 / information[0])
    for k in range(len(values)):
        if model.single[k]:
            light, slope = _light(model, k, position)
            swing = levels[0, 1]
            mean = levels[0, 0] + swing * light
            of_sample = dark + growth * max(mean, 0.0) + misfit * swing * swing
            moved = swing * slope * model.frequency[k]
            # A, and B times light, are known about as well as a sample.
            variance = of_sample * (1 + (1 + 2 * light * light) / 3) + moved * moved / information[0]
            cost += (values[k] - mean) ** 2 / variance
    return cost


def _decide_by_neighbours(found: _Found) -> None:
    """Of two positions about as good, choose the one that continues nearby pixels with a single one."""
    doubtful = np.isfinite(found.other)
    for _ in range(_PASSES):
        if not doubtful.any():
            return
        position, other = found.position.copy(), found.other.copy()
        in_bands(_neighbour_kernel, len(position), found.position, found.other, position, other)
        found.position[:], found.other[:] = position, other
        before, doubtful = np.count_nonzero(doubtful), np.isfinite(other)
        if np.count_nonzero(doubtful) == before:
            return


@kernel(in_every_scan=False)
def _neighbour_kernel(first: int, last: int, position: Any, other: Any, out: Any, out_other: Any) -> None:
    rows, columns = position.shape
    for y in range(first, last):
        for x in range(columns):
            if np.isnan(other[y, x]):
                continue
            here, there = position[y, x], other[y, x]
            near = 0.25 * abs(here - there)
            for_here = for_there = 0
            for v in range(max(y - _REACH, 0), min(y + _REACH + 1, rows)):
                for u in range(max(x - _REACH, 0), min(x + _REACH + 1, columns)):
                    if np.isnan(position[v, u]) or not np.isnan(other[v, u]):
                        continue
                    if abs(position[v, u] - here) < near:
                        for_here += 1
                    elif abs(position[v, u] - there) < near:
                        for_there += 1
            if (for_here > 0) != (for_there > 0):
                out[y, x] = here if for_here else there
                out_other[y, x] = np.nan

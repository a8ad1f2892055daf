"""Frames of shifted sinusoids against one position per pixel: pure functions of sampled frames.

At a pixel that sees the projector's position x, frame k of one axis has the light level + swing · m_k(x): level and
swing are those of the pixel, m_k, 0 to 1, is the light of pattern k after a gamma and with the contrast that blur
leaves its period. White, black and the bits of the axis follow it as well. K frames are K − 3 more equations than
unknowns at each pixel, so that a frame which shows another pattern, or is damaged, does not fit the others.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations

import numpy as np

from slrig.capture.frame_checks import BANDS, NEAR_SATURATION, SampleMask, Samples
from slrig.capture.frame_light import MAX_LIGHT_FACTOR, STEADY_LIGHT, FrameLight
from slrig.model import Axis, Black, FloatArray, Gray, Integers, Pattern, Sine, White, to_gray

Light = Samples
"""(K, n) or (K, positions) float32: light of K frames."""

MIN_SPARE_FRAMES = 2
"""Frames over the three unknowns of a pixel, to find that one does not fit."""

_STEPS_PER_PERIOD = 24  # of the position, in the shortest period
_MAX_EXTENT_PX = 4096.0
_SAME_PHASE = 0.02  # periods
_MIN_PIXELS, _MAX_PAIRS = 200, 800
_GAMMA_PIXELS, _SEARCH_PAIRS, _ORDER_PAIRS = 80, 150, 60
_MIN_LIT_FRACTION = 0.15  # of the 99th percentile of the range
_GAMMAS = (1.0, 0.5, 0.7, 1.3, 1.6, 1.9, 2.2, 2.5)
_EDGE_PX = 3.0
_FIT_STEPS = 2
_LIKE_PERIODS = 2.0  # ratio of two that blur dims alike
_GAINS = (0.05, 1.5)  # of the contrast of a period
_BLOCK = 512  # pixels
_MAX_MISFIT, _MAX_MISFIT_SIGMAS = 0.04, 1.2  # of the swing; of the noise
_MAX_FRAME_MISFIT = 1.5  # times the limit, of one frame
_MAX_WRONG = 3  # frames; more are no fault of single ones
_MIN_TRIED = 3  # sets of frames that are enlarged
_LEFT_FRACTION, _MAX_LEFT_FRACTION = 0.15, 0.3  # of the mean square, without the frames that are wrong
_CLEARLY_OFF, _MAX_LEFT_IN_SCENE = 4.0, 0.6
_MAX_FIRST_FRACTION = 0.75  # the same, without one of several that are wrong
_MAX_PROVING_JUMPS, _MANY_JUMPS = 0.1, 0.3  # the same
_LEFT_JUMPS = 0.25  # of those before
_MIN_JUMPS = 0.02  # of the adjacent pixels
_LIGHT_STEPS, _MIN_FITTED_CHANGE = 5, 0.06
_BRIGHT = 0.5  # of the most light of a frame, where its factor is measured
_MIN_LIT_DEVIATION = 0.12  # of the light of a frame, to tell a factor from a shift
_DOUBTFUL_MISFIT = 2.0  # times the limit, to suspect frames of which none is proven wrong
_MAX_PROVING_MISFIT, _MAX_MISFIT_OF_A_SCENE = 0.12, 0.2
_MIN_DEVIATION = 0.05  # of the light of a frame that proves something
_MIN_OPPOSITE_SIGMAS = 6.0
MIN_SHIFTS = 3
_MIN_AHEAD = 2.5  # of the mean square, to the next set of as many frames
_MIN_OFF = 0.3  # of the deviation of the light of a pattern, by which a wrong frame is off
_SHOWN_FRACTION = 0.4  # of the mean square, of the pattern that a frame shows instead of its own


@dataclass(frozen=True, slots=True)
class FrameFit:
    """Fit of K frames at n pixels. rest : (K, n) float32, what does not fit, over the pixel's swing; gamma : of the
    light. noise : standard deviation of the frames, over the swing. used : (K,) bool, the frames that were fitted.
    shape : (K, n) light of the patterns at the positions that were found. level, swing : (n,) of the pixels. jumps :
    fraction of the adjacent pixels whose positions are more than half of the shortest period apart.
    """

    rest: Light
    shape: Light
    gamma: float
    noise: float
    used: SampleMask
    level: Samples
    swing: Samples
    jumps: float

    def off(self, place: int) -> float:
        """Return the root mean square of what does not fit of a frame."""
        return float(np.sqrt(np.mean(self.rest[place] ** 2)))

    @property
    def limit(self) -> float:
        """Root mean square of what does not fit of right frames in any but a difficult scene."""
        return float(np.hypot(_MAX_MISFIT, _MAX_MISFIT_SIGMAS * self.noise))

    def misfit(self, where: SampleMask) -> float:
        """Return the mean square of what does not fit, of the frames that were fitted, for each equation to spare."""
        rest = self.rest[self.used][:, where]
        return float(np.mean(rest**2) * len(rest) / max(len(rest) - 3, 1))


@dataclass(frozen=True, slots=True)
class FrameAgreement:
    """Whether the K frames of one axis fit one position per pixel.

    fitting : (K,) bool, frames that a test has passed which other patterns would fail. wrong : places of frames without
    which the others fit; suspects : places of frames of which some are wrong, if it is not known which. where : (n,)
    bool, the pixels concerned. shows : by place, the place of the pattern that a wrong frame shows there. opposite :
    the suspects come in the opposite order. lights : of the K frames, if they agree only after these are undone.
    """

    fitting: SampleMask
    where: SampleMask
    wrong: tuple[int, ...] = ()
    suspects: tuple[int, ...] = ()
    shows: Mapping[int, int] = field(default_factory=dict)
    opposite: bool = False
    lights: tuple[FrameLight, ...] = ()


def check_agreement(frames: Light, model: LightModel, band: Integers) -> FrameAgreement:
    """Find the frames that do not fit the others.

    A scene that does not follow the model, as with light that comes a second way, leaves much with any frames left out;
    it is no contradiction, and proves no frame. frames : (K, n) float32 of one axis, the second half of the pixels
    neighbours of the first. band : (n,) index of the band of rows.
    """
    fit, count = fit_frames(frames, model), len(frames)
    everywhere = np.ones(frames.shape[1], dtype=np.bool_)
    none = np.zeros(count, dtype=np.bool_)
    opposite = opposite_groups(frames, model)
    if opposite:
        return FrameAgreement(none, everywhere, suspects=opposite, opposite=True)
    exchanged = _find_exchange(frames, model) if fit.jumps > _MANY_JUMPS else ()
    if exchanged:
        return FrameAgreement(none, everywhere, exchanged, shows=dict(zip(exchanged, exchanged[::-1], strict=True)))
    limit = fit.limit
    misfits = np.array([fit.misfit(band == each) if np.any(band == each) else 0.0 for each in range(BANDS)])
    where = np.isin(band, np.flatnonzero(misfits > limit**2))
    if np.sqrt(np.mean(fit.rest**2, axis=1)).max() > _MAX_FRAME_MISFIT * limit and not where.any():
        where = everywhere
    is_changed = np.abs(_factors(frames, model, fit, is_exposure=False) - 1) > _MIN_FITTED_CHANGE
    if where.any() or is_changed.any():
        lights = _find_lights(frames, model, fit, band)
        if lights:
            return FrameAgreement(
                model.provable() & (fit.shape.std(axis=1) > _MIN_DEVIATION), everywhere, lights=lights
            )
    if where.any():
        found = _find_wrong(frames[:, where], model, fit.misfit(where), limit)
        if found is not None:
            wrong, suspects, shows = found
            right = model.provable() if wrong else none
            right[list(wrong)] = False
            return FrameAgreement(right, where, wrong, suspects, shows)
    if fit.misfit(everywhere) > (_MAX_MISFIT_OF_A_SCENE + _MAX_MISFIT_SIGMAS * fit.noise) ** 2:
        sines = tuple(place for places in model.groups for place in places)
        return FrameAgreement(none, everywhere, suspects=tuple(sorted(sines)))
    if fit.jumps > _MAX_PROVING_JUMPS or misfits.max() > (_MAX_PROVING_MISFIT + _MAX_MISFIT_SIGMAS * fit.noise) ** 2:
        return FrameAgreement(none, everywhere)
    return FrameAgreement(model.provable() & (fit.shape.std(axis=1) > _MIN_DEVIATION), everywhere)


def _find_exchange(frames: Light, model: LightModel) -> tuple[int, ...]:
    """Return the two frames of a period that make the position continuous if they are exchanged back; empty if none do.

    Few frames fit some position in any order, which then jumps from pixel to pixel.
    """
    few = _some_pairs(frames, _SEARCH_PAIRS)
    before, everywhere = fit_frames(few, model), np.ones(few.shape[1], dtype=np.bool_)
    found: list[tuple[float, tuple[int, ...]]] = []
    for one, other in (pair for group in model.groups for pair in combinations(group, 2)):
        order = np.arange(len(few))
        order[[one, other]] = other, one
        fit = fit_frames(few[order], model)
        if fit.misfit(everywhere) < max(fit.limit**2, before.misfit(everywhere)):
            found.append((fit.jumps, (one, other)))
    found.sort()
    if not found or found[0][0] > _LEFT_JUMPS * before.jumps:
        return ()
    is_only = len(found) == 1 or found[1][0] > found[0][0] + _LEFT_JUMPS * before.jumps
    return found[0][1] if is_only else ()


def _find_lights(frames: Light, model: LightModel, fit: FrameFit, band: Integers) -> tuple[FrameLight, ...]:
    """Return the light of each frame with which all of them fit; empty if no factors of single frames explain it.

    A frame whose light hardly varies over the pixels would fit with a factor where it shows another shift.
    """
    best, found = _MAX_LEFT_FRACTION * fit.misfit(np.ones(frames.shape[1], dtype=np.bool_)), tuple[FrameLight, ...]()
    is_sine = np.array([isinstance(pattern, Sine) for pattern in model.patterns])
    for is_exposure in (False, True):
        again = fit
        for _ in range(_LIGHT_STEPS):
            factors = _factors(frames, model, again, is_exposure=is_exposure)
            base = np.float32(0) if is_exposure else again.level
            if not np.all((factors > 1 / MAX_LIGHT_FACTOR) & (factors < MAX_LIGHT_FACTOR)):
                break
            again = fit_frames(base + (frames - base) / factors[:, np.newaxis], model)
        limit = again.limit
        after = max(again.misfit(band == each) for each in np.unique(band))
        doubtful = is_sine & (np.abs(factors - 1) > STEADY_LIGHT) & (again.shape.std(axis=1) < _MIN_LIT_DEVIATION)
        if after < min(limit**2, best) and not doubtful.any():
            best, found = after, tuple(FrameLight(float(each), is_exposure) for each in factors)
    return found


def _factors(frames: Light, model: LightModel, fit: FrameFit, *, is_exposure: bool) -> Samples:
    """(K,) float32: light of each frame relative to white, or to the median without white, where it is bright."""
    base = np.float32(0) if is_exposure else fit.level
    predicted = np.maximum(fit.level + fit.swing * fit.shape - base, 1e-3)
    most = fit.shape.max(axis=1, keepdims=True)
    ratio = np.where(fit.shape >= _BRIGHT * most, (frames - base) / predicted, np.nan)
    # A frame that is dark wherever the camera looks has no measurable factor.
    ratio[most[:, 0] < _MIN_DEVIATION] = 1
    factors = np.nanmedian(ratio, axis=1)
    white = [place for place, pattern in enumerate(model.patterns) if isinstance(pattern, White)]
    factors /= factors[white[0]] if white else np.median(factors)
    factors[[isinstance(pattern, Black) for pattern in model.patterns]] = 1
    return factors.astype(np.float32)


def _find_wrong(
    frames: Light, model: LightModel, before: float, limit: float
) -> tuple[tuple[int, ...], tuple[int, ...], dict[int, int]] | None:
    """Return the frames without which the others fit, and what they show; or those of which some must be wrong."""
    frames = _some_pairs(frames, _SEARCH_PAIRS)
    count, everywhere = len(frames), np.ones(frames.shape[1], dtype=np.bool_)
    tried: list[tuple[float, tuple[int, ...], FrameFit]] = []
    standing: tuple[tuple[int, ...], tuple[int, ...], dict[int, int]] | None = None
    for _ in range(min(_MAX_WRONG, count - 3 - MIN_SPARE_FRAMES)):
        larger: dict[tuple[int, ...], tuple[float, FrameFit]] = {}
        for places in [places for _, places, _ in tried[:_MIN_TRIED]] or [()]:
            for place in range(count):
                without = tuple(sorted({*places, place}))
                whole = any(len(group) > 1 and set(group) <= set(without) for group in model.groups)
                if place not in places and without not in larger and not whole:
                    again = fit_frames(frames, model, without=without)
                    larger[without] = (again.misfit(everywhere), again)
        tried = sorted(((left, places, again) for places, (left, again) in larger.items()), key=lambda each: each[0])
        left, places, fit = tried[0]
        if left > _MAX_FIRST_FRACTION * before:
            break
        fits = left < min(max(_LEFT_FRACTION * before, limit**2), _MAX_LEFT_FRACTION * before)
        # Where the scene leaves much, a sinusoid may stand out; without a bit, another position fits.
        clear, sines = _CLEARLY_OFF * max(left**0.5, limit), {place for group in model.groups for place in group}
        stands_out = left < _MAX_LEFT_IN_SCENE * before and sines.issuperset(places)
        stands_out = stands_out and all(fit.off(place) > clear for place in places)
        if stands_out and not fits and standing is None and len(tried) > 1 and tried[1][0] > _MIN_AHEAD * left:
            standing = (places, (), _shown(fit, places))
        if not fits or not all(_is_off(fit, place) for place in places):
            continue
        close = [each for each in tried if each[0] < _MIN_AHEAD * left]
        # Of several that fit, the position is continuous without those that are wrong.
        close.sort(key=lambda each: each[2].jumps)
        _, places, fit = close[0]
        ahead = len(close) == 1 or close[1][2].jumps > fit.jumps + _MIN_JUMPS
        if ahead and all(_is_off(fit, place) for place in places):
            return places, (), _shown(fit, places)
        suspects = sorted({place for _, each, _ in close for place in each})
        # Without any of several bits, another position fits.
        if all(place in model.reach for place in suspects) or before > (_DOUBTFUL_MISFIT * limit) ** 2:
            return (), tuple(suspects), {}
    return standing


def opposite_groups(frames: Light, model: LightModel) -> tuple[int, ...]:
    """Return the places of sinusoids whose phase falls where that of others rises, from pixel to adjacent pixel; of
    all, if there are two and neither is confirmed. Empty if there are none.
    """
    steps: dict[tuple[int, ...], Samples] = {}
    for places in model.groups:
        sines = [(each, model.patterns[each]) for each in places]
        shifts = {pattern.shift: each for each, pattern in sines if isinstance(pattern, Sine)}
        first = model.patterns[places[0]]
        if not isinstance(first, Sine) or len(shifts) < max(first.steps, MIN_SHIFTS):
            continue
        turns = np.exp(2j * np.pi / first.steps * np.arange(first.steps))
        wave = turns @ frames[[shifts[k] for k in range(first.steps)]]
        one, other = np.conj(wave.reshape(2, -1))
        step_px = np.angle(other * np.conj(one)) * first.period_px / (2 * np.pi)
        step_px[np.abs(step_px) > first.period_px / 3] = np.nan
        steps[places] = step_px.astype(np.float32)
    pairs = [(a, b) for a in steps for b in steps if a < b and _are_opposite(steps[a], steps[b])]
    if not pairs:
        return ()
    against = {each: sum(each in pair for pair in pairs) for each in steps}
    most = max(against.values())
    blamed = [each for each, count in against.items() if count == most]
    return tuple(sorted(place for places in blamed for place in places))


def _are_opposite(one: Samples, other: Samples) -> bool:
    product = (one * other)[np.isfinite(one * other)]
    if len(product) < _MIN_PIXELS // 2:
        return False
    return bool(product.mean() < -_MIN_OPPOSITE_SIGMAS * product.std() / len(product) ** 0.5)


def order_misfit(frames: Light, model: LightModel) -> tuple[float, float]:
    """Return the mean square of what does not fit, and its limit for frames in the right order."""
    fit = fit_frames(_some_pairs(frames, _ORDER_PAIRS), model)
    limit = fit.limit
    return fit.misfit(np.ones(fit.rest.shape[1], dtype=np.bool_)), limit**2


def _some_pairs(frames: Light, count: int) -> Light:
    """Return at most `count` pairs of adjacent pixels."""
    half = frames.shape[1] // 2
    some = np.arange(half)[:: -(-half // count)]
    return frames[:, np.concatenate([some, some + half])]


def _is_off(fit: FrameFit, place: int) -> bool:
    """True if a frame differs from what the others predict by more than noise and blur explain."""
    return fit.off(place) > _MIN_OFF * float(fit.shape[place].std()) + 2 * fit.noise


def _shown(fit: FrameFit, places: Sequence[int]) -> dict[int, int]:
    """Return the pattern that each of these frames shows, if that is one of the others."""
    shows: dict[int, int] = {}
    for place in places:
        light = fit.rest[place] + fit.shape[place]
        misfits = np.mean((light - fit.shape) ** 2, axis=1)
        nearest = int(np.argmin(misfits))
        if nearest != place and misfits[nearest] < _SHOWN_FRACTION * misfits[place]:
            shows[place] = nearest
    return shows


def fitted_patterns(patterns: Sequence[Pattern], axis: Axis) -> list[int]:
    """Return the places of the patterns whose frames follow the position along an axis, each pattern once."""
    places = {
        pattern: place
        for place, pattern in reversed(list(enumerate(patterns)))
        if isinstance(pattern, White | Black) or (isinstance(pattern, Gray | Sine) and pattern.axis is axis)
    }
    return sorted(places.values())


def choose_pixels(frames: Light, patterns: Sequence[Pattern], *, full_scale: int) -> Integers | None:
    """Return the indices of at most 2 x 800 pixels to fit; None if fewer than 200 are lit and not saturated.

    frames : (K, n), the second half of the pixels are neighbours of the first, as they are in the result.
    """
    ordered = np.sort(frames, axis=0)
    # A single frame may be damaged.
    span = ordered[-2] - ordered[1]
    lit = span >= max(2.0, _MIN_LIT_FRACTION * float(np.percentile(span, 99)))
    clipped = frames >= NEAR_SATURATION * full_scale
    white = [place for place, pattern in enumerate(patterns) if isinstance(pattern, White)]
    usable = lit & (np.count_nonzero(clipped, axis=0) < 2) & ~clipped[white].any(axis=0)
    both = usable.reshape(2, -1).all(axis=0)
    if np.count_nonzero(both) < _MIN_PIXELS // 2:
        return None
    first = np.flatnonzero(both)
    first = first[:: -(-len(first) // _MAX_PAIRS)]
    return np.concatenate([first, first + len(both)])


@dataclass(frozen=True, slots=True)
class LightModel:
    """Light of K patterns of one axis at the positions among which their frames decide.

    by_gamma : (K, positions) float32, by gamma. groups : places of the sinusoids of each period; equally_blurred :
    those that have one contrast, as blur leaves it. reach : by place of a bit, over how many positions an edge of it
    may be blurred.
    """

    patterns: tuple[Pattern, ...]
    by_gamma: Mapping[float, Light]
    groups: tuple[tuple[int, ...], ...]
    equally_blurred: tuple[tuple[int, ...], ...]
    reach: Mapping[int, int]

    def provable(self) -> SampleMask:
        """(K,) bool: frames for which another pattern would not fit. Sinusoids of one period alone fit in any order,
        and bits of wide cells with any position.
        """
        coded = [each for each in self.patterns if isinstance(each, Gray)]
        shortest_px = min(each.period_px for each in self.patterns if isinstance(each, Sine))
        bits = bool(coded) and 2 * coded[0].cell_px <= shortest_px
        sines = len(self.groups) > 1 or bool(coded)
        return np.array([(isinstance(p, Sine) and sines) or (isinstance(p, Gray) and bits) for p in self.patterns])

    @classmethod
    @lru_cache(maxsize=32)
    def from_patterns(cls, patterns: tuple[Pattern, ...], extent_px: int | None = None) -> LightModel:
        """Return the model of white, black, bits and at least one sinusoid. extent_px : of the projector, if known."""
        position_px = _positions_px(patterns, extent_px)
        step_px = position_px[1] - position_px[0]
        lights = {each: np.stack([_light(p, position_px, each) for p in patterns]) for each in _GAMMAS}
        periods = {p.period_px: None for p in patterns if isinstance(p, Sine)}
        groups = [
            [i for i, p in enumerate(patterns) if isinstance(p, Sine) and p.period_px == each] for each in periods
        ]
        reach = {
            i: max(1, round(min(_EDGE_PX, p.cell_px / 4) / step_px))
            for i, p in enumerate(patterns)
            if isinstance(p, Gray)
        }
        return cls(
            tuple(patterns),
            {each: light.astype(np.float32) for each, light in lights.items()},
            tuple(map(tuple, groups)),
            _equally_blurred(list(periods), groups),
            reach,
        )


def _equally_blurred(periods: Sequence[float], groups: Sequence[Sequence[int]]) -> tuple[tuple[int, ...], ...]:
    """Join each period of few frames, whose contrast and light are not told apart, with the nearest one of more."""
    shared = {period: list(group) for period, group in zip(periods, groups, strict=True) if len(group) >= MIN_SHIFTS}
    alone: list[tuple[int, ...]] = []
    for period, group in zip(periods, groups, strict=True):
        if len(group) >= MIN_SHIFTS:
            continue
        distances = {each: abs(float(np.log(each / period))) for each in shared}
        nearest = min(distances, key=distances.__getitem__, default=None)
        if nearest is not None and 1 / _LIKE_PERIODS <= nearest / period <= _LIKE_PERIODS:
            shared[nearest] += group
        else:
            alone.append(tuple(group))
    return (*map(tuple, shared.values()), *alone)


def _positions_px(patterns: Sequence[Pattern], extent_px: int | None) -> FloatArray:
    """Return positions of the projector, at most as far as the code goes or until all phases come again."""
    periods = np.array(sorted({p.period_px for p in patterns if isinstance(p, Sine)}))
    extents = periods[-1] * np.arange(1, max(int(_MAX_EXTENT_PX / periods[-1]), 1) + 1)
    turns = extents[:, np.newaxis] / periods
    again = (np.abs(turns - np.rint(turns)) < _SAME_PHASE).all(axis=1)
    coded = [p.cell_px << p.bits for p in patterns if isinstance(p, Gray)]
    least_px = max(coded) if coded else extents[np.argmax(again)] if again.any() else extents[-1]
    return np.arange(0, min(least_px, extent_px or least_px), periods[0] / _STEPS_PER_PERIOD)


def _light(pattern: Pattern, position_px: FloatArray, gamma: float) -> FloatArray:
    match pattern:
        case White():
            return np.ones_like(position_px)
        case Gray():
            # Blur makes a ramp of an edge.
            ramp_px = min(_EDGE_PX, pattern.cell_px / 2) * np.linspace(-1, 1, 9)[:, np.newaxis]
            cell = np.floor((position_px + ramp_px + 0.5 + pattern.offset_px) / pattern.cell_px).astype(np.int64)
            lit = (to_gray(np.maximum(cell, 0)) >> (pattern.bits - 1 - pattern.bit) & 1) != pattern.inverted
            return np.asarray(lit.mean(axis=0))
        case Sine():
            turns = position_px / pattern.period_px - pattern.shift / pattern.steps
            return np.asarray((0.5 + 0.5 * np.cos(2 * np.pi * turns)) ** gamma)
        case _:
            return np.zeros_like(position_px)


def _fit_once(frames: Light, model: Light, used: SampleMask) -> tuple[Integers, Samples, Samples]:
    """Return position index, level and swing of each pixel: the largest correlation of its frames with the model."""
    shape, seen = model[used], frames[used]
    mean, seen_mean = shape.mean(axis=0), seen.mean(axis=0)
    shape, seen = shape - mean, seen - seen_mean
    unit = shape / np.maximum(np.sqrt(np.sum(shape**2, axis=0)), 1e-3)
    index = np.concatenate(
        [np.argmax(seen[:, start : start + _BLOCK].T @ unit, axis=1) for start in range(0, seen.shape[1], _BLOCK)]
    )
    at = shape[:, index]
    swing = np.maximum(np.sum(seen * at, axis=0) / np.maximum(np.sum(at**2, axis=0), 1e-6), 1e-3)
    return index, seen_mean - swing * mean[index], swing


def fit_frames(frames: Light, model: LightModel, *, without: Collection[int] = ()) -> FrameFit:
    """Fit frames of one axis, (K, n) float32, by position, level and swing of each pixel.

    without : frames, by place, that take no part, and are predicted by the others.
    """
    used = np.array([place not in without for place in range(len(model.patterns))])
    few = frames[:, :: max(frames.shape[1] // _GAMMA_PIXELS, 4)]
    lights = {
        each: _with_contrast(few, light, used, model.equally_blurred, 1) for each, light in model.by_gamma.items()
    }
    misfits = {each: _median_misfit(few, light, used) for each, light in lights.items()}
    gamma = min(misfits, key=misfits.__getitem__)
    light = _with_contrast(frames, lights[gamma], used, model.equally_blurred, _FIT_STEPS)
    index, level, swing = _fit_once(frames, light, used)
    low, high = light[:, index], light[:, index]
    for place, reach in model.reach.items():
        around = np.clip(index + np.arange(-reach, reach + 1)[:, np.newaxis], 0, light.shape[1] - 1)
        low[place], high[place] = light[place, around].min(axis=0), light[place, around].max(axis=0)
    seen = (frames - level) / swing
    rest = np.clip(seen - np.clip(seen, low, high), -1, 1)
    one, other = index.reshape(2, -1)
    jumps = float(np.mean(np.abs(one - other) > _STEPS_PER_PERIOD / 2))
    return FrameFit(rest, light[:, index], gamma, _noise(rest[used]), used, level, swing, jumps)


def _with_contrast(frames: Light, light: Light, used: SampleMask, groups: Sequence[Sequence[int]], steps: int) -> Light:
    """Return the light of the patterns with the contrast that blur leaves each period."""
    light = light.copy()
    for _ in range(steps):
        index, level, swing = _fit_once(frames, light, used)
        seen = (frames - level) / swing
        for places in groups:
            gains = [_slope(light[each, index], seen[each]) for each in places if used[each]]
            if gains:
                rows, gain = list(places), np.float32(np.clip(np.median(gains), *_GAINS))
                mean = light[rows].mean()
                light[rows] = mean + gain * (light[rows] - mean)
    return light


def _median_misfit(frames: Light, light: Light, used: SampleMask) -> float:
    index, level, swing = _fit_once(frames, light, used)
    rest = np.clip((frames - level) / swing - light[:, index], -1, 1)[used]
    return float(np.median(np.sum(rest**2, axis=0)))


def _slope(shape: Samples, light: Samples) -> float:
    off = shape - shape.mean()
    return float(np.dot(off, np.clip(light, -0.5, 1.5)) / max(float(np.dot(off, off)), 1e-6))


def _noise(rest: Light) -> float:
    """Noise of a frame: what does not fit differs between neighbours by noise, as the scene varies less. A wrong frame
    differs as well, so it is that of the quieter frames.
    """
    one, other = rest.reshape(len(rest), 2, -1).transpose(1, 0, 2)
    return float(np.percentile(1.4826 * np.median(np.abs(one - other), axis=1) / 2**0.5, 25))

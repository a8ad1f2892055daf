"""Light of single frames: pure functions that find by which factor a frame is brighter than white and black say.

A lamp that follows the picture (dynamic contrast) or flickers changes the projector's light, automatic exposure changes
all light, from frame to frame. One factor for each frame is free: checks judge what is left after it.

With β = black/(white − black), a frame on the scale of white and black is u = a·s for projector light of the factor a,
and u = a·(s + β) − β if all light has this factor; s, 0 to 1, is the light of the pattern at a pixel. A pattern and its
inverse have s + s' = 1, so that u/a + u'/a' = 1, or (u + β)/a + (u' + β)/a' = 1 + 2β: a straight line in both cases.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from slrig.capture.frame_checks import BANDS, ReferenceFrames, Samples

MAX_LIGHT_FACTOR = 4.0
"""Largest factor of a frame's light, up or down; beyond it, a frame counts as dark or as another pattern."""

STEADY_LIGHT = 0.1
"""Changes of light up to this fraction are not worth a note."""

_MIN_CLASS_FRACTION = 0.03  # of the tested pixels, for a median of those that one frame of a pair lights
_MIN_LIT_FRACTION = 0.1  # of the tested pixels, lit by one frame of a pair and not by the other
_MIN_SWING = 0.5  # between the frames of a pair at such a pixel
_MIN_RESIDUAL, _MAX_RESIDUAL = 0.02, 0.04  # of the straight line: more is no change of light
_TUKEY = 4.7
_FIT_STEPS = 8
_PLATEAU = 0.75  # quantile of the pixels that a frame lights, beyond those at edges
_EQUALITY_WEIGHT = 0.0005  # of the pixels, for equal factors where one of two is not determined
_MAX_EDGE_EXCESS = 0.1  # of the sum of a pair at its edges, in a camera that counts as linear
_MIN_EDGE_SAMPLES = 100


@dataclass(frozen=True, slots=True)
class FrameLight:
    """Light of a frame relative to the white and black frames. is_exposure : True if all light has the factor, as by
    exposure or gain; False if the projector's light has it.
    """

    factor: float = 1.0
    is_exposure: bool = False

    def undo(self, frame: Samples, black: Samples) -> Samples:
        """Return the frame as the light of white and black would have made it. black : samples of the black frame."""
        if self.factor == 1.0:
            return frame
        base = np.float32(0) if self.is_exposure else black
        return np.asarray(base + (frame - base) / np.float32(self.factor), dtype=np.float32)


STEADY = FrameLight()


def pair_lights(
    bit: Samples, inverse: Samples, ref: ReferenceFrames, *, usual: float
) -> Iterator[tuple[FrameLight, FrameLight]]:
    """Yield the possible lights of a frame and its inverse: that of white and black, the usual factor of other pairs,
    then those of `fit_pair_light` for a lamp and for an exposure.
    """
    yield STEADY, STEADY
    if usual != 1.0:
        yield FrameLight(usual), FrameLight(usual)
    for is_exposure in (False, True):
        fitted = fit_pair_light(bit, inverse, ref, is_exposure=is_exposure)
        # A smaller change passes as it is; a damaged frame may fit one.
        if fitted is not None and max(abs(each.factor - 1) for each in fitted) > STEADY_LIGHT:
            yield fitted


def fit_pair_light(
    bit: Samples, inverse: Samples, ref: ReferenceFrames, *, is_exposure: bool
) -> tuple[FrameLight, FrameLight] | None:
    """Return the light of a frame and of its inverse; None if the pair does not determine them.

    A pair that is alike everywhere, because its stripes are too fine or because one frame is a copy of the other, fits
    any factor.
    """
    u, v = ref.relative(bit), ref.relative(inverse)
    if is_exposure:
        offset = (ref.black / ref.contrast)[ref.tested]
        u, v = (u + offset) / (1 + 2 * offset), (v + offset) / (1 + 2 * offset)
    a, b = _fit_factors(u, v)
    if not all(1 / MAX_LIGHT_FACTOR <= each <= MAX_LIGHT_FACTOR for each in (a, b)):
        return None
    if np.mean(np.abs(u / a - v / b) > _MIN_SWING) < _MIN_LIT_FRACTION:
        return None
    return FrameLight(a, is_exposure), FrameLight(b, is_exposure)


def _fit_factors(u: Samples, v: Samples) -> tuple[float, float]:
    """Return a and b of the straight line u/a + v/b = 1 through most pixels, by iterated weighted least squares with
    Tukey's weights; infinite if there is no such line, and 1 where the frames add up to white and black as they are.
    """
    # A third of the pixels tells two numbers as well.
    u, v = u[::3], v[::3]
    # Pixels that one frame lights and the other does not; both kinds count alike, however few the rarer ones are.
    kinds = [mask for mask in (u > v, u <= v) if np.mean(mask) >= _MIN_CLASS_FRACTION]
    # Where few pixels are lit by one of the frames, a line through blurred edges may fit as well.
    if all(abs(float(np.median((u + v)[mask])) - 1) < _MIN_RESIDUAL for mask in kinds):
        return 1.0, 1.0
    share = np.ones(len(u))
    for mask in kinds:
        share[mask] = 1 / (len(kinds) * np.mean(mask))
    common = 1 / max(float(np.median(u + v)), 1e-3)
    x, y = (
        1 / max(float(np.quantile(each[mask], _PLATEAU)), 1e-3) if np.mean(mask) >= _MIN_CLASS_FRACTION else common
        for each, mask in ((u, u > v), (v, u <= v))
    )
    equal = _EQUALITY_WEIGHT * len(u)
    for _ in range(_FIT_STEPS):
        rest = u * x + v * y - 1
        spread = max(_MIN_RESIDUAL, *(1.4826 * float(np.median(np.abs(rest[mask]))) for mask in kinds))
        weight = share * np.clip(1 - (rest / (_TUKEY * spread)) ** 2, 0, None) ** 2
        matrix = np.array(
            [
                [float(np.sum(weight * u * u)) + equal, float(np.sum(weight * u * v)) - equal],
                [float(np.sum(weight * u * v)) - equal, float(np.sum(weight * v * v)) + equal],
            ]
        )
        if np.linalg.det(matrix) <= 1e-9 * np.trace(matrix) ** 2:
            break
        x, y = (float(each) for each in np.linalg.solve(matrix, [np.sum(weight * u), np.sum(weight * v)]))
    rest = np.abs(u * x + v * y - 1)
    if x <= 0 or y <= 0 or any(np.median(rest[mask]) > _MAX_RESIDUAL for mask in kinds):
        return np.inf, np.inf
    return 1 / x, 1 / y


def single_lights(frame: Samples, ref: ReferenceFrames, *, usual: float) -> Iterator[FrameLight]:
    """Yield the possible lights of a frame without an inverse: that of white and black, the usual factor, and one that
    brings the brightest pixels of most bands to white.
    """
    yield STEADY
    if usual != 1.0:
        yield FrameLight(usual)
    u = ref.relative(frame)
    band = ref.band[ref.tested]
    brightest = float(np.median([np.quantile(u[band == b], 0.98) for b in range(BANDS) if (band == b).any()]))
    if 1 < brightest <= MAX_LIGHT_FACTOR:
        yield FrameLight(brightest)


def coarse_bit_factor(frame: Samples, ref: ReferenceFrames) -> float:
    """Return the factor of a bit with few edges: the median of the pixels that it lights; 1 if it lights few."""
    u = ref.relative(frame)
    lit = u > max(0.5 * float(np.quantile(u, 0.98)), 1 / MAX_LIGHT_FACTOR)
    return float(np.median(u[lit])) if np.mean(lit) >= _MIN_LIT_FRACTION else 1.0


def repeat_light(first: Samples, repeat: Samples, ref: ReferenceFrames) -> FrameLight:
    """Return the light of a second frame of a pattern relative to the first: the factor, of the projector's light or of
    all light, that leaves less; that of white and black if it is beyond `MAX_LIGHT_FACTOR`.
    """
    candidates = []
    for is_exposure in (False, True):
        base = np.float32(0) if is_exposure else ref.black
        before, after = (first - base)[ref.tested], (repeat - base)[ref.tested]
        power = float(np.dot(before, before))
        factor = float(np.dot(before, after)) / power if power > 0 else 1.0
        candidates.append((float(np.median(np.abs(after - factor * before))), FrameLight(factor, is_exposure)))
    light = min(candidates, key=lambda each: each[0])[1]
    return light if 1 / MAX_LIGHT_FACTOR <= light.factor <= MAX_LIGHT_FACTOR else STEADY


def line_lights(frames: Sequence[Samples], ref: ReferenceFrames) -> list[FrameLight]:
    """Return the light of each line frame of an axis relative to their median: over several periods, all shifts send
    equally much light.
    """
    contrast = float(np.sum(ref.contrast[ref.tested]))
    light = np.array([float(np.sum((frame - ref.black)[ref.tested])) / contrast for frame in frames])
    usual = float(np.median(light))
    if usual <= 0 or light.min() <= 0:
        return [STEADY] * len(frames)
    return [FrameLight(float(each)) for each in np.clip(light / usual, 1 / MAX_LIGHT_FACTOR, MAX_LIGHT_FACTOR)]


def line_factors(frames: Sequence[Samples], ref: ReferenceFrames, *, duty: float) -> list[float]:
    """Return the light of each line frame over its share of white; the response of the camera must be linear."""
    contrast = float(np.sum(ref.contrast[ref.tested]))
    return [float(np.sum((frame - ref.black)[ref.tested])) / contrast / duty for frame in frames]


def is_linear_at_edges(bit: Samples, inverse: Samples, ref: ReferenceFrames) -> bool | None:
    """True if a bit and its inverse, both at the light of white and black, add up to it also at their edges, as in a
    camera with linear response; None without enough edges.
    """
    u, v = ref.relative(bit), ref.relative(inverse)
    edge = np.abs(u - v) < _MIN_SWING
    if np.count_nonzero(edge) < _MIN_EDGE_SAMPLES:
        return None
    return bool(abs(float(np.median((u + v)[edge])) - 1) < _MAX_EDGE_EXCESS)

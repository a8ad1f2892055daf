"""Fusion of several exposures of every pattern into one image each, before decoding.

A pixel takes part with those exposures at which nothing that it showed was clipped, the same ones in all its frames and
with the same weights: then whatever an exposure adds (a pedestal) or how far its time is off cancels in the differences
that all decoding is made of. Chosen frame by frame, it would bend the light profile that tells a stripe's centre.

In units of the longest exposure, with s how much more light that one has than exposure k, a sample is s·I and its noise
s²·(read + slope·I). Weights w are the inverse of that variance at the middle of what the pixel shows, so that the fused
value has the least noise: read · Σ w²s² + slope · Σ w²s · value, the two shares of `NoiseModel`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import Axis, Capture, FloatArray, Gray, Pattern, exposure_groups
from slrig.reconstruction.camera_response import compression_loss
from slrig.reconstruction.frames import (
    NEARLY_FULL,
    AxisFrames,
    AxisPatterns,
    FrameStacks,
    Image,
    axis_patterns,
    ends_repeats,
    mean_image,
    telling_shots,
)
from slrig.reconstruction.noise import NoiseModel, fitted_noise, noise_samples

_CLEAR_SIGMA = 20.0  # the ratio of two exposures is then known to a twentieth at each pixel,
_LEAST_FOR_LIGHT = 500  # and the median of so many to a three-hundredth


@dataclass(frozen=True, slots=True)
class FusedFrames:
    """The frames of a bracket as if they were of one exposure, the longest: in its units, and often beyond full scale.

    exposures_s : (k,) float64, from long to short; light : (k,) float64, that of the projector as measured, as a share
    of the longest's: exposures_s over the longest where the camera does as it says.
    weights : (k, H, W) float32, the share of each exposure in each pixel, in sum 1.
    """

    frames: AxisFrames
    noise: NoiseModel
    exposures_s: FloatArray
    light: FloatArray
    weights: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ExposureUse:
    """What one exposure of a bracket gave.

    light : the projector's, as a share of the longest exposure's, as measured, over what the exposure times tell.
    longest_of : share of the pixels asked about of which this is the longest exposure that nothing clipped;
    weight : its part in their values, on average.
    """

    exposure_s: float
    light: float
    longest_of: float
    weight: float


@dataclass(frozen=True, slots=True)
class _Exposed:
    """One exposure: the image of each pattern, and white and black as `AxisFrames` has them, in the camera's own units.

    usable : (H, W) bool, pixels of which nothing is clipped; samples : those of `noise_samples`.
    """

    images: Mapping[Pattern, NDArray[Any]]
    white: Image
    black: Image
    usable: NDArray[np.bool_]
    samples: tuple[NDArray[np.float32], NDArray[np.float32]]


def fused_frames(capture: Capture, camera: str, axis: Axis) -> FusedFrames:
    """Fuse the exposures of one camera, and sort the images for decoding along one axis.

    Raises
    ------
    PatternError
        As `axis_patterns` does, or a pattern lacks one of the exposures, or an exposure is not known.
    """
    shots = telling_shots(capture, camera)
    alike = exposure_groups(shot.exposure_s for shot in shots)
    shown = [capture.patterns[shot.pattern] for shot in shots]
    patterns = axis_patterns(set(shown), camera, axis)
    seen: dict[Pattern, dict[float | None, list[NDArray[Any]]]] = {each: {} for each in patterns.needed}
    for shot, pattern in zip(shots, shown, strict=True):
        if pattern in seen:
            seen[pattern].setdefault(alike[shot.exposure_s], []).append(shot.image)
    exposures_s = _common_exposures(seen, camera)
    form = capture.cameras[camera]
    scales = {"full_scale": float(form.full_scale), "ends_repeats": ends_repeats(shown, axis)}
    exposed: list[_Exposed] = []
    unseen = np.ones(form.size.shape, dtype=np.bool_)
    for time_s in exposures_s:
        repeats = {pattern: by_exposure[time_s] for pattern, by_exposure in seen.items()}
        exposed.append(_exposed(repeats, patterns, unseen, **scales))
        unseen &= ~exposed[-1].usable
    noise = fitted_noise(each.samples for each in exposed)
    light = _measured_light(exposed, exposures_s, noise)
    weights = _weights(exposed, 1 / light, noise)
    gains = weights * (1 / light).astype(np.float32)[:, np.newaxis, np.newaxis]
    stacks = FrameStacks(patterns, form.size.shape, **scales, exposure_ratio=float(np.float32(1 / light[-1])))
    for pattern in patterns.needed:
        stacks.put(pattern, _fused([each.images[pattern] for each in exposed], gains))
    loss = _loss(exposed[0], patterns, noise, float(form.full_scale))
    shares = np.einsum("kij,kij->ij", gains, gains), np.einsum("kij,kij->ij", weights, gains)
    return FusedFrames(
        stacks.frames(),
        replace(noise, read_share=shares[0], shot_share=shares[1], loss=loss),
        exposures_s,
        light,
        weights,
    )


def _loss(longest: _Exposed, patterns: AxisPatterns, noise: NoiseModel, full_scale: float) -> FloatArray:
    """What compression took from the longest exposure, whose light tells most where it is not clipped."""
    spread = np.sqrt(noise.variance(longest.white) + noise.variance(longest.black))
    lit = longest.usable & (longest.white - longest.black > _CLEAR_SIGMA * spread)
    code = [longest.images[each] for each in patterns.needed if isinstance(each, Gray)]
    return compression_loss([longest.images[each] for each in patterns.lines] or code, code, lit, full_scale)


def _common_exposures(seen: Mapping[Pattern, Mapping[float | None, object]], camera: str) -> FloatArray:
    """(k,) float64: the exposures that every pattern has, from long to short."""
    sets = {frozenset(by_exposure) for by_exposure in seen.values()}
    if len(sets) > 1 or None in next(iter(sets)):
        message = (
            f"camera '{camera}': an exposure bracket needs the same exposures, stated, for every pattern; "
            f"found {[sorted(str(e) for e in each) for each in sets]}"
        )
        raise PatternError(message)
    return np.sort([float(e) for e in next(iter(sets)) if e is not None])[::-1]


def _exposed(
    repeats: Mapping[Pattern, Sequence[NDArray[Any]]],
    patterns: AxisPatterns,
    unseen: NDArray[np.bool_],
    *,
    full_scale: float,
    ends_repeats: float,
) -> _Exposed:
    """Average repeats, and see what is of use.

    unseen : (H, W) bool, pixels that no longer exposure could use; the others are dark here and say little of the
    noise, which zero cuts off.
    """
    shape = unseen.shape
    images = {pattern: mean_image(each) for pattern, each in repeats.items()}
    # Lines tell nothing of the noise, and what decoding is made of is large.
    code = replace(patterns, lines=())
    stacks = FrameStacks(code, shape, full_scale=full_scale, ends_repeats=ends_repeats)
    for pattern in code.needed:
        stacks.put(pattern, images[pattern])
    frames = stacks.frames()
    brightest = np.zeros(shape, dtype=np.uint16)
    for each in repeats.values():
        for image in each:
            np.maximum(brightest, image, out=brightest)
    usable = brightest < NEARLY_FULL * full_scale
    return _Exposed(images, frames.white, frames.black, usable, noise_samples(frames, unseen & usable))


def _measured_light(exposed: Sequence[_Exposed], exposures_s: FloatArray, noise: NoiseModel) -> FloatArray:
    """(k,) float64: how much light each exposure got of the projector, as a share of the longest's.

    Sensors and shutters are not exact, and a projector that refreshes lights a short exposure by chance. Measured where
    the brightness of two exposures that follow one another is clear of noise, and by the clock where it nowhere is.
    """
    light = [1.0]
    for (long, short), (long_s, short_s) in zip(pairwise(exposed), pairwise(exposures_s), strict=True):
        step = short_s / long_s
        contrast = long.white - long.black
        spread = np.sqrt(noise.variance(short.white) + noise.variance(short.black))
        clear = long.usable & short.usable & (contrast * np.float32(step) > _CLEAR_SIGMA * spread)
        if np.count_nonzero(clear) >= _LEAST_FOR_LIGHT:
            step = min(float(np.median((short.white - short.black)[clear] / contrast[clear])), 1.0)
        light.append(light[-1] * step)
    return np.array(light)


def _weights(exposed: Sequence[_Exposed], scales: FloatArray, noise: NoiseModel) -> NDArray[np.float32]:
    """(k, H, W) float32: the weight of each exposure in each pixel. scales : (k,), into units of the longest."""
    shape = exposed[0].white.shape
    middle = np.zeros(shape, dtype=np.float32)
    for each, scale in reversed(list(zip(exposed, scales, strict=True))):
        # The longest of the usable ones knows best.
        level = np.maximum(each.white + each.black, 0) * np.float32(scale / 2)
        middle = np.where(each.usable, level, middle)
    weights = np.zeros((len(exposed), *shape), dtype=np.float32)
    for weight, each, scale in zip(weights, exposed, scales, strict=True):
        variance = np.float32(scale**2 * noise.read_variance) + np.float32(scale * noise.slope) * middle
        np.divide(1, variance, out=weight, where=each.usable)
    # What every exposure clips, the shortest clips least; decoding says what is left of it.
    weights[-1][~np.any([each.usable for each in exposed], axis=0)] = 1
    weights /= weights.sum(axis=0)
    return weights


def _fused(images: Sequence[NDArray[Any]], gains: NDArray[np.float32]) -> Image:
    total = images[0] * gains[0]
    for image, gain in zip(images[1:], gains[1:], strict=True):
        total += image * gain
    return np.asarray(total, dtype=np.float32)


def fused_colour(repeats: Sequence[Sequence[NDArray[Any]]], fused: FusedFrames, full_scale: float) -> Image:
    """(H, W, 3) float32: a pattern's frames in colour, in units of the longest exposure: of each channel the exposures
    that did not clip it, by their light; what all clip, as the shortest has it.

    repeats : of each exposure, from long to short, as `fused` has them.
    """
    total = np.zeros(repeats[0][0].shape, dtype=np.float32)
    weight = np.zeros_like(total)
    for light, images in zip(fused.light, repeats, strict=True):
        usable = np.max(images, axis=0) < NEARLY_FULL * full_scale
        np.add(total, mean_image(images), out=total, where=usable)
        np.add(weight, np.float32(light), out=weight, where=usable)
    shortest = mean_image(repeats[-1]) / np.float32(fused.light[-1])
    return np.asarray(np.divide(total, weight, out=shortest.astype(np.float32), where=weight > 0))


def exposure_use(fused: FusedFrames, used: NDArray[np.bool_]) -> tuple[ExposureUse, ...]:
    """What each exposure gave to the pixels `used`, (H, W) bool; from short to long."""
    count = max(int(np.count_nonzero(used)), 1)
    longest = np.argmax(fused.weights > 0, axis=0)
    told = fused.exposures_s / fused.exposures_s[0]
    uses = [
        ExposureUse(
            exposure_s=float(exposure_s),
            light=float(fused.light[index] / told[index]),
            longest_of=float(np.count_nonzero(used & (longest == index)) / count),
            weight=float(np.sum(fused.weights[index], where=used, dtype=np.float64) / count),
        )
        for index, exposure_s in enumerate(fused.exposures_s)
    ]
    return tuple(reversed(uses))

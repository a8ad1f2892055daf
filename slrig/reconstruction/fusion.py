"""Fusion of several exposures of every pattern into one image each, before decoding.

A pixel uses those exposures in which none of its values is clipped, the same ones with the same weights in all its
frames. An offset or an inexact time of an exposure then cancels in the differences that decoding uses. A choice per
frame would distort the light profile from which the centre of a stripe is measured.

In units of the longest exposure, with s its light over that of exposure k, a sample is s·I and its noise s²·(read +
slope·I). Weights w are the inverse of that variance at the mean level of the pixel, so that the fused value has the
least noise: read · Σ w²s² + slope · Σ w²s · value, with the two shares of `NoiseModel`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import Axis, Capture, FloatArray, Gray, NoiseModel, Pattern, exposure_groups, fit_noise
from slrig.reconstruction.camera_response import compression_loss, sample_noise
from slrig.reconstruction.frames import (
    NEAR_SATURATION,
    AxisFrames,
    AxisPatterns,
    FrameStacks,
    Image,
    axis_patterns,
    mean_image,
    reference_repeats,
    used_shots,
)

# The ratio of two exposures is then known to a twentieth at each pixel, and the median of this number to 1/300.
_MIN_CONTRAST_SIGMA = 20.0
_MIN_LIGHT_PIXELS = 500


@dataclass(frozen=True, slots=True)
class FusedFrames:
    """Frames of a bracket in units of its longest exposure, often beyond full scale.

    exposures_s : (k,) float64, from long to short; light : (k,) float64, measured light of the projector as a share of
    the longest's, which is exposures_s over the longest if the camera is exact. weights : (k, H, W) float32, share of
    each exposure in each pixel, in sum 1.
    """

    frames: AxisFrames
    noise: NoiseModel
    exposures_s: FloatArray
    light: FloatArray
    weights: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ExposureUse:
    """Contribution of one exposure of a bracket.

    light : measured light of the projector as a share of the longest exposure's, over that share by exposure times.
    longest_of : share of the pixels in question for which this is the longest unclipped exposure; weight : its mean
    weight in their values.
    """

    exposure_s: float
    light: float
    longest_of: float
    weight: float


@dataclass(frozen=True, slots=True)
class _ExposureImages:
    """Images of one exposure by pattern, and white and black as in `AxisFrames`, in the camera's own units.

    usable : (H, W) bool, pixels that are never clipped; samples : those of `sample_noise`.
    """

    images: Mapping[Pattern, NDArray[Any]]
    white: Image
    black: Image
    usable: NDArray[np.bool_]
    samples: tuple[NDArray[np.float32], NDArray[np.float32]]


def fuse_exposures(capture: Capture, camera: str, axis: Axis) -> FusedFrames:
    """Fuse the exposures of one camera, and sort the images for decoding along one axis.

    Raises
    ------
    PatternError
        As `axis_patterns` does, or a pattern lacks one of the exposures, or an exposure is not known.
    """
    shots = used_shots(capture, camera)
    group_of = exposure_groups(shot.exposure_s for shot in shots)
    shot_patterns = [capture.patterns[shot.pattern] for shot in shots]
    patterns = axis_patterns(set(shot_patterns), camera, axis)
    images: dict[Pattern, dict[float | None, list[NDArray[Any]]]] = {each: {} for each in patterns.required}
    for shot, pattern in zip(shots, shot_patterns, strict=True):
        if pattern in images:
            images[pattern].setdefault(group_of[shot.exposure_s], []).append(shot.image)
    exposures_s = _common_exposures(images, camera)
    camera_format = capture.cameras[camera]
    scales = {
        "full_scale": float(camera_format.full_scale),
        "reference_repeats": reference_repeats(shot_patterns, axis),
    }
    exposures: list[_ExposureImages] = []
    unused = np.ones(camera_format.size.shape, dtype=np.bool_)
    for time_s in exposures_s:
        repeats = {pattern: by_exposure[time_s] for pattern, by_exposure in images.items()}
        exposures.append(_collect_exposure(repeats, patterns, unused, **scales))
        unused &= ~exposures[-1].usable
    noise = fit_noise(each.samples for each in exposures)
    light = _measure_light(exposures, exposures_s, noise)
    weights = _exposure_weights(exposures, 1 / light, noise)
    gains = weights * (1 / light).astype(np.float32)[:, np.newaxis, np.newaxis]
    stacks = FrameStacks(patterns, camera_format.size.shape, **scales, exposure_ratio=float(np.float32(1 / light[-1])))
    for pattern in patterns.required:
        stacks.put(pattern, _blend([each.images[pattern] for each in exposures], gains))
    loss = _longest_exposure_loss(exposures[0], patterns, noise, float(camera_format.full_scale))
    shares = np.einsum("kij,kij->ij", gains, gains), np.einsum("kij,kij->ij", weights, gains)
    return FusedFrames(
        stacks.frames(),
        replace(noise, read_share=shares[0], shot_share=shares[1], loss=loss),
        exposures_s,
        light,
        weights,
    )


def _longest_exposure_loss(
    longest: _ExposureImages, patterns: AxisPatterns, noise: NoiseModel, full_scale: float
) -> FloatArray:
    """Loss by compression of the longest exposure, which has most light where it is not clipped."""
    spread = np.sqrt(noise.variance(longest.white) + noise.variance(longest.black))
    lit = longest.usable & (longest.white - longest.black > _MIN_CONTRAST_SIGMA * spread)
    code = [longest.images[each] for each in patterns.required if isinstance(each, Gray)]
    code = code or [longest.images[each] for each in patterns.sines]
    return compression_loss([longest.images[each] for each in patterns.lines] or code, code, lit, full_scale)


def _common_exposures(images: Mapping[Pattern, Mapping[float | None, object]], camera: str) -> FloatArray:
    """(k,) float64: the exposures that every pattern has, from long to short."""
    sets = {frozenset(by_exposure) for by_exposure in images.values()}
    if len(sets) > 1 or None in next(iter(sets)):
        message = (
            f"camera '{camera}': an exposure bracket needs the same exposures, stated, for every pattern; "
            f"found {[sorted(str(e) for e in each) for each in sets]}"
        )
        raise PatternError(message)
    return np.sort([float(e) for e in next(iter(sets)) if e is not None])[::-1]


def _collect_exposure(
    repeats: Mapping[Pattern, Sequence[NDArray[Any]]],
    patterns: AxisPatterns,
    unused: NDArray[np.bool_],
    *,
    full_scale: float,
    reference_repeats: float,
) -> _ExposureImages:
    """Average repeats, find usable pixels and sample the noise.

    unused : (H, W) bool, pixels that no longer exposure could use; the others are dark here, and zero cuts off their
    noise.
    """
    shape = unused.shape
    images = {pattern: mean_image(each) for pattern, each in repeats.items()}
    # Lines are not needed for the noise, and stacks are large.
    code = replace(patterns, lines=())
    stacks = FrameStacks(code, shape, full_scale=full_scale, reference_repeats=reference_repeats)
    for pattern in code.required:
        stacks.put(pattern, images[pattern])
    frames = stacks.frames()
    brightest = np.zeros(shape, dtype=np.uint16)
    for each in repeats.values():
        for image in each:
            np.maximum(brightest, image, out=brightest)
    usable = brightest < NEAR_SATURATION * full_scale
    return _ExposureImages(images, frames.white, frames.black, usable, sample_noise(frames, unused & usable))


def _measure_light(exposures: Sequence[_ExposureImages], exposures_s: FloatArray, noise: NoiseModel) -> FloatArray:
    """(k,) float64: light of the projector in each exposure, as a share of the longest's.

    Sensors and shutters are not exact, and short exposures of a projector that refreshes get light by chance. It is
    measured where two consecutive exposures are clear of noise, and taken from the exposure times otherwise.
    """
    light = [1.0]
    for (long, short), (long_s, short_s) in zip(pairwise(exposures), pairwise(exposures_s), strict=True):
        step = short_s / long_s
        contrast = long.white - long.black
        spread = np.sqrt(noise.variance(short.white) + noise.variance(short.black))
        clear = long.usable & short.usable & (contrast * np.float32(step) > _MIN_CONTRAST_SIGMA * spread)
        if np.count_nonzero(clear) >= _MIN_LIGHT_PIXELS:
            step = min(float(np.median((short.white - short.black)[clear] / contrast[clear])), 1.0)
        light.append(light[-1] * step)
    return np.array(light)


def _exposure_weights(
    exposures: Sequence[_ExposureImages], scales: FloatArray, noise: NoiseModel
) -> NDArray[np.float32]:
    """(k, H, W) float32: weight of each exposure in each pixel. scales : (k,), factors to units of the longest."""
    shape = exposures[0].white.shape
    middle = np.zeros(shape, dtype=np.float32)
    for each, scale in reversed(list(zip(exposures, scales, strict=True))):
        # The longest usable exposure has the best estimate.
        level = np.maximum(each.white + each.black, 0) * np.float32(scale / 2)
        middle = np.where(each.usable, level, middle)
    weights = np.zeros((len(exposures), *shape), dtype=np.float32)
    for weight, each, scale in zip(weights, exposures, scales, strict=True):
        variance = np.float32(scale**2 * noise.read_variance) + np.float32(scale * noise.slope) * middle
        np.divide(1, variance, out=weight, where=each.usable)
    # If all exposures are clipped, the shortest is used; decoding then refuses the pixel if needed.
    weights[-1][~np.any([each.usable for each in exposures], axis=0)] = 1
    weights /= weights.sum(axis=0)
    return weights


def _blend(images: Sequence[NDArray[Any]], gains: NDArray[np.float32]) -> Image:
    total = images[0] * gains[0]
    for image, gain in zip(images[1:], gains[1:], strict=True):
        total += image * gain
    return np.asarray(total, dtype=np.float32)


def fuse_colour(repeats: Sequence[Sequence[NDArray[Any]]], fused: FusedFrames, full_scale: float) -> Image:
    """(H, W, 3) float32: colour frames of a pattern in units of the longest exposure.

    Each channel combines its unclipped exposures by their light; if all are clipped, it is that of the shortest.
    repeats : images of each exposure, in the order of `fused`.
    """
    total = np.zeros(repeats[0][0].shape, dtype=np.float32)
    weight = np.zeros_like(total)
    for light, images in zip(fused.light, repeats, strict=True):
        usable = np.max(images, axis=0) < NEAR_SATURATION * full_scale
        np.add(total, mean_image(images), out=total, where=usable)
        np.add(weight, np.float32(light), out=weight, where=usable)
    shortest = mean_image(repeats[-1]) / np.float32(fused.light[-1])
    return np.asarray(np.divide(total, weight, out=shortest.astype(np.float32), where=weight > 0))


def exposure_use(fused: FusedFrames, used: NDArray[np.bool_]) -> tuple[ExposureUse, ...]:
    """Contribution of each exposure to the pixels `used`, (H, W) bool; from short to long."""
    count = max(int(np.count_nonzero(used)), 1)
    longest = np.argmax(fused.weights > 0, axis=0)
    time_share = fused.exposures_s / fused.exposures_s[0]
    uses = [
        ExposureUse(
            exposure_s=float(exposure_s),
            light=float(fused.light[index] / time_share[index]),
            longest_of=float(np.count_nonzero(used & (longest == index)) / count),
            weight=float(np.sum(fused.weights[index], where=used, dtype=np.float64) / count),
        )
        for index, exposure_s in enumerate(fused.exposures_s)
    ]
    return tuple(reversed(uses))

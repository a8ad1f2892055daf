"""Exposure brackets: check which exposures are usable, whether they agree, and what they verify.

A bracket plays the whole sequence once for each exposure, from short to long, so that each exposure is verified like a
single one. Playing all exposures of one pattern before the next would change the settings of every camera for every
frame, which takes several frames on most cameras, and would allow frames of a wrong exposure. The check for movement
covers the longer time between the exposures.

Pure functions of frames and their samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from slrig.bundle import RefusedFrame
from slrig.capture.frame_checks import NEAR_SATURATION, NOISE_FLOOR_DN, Samples, describe_pattern
from slrig.capture.verifier import EvidenceSummary, Sampler, check_capture
from slrig.model import Black, CameraFormat, Capture, Pattern, Pixels, White, exposure_groups

MIN_CONTRAST_TO_NOISE = 12.0
"""Minimum of white − black in standard deviations of the noise."""

MIN_CONTRAST_DN = 4.0
"""Minimum of white − black, below which rounding hides relative light."""

_PERIOD_TOLERANCE = 1e-6  # of a refresh period, for ranges stated as whole periods
_MAX_SATURATED_FRACTION = 0.9  # of the lit samples, as in `frame_checks.measure_lighting`
_MIN_LIT_SAMPLES = 40  # as in `frame_checks`
_MIN_COMPARED_SAMPLES = 300
_MAX_MOVED_FRACTION = 0.05  # of the pixels, as in `frame_checks.drift_fault`
_MOVED_THRESHOLD = 0.3  # of white, as in `frame_checks.measure_drift`


def round_to_refresh_s(exposure_s: float, refresh_s: float | None, ranges_s: Iterable[tuple[float, float]]) -> float:
    """Round an exposure to whole refresh periods, at least one, within the ranges of all cameras if possible.

    The light of a video projector is constant only over whole periods, which average out colour wheel, dithering and
    scan-out. refresh_s : None returns the exposure unchanged.

    >>> round_to_refresh_s(0.02, 1 / 60, []), round_to_refresh_s(0.005, 0.01, []), round_to_refresh_s(0.005, None, [])
    (0.016666666666666666, 0.01, 0.005)
    >>> round_to_refresh_s(0.0317, 1 / 60, [(0.001, 0.0317)])
    0.016666666666666666
    """
    if refresh_s is None:
        return exposure_s
    least, most = 1, round(exposure_s / refresh_s)
    for low_s, high_s in ranges_s:
        least = max(least, math.ceil(low_s / refresh_s - _PERIOD_TOLERANCE))
        most = min(most, math.floor(high_s / refresh_s + _PERIOD_TOLERANCE))
    return max(least, most) * refresh_s


class ExposureFault(StrEnum):
    """Reason why an exposure is unusable for a camera."""

    TOO_DARK = "too dark"
    TOO_BRIGHT = "too bright"


@dataclass(frozen=True, slots=True)
class ExposureVerdict:
    """Fault of an exposure, with a description."""

    fault: ExposureFault
    description: str


def judge_exposure(white: Pixels, black: Pixels, form: CameraFormat) -> ExposureVerdict | None:
    """Check an exposure by its white and black frames; None unless it has too much or too little light.

    Too bright: 90 % of the lit pixels, or half of the black frame, are saturated. Too dark: nothing is lit, or the
    median contrast is below `MIN_CONTRAST_TO_NOISE`.
    """
    sampler, near_saturation = Sampler.from_size(form.size), NEAR_SATURATION * form.full_scale
    white_samples, black_samples = sampler.take(white), sampler.take(black)
    contrast = white_samples - black_samples
    high, low = float(np.percentile(contrast, 99.5)), -float(np.percentile(contrast, 0.5))
    noise = max(2**0.5 * NOISE_FLOOR_DN, -float(np.percentile(contrast, 2.0)) / 2.05)
    saturated = white_samples >= near_saturation
    lit = (contrast >= max(2.0, 0.1 * high, 4 * noise)) | saturated
    white_fraction = float(np.mean(saturated[lit])) if lit.any() else 0.0
    black_fraction = float(np.mean(black_samples >= near_saturation))
    if white_fraction > _MAX_SATURATED_FRACTION or black_fraction > 0.5:
        description = (
            f"white is saturated on {white_fraction:.0%} of the area that the projector lights, black on "
            f"{black_fraction:.0%} of the image"
        )
        return ExposureVerdict(ExposureFault.TOO_BRIGHT, description)
    if low > 3 * max(high, 1.0):
        return None
    median = float(np.median(contrast[lit])) if np.count_nonzero(lit) >= _MIN_LIT_SAMPLES else max(high, 0.0)
    if np.count_nonzero(lit) < _MIN_LIT_SAMPLES or median < MIN_CONTRAST_TO_NOISE * noise:
        description = f"white is {median:.1f} DN above black, and noise is {noise:.1f} DN"
        return ExposureVerdict(ExposureFault.TOO_DARK, description)
    return None


@dataclass(frozen=True, slots=True)
class ExposureSamples:
    """One exposure of one camera at the pixels of `Sampler.from_size`. frames : samples by pattern index."""

    exposure_s: float
    frames: Mapping[int, Samples]
    noise_dn: float


def detect_movement(
    before: ExposureSamples, after: ExposureSamples, patterns: Sequence[Pattern], full_scale: int
) -> str | None:
    """Return a description of movement between two exposures, or None: each pattern, relative to white, must be the
    same.

    Compares pixels that are not saturated and clear of noise in both exposures, if there are enough.
    """
    relative, noise = [], []
    usable: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] | None = None
    for each in (before, after):
        white, black = (_first_samples(each, patterns, kind) for kind in (White(), Black()))
        if white is None or black is None:
            return None
        contrast = np.maximum(white - black, np.float32(1))
        is_clear = contrast >= max(MIN_CONTRAST_DN, MIN_CONTRAST_TO_NOISE * each.noise_dn)
        is_clear &= white < NEAR_SATURATION * full_scale
        usable = is_clear if usable is None else usable & is_clear
        relative.append({i: (frame - black) / contrast for i, frame in each.frames.items()})
        noise.append(2**0.5 * each.noise_dn / contrast)
    if usable is None or np.count_nonzero(usable) < _MIN_COMPARED_SAMPLES:
        return None
    limit = np.maximum(_MOVED_THRESHOLD, 5 * np.hypot(*noise))[usable]
    for index in sorted(relative[0].keys() & relative[1].keys()):
        moved = float(np.mean(np.abs(relative[0][index] - relative[1][index])[usable] > limit))
        if moved > _MAX_MOVED_FRACTION:
            return (
                f"{describe_pattern(index, patterns[index])} looks different at {after.exposure_s:g} s and at "
                f"{before.exposure_s:g} s on {moved:.0%} of the pixels: the object, the projector or a camera moved "
                "between the two exposures; hold them still, or ask for fewer exposures, and scan again"
            )
    return None


def _first_samples(exposure: ExposureSamples, patterns: Sequence[Pattern], kind: Pattern) -> Samples | None:
    return next((exposure.frames[i] for i in sorted(exposure.frames) if patterns[i] == kind), None)


def bracket_summary(
    parts: Sequence[tuple[float, EvidenceSummary]],
    refused: Sequence[RefusedFrame],
    faults: Sequence[str],
    patterns: Sequence[Pattern],
) -> EvidenceSummary:
    """Combine the summaries of a bracket; the best exposure determines what is verified.

    parts : exposure time and summary of each, from short to long, at least one. refused : of all exposures. faults : of
    comparisons between exposures.
    """
    best = max((part for _, part in parts), key=lambda part: (part.verified, len(part.lit)))
    drift: dict[str, float] = {}
    for _, part in parts:
        for camera, each in part.light_drift.items():
            drift[camera] = max(drift.get(camera, 0.0), each, key=abs)
    exposure_faults = [f"at {time_s:g} s, {fault}" for time_s, part in parts for fault in part.faults]
    return replace(best, light_drift=drift, faults=(*exposure_faults, *faults)).with_refused(refused, patterns)


def check_exposures(recorded: Capture, refused: Sequence[RefusedFrame] = ()) -> EvidenceSummary:
    """Verify a recorded capture as `slrig.capture.verifier.check_capture` does, a bracket by exposures."""
    groups = exposure_groups(shot.exposure_s for shot in recorded.shots)
    by_camera = {name: {groups[s.exposure_s] for s in recorded.shots if s.camera == name} for name in recorded.cameras}
    if all(len(exposures) <= 1 for exposures in by_camera.values()) or None in groups:
        return check_capture(recorded, refused)
    patterns, parts, faults = recorded.patterns, [], []
    previous: dict[str, ExposureSamples] = {}
    for exposure_s in sorted({each for each in groups.values() if each is not None}):
        shots = tuple(replace(s, exposure_s=exposure_s) for s in recorded.shots if groups[s.exposure_s] == exposure_s)
        cameras = {name: form for name, form in recorded.cameras.items() if exposure_s in by_camera[name]}
        summary = check_capture(Capture(recorded.projector, patterns, cameras, shots))
        parts.append((exposure_s, summary))
        for name, form in cameras.items():
            sampler = Sampler.from_size(form.size)
            # The first frame of a pattern counts, as in the check of each exposure.
            samples = {s.pattern: sampler.take(s.image) for s in reversed(shots) if s.camera == name}
            exposure = ExposureSamples(exposure_s, samples, summary.noise_dn.get(name, NOISE_FLOOR_DN))
            before = previous.get(name)
            fault = None if before is None else detect_movement(before, exposure, patterns, form.full_scale)
            if fault is not None:
                faults.append(f"camera '{name}', {fault}")
            previous[name] = exposure
    known = [each for each in refused if each.pattern < len(patterns)]
    return bracket_summary(parts, known, faults, patterns)

"""Exposure brackets: which exposures show the scene, whether they agree, and what they prove.

A bracket is the whole sequence once for each exposure, from short to long. Each sequence is judged by itself, so that
every frame is proven as in a scan with one exposure; the alternative, all exposures of one pattern before the next,
sets every camera anew for every frame, which takes most cameras several frames, and lets a frame of the wrong exposure
pass for one of the right. What takes longer this way, and may move meanwhile, is judged here.

Pure functions on frames and samples of frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from slrig.bundle import RefusedFrame
from slrig.capture.frame_checks import NEARLY_FULL, NOISE_FLOOR_DN, Samples, named
from slrig.capture.verifier import EvidenceSummary, Sampler, check_capture
from slrig.model import Black, CameraFormat, Capture, Pattern, Pixels, White, exposure_groups

_ROUNDED = 1e-6  # of a refresh period: a range that is stated as whole ones is
_MOST_SATURATED = 0.9  # of what is lit, as `frame_checks.lighting` has it
_LEAST_LIT = 40  # samples, as `checks` has it
LEAST_CLEAR = 12.0  # noises that white lies above black
LEAST_CLEAR_DN = 4.0  # rounding hides the shares of less
_LEAST_COMPARED = 300  # samples, as many as a band needs to be judged
_MOST_MOVED = 0.05  # of the pixels, as `frame_checks.drift_fault` has it
_MOVED = 0.3  # of white, as `frame_checks.drift` has it


def whole_refreshes_s(exposure_s: float, refresh_s: float | None, ranges_s: Iterable[tuple[float, float]]) -> float:
    """The exposure of whole refresh periods, one at least, that is nearest to what was asked and that cameras of these
    ranges can do; the nearest of one period and more where they can do none.

    A video projector's light is steady over whole ones only: a colour wheel, dithering and the scan-out of the picture
    average out in them. `refresh_s` None leaves the exposure as it is.

    >>> whole_refreshes_s(0.02, 1 / 60, []), whole_refreshes_s(0.005, 0.01, []), whole_refreshes_s(0.005, None, [])
    (0.016666666666666666, 0.01, 0.005)
    >>> whole_refreshes_s(0.0317, 1 / 60, [(0.001, 0.0317)])
    0.016666666666666666
    """
    if refresh_s is None:
        return exposure_s
    least, most = 1, round(exposure_s / refresh_s)
    for low_s, high_s in ranges_s:
        least = max(least, math.ceil(low_s / refresh_s - _ROUNDED))
        most = min(most, math.floor(high_s / refresh_s + _ROUNDED))
    return max(least, most) * refresh_s


class Unfit(StrEnum):
    """Why an exposure is of no use to a camera."""

    TOO_DARK = "too dark"
    TOO_BRIGHT = "too bright"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What white and black say of an exposure, in one word and in several."""

    unfit: Unfit
    words: str


def verdict(white: Pixels, black: Pixels, form: CameraFormat) -> Verdict | None:
    """Judge an exposure by its white and black frames; None where too much or too little light is not what is wrong.

    Too bright: all but a tenth of what the projector lights is saturated, or half of the image is under black. Too
    dark: nothing is lit, or noise hides a good part of what is.
    """
    sampler, nearly_full = Sampler.of(form.size), NEARLY_FULL * form.full_scale
    lit_frame, dark_frame = sampler.take(white), sampler.take(black)
    contrast = lit_frame - dark_frame
    high, low = float(np.percentile(contrast, 99.5)), -float(np.percentile(contrast, 0.5))
    noise = max(2**0.5 * NOISE_FLOOR_DN, -float(np.percentile(contrast, 2.0)) / 2.05)
    full = lit_frame >= nearly_full
    lit = (contrast >= max(2.0, 0.1 * high, 4 * noise)) | full
    saturated = float(np.mean(full[lit])) if lit.any() else 0.0
    under_black = float(np.mean(dark_frame >= nearly_full))
    if saturated > _MOST_SATURATED or under_black > 0.5:
        words = f"white is saturated on {saturated:.0%} of what the projector lights, black on {under_black:.0%} of all"
        return Verdict(Unfit.TOO_BRIGHT, words)
    if low > 3 * max(high, 1.0):
        return None
    clear = float(np.median(contrast[lit])) if np.count_nonzero(lit) >= _LEAST_LIT else max(high, 0.0)
    if np.count_nonzero(lit) < _LEAST_LIT or clear < LEAST_CLEAR * noise:
        words = f"white is {clear:.1f} DN above black, and noise is {noise:.1f} DN"
        return Verdict(Unfit.TOO_DARK, words)
    return None


@dataclass(frozen=True, slots=True)
class ExposedSamples:
    """One exposure of one camera at the pixels of `Sampler.of` its size: samples by index of their pattern."""

    exposure_s: float
    frames: Mapping[int, Samples]
    noise_dn: float


def movement_between(
    before: ExposedSamples, after: ExposedSamples, patterns: Sequence[Pattern], full_scale: int
) -> str | None:
    """Say whether something moved between two exposures: each pattern, as a share of white, must look the same.

    Asked where both exposures are clear of noise and neither is saturated; too few such pixels tell nothing.
    """
    relative, doubt = [], []
    usable: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] | None = None
    for each in (before, after):
        ends = [_first(each, patterns, kind) for kind in (White(), Black())]
        if ends[0] is None or ends[1] is None:
            return None
        white, black = ends[0], ends[1]
        contrast = np.maximum(white - black, np.float32(1))
        clear = (contrast >= max(LEAST_CLEAR_DN, LEAST_CLEAR * each.noise_dn)) & (white < NEARLY_FULL * full_scale)
        usable = clear if usable is None else usable & clear
        relative.append({i: (frame - black) / contrast for i, frame in each.frames.items()})
        doubt.append(2**0.5 * each.noise_dn / contrast)
    if usable is None or np.count_nonzero(usable) < _LEAST_COMPARED:
        return None
    limit = np.maximum(_MOVED, 5 * np.hypot(*doubt))[usable]
    for index in sorted(relative[0].keys() & relative[1].keys()):
        moved = float(np.mean(np.abs(relative[0][index] - relative[1][index])[usable] > limit))
        if moved > _MOST_MOVED:
            return (
                f"{named(index, patterns[index])} looks otherwise at {after.exposure_s:g} s than at "
                f"{before.exposure_s:g} s on {moved:.0%} of the pixels: the object, the projector or a camera moved "
                "between the two exposures; hold them still, or ask for fewer exposures, and scan again"
            )
    return None


def _first(exposed: ExposedSamples, patterns: Sequence[Pattern], kind: Pattern) -> Samples | None:
    return next((exposed.frames[i] for i in sorted(exposed.frames) if patterns[i] == kind), None)


def bracket_summary(
    parts: Sequence[tuple[float, EvidenceSummary]],
    refused: Sequence[RefusedFrame],
    faults: Sequence[str],
    patterns: Sequence[Pattern],
) -> EvidenceSummary:
    """Sum up the sequences of a bracket: what is verified is what its best exposure verifies.

    parts : exposure time and evidence of each, from short to long, one at least; refused : of all of them; faults :
    what they say against one another.
    """
    best = max((part for _, part in parts), key=lambda part: (part.verified, len(part.lit)))
    drift: dict[str, float] = {}
    for _, part in parts:
        for camera, each in part.light_drift.items():
            drift[camera] = max(drift.get(camera, 0.0), each, key=abs)
    told = [f"at {time_s:g} s, {fault}" for time_s, part in parts for fault in part.faults]
    return replace(best, light_drift=drift, faults=(*told, *faults)).with_refused(refused, patterns)


def check_exposures(recorded: Capture, refused: Sequence[RefusedFrame] = ()) -> EvidenceSummary:
    """Judge a recorded capture as `slrig.capture.verifier.check_capture` does, a bracket exposure by exposure."""
    alike = exposure_groups(shot.exposure_s for shot in recorded.shots)
    of_camera = {name: {alike[s.exposure_s] for s in recorded.shots if s.camera == name} for name in recorded.cameras}
    if all(len(exposures) <= 1 for exposures in of_camera.values()) or None in alike:
        return check_capture(recorded, refused)
    patterns, parts, faults = recorded.patterns, [], []
    compared: dict[str, ExposedSamples] = {}
    for exposure_s in sorted({each for each in alike.values() if each is not None}):
        shots = tuple(replace(s, exposure_s=exposure_s) for s in recorded.shots if alike[s.exposure_s] == exposure_s)
        cameras = {name: form for name, form in recorded.cameras.items() if exposure_s in of_camera[name]}
        summary = check_capture(Capture(recorded.projector, patterns, cameras, shots))
        parts.append((exposure_s, summary))
        for name, form in cameras.items():
            sampler = Sampler.of(form.size)
            # Of a pattern that was taken twice the first counts, as it does in the check of each exposure.
            samples = {s.pattern: sampler.take(s.image) for s in reversed(shots) if s.camera == name}
            exposed = ExposedSamples(exposure_s, samples, summary.noise_dn.get(name, NOISE_FLOOR_DN))
            before = compared.get(name)
            fault = None if before is None else movement_between(before, exposed, patterns, form.full_scale)
            if fault is not None:
                faults.append(f"camera '{name}', {fault}")
            compared[name] = exposed
    known = [each for each in refused if each.pattern < len(patterns)]
    return bracket_summary(parts, known, faults, patterns)

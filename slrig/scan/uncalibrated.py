"""Scans of rigs without a calibration: guesses of the devices, and the calibration that the scan itself gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from slrig.calibration import device_covariance, device_title, scale_mode
from slrig.errors import SolveRefusedError, setting
from slrig.model import UNSCALED, Calibration, Capture, SolveRecord
from slrig.reconstruction import DeviceGuess, PixelPairs, SelfCalibration, guessed_calibration, self_calibrate
from slrig.scan.plan import RigGuess, length_unit
from slrig.scan.stream import SecondAxisResult

SCALED = "self-"
"""Beginning of the solve id of a calibration by scans whose lengths are in mm."""

UNITS_PER_BASELINE = 100.0
"""Length of the baseline where nothing is known of it, in the unit of the results."""

_CONTRADICTED = 3.0  # distances from the epipolar lines of before, over their stated deviations

_USUAL_RATIO, _USUAL_SIGMA = 1.4, 0.25
"""Focal length over the width of the image, and its relative deviation, where nothing is known."""
_STATED_SIGMA = 0.03
"""Relative deviation of what pictures state: names of lenses are round, and 35 mm equivalents are whole millimetres."""


@dataclass(frozen=True, slots=True)
class ScanCalibration:
    """The calibration that a scan gave. report : its section in report.json; notes : sentences for a person."""

    calibration: Calibration
    report: Mapping[str, object]
    notes: tuple[str, ...]


def guessed_rig(outline: Capture, guess: RigGuess, stated_px: Mapping[str, float]) -> Calibration:
    """Devices as guessed, side by side, with the covariance of their lenses. stated_px : focal lengths that pictures
    state, of cameras for which the guess has none. Raises SolveRefusedError: a guess is of a camera that is not there.
    """
    unknown = sorted(set(guess.focal_px) - set(outline.cameras))
    if unknown:
        message = (
            f"{setting('focal_px')}: it names camera {', '.join(unknown)}, and the scan has "
            f"{', '.join(outline.cameras)}; correct the name"
        )
        raise SolveRefusedError(message)
    cameras = {
        name: DeviceGuess(
            form.size,
            guess.focal_px.get(name, stated_px.get(name, _USUAL_RATIO * form.size.width_px)),
            guess.focal_sigma if name in guess.focal_px else _STATED_SIGMA if name in stated_px else _USUAL_SIGMA,
        )
        for name, form in outline.cameras.items()
    }
    ratio = guess.throw_ratio
    size = outline.projector
    light = DeviceGuess(
        size, (ratio or _USUAL_RATIO) * size.width_px, _USUAL_SIGMA if ratio is None else guess.throw_sigma
    )
    calibration, covariance = guessed_calibration(cameras, light)
    # Side by side, so that columns are the first axis to be tried.
    length = guess.baseline_mm or UNITS_PER_BASELINE
    beside = {
        name: replace(device, translation_mm=np.array([-length * (1 + index), 0, 0]))
        for index, (name, device) in enumerate(calibration.cameras.items())
    }
    record = SolveRecord("guess", datetime.now(UTC).isoformat(), covariance, np.zeros((2, 3)), 0.0)
    return replace(calibration, cameras=beside, solved=record)


def calibrated_by_scan(
    folder: Path,
    guess: Calibration,
    known: RigGuess,
    seconds: Mapping[str, SecondAxisResult | None],
    stated_px: Mapping[str, float],
) -> ScanCalibration:
    """The calibration that one scan by columns and rows gives. seconds : what the second axis shows of each camera.
    stated_px : as of `guessed_rig`.

    Raises SolveRefusedError: one axis was played, or the scan leaves the shape open.
    """
    pairs = pairs_of_both_axes(folder, seconds)
    covariance = device_covariance(guess)
    length = known.baseline_mm or UNITS_PER_BASELINE
    try:
        found = self_calibrate(guess, covariance, [pairs], baseline_mm=length, most_error=known.most_error)
    except SolveRefusedError as cause:
        raise SolveRefusedError(f"{folder}: {cause}") from cause
    in_mm = known.baseline_mm is not None
    scale_sigma = known.baseline_sigma if in_mm else 0.0
    calibration = _record(found, scale_sigma, SCALED if in_mm else UNSCALED)
    unit = length_unit(known)
    focal = {name: float(change[0]) for name, change in found.changes.items()}
    report = {
        "shape_error": found.shape_error,
        "shape_error_mm": found.error_mm,
        "size_mm": found.size_mm,
        "unit": "mm" if in_mm else "baseline/100",
        "scale_sigma": scale_sigma if in_mm else None,
        "pairs": found.pairs,
        "residual_px": found.residual_px,
        "focal_changed": focal,
    }
    words = (
        f"calibrated by this scan alone: its shape is known to {found.shape_error:.2%} of its size "
        f"({found.error_mm:.2g} of {found.size_mm:.3g} {unit}, one standard deviation). "
    )
    words += (
        f"Its size is as right as the baseline that was stated ({scale_sigma:.1%}). "
        if in_mm
        else "All lengths are in hundredths of the distance from the first camera to the projector: state it "
        f"({setting('baseline_mm')}) for millimetres. "
    )
    sources = (
        f"the focal length of camera '{name}' began from what its pictures state (EXIF): {px:.0f} px, right to "
        f"{_STATED_SIGMA:.0%}. Where that is wrong, state it ({setting('focal_px')})"
        for name, px in stated_px.items()
    )
    return ScanCalibration(calibration, report, (words + "Calibrate with a board for less", *sources))


def pairs_of_both_axes(folder: Path, seconds: Mapping[str, SecondAxisResult | None]) -> dict[str, PixelPairs]:
    """The pixels that each camera and the projector share. Raises SolveRefusedError: a camera has one axis."""
    pairs = {name: each.pairs for name, each in seconds.items() if each is not None}
    if len(pairs) < len(seconds):
        message = (
            f"{folder}: expected columns and rows of every camera to calibrate by a scan, found one axis of "
            f"{', '.join(sorted(set(seconds) - set(pairs)))}; scan with {setting('rows')}"
        )
        raise SolveRefusedError(message)
    return pairs


def refined_by_pairs(prior: Calibration, scans: Sequence[Mapping[str, PixelPairs]]) -> tuple[Calibration, list[str]]:
    """A calibration improved by the pairs of scans, and its changes, a line each.

    Raises SolveRefusedError: the scans contradict the calibration, or see `self_calibrate`.
    """
    found = self_calibrate(prior, device_covariance(prior), scans, most_error=np.inf)
    if found.contradiction > _CONTRADICTED:
        message = (
            f"the scans contradict the calibration: their pixels are {found.contradiction:.1f} times as far from its "
            "epipolar lines as it states. Most likely a device was moved, refocused or zoomed since, so that there is "
            "nothing to improve: calibrate again (slrig verify with the board says how large the drift is)"
        )
        raise SolveRefusedError(message)
    names = [*prior.cameras, "projector"]
    scale_sigma = 0.0 if prior.solved is None else prior.solved.scale_sigma
    lines = [
        f"shape     known to {found.shape_error:.2%} of the scenes' size ({found.error_mm:.2g} of {found.size_mm:.3g})",
        f"pairs     {found.pairs} in {len(scans)} scans, {found.residual_px:.3f} px from their epipolar lines",
    ]
    for name in names:
        focal, x, y = found.changes[name]
        lines.append(f"{device_title(name)}: focal length {focal:+.2%}, principal point {x:+.2f}, {y:+.2f} px")
    # The covariance holds the scale already, which pairs do not touch.
    refined = _record(found, 0.0, UNSCALED if prior.solve_id.startswith(UNSCALED) else SCALED)
    if refined.solved is not None:
        refined = replace(refined, solved=replace(refined.solved, scale_sigma=scale_sigma))
    return refined, lines


def _record(found: SelfCalibration, scale_sigma: float, kind: str) -> Calibration:
    """The calibration with a record of its error. scale_sigma : relative deviation of the scale, which pairs leave
    open. kind : beginning of the record's id.
    """
    calibration = found.calibration
    mode = scale_sigma * scale_mode(calibration)
    covariance = found.covariance + np.outer(mode, mode)
    record = SolveRecord(
        f"{kind}{calibration.digest}", datetime.now(UTC).isoformat(), covariance, found.volume_mm, found.error_mm,
        scale_sigma,
    )  # fmt: skip
    return replace(calibration, solved=record)

"""From the frames of a scan to triangulated points, by the axis of light that tells most of depth.

Where both axes were played the calibration names one of them (`slrig.model.geometry`). What the frames hold may speak
for the other: the projector stands otherwise than was assumed, or the camera resolves its patterns better. Where the
first axis is weak both are tried, and the one that decodes more pixels to a smaller error is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from slrig.bundle import (
    CALIBRATION,
    BundleFiles,
    open_bundle,
    read_calibration,
    read_description,
    read_refused,
    require_two_rays,
)
from slrig.capture import Evidence, EvidenceSummary, check_exposures, checked_frames
from slrig.errors import CalibrationError, NothingToReconstructError, PatternError, setting
from slrig.model import (
    MIN_BASELINE_FRACTION,
    Axis,
    Calibration,
    CaptureHeader,
    Gray,
    Pattern,
    Region,
    Shot,
    Size,
    trim_incomplete_codes,
)
from slrig.reconstruction import exposure_count
from slrig.scan.axis_agreement import AxisAgreement, check_cameras
from slrig.scan.light_axis import FAIR_SHARE, left_out_notes, weakness
from slrig.scan.losses import FAIR_SHARE as FAIR_DECODED
from slrig.scan.losses import (
    LossStage,
    code_extent_notes,
    code_of,
    geometry_fault,
    geometry_notes,
    require_code_on_projector,
    require_surface,
)
from slrig.scan.report import capture_notes, capture_report, layout_notes, lit_pixels
from slrig.scan.stream import CameraResult, LiveScan, ScanStream, cell_px, step_px
from slrig.scan.triangulated import Triangulated, camera_notes, triangulate_cameras, unresolved_notes
from slrig.scan.usable_frames import UsableFiles, usable_files

_STAGES = ("measure noise", "decode", "locate stripes", "refine stripes", "identify stripes", "link stripes")

Entered = Callable[[str, float, str], None]
"""Told the name of a stage, how far the whole is, and a detail."""


@dataclass(frozen=True, slots=True)
class Walked:
    """What the frames told along one axis: the curves of every camera, and their part of the report.

    step_px : distance of neighbouring curves where all that was shown resolves; cell_px : of neighbouring code edges.
    gray : a bit of the axis's code; projector : the projector's extent.
    """

    devices: Calibration
    axis: Axis
    shown: frozenset[Axis]
    seen: list[CameraResult]
    step_px: float
    cell_px: float
    gray: Gray
    projector: Size
    sections: dict[str, object]
    notes: list[str]
    agreement: AxisAgreement


def measured(
    folder: Path,
    calibration_file: Path | None,
    live: LiveScan | None,
    entered: Entered,
    *,
    axis: Axis | None,
    region: Region | None = None,
    judged: EvidenceSummary | None = None,
    drop_finest_bits: int = 0,
) -> tuple[Walked, Triangulated]:
    """The points of a recorded bundle: of the frames that came while it was captured, or else of its files.

    axis : the one that was asked for; None for that which tells most of depth. region : what of the scene is asked for.
    judged : what the frames proved as they were captured; without it, files of one exposure are judged again.
    drop_finest_bits : as in `slrig.scan.plan.ReconstructionPlan`.

    Raises
    ------
    BundleError, CalibrationError, PatternError
        The bundle cannot be used as it is.
    NothingToReconstructError
        No pixel could be decoded, no stripe be found, or the light tells no depth.
    """
    walk = partial(
        _walked, folder, calibration_file, entered=entered, region=region, judged=judged,
        drop_finest_bits=drop_finest_bits,
    )  # fmt: skip
    walked = walk(live, axis=axis)
    tries = [_tried(walked, folder, entered, region)]
    others = walked.shown - {walked.axis} if axis is None else frozenset()
    for other in others:
        if _is_weak(tries[0]):
            again = walk(None, axis=other)
            tries.append(_tried(again, folder, entered, region))
    sound = [each for each in tries if not isinstance(each, NothingToReconstructError)]
    if not sound:
        raise next(each for each in tries if isinstance(each, NothingToReconstructError))
    best, found = max(sound, key=lambda each: _depth_known(*each)) if len(sound) > 1 else sound[0]
    best.notes.extend(_chosen_notes(walked, best, found))
    best.notes.extend(left_out_notes(best.axis, {seen.name: seen.device for seen in best.seen}, best.devices.projector))
    words = weakness(best.axis, best.shown, found.baseline_sine, on_request=axis is not None)
    if words is not None:
        if found.baseline_sine < MIN_BASELINE_FRACTION:
            if isinstance(tries[0], NothingToReconstructError):
                raise tries[0]
            message = f"{folder}: {words}"
            raise NothingToReconstructError(message)
        best.notes.append(words)
    return replace(best, seen=found.cameras), found


def _tried(
    walked: Walked, folder: Path, entered: Entered, region: Region | None
) -> tuple[Walked, Triangulated] | NothingToReconstructError:
    """The points along one axis, or why there are none."""
    seen = walked.seen
    try:
        require_surface(any(each.curves.decoded_pixels > 0 for each in seen), folder, "no pixel could be decoded", seen)
        require_code_on_projector(folder, seen, walked.gray, walked.projector)
        require_surface(any(each.curves.stripe_count > 0 for each in seen), folder, "no stripe was found", seen)
        entered("compare axes", 0.58, "")
        projector = walked.devices.projector
        agreeing, agreement = check_cameras(folder, seen, projector, walked.axis)
        walked = replace(walked, seen=agreeing, agreement=agreement, notes=[*walked.notes, *agreement.notes])
        entered("triangulate", 0.6, "")
        found = triangulate_cameras(agreeing, walked.devices, walked.axis, region, checks=agreement.checks)
        fault = geometry_fault(found.cameras, agreeing, projector, walked.axis)
        require_surface(fault is None, folder, str(fault), found.cameras, stage=LossStage.GEOMETRY)
    except NothingToReconstructError as error:
        return error
    walked.notes[:0] = [*code_extent_notes(seen, walked.gray, walked.projector), *geometry_notes(found.cameras)]
    return walked, found


def _is_weak(tried: tuple[Walked, Triangulated] | NothingToReconstructError) -> bool:
    """Whether the other axis, if it was played, may tell more."""
    if isinstance(tried, NothingToReconstructError):
        return True
    walked, found = tried
    return found.baseline_sine < FAIR_SHARE or _decoded_share(walked.seen) < FAIR_DECODED


def _decoded_share(cameras: Sequence[CameraResult]) -> float:
    """Of the pixels that are lit."""
    lit = sum(np.count_nonzero(lit_pixels(seen.curves)) for seen in cameras)
    return _decoded(cameras) / max(lit, 1)


def _decoded(cameras: Sequence[CameraResult]) -> float:
    """Number of decoded pixels. Each bit that a pixel leaves out, more than the best tenth of them, halves its part."""
    total = 0.0
    for curves in (seen.curves for seen in cameras):
        left_out = np.zeros(1) if curves.unresolved is None else curves.unresolved[lit_pixels(curves)]
        if left_out.size:
            finest = np.percentile(left_out, 10)
            total += curves.decoded_pixels * float(np.exp2(np.minimum(finest - left_out, 0)).mean())
    return total


def _depth_known(walked: Walked, found: Triangulated) -> float:
    """The square of the decoded pixels over the usual standard deviation of a point: half of a surface is worth the
    whole only where it is four times as precise. Coarse bits alone are precise, too.
    """
    deviation_mm = found.merged.curves.deviation_mm
    if len(deviation_mm) == 0:
        return 0.0
    usual_mm = float(np.median(np.linalg.norm(deviation_mm, axis=1)))
    return _decoded(walked.seen) ** 2 / usual_mm


def _chosen_notes(first: Walked, best: Walked, found: Triangulated) -> list[str]:
    """What to say where the calibration with a projector had named another axis than the one that is used."""
    if best.axis is first.axis or best.devices.projector is None:
        return []
    usual_mm = float(np.median(np.linalg.norm(found.merged.curves.deviation_mm, axis=1)))
    return [
        f"triangulated by {best.axis}s, which decode {_decoded_share(best.seen):.0%} of what is lit ({usual_mm:.3g} mm "
        f"of noise): the {first.axis}s, which cross the baseline more steeply, decode {_decoded_share(first.seen):.0%}"
    ]


def _require_calibration(folder: Path, names: list[str], found: Calibration | None) -> Calibration:
    if found is None:
        message = (
            f"{folder}: no calibration.json beside the frames, and without one nothing can be measured; "
            f"calibrate the rig, put one there, or name a file with {setting('calibration')}"
        )
        raise CalibrationError(message)
    missing = [name for name in names if name not in found.cameras]
    if missing:
        message = (
            f"{folder}: the calibration knows cameras {sorted(found.cameras)}, the frames are of {names}; "
            f"calibrate {missing}, or use the names of the calibration"
        )
        raise CalibrationError(message)
    require_two_rays(found, names, str(folder))
    return found


def _walked(
    folder: Path,
    calibration_file: Path | None,
    live: LiveScan | None,
    *,
    entered: Entered,
    axis: Axis | None,
    region: Region | None,
    judged: EvidenceSummary | None,
    drop_finest_bits: int,
) -> Walked:
    """Frames to curves: those that came while the scan was captured, or else those of the bundle, along `axis`."""
    names: list[str] = []
    cut_short: tuple[str, ...] = ()
    not_used: str | None = None
    last, share = "", 0.0

    def stage_entered(stage: str, name: str) -> None:
        nonlocal last, share
        if last != stage + name:
            last = stage + name
            if stage in _STAGES:
                # Stripes may be located before the code is read.
                share = max(share, (names.index(name) + _STAGES.index(stage) / len(_STAGES)) / len(names))
            entered(stage, 0.1 + 0.5 * share, f"camera '{name}'")

    if (
        live is not None
        and live.evidence is not None
        and live.one_exposure
        and axis in (None, live.axis)
        and live.region == region
        and drop_finest_bits == 0
        and _is_of(live, folder, calibration_file)
    ):
        names += live.header.cameras
        devices, evidence = live.calibration, live.evidence
        stream: ScanStream = live
        _require_calibration(folder, names, devices)
        usable = _usable(folder, open_bundle(folder, calibration_file=calibration_file), evidence)
        if usable is None:
            seen = live.finished(stage_entered)
    else:
        files = open_bundle(folder, calibration_file=calibration_file)
        names += files.outline.cameras
        devices = _require_calibration(folder, names, files.calibration)
        try:
            stream, evidence, cut_short = _streamed(
                files, devices, stage_entered, axis, region, judged, drop_finest_bits
            )
            usable = _usable(folder, files, evidence)
            if usable is None:
                seen = stream.finish()
        except PatternError as cause:
            message = f"{folder}: {cause}"
            raise PatternError(message) from cause
    if usable is not None:
        try:
            stream, _, shortened = _streamed(
                usable, devices, stage_entered, stream.axis, region, evidence, drop_finest_bits
            )
            seen, not_used, cut_short = stream.finish(), "; ".join(filter(None, [usable.note, *shortened])) or None, ()
        except PatternError as cause:
            message = f"{folder}: {'; '.join(evidence.faults)}; {usable.note}. {cause}"
            raise PatternError(message) from cause
    wrong = {getattr(pattern, "axis", None) for pattern in _wrong_patterns(folder, evidence)}
    if wrong - {None, stream.axis}:
        # Frames of the other axis that show something else prove nothing against the calibration.
        seen = [replace(each, second=None) for each in seen]
    sections = capture_report(stream.header, stream.axis, evidence)
    step, cell = (each(stream.header.displayed_patterns, stream.axis) for each in (step_px, cell_px))
    notes = [
        *cut_short,
        *layout_notes(devices),
        *capture_notes(
            stream.header, stream.axis, evidence, not_used, is_evened=usable is not None and bool(usable.evened)
        ),
        *camera_notes(seen),
        *unresolved_notes(seen, step, cell, dropped=drop_finest_bits),
    ]
    agreement = AxisAgreement(stream.axis, {})
    gray = code_of(stream.header.displayed_patterns, stream.axis)
    projector = stream.header.projector
    return Walked(
        devices, stream.axis, stream.header.axes, seen, step, cell, gray, projector, sections, notes, agreement
    )


def _wrong_patterns(folder: Path, evidence: EvidenceSummary) -> set[Pattern]:
    """Patterns of a bundle of which a frame is proven wrong."""
    indices = {index for each in evidence.wrong.values() for index in each}
    patterns = read_description(folder).pattern_list() if indices else ()
    return {patterns[index] for index in indices}


def _usable(folder: Path, files: BundleFiles, evidence: EvidenceSummary) -> UsableFiles | None:
    """The bundle without frames that are proven wrong; None if all are of use. Raises
    NothingToReconstructError: the frames do not come in the order of their patterns.
    """
    if evidence.misordered is not None:
        message = f"{folder}: {evidence.misordered}; nothing is measured from frames of other patterns"
        raise NothingToReconstructError(message)
    return usable_files(files, evidence, None)


def _streamed(
    files: BundleFiles | UsableFiles,
    devices: Calibration,
    entered: Callable[[str, str], None],
    axis: Axis | None,
    region: Region | None,
    proven: EvidenceSummary | None,
    drop_finest_bits: int,
) -> tuple[ScanStream, EvidenceSummary, tuple[str, ...]]:
    """The frames of a bundle in a stream, what they prove, and words for each code that was cut short.

    Frames are read one after another, so that memory holds only those that are needed. Brackets, and frames that a
    missing bit gives other patterns, are read first. proven : what the frames proved as they were captured.
    """
    refused = read_refused(files.folder)
    capture, cut_short = trim_incomplete_codes(files.outline)
    exposures = [{shot.exposure_s for shot in capture.shots if shot.camera == name} for name in capture.cameras]
    one_exposure = all(exposure_count(each) <= 1 for each in exposures)
    judged = checked_frames(capture)
    others = sorted(set(range(len(capture.shots))) - set(judged))
    order = [i for name in capture.cameras for i in (*judged, *others) if capture.shots[i].camera == name]
    if cut_short or not one_exposure:
        every = tuple(files.shots(range(len(files.outline.shots))))
        capture, _ = trim_incomplete_codes(replace(files.outline, shots=every))
        shots: Iterable[Shot] = [capture.shots[index] for index in order]
        proven = None  # of other patterns, or of each exposure by itself
    else:
        shots = files.shots(order)
    stream = ScanStream(
        CaptureHeader.from_capture(capture),
        devices,
        entered=entered,
        axis=axis,
        one_exposure=one_exposure,
        region=region,
        drop_finest_bits=drop_finest_bits,
    )
    evidence = Evidence(capture.patterns, capture.cameras, refused, projector=capture.projector)
    for index, shot in zip(order, shots, strict=True):
        stream.take(shot)
        if proven is None and one_exposure and index in judged:
            entered("check frames", shot.camera)
            evidence.add_shot(shot)
        entered("read bundle", shot.camera)
    if proven is None:
        proven = evidence.summary() if one_exposure else check_exposures(capture, refused)
    return stream, proven, cut_short


def _is_of(live: LiveScan, folder: Path, calibration_file: Path | None) -> bool:
    """Whether the frames taken live are those that the bundle lists, for the calibration that it is measured by."""
    description = read_description(folder)
    listed = CaptureHeader(
        description.projector_size(), description.pattern_list(), description.camera_formats(),
        tuple((frame.pattern, frame.camera) for frame in description.frames),
    )  # fmt: skip
    path = folder / CALIBRATION if calibration_file is None else calibration_file
    return live.taken == listed and path.exists() and read_calibration(path).digest == live.calibration.digest

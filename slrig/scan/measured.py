"""From the frames of a scan to triangulated points, by the axis of light that tells most of depth.

Where both axes were played the calibration names one of them (`slrig.model.geometry`). What the frames hold may speak
for the other: the projector stands otherwise than was assumed, or the camera resolves its patterns better. Where the
first axis is weak both are tried, and the one that decodes more pixels to a smaller error is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

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
from slrig.meshing import runs_of_curve_parts
from slrig.model import (
    MIN_BASELINE_FRACTION,
    Axis,
    Calibration,
    CaptureHeader,
    FloatArray,
    Gray,
    IntArray,
    Pattern,
    Pinhole,
    Refusal,
    Region,
    Shot,
    Size,
    baseline_fraction,
    depth_sensitive_cameras,
    trim_incomplete_codes,
)
from slrig.reconstruction import (
    CalibrationCheck,
    CameraCurves,
    MergedCurves,
    PixelPairs,
    SheetCurves,
    SinusoidResponse,
    calibration_modes,
    calibration_sigma,
    evaluate_redundancy,
    exposure_count,
    merge_curves,
    select_points,
    stripe_crossing,
    stripe_tangents,
    triangulate_camera_pair,
    triangulate_camera_pairs,
    triangulate_camera_projector,
)
from slrig.scan.agreement import (
    Agreement,
    AxisAgreement,
    check_agreement,
    check_cameras,
    drop_contradicting_areas,
    leave_out_contradicted,
)
from slrig.scan.losses import FAIR_SHARE as FAIR_DECODED
from slrig.scan.losses import (
    NO_MIRROR_IMAGES,
    LossStage,
    MirrorImages,
    code_extent_notes,
    code_of,
    geometry_fault,
    geometry_notes,
    refuse_mirror_images,
    require_code_on_projector,
    require_surface,
)
from slrig.scan.plan import FAIR_SHARE, RigGuess, left_out_notes, weakness
from slrig.scan.preparation import UsableFiles, usable_files
from slrig.scan.report import capture_notes, capture_report, layout_notes, lit_pixels, lit_share
from slrig.scan.stream import CameraResult, LiveScan, ScanStream, cell_px, limited, step_px
from slrig.scan.uncalibrated import calibrated_by_scan, guessed_rig, pairs_of_both_axes, refined_by_pairs

_WIDEST_GAP_PX = 4.0
_WIDEST_GAP_STEPS = 2.5  # of the usual distance of two points along a curve
_STEEP_ENOUGH = 0.5  # of the pair whose stripes cross its epipolar lines most steeply: errors twice its at most
_MANY_ALONE = 0.4  # of one camera's points, that the other should see if calibration and overlap are right


@dataclass(frozen=True, slots=True)
class Triangulated:
    """Points of all cameras in the world.

    merged : the points. cameras : without stripes, and with the points that were left out in their maps of causes;
    their devices are those of the calibration of `agreement`. baseline_sine : 0 to 1, the sine of the angle between the
    stripes and the baseline: by the calibration, or without a projector as the median over the image. agreement : what
    the cameras say of the calibration, and the devices that the points were made with. notes : sentences for a person.
    second : index of the camera that most points of the first are paired with, without a projector. mirror_images :
    those of several cameras, which were left out before their points were merged. widest_gap_px : of the function of
    that name.
    """

    merged: MergedCurves
    cameras: list[CameraResult]
    baseline_sine: float
    agreement: Agreement
    notes: tuple[str, ...]
    second: int = 1
    mirror_images: MirrorImages = NO_MIRROR_IMAGES
    widest_gap_px: float = _WIDEST_GAP_PX


def triangulate_cameras(
    cameras: list[CameraResult],
    calibration: Calibration,
    axis: Axis,
    region: Region | None = None,
    *,
    checks: Mapping[str, CalibrationCheck | None] | None = None,
) -> Triangulated:
    """Triangulate the curves of an axis; without a projector, of at least two cameras.

    region : part of the scene that is used. checks : what the second axis of patterns shows of each camera.

    With a projector, a camera is left out whose baseline lies along the stripes: it sees the light sheets edge on.
    Cameras that contradict each other are not merged, see `slrig.scan.agreement`.

    Without a projector the points are those of the first camera, since the light sheet has no rows to merge several by:
    each is met with one of the cameras whose stripes cross the epipolar lines steeply.

    Raises
    ------
    CalibrationError
        The cameras refute the calibration, and nothing shows which one is right.
    """
    projector = calibration.projector
    if projector is None:
        return _triangulate_pair(cameras, calibration, axis, region)
    names = [camera.name for camera in cameras]
    checks = checks or {}
    second_axis = {name: np.inf if each.is_significant else 1.0 for name, each in checks.items() if each is not None}
    parts, marked, images = _triangulate_sheets(cameras, projector, axis, region, checks)
    gap = widest_gap_px(projector, axis, parts)
    stripes = [camera.curves.ensemble for camera in cameras]
    agreement = check_agreement(
        names, stripes, parts, calibration, projector, axis, widest_gap_px=gap, second_axis=second_axis or None
    )
    redundancy = agreement.redundancy
    if agreement.calibration is not calibration:
        projector = agreement.calibration.projector or projector
        cameras = [replace(camera, device=agreement.calibration.cameras[camera.name]) for camera in cameras]
        parts, marked, images = _triangulate_sheets(cameras, projector, axis, region, checks)
        redundancy = evaluate_redundancy(
            parts, {camera.name: camera.device for camera in cameras}, axis, widest_gap_px=gap, calibration=calibration
        )
    used, area_notes = drop_contradicting_areas(names, parts, redundancy, agreement.usable)
    for index, points in enumerate(used):
        if not points.all():
            marked[index] = _with_cause(marked[index], parts[index].pixels_px, points)
            parts[index] = select_points(parts[index], points)
    return Triangulated(
        merge_curves(parts, projector.centre_mm, widest_gap_px=gap),
        _without_points(marked),
        baseline_fraction(axis, [camera.device for camera in cameras], projector),
        agreement,
        (*agreement.notes, *area_notes),
        mirror_images=images,
        widest_gap_px=gap,
    )


def _triangulate_sheets(
    cameras: Sequence[CameraResult],
    projector: Pinhole,
    axis: Axis,
    region: Region | None,
    checks: Mapping[str, CalibrationCheck | None],
) -> tuple[list[SheetCurves], list[CameraResult], MirrorImages]:
    """Points of each camera on the light sheets, the cameras with the other points in their maps of causes, and the
    mirror images of several cameras.
    """
    parts, marked = [], []
    sensitive = depth_sensitive_cameras(axis, [camera.device for camera in cameras], projector)
    for camera, measures_depth in zip(cameras, sensitive, strict=True):
        part, cause = triangulate_camera_projector(camera.curves.ensemble, camera.device, projector, axis)
        if not measures_depth:
            part = select_points(part, np.zeros(len(part.points_mm), dtype=np.bool_))
            cause = np.where(cause == Refusal.NONE, np.uint8(Refusal.SHEET_SEEN_ALONG), cause)
        refusal = _with_left_out(camera.curves, part, cause)
        if region is not None:
            part, refusal, _ = limited(region, part, refusal, camera.device)
        camera, part = leave_out_contradicted(
            replace(camera, curves=replace(camera.curves, refusal=refusal)), part, projector, axis,
            checks.get(camera.name),
        )  # fmt: skip
        parts.append(part)
        marked.append(camera)
    if len(parts) == 1:
        return parts, marked, NO_MIRROR_IMAGES
    return refuse_mirror_images(parts, marked, projector, axis)


def _triangulate_pair(
    cameras: Sequence[CameraResult], calibration: Calibration, axis: Axis, region: Region | None
) -> Triangulated:
    """Points of the first camera, each with one of those that it is paired with, without a projector."""
    first, *others = cameras
    stripes = first.curves.ensemble
    crossing = [stripe_crossing(stripes, first.device, other.device) for other in others]
    steep = [index for index, sine in enumerate(crossing) if sine >= _STEEP_ENOUGH * max(crossing)]
    paired = [others[index] for index in steep]
    points, partner, matched = triangulate_camera_pairs(
        stripes, first.device, [(other.curves.ensemble, other.device) for other in paired]
    )
    partner = np.array(steep, dtype=np.int32)[partner] + 1
    marked = [_with_cause(first, stripes.points_px, matched)]
    for index, other in enumerate(others):
        ensemble = other.curves.ensemble
        is_matched = np.zeros(len(ensemble.points_px), dtype=np.bool_)
        if index in steep:
            _, is_matched = triangulate_camera_pair(ensemble, stripes, other.device, first.device)
        marked.append(_with_cause(other, ensemble.points_px, is_matched))
    if region is not None:
        points, refusal, kept = limited(region, points, marked[0].curves.refusal, first.device)
        partner = partner[kept]
        marked[0] = replace(marked[0], curves=replace(marked[0].curves, refusal=refusal))
    second = int(np.bincount(partner).argmax()) if len(partner) else steep[0] + 1
    gap, none = widest_gap_px(None, axis, [points]), np.zeros(0)
    devices = {camera.name: camera.device for camera in cameras}
    redundancy = evaluate_redundancy([points], devices, axis, widest_gap_px=gap)
    notes, names = [], " or ".join(f"'{other.name}'" for other in paired)
    if len(matched) and (alone := 1 - float(matched.mean())) > _MANY_ALONE:
        notes.append(
            f"{alone:.0%} of the points of camera '{first.name}' have no partner in camera {names}: the "
            "cameras see too little of the same surface, or their calibration is wrong (verify it: slrig verify)"
        )
    return Triangulated(
        MergedCurves(points, np.zeros(len(partner), dtype=np.int32), 1 | (1 << partner.astype(np.int64)), none, none),
        _without_points(marked),
        crossing[second - 1],
        Agreement(calibration, (True,) * len(cameras), redundancy),
        tuple(notes),
        second,
        widest_gap_px=gap,
    )


def _without_points(cameras: Sequence[CameraResult]) -> list[CameraResult]:
    return [
        replace(camera, curves=replace(camera.curves, ensemble=camera.curves.ensemble.without_points()))
        for camera in cameras
    ]


def widest_gap_px(projector: Pinhole | None, axis: Axis, parts: Sequence[SheetCurves]) -> float:
    """Steps along a light sheet between two points of one camera up to which the curve between them counts as measured;
    without a projector, camera pixels.

    Where the projector is addressed more finely along the sheet than across it, or than a camera resolves, a pixel of
    the camera covers more of them.
    """
    widest = _WIDEST_GAP_PX
    if projector is not None:
        across, along = (0, 1) if axis is Axis.COLUMN else (1, 0)
        widest *= max(1.0, float(projector.matrix[along, along] / projector.matrix[across, across]))
    usual = [float(np.median(np.abs(np.diff(part.along_px)))) for part in parts if len(part.along_px) > 1]
    return max([widest, *(_WIDEST_GAP_STEPS * each for each in usual)])


def disagreement_sigma_mm(found: Triangulated, normals: NDArray[np.float32], axis: Axis) -> FloatArray | None:
    """(n,) float64: standard deviation of each point by what the cameras show beyond what is stated; None for nothing.

    normals : (n, 3) of the points.
    """
    agreement = found.agreement
    if agreement.pose_error is None:
        return np.full(len(normals), agreement.distance_mm) if agreement.distance_mm else None
    pose_mm = calibration_sigma_mm(found, agreement.pose_error, normals, axis)
    return None if pose_mm is None else np.hypot(pose_mm, agreement.distance_mm)


def calibration_sigma_mm(
    found: Triangulated, calibration: Calibration, normals: NDArray[np.float32], axis: Axis
) -> FloatArray | None:
    """(n,) float64: the calibration's part of the standard deviation of each point; None if it states no error."""
    modes = calibration_modes(calibration, [camera.name for camera in found.cameras], axis, second=found.second)
    if modes is None:
        return None
    merged, points = found.merged, found.merged.curves
    tangents = stripe_tangents(points.points_mm, points.offsets, points.bridge_after)
    return calibration_sigma(modes, points.points_mm, normals, points.source, merged.camera, merged.seen_by, tangents)


def _with_left_out(curves: CameraCurves, triangulated: SheetCurves, cause: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The map of causes with the points that triangulation left out, where no other point is in the same pixel.

    cause : (n,) uint8, `Refusal` of every point of the ensemble.
    """
    left_out = np.flatnonzero(cause != Refusal.NONE)
    if len(left_out) == 0:
        return curves.refusal
    stays = np.zeros(curves.refusal.shape, dtype=bool)
    columns, rows = np.rint(triangulated.pixels_px).astype(int).T
    stays[rows, columns] = True
    columns, rows = np.rint(curves.ensemble.points_px[left_out]).astype(int).T
    off = ~stays[rows, columns]
    refusal = curves.refusal.copy()
    refusal[rows[off], columns[off]] = cause[left_out][off]
    return refusal


def _with_cause(camera: CameraResult, pixels_px: FloatArray, used: NDArray[np.bool_]) -> CameraResult:
    """The camera with its measured pixels marked whose nearest point, (n, 2), is not `used`, (n,) bool."""
    if used.all():
        return camera
    nearest = np.ones(camera.curves.refusal.shape, dtype=np.uint8)
    is_used = np.zeros(nearest.shape, dtype=np.bool_)
    columns, rows = np.rint(pixels_px).astype(int).T
    nearest[rows, columns] = 0
    is_used[rows[used], columns[used]] = True
    _, labels = cv2.distanceTransformWithLabels(nearest, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    used_label = np.zeros(int(labels.max()) + 1, dtype=np.bool_)
    used_label[labels[is_used]] = True
    refusal = camera.curves.refusal.copy()
    refusal[(refusal == Refusal.NONE) & ~used_label[labels]] = Refusal.ONE_CAMERA_ONLY
    return replace(camera, curves=replace(camera.curves, refusal=refusal))


_MIN_UNRESOLVED = 0.02  # of what is lit
_NOTED_GAMMA, _NOTED_MISFIT = 0.1, 0.02
_WIDEST_BRIDGES = 2.5
"""Of the gaps up to which a curve counts as measured: what strips still bridge at the usual limit of a depth edge."""


@dataclass(frozen=True, slots=True)
class CurveSpacing:
    """at_points_px : (n,) float64, distance of neighbouring curves at each point, or one for all, projector px; runs :
    the parts of curves to be joined to strips, None for whole curves.
    """

    at_points_px: FloatArray | float
    runs: IntArray | None


def curve_spacing(
    cameras: Sequence[CameraResult],
    merged: MergedCurves,
    step_px: float,
    cell_px: float,
    *,
    max_gap: int,
    widest_gap_px: float,
) -> CurveSpacing:
    """Distance between curves, and which of them are neighbours.

    step_px : distance of curves where every pattern resolves. cell_px : width of a cell of the code. max_gap : largest
    distance of neighbours, in steps. widest_gap_px : as `widest_gap_px` returns it.
    """
    maps = [_spacing_px(camera.curves, step_px, cell_px) for camera in cameras]
    if all(each is None for each in maps):
        return CurveSpacing(step_px, None)
    curves = merged.curves
    columns, rows = np.rint(curves.pixels_px).astype(int).T
    at_points = np.full(len(rows), step_px)
    for index, each in enumerate(maps):
        own = merged.camera == index
        if each is not None:
            at_points[own] = each[rows[own], columns[own]]
    # A curve may have a neighbour that another camera does not resolve.
    widest_px = max(float(each.max()) for each in maps if each is not None)
    runs = runs_of_curve_parts(
        curves.position_px, curves.offsets, curves.along_px,
        widest_step_px=max(step_px * max_gap, widest_px), widest_gap_px=_WIDEST_BRIDGES * widest_gap_px,
    )  # fmt: skip
    return CurveSpacing(at_points, runs)


def _spacing_px(curves: CameraCurves, step_px: float, cell_px: float) -> NDArray[np.float32] | None:
    """(H, W): distance of neighbouring curves at each pixel, projector px; None if every pattern resolves."""
    if curves.unresolved is None:
        return None
    edges_px = np.float32(cell_px) * np.exp2(curves.unresolved, dtype=np.float32)
    if curves.unresolved_lines is not None:
        return np.where(curves.unresolved_lines, edges_px, np.float32(step_px))
    return edges_px if curves.unresolved.any() else None


def camera_notes(cameras: Sequence[CameraResult]) -> list[str]:
    """Sentences on each camera whose frames are clipped, compressed, not linear, or not alike."""
    notes = []
    for camera in cameras:
        share = camera.curves.clipped_white / max(int(np.count_nonzero(lit_pixels(camera.curves))), 1)
        if share >= _MIN_UNRESOLVED:
            notes.append(
                f"camera '{camera.name}': white is clipped at full scale ({camera.curves.full_scale:.0f}) on "
                f"{share:.0%} of what is lit. Shifted lines give no points there, and edges of the code are less exact "
                "(σ contains this). Expose shorter, lower the gain, or take several exposures"
            )
        apart_px = np.abs(camera.curves.disagreement_px)
        if not camera.curves.refined and np.isfinite(apart_px).any():
            notes.append(
                f"camera '{camera.name}': lines of single frames lie up to {np.nanmax(apart_px):.2f} px beside where "
                "all frames put them, so each frame counts by itself, and σ contains this. Keep object and rig still, "
                "lock exposure and gain, and show patterns pixel for pixel in the projector's own resolution"
            )
        if camera.curves.bits_displaced_px.any():
            notes.append(
                f"camera '{camera.name}': edges of the code's finest bits lie up to "
                f"{camera.curves.bits_displaced_px.max():.2f} px (median where they do) beside those of the others, "
                "and σ contains this. Light spreads to one side (a translucent object, a decentred lens), or something "
                "moved between two frames. What displaces all bits alike does not show: play shifted "
                "lines or sinusoids, too, wider cells, or both axes"
            )
        if camera.curves.compression_dn > 0:
            notes.append(
                f"camera '{camera.name}': its frames were compressed as JPEG, which errs by as much as "
                f"{camera.curves.compression_dn:.1f} grey levels of noise in every pixel would: take frames without "
                "compression (GREY, YUYV; PNG, TIFF or BMP files) for a finer surface"
            )
        if camera.curves.gamma != 1:
            notes.append(
                f"camera '{camera.name}': its values are made for a display (gamma {camera.curves.gamma:.1f}), as "
                "edges of the code show; they were made proportional to light again. Switch its gamma correction off "
                "to keep the levels that it costs"
            )
        if camera.curves.sinusoids is not None:
            notes += _sinusoid_notes(camera.name, camera.curves.sinusoids)
    return notes


def _sinusoid_notes(camera: str, response: SinusoidResponse) -> list[str]:
    """Sentences on light that does not follow the values of the sinusoids."""
    notes = []
    if np.isnan(response.gamma):
        notes.append(
            f"camera '{camera}': nothing in the frames shows whether light follows the values of the sinusoids (three "
            "shifts of one period without white and black, or too little light): σ holds noise only, and a gamma of "
            "the projector bends the surface. Add white and black, a fourth shift or another period; or be sure that "
            "the projector is linear"
        )
    elif abs(response.gamma - 1) >= _NOTED_GAMMA:
        notes.append(
            f"camera '{camera}': light follows the values of the sinusoids to the power of {response.gamma:.2f}, by "
            "gamma of projector or camera. Positions are corrected for it; without gamma they have less noise"
        )
    if response.misfit >= _NOTED_MISFIT:
        notes.append(
            f"camera '{camera}': frames of sinusoids are {response.misfit:.1%} of their modulation beside what all "
            "frames together say, and σ contains this: light that changed between frames, surfaces that light each "
            "other, or a projector whose light is no power of its values. Lock the exposure, keep object and rig still"
        )
    return notes


def unresolved_notes(cameras: Sequence[CameraResult], step_px: float, cell_px: float, *, dropped: int = 0) -> list[str]:
    """One sentence for each camera that does not resolve the finest patterns on a part of what is lit, and one for
    finest bits that were dropped by hand.
    """
    notes = []
    for camera in cameras:
        share = lit_share(camera.curves, camera.curves.unresolved_lines)
        if share >= _MIN_UNRESOLVED:
            notes.append(
                f"camera '{camera.name}' does not resolve the shifted lines on {share:.0%} of what is lit: the edges "
                f"of the code stand for them there, every {cell_px:g} projector pixels or wider instead of every "
                f"{step_px:g}. Look at focus and resolution, or play lines further apart: "
                f"{setting('line_shift_period_px')}"
            )
        elif camera.curves.unresolved is not None and camera.curves.unresolved_lines is None:
            share = lit_share(camera.curves, camera.curves.unresolved > dropped)
            if share >= _MIN_UNRESOLVED:
                here = lit_pixels(camera.curves) & (camera.curves.unresolved > dropped)
                bits = int(np.median(camera.curves.unresolved[here]))
                which, them = ("finest Gray bit", "it is") if bits == 1 else (f"{bits} finest Gray bits", "they are")
                notes.append(
                    f"camera '{camera.name}' does not resolve the {which} on {share:.0%} of what is lit: "
                    f"{them} left out there, and the surface is sampled every {2**bits * step_px:g} projector pixels "
                    f"or wider. Look at focus and resolution, or play wider cells: {setting('gray_cell_px')}"
                )
    if dropped and any(camera.curves.unresolved is not None for camera in cameras):
        notes.append(
            f"the {dropped} finest bits of the code were not read, as {setting('drop_finest_bits')} asks: points lie "
            f"every {2**dropped * cell_px:g} projector pixels or wider where the code gives them"
        )
    return notes


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
    uncalibrated: RigGuess | None = None,
) -> tuple[Walked, Triangulated]:
    """The points of a recorded bundle: of the frames that came while it was captured, or else of its files.

    axis : the one that was asked for; None for that which tells most of depth. region : what of the scene is asked for.
    judged : what the frames proved as they were captured; without it, files of one exposure are judged again.
    drop_finest_bits, uncalibrated : as in `slrig.scan.plan.ReconstructionPlan`.

    Raises
    ------
    BundleError, CalibrationError, PatternError
        The bundle cannot be used as it is.
    SolveRefusedError
        There is no calibration, and the scan determines none.
    NothingToReconstructError
        No pixel could be decoded, no stripe be found, or the light tells no depth.
    """
    walk = partial(
        _walked, folder, calibration_file, entered=entered, region=region, judged=judged,
        drop_finest_bits=drop_finest_bits,
    )  # fmt: skip
    if uncalibrated is None:
        walked = walk(live, axis=axis)
    else:
        files = open_bundle(folder)
        stated_px = {name: px for name, px in files.focal_px.items() if name not in uncalibrated.focal_px}
        guess = guessed_rig(files.outline, uncalibrated, stated_px)
        walked = walk(None, axis=axis, devices=guess)
        entered("calibrate by scan", 0.58, "")
        seconds = {each.name: each.second for each in walked.seen}
        own = calibrated_by_scan(folder, guess, uncalibrated, seconds, stated_px)
        seen = [replace(each, device=own.calibration.cameras[each.name]) for each in walked.seen]
        walked = replace(walked, devices=own.calibration, seen=seen)
        walked.sections["self_calibration"] = own.report
        walked.notes[:0] = own.notes
    tries = [_tried(walked, folder, entered, region)]
    others = walked.shown - {walked.axis} if axis is None else frozenset()
    for other in others:
        if _is_weak(tries[0]):
            again = walk(None, axis=other, devices=None if uncalibrated is None else walked.devices)
            tries.append(_tried(again, folder, entered, region))
    sound = [each for each in tries if not isinstance(each, NothingToReconstructError)]
    if not sound:
        raise next(each for each in tries if isinstance(each, NothingToReconstructError))
    best, found = max(sound, key=lambda each: _depth_known(*each)) if len(sound) > 1 else sound[0]
    if uncalibrated is not None and best.axis is not walked.axis:
        best.sections["self_calibration"] = walked.sections["self_calibration"]
        best.notes[:0] = own.notes
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


def refine_by_scans(prior: Calibration, bundles: Sequence[Path], entered: Entered) -> tuple[Calibration, list[str]]:
    """A calibration improved by scans by columns and rows, and what changed, a line each.

    Raises
    ------
    BundleError, CalibrationError, PatternError
        A bundle cannot be used, or is of other devices; or the calibration does not state its errors.
    SolveRefusedError
        A bundle has one axis, the scans leave the shape open, or they contradict the calibration.
    """
    if prior.solved is None:
        message = (
            "expected a calibration that states its errors, so that scans can be weighed against them, found none; "
            f"solve it from board poses, or take that of a scan with {setting('uncalibrated')}"
        )
        raise CalibrationError(message)
    return refined_by_pairs(prior, pairs_of_scans(prior, bundles, entered))


def pairs_of_scans(devices: Calibration, bundles: Sequence[Path], entered: Entered) -> list[dict[str, PixelPairs]]:
    """Pixels that each camera shares with the projector, of each scan by columns and rows.

    Raises BundleError, CalibrationError, PatternError; SolveRefusedError: a bundle has one axis.
    """
    scans = []
    for place, bundle in enumerate(bundles):

        def stage(name: str, fraction: float, detail: str, place: int = place) -> None:
            if name in _STAGES:
                entered(name, (place + fraction) / len(bundles), f"{place + 1} of {len(bundles)}, {detail}")

        walked = _walked(
            bundle, None, None, entered=stage, axis=None, region=None, judged=None, drop_finest_bits=0, devices=devices
        )
        scans.append(pairs_of_both_axes(bundle, {each.name: each.second for each in walked.seen}))
    return scans


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
    devices: Calibration | None = None,
) -> Walked:
    """Frames to curves: those that came while the scan was captured, or else those of the bundle, along `axis`.

    devices : to use in place of the calibration of the bundle.
    """
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
        and devices is None
        and live.evidence is not None
        and live.one_exposure
        and axis in (None, live.axis)
        and live.region == region
        and drop_finest_bits == 0
        and _is_of(live, folder, calibration_file)
    ):
        names += live.header.cameras
        own, evidence = live.calibration, live.evidence
        stream: ScanStream = live
        devices = _require_calibration(folder, names, own)
        usable = _usable(folder, open_bundle(folder, calibration_file=calibration_file), evidence)
        if usable is None:
            seen = live.finished(stage_entered)
    else:
        files = open_bundle(folder, calibration_file=calibration_file)
        names += files.outline.cameras
        devices = _require_calibration(folder, names, devices or files.calibration)
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

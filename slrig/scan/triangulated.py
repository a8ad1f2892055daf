"""From the curves of every camera to one set of points: with the projector's light sheets, or from a pair of cameras.

Also the distance between curves where a camera does not resolve the finest patterns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import setting
from slrig.meshing import runs_of_curve_parts
from slrig.model import (
    Axis,
    Calibration,
    FloatArray,
    IntArray,
    Pinhole,
    Refusal,
    Region,
    baseline_fraction,
    depth_sensitive_cameras,
)
from slrig.reconstruction import (
    CalibrationCheck,
    CameraCurves,
    MergedCurves,
    SheetCurves,
    SinusoidResponse,
    calibration_modes,
    calibration_sigma,
    evaluate_redundancy,
    merge_curves,
    select_points,
    stripe_crossing,
    stripe_tangents,
    triangulate_camera_pair,
    triangulate_camera_projector,
)
from slrig.scan.axis_agreement import leave_out_contradicted
from slrig.scan.camera_agreement import Agreement, check_agreement, drop_contradicting_areas
from slrig.scan.limited import limited
from slrig.scan.mirror_images import NO_MIRROR_IMAGES, MirrorImages, refuse_mirror_images
from slrig.scan.report import lit_pixels, lit_share
from slrig.scan.stream import CameraResult

_WIDEST_GAP_PX = 4.0
_WIDEST_GAP_STEPS = 2.5  # of the usual distance of two points along a curve
_STEEP_ENOUGH = 0.5  # of the pair whose stripes cross its epipolar lines most steeply: errors twice its at most
_MANY_ALONE = 0.4  # of one camera's points, that the other should see if calibration and overlap are right


@dataclass(frozen=True, slots=True)
class Triangulated:
    """Points of all cameras in the world.

    merged : the points. cameras : without stripes, and with the points that were left out in their maps of causes;
    their devices are those of `agreement.calibration`. baseline_sine : 0 to 1, the sine of the angle between the
    stripes and the baseline: by the calibration, or without a projector as the median over the image. agreement : what
    the cameras say of the calibration, and the devices that the points were made with. notes : sentences for a person.
    second : index of the camera that the first is paired with, without a projector. mirror_images : those of several
    cameras, which were left out before their points were merged. widest_gap_px : of the function of that name.
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
    Cameras that contradict each other are not merged, see `slrig.scan.camera_agreement`.

    Without a projector one pair of cameras is used, since the light sheet has no rows to merge several by: of the pairs
    with the first camera whose stripes cross the epipolar lines steeply, the one that gives most points.

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
            part, refusal = limited(region, part, refusal, camera.device)
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
    """Points of the first camera and the one that it is paired with, without a projector."""
    first, *others = cameras
    stripes = first.curves.ensemble
    crossing = [stripe_crossing(stripes, first.device, other.device) for other in others]
    steep = [index for index, sine in enumerate(crossing) if sine >= _STEEP_ENOUGH * max(crossing)]
    pairs = {
        index: triangulate_camera_pair(stripes, others[index].curves.ensemble, first.device, others[index].device)
        for index in steep
    }
    partner = max(pairs, key=lambda index: len(pairs[index][0].points_mm))
    points, matched = pairs[partner]
    second = others[partner]
    _, matched_back = triangulate_camera_pair(second.curves.ensemble, stripes, second.device, first.device)
    marked = [_with_cause(first, stripes.points_px, matched)]
    for index, other in enumerate(others):
        is_matched = (
            matched_back if index == partner else np.zeros(len(other.curves.ensemble.points_px), dtype=np.bool_)
        )
        marked.append(_with_cause(other, other.curves.ensemble.points_px, is_matched))
    if region is not None:
        points, refusal = limited(region, points, marked[0].curves.refusal, first.device)
        marked[0] = replace(marked[0], curves=replace(marked[0].curves, refusal=refusal))
    gap = widest_gap_px(None, axis, [points])
    devices = {camera.name: camera.device for camera in cameras}
    redundancy = evaluate_redundancy([points], devices, axis, widest_gap_px=gap)
    notes = []
    if len(matched) and (alone := 1 - float(matched.mean())) > _MANY_ALONE:
        notes.append(
            f"{alone:.0%} of the points of camera '{first.name}' have no partner in camera '{second.name}': the "
            "cameras see too little of the same surface, or their calibration is wrong (verify it: slrig verify)"
        )
    return Triangulated(
        merge_curves([points], first.device.centre_mm, widest_gap_px=gap),
        _without_points(marked),
        crossing[partner],
        Agreement(calibration, (True,) * len(cameras), redundancy),
        tuple(notes),
        1 + partner,
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
    points = found.merged.curves
    tangents = stripe_tangents(points.points_mm, points.offsets, points.bridge_after)
    return calibration_sigma(modes, points.points_mm, normals, points.source, found.merged.camera, tangents)


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

"""From the curves of every camera to one set of points: with the projector's light sheets, or in pairs of cameras.

And what follows where a camera does not resolve the finest patterns: wider steps between curves, and only there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.errors import setting
from slrig.meshing import runs_of_curve_parts
from slrig.model import Axis, FloatArray, IntArray, Pinhole, Refusal, Region, baseline_fraction, depth_sensitive_cameras
from slrig.reconstruction import (
    CameraCurves,
    MergedCurves,
    Redundancy,
    SheetCurves,
    evaluate_redundancy,
    merge_curves,
    select_points,
    stripe_crossing,
    triangulate_camera_pair,
    triangulate_camera_projector,
)
from slrig.scan.limited import limited
from slrig.scan.report import lit_pixels, lit_share
from slrig.scan.stream import CameraResult

_WIDEST_GAP_PX = 4.0
_STEEP_ENOUGH = 0.5  # of the pair whose stripes cross its epipolar lines most steeply: errors twice its at most


@dataclass(frozen=True, slots=True)
class Triangulated:
    """The curves of all cameras, what they say of one another, and the cameras with the points that were left out
    among their refusals, and no points in their own curves.

    share_across : 0 to 1, the sine of the angle between the stripes and the baseline: by the calibration, or without a
    projector as the median over the image. second : index of the camera that the first is paired with, without one.
    """

    joined: MergedCurves
    spare: Redundancy
    cameras: list[CameraResult]
    share_across: float
    second: int = 1


def triangulated(
    cameras: list[CameraResult], projector: Pinhole | None, axis: Axis, region: Region | None = None
) -> Triangulated:
    """Triangulate the curves of an axis; without a projector, of at least two cameras. region : what of it counts.

    With a projector, a camera is left out whose baseline lies along the stripes: it sees them edge on, and where others
    measure, its errors of depth are no use.

    Without a projector one pair of cameras is used, since the light sheet has no rows to merge several by: of the pairs
    with the first camera whose stripes cross the epipolar lines steeply, the one that gives most points.
    """
    devices = {seen.name: seen.device for seen in cameras}
    if projector is not None:
        met = [
            _on_sheets(seen, projector, axis, told=told)
            for seen, told in zip(
                cameras, depth_sensitive_cameras(axis, list(devices.values()), projector), strict=True
            )
        ]
        told = [
            replace(seen, curves=replace(seen.curves, refusal=_with_left_out(seen.curves, part, cause)))
            for seen, (part, cause) in zip(cameras, met, strict=True)
        ]
        parts = [part for part, _ in met]
        if region is not None:
            for index, seen in enumerate(told):
                parts[index], told[index] = _limited(region, seen, parts[index])
        gap = widest_gap_px(projector, axis)
        spare = evaluate_redundancy(parts, devices, axis, widest_gap_px=gap)
        joined = merge_curves(parts, projector.centre_mm, widest_gap_px=gap)
        return Triangulated(
            joined, spare, _without_points(told), baseline_fraction(axis, list(devices.values()), projector)
        )
    first, *others = cameras
    mine = first.curves.ensemble
    crossing = [stripe_crossing(mine, first.device, seen.device) for seen in others]
    steep = [index for index, share in enumerate(crossing) if share >= _STEEP_ENOUGH * max(crossing)]
    pairs = {i: triangulate_camera_pair(mine, others[i].curves.ensemble, first.device, others[i].device) for i in steep}
    second = max(pairs, key=lambda index: len(pairs[index].points_mm))
    best = pairs[second]
    if region is not None:
        best, first = _limited(region, first, best)
        cameras = [first, *others]
    gap = widest_gap_px(None, axis)
    spare = evaluate_redundancy([best], devices, axis, widest_gap_px=gap)
    joined = merge_curves([best], first.device.centre_mm, widest_gap_px=gap)
    return Triangulated(joined, spare, _without_points(cameras), crossing[second], 1 + second)


def _without_points(cameras: Sequence[CameraResult]) -> list[CameraResult]:
    return [
        replace(seen, curves=replace(seen.curves, ensemble=seen.curves.ensemble.without_points())) for seen in cameras
    ]


def widest_gap_px(projector: Pinhole | None, axis: Axis) -> float:
    """Steps along a light sheet between two points of one camera up to which the curve between them counts as seen;
    without a projector, camera pixels.

    Where the projector is addressed more finely along the sheet than across it, a camera's pixel covers more of them.
    """
    if projector is None:
        return _WIDEST_GAP_PX
    across, along = (0, 1) if axis is Axis.COLUMN else (1, 0)
    return _WIDEST_GAP_PX * max(1.0, float(projector.matrix[along, along] / projector.matrix[across, across]))


def _on_sheets(
    seen: CameraResult, projector: Pinhole, axis: Axis, *, told: bool
) -> tuple[SheetCurves, NDArray[np.uint8]]:
    """`triangulate_camera_projector`, with nothing kept of a camera that the axis tells no depth."""
    part, cause = triangulate_camera_projector(seen.curves.ensemble, seen.device, projector, axis)
    if told:
        return part, cause
    return (
        select_points(part, np.zeros(len(part.points_mm), dtype=np.bool_)),
        np.where(cause == Refusal.NONE, np.uint8(Refusal.SHEET_SEEN_ALONG), cause),
    )


def _limited(region: Region, seen: CameraResult, part: SheetCurves) -> tuple[SheetCurves, CameraResult]:
    """The points of a camera that a region holds, and the camera with the others among its refusals."""
    part, refusal = limited(region, part, seen.curves.refusal, seen.device)
    return part, replace(seen, curves=replace(seen.curves, refusal=refusal))


def _with_left_out(curves: CameraCurves, triangulated: SheetCurves, cause: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The refusals with the points among them that triangulation left out, where it kept none in the same pixel.

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


_WORTH_TELLING = 0.02
_WIDEST_BRIDGES = 2.5
"""Of the gaps up to which a curve counts as seen: what strips still bridge at the usual limit of a depth edge."""


@dataclass(frozen=True, slots=True)
class Steps:
    """at_points_px : (n,) float64, distance of neighbouring curves where each point lies, or one for all; runs : the
    parts of curves to be joined, None where they are whole curves.
    """

    at_points_px: FloatArray | float
    runs: IntArray | None


def steps(
    cameras: Sequence[CameraResult],
    joined: MergedCurves,
    step_px: float,
    cell_px: float,
    *,
    max_gap: int,
    widest_gap_px: float,
) -> Steps:
    """How far apart curves lie, and which are neighbours.

    step_px : where all that was shown resolves. cell_px : of the code. max_gap : neighbours are at most so many steps
    apart. widest_gap_px : along a curve, up to which it is there between two points.
    """
    maps = [_steps_px(seen.curves, step_px, cell_px) for seen in cameras]
    if all(each is None for each in maps):
        return Steps(step_px, None)
    curves = joined.curves
    columns, rows = np.rint(curves.pixels_px).astype(int).T
    at_points = np.full(len(rows), step_px)
    for index, each in enumerate(maps):
        mine = joined.camera == index
        if each is not None:
            at_points[mine] = each[rows[mine], columns[mine]]
    # A curve may have a neighbour that another camera does not resolve.
    widest_px = max(float(each.max()) for each in maps if each is not None)
    runs = runs_of_curve_parts(
        curves.position_px, curves.offsets, curves.along_px,
        widest_step_px=max(step_px * max_gap, widest_px), widest_gap_px=_WIDEST_BRIDGES * widest_gap_px,
    )  # fmt: skip
    return Steps(at_points, runs)


def _steps_px(curves: CameraCurves, step_px: float, cell_px: float) -> NDArray[np.float32] | None:
    """(H, W): how far apart curves lie at each pixel; None if as usual everywhere."""
    if curves.unresolved is None:
        return None
    edges_px = np.float32(cell_px) * np.exp2(curves.unresolved, dtype=np.float32)
    if curves.unresolved_lines is not None:
        return np.where(curves.unresolved_lines, edges_px, np.float32(step_px))
    return edges_px if curves.unresolved.any() else None


def camera_notes(cameras: Sequence[CameraResult]) -> list[str]:
    """Sentences on each camera whose frames are clipped, compressed, not linear, or not alike."""
    notes = []
    for seen in cameras:
        share = seen.curves.clipped_white / max(int(np.count_nonzero(lit_pixels(seen.curves))), 1)
        if share >= _WORTH_TELLING:
            notes.append(
                f"camera '{seen.name}': white is clipped at full scale ({seen.curves.full_scale:.0f}) on "
                f"{share:.0%} of what is lit. Shifted lines give no points there, and edges of the code are less exact "
                "(σ contains this). Expose shorter, lower the gain, or take several exposures"
            )
        apart_px = np.abs(seen.curves.disagreement_px)
        if not seen.curves.refined and np.isfinite(apart_px).any():
            notes.append(
                f"camera '{seen.name}': lines of single frames lie up to {np.nanmax(apart_px):.2f} px beside where all "
                "frames put them, so each frame counts by itself, and σ contains this. Keep object and rig still, lock "
                "exposure and gain, and show patterns pixel for pixel in the projector's own resolution"
            )
        if seen.curves.compression_dn > 0:
            notes.append(
                f"camera '{seen.name}': its frames were compressed as JPEG, which errs by as much as "
                f"{seen.curves.compression_dn:.1f} grey levels of noise in every pixel would: take frames without "
                "compression (GREY, YUYV; PNG, TIFF or BMP files) for a finer surface"
            )
        if seen.curves.gamma != 1:
            notes.append(
                f"camera '{seen.name}': its values are made for a display (gamma {seen.curves.gamma:.1f}), as edges of "
                "the code tell; they were made proportional to light again. Switch its gamma correction off to keep "
                "the levels that it costs"
            )
    return notes


def unresolved_notes(cameras: Sequence[CameraResult], step_px: float, cell_px: float) -> list[str]:
    """One sentence for each camera that does not resolve the finest patterns on a part of what is lit."""
    notes = []
    for seen in cameras:
        share = lit_share(seen.curves, seen.curves.unresolved_lines)
        if share >= _WORTH_TELLING:
            notes.append(
                f"camera '{seen.name}' does not resolve the shifted lines on {share:.0%} of what is lit: the edges of "
                f"the code stand for them there, every {cell_px:g} projector pixels or wider instead of every "
                f"{step_px:g}. Look at focus and resolution, or play lines further apart: "
                f"{setting('line_shift_period_px')}"
            )
        elif seen.curves.unresolved is not None and seen.curves.unresolved_lines is None:
            share = lit_share(seen.curves, seen.curves.unresolved > 0)
            if share >= _WORTH_TELLING:
                notes.append(
                    f"camera '{seen.name}' does not resolve the finest Gray bit on {share:.0%} of what is lit: "
                    f"it is left out there, and the surface is sampled every {2 * step_px:g} projector pixels or "
                    f"wider. Look at focus and resolution, or play wider cells: {setting('gray_cell_px')}"
                )
    return notes

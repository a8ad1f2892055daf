"""From the curves of every camera to one set of points: with the projector's light sheets, or in pairs of cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.model import Axis, Pinhole, Refusal, share_across, told_depth
from slrig.reconstruction.camera import CameraCurves
from slrig.reconstruction.epipolar import stripe_crossing
from slrig.reconstruction.merging import MergedCurves, merged
from slrig.reconstruction.redundancy import Redundancy, redundancy
from slrig.reconstruction.sheet_curves import selected
from slrig.reconstruction.triangulation import SheetCurves, camera_camera, camera_projector
from slrig.scan.stream import CameraResult

_WIDEST_GAP_PX = 4.0
_STEEP_ENOUGH = 0.5  # of the pair whose stripes cross its epipolar lines most steeply: errors twice its at most


@dataclass(frozen=True, slots=True)
class Triangulated:
    """The curves of all cameras, what they say of one another, and the cameras with the points that were left out
    among their refusals.

    share_across : 0 to 1, the sine of the angle between the stripes and the baseline: by the calibration, or without a
    projector as the median over the image. second : index of the camera that the first is paired with, without one.
    """

    joined: MergedCurves
    spare: Redundancy
    cameras: list[CameraResult]
    share_across: float
    second: int = 1


def triangulated(cameras: list[CameraResult], projector: Pinhole | None, axis: Axis) -> Triangulated:
    """Triangulate the curves of an axis; without a projector, of at least two cameras.

    With a projector, a camera is left out whose baseline lies along the stripes: it sees them edge on, and where others
    measure, its errors of depth are no use.

    Without a projector one pair of cameras is used, since the light sheet has no rows to merge several by: of the pairs
    with the first camera whose stripes cross the epipolar lines steeply, the one that gives most points.
    """
    devices = {seen.name: seen.device for seen in cameras}
    if projector is not None:
        met = [
            _on_sheets(seen, projector, axis, told=told)
            for seen, told in zip(cameras, told_depth(axis, list(devices.values()), projector), strict=True)
        ]
        told = [
            replace(seen, curves=replace(seen.curves, refusal=_with_left_out(seen.curves, part, cause)))
            for seen, (part, cause) in zip(cameras, met, strict=True)
        ]
        parts = [part for part, _ in met]
        gap = widest_gap_px(projector, axis)
        spare = redundancy(parts, devices, axis, widest_gap_px=gap)
        joined = merged(parts, projector.centre_mm, widest_gap_px=gap)
        return Triangulated(joined, spare, told, share_across(axis, list(devices.values()), projector))
    first, *others = cameras
    mine = first.curves.ensemble
    crossing = [stripe_crossing(mine, first.device, seen.device) for seen in others]
    steep = [index for index, share in enumerate(crossing) if share >= _STEEP_ENOUGH * max(crossing)]
    pairs = {i: camera_camera(mine, others[i].curves.ensemble, first.device, others[i].device) for i in steep}
    second = max(pairs, key=lambda index: len(pairs[index].points_mm))
    best = pairs[second]
    gap = widest_gap_px(None, axis)
    spare = redundancy([best], devices, axis, widest_gap_px=gap)
    joined = merged([best], first.device.centre_mm, widest_gap_px=gap)
    return Triangulated(joined, spare, cameras, crossing[second], 1 + second)


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
    """`camera_projector`, with nothing kept of a camera that the axis tells no depth."""
    part, cause = camera_projector(seen.curves.ensemble, seen.device, projector, axis)
    if told:
        return part, cause
    return (
        selected(part, np.zeros(len(part.points_mm), dtype=np.bool_)),
        np.where(cause == Refusal.NONE, np.uint8(Refusal.SHEET_SEEN_ALONG), cause),
    )


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

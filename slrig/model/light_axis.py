"""Which axis of light tells depth: the one whose stripes lie across the baseline."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, sqrt

from numpy import linalg

from slrig.model.rig import Axis, Pinhole

LEAST_SHARE = 0.2
"""A baseline that lies across the stripes by less than this share of it (12°) makes errors five times as large as they
need be, and what is seen of depth is mostly errors."""


def triangulated_axis(cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> Axis:
    """The axis of patterns to triangulate by, of cameras in their order.

    Light that runs along the baseline is seen edge on, and an epipolar line meets such a stripe nowhere or everywhere:
    it tells no depth. Columns are for devices side by side, rows for devices above one another.

    With a projector that is the axis by which all cameras together know depth best: a point moves in a camera by as
    many pixels as its focal length times its baseline, seen in the projector's frame; inverse variances add up.
    Without a projector the baseline is that from the first camera to another, seen in the first camera's frame; of
    several the one that is longest across the view. The projector is then assumed to stand upright to the first camera,
    within 45°: its columns run down the image. The direction of the stripes shows whether that holds
    (`slrig.reconstruction.triangulation`).
    """
    across = share_across(Axis.COLUMN, cameras, projector)
    return Axis.COLUMN if across >= share_across(Axis.ROW, cameras, projector) else Axis.ROW


def share_across(axis: Axis, cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> float:
    """0 to 1: the sine of the angle between the baseline of `triangulated_axis` and the stripes of an axis.

    A point's error grows with its inverse. Of several baselines their root mean square by the same weights. Where there
    is no baseline to be seen, 1 for columns and 0 for rows.
    """
    beside, above = _moved_px(cameras, projector)
    length = hypot(beside, above)
    if length == 0:
        return 1.0 if axis is Axis.COLUMN else 0.0
    return (beside if axis is Axis.COLUMN else above) / length


def told_depth(axis: Axis, cameras: Sequence[Pinhole], projector: Pinhole, /) -> list[bool]:
    """Which cameras an axis of light tells depth; all of them where it tells it to none."""
    told = [share_across(axis, [camera], projector) >= LEAST_SHARE for camera in cameras]
    return told if any(told) else [True] * len(told)


def _moved_px(cameras: Sequence[Pinhole], projector: Pinhole | None) -> tuple[float, float]:
    """By how much points move in images, px mm, along x and y of the frame that the baselines are seen in.

    What of a baseline runs along the view is of no use.
    """
    first, *others = cameras
    seen_by, ends = (first, others) if projector is None else (projector, cameras)
    found = [
        sqrt(abs(linalg.det(end.matrix[:2, :2]))) * abs(seen_by.rotation @ end.centre_mm + seen_by.translation_mm)
        for end in ends
    ]
    if projector is None:
        return max(((float(x), float(y)) for x, y, _ in found), key=lambda each: hypot(*each), default=(0.0, 0.0))
    return hypot(*(float(x) for x, _, _ in found)), hypot(*(float(y) for _, y, _ in found))

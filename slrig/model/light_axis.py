"""Which axis of light tells depth: the one whose stripes lie across the baseline."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

from slrig.model.rig import Axis, Pinhole


def triangulated_axis(cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> Axis:
    """The axis of patterns to triangulate by, of cameras in their order.

    Light that runs along the baseline is seen edge on, and an epipolar line meets such a stripe nowhere or everywhere:
    it tells no depth. Columns are for devices side by side, rows for devices above one another.

    With a projector the baseline is that to the first camera, seen in the projector's frame. Without one it is that
    from the first camera to another, seen in the first camera's frame; of several the one that is longest across the
    view. The projector is then assumed to stand upright to the first camera, within 45°: its columns run down the
    image. Whether that holds, the stripes tell (`slrig.reconstruction.epipolar`).
    """
    across = share_across(Axis.COLUMN, cameras, projector)
    return Axis.COLUMN if across >= share_across(Axis.ROW, cameras, projector) else Axis.ROW


def share_across(axis: Axis, cameras: Sequence[Pinhole], projector: Pinhole | None, /) -> float:
    """0 to 1: the sine of the angle between the baseline of `triangulated_axis` and the stripes of an axis.

    A point's error grows with its inverse. Where there is no baseline to be seen, 1 for columns and 0 for rows.
    """
    beside, above = _baseline_mm(cameras, projector)
    length = hypot(beside, above)
    if length == 0:
        return 1.0 if axis is Axis.COLUMN else 0.0
    return abs(beside if axis is Axis.COLUMN else above) / length


def _baseline_mm(cameras: Sequence[Pinhole], projector: Pinhole | None) -> tuple[float, float]:
    """Along x and y of the frame that it is seen in; along the view it is of no use."""
    first, *others = cameras
    seen_by, ends = (first, others) if projector is None else (projector, [first])
    found = [seen_by.rotation @ end.centre_mm + seen_by.translation_mm for end in ends]
    return max(((float(x), float(y)) for x, y, _ in found), key=lambda each: hypot(*each), default=(0.0, 0.0))

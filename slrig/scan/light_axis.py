"""The axis of light that a scan plays and is triangulated by, and what is said where it tells little of depth."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from math import asin, degrees

from slrig.errors import PatternError, setting
from slrig.model import (
    MIN_BASELINE_FRACTION,
    Axis,
    Calibration,
    Pinhole,
    baseline_fraction,
    depth_sensitive_cameras,
    triangulated_axis,
)

_NEXT_TO_NONE = 0.01
FAIR_SHARE = 0.5
"""By this share of it (30°), errors are twice as large as they need be."""

_BOTH = f"Scan with both axes: {setting('rows')}"


def played_axes(
    rows: bool | None, calibration: Calibration | None, names: Iterable[str], *, axis: Axis | None = None
) -> tuple[Axis, ...]:
    """The axes that a scan with the cameras `names` plays.

    rows : True plays both, False columns alone; None the one that the calibration asks for, and columns without one.
    axis : the one to triangulate by, if that was asked for.

    Raises
    ------
    PatternError
        The axis asked for tells no depth by the calibration, or columns alone are to be played and rows to be used.
    """
    if rows:
        return tuple(Axis)
    if axis is Axis.ROW and rows is False:
        message = (
            f"{setting('rows')} as false plays columns alone, and {setting('axis')} as row triangulates by rows; leave "
            "one of them out"
        )
        raise PatternError(message)
    cameras = _known(calibration, names)
    wanted = Axis.COLUMN if rows is False else axis
    if calibration is None or not cameras:
        return (wanted or Axis.COLUMN,)
    if wanted is None:
        return (triangulated_axis(cameras, calibration.projector),)
    return (chosen_axis((wanted,), cameras, calibration.projector),)


def chosen_axis(shown: Collection[Axis], cameras: Sequence[Pinhole], projector: Pinhole | None) -> Axis:
    """The axis to triangulate by, of those that were shown.

    Raises
    ------
    PatternError
        The only one shown tells no depth. Without a projector the stripes have to be seen before that can be said.
    """
    if len(shown) != 1:
        return triangulated_axis(cameras, projector)
    (axis,) = shown
    if projector is not None and baseline_fraction(axis, cameras, projector) < MIN_BASELINE_FRACTION:
        where = "above or below" if axis is Axis.COLUMN else "beside"
        message = (
            f"expected patterns across the baseline, found those of {axis}s alone: the camera stands {where} the "
            f"projector, and light of one {axis} is seen edge on there and tells no depth. {_BOTH}"
        )
        raise PatternError(message)
    return axis


def weakness(axis: Axis, shown: Collection[Axis], share: float, *, on_request: bool = False) -> str | None:
    """What to say of a scan whose stripes cross the baseline by so small a share; None where that is well.

    on_request : True if this axis was requested. Then the other one, if it was shown, is the cure.
    """
    if share >= FAIR_SHARE:
        return None
    if len(shown) == 1:
        cure = _BOTH
    elif on_request:
        cure = f"The {axis.other}s were played, too, and cross it more steeply: leave out {setting('axis')}"
    else:
        cure = "Both axes were played: turn the projector about its view by 45°"
    times = f"{1 / share:.1f}" if share > _NEXT_TO_NONE else f"more than {1 / _NEXT_TO_NONE:.0f}"
    return (
        f"the light of the {axis}s crosses the baseline at {degrees(asin(share)):.0f}° only, and depth is {times} "
        f"times as uncertain as it would be across it. {cure}"
    )


def left_out_notes(axis: Axis, cameras: Mapping[str, Pinhole], projector: Pinhole | None) -> list[str]:
    """One sentence for each camera that the axis tells no depth, where it tells others."""
    if projector is None:
        return []
    told = depth_sensitive_cameras(axis, list(cameras.values()), projector)
    return [
        f"camera '{name}' is left out: its baseline to the projector lies along the {axis}s of light, which tell it no "
        "depth; the other cameras measure by them"
        for name, tells in zip(cameras, told, strict=True)
        if not tells
    ]


def _known(calibration: Calibration | None, names: Iterable[str]) -> list[Pinhole]:
    return [] if calibration is None else [calibration.cameras[n] for n in names if n in calibration.cameras]

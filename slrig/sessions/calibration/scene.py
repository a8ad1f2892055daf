"""Drawings of the bench, as SVG: the expected error in slices of the volume, and the rig from above and aside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.solution import PROJECTOR, BoardPose, ExpectedError
from slrig.model import Calibration, FloatArray, Pinhole
from slrig.sessions.calibration.charts import WIDTH, drawing, ink_on, ramp_colour
from slrig.sessions.calibration.words import rounded
from slrig.sessions.markup import Markup, tag

_MARGIN = 34.0
_END_SHARE = 0.12
_NUMBER_PX = 20.0
_SAME_MM = 1e-2
_LABEL_WIDE, _LABEL_HIGH = 56.0, 32.0
_X, _Y, _Z = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Slice:
    """The expected error across the volume at one distance."""

    z_mm: float
    picture: Markup


def error_slices(expected: ExpectedError, *, most: int = 3) -> tuple[Slice, ...]:
    """The error of a point in slices across the volume, from near to far, all in the same colours.

    The world is the first camera's frame: x to its right, y down, and a slice is seen as the camera sees it.
    """
    levels = np.unique(np.round(expected.grid_mm[:, _Z], 3))
    # Not the very ends: of those the board reached a corner only.
    ends = np.quantile(expected.grid_mm[:, _Z], np.linspace(_END_SHARE, 1 - _END_SHARE, most))
    chosen = np.unique([levels[np.abs(levels - z).argmin()] for z in ends])
    return tuple(Slice(float(z), _slice(expected, float(z))) for z in chosen)


def error_range_mm(expected: ExpectedError) -> tuple[float, float]:
    """The least and the greatest error in the volume, mm: the ends of the colours."""
    finite = expected.grid_point_mm[np.isfinite(expected.grid_point_mm)]
    return float(finite.min()), float(finite.max())


def _slice(expected: ExpectedError, z_mm: float) -> Markup:
    least, most = error_range_mm(expected)
    here = np.abs(expected.grid_mm[:, _Z] - z_mm) < _SAME_MM
    places, errors = expected.grid_mm[here][:, :2], expected.grid_point_mm[here]
    step = np.array([_step(expected.grid_mm[:, _X]), _step(expected.grid_mm[:, _Y])])
    low, high = expected.grid_mm[:, :2].min(axis=0) - step / 2, expected.grid_mm[:, :2].max(axis=0) + step / 2
    scale = WIDTH / (high - low)[0]
    wide, tall = scale * step
    height = scale * (high - low)[1]
    decimals = 0 if most >= 0.01 else 1 if most >= 0.001 else 2
    numbered = wide > _NUMBER_PX and tall > _NUMBER_PX / 2
    parts = [tag("rect", x=0, y=0, width=WIDTH, height=height, class_="unseen")]
    for place, error in zip(places, errors, strict=True):
        share = (float(error) - least) / max(most - least, 1e-12)
        x, y = scale * (place - step / 2 - low)
        told = tag("title", f"x {place[_X]:.0f}, y {place[_Y]:.0f}, z {z_mm:.0f} mm: {rounded(error)} mm")
        # A little wider than the grid: no seams between neighbours of nearly one colour.
        parts.append(tag("rect", told, x=x, y=y, width=wide + 0.4, height=tall + 0.4, fill=ramp_colour(share)))
        if numbered:
            middle = {"x": x + wide / 2, "y": y + tall / 2 + 3}
            parts.append(tag("text", f"{1000 * error:.{decimals}f}", **middle, class_="cell-value", fill=ink_on(share)))
    return drawing(WIDTH, height, f"expected error of a point at {z_mm:.0f} mm", parts)


def _step(values_mm: FloatArray) -> float:
    levels = np.unique(np.round(values_mm, 3))
    return float(np.median(np.diff(levels))) if len(levels) > 1 else 1.0


def rig_view(
    calibration: Calibration,
    poses: Sequence[BoardPose],
    board: Board,
    volume_mm: FloatArray,
    *,
    aside: bool,
) -> Markup:
    """The bench to scale: devices with what they see, the board in every pose, and the working volume.

    The first camera looks to the right. From above, so that its right (x) is down the page, or from aside (y down).
    """
    across, along = _Z, _Y if aside else _X
    named = [*calibration.cameras.items()]
    if calibration.projector is not None:
        named.append((PROJECTOR, calibration.projector))
    far_mm = float(volume_mm[1, _Z])
    cones = [_cone(device, far_mm, aside=aside) for _, device in named]
    boards = [_edge_on(pose, board, (across, along)) for pose in poses]
    corners = np.array([[volume_mm[a, across], volume_mm[b, along]] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))])
    extent = np.concatenate([corners, *boards, *(cone[:, [across, along]] for cone in cones)])
    low, high = extent.min(axis=0), extent.max(axis=0)
    scale = (WIDTH - 2 * _MARGIN) / max(high[0] - low[0], 1e-9)
    height = scale * (high[1] - low[1]) + 2 * _MARGIN

    def placed(points: FloatArray) -> FloatArray:
        return np.asarray((points - low) * scale + _MARGIN)

    parts = [
        tag(
            "polygon",
            points=_listed(placed(cone[:, [across, along]])),
            class_="cone light" if name == PROJECTOR else "cone",
        )
        for (name, _), cone in zip(named, cones, strict=True)
    ]
    parts.append(tag("polygon", points=_listed(placed(corners)), class_="volume"))
    parts += [tag("polygon", points=_listed(placed(outline)), class_="board") for outline in boards]
    spots = [placed(device.centre_mm[None, [across, along]])[0] for _, device in named]
    for (name, _), spot, shift in zip(named, spots, _label_shifts(spots), strict=True):
        parts.append(
            tag("circle", cx=spot[0], cy=spot[1], r=4.5, class_="projector" if name == PROJECTOR else "camera")
        )
        parts.append(tag("text", name, x=spot[0], y=spot[1] + shift, class_="label"))
    length = _round_length(0.4 * (high[0] - low[0]))
    parts.append(tag("path", d=f"M{_MARGIN} 8v6h{scale * length:.1f}v-6", class_="ruler"))
    parts.append(tag("text", f"{length:g} mm", x=_MARGIN + scale * length + 6, y=15, class_="tick"))
    view = "from the side" if aside else "from above"
    return drawing(WIDTH, height, f"the rig {view}, to scale", parts)


def _label_shifts(spots: Sequence[FloatArray]) -> list[float]:
    """For each spot how far below it its label stands: below, unless another device is close by there; then above."""
    shifts = []
    for at, spot in enumerate(spots):
        below = (
            (spot[1], at) < (other[1], number)
            and abs(other[0] - spot[0]) < _LABEL_WIDE
            and other[1] - spot[1] < _LABEL_HIGH
            for number, other in enumerate(spots)
        )
        shifts.append(-9.0 if any(below) else 17.0)
    return shifts


def _cone(device: Pinhole, far_mm: float, *, aside: bool) -> FloatArray:
    """(3, 3): the centre, and where the two edges of the image meet z = `far_mm` in the world, mm."""
    width, height = device.size.width_px - 1, device.size.height_px - 1
    middle = ((width / 2, 0), (width / 2, height)) if aside else ((0, height / 2), (width, height / 2))
    ends = []
    for column, row in middle:
        ray = device.rotation.T @ np.linalg.solve(device.matrix, np.array([column, row, 1.0]))
        reach = (far_mm - device.centre_mm[_Z]) / ray[_Z] if abs(ray[_Z]) > 1e-9 else far_mm
        ends.append(device.centre_mm + ray * reach)
    return np.stack([device.centre_mm, *ends])


def _edge_on(pose: BoardPose, board: Board, axes: tuple[int, int]) -> FloatArray:
    outline = board_outline_mm(board) @ pose.rotation.T + pose.translation_mm
    return outline[:, list(axes)]


def board_outline_mm(board: Board, *, along: int = 1) -> FloatArray:
    """(4 along, 3) float64: the edge of what is printed, in the board's frame, `along` points to a side."""
    (left, top), (right, bottom) = board.print_mm
    corners = np.array([[left, top, 0], [right, top, 0], [right, bottom, 0], [left, bottom, 0]], dtype=np.float64)
    following = np.roll(corners, -1, axis=0)
    steps = np.arange(along)[:, None, None] / along
    return np.asarray((corners + steps * (following - corners)).swapaxes(0, 1).reshape(-1, 3))


def _listed(points: FloatArray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


def _round_length(longest_mm: float) -> float:
    power = 10 ** np.floor(np.log10(max(longest_mm, 1e-3)))
    return float(max(step for step in (1, 2, 5) if step * power <= longest_mm) * power)

"""Drawings of a calibration: what is left over over an image, where the board was held, the error, and the rig."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from markupsafe import Markup

from slrig.calibrate.figures import named_devices
from slrig.calibrate.words import rounded
from slrig.calibration import CELLS, PROJECTOR, Board, BoardPose, DeviceResiduals, ExpectedError
from slrig.model import Calibration, FloatArray, Pinhole, Size
from slrig.reports.drawing import WIDTH, drawing, ink_on, path, polygon, ramp_colour, shape

_ARROW_SHARE = 0.42
"""The longest arrow, of a cell's shorter side: it stays within the cell, whose middle it has."""
_POINTS_ALONG = 8
"""Points to a side of the board, so that the lens bends its outline smoothly."""
_MARGIN = 34.0
_END_SHARE = 0.12
_NUMBER_PX = 20.0
"""A cell narrower than this, in units of the drawing, has no room for a number."""
_SAME_MM = 1e-2
_LABEL_WIDE, _LABEL_HIGH = 56.0, 32.0
_X, _Y, _Z = 0, 1, 2


def residual_map(residuals: DeviceResiduals, size: Size, *, name: str, most_px: float) -> Markup:
    """Cells over the image, each with its rms as number and colour, and its mean residual as an arrow.

    most_px : the rms of the brightest colour. The longest arrow is as long as fits; a caption has to say its length.
    """
    height = _height(size)
    wide, high = WIDTH / CELLS, height / CELLS
    scale = _ARROW_SHARE * min(wide, high) / max(longest_arrow_px(residuals), 1e-9)
    parts = []
    for row, column in np.ndindex(CELLS, CELLS):
        x, y = column * wide, row * high
        box = {"x": x, "y": y, "width": wide, "height": high}
        rms = float(residuals.map_rms_px[row, column])
        if math.isnan(rms):
            parts.append(shape("rect", shape("title", "nothing was seen here"), **box, class_="unseen"))
            continue
        mean, count = residuals.map_mean_px[row, column], int(residuals.map_count[row, column])
        fill, ink = ramp_colour(rms / most_px), ink_on(rms / most_px)
        told = shape("title", f"rms {rms:.3f} px of {count:,}; mean {mean[0]:+.3f}, {mean[1]:+.3f} px")
        parts += [
            shape("rect", told, **box, fill=fill, class_="cell"),
            _arrow(np.array([x + wide / 2, y + 0.62 * high]), scale * mean, ink),
            shape("text", f"{rms:.3f}", x=x + wide / 2, y=y + 11, class_="cell-value", fill=ink),
        ]
    return drawing(WIDTH, height, f"{name}: what is left over, cell by cell", parts)


def longest_arrow_px(residuals: DeviceResiduals) -> float:
    """The length of the longest mean residual of a cell, px; 0 where no cell has one."""
    lengths = np.hypot(*np.moveaxis(residuals.map_mean_px, -1, 0))
    return float(np.nanmax(lengths)) if np.isfinite(lengths).any() else 0.0


def coverage_map(
    device: Pinhole, board: Board, poses: Sequence[BoardPose], points_px: FloatArray, *, name: str
) -> Markup:
    """The image with the board's outline in every pose, cut at the image's edge, and every point that was used.

    points_px : (n, 2) float64, pixels.
    """
    height = _height(device.size)
    scale = WIDTH / device.size.width_px
    outlines_mm = [_outline_mm(board, pose, along=_POINTS_ALONG) for pose in poses]
    boards = [polygon((_projected(device, outline_mm) + 0.5) * scale, "board") for outline_mm in outlines_mm]
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in (points_px + 0.5) * scale)
    steps = range(1, CELLS)
    grid = "".join(f"M{WIDTH * at / CELLS:.1f} 0v{height:.1f}M0 {height * at / CELLS:.1f}h{WIDTH:.1f}" for at in steps)
    clip = f"image-of-{name}"
    parts = [
        shape("clipPath", shape("rect", width=WIDTH, height=height), id=clip),
        shape("path", d=grid, class_="grid"),
        shape("g", *boards, shape("path", d=dots, class_="dots"), clip_path=f"url(#{clip})"),
        shape("rect", x=0.5, y=0.5, width=WIDTH - 1, height=height - 1, class_="frame"),
    ]
    return drawing(WIDTH, height, f"{name}: where the board was held", parts)


def error_slices(expected: ExpectedError, *, most: int = 3) -> list[tuple[float, Markup]]:
    """The error of a point in slices across the volume, each with its z in mm, near to far, all in the same colours.

    The world is the first camera's frame: x to its right, y down, and a slice is seen as the camera sees it.
    """
    levels = np.unique(np.round(expected.grid_mm[:, _Z], 3))
    # Not the very ends: of those the board reached a corner only.
    ends = np.quantile(expected.grid_mm[:, _Z], np.linspace(_END_SHARE, 1 - _END_SHARE, most))
    chosen = np.unique([levels[np.abs(levels - z).argmin()] for z in ends])
    return [(float(z), _slice(expected, float(z))) for z in chosen]


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
    parts = [shape("rect", x=0, y=0, width=WIDTH, height=height, class_="unseen")]
    for place, error in zip(places, errors, strict=True):
        share = (float(error) - least) / max(most - least, 1e-12)
        x, y = scale * (place - step / 2 - low)
        told = shape("title", f"x {place[_X]:.0f}, y {place[_Y]:.0f}, z {z_mm:.0f} mm: {rounded(error)} mm")
        # A little wider than the grid: no seams between neighbours of nearly one colour.
        parts.append(shape("rect", told, x=x, y=y, width=wide + 0.4, height=tall + 0.4, fill=ramp_colour(share)))
        if numbered:
            number, middle = f"{1000 * error:.{decimals}f}", {"x": x + wide / 2, "y": y + tall / 2 + 3}
            parts.append(shape("text", number, **middle, class_="cell-value", fill=ink_on(share)))
    return drawing(WIDTH, height, f"expected error of a point at {z_mm:.0f} mm", parts)


def _step(values_mm: FloatArray) -> float:
    levels = np.unique(np.round(values_mm, 3))
    return float(np.median(np.diff(levels))) if len(levels) > 1 else 1.0


def rig_view(
    calibration: Calibration, poses: Sequence[BoardPose], board: Board, volume_mm: FloatArray, *, aside: bool
) -> Markup:
    """The bench to scale: devices with what they see, the board in every pose, and the working volume.

    The first camera looks to the right. From above, so that its right (x) is down the page, or from aside (y down).
    """
    axes = [_Z, _Y if aside else _X]
    named = named_devices(calibration)
    cones = [_cone(device, float(volume_mm[1, _Z]), aside=aside)[:, axes] for device in named.values()]
    boards = [_outline_mm(board, pose)[:, axes] for pose in poses]
    corners = _rectangle(*volume_mm[:, axes])
    extent = np.concatenate([corners, *boards, *cones])
    low, high = extent.min(axis=0), extent.max(axis=0)
    scale = (WIDTH - 2 * _MARGIN) / max(high[0] - low[0], 1e-9)
    height = scale * (high[1] - low[1]) + 2 * _MARGIN

    def placed(points: FloatArray) -> FloatArray:
        return np.asarray((points - low) * scale + _MARGIN)

    parts = [
        *(
            polygon(placed(cone), "cone light" if name == PROJECTOR else "cone")
            for name, cone in zip(named, cones, strict=True)
        ),
        polygon(placed(corners), "volume"),
        *(polygon(placed(outline), "board") for outline in boards),
    ]
    spots = [placed(device.centre_mm[axes]) for device in named.values()]
    for name, (x, y), shift in zip(named, spots, _label_shifts(spots), strict=True):
        kind = "projector" if name == PROJECTOR else "camera"
        parts += [
            shape("circle", cx=x, cy=y, r=4.5, class_=kind),
            shape("text", name, x=x, y=y + shift, class_="label"),
        ]
    length = _round_length(0.4 * (high[0] - low[0]))
    parts += [
        shape("path", d=f"M{_MARGIN} 8v6h{scale * length:.1f}v-6", class_="ruler"),
        shape("text", f"{length:g} mm", x=_MARGIN + scale * length + 6, y=15, class_="tick"),
    ]
    return drawing(WIDTH, height, f"the rig {'from the side' if aside else 'from above'}, to scale", parts)


def _label_shifts(spots: Sequence[FloatArray]) -> list[float]:
    """For each spot how far below it its label stands: below, unless another device is close by there; then above."""

    def beneath(at: int, other: int) -> bool:
        across, down = spots[other] - spots[at]
        return (down, other) > (0, at) and down < _LABEL_HIGH and abs(across) < _LABEL_WIDE

    every = range(len(spots))
    return [-9.0 if any(beneath(at, other) for other in every) else 17.0 for at in every]


def _cone(device: Pinhole, far_mm: float, *, aside: bool) -> FloatArray:
    """(3, 3): the centre, and where the two edges of the image meet z = `far_mm` in the world, mm."""
    width, height = device.size.width_px - 1, device.size.height_px - 1
    edges = ((width / 2, 0), (width / 2, height)) if aside else ((0, height / 2), (width, height / 2))
    ends = [device.centre_mm]
    for column, row in edges:
        ray = device.rotation.T @ np.linalg.solve(device.matrix, np.array([column, row, 1.0]))
        reach = (far_mm - device.centre_mm[_Z]) / ray[_Z] if abs(ray[_Z]) > 1e-9 else far_mm
        ends.append(device.centre_mm + ray * reach)
    return np.stack(ends)


def _outline_mm(board: Board, pose: BoardPose, *, along: int = 1) -> FloatArray:
    """(4 along, 3) float64: the edge of what is printed, in the world, `along` points to a side."""
    corners = np.pad(_rectangle(*board.print_mm), ((0, 0), (0, 1)))
    steps = np.arange(along)[:, None, None] / along
    outline_mm = (corners + steps * (np.roll(corners, -1, axis=0) - corners)).swapaxes(0, 1).reshape(-1, 3)
    return np.asarray(outline_mm @ pose.rotation.T + pose.translation_mm)


def _rectangle(low: FloatArray, high: FloatArray) -> FloatArray:
    """(4, 2): its corners in their order around it."""
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def _projected(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: where points of the world fall in the device's image, also beyond its edge."""
    turn, _ = cv2.Rodrigues(device.rotation)
    pixels, _ = cv2.projectPoints(points_mm, turn, device.translation_mm, device.matrix, device.distortion)
    return np.asarray(pixels[:, 0], dtype=np.float64)


def _round_length(longest_mm: float) -> float:
    power = 10 ** np.floor(np.log10(max(longest_mm, 1e-3)))
    return float(max(step for step in (1, 2, 5) if step * power <= longest_mm) * power)


def _height(size: Size) -> float:
    return WIDTH * size.height_px / size.width_px


def _arrow(middle: FloatArray, along: FloatArray, ink: str) -> Markup:
    """An arrow about its middle; a dot where it would be too short to see."""
    length = float(np.hypot(*along))
    if length < 1.5:
        return shape("circle", cx=float(middle[0]), cy=float(middle[1]), r=1.2, fill=ink)
    tip, tail = middle + along / 2, middle - along / 2
    ahead = along / length * min(5.0, length / 2)
    aside = np.array([-ahead[1], ahead[0]]) * 0.55
    head = np.array([tip - ahead + aside, tip, tip - ahead - aside])
    return shape("path", d=path(np.array([tail, tip]), head), class_="arrow", stroke=ink)

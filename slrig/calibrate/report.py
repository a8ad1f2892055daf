"""A solved calibration as one page of HTML with its drawings: verdict, error in mm, devices, poses; and remarks on each
pose.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slrig.bundle import read_description, read_pages, write_file
from slrig.calibrate.store import CalibrationResult, ReadPose, SessionRecord, Setting, plain
from slrig.calibration import (
    CELLS,
    PARAMETERS,
    PROJECTOR,
    Board,
    BoardPose,
    DeviceResiduals,
    ExpectedError,
    PoseObservation,
    device_title,
)
from slrig.calibration.judgement import describe_board
from slrig.calibration.poses import (
    Advice,
    Coverage,
    advise_pose,
    attitude,
    check_pose,
    coverage,
    draw_coverage,
    draw_pose,
    estimate_rig,
    projector_view,
)
from slrig.errors import BundleError
from slrig.model import LENS_TERMS, Calibration, FloatArray, Pinhole, Pixels, Size, White
from slrig.reports.page import WIDTH, drawing, filled, ink_on, jpeg_uri, legend, path, polygon, ramp_colour, shape

_INNER = PARAMETERS[:9]
_TURN = slice(9, 12)
_SHIFT = slice(12, 15)


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its standard deviation, which is 0 for a number that was held and not solved."""

    value: float
    sigma: float

    def shown(self, number: float) -> str:
        """A number with so many decimals that the deviation shows two digits, four if it is 0, and a true minus sign.

        >>> Figure(-1810.4, 0.213).shown(-1810.4), Figure(-0.12, 0.00031).shown(0.00031), Figure(842.0, 15.0).shown(15)
        ('−1810.40', '0.00031', '15')
        """
        digits = min(max(1 - math.floor(math.log10(self.sigma)), 0), 9) if self.sigma > 0 else 4
        return f"{number:.{digits}f}".replace("-", "−")


@dataclass(frozen=True, slots=True)
class DeviceFigures:
    """One device: its solved parameters, and its residuals.

    values : by the names of `PARAMETERS` that describe the lens, and of `terms` only; centre_mm : its centre of
    projection in the world, a figure for each of x, y, z.
    """

    name: str
    size: Size
    terms: tuple[str, ...]
    values: Mapping[str, Figure]
    centre_mm: tuple[Figure, Figure, Figure]
    residuals: DeviceResiduals

    @property
    def solved(self) -> Mapping[str, Figure]:
        """Its `values`, and its position unless that was held."""
        is_free = any(axis.sigma > 0 for axis in self.centre_mm)
        place = dict(zip(("x_mm", "y_mm", "z_mm"), self.centre_mm, strict=True))
        return {**self.values, **place} if is_free else self.values

    @property
    def held_out_ratio(self) -> float:
        """The rms at poses held out from the solve over the rms at those in it; NaN if there were too few."""
        return self.residuals.held_out_rms_px / self.residuals.rms_px if self.residuals.rms_px > 0 else math.nan


@dataclass(frozen=True, slots=True)
class Baseline:
    """Two devices: their distance, and the angle between their views of the middle of the working volume."""

    first: str
    second: str
    length_mm: Figure
    angle_deg: Figure


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """One pose of the board: rms by device; its tilt against the first camera's line of sight, and its distance.

    `left_out` is the reason why it was, and empty for a pose that was used; figures that need its place are NaN then.
    """

    name: str
    rms_px: Mapping[str, float]
    tilt_deg: float
    distance_mm: float
    left_out: str


def device_figures(result: CalibrationResult) -> tuple[DeviceFigures, ...]:
    """Every device, cameras in order, then the projector."""
    found = []
    for name, device, place in _device_rows(result.calibration):
        covariance = result.solution.covariance[place, place]
        terms = tuple(term for term in LENS_TERMS if term in result.solution.distortion.get(name, ()))
        numbers = [device.matrix[0, 0], device.matrix[1, 1], device.matrix[0, 2], device.matrix[1, 2]]
        numbers += device.distortion.tolist()
        sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        values = {
            each: Figure(float(number), float(sigma))
            for each, number, sigma in zip(_INNER, numbers, sigmas, strict=False)
            if each not in LENS_TERMS or each in terms
        }
        x, y, z = (_propagated([device], covariance, partial(_centre_mm, axis)) for axis in range(3))
        found.append(DeviceFigures(name, device.size, terms, values, (x, y, z), result.solution.residuals[name]))
    return tuple(found)


def baselines(result: CalibrationResult) -> tuple[Baseline, ...]:
    """Every pair of devices, in the order of the devices."""
    middle = result.expected.volume_mm.mean(axis=0)
    found = []
    for (first, one, own), (second, other, its) in combinations(_device_rows(result.calibration), 2):
        rows = np.r_[own, its]
        shared = result.solution.covariance[np.ix_(rows, rows)]
        length = _propagated((one, other), shared, lambda pair: float(np.linalg.norm(pair[1][1] - pair[0][1])))
        angle = _propagated((one, other), shared, lambda pair: _angle_deg(pair, middle))
        found.append(Baseline(first, second, length, angle))
    return tuple(found)


def pose_figures(result: CalibrationResult, board: Board, names: Sequence[str]) -> tuple[PoseFigures, ...]:
    """Every pose of `names`, in their order, and then others of the result."""
    solution = result.solution
    known = [*solution.poses, *solution.outliers]
    first = next(iter(result.calibration.cameras.values()))
    middle_mm = board.points_mm.mean(axis=0)
    found = []
    for name in dict.fromkeys([*(name for name in names if name in known), *known]):
        rms = {
            device: residuals.pose_rms_px[name]
            for device, residuals in solution.residuals.items()
            if name in residuals.pose_rms_px
        }
        tilt = distance = math.nan
        if (pose := solution.poses.get(name)) is not None:
            turned, moved_mm = first.rotation @ pose.rotation, first.rotation @ pose.translation_mm
            view = attitude(BoardPose(turned, moved_mm + first.translation_mm), middle_mm)
            tilt, distance = view.incidence_deg, view.distance_mm
        found.append(PoseFigures(name, rms, tilt, distance, solution.outliers.get(name, "")))
    return tuple(found)


def named_devices(calibration: Calibration) -> Mapping[str, Pinhole]:
    """Every device by its name, cameras in order, then the projector."""
    projector = {} if calibration.projector is None else {PROJECTOR: calibration.projector}
    return {**calibration.cameras, **projector}


def _device_rows(calibration: Calibration) -> list[tuple[str, Pinhole, slice]]:
    """Each device with its rows in the covariance."""
    rows = len(PARAMETERS)
    named = named_devices(calibration).items()
    return [(name, device, slice(rows * at, rows * (at + 1))) for at, (name, device) in enumerate(named)]


Posed = tuple[FloatArray, FloatArray]
"""A device's rotation, world to device, and its centre in the world, mm."""


def _centre_mm(axis: int, devices: Sequence[Posed]) -> float:
    """One coordinate of the first device's centre in the world."""
    return float(devices[0][1][axis])


def _propagated(
    devices: Sequence[Pinhole], covariance: FloatArray, number: Callable[[Sequence[Posed]], float]
) -> Figure:
    """A number of devices' poses with its standard deviation: sqrt(J C Jᵀ), J by differences one deviation wide."""
    rows = len(PARAMETERS)
    value = number([_moved(device, np.zeros(rows)) for device in devices])
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    slopes = np.zeros(len(sigmas))
    for row in np.flatnonzero(sigmas):
        ends = []
        for step in (-sigmas[row], sigmas[row]):
            change = np.zeros((len(devices), rows))
            change.flat[row] = step
            ends.append(number([_moved(device, own) for device, own in zip(devices, change, strict=True)]))
        slopes[row] = (ends[1] - ends[0]) / (2 * sigmas[row])
    return Figure(value, math.sqrt(max(float(slopes @ covariance @ slopes), 0.0)))


def _moved(device: Pinhole, change: FloatArray) -> Posed:
    rotation = Rotation.from_rotvec(change[_TURN]).as_matrix() @ device.rotation
    return rotation, -rotation.T @ (device.translation_mm + change[_SHIFT])


def _angle_deg(pair: Sequence[Posed], middle_mm: FloatArray) -> float:
    one, other = (middle_mm - centre for _, centre in pair)
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other)))


def rounded(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, never as a power of ten.

    >>> rounded(0.17672), rounded(0.000591), rounded(1253.4), rounded(0.0)
    ('0.177', '0.000591', '1253', '0')
    """
    if not value or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"


_ARROW_SHARE = 0.42
"""The longest arrow, of a cell's shorter side: it stays within the cell, in its middle."""
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
        title = shape("title", f"rms {rms:.3f} px of {count:,}; mean {mean[0]:+.3f}, {mean[1]:+.3f} px")
        parts += [
            shape("rect", title, **box, fill=fill, class_="cell"),
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

    The world is the first camera's frame: x to its right, y down, and a slice is drawn as the camera sees it.
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
        title = shape("title", f"x {place[_X]:.0f}, y {place[_Y]:.0f}, z {z_mm:.0f} mm: {rounded(error)} mm")
        # A little wider than the grid: no seams between neighbours of nearly one colour.
        parts.append(shape("rect", title, x=x, y=y, width=wide + 0.4, height=tall + 0.4, fill=ramp_colour(share)))
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

    The first camera points to the right. From above, so that its right (x) is down the page, or from aside (y down).
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

    def scaled(points: FloatArray) -> FloatArray:
        return np.asarray((points - low) * scale + _MARGIN)

    parts = [
        *(
            polygon(scaled(cone), "cone light" if name == PROJECTOR else "cone")
            for name, cone in zip(named, cones, strict=True)
        ),
        polygon(scaled(corners), "volume"),
        *(polygon(scaled(outline), "board") for outline in boards),
    ]
    spots = [scaled(device.centre_mm[axes]) for device in named.values()]
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
    """For each spot the distance of its label below it: below, unless another device is close by there; then above."""

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
    """(4 along, 3) float64: the edge of the print, in the world, `along` points to a side."""
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


_PICTURE_PX = 480
_QUALITY = 85
_MOST_DOTS = 1200


def report_html(
    result: CalibrationResult,
    poses: Sequence[ReadPose],
    pictures: Mapping[str, Mapping[str, Pixels]] | None = None,
    /,
    *,
    board: Board,
    title: str,
    remarks: Mapping[str, Sequence[str]] | None = None,
    refused: Mapping[str, str] | None = None,
    machine: str = "",
) -> str:
    """The report of a solved calibration.

    Parameters
    ----------
    poses : the poses that the solve was given, in their order.
    pictures : by pose and camera, its white frame, (H, W) or (H, W, 3) uint8, blue, green, red.
    remarks : by pose, what could be better about it. refused : by pose, why it could not be read at all.
    machine : name of the machine that solved it, for people.
    """
    expected = result.expected
    devices = device_figures(result)
    shown = pose_figures(result, board, [pose.observation.name for pose in poses])
    least_mm, most_mm = error_range_mm(expected)
    sides_mm = expected.volume_mm[1] - expected.volume_mm[0]
    return filled(
        "calibration.html",
        result=result,
        board=board,
        title=title,
        remarks=remarks or {},
        refused=refused or {},
        machine=machine,
        devices=devices,
        shown=shown,
        # The longest bar of each device's column.
        most_px={
            device.name: max((pose.rms_px.get(device.name, 0.0) for pose in shown), default=0.0) or 1.0
            for device in devices
        },
        pairs=baselines(result),
        least_mm=least_mm,
        most_mm=most_mm,
        sides_mm=tuple(sides_mm),
        diagonal_mm=float(np.linalg.norm(sides_mm)),
        pictures=list(_pictures(shown, poses, pictures or {}, board)),
        describe_board=describe_board,
        coverage=partial(_coverage, result, poses, board),
        error_slices=error_slices,
        longest_arrow_px=longest_arrow_px,
        residual_map=residual_map,
        device_title=device_title,
        legend=legend,
        rig_view=partial(rig_view, result.calibration, list(result.solution.poses.values()), board, expected.volume_mm),
        rounded=rounded,
    )


def _pictures(
    shown: Sequence[PoseFigures],
    poses: Sequence[ReadPose],
    pictures: Mapping[str, Mapping[str, Pixels]],
    board: Board,
) -> Iterable[tuple[str, str]]:
    """The address of each picture with corners drawn in, and its title."""
    views = {pose.observation.name: pose.observation.views for pose in poses}
    for pose in shown:
        for camera, picture in pictures.get(pose.name, {}).items():
            title = f"{pose.name}, {device_title(camera)}" + (" — left out" if pose.left_out else "")
            drawn = draw_pose(picture, views.get(pose.name, {}).get(camera), board, width_px=_PICTURE_PX)
            yield jpeg_uri(drawn[..., ::-1], _QUALITY), title


def _coverage(result: CalibrationResult, poses: Sequence[ReadPose], board: Board, name: str) -> Markup:
    device = named_devices(result.calibration)[name]
    used = [pose.observation for pose in poses if pose.observation.name not in result.solution.outliers]
    if name == PROJECTOR:
        parts = [projector_view(pose, device.size).positions_px for pose in used]
    else:
        parts = [pose.views[name].points_px for pose in used if name in pose.views]
    points = np.concatenate([np.zeros((0, 2)), *parts])
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_DOTS)).astype(int))
    return coverage_map(device, board, list(result.solution.poses.values()), points[chosen], name=name)


_MOST_LIGHT_SHOWN = 400


def pose_png(bundle: Path, camera: str, reading: ReadPose | None, board: Board) -> bytes:
    """Return what a camera saw of a pose: its white frame, and the corners if any were found. Raises BundleError."""
    view = None if reading is None else reading.observation.views.get(camera)
    return _png(draw_pose(white_frame(bundle, camera), view, board))


def white_frame(bundle: Path, camera: str) -> Pixels:
    """(H, W) or (H, W, 3) uint8: the first frame of a camera in which all is lit. Raises BundleError."""
    description = read_description(bundle)
    whites = {index for index, pattern in enumerate(description.pattern_list()) if isinstance(pattern, White)}
    for frame in description.frames:
        if frame.camera == camera and frame.pattern in whites:
            form = description.camera_formats()[camera]
            image = read_pages(bundle / frame.file, [frame.page], form)[frame.page]
            scaled = image if form.full_scale == 255 else image.astype(np.float32) * (255 / form.full_scale)
            return np.asarray(scaled, dtype=np.uint8)
    message = f"{bundle}: camera '{camera}' has no white frame; shoot the pose again"
    raise BundleError(message)


def coverage_png(setting: Setting, device: str, poses: Sequence[ReadPose], next_move: Mapping[str, Any]) -> bytes:
    """Picture of the board's positions in a device's view, or its light, and of the next one.

    next_move : as a session keeps it (`slrig.calibrate.report`).
    """
    size = setting.sizes[device]
    observations = [each.observation for each in poses]
    covered = coverage(observations, setting.board, setting.sizes)
    outline = next_move.get("outline_px") if next_move.get("camera") == device else None
    outline_px = np.asarray(outline, dtype=np.float64) if outline else None
    points = [_points_px(each, device, size) for each in observations]
    return _png(draw_coverage(covered.devices[device], points, size, outline_px=outline_px))


def _points_px(pose: PoseObservation, device: str, size: Size) -> FloatArray:
    """(n, 2) float64: the corners that a camera saw, or some of the pixels by which the projector lit the board."""
    if device == PROJECTOR:
        lit = projector_view(pose, size).positions_px
        return lit[:: max(len(lit) // _MOST_LIGHT_SHOWN, 1)]
    view = pose.views.get(device)
    return np.zeros((0, 2)) if view is None else view.points_px


def _png(picture: NDArray[np.uint8]) -> bytes:
    """The PNG of (H, W, 3) uint8: red, green, blue."""
    made, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    if not made:
        message = f"a picture of {picture.shape} could not be encoded as PNG"
        raise ValueError(message)
    return data.tobytes()


@dataclass(frozen=True, slots=True)
class SessionGuidance:
    """Guidance of a session: the coverage of its poses, and the next move with its reason; JSON values."""

    coverage: Mapping[str, Any]
    next_move: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Judgement:
    """Judgement of a pose. refusals : why it cannot be used; none if it can. answer : its figures, as JSON values.
    guidance : of the session with it, None where it could not be read.
    """

    refusals: tuple[str, ...]
    answer: Mapping[str, Any]
    guidance: SessionGuidance | None


_ANSWER = (
    "warnings",
    "corners_found",
    "corners_expected",
    "filled",
    "tilt_deg",
    "distance_mm",
    "sharpness_px",
    "saturated",
    "moved_px",
)
"""Fields of `slrig.calibration.poses.checks.PoseAssessment` that belong to the pose alone."""

_CHECK = ("poses", "difference_mm", "stated_mm", "ratio", "chance", "fits", "words")
"""Fields of `slrig.calibration.accuracy.OddEven` next to its `motion`."""


def judgement(pose: ReadPose, earlier: Sequence[ReadPose], setting: Setting) -> Judgement:
    """Judge a pose, with the accepted ones before it."""
    observations = [each.observation for each in earlier]
    found = check_pose(pose.observation, pose.figures, observations, setting.board, setting.sizes)
    guidance = _guidance(found.coverage, found.advice, pose.observation)
    return Judgement(found.refusals, _fields(found, *_ANSWER), guidance)


def session_guidance(poses: Sequence[ReadPose], setting: Setting) -> SessionGuidance:
    """Coverage of the accepted poses, and the next move."""
    observations = [each.observation for each in poses]
    guess = estimate_rig(observations, setting.board, setting.sizes)
    covered = coverage(observations, setting.board, setting.sizes, rig=guess)
    advice = advise_pose(observations, setting.board, setting.sizes, rig=guess, covered=covered)
    return _guidance(covered, advice, observations[-1] if observations else None)


def summary(result: CalibrationResult) -> Mapping[str, Any]:
    """Return the figures of a solve that an answer shows."""
    solution, bow, checked = result.solution, result.solution.bow, result.odd_even
    figures = {
        "devices": {
            each.name: {
                **_fields(each.residuals, "rms_px", "held_out_rms_px", "stated_rms_px", "outlying", "pose_rms_px"),
                "observations": each.residuals.count,
                "distortion": each.terms,
                "values": {name: astuple(figure) for name, figure in each.values.items()},
                "centre_mm": [astuple(figure) for figure in each.centre_mm],
            }
            for each in device_figures(result)
        },
        "baselines": baselines(result),
        "expected": _fields(
            result.expected, "point_mm", "noise_mm", "total_mm", "length_share", "across", "volume_mm", "board_mm"
        ),
        "odd_even": None if checked is None else {**_fields(checked, *_CHECK), **checked.motion._asdict()},
        "verdict": _fields(result.verdict, "grade", "summary", "reasons", "remarks", "unattended", "tolerance_mm"),
        "board": {
            "bowed": solution.board_shape_mm is not None,
            "bow_mm": None if bow is None else [bow.height_mm, bow.sigma_mm],
            "words": describe_board(solution),
            "scale_sigma": solution.size.scale_sigma,
            "stretch": [solution.size.stretch, solution.size.stretch_sigma],
        },
        "poses": list(solution.poses),
        "outliers": solution.outliers,
    }
    document: dict[str, Any] = plain(figures)
    return document


def write_report(
    path: Path, result: CalibrationResult, poses: Sequence[ReadPose], record: SessionRecord, bundles: Mapping[str, Path]
) -> None:
    """Write the report of a solve, with a picture of each pose. bundles : of the accepted poses, by name."""
    if record.board is None:
        raise TypeError(record)
    text = report_html(
        result,
        poses,
        {name: {camera: white_frame(bundle, camera) for camera in record.cameras} for name, bundle in bundles.items()},
        board=record.board,
        title=record.label or f"Rig '{record.rig}'",
        remarks={pose.name: list((pose.answer or {}).get("warnings", ())) for pose in record.accepted},
        refused={pose.name: pose.fault.message for pose in record.poses if pose.refused and pose.fault},
        machine=f"rig '{record.rig}'",
    )
    write_file(path, text.encode())


def warm() -> None:
    """Load what reading a pose needs, so that the first one is answered as fast as the others."""
    importlib.import_module("slrig.calibrate.pose_reading")


def _guidance(found: Coverage, advice: Advice, last: PoseObservation | None) -> SessionGuidance:
    """Last : the pose shot last, which shows the present place of the board."""
    shown = ("cells", "reachable", "share", "depths", "tilted", "turns", "distance_mm")
    devices = {name: _fields(each, *shown) for name, each in found.devices.items()}
    move = _fields(advice, "enough", "camera", "outline_px", "worst_px", "expected_px")
    view = None if last is None or advice.camera is None else last.views.get(advice.camera)
    from_px = None if view is None or not len(view.points_px) else view.points_px.mean(axis=0)
    next_move = {"words": advice.text, **move, "from_px": plain(from_px)}
    return SessionGuidance({**_fields(found, "poses", "missing"), "devices": devices}, next_move)


def _fields(value: object, *names: str) -> dict[str, Any]:
    """Some fields of a value as JSON values."""
    return {name: plain(getattr(value, name)) for name in names}

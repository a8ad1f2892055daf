"""Coverage of image, depth and tilt by the poses so far, and advice on the next pose."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind, PoseObservation
from slrig.calibration.poses.initial import (
    LENS_TERM_COUNT,
    MIN_CORNERS,
    MIN_SIGMA_PX,
    DeviceEstimate,
    RigEstimate,
    estimate_rig,
    is_in_image,
    lens_information,
    projection_jacobians,
)
from slrig.calibration.solution import CELLS, PROJECTOR, BoardPose, device_title
from slrig.model import FloatArray, IntArray, Size
from slrig.model.lens import distort

BoolArray = NDArray[np.bool_]

MAX_FOCAL_SIGMA = 0.15
"""Distances are NaN while the relative deviation of the focal length is larger."""

_MIN_LIT_SAMPLES = 3
_TILT_DEG = 30.0
"""Tilt of advised poses: the middle of the range that counts."""
_TILTS = ((0.0, 0.0), (_TILT_DEG, 0.0), (-_TILT_DEG, 0.0), (0.0, _TILT_DEG), (0.0, -_TILT_DEG))
_TURNS_DEG = (0.0, 35.0, 90.0)
_DISTANCE_FACTORS = (0.85, 1.0, 1.17)
_LARGE_DISTANCE_FACTORS = (1.4, 1.8, 2.4)
_MARGIN = 0.015
_FILLED_WIDTH = 0.55
"""Fraction of the image's width that the first pose should fill."""
_CENTRING_ITERATIONS = 4
_MIN_NEW_CELLS = 2
_SAME_DISTANCE = 0.04
_SAME_TURN_DEG = 10.0
_MIN_TILT_DEG = 5.0
_MAX_STATED_SIGMA_PX = 10.0
_MAX_REASONS = 3
_MAX_CANDIDATE_CORNERS = 30
_MIN_DEPTH_RANGE = 0.1
_MIN_GAIN = 0.03
"""Least relative decrease of the worst cell's uncertainty that is worth another pose."""


@dataclass(frozen=True, slots=True)
class Goals:
    """Goals for a good set of poses (usual in practice; our own values are marked *).

    cell_fraction : of the 36 cells of an image, those with a corner (projector: with light on the board) in some pose.
    depths : number of distances, each at least depth_step* (relative) from the next. tilt_deg : range of tilts that
    count; tilted* : poses with a tilt about each of the two axes. turns : number of angles in the board's plane,
    turn_step_deg* apart. min_poses*, max_poses : number of poses. max_sigma_px* : uncertainty of a corner in the worst
    cell.
    """

    cell_fraction: float = 0.8
    depths: int = 3
    depth_step: float = 0.05
    tilt_deg: tuple[float, float] = (15.0, 45.0)
    tilted: int = 2
    turns: int = 3
    turn_step_deg: float = 20.0
    min_poses: int = 12
    max_poses: int = 30
    max_sigma_px: float = 0.05


GOALS = Goals()


@dataclass(frozen=True, slots=True)
class Attitude:
    """Orientation and distance of the board in one device's frame.

    tilt_deg : (about the image's horizontal axis, about its vertical one); positive where the top edge, or the right
    edge, is nearer. turn_deg : in its plane, clockwise in the image. distance_mm : from the device to the board's
    centre along the optical axis. incidence_deg : between the board's normal and the line of sight.
    """

    tilt_deg: tuple[float, float]
    turn_deg: float
    distance_mm: float
    incidence_deg: float


@dataclass(frozen=True, slots=True)
class DeviceCoverage:
    """Coverage of one device.

    cells : (6, 6) int32, number of poses with a corner in the cell (projector: at least three lit samples). reachable :
    (6, 6) bool, cells in which a board can be visible: of a projector, those that some camera sees. attitudes : by
    pose. depths, turns : number of distinct ones. tilted : number of poses with a tilt about the image's horizontal and
    about its vertical axis. distance_mm : least and greatest, NaN while the focal length is not known. share : covered
    fraction of the reachable cells.
    """

    cells: IntArray
    reachable: BoolArray
    attitudes: Mapping[str, Attitude]
    depths: int
    tilted: tuple[int, int]
    turns: int
    distance_mm: tuple[float, float]
    share: float


@dataclass(frozen=True, slots=True)
class Coverage:
    """Coverage by the poses so far. missing : a description of each open goal; empty when the set is complete."""

    poses: tuple[str, ...]
    devices: Mapping[str, DeviceCoverage]
    missing: tuple[str, ...]


def coverage(
    poses: Sequence[PoseObservation], board: Board, sizes: Mapping[str, Size], *, rig: RigEstimate | None = None
) -> Coverage:
    """Measure the coverage of each device of `sizes` (cameras by name, and PROJECTOR where one is calibrated)."""
    rig = estimate_rig(poses, board, sizes) if rig is None else rig
    centre_mm = board.points_mm.mean(axis=0)
    devices = {}
    for name, size in sizes.items():
        device = rig.devices[name]
        cells = sum((_covered_cells(pose, name, size, rig) for pose in poses), np.zeros((CELLS, CELLS), dtype=np.int32))
        reachable = _reachable_cells(rig, name) | (cells > 0)
        attitudes = {each: attitude(board_pose, centre_mm) for each, board_pose in device.poses.items()}
        distances = [each.distance_mm for each in attitudes.values()]
        turns = [each.turn_deg for each in attitudes.values()]
        is_scaled = bool(distances) and device.focal_sigma <= MAX_FOCAL_SIGMA
        devices[name] = DeviceCoverage(
            cells,
            reachable,
            attitudes,
            len(distinct_depths(distances)),
            count_tilted(attitudes.values()),
            len(distinct_turns(turns, symmetry_angle_deg(board))),
            (min(distances), max(distances)) if is_scaled else (float("nan"), float("nan")),
            float((cells > 0)[reachable].mean()),
        )
    names = tuple(pose.name for pose in poses)
    return Coverage(names, devices, tuple(_open_goals(len(names), devices)))


def count_per_cell(points_px: FloatArray, size: Size) -> IntArray:
    """(6, 6) int32: number of points in each cell of an image. Points outside the image do not count."""
    extent = np.array([size.width_px, size.height_px], dtype=np.float64)
    place = np.floor((points_px + 0.5) / extent * CELLS).astype(np.int64)
    place = place[((place >= 0) & (place < CELLS)).all(axis=1)]
    counts = np.zeros((CELLS, CELLS), dtype=np.int32)
    np.add.at(counts, (place[:, 1], place[:, 0]), 1)
    return counts


def attitude(board_pose: BoardPose, centre_mm: FloatArray) -> Attitude:
    """Return the attitude of a board from its pose in the device's frame. centre_mm : of the board in its own frame."""
    normal, x_axis = board_pose.rotation[:, 2], board_pose.rotation[:, 0]
    centre = board_pose.rotation @ centre_mm + board_pose.translation_mm
    cosine = float(abs(normal @ centre) / np.linalg.norm(centre))
    angles = [
        np.arctan2(-normal[1], normal[2]), np.arctan2(normal[0], normal[2]), np.arctan2(x_axis[1], x_axis[0]),
        np.arccos(min(1.0, cosine)),
    ]  # fmt: skip
    tilt_x, tilt_y, turn_deg, incidence_deg = (float(np.degrees(angle)) for angle in angles)
    return Attitude((tilt_x, tilt_y), turn_deg, float(centre[2]), incidence_deg)


def distinct_depths(distances_mm: Sequence[float]) -> list[float]:
    """Return the distances that differ by at least `Goals.depth_step`, in ascending order, each the least of its group.

    >>> distinct_depths([600.0, 505.0, 500.0, 610.0, 700.0])
    [500.0, 600.0, 700.0]
    """
    groups: list[float] = []
    for distance in sorted(distances_mm):
        if not groups or distance >= (1 + GOALS.depth_step) * groups[-1]:
            groups.append(distance)
    return groups


def distinct_turns(turns_deg: Sequence[float], period_deg: float) -> list[float]:
    """Return angles at least `Goals.turn_step_deg` apart on the circle, in their original order.

    period_deg : angle after which the board looks the same.

    >>> distinct_turns([0.0, 178.0, 30.0, -175.0, 355.0], 360.0)
    [0.0, 178.0, 30.0]
    """
    groups: list[float] = []
    for turn in turns_deg:
        if all(abs(wrap_deg(turn - other, period_deg)) >= GOALS.turn_step_deg for other in groups):
            groups.append(turn)
    return groups


def wrap_deg(angle_deg: float, period_deg: float = 360.0) -> float:
    """Wrap an angle to half a period around zero.

    >>> wrap_deg(350.0), wrap_deg(175.0, 180.0)
    (-10.0, -5.0)
    """
    return (angle_deg + period_deg / 2) % period_deg - period_deg / 2


def symmetry_angle_deg(board: Board) -> float:
    """Return the angle after which a board in its plane looks the same: half a turn for some chessboards."""
    even = (board.columns + board.rows) % 2 == 0
    return 180.0 if board.kind is BoardKind.CHESSBOARD and even else 360.0


def count_tilted(attitudes: Iterable[Attitude]) -> tuple[int, int]:
    """Count the poses with a tilt in `Goals.tilt_deg` about the horizontal and about the vertical axis of the image."""
    low, high = GOALS.tilt_deg
    tilts = [each.tilt_deg for each in attitudes]
    return sum(low <= abs(x) <= high for x, _ in tilts), sum(low <= abs(y) <= high for _, y in tilts)


def describe_place(place: tuple[int, int]) -> str:
    """Name a part of an image.

    >>> describe_place((-1, 1)), describe_place((0, 0)), describe_place((1, 0))
    ('lower left corner', 'middle', 'right edge')
    """
    across, down = {-1: "left", 0: "", 1: "right"}[place[0]], {-1: "upper", 0: "", 1: "lower"}[place[1]]
    if across and down:
        return f"{down} {across} corner"
    return f"{across or down} edge" if across or down else "middle"


def _covered_cells(pose: PoseObservation, name: str, size: Size, rig: RigEstimate) -> IntArray:
    if name == PROJECTOR:
        return (count_per_cell(rig.projected_px[pose.name], size) >= _MIN_LIT_SAMPLES).astype(np.int32)
    view = pose.views.get(name)
    if view is None:
        return np.zeros((CELLS, CELLS), dtype=np.int32)
    return (count_per_cell(view.points_px, size) > 0).astype(np.int32)


def _reachable_cells(rig: RigEstimate, name: str) -> BoolArray:
    """(6, 6) bool: cells of a device in which a camera could see a board, at the distances of the poses so far.

    A projector may light more than the cameras see. Every cell of a camera is reachable.
    """
    everywhere = np.ones((CELLS, CELLS), dtype=np.bool_)
    projector = rig.devices[name]
    if name != PROJECTOR or not projector.poses:
        return everywhere
    cells = np.zeros((CELLS, CELLS), dtype=np.int32)
    for camera, device in rig.devices.items():
        transform = rig.relative_pose(camera, name)
        if camera == PROJECTOR or transform is None:
            continue
        size = device.size
        across, down = np.linspace(0, size.width_px - 1, 25), np.linspace(0, size.height_px - 1, 25)
        pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 1, 2)
        rays = cv2.undistortPoints(pixels, device.matrix, device.distortion).reshape(-1, 2)
        distances = [pose.translation_mm[2] for pose in device.poses.values()]
        for distance in (min(distances), max(distances)):
            camera_mm = np.column_stack([rays, np.ones(len(rays))]) * distance
            points_mm = camera_mm @ transform.rotation.T + transform.translation_mm
            points_px = points_mm[points_mm[:, 2] > 0] @ projector.matrix.T
            cells += count_per_cell(points_px[:, :2] / points_px[:, 2:], projector.size)
    return np.asarray(cells > 0, dtype=np.bool_) if cells.any() else everywhere


def _open_goals(count: int, devices: Mapping[str, DeviceCoverage]) -> list[str]:
    """Describe the open goals. Tilts, turns and depths are goals of cameras: the projector lights the same board."""
    missing, goals = [], GOALS
    for name, device in devices.items():
        title = device_title(name)
        if device.share < goals.cell_fraction:
            what = "lit on the board" if name == PROJECTOR else "covered"
            missing.append(f"{title}: {device.share:.0%} of the image {what}, {goals.cell_fraction:.0%} wanted")
        if name == PROJECTOR:
            continue
        if device.depths < goals.depths:
            missing.append(f"{title}: {device.depths} of {goals.depths} distances, {goals.depth_step:.0%} apart")
        for axis, edge in ((0, "top or bottom"), (1, "left or right")):
            if device.tilted[axis] < goals.tilted:
                low, high = goals.tilt_deg
                missing.append(
                    f"{title}: {device.tilted[axis]} of {goals.tilted} poses with the {edge} edge tilted "
                    f"{low:.0f}–{high:.0f}° towards it"
                )
        if device.turns < goals.turns:
            missing.append(f"{title}: {device.turns} of {goals.turns} angles in the board's plane")
    if count < goals.min_poses:
        missing.append(f"{count} of at least {goals.min_poses} poses")
    return missing


@dataclass(frozen=True, slots=True)
class PoseCandidate:
    """A pose to hold the board in, described for one camera.

    place : (-1, 0 or 1 across, the same down): left or top, middle, right or bottom. tilt_deg, turn_deg, distance_mm :
    nominal, as in `Attitude`. board_pose : in the camera's frame. outline_px : (4, 2) float64, the outer corners in its
    image.
    """

    place: tuple[int, int]
    tilt_deg: tuple[float, float]
    turn_deg: float
    distance_mm: float
    board_pose: BoardPose
    outline_px: FloatArray


def _pose_candidates(
    device: DeviceEstimate, board: Board, *, distance_mm: float, upright_deg: float
) -> list[PoseCandidate]:
    """Return all poses of a small grid that the camera sees; boards other than ChArUco are seen as a whole.

    distance_mm : the middle distance. upright_deg : usual angle of the board in its plane.
    """
    for factors in (_DISTANCE_FACTORS, _LARGE_DISTANCE_FACTORS):
        found = _place_candidates(device, board, [factor * distance_mm for factor in factors], upright_deg)
        if found:
            return found
    return []


def _initial_distance_mm(device: DeviceEstimate, board: Board) -> float:
    """Return the distance at which the board fills about half of the image."""
    width_mm, height_mm, _ = np.ptp(board.points_mm, axis=0)
    across = width_mm * device.matrix[0, 0] / device.size.width_px
    down = height_mm * device.matrix[1, 1] / device.size.height_px
    return float(max(across, down) / _FILLED_WIDTH)


def board_rotation(tilt_deg: tuple[float, float], turn_deg: float) -> FloatArray:
    """(3, 3) float64: turned in its plane, then about the image's vertical axis, then about its horizontal one."""
    rotation = np.eye(3)
    for axis, angle in ((2, turn_deg), (1, tilt_deg[1]), (0, tilt_deg[0])):
        vector = np.zeros(3)
        vector[axis] = np.radians(angle)
        rotation = cv2.Rodrigues(vector)[0] @ rotation
    return np.asarray(rotation, dtype=np.float64)


def _project_points(device: DeviceEstimate, points_mm: FloatArray) -> FloatArray:
    """Return (..., 2) float64: image of points (..., 3) in a device's frame; NaN behind the device.

    Projects all candidates at once, where OpenCV takes one call each.
    """
    depth = np.where(points_mm[..., 2] > 0, points_mm[..., 2], np.nan)
    x, y = points_mm[..., 0] / depth, points_mm[..., 1] / depth
    across, down, _, _, _ = distort(device.distortion, x, y)
    matrix = device.matrix
    return np.stack([matrix[0, 0] * across + matrix[0, 2], matrix[1, 1] * down + matrix[1, 2]], axis=-1)


def _sample_corners(board: Board, max_count: int) -> FloatArray:
    """(n, 3) float64: some of the board's corners, evenly in both directions, the outer four included."""
    grid = board.points_mm.reshape(board.rows, board.columns, 3)
    across = max(2, min(board.columns, round(float(np.sqrt(max_count * board.columns / board.rows)))))
    down = max(2, min(board.rows, max_count // across))
    rows = np.linspace(0, board.rows - 1, down).round().astype(int)
    columns = np.linspace(0, board.columns - 1, across).round().astype(int)
    return np.asarray(grid[np.ix_(rows, columns)].reshape(-1, 3), dtype=np.float64)


def _place_candidates(
    device: DeviceEstimate, board: Board, distances_mm: Sequence[float], upright_deg: float
) -> list[PoseCandidate]:
    """Place the board at the sides and corners of the image with all tilts, turns and distances."""
    kinds = list(product(product((-1, 0, 1), (-1, 0, 1)), _TILTS, _TURNS_DEG, distances_mm))
    place = np.array([kind[0] for kind in kinds], dtype=np.float64)
    depth = np.array([kind[3] for kind in kinds])
    turns = {(tilt, turn): board_rotation(tilt, upright_deg + turn) for tilt in _TILTS for turn in _TURNS_DEG}
    rotation = np.stack([turns[kind[1], kind[2]] for kind in kinds])
    last = board.corner_count - 1
    outer_mm = board.points_mm[[0, board.columns - 1, last, last - board.columns + 1]]
    rotated = np.einsum("cij,nj->cni", rotation, outer_mm - board.points_mm.mean(axis=0))
    centre = np.column_stack([np.zeros((len(kinds), 2)), depth])
    extent = np.array([device.size.width_px, device.size.height_px], dtype=np.float64)
    focal = np.array([device.matrix[0, 0], device.matrix[1, 1]])
    least, greatest = _MARGIN * extent, (1 - _MARGIN) * extent
    outline = _project_points(device, rotated + centre[:, None, :])
    for _ in range(_CENTRING_ITERATIONS):
        low, high = outline.min(axis=1), outline.max(axis=1)
        offset_px = np.where(place < 0, least - low, np.where(place > 0, greatest - high, (extent - low - high) / 2))
        centre[:, :2] += offset_px * depth[:, None] / focal
        outline = _project_points(device, rotated + centre[:, None, :])
    low, high = outline.min(axis=1), outline.max(axis=1)
    slack = 0.5 * _MARGIN * extent
    is_whole = ((low >= least - slack) & (high <= greatest + slack)).all(axis=1)
    middle_px = _project_points(device, centre[:, None, :])[:, 0]
    fits = is_whole if board.kind is not BoardKind.CHARUCO else is_in_image(middle_px, device.size)
    shift = centre - rotation @ board.points_mm.mean(axis=0)
    return [
        PoseCandidate(
            kind[0], kind[1], upright_deg + kind[2], kind[3], BoardPose(rotation[index], shift[index]), outline[index]
        )
        for index, kind in enumerate(kinds)
        if fits[index]
    ]


def _goals_advanced(
    candidate: PoseCandidate,
    rig: RigEstimate,
    covered: Coverage,
    transforms: Mapping[str, BoardPose],
    visible_px: Mapping[str, FloatArray],
) -> dict[str, list[str]]:
    """By device, the open goals that a candidate advances: cells, tilt, distance, turn.

    transforms : from the frame of the candidate's camera to each device's; visible_px : the corners visible to each.
    """
    advanced: dict[str, list[str]] = {}
    for name, points_px in visible_px.items():
        device, goals = covered.devices[name], advanced.setdefault(name, [])
        if not len(points_px):
            continue
        new_cells = (count_per_cell(points_px, rig.devices[name].size) > 0) & (device.cells == 0) & device.reachable
        if device.share < GOALS.cell_fraction and new_cells.sum() >= _MIN_NEW_CELLS:
            goals.append("cells")
        if name == PROJECTOR:
            continue
        transform, pose = transforms[name], candidate.board_pose
        rotation, shift = transform.rotation, transform.translation_mm
        device_pose = BoardPose(rotation @ pose.rotation, rotation @ pose.translation_mm + shift)
        new, earlier = attitude(device_pose, rig.board.points_mm.mean(axis=0)), list(device.attitudes.values())
        is_tilted = count_tilted([new])
        if any(device.tilted[axis] < GOALS.tilted and is_tilted[axis] for axis in (0, 1)):
            goals.append("tilt")
        distances = [each.distance_mm for each in (*earlier, new)]
        if device.depths < GOALS.depths and len(distinct_depths(distances)) > device.depths:
            goals.append("distance")
        turns = [each.turn_deg for each in (*earlier, new)]
        if device.turns < GOALS.turns and len(distinct_turns(turns, symmetry_angle_deg(rig.board))) > device.turns:
            goals.append("turn")
    return advanced


def _describe_move(candidate: PoseCandidate, camera: str, last: Attitude, upright_deg: float, period_deg: float) -> str:
    """Describe a move of the board in one clause.

    last : attitude of the board now; upright_deg : its usual angle; period_deg : angle after which it looks the same.
    """
    parts = [f"move the board to the {describe_place(candidate.place)} of camera '{camera}'"]
    about_x, about_y = candidate.tilt_deg
    if abs(about_x) >= _MIN_TILT_DEG:
        parts.append(f"tilt its {'top' if about_x > 0 else 'bottom'} edge {abs(about_x):.0f}° towards the camera")
    if abs(about_y) >= _MIN_TILT_DEG:
        parts.append(f"tilt its {'right' if about_y > 0 else 'left'} edge {abs(about_y):.0f}° towards the camera")
    if max(abs(about_x), abs(about_y)) < _MIN_TILT_DEG:
        parts.append("turn it to face the camera")
    turn = 5 * round(wrap_deg(candidate.turn_deg - last.turn_deg, period_deg) / 5)
    if abs(turn) > _SAME_TURN_DEG:
        parts.append(f"turn it {abs(turn):.0f}° {'clockwise' if turn > 0 else 'anticlockwise'} in its plane")
    elif abs(wrap_deg(candidate.turn_deg - upright_deg, period_deg)) > _SAME_TURN_DEG:
        parts.append("leave it turned in its plane as it is")
    change = candidate.distance_mm / last.distance_mm - 1
    if abs(change) > _SAME_DISTANCE:
        parts.append(f"bring it {abs(change):.0%} {'farther away' if change > 0 else 'nearer'}")
    return ", ".join(parts)


def _describe_reasons(
    camera: str, advanced: Mapping[str, Sequence[str]], worst: Mapping[str, float], expected: Mapping[str, float],
    worst_place: tuple[str, tuple[int, int]],
) -> str:  # fmt: skip
    """Describe why. advanced : of `_goals_advanced`; worst_place : least certain device, and the place in its image."""
    parts = ["parts of the image there are not covered yet"] if "cells" in advanced.get(camera, []) else []
    for name in (name for name, goals in advanced.items() if "cells" in goals and name != camera):
        image = "the projector's image" if name == PROJECTOR else f"the image of camera '{name}'"
        parts.append(f"it covers new parts of {image}")
    for goal, reason in (
        ("tilt", "too few poses are tilted that way"),
        ("distance", "the poses so far are at too few distances"),
        ("turn", "the board was not yet turned in its plane like this"),
    ):
        if any(goal in goals for goals in advanced.values()):
            parts.append(reason)
    parts = parts[:_MAX_REASONS]
    name, part = worst_place
    if worst[name] < _MAX_STATED_SIGMA_PX and expected[name] < worst[name]:
        parts.append(
            f"{device_title(name)} is least certain at its {describe_place(part)}, ±{worst[name]:.2g} px at the worst, "
            f"and about ±{expected[name]:.2g} px after this pose"
        )
    return "; ".join(parts) if parts else "it is the most informative pose now"


@dataclass(frozen=True, slots=True)
class Advice:
    """Advice on the next pose.

    text : one sentence or two. enough : the set is complete, as the text says. camera : the camera whose image the move
    refers to; None without a move. outline_px : (4, 2) float64, target of the board's outer corners in that image,
    clockwise in the print from corner 0; empty without a move. candidate : the move. worst_px : by device, the present
    uncertainty in its worst cell, and expected_px : with the move made; px per coordinate.
    """

    text: str
    enough: bool
    camera: str | None = None
    outline_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    candidate: PoseCandidate | None = None
    worst_px: Mapping[str, float] = field(default_factory=dict)
    expected_px: Mapping[str, float] = field(default_factory=dict)


def advise_pose(
    poses: Sequence[PoseObservation],
    board: Board,
    sizes: Mapping[str, Size],
    *,
    rig: RigEstimate | None = None,
    covered: Coverage | None = None,
) -> Advice:
    """Return the pose to shoot next.

    rig, covered : `estimate_rig` and `coverage` of the same poses, if available.
    """
    rig = estimate_rig(poses, board, sizes) if rig is None else rig
    covered = coverage(poses, board, sizes, rig=rig) if covered is None else covered
    cameras = [name for name in sizes if name != PROJECTOR and rig.devices[name].poses]
    if not cameras:
        return _first_advice(sizes)
    devices = {name: device for name, device in rig.devices.items() if device.poses}
    sensitivity = {name: _lens_sensitivity(device) for name, device in devices.items()}
    worst = {
        name: float(_cell_sigma_px(device.information[None], sensitivity[name]).max())
        for name, device in devices.items()
    }
    is_certain = not covered.missing and max(worst.values()) <= GOALS.max_sigma_px
    if is_certain or len(poses) >= GOALS.max_poses:
        return _completion_advice(covered, worst)
    camera = _most_uncertain_camera(cameras, rig, covered, worst)
    attitudes = list(covered.devices[camera].attitudes.values())
    distance_mm = float(np.median([each.distance_mm for each in attitudes]))
    upright_deg = 90.0 * round(attitudes[0].turn_deg / 90.0)
    candidates: list[PoseCandidate] = []
    for distance in (distance_mm, _initial_distance_mm(devices[camera], board)):
        candidates = candidates or _pose_candidates(
            devices[camera], board, distance_mm=distance, upright_deg=upright_deg
        )
    if not candidates:
        return _completion_advice(covered, worst)
    added = _add_candidates(candidates, camera, rig, board)
    after = {name: _cell_sigma_px(added.information[name], sensitivity[name]).max(axis=1) for name in devices}
    advanced = [
        _goals_advanced(candidate, rig, covered, added.transforms, added.visible_px(index))
        for index, candidate in enumerate(candidates)
    ]
    total = np.sum([(after[name] / device.matrix[0, 0]) ** 2 for name, device in devices.items()], axis=0)
    best = _best_candidate(advanced, total, added.device_count)
    now = float(np.sum([(worst[name] / device.matrix[0, 0]) ** 2 for name, device in devices.items()]))
    if not covered.missing and float(np.sqrt(total[best] / now)) > 1 - _MIN_GAIN:
        return _completion_advice(covered, worst)
    expected = {name: float(after[name][best]) for name in devices}
    move = _describe_move(candidates[best], camera, attitudes[-1], upright_deg, symmetry_angle_deg(board))
    reasons = _describe_reasons(camera, advanced[best], worst, expected, _worst_place(devices, sensitivity, worst))
    candidate = candidates[best]
    return Advice(f"{move}: {reasons}", False, camera, candidate.outline_px, candidate, worst, expected)


@dataclass(frozen=True, slots=True)
class _CandidateInformation:
    """By device: (c, 8, 8) information with each of c candidates added, the transform to its frame from the camera's,
    and the corners of each candidate with their visibility. device_count : (c,), devices that see enough corners.
    """

    information: Mapping[str, FloatArray]
    transforms: Mapping[str, BoardPose]
    points_px: Mapping[str, FloatArray]
    is_visible: Mapping[str, NDArray[np.bool_]]
    device_count: NDArray[np.int64]

    def visible_px(self, index: int) -> dict[str, FloatArray]:
        """By device, the visible corners of one candidate."""
        return {name: points[index][self.is_visible[name][index]] for name, points in self.points_px.items()}


def _lens_sensitivity(device: DeviceEstimate) -> FloatArray:
    """(k, 2, 36, 8) float64: derivative of projected points in the volume by the lens, rigid moves projected out.

    The points are in the 36 cells at k = 3 distances, over which the poses spread.
    """
    size = device.size
    across = (np.arange(CELLS) + 0.5) * size.width_px / CELLS - 0.5
    down = (np.arange(CELLS) + 0.5) * size.height_px / CELLS - 0.5
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 1, 2)
    rays = np.asarray(cv2.undistortPoints(pixels, device.matrix, device.distortion), dtype=np.float64).reshape(-1, 2)
    distances = [pose.translation_mm[2] for pose in device.poses.values()]
    median = float(np.median(distances))
    near, far = min(*distances, (1 - _MIN_DEPTH_RANGE) * median), max(*distances, (1 + _MIN_DEPTH_RANGE) * median)
    depths = np.array([near, (near + far) / 2, far])
    points_mm = (np.column_stack([rays, np.ones(len(rays))])[None] * depths[:, None, None]).reshape(-1, 3)
    _, lens, rigid = projection_jacobians(device, points_mm, BoardPose(np.eye(3), np.zeros(3)))
    absorbed, *_ = np.linalg.lstsq(rigid, lens, rcond=None)
    remaining = (lens - rigid @ absorbed).reshape(len(depths), CELLS * CELLS, 2, LENS_TERM_COUNT)
    return np.asarray(remaining.transpose(0, 2, 1, 3), dtype=np.float64)


def _cell_sigma_px(information: FloatArray, sensitivity: FloatArray) -> FloatArray:
    """(c, 36) float64: uncertainty in each cell, for each of c information matrices."""
    covariance = np.linalg.inv(information)
    flat = sensitivity.reshape(-1, LENS_TERM_COUNT)
    variance = np.einsum("ckj,kj->ck", flat @ covariance, flat)
    return np.asarray(np.sqrt(variance.reshape(len(information), -1, CELLS * CELLS).mean(axis=1)), dtype=np.float64)


def _add_candidates(
    candidates: Sequence[PoseCandidate], camera: str, rig: RigEstimate, board: Board
) -> _CandidateInformation:
    """Add the information of each candidate to that of each device."""
    points_mm = _sample_corners(board, _MAX_CANDIDATE_CORNERS)
    rotation = np.stack([candidate.board_pose.rotation for candidate in candidates])
    shift = np.stack([candidate.board_pose.translation_mm for candidate in candidates])
    information, transforms, points, is_visible = {}, {}, {}, {}
    device_count = np.zeros(len(candidates), dtype=np.int64)
    for name, device in rig.devices.items():
        if not device.poses:
            continue
        information[name] = np.repeat(device.information[None], len(candidates), axis=0)
        transform = rig.relative_pose(camera, name)
        if transform is None:
            continue
        rotations = transform.rotation @ rotation
        shifts = shift @ transform.rotation.T + transform.translation_mm
        points_px = _project_points(device, points_mm @ rotations.transpose(0, 2, 1) + shifts[:, None, :])
        flat = is_in_image(np.nan_to_num(points_px.reshape(-1, 2), nan=-1e9), device.size)
        visible = flat.reshape(points_px.shape[:2])
        if name != PROJECTOR and board.kind is not BoardKind.CHARUCO:
            visible &= visible.all(axis=1, keepdims=True)
        # The views' own deviations are those of one corner; the sample represents all corners.
        corner_px = max(MIN_SIGMA_PX, float(np.median([view.corner_sigma_px for view in device.views.values()])))
        sigma_px = corner_px * float(np.sqrt(len(points_mm) / board.corner_count))
        for index in np.flatnonzero(visible.sum(axis=1) >= MIN_CORNERS):
            board_pose = BoardPose(rotations[index], shifts[index])
            _, lens, pose = projection_jacobians(device, points_mm[visible[index]], board_pose)
            information[name][index] += lens_information(lens, pose, sigma_px)
            device_count[index] += 1
        transforms[name], points[name], is_visible[name] = transform, points_px, visible
    return _CandidateInformation(information, transforms, points, is_visible, device_count)


def _most_uncertain_camera(
    cameras: Sequence[str], rig: RigEstimate, covered: Coverage, worst: Mapping[str, float]
) -> str:
    """Return the camera with the most open goals, of several the least certain."""

    def rank(name: str) -> tuple[int, float]:
        open_goals = sum(f"'{name}'" in each for each in covered.missing)
        return open_goals, worst[name] / float(rig.devices[name].matrix[0, 0])

    return max(cameras, key=rank)


def _best_candidate(
    advanced: Sequence[Mapping[str, Sequence[str]]], total: FloatArray, device_count: NDArray[np.int64]
) -> int:
    """Return the candidate with the lowest total uncertainty, of those that advance an open goal if any does.

    Candidates that more devices see have priority.
    """
    is_useful = np.array([any(goals.values()) for goals in advanced])
    allowed = is_useful if is_useful.any() else np.ones(len(advanced), dtype=bool)
    allowed = allowed & (device_count == device_count[allowed].max())
    return int(np.argmin(np.where(allowed, total, np.inf)))


def _worst_place(
    devices: Mapping[str, DeviceEstimate], sensitivity: Mapping[str, FloatArray], worst: Mapping[str, float]
) -> tuple[str, tuple[int, int]]:
    """Return the least certain device (by angle) and the place of its worst cell, as `PoseCandidate.place`."""
    name = max(sensitivity, key=lambda each: worst[each] / float(devices[each].matrix[0, 0]))
    cells = _cell_sigma_px(devices[name].information[None], sensitivity[name])[0].reshape(CELLS, CELLS)
    row, column = np.unravel_index(int(np.argmax(cells)), cells.shape)
    third = CELLS // 3
    return name, (int(column) // third - 1, int(row) // third - 1)


def _first_advice(sizes: Mapping[str, Size]) -> Advice:
    """Return the advice before the first pose."""
    cameras = [name for name in sizes if name != PROJECTOR]
    others = " and visible to the others" if len(cameras) > 1 else ""
    light = ", lit by the projector" if PROJECTOR in sizes else ""
    text = (
        f"hold the board in the middle of the image of camera '{cameras[0]}', facing it{others}{light}, near enough to "
        "fill about half of the image: the first pose shows its size and distance"
    )
    return Advice(text, enough=False)


def _completion_advice(covered: Coverage, worst: Mapping[str, float]) -> Advice:
    """Return the advice to solve, since the set is complete or more poses would hardly help."""
    count = len(covered.poses)
    sigmas = ", ".join(f"{device_title(name)} to ±{sigma:.2g} px" for name, sigma in worst.items())
    remark = "" if max(worst.values(), default=np.inf) <= GOALS.max_sigma_px else ", and another would hardly help"
    text = f"enough: {count} poses determine {sigmas} in its worst place{remark}; solve now"
    if covered.missing:
        missing = "; ".join(covered.missing)
        text = f"{count} poses, and more hardly help. Still open: {missing}. Solve, and read the verdict"
    return Advice(text, enough=True, worst_px=worst)

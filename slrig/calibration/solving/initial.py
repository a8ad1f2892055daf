"""Initial values: cameras by Zhang's method, poses of the board, relative poses, projector.

Cameras: Zhang, "A flexible new technique for camera calibration", PAMI 22(11), 2000, as in OpenCV. The board's pose in
one camera: IPPE (Collins and Bartoli 2014). Each pose that two cameras share gives a transform between them, and the
one that most others agree with is taken. The corners of a chessboard that looks the same after half a turn may be
counted from either end: both are tried, and the one that agrees with the other poses is taken.

Parallel boards have one vanishing line and are parallel with any focal length, so they do not determine it. Tilts are
checked with the lens that was found and, if its focal length is poorly determined, with a typical one too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from slrig.calibration.board import COLUMN, ROW, Board, BoardKind, BoardView, Observations
from slrig.calibration.solving.projection import MIN_CORNERS, Measurements, device_row, pose_row
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray, Size

_ROUNDS = 12
_MIN_MATCHES = 50  # along each axis
MIN_POSES = 3
_MAX_SCATTER = 4.0
_MIN_TILT_DEG = 5.0
"""Minimum change of the board's tilt between any two poses, about one axis."""
_TYPICAL_FOCAL = 1.3  # over the image's width
_MAX_FOCAL_SIGMA = 0.01  # relative

_Lens = tuple[FloatArray, FloatArray]
"""Matrix (3, 3) and distortion (5,)."""


def estimate_projector(devices: FloatArray, poses: FloatArray, matches: Measurements, size: Size, /) -> FloatArray:
    """Estimate the projector as a row, (21,) float64, without distortion.

    devices : (c, 21), cameras; poses : (m, 12).

    Raises SolveRefusedError if there is too little light along one axis, or its image is mirrored.
    """
    axis = matches.match_where[:, 2]
    counts = [int((axis == each).sum()) for each in (COLUMN, ROW)]
    if min(counts) < _MIN_MATCHES:
        message = (
            f"the projector's light was decoded at {counts[COLUMN]} places along columns and {counts[ROW]} along rows, "
            "and both are needed: shoot the poses with patterns along both axes, so that the light reaches the board"
        )
        raise SolveRefusedError(message)
    points = intersect_board(devices, poses, matches)
    good = np.isfinite(points).all(axis=1)
    points, axis, position = points[good], axis[good], matches.match_px[good]
    matrix = _fit_projection_matrix(points, axis, position)
    return _decompose(matrix, points, size)


def intersect_board(devices: FloatArray, poses: FloatArray, matches: Measurements) -> FloatArray:
    """(k, 3) float64: intersection of each lit pixel's ray with the flat board, world, mm; NaN behind the camera."""
    points = np.full((len(matches.match_px), 3), np.nan)
    for camera, device in enumerate(devices):
        own = matches.match_where[:, 0] == camera
        if not own.any():
            continue
        matrix = np.array([[device[0], 0, device[2]], [0, device[1], device[3]], [0, 0, 1.0]])
        flat = cv2.undistortPoints(matches.match_pixel[own].reshape(-1, 1, 2), matrix, device[4:9]).reshape(-1, 2)
        turn, shift = device[9:18].reshape(3, 3), device[18:]
        rays = np.column_stack([flat, np.ones(len(flat))]) @ turn
        origin = -turn.T @ shift
        board = poses[matches.match_where[own, 1]]
        normal = board[:, [2, 5, 8]]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.einsum("ni,ni->n", normal, board[:, 9:] - origin) / np.einsum("ni,ni->n", normal, rays)
        points[own] = np.where(depth[:, None] > 0, origin + depth[:, None] * rays, np.nan)
    return points


def _fit_projection_matrix(points: FloatArray, axis: NDArray[np.int32], position: FloatArray) -> FloatArray:
    """(3, 4) float64: projection matrix by least squares in pixels with robust weights (Cauchy)."""
    centre_mm, extent = points.mean(axis=0), float(points.std())
    centre_px, spread_px = float(position.mean()), float(position.std())
    scaled = np.column_stack([(points - centre_mm) / extent, np.ones(len(points))])
    coordinate = (position - centre_px) / spread_px
    rows = np.zeros((len(points), 12))
    rows[:, 8:] = coordinate[:, None] * scaled
    for each in (COLUMN, ROW):
        own = np.flatnonzero(axis == each)
        rows[own, 4 * each : 4 * each + 4] = -scaled[own]
    weight = np.ones(len(points))
    solved = np.zeros((3, 4))
    for _ in range(_ROUNDS):
        weighted = rows * weight[:, None]
        solved = np.linalg.eigh(weighted.T @ weighted)[1][:, 0].reshape(3, 4)
        depth = scaled @ solved[2]
        depth = np.where(np.abs(depth) > 1e-6 * np.abs(depth).max(), depth, np.nan)
        residual = np.einsum("ni,ni->n", scaled, solved[axis]) / depth - coordinate
        scale = float(np.nanmedian(np.abs(residual))) / 0.6745 + 1e-12
        weight = np.nan_to_num(1 / np.abs(depth) / np.sqrt(1 + (residual / (2 * scale)) ** 2))
    to_pixels = np.array([[spread_px, 0, centre_px], [0, spread_px, centre_px], [0, 0, 1.0]])
    to_scaled = np.eye(4) / extent
    to_scaled[:3, 3] = -centre_mm / extent
    to_scaled[3, 3] = 1.0
    return np.asarray(to_pixels @ solved @ to_scaled)


def _decompose(matrix: FloatArray, points: FloatArray, size: Size) -> FloatArray:
    """Decompose a projection matrix (3, 4) into a device row (Hartley and Zisserman, §6.2.4)."""
    depth = np.column_stack([points, np.ones(len(points))]) @ matrix[2]
    matrix = matrix * (1 if np.median(depth) > 0 else -1)
    if np.linalg.det(matrix[:, :3]) < 0:
        message = (
            "the projector's image on the board is mirrored: its columns or rows run the other way round; switch off "
            "mirroring (rear or ceiling mode) in the projector and in the cameras"
        )
        raise SolveRefusedError(message)
    upper, rotation = rq(matrix[:, :3])
    signs = np.diag(np.sign(np.diagonal(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    lens = upper / upper[2, 2]
    if not np.isfinite(lens).all() or not 0.1 < lens[0, 0] / lens[1, 1] < 10 or lens[0, 0] > 1e3 * size.width_px:
        message = (
            f"the projector's light and the board's poses do not match (focal lengths {lens[0, 0]:.0f} and "
            f"{lens[1, 1]:.0f} px): shoot the board at several distances and tilts, and make sure that it does not move"
        )
        raise SolveRefusedError(message)
    return device_row(
        np.asarray(lens, dtype=np.float64),
        np.zeros(5),
        np.asarray(rotation, dtype=np.float64),
        np.linalg.solve(upper, matrix[:, 3]),
    )


@dataclass(frozen=True, slots=True)
class InitialValues:
    """Devices (c, 21) and poses (m, 12) as rows; NaN for a pose that no camera sees.

    flipped : by (camera, pose), True if that view is counted from the board's other end.
    """

    devices: FloatArray
    poses: FloatArray
    flipped: Mapping[tuple[int, int], bool] = field(default_factory=dict)


def estimate_initial_values(observations: Observations, /) -> InitialValues:
    """Estimate all cameras and poses.

    Raises SolveRefusedError if a camera has too few poses, parallel ones only, or shares none with the others.
    """
    names = list(observations.cameras)
    views = [_usable_views(observations, name) for name in names]
    lenses = [
        _calibrate_lens(observations.board, name, observations.cameras[name], views[camera], observations)
        for camera, name in enumerate(names)
    ]
    in_camera = {
        (camera, number): _board_in_camera(observations.board, lenses[camera], view)
        for camera, views_of_camera in enumerate(views)
        for number, view in views_of_camera.items()
    }
    return _connect_cameras(observations, lenses, in_camera)


def _usable_views(observations: Observations, name: str) -> dict[int, BoardView]:
    views = {}
    for number, pose in enumerate(observations.poses):
        view = pose.views.get(name)
        if view is not None and len(view.corner) >= MIN_CORNERS and _spans_plane(observations.board, view):
            views[number] = view
    return views


def _spans_plane(board: Board, view: BoardView) -> bool:
    """True if the corners are on more than one line of the board."""
    points = board.points_mm[view.corner, :2]
    return bool(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] > 0.5 * board.square_mm)


def _calibrate_lens(
    board: Board, name: str, size: Size, views: Mapping[int, BoardView], observations: Observations
) -> _Lens:
    """Calibrate one camera with its first radial term."""
    if len(views) < MIN_POSES:
        message = (
            f"camera '{name}' sees the board in {len(views)} of {len(observations.poses)} poses, and a calibration "
            f"needs at least {MIN_POSES}; shoot 15 to 20, tilted differently, all over its image"
        )
        raise SolveRefusedError(message)
    objects = [board.points_mm[view.corner] for view in views.values()]
    images = [view.points_px for view in views.values()]
    size_px = (size.width_px, size.height_px)
    flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    on_board, in_image = ([each.astype(np.float32) for each in arrays] for arrays in (objects, images))
    result = cv2.calibrateCamera(on_board, in_image, size_px, None, None, flags=flags)
    matrix, distortion = np.asarray(result[1], dtype=np.float64), np.concatenate([np.ravel(result[2]), np.zeros(5)])[:5]
    _refuse_parallel(name, size, (matrix, distortion), result[3:5], objects, images)
    return matrix, distortion


def _board_in_camera(board: Board, lens: _Lens, view: BoardView) -> FloatArray:
    """(4, 4) float64: transform from board to camera."""
    objects = board.points_mm[view.corner]
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        objects, view.points_px.astype(np.float64), lens[0], lens[1], flags=cv2.SOLVEPNP_IPPE
    )
    transform = np.eye(4)
    transform[:3, :3] = cv2.Rodrigues(turns[0])[0]
    transform[:3, 3] = np.ravel(shifts[0])
    return transform


def _half_turn(board: Board) -> FloatArray | None:
    """(4, 4) float64: from a board counted from its other end to the board; None if the ends look different.

    Half a turn maps a chessboard to itself if outermost squares opposite each other have the same colour.
    """
    if board.kind is not BoardKind.CHESSBOARD or (board.columns + board.rows) % 2:
        return None
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:3, 3] = board.points_mm[-1]
    return turn


def _connect_cameras(
    observations: Observations,
    lenses: list[_Lens],
    in_camera: Mapping[tuple[int, int], FloatArray],
) -> InitialValues:
    names = list(observations.cameras)
    half_turn = _half_turn(observations.board)
    connected: dict[int, FloatArray] = {0: np.eye(4)}
    in_world = {number: transform for (camera, number), transform in in_camera.items() if camera == 0}
    flipped: dict[tuple[int, int], bool] = {}
    while len(connected) < len(names):
        unconnected = [camera for camera in range(len(names)) if camera not in connected]
        shared = {camera: [n for (c, n) in in_camera if c == camera and n in in_world] for camera in unconnected}
        camera = max(unconnected, key=lambda index: len(shared[index]))
        if not shared[camera]:
            message = (
                f"camera '{names[camera]}' never saw the board in the same pose as "
                f"{', '.join(repr(names[other]) for other in sorted(connected))}: its pose is not determined; shoot at "
                "least three poses that both see"
            )
            raise SolveRefusedError(message)
        candidates = []
        for number in shared[camera]:
            transform, board_in_world = in_camera[camera, number], in_world[number]
            ends = [transform] if half_turn is None else [transform, transform @ half_turn]
            candidates.append([end @ np.linalg.inv(board_in_world) for end in ends])
        reach = float(np.median([np.linalg.norm(in_world[n][:3, 3]) for n in shared[camera]]))
        to_camera, chosen = _find_consensus(candidates, reach)
        connected[camera] = to_camera
        for number, choice in zip(shared[camera], chosen, strict=True):
            flipped[camera, number] = choice == 1
        to_world = np.linalg.inv(to_camera)
        for (other, number), transform in in_camera.items():
            if other == camera and number not in in_world:
                in_world[number] = to_world @ transform
    devices = [
        device_row(lenses[camera][0], lenses[camera][1], connected[camera][:3, :3], connected[camera][:3, 3])
        for camera in range(len(names))
    ]
    poses = np.full((len(observations.poses), 12), np.nan)
    for number, transform in in_world.items():
        poses[number] = pose_row(transform[:3, :3], transform[:3, 3])
    return InitialValues(np.array(devices), poses, flipped)


def _find_consensus(candidates: list[list[FloatArray]], reach: float) -> tuple[FloatArray, list[int]]:
    """Mean (4, 4) of the transform nearest to most others and those near it, and the chosen end of each pose's board.

    candidates : for each pose the transforms with either end of the board.
    """

    def distances(transform: FloatArray) -> FloatArray:
        return np.array([[_transform_distance_mm(transform, end, reach) for end in ends] for ends in candidates])

    every = [end for ends in candidates for end in ends]
    medians = [float(np.median(distances(candidate).min(axis=1))) for candidate in every]
    from_best = distances(every[int(np.argmin(medians))])
    chosen = [int(k) for k in np.argmin(from_best, axis=1)]
    nearest = from_best.min(axis=1)
    near = nearest <= max(_MAX_SCATTER * float(np.median(nearest)), 1e-9)
    agreeing = [ends[choice] for ends, choice, agrees in zip(candidates, chosen, near, strict=True) if agrees]
    mean = np.eye(4)
    left, _, right = np.linalg.svd(np.sum([transform[:3, :3] for transform in agreeing], axis=0))
    mean[:3, :3] = left @ right
    mean[:3, 3] = np.mean([transform[:3, 3] for transform in agreeing], axis=0)
    return mean, chosen


def _transform_distance_mm(first: FloatArray, second: FloatArray, reach: float) -> float:
    """Distance between the images of a point at the distance reach, mm."""
    turn = first[:3, :3] - second[:3, :3]
    return float(np.linalg.norm(turn) * reach / np.sqrt(2) + np.linalg.norm(first[:3, 3] - second[:3, 3]))


def _refuse_parallel(
    name: str, size: Size, lens: _Lens, poses: tuple[Sequence[FloatArray], Sequence[FloatArray]],
    objects: Sequence[FloatArray], images: Sequence[FloatArray], /,
) -> None:  # fmt: skip
    """Raise SolveRefusedError unless the boards of a camera's views have different tilts.

    poses : turns and shifts of the views with that lens; objects, images : corners on the board and in the image.
    """
    sideways, upright = _tilt_ranges_deg(lens, lens[0], objects, images)
    if not _focal_sigma_px(lens, poses, objects, images) <= _MAX_FOCAL_SIGMA * lens[0][0, 0]:
        focal = _TYPICAL_FOCAL * size.width_px
        typical = np.array([
            [focal, 0, (size.width_px - 1) / 2], [0, focal, (size.height_px - 1) / 2], [0, 0, 1]
        ])  # fmt: skip
        typical_tilts = _tilt_ranges_deg(lens, typical, objects, images)
        if max(typical_tilts) < max(sideways, upright):
            sideways, upright = typical_tilts
    if max(sideways, upright) >= _MIN_TILT_DEG:
        return
    message = (
        f"in camera '{name}' the board is nearly parallel in all {len(objects)} poses: between them it is tilted by "
        f"{sideways:.1f}° sideways and by {upright:.1f}° up and down, so that the focal length is not determined; "
        "shoot poses tilted by 20° to 40° to the left and to the right, and as much up and down"
    )
    raise SolveRefusedError(message)


def _tilt_ranges_deg(
    lens: _Lens, matrix: FloatArray, objects: Sequence[FloatArray], images: Sequence[FloatArray]
) -> tuple[float, float]:
    """Range of the tilts of the board's normal over all views, sideways and up and down, degrees.

    lens : corrects distortion; matrix : gives directions. The normal of a plane with the vanishing line l is Kᵀ l
    (Hartley and Zisserman, §8.6).
    """
    normals = []
    for on_board, in_image in zip(objects, images, strict=True):
        undistorted = cv2.undistortPoints(in_image.reshape(-1, 1, 2), lens[0], lens[1], P=lens[0]).reshape(-1, 2)
        homography, _ = cv2.findHomography(on_board[:, :2], undistorted)
        if homography is None:
            continue
        normal = matrix.T @ np.linalg.inv(homography).T @ np.array([0.0, 0.0, 1.0])
        normals.append(normal / np.linalg.norm(normal) * (1 if normal[2] > 0 else -1))
    directions = np.array(normals)
    sideways = np.degrees(np.arctan2(directions[:, 0], directions[:, 2]))
    upright = np.degrees(np.arctan2(directions[:, 1], directions[:, 2]))
    return float(np.ptp(sideways)), float(np.ptp(upright))


def _focal_sigma_px(
    lens: _Lens, poses: tuple[Sequence[FloatArray], Sequence[FloatArray]], objects: Sequence[FloatArray],
    images: Sequence[FloatArray],
) -> float:  # fmt: skip
    """Standard deviation of the focal length fx, px, with poses and one radial term unknown; infinite if undetermined.

    That of OpenCV is far too small near a singular matrix.
    """
    lens_count = 5
    information, squares, degrees_of_freedom = np.zeros((lens_count, lens_count)), 0.0, 0
    for turn, shift, on_board, in_image in zip(*poses, objects, images, strict=True):
        projected, jacobian = cv2.projectPoints(on_board.astype(np.float64), turn, shift, lens[0], lens[1])
        squares += float(np.sum((projected.reshape(-1, 2) - in_image) ** 2))
        degrees_of_freedom += 2 * len(in_image) - 6
        by_pose, by_lens = jacobian[:, :6], jacobian[:, 6 : 6 + lens_count]
        explained = np.linalg.lstsq(by_pose, by_lens, rcond=None)[0]
        reduced = by_lens - by_pose @ explained
        information += reduced.T @ reduced
    scale = 1 / np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if values[0] <= 1e-12 or degrees_of_freedom <= lens_count:
        return np.inf
    variance = float(np.sum(vectors[0] ** 2 / values)) * scale[0] ** 2
    return float(np.sqrt(variance * squares / (degrees_of_freedom - lens_count)))

"""Initial values: cameras by Zhang's method, poses of the board, relative poses, projector.

Zhang, "A flexible new technique for camera calibration", PAMI 22(11), 2000, as in OpenCV. The board's pose in one
camera comes of its corners (IPPE, Collins and Bartoli 2014). Cameras that see the board in the same pose are tied by
it; of all poses that two share, the tie that most agree with counts. A chessboard of which half a turn looks the same
may be counted from either end: both are tried, and the one that agrees with the other poses is taken.

Parallel boards have one vanishing line, and any lens turns one line into one normal: whatever the focal length, they
look parallel, and no focal length follows. So tilts are judged by the lens that was found; where its focal length is
all but open, by an ordinary one, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from slrig.calibration.board import COLUMN, ROW, Board, BoardKind, BoardView, Observations
from slrig.calibration.solving.projection import LEAST_CORNERS, Measurements, device_row, pose_row
from slrig.errors import SolveRefusedError
from slrig.model import FloatArray, Size

_ROUNDS = 12
_LEAST_EACH = 50


def projector_start(devices: FloatArray, poses: FloatArray, matches: Measurements, size: Size, /) -> FloatArray:
    """(21,) float64: the projector as a row, without distortion.

    devices : (c, 21), cameras; poses : (m, 12).

    Raises SolveRefusedError where there is too little light along one axis, or what it shows is a mirror image.
    """
    axis = matches.match_where[:, 2]
    counts = [int((axis == one).sum()) for one in (COLUMN, ROW)]
    if min(counts) < _LEAST_EACH:
        message = (
            f"the projector's light was decoded at {counts[COLUMN]} places along columns and {counts[ROW]} along rows, "
            "and both are needed: shoot the poses with patterns along both axes, so that the light reaches the board"
        )
        raise SolveRefusedError(message)
    points = met_points(devices, poses, matches)
    good = np.isfinite(points).all(axis=1)
    points, axis, position = points[good], axis[good], matches.match_px[good]
    matrix = _robust(points, axis, position)
    return _decomposed(matrix, points, size)


def met_points(devices: FloatArray, poses: FloatArray, matches: Measurements) -> FloatArray:
    """(k, 3) float64: where each lit pixel's ray meets the flat board, in the world, mm; NaN behind the camera."""
    points = np.full((len(matches.match_px), 3), np.nan)
    for camera, device in enumerate(devices):
        mine = matches.match_where[:, 0] == camera
        if not mine.any():
            continue
        matrix = np.array([[device[0], 0, device[2]], [0, device[1], device[3]], [0, 0, 1.0]])
        flat = cv2.undistortPoints(matches.match_pixel[mine].reshape(-1, 1, 2), matrix, device[4:9]).reshape(-1, 2)
        turn, shift = device[9:18].reshape(3, 3), device[18:]
        rays = np.column_stack([flat, np.ones(len(flat))]) @ turn
        origin = -turn.T @ shift
        board = poses[matches.match_where[mine, 1]]
        normal = board[:, [2, 5, 8]]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.einsum("ni,ni->n", normal, board[:, 9:] - origin) / np.einsum("ni,ni->n", normal, rays)
        points[mine] = np.where(depth[:, None] > 0, origin + depth[:, None] * rays, np.nan)
    return points


def _robust(points: FloatArray, axis: NDArray[np.int32], position: FloatArray) -> FloatArray:
    """(3, 4) float64: the matrix by least squares of pixels, what lies far off weighing less and less (Cauchy)."""
    middle, extent = points.mean(axis=0), float(points.std())
    centre, half = float(position.mean()), float(position.std())
    scaled = np.column_stack([(points - middle) / extent, np.ones(len(points))])
    coordinate = (position - centre) / half
    rows = np.zeros((len(points), 12))
    rows[:, 8:] = coordinate[:, None] * scaled
    for one in (COLUMN, ROW):
        mine = np.flatnonzero(axis == one)
        rows[mine, 4 * one : 4 * one + 4] = -scaled[mine]
    weight = np.ones(len(points))
    solved = np.zeros((3, 4))
    for _ in range(_ROUNDS):
        weighed = rows * weight[:, None]
        solved = np.linalg.eigh(weighed.T @ weighed)[1][:, 0].reshape(3, 4)
        depth = scaled @ solved[2]
        depth = np.where(np.abs(depth) > 1e-6 * np.abs(depth).max(), depth, np.nan)
        residual = np.einsum("ni,ni->n", scaled, solved[axis]) / depth - coordinate
        scale = float(np.nanmedian(np.abs(residual))) / 0.6745 + 1e-12
        weight = np.nan_to_num(1 / np.abs(depth) / np.sqrt(1 + (residual / (2 * scale)) ** 2))
    to_pixels = np.array([[half, 0, centre], [0, half, centre], [0, 0, 1.0]])
    to_scaled = np.eye(4) / extent
    to_scaled[:3, 3] = -middle / extent
    to_scaled[3, 3] = 1.0
    return np.asarray(to_pixels @ solved @ to_scaled)


def _decomposed(matrix: FloatArray, points: FloatArray, size: Size) -> FloatArray:
    """The device of a 3 x 4 matrix; see Hartley and Zisserman §6.2.4."""
    depth = np.column_stack([points, np.ones(len(points))]) @ matrix[2]
    matrix = matrix * (1 if np.median(depth) > 0 else -1)
    if np.linalg.det(matrix[:, :3]) < 0:
        message = (
            "the projector's light lies on the board as in a mirror: its columns or rows run the other way round than "
            "the cameras see them; switch off mirroring (rear or ceiling mode) in the projector and in the cameras"
        )
        raise SolveRefusedError(message)
    upper, rotation = rq(matrix[:, :3])
    signs = np.diag(np.sign(np.diagonal(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    lens = upper / upper[2, 2]
    if not np.isfinite(lens).all() or not 0.1 < lens[0, 0] / lens[1, 1] < 10 or lens[0, 0] > 1e3 * size.width_px:
        message = (
            f"the projector's light and the board's poses do not fit one another (focal lengths {lens[0, 0]:.0f} and "
            f"{lens[1, 1]:.0f} px): shoot the board at several distances and tilts, and make sure that it stands still"
        )
        raise SolveRefusedError(message)
    return device_row(
        np.asarray(lens, dtype=np.float64),
        np.zeros(5),
        np.asarray(rotation, dtype=np.float64),
        np.linalg.solve(upper, matrix[:, 3]),
    )


LEAST_POSES = 3
_MOST_SCATTER = 4.0
_LEAST_TILT_DEG = 5.0
"""The least turn of the board between some two poses, about one axis."""

_ORDINARY_FOCAL = 1.3  # over the image's width
_WELL_KNOWN = 0.01

_Lens = tuple[FloatArray, FloatArray]
"""Matrix (3, 3) and distortion (5,)."""


@dataclass(frozen=True, slots=True)
class Start:
    """Devices (c, 21) and poses (m, 12) as rows; NaN where a pose was seen by no camera.

    flipped : by (camera, pose), whether that view is counted from the board's other end.
    """

    devices: FloatArray
    poses: FloatArray
    flipped: Mapping[tuple[int, int], bool] = field(default_factory=dict)


def start_of(observations: Observations, /) -> Start:
    """A start for all cameras and poses.

    Raises SolveRefusedError where a camera has too few poses, all of them parallel, or shares none with the others.
    """
    names = list(observations.cameras)
    views = [_views(observations, name) for name in names]
    lenses = [
        _lens(observations.board, name, observations.cameras[name], views[camera], observations)
        for camera, name in enumerate(names)
    ]
    in_camera = {
        (camera, number): _seen_from(observations.board, lenses[camera], view)
        for camera, of_camera in enumerate(views)
        for number, view in of_camera.items()
    }
    return _tied(observations, lenses, in_camera)


def _views(observations: Observations, name: str) -> dict[int, BoardView]:
    found = {}
    for number, pose in enumerate(observations.poses):
        view = pose.views.get(name)
        if view is not None and len(view.corner) >= LEAST_CORNERS and _spans(observations.board, view):
            found[number] = view
    return found


def _spans(board: Board, view: BoardView) -> bool:
    """Whether the corners lie on more than one line of the board."""
    points = board.points_mm[view.corner, :2]
    return bool(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] > 0.5 * board.square_mm)


def _lens(board: Board, name: str, size: Size, views: Mapping[int, BoardView], observations: Observations) -> _Lens:
    """Matrix (3, 3) and distortion (5,) of one camera, its first radial term solved for."""
    if len(views) < LEAST_POSES:
        message = (
            f"camera '{name}' saw the board in {len(views)} of {len(observations.poses)} poses, and a calibration "
            f"needs {LEAST_POSES} at the very least; shoot 15 to 20, tilted differently, all over its image"
        )
        raise SolveRefusedError(message)
    objects = [board.points_mm[view.corner] for view in views.values()]
    images = [view.points_px for view in views.values()]
    shape = (size.width_px, size.height_px)
    flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    on_board, in_image = ([each.astype(np.float32) for each in arrays] for arrays in (objects, images))
    found = cv2.calibrateCamera(on_board, in_image, shape, None, None, flags=flags)
    matrix, distortion = np.asarray(found[1], dtype=np.float64), np.concatenate([np.ravel(found[2]), np.zeros(5)])[:5]
    _refuse_parallel(name, size, (matrix, distortion), found[3:5], objects, images)
    return matrix, distortion


def _seen_from(board: Board, lens: _Lens, view: BoardView) -> FloatArray:
    """(4, 4) float64: board to camera."""
    objects = board.points_mm[view.corner]
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        objects, view.points_px.astype(np.float64), lens[0], lens[1], flags=cv2.SOLVEPNP_IPPE
    )
    seen = np.eye(4)
    seen[:3, :3] = cv2.Rodrigues(turns[0])[0]
    seen[:3, 3] = np.ravel(shifts[0])
    return seen


def _half_turn(board: Board) -> FloatArray | None:
    """(4, 4) float64: from a board counted from its other end to the board; None where the ends look different.

    Half a turn maps a chessboard on itself where its outermost squares opposite each other have one colour.
    """
    if board.kind is not BoardKind.CHESSBOARD or (board.columns + board.rows) % 2:
        return None
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:3, 3] = board.points_mm[-1]
    return turn


def _tied(
    observations: Observations,
    lenses: list[_Lens],
    in_camera: Mapping[tuple[int, int], FloatArray],
) -> Start:
    names = list(observations.cameras)
    half_turn = _half_turn(observations.board)
    worlds: dict[int, FloatArray] = {0: np.eye(4)}
    in_world = {number: seen for (camera, number), seen in in_camera.items() if camera == 0}
    flipped: dict[tuple[int, int], bool] = {}
    while len(worlds) < len(names):
        waiting = [camera for camera in range(len(names)) if camera not in worlds]
        shared = {camera: [n for (c, n) in in_camera if c == camera and n in in_world] for camera in waiting}
        camera = max(waiting, key=lambda one: len(shared[one]))
        if not shared[camera]:
            message = (
                f"camera '{names[camera]}' never saw the board in the same pose as "
                f"{', '.join(repr(names[other]) for other in sorted(worlds))}: where it stands is not determined; "
                "shoot at least three poses that both see"
            )
            raise SolveRefusedError(message)
        ties = []
        for number in shared[camera]:
            seen, known = in_camera[camera, number], in_world[number]
            ends = [seen] if half_turn is None else [seen, seen @ half_turn]
            ties.append([end @ np.linalg.inv(known) for end in ends])
        reach = float(np.median([np.linalg.norm(in_world[n][:3, 3]) for n in shared[camera]]))
        agreed, chosen = _agreed(ties, reach)
        worlds[camera] = agreed
        for number, choice in zip(shared[camera], chosen, strict=True):
            flipped[camera, number] = choice == 1
        back = np.linalg.inv(agreed)
        for (other, number), seen in in_camera.items():
            if other == camera and number not in in_world:
                in_world[number] = back @ seen
    devices = [
        device_row(lenses[camera][0], lenses[camera][1], worlds[camera][:3, :3], worlds[camera][:3, 3])
        for camera in range(len(names))
    ]
    poses = np.full((len(observations.poses), 12), np.nan)
    for number, seen in in_world.items():
        poses[number] = pose_row(seen[:3, :3], seen[:3, 3])
    return Start(np.array(devices), poses, flipped)


def _agreed(ties: list[list[FloatArray]], reach: float) -> tuple[FloatArray, list[int]]:
    """The tie (4, 4) that lies nearest to most, its mean with those near it, and which end of the board poses took."""

    def distances(of: FloatArray) -> FloatArray:
        """(poses, ends): by how many mm points as far off as the board come to lie apart."""
        return np.array([[_apart(of, end, reach) for end in ends] for ends in ties])

    candidates = [end for ends in ties for end in ends]
    medians = [float(np.median(distances(candidate).min(axis=1))) for candidate in candidates]
    best = candidates[int(np.argmin(medians))]
    far = distances(best)
    chosen = [int(k) for k in np.argmin(far, axis=1)]
    nearest = far.min(axis=1)
    near = nearest <= max(_MOST_SCATTER * float(np.median(nearest)), 1e-9)
    taken = [ends[choice] for ends, choice, kept in zip(ties, chosen, near, strict=True) if kept]
    mean = np.eye(4)
    left, _, right = np.linalg.svd(np.sum([tie[:3, :3] for tie in taken], axis=0))
    mean[:3, :3] = left @ right
    mean[:3, 3] = np.mean([tie[:3, 3] for tie in taken], axis=0)
    return mean, chosen


def _apart(first: FloatArray, second: FloatArray, reach: float) -> float:
    turn = first[:3, :3] - second[:3, :3]
    return float(np.linalg.norm(turn) * reach / np.sqrt(2) + np.linalg.norm(first[:3, 3] - second[:3, 3]))


def _refuse_parallel(
    name: str, size: Size, lens: _Lens, found: tuple[Sequence[FloatArray], Sequence[FloatArray]],
    objects: Sequence[FloatArray], images: Sequence[FloatArray], /,
) -> None:  # fmt: skip
    """Raise SolveRefusedError unless the boards of a camera's views are tilted to one another.

    found : turns and shifts of the views with that lens; objects, images : corners on the board and in the image.
    """
    sideways, upright = _tilts_deg(lens, lens[0], objects, images)
    if not _focal_deviation(lens, found, objects, images) <= _WELL_KNOWN * lens[0][0, 0]:
        focal = _ORDINARY_FOCAL * size.width_px
        ordinary = np.array([
            [focal, 0, (size.width_px - 1) / 2], [0, focal, (size.height_px - 1) / 2], [0, 0, 1]
        ])  # fmt: skip
        by_ordinary = _tilts_deg(lens, ordinary, objects, images)
        if max(by_ordinary) < max(sideways, upright):
            sideways, upright = by_ordinary
    if max(sideways, upright) >= _LEAST_TILT_DEG:
        return
    message = (
        f"in camera '{name}' the board is all but parallel to itself in all {len(objects)} poses: between them "
        f"it turns by {sideways:.1f}° sideways and nods by {upright:.1f}°, so that the focal length is not determined; "
        "shoot poses turned by 20° to 40° to the left and to the right, and nodded as much up and down"
    )
    raise SolveRefusedError(message)


def _tilts_deg(
    lens: _Lens, matrix: FloatArray, objects: Sequence[FloatArray], images: Sequence[FloatArray]
) -> tuple[float, float]:
    """Between all views, by how many degrees the board's normal turns sideways, and up and down.

    Distortion is taken off by the lens, directions are told by the matrix. The normal of a plane that vanishes in the
    line l is Kᵀ l (Hartley and Zisserman, §8.6).
    """
    normals = []
    for on_board, in_image in zip(objects, images, strict=True):
        straight = cv2.undistortPoints(in_image.reshape(-1, 1, 2), lens[0], lens[1], P=lens[0]).reshape(-1, 2)
        homography, _ = cv2.findHomography(on_board[:, :2], straight)
        if homography is None:
            continue
        normal = matrix.T @ np.linalg.inv(homography).T @ np.array([0.0, 0.0, 1.0])
        normals.append(normal / np.linalg.norm(normal) * (1 if normal[2] > 0 else -1))
    spread = np.array(normals)
    turned = np.degrees(np.arctan2(spread[:, 0], spread[:, 2]))
    nodded = np.degrees(np.arctan2(spread[:, 1], spread[:, 2]))
    return float(np.ptp(turned)), float(np.ptp(nodded))


def _focal_deviation(
    lens: _Lens, found: tuple[Sequence[FloatArray], Sequence[FloatArray]], objects: Sequence[FloatArray],
    images: Sequence[FloatArray],
) -> float:  # fmt: skip
    """Standard deviation of the focal length (fx), px, the poses and one radial term open; infinite where it is open.

    OpenCV states one of its own, and near a singular matrix that is far too small.
    """
    inner = 5
    whole, squares, count = np.zeros((inner, inner)), 0.0, 0
    for turn, shift, on_board, in_image in zip(*found, objects, images, strict=True):
        projected, jacobian = cv2.projectPoints(on_board.astype(np.float64), turn, shift, lens[0], lens[1])
        squares += float(np.sum((projected.reshape(-1, 2) - in_image) ** 2))
        count += 2 * len(in_image) - 6
        of_pose, of_lens = jacobian[:, :6], jacobian[:, 6 : 6 + inner]
        held = np.linalg.lstsq(of_pose, of_lens, rcond=None)[0]
        left = of_lens - of_pose @ held
        whole += left.T @ left
    scale = 1 / np.sqrt(np.maximum(np.diagonal(whole), 1e-300))
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    if values[0] <= 1e-12 or count <= inner:
        return np.inf
    variance = float(np.sum(vectors[0] ** 2 / values)) * scale[0] ** 2
    return float(np.sqrt(variance * squares / (count - inner)))

"""Rough estimate of devices and poses while poses still arrive, from boards and from projected light.

Each device is fitted alone, its lens with a prior that stands where the poses do not speak yet: one pose already gives
an answer, and poses that are all parallel do no harm. What a solve gives is better, and takes longer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import COLUMN, Board, BoardView, Correspondences, PoseObservation
from slrig.calibration.solution import PROJECTOR, BoardPose
from slrig.model import FloatArray, Size

_MOST_SAMPLES = 2500
_FEWEST_SAMPLES = 40
_TURNS = 3
_WIDE = 3.0
"""Correspondences farther off than this many robust deviations are left out of the map."""

_LEAST_SPREAD_PX = 0.5
LEAST_SIGMA_PX = 0.03
"""No corner is trusted to be better known than this, whatever its detector states."""


@dataclass(frozen=True, slots=True)
class LitBoard:
    """One pose as the projector would see it.

    view : the board's corners in its image; of several cameras, the one with the most counts; None where no camera has
    enough light on them. positions_px : (n, 2) float64, (column, row) of a sample of the pixels lit on the board.
    """

    view: BoardView | None
    positions_px: FloatArray


def lit_board(pose: PoseObservation, size: Size) -> LitBoard:
    """Return one pose as a projector of this size would see it. Corners that lie outside its image are left out."""
    best: BoardView | None = None
    positions = [np.zeros((0, 2))]
    for camera, light in pose.correspondences.items():
        to_projector = plane_map(light)
        if to_projector is None:
            continue
        positions_px = mapped(to_projector, _sample(light).pixels_px)
        positions.append(positions_px[within(positions_px, size)])
        view = pose.views.get(camera)
        if view is None:
            continue
        points_px = mapped(to_projector, view.points_px)
        inside = within(points_px, size)
        sigma_px = np.full(int(inside.sum()), _corner_sigma(light, len(view.corner)))
        found = BoardView(view.corner[inside], points_px[inside], sigma_px)
        if best is None or len(found.corner) > len(best.corner):
            best = found
    return LitBoard(best, np.concatenate(positions))


def plane_map(light: Correspondences) -> FloatArray | None:
    """Return the (3, 3) float64 homography from camera pixels to projector (column, row), or None without one.

    Each correspondence gives one linear equation, u (h3·p) = h_axis·p (Hartley and Zisserman, chapter 4), so that
    columns and rows need not come from the same pixels. Fitted again without what lies far off.
    """
    few = _sample(light)
    along_column = few.axis == COLUMN
    if min(int(along_column.sum()), int((~along_column).sum())) < _FEWEST_SAMPLES:
        return None
    columns, rows = few.position_px[along_column], few.position_px[~along_column]
    in_camera = _scaling(few.pixels_px.mean(axis=0), float(few.pixels_px.std()))
    middle = np.array([np.median(columns), np.median(rows)])
    in_projector = _scaling(middle, max(float(columns.std()), float(rows.std())))
    points = np.column_stack([few.pixels_px, np.ones(len(few.axis))]) @ in_camera.T
    position = few.position_px * np.where(along_column, in_projector[0, 0], in_projector[1, 1])
    position = position + np.where(along_column, in_projector[0, 2], in_projector[1, 2])
    rows = np.zeros((len(points), 9))
    rows[along_column, 0:3] = points[along_column]
    rows[~along_column, 3:6] = points[~along_column]
    rows[:, 6:9] = -position[:, None] * points
    keep = np.ones(len(points), dtype=bool)
    solved = np.eye(3)
    for _ in range(_TURNS):
        _, vectors = np.linalg.eigh(rows[keep].T @ rows[keep])
        solved = vectors[:, 0].reshape(3, 3)
        depth = points @ solved[2]
        if not (np.abs(depth) > 1e-9).all():
            return None
        off = np.abs(np.where(along_column, points @ solved[0], points @ solved[1]) / depth - position)
        spread = 1.4826 * float(np.median(off[keep]))
        fresh = off <= max(_WIDE * spread, _LEAST_SPREAD_PX * float(in_projector[0, 0]))
        if fresh.sum() < 2 * _FEWEST_SAMPLES or (fresh == keep).all():
            break
        keep = fresh
    return np.asarray(np.linalg.inv(in_projector) @ solved @ in_camera, dtype=np.float64)


def mapped(homography: FloatArray, points_px: FloatArray) -> FloatArray:
    """(n, 2) float64: points taken through a (3, 3) homography."""
    ends = np.column_stack([points_px, np.ones(len(points_px))]) @ homography.T
    return np.asarray(ends[:, :2] / ends[:, 2:], dtype=np.float64)


def within(points_px: FloatArray, size: Size) -> NDArray[np.bool_]:
    """(n,) bool: whether each point lies in an image of this size, whose pixel centres are at whole numbers."""
    inside = (points_px > -0.5) & (points_px < np.array([size.width_px, size.height_px]) - 0.5)
    return np.asarray(inside.all(axis=1), dtype=np.bool_)


def _sample(light: Correspondences) -> Correspondences:
    step = max(1, len(light.axis) // _MOST_SAMPLES)
    # An odd step: with an even one, columns and rows that come by turns would leave one axis out.
    every = slice(None, None, step + (1 - step % 2))
    return Correspondences(light.pixels_px[every], light.axis[every], light.position_px[every], light.sigma_px[every])


def _corner_sigma(light: Correspondences, corners: int) -> float:
    """Deviation of a corner in the projector: that of its light, averaged over the pixels that belong to it."""
    per_corner = max(1.0, len(light.axis) / (2 * max(corners, 1)))
    return max(LEAST_SIGMA_PX, float(np.median(light.sigma_px)) / float(np.sqrt(per_corner)))


def _scaling(middle: FloatArray, spread: float) -> FloatArray:
    """A similarity that brings points about a middle to the origin at unit spread, which the linear solve needs."""
    spread = max(spread, 1e-6)
    return np.array([[1 / spread, 0, -middle[0] / spread], [0, 1 / spread, -middle[1] / spread], [0, 0, 1]])


LENS = 8
"""Terms of a lens in a guess: fx, fy, cx, cy, k1, k2, p1, p2."""

FEWEST_CORNERS = 6
_MOST_CORNERS = 40
_NOMINAL_FOCAL = 1.2
"""Focal length over the image's width before any pose tells: a lens of 45° across."""

_FOCAL_RANGE = (0.3, 12.0)
_STEPS = 12
_SETTLED = 1e-4
_FEW_POSES = 6

_SIGMA_FOCAL = 0.7
_SIGMA_ASPECT = 0.02
_SIGMA_CENTRE = 0.1
_SIGMA_SHIFTED = 1.0
_SIGMA_TERMS = (0.3, 0.6, 0.005, 0.005)


@dataclass(frozen=True, slots=True)
class SeenBoard:
    """A view made ready: (n, 3) mm, (n, 2) px, a part of its corners.

    corner_sigma_px : deviation of one coordinate of a corner; sigma_px : what these few count for, standing for all.
    """

    points_mm: FloatArray
    points_px: FloatArray
    corner_sigma_px: float
    sigma_px: float


@dataclass(frozen=True, slots=True)
class DeviceGuess:
    """One device as the poses so far tell it.

    matrix : (3, 3); distortion : (5,), k3 zero; information : (8, 8) float64, inverse covariance of the lens (`LENS`),
    with the poses solved for and the prior counted in; seen, poses : by pose, where the board stood in the device's own
    frame, X_device = R X_board + t. focal_sigma : deviation of the focal length, as a share of it.
    """

    size: Size
    matrix: FloatArray
    distortion: FloatArray
    information: FloatArray
    seen: Mapping[str, SeenBoard]
    poses: Mapping[str, BoardPose]

    @property
    def focal_sigma(self) -> float:
        """Deviation of the focal length over the focal length."""
        return float(np.sqrt(np.linalg.inv(self.information)[0, 0]) / self.matrix[0, 0])


@dataclass(frozen=True, slots=True)
class RigGuess:
    """All devices of a rig: cameras in order, then the projector where there is one.

    lit_px : by pose, (n, 2) float64, (column, row) of a sample of the projector's light on the board.
    """

    board: Board
    devices: Mapping[str, DeviceGuess]
    lit_px: Mapping[str, FloatArray] = field(default_factory=dict)

    def relative(self, start: str, end: str) -> BoardPose | None:
        """Return the pose that takes the frame of one device into another's, from the poses that both saw."""
        first, second = self.devices[start].poses, self.devices[end].poses
        both = [name for name in first if name in second]
        if not both:
            return None
        turns = [second[name].rotation @ first[name].rotation.T for name in both]
        left, _, right = np.linalg.svd(np.sum(turns, axis=0))
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        shifts = [second[name].translation_mm - rotation @ first[name].translation_mm for name in both]
        return BoardPose(rotation, np.median(shifts, axis=0))


def rig_guess(poses: Sequence[PoseObservation], board: Board, sizes: Mapping[str, Size]) -> RigGuess:
    """Return a guess at every device of `sizes` (cameras by name, and PROJECTOR where one is calibrated)."""
    points_mm = board.points_mm
    devices: dict[str, DeviceGuess] = {}
    lit_px: dict[str, FloatArray] = {}
    for name, size in sizes.items():
        if name != PROJECTOR:
            found = {pose.name: pose.views[name] for pose in poses if name in pose.views}
            seen = _seen(found, points_mm)
            devices[name] = _device(size, seen, shifted=False)
    if PROJECTOR in sizes:
        size = sizes[PROJECTOR]
        lit = {pose.name: lit_board(pose, size) for pose in poses}
        lit_px = {name: each.positions_px for name, each in lit.items()}
        seen = _seen({name: each.view for name, each in lit.items() if each.view is not None}, points_mm)
        matrix = _projector_matrix(seen, devices, size)
        devices[PROJECTOR] = _device(size, seen, shifted=True, matrix=matrix)
    return RigGuess(board, devices, lit_px)


def lens_rows(guess: DeviceGuess, points_mm: FloatArray, pose: BoardPose) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ((n, 2) px, (2 n, 8), (2 n, 6)): where points fall, and the derivatives by the lens and by the pose."""
    vector, _ = cv2.Rodrigues(pose.rotation)
    points_px, derivative = cv2.projectPoints(points_mm, vector, pose.translation_mm, guess.matrix, guess.distortion)
    return points_px.reshape(-1, 2), derivative[:, 6 : 6 + LENS], derivative[:, :6]


def gained(lens: FloatArray, pose: FloatArray, sigma_px: float) -> FloatArray:
    """(8, 8) float64: what one view tells about the lens when its own pose is unknown (Schur complement)."""
    across = lens.T @ pose
    inner = pose.T @ pose
    inner = inner + np.diag(1e-9 * np.diag(inner) + 1e-12)
    return np.asarray((lens.T @ lens - across @ np.linalg.solve(inner, across.T)) / sigma_px**2, dtype=np.float64)


def _seen(views: Mapping[str, BoardView], points_mm: FloatArray) -> dict[str, SeenBoard]:
    """Make views ready, leaving out those that no pose can be told from: too few corners, or all on one line."""
    ready = {}
    for name, view in views.items():
        count = len(view.corner)
        if count < FEWEST_CORNERS:
            continue
        few = np.unique(np.linspace(0, count - 1, min(count, _MOST_CORNERS)).round().astype(int))
        flat = points_mm[view.corner[few]]
        if np.linalg.matrix_rank(flat[:, :2] - flat[0, :2], tol=1e-6) < 2:
            continue
        sigma_px = max(LEAST_SIGMA_PX, float(np.median(view.sigma_px)))
        points_px = np.asarray(view.points_px[few], dtype=np.float64)
        ready[name] = SeenBoard(flat, points_px, sigma_px, sigma_px * float(np.sqrt(len(few) / count)))
    return ready


def _device(
    size: Size, seen: Mapping[str, SeenBoard], *, shifted: bool, matrix: FloatArray | None = None
) -> DeviceGuess:
    """Return the best fit of those that start from the nominal lens, from OpenCV's closed form, and from a matrix.

    While the poses hardly tell the focal length, the fit creeps along a valley, and where it starts matters. Later the
    best start alone will do.
    """
    starts = _starts(size, seen, matrix)
    if len(seen) > _FEW_POSES:
        starts = [min(starts, key=lambda start: _cost(start, shifted=shifted))]
    return min((_fitted(start, shifted=shifted) for start in starts), key=lambda fit: _cost(fit, shifted=shifted))


def _starts(size: Size, seen: Mapping[str, SeenBoard], matrix: FloatArray | None) -> list[DeviceGuess]:
    nominal_px = _NOMINAL_FOCAL * size.width_px
    matrices = [_centred(size, nominal_px)] + ([] if matrix is None else [matrix])
    if seen:
        objects = [each.points_mm.astype(np.float32) for each in seen.values()]
        images = [each.points_px.astype(np.float32) for each in seen.values()]
        focal_px = float(cv2.initCameraMatrix2D(objects, images, (size.width_px, size.height_px), 1.0)[0, 0])
        if _FOCAL_RANGE[0] * size.width_px < focal_px < _FOCAL_RANGE[1] * size.width_px:
            matrices.append(_centred(size, focal_px))
    starts = []
    for each in matrices:
        poses = {name: pose for name, board in seen.items() if (pose := _pose(board, each)) is not None}
        kept = {name: board for name, board in seen.items() if name in poses}
        starts.append(DeviceGuess(size, each, np.zeros(5), np.eye(LENS), kept, poses))
    most = max(len(start.poses) for start in starts)
    return [start for start in starts if len(start.poses) == most]


def _centred(size: Size, focal_px: float) -> FloatArray:
    across, down = (size.width_px - 1) / 2, (size.height_px - 1) / 2
    return np.array([[focal_px, 0, across], [0, focal_px, down], [0, 0, 1]])


def _pose(seen: SeenBoard, matrix: FloatArray) -> BoardPose | None:
    count, vectors, shifts, _ = cv2.solvePnPGeneric(
        seen.points_mm, seen.points_px, matrix, None, flags=cv2.SOLVEPNP_IPPE
    )
    if not count or not np.isfinite(shifts[0]).all() or shifts[0][2, 0] <= 0:
        return None
    rotation, _ = cv2.Rodrigues(vectors[0])
    return BoardPose(np.asarray(rotation, dtype=np.float64), np.asarray(shifts[0], dtype=np.float64).reshape(3))


def _projector_matrix(
    seen: Mapping[str, SeenBoard], devices: Mapping[str, DeviceGuess], size: Size
) -> FloatArray | None:
    """Return the projector's matrix from the cameras' poses of the board (direct linear transform), or None.

    A projector's principal point may lie outside its image, which no start from the image's centre gets right.
    """
    for camera in devices.values():
        both = [name for name in seen if name in camera.poses]
        if len(both) < 2:
            continue
        points_mm = np.concatenate(
            [seen[each].points_mm @ camera.poses[each].rotation.T + camera.poses[each].translation_mm for each in both]
        )
        points_px = np.concatenate([seen[name].points_px for name in both])
        middle, spread = points_mm.mean(axis=0), points_mm.std()
        flat = (points_px - np.array([size.width_px, size.height_px]) / 2) / size.width_px
        space = np.column_stack([(points_mm - middle) / spread, np.ones(len(points_mm))])
        none = np.zeros_like(space)
        rows = np.concatenate(
            [np.column_stack([space, none, -flat[:, :1] * space]), np.column_stack([none, space, -flat[:, 1:] * space])]
        )
        values, vectors = np.linalg.eigh(rows.T @ rows)
        if values[1] < 1e-9 * values[-1]:
            continue
        camera_matrix = vectors[:, 0].reshape(3, 4)[:, :3]
        camera_matrix = camera_matrix * np.sign(np.linalg.det(camera_matrix))
        upper = np.asarray(cv2.RQDecomp3x3(camera_matrix)[1], dtype=np.float64)
        upper = upper / upper[2, 2]
        upper = upper @ np.diag(np.sign(np.diag(upper)))
        matrix = np.diag([size.width_px, size.width_px, 1.0]) @ upper
        matrix[0, 1] = 0.0
        matrix[:2, 2] += np.array([size.width_px, size.height_px]) / 2
        low, high = (share * size.width_px for share in _FOCAL_RANGE)
        shifted = np.abs(matrix[:2, 2] - np.array([size.width_px, size.height_px]) / 2)
        if low < matrix[0, 0] < high and low < matrix[1, 1] < high and (shifted < 2 * size.width_px).all():
            return np.asarray(matrix, dtype=np.float64)
    return None


def _lens(guess: DeviceGuess) -> FloatArray:
    matrix = guess.matrix
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *guess.distortion[:4]])


def _with_lens(guess: DeviceGuess, lens: FloatArray) -> DeviceGuess:
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    return replace(guess, matrix=matrix, distortion=np.append(lens[4:8], 0.0))


def _prior(guess: DeviceGuess, *, shifted: bool) -> tuple[float, FloatArray, FloatArray]:
    """Return what a lens costs before any pose, the (8,) pull towards what is usual, and the (8, 8) information."""
    size, lens = guess.size, _lens(guess)
    nominal_px = _NOMINAL_FOCAL * size.width_px
    sigma_centre = (_SIGMA_SHIFTED if shifted else _SIGMA_CENTRE) * size.width_px
    sigma = np.array([*(_SIGMA_FOCAL * lens[:2]), sigma_centre, sigma_centre, *_SIGMA_TERMS])
    # Of focal lengths the ratio counts: twice as long is as unusual as half as long.
    off = np.array([*(lens[:2] * np.log(lens[:2] / nominal_px)), *lens[2:]])
    off[2:4] -= (np.array([size.width_px, size.height_px]) - 1) / 2
    cost, pull, information = float(((off / sigma) ** 2).sum()), -off / sigma**2, np.diag(1 / sigma**2)
    if not shifted:  # a camera's pixels are square; a projector's mirrors need not be addressed so
        aspect = np.zeros(LENS)
        aspect[:2] = np.array([1.0, -1.0]) / (_SIGMA_ASPECT * lens[0])
        uneven = float(aspect @ lens)
        cost, pull = cost + uneven**2, pull - uneven * aspect
        information = information + np.outer(aspect, aspect)
    return cost, pull, information


def _fitted(start: DeviceGuess, *, shifted: bool) -> DeviceGuess:
    """Return the guess after a damped Gauss-Newton fit of lens and poses with the prior (Levenberg's method)."""
    best, cost = start, _cost(start, shifted=shifted)
    damping = 1e-3
    for _ in range(_STEPS):
        moved, _ = _step(best, damping, shifted=shifted)
        fresh = _cost(moved, shifted=shifted)
        if not fresh < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        settled = cost - fresh < _SETTLED * cost
        best, cost, damping = moved, fresh, damping / 10
        if settled:
            break
    _, information = _step(best, 0.0, shifted=shifted)
    return replace(best, information=information)


def _step(guess: DeviceGuess, damping: float, *, shifted: bool) -> tuple[DeviceGuess, FloatArray]:
    """Return the guess one step on, and the (8, 8) information of its lens before the step."""
    lens = _lens(guess)
    _, right, whole = _prior(guess, shifted=shifted)
    back = []
    for name, seen in guess.seen.items():
        pose = guess.poses[name]
        points_px, by_lens, by_pose = lens_rows(guess, seen.points_mm, pose)
        off = (seen.points_px - points_px).ravel()
        weight = 1 / seen.sigma_px**2
        across, inner = weight * by_lens.T @ by_pose, weight * by_pose.T @ by_pose
        inner = inner + np.diag((damping + 1e-9) * np.diag(inner) + 1e-12)
        whole += weight * by_lens.T @ by_lens - across @ np.linalg.solve(inner, across.T)
        pull = weight * by_pose.T @ off
        right += weight * by_lens.T @ off - across @ np.linalg.solve(inner, pull)
        back.append((name, pose, across, inner, pull))
    lens_step = np.linalg.solve(whole + damping * np.diag(np.diag(whole)), right)
    poses = {}
    for name, pose, across, inner, pull in back:
        step = np.linalg.solve(inner, pull - across.T @ lens_step)
        vector = cv2.Rodrigues(pose.rotation)[0].reshape(3) + step[:3]
        rotation = np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)
        poses[name] = BoardPose(rotation, pose.translation_mm + step[3:])
    return _with_lens(replace(guess, poses=poses), lens + lens_step), whole


def _cost(guess: DeviceGuess, *, shifted: bool) -> float:
    lens = _lens(guess)
    if lens[0] <= 0 or lens[1] <= 0 or any(pose.translation_mm[2] <= 0 for pose in guess.poses.values()):
        return float("inf")
    total, _, _ = _prior(guess, shifted=shifted)
    for name, seen in guess.seen.items():
        vector, _ = cv2.Rodrigues(guess.poses[name].rotation)
        shift = guess.poses[name].translation_mm
        points_px, _ = cv2.projectPoints(seen.points_mm, vector, shift, guess.matrix, guess.distortion)
        total += float(((seen.points_px - points_px.reshape(-1, 2)) ** 2).sum()) / seen.sigma_px**2
    return total

"""Initial estimate of devices and poses while poses still arrive, from board corners and projected light.

Each device is fitted separately. A prior on its lens replaces missing poses: one pose suffices for an
estimate, and parallel poses do no harm. A solve is better and takes longer.
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

_MAX_SAMPLES = 2500
_MIN_SAMPLES = 40
_MAP_ITERATIONS = 3
_MAX_DEVIATIONS = 3.0
"""Correspondences farther from the homography, in robust standard deviations, are left out."""
_MIN_SPREAD_PX = 0.5
MIN_SIGMA_PX = 0.03
"""Least standard deviation of a corner, even if the detector states less."""
LENS_TERM_COUNT = 8
"""Number of lens parameters in an estimate: fx, fy, cx, cy, k1, k2, p1, p2."""
MIN_CORNERS = 6
_MAX_CORNERS = 40
_NOMINAL_FOCAL = 1.2
"""Prior focal length over the image's width: a field of view of 45°."""
_FOCAL_RANGE = (0.3, 12.0)
_STEPS = 12
_CONVERGED = 1e-4
_MAX_POSES_FOR_ALL_STARTS = 6
_SIGMA_FOCAL = 0.7
_SIGMA_ASPECT = 0.02
_SIGMA_CENTRE = 0.1
_SIGMA_SHIFTED_CENTRE = 1.0
_SIGMA_TERMS = (0.3, 0.6, 0.005, 0.005)


@dataclass(frozen=True, slots=True)
class ProjectorView:
    """One pose in the projector's image.

    view : the board's corners, from the camera with most corners in the image; None where no camera has enough light on
    the board. positions_px : (n, 2) float64, (column, row) of a sample of the pixels lit on the board.
    """

    view: BoardView | None
    positions_px: FloatArray


def projector_view(pose: PoseObservation, size: Size) -> ProjectorView:
    """Map one pose into the image of a projector of this size. Corners outside the image are left out."""
    best: BoardView | None = None
    positions = [np.zeros((0, 2))]
    for camera, light in pose.correspondences.items():
        to_projector = projector_homography(light)
        if to_projector is None:
            continue
        positions_px = apply_homography(to_projector, _subsample(light).pixels_px)
        positions.append(positions_px[is_in_image(positions_px, size)])
        view = pose.views.get(camera)
        if view is None:
            continue
        points_px = apply_homography(to_projector, view.points_px)
        inside = is_in_image(points_px, size)
        # The deviation of the light, averaged over the pixels per corner.
        pixels_per_corner = max(1.0, len(light.axis) / (2 * max(len(view.corner), 1)))
        sigma_px = max(MIN_SIGMA_PX, float(np.median(light.sigma_px)) / float(np.sqrt(pixels_per_corner)))
        mapped = BoardView(view.corner[inside], points_px[inside], np.full(int(inside.sum()), sigma_px))
        if best is None or len(mapped.corner) > len(best.corner):
            best = mapped
    return ProjectorView(best, np.concatenate(positions))


def projector_homography(light: Correspondences) -> FloatArray | None:
    """Return the (3, 3) float64 homography from camera pixels to projector (column, row), or None without one.

    Each correspondence gives one linear equation, u (h3·p) = h_axis·p (Hartley and Zisserman, chapter 4), so that
    columns and rows may come from different pixels. Fitted again without outliers.
    """
    sample = _subsample(light)
    along_column = sample.axis == COLUMN
    if min(int(along_column.sum()), int((~along_column).sum())) < _MIN_SAMPLES:
        return None
    columns, rows = sample.position_px[along_column], sample.position_px[~along_column]
    in_camera = _normalisation(sample.pixels_px.mean(axis=0), float(sample.pixels_px.std()))
    centre = np.array([np.median(columns), np.median(rows)])
    in_projector = _normalisation(centre, max(float(columns.std()), float(rows.std())))
    points = np.column_stack([sample.pixels_px, np.ones(len(sample.axis))]) @ in_camera.T
    position = sample.position_px * np.where(along_column, in_projector[0, 0], in_projector[1, 1])
    position = position + np.where(along_column, in_projector[0, 2], in_projector[1, 2])
    rows = np.zeros((len(points), 9))
    rows[along_column, 0:3] = points[along_column]
    rows[~along_column, 3:6] = points[~along_column]
    rows[:, 6:9] = -position[:, None] * points
    inliers = np.ones(len(points), dtype=bool)
    homography = np.eye(3)
    for _ in range(_MAP_ITERATIONS):
        _, vectors = np.linalg.eigh(rows[inliers].T @ rows[inliers])
        homography = vectors[:, 0].reshape(3, 3)
        depth = points @ homography[2]
        if not (np.abs(depth) > 1e-9).all():
            return None
        deviation = np.abs(np.where(along_column, points @ homography[0], points @ homography[1]) / depth - position)
        spread = 1.4826 * float(np.median(deviation[inliers]))
        updated = deviation <= max(_MAX_DEVIATIONS * spread, _MIN_SPREAD_PX * float(in_projector[0, 0]))
        if updated.sum() < 2 * _MIN_SAMPLES or (updated == inliers).all():
            break
        inliers = updated
    return np.asarray(np.linalg.inv(in_projector) @ homography @ in_camera, dtype=np.float64)


def apply_homography(homography: FloatArray, points_px: FloatArray) -> FloatArray:
    """(n, 2) float64: points mapped by a (3, 3) homography."""
    homogeneous = np.column_stack([points_px, np.ones(len(points_px))]) @ homography.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:], dtype=np.float64)


def is_in_image(points_px: FloatArray, size: Size) -> NDArray[np.bool_]:
    """(n,) bool: True for points inside an image of this size, whose pixel centres are at whole numbers."""
    inside = (points_px > -0.5) & (points_px < np.array([size.width_px, size.height_px]) - 0.5)
    return np.asarray(inside.all(axis=1), dtype=np.bool_)


def _subsample(light: Correspondences) -> Correspondences:
    step = max(1, len(light.axis) // _MAX_SAMPLES)
    # An odd step: an even one would leave one axis out where columns and rows alternate.
    selected = slice(None, None, step + (1 - step % 2))
    return Correspondences(
        light.pixels_px[selected], light.axis[selected], light.position_px[selected], light.sigma_px[selected]
    )


def _normalisation(centre: FloatArray, spread: float) -> FloatArray:
    """(3, 3): the similarity that centres points at the origin with unit spread, to condition the linear solve."""
    spread = max(spread, 1e-6)
    return np.array([[1 / spread, 0, -centre[0] / spread], [0, 1 / spread, -centre[1] / spread], [0, 0, 1]])


@dataclass(frozen=True, slots=True)
class ThinnedView:
    """Some corners of a view: (n, 3) mm, (n, 2) px.

    corner_sigma_px : standard deviation of a coordinate of one corner; sigma_px : the same for these few corners in
    place of all of them.
    """

    points_mm: FloatArray
    points_px: FloatArray
    corner_sigma_px: float
    sigma_px: float


@dataclass(frozen=True, slots=True)
class DeviceEstimate:
    """Estimate of one device.

    matrix : (3, 3); distortion : (5,), k3 zero; information : (8, 8) float64, inverse covariance of the lens, poses
    marginalised and prior included; views, poses : by name of the pose, poses in the device's frame, X_device = R
    X_board + t.
    """

    size: Size
    matrix: FloatArray
    distortion: FloatArray
    information: FloatArray
    views: Mapping[str, ThinnedView]
    poses: Mapping[str, BoardPose]

    @property
    def focal_sigma(self) -> float:
        """Relative standard deviation of the focal length."""
        return float(np.sqrt(np.linalg.inv(self.information)[0, 0]) / self.matrix[0, 0])


@dataclass(frozen=True, slots=True)
class RigEstimate:
    """Estimates of all devices of a rig: cameras in order, then the projector if there is one.

    projected_px : by pose, (n, 2) float64, (column, row) of a sample of the projector's light on the board.
    """

    board: Board
    devices: Mapping[str, DeviceEstimate]
    projected_px: Mapping[str, FloatArray] = field(default_factory=dict)

    def relative_pose(self, start: str, end: str) -> BoardPose | None:
        """Return the transform from the frame of one device to another's, from the poses in both; None without any."""
        first, second = self.devices[start].poses, self.devices[end].poses
        common = [name for name in first if name in second]
        if not common:
            return None
        rotations = [second[name].rotation @ first[name].rotation.T for name in common]
        left, _, right = np.linalg.svd(np.sum(rotations, axis=0))
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        shifts = [second[name].translation_mm - rotation @ first[name].translation_mm for name in common]
        return BoardPose(rotation, np.median(shifts, axis=0))


def estimate_rig(poses: Sequence[PoseObservation], board: Board, sizes: Mapping[str, Size]) -> RigEstimate:
    """Estimate every device of `sizes` (cameras by name, and PROJECTOR where one is calibrated)."""
    points_mm = board.points_mm
    devices: dict[str, DeviceEstimate] = {}
    projected_px: dict[str, FloatArray] = {}
    for name, size in sizes.items():
        if name != PROJECTOR:
            camera_views = {pose.name: pose.views[name] for pose in poses if name in pose.views}
            views = _thin_views(camera_views, points_mm)
            devices[name] = _estimate_device(size, views, free_centre=False)
    if PROJECTOR in sizes:
        size = sizes[PROJECTOR]
        projector_views = {pose.name: projector_view(pose, size) for pose in poses}
        projected_px = {name: each.positions_px for name, each in projector_views.items()}
        views = _thin_views(
            {name: each.view for name, each in projector_views.items() if each.view is not None}, points_mm
        )
        matrix = _projector_matrix(views, devices, size)
        devices[PROJECTOR] = _estimate_device(size, views, free_centre=True, matrix=matrix)
    return RigEstimate(board, devices, projected_px)


def projection_jacobians(
    device: DeviceEstimate, points_mm: FloatArray, pose: BoardPose
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Project points: ((n, 2) px, (2 n, 8), (2 n, 6)), the points and the derivatives by lens and by pose."""
    vector, _ = cv2.Rodrigues(pose.rotation)
    points_px, derivative = cv2.projectPoints(points_mm, vector, pose.translation_mm, device.matrix, device.distortion)
    return points_px.reshape(-1, 2), derivative[:, 6 : 6 + LENS_TERM_COUNT], derivative[:, :6]


def lens_information(lens: FloatArray, pose: FloatArray, sigma_px: float) -> FloatArray:
    """(8, 8) float64: information of one view about the lens, its pose marginalised (Schur complement)."""
    cross = lens.T @ pose
    inner = pose.T @ pose
    inner = inner + np.diag(1e-9 * np.diag(inner) + 1e-12)
    return np.asarray((lens.T @ lens - cross @ np.linalg.solve(inner, cross.T)) / sigma_px**2, dtype=np.float64)


def _thin_views(views: Mapping[str, BoardView], points_mm: FloatArray) -> dict[str, ThinnedView]:
    """Reduce views to a few corners. Views that determine no pose are left out: too few corners, or all on one line."""
    thinned = {}
    for name, view in views.items():
        count = len(view.corner)
        if count < MIN_CORNERS:
            continue
        selected = np.unique(np.linspace(0, count - 1, min(count, _MAX_CORNERS)).round().astype(int))
        board_mm = points_mm[view.corner[selected]]
        if np.linalg.matrix_rank(board_mm[:, :2] - board_mm[0, :2], tol=1e-6) < 2:
            continue
        sigma_px = max(MIN_SIGMA_PX, float(np.median(view.sigma_px)))
        points_px = np.asarray(view.points_px[selected], dtype=np.float64)
        thinned[name] = ThinnedView(board_mm, points_px, sigma_px, sigma_px * float(np.sqrt(len(selected) / count)))
    return thinned


def _estimate_device(
    size: Size, views: Mapping[str, ThinnedView], *, free_centre: bool, matrix: FloatArray | None = None
) -> DeviceEstimate:
    """Return the best fit of those that start from the nominal lens, OpenCV's closed form and a matrix.

    While the poses hardly determine the focal length, the fit depends on its start; later the best start alone
    suffices.
    """
    starts = _initial_estimates(size, views, matrix)
    if len(views) > _MAX_POSES_FOR_ALL_STARTS:
        starts = [min(starts, key=lambda start: _cost(start, free_centre=free_centre))]
    return min(
        (_fit(start, free_centre=free_centre) for start in starts), key=lambda fit: _cost(fit, free_centre=free_centre)
    )


def _initial_estimates(size: Size, views: Mapping[str, ThinnedView], matrix: FloatArray | None) -> list[DeviceEstimate]:
    nominal_px = _NOMINAL_FOCAL * size.width_px
    matrices = [_centred_matrix(size, nominal_px)] + ([] if matrix is None else [matrix])
    if views:
        objects = [each.points_mm.astype(np.float32) for each in views.values()]
        images = [each.points_px.astype(np.float32) for each in views.values()]
        focal_px = float(cv2.initCameraMatrix2D(objects, images, (size.width_px, size.height_px), 1.0)[0, 0])
        if _FOCAL_RANGE[0] * size.width_px < focal_px < _FOCAL_RANGE[1] * size.width_px:
            matrices.append(_centred_matrix(size, focal_px))
    starts = []
    for each in matrices:
        poses = {name: pose for name, board in views.items() if (pose := _estimate_pose(board, each)) is not None}
        used_views = {name: board for name, board in views.items() if name in poses}
        starts.append(DeviceEstimate(size, each, np.zeros(5), np.eye(LENS_TERM_COUNT), used_views, poses))
    max_poses = max(len(start.poses) for start in starts)
    return [start for start in starts if len(start.poses) == max_poses]


def _centred_matrix(size: Size, focal_px: float) -> FloatArray:
    across, down = (size.width_px - 1) / 2, (size.height_px - 1) / 2
    return np.array([[focal_px, 0, across], [0, focal_px, down], [0, 0, 1]])


def _estimate_pose(view: ThinnedView, matrix: FloatArray) -> BoardPose | None:
    count, vectors, shifts, _ = cv2.solvePnPGeneric(
        view.points_mm, view.points_px, matrix, None, flags=cv2.SOLVEPNP_IPPE
    )
    if not count or not np.isfinite(shifts[0]).all() or shifts[0][2, 0] <= 0:
        return None
    rotation, _ = cv2.Rodrigues(vectors[0])
    return BoardPose(np.asarray(rotation, dtype=np.float64), np.asarray(shifts[0], dtype=np.float64).reshape(3))


def _projector_matrix(
    views: Mapping[str, ThinnedView], devices: Mapping[str, DeviceEstimate], size: Size
) -> FloatArray | None:
    """Return the projector's matrix from the cameras' poses of the board (direct linear transform), or None.

    The principal point of a projector may be outside its image, which a start from the image's centre does not find.
    """
    for camera in devices.values():
        common = [name for name in views if name in camera.poses]
        if len(common) < 2:
            continue
        points_mm = np.concatenate(
            [
                views[each].points_mm @ camera.poses[each].rotation.T + camera.poses[each].translation_mm
                for each in common
            ]
        )
        points_px = np.concatenate([views[name].points_px for name in common])
        centre, spread = points_mm.mean(axis=0), points_mm.std()
        normalised = (points_px - np.array([size.width_px, size.height_px]) / 2) / size.width_px
        homogeneous = np.column_stack([(points_mm - centre) / spread, np.ones(len(points_mm))])
        zero = np.zeros_like(homogeneous)
        rows = np.concatenate(
            [
                np.column_stack([homogeneous, zero, -normalised[:, :1] * homogeneous]),
                np.column_stack([zero, homogeneous, -normalised[:, 1:] * homogeneous]),
            ]
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
        offset_px = np.abs(matrix[:2, 2] - np.array([size.width_px, size.height_px]) / 2)
        if low < matrix[0, 0] < high and low < matrix[1, 1] < high and (offset_px < 2 * size.width_px).all():
            return np.asarray(matrix, dtype=np.float64)
    return None


def _lens(device: DeviceEstimate) -> FloatArray:
    matrix = device.matrix
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *device.distortion[:4]])


def _prior(device: DeviceEstimate, *, free_centre: bool) -> tuple[float, FloatArray, FloatArray]:
    """Return the cost of a lens before any pose, its (8,) gradient towards the nominal lens, and the (8, 8)
    information.
    """
    size, lens = device.size, _lens(device)
    nominal_px = _NOMINAL_FOCAL * size.width_px
    sigma_centre = (_SIGMA_SHIFTED_CENTRE if free_centre else _SIGMA_CENTRE) * size.width_px
    sigma = np.array([*(_SIGMA_FOCAL * lens[:2]), sigma_centre, sigma_centre, *_SIGMA_TERMS])
    # Focal lengths deviate by their ratio: twice as long is as unlikely as half as long.
    deviation = np.array([*(lens[:2] * np.log(lens[:2] / nominal_px)), *lens[2:]])
    deviation[2:4] -= (np.array([size.width_px, size.height_px]) - 1) / 2
    cost, gradient, information = float(((deviation / sigma) ** 2).sum()), -deviation / sigma**2, np.diag(1 / sigma**2)
    if not free_centre:  # a camera's pixels are square; a projector's need not be
        aspect = np.zeros(LENS_TERM_COUNT)
        aspect[:2] = np.array([1.0, -1.0]) / (_SIGMA_ASPECT * lens[0])
        aspect_error = float(aspect @ lens)
        cost, gradient = cost + aspect_error**2, gradient - aspect_error * aspect
        information = information + np.outer(aspect, aspect)
    return cost, gradient, information


def _fit(start: DeviceEstimate, *, free_centre: bool) -> DeviceEstimate:
    """Fit lens and poses with the prior by damped Gauss-Newton steps (Levenberg)."""
    best, cost = start, _cost(start, free_centre=free_centre)
    damping = 1e-3
    for _ in range(_STEPS):
        trial, _ = _step(best, damping, free_centre=free_centre)
        trial_cost = _cost(trial, free_centre=free_centre)
        if not trial_cost < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        converged = cost - trial_cost < _CONVERGED * cost
        best, cost, damping = trial, trial_cost, damping / 10
        if converged:
            break
    _, information = _step(best, 0.0, free_centre=free_centre)
    return replace(best, information=information)


def _step(device: DeviceEstimate, damping: float, *, free_centre: bool) -> tuple[DeviceEstimate, FloatArray]:
    """Return the estimate after one step, and the (8, 8) information of its lens before the step."""
    lens = _lens(device)
    _, gradient, information = _prior(device, free_centre=free_centre)
    eliminated = []
    for name, view in device.views.items():
        pose = device.poses[name]
        points_px, by_lens, by_pose = projection_jacobians(device, view.points_mm, pose)
        deviation = (view.points_px - points_px).ravel()
        weight = 1 / view.sigma_px**2
        cross, inner = weight * by_lens.T @ by_pose, weight * by_pose.T @ by_pose
        inner = inner + np.diag((damping + 1e-9) * np.diag(inner) + 1e-12)
        information += weight * by_lens.T @ by_lens - cross @ np.linalg.solve(inner, cross.T)
        pose_gradient = weight * by_pose.T @ deviation
        gradient += weight * by_lens.T @ deviation - cross @ np.linalg.solve(inner, pose_gradient)
        eliminated.append((name, pose, cross, inner, pose_gradient))
    lens_step = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
    poses = {}
    for name, pose, cross, inner, pose_gradient in eliminated:
        step = np.linalg.solve(inner, pose_gradient - cross.T @ lens_step)
        vector = cv2.Rodrigues(pose.rotation)[0].reshape(3) + step[:3]
        rotation = np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)
        poses[name] = BoardPose(rotation, pose.translation_mm + step[3:])
    lens = lens + lens_step
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    return replace(device, matrix=matrix, distortion=np.append(lens[4:8], 0.0), poses=poses), information


def _cost(device: DeviceEstimate, *, free_centre: bool) -> float:
    lens = _lens(device)
    if lens[0] <= 0 or lens[1] <= 0 or any(pose.translation_mm[2] <= 0 for pose in device.poses.values()):
        return float("inf")
    total, _, _ = _prior(device, free_centre=free_centre)
    for name, view in device.views.items():
        vector, _ = cv2.Rodrigues(device.poses[name].rotation)
        shift = device.poses[name].translation_mm
        points_px, _ = cv2.projectPoints(view.points_mm, vector, shift, device.matrix, device.distortion)
        total += float(((view.points_px - points_px.reshape(-1, 2)) ** 2).sum()) / view.sigma_px**2
    return total

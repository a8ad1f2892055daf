"""Result of a solve, and the effect of errors of the devices on measured points.

A device has 15 parameters. Each has its row and column in the covariance, in this order: fx, fy, cx, cy (px), k1, k2,
p1, p2, k3, a small rotation (three angles, rad: R' = exp([turn]x) R) and the translation (mm). The first camera's frame
is the world, so its pose has no variance.

A point X follows from three equations h(X, θ) = m: its pixel (u, v) in a camera and a third one, with m as measured. A
small change of the parameters θ of the devices moves it by

    dX = -(∂h/∂X)⁻¹ ∂h/∂θ dθ

(implicit function theorem). The third equation is the projector's column (or row); without a projector, the second
camera's coordinate along the epipolar line. A single camera has no third measurement: there r · X = m with the viewing
ray r, as if the distance were known.

Where several cameras see the light of one projector pixel, a scan takes the mean of their points, weighted by inverse
variance. With equal noise in all cameras the weight is the square of the pixels by which a point moves in a camera when
it moves along the projector's ray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.model import (
    LENS_TERMS,
    Axis,
    Calibration,
    FloatArray,
    IntArray,
    Pinhole,
    depth_sensitive_cameras,
    triangulated_axis,
)
from slrig.model.lens import distort, distortion_by_terms

PARAMETERS = ("fx", "fy", "cx", "cy", *LENS_TERMS, "turn_x", "turn_y", "turn_z", "x_mm", "y_mm", "z_mm")
_PARAMETER_COUNT = len(PARAMETERS)

CELLS = 6
"""Residual maps have 6 x 6 cells over the image."""

MIN_HALVED_POSES = 8
"""Minimum number of poses for solving two halves separately: each half needs four to hold some of them out."""

PROJECTOR = "projector"
"""Name of the projector among the devices."""


def device_title(name: str) -> str:
    """Name of a device for use in a sentence.

    >>> device_title("left"), device_title("projector")
    ("camera 'left'", 'the projector')
    """
    return "the projector" if name == PROJECTOR else f"camera '{name}'"


def devices_by_name(calibration: Calibration, /) -> dict[str, Pinhole]:
    """Cameras in order, then the projector if there is one: the order of the covariance."""
    projector = {} if calibration.projector is None else {PROJECTOR: calibration.projector}
    return {**calibration.cameras, **projector}


def device_covariance(calibration: Calibration, /, *names: str, board: bool = True) -> FloatArray:
    """(15 k, 15 k) float64: covariance of the k named devices (default: all); zeros if the calibration states none.

    board : False leaves out the uncertainty of the board's size, for observations of the same board.
    """
    order = list(devices_by_name(calibration))
    if calibration.solved is None:
        return np.zeros((len(PARAMETERS) * len(names or order),) * 2)
    covariance = calibration.solved.covariance
    if not board and calibration.solved.scale_sigma > 0:
        mode = calibration.solved.scale_sigma * scale_mode(calibration)
        covariance = covariance - np.outer(mode, mode)
    indices = np.arange(len(PARAMETERS) * len(order)).reshape(len(order), -1)
    rows = indices[[order.index(name) for name in names or order]].ravel()
    return np.asarray(covariance[np.ix_(rows, rows)], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class BoardPose:
    """Pose of the board: X_world = rotation @ X_board + translation_mm; (3, 3) and (3,) float64."""

    rotation: FloatArray
    translation_mm: FloatArray

    def to_world(self, points_mm: FloatArray) -> FloatArray:
        """Transform points (n, 3) from the board to the world."""
        return np.asarray(points_mm @ self.rotation.T + self.translation_mm)


@dataclass(frozen=True, slots=True)
class DeviceResiduals:
    """Residuals of one device, px: of a camera the rms distance of corners, of the projector the rms per coordinate.

    count : number of observations that the figures use; outlying : number of outliers, which they leave out.
    stated_rms_px : rms predicted by the observations' own standard deviations; held_out_rms_px : rms at poses held out
    from the solve, NaN if there were too few; pose_rms_px : by pose. map_rms_px : (6, 6) float64, NaN where nothing was
    observed; map_count : (6, 6) int32; map_mean_px : (6, 6, 2) float64, mean residual vector of a cell.
    """

    rms_px: float
    stated_rms_px: float
    held_out_rms_px: float
    count: int
    outlying: int
    pose_rms_px: Mapping[str, float]
    map_rms_px: FloatArray
    map_mean_px: FloatArray
    map_count: IntArray


@dataclass(frozen=True, slots=True)
class Bow:
    """Flatness of the board: height_mm from its lowest to its highest corner, sigma_mm its standard deviation.

    solved : True if the solve modelled the board as bent; otherwise the figures are an estimate made after it.
    """

    height_mm: float
    sigma_mm: float
    solved: bool


@dataclass(frozen=True, slots=True)
class BoardSize:
    """Relative error of the print's size.

    scale_sigma : standard deviation of the mean of width and height, which no pose determines. stretch : width over
    height minus 1, relative to the board's description, as estimated from the poses; stretch_sigma : its deviation.
    """

    scale_sigma: float = 0.0
    stretch: float = 0.0
    stretch_sigma: float = 0.0


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """Expected error of a scan with this calibration, mm, over the volume in which the board was held.

    All figures are root mean squares over the volume of one standard deviation. They leave out rigid motions of the
    whole, which do not affect a measurement.

    volume_mm : (2, 3) float64, opposite corners of the volume's box in the world.
    point_mm : error of a point along the first camera's viewing ray, from the calibration alone. noise_mm : from the
    noise of one point's light alone, for a surface as bright as the board's paper; NaN if no light was observed.
    total_mm : both. length_share : error of a length over that length, from the calibration alone, for lengths of half
    the volume's diagonal in all directions in the volume. board_mm : the part of point_mm from the known uncertainty of
    the board's size.
    grid_mm : (n, 3) float64, points in the volume that the devices see; grid_point_mm : (n,) float64, point_mm there.
    across : True for a calibration of one camera, which measures no depth: point_mm is across its viewing ray, for
    points of known distance, and noise_mm, total_mm and length_share are NaN.
    """

    volume_mm: FloatArray
    point_mm: float
    noise_mm: float
    total_mm: float
    length_share: float
    grid_mm: FloatArray
    grid_point_mm: FloatArray
    across: bool = False
    board_mm: float = 0.0

    @property
    def point_description(self) -> str:
        """The kind of point that `point_mm` is the error of."""
        return "a point of known distance" if self.across else "a scanned point"

    @property
    def direction_description(self) -> str:
        """The direction of `point_mm`, to be put behind it; empty for the usual one."""
        return " across the line of sight" if self.across else ""


@dataclass(frozen=True, slots=True)
class HalfSolution:
    """Solve of the odd or the even poses alone.

    poses : their names. change : (15 d,) float64, its parameters minus those of the full solve; covariance :
    (15 d, 15 d) float64.
    """

    poses: tuple[str, ...]
    change: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Solution:
    """A solved calibration.

    calibration : cameras and projector in the world, the first camera's frame.
    covariance : (15 d, 15 d) float64, of the parameters of all d devices, cameras in order, then the projector.
    distortion : by device, the names of the lens terms that were solved for.
    poses : the poses that were used, by name; outliers : the poses that were left out, each with the reason.
    residuals : by device, PROJECTOR among them.
    board_shape_mm : (n, 3) float64, offset of each corner from its nominal position, or None if not solved for.
    bow : flatness of the board; None if the board was declared flat.
    halves : solves of the odd and of the even poses; empty if there are too few.
    size : of the board's print; the covariance includes its scale (`scale_mode`).
    """

    calibration: Calibration
    covariance: FloatArray
    distortion: Mapping[str, tuple[str, ...]]
    poses: Mapping[str, BoardPose]
    outliers: Mapping[str, str]
    residuals: Mapping[str, DeviceResiduals]
    board_shape_mm: FloatArray | None = None
    bow: Bow | None = None
    halves: tuple[HalfSolution, ...] = ()
    size: BoardSize = BoardSize()


def scale_mode(calibration: Calibration, /) -> FloatArray:
    """(15 d,) float64: derivative of each parameter by a relative change of the scale of everything.

    The first camera keeps its place, and the distances of all others from it grow: only translations change.
    """
    base = next(iter(calibration.cameras.values())).centre_mm
    change = np.zeros((len(devices_by_name(calibration)), len(PARAMETERS)))
    for row, device in zip(change, devices_by_name(calibration).values(), strict=True):
        # A device at the centre c goes to base + (1 + s)(c - base), and its translation is -R c.
        row[-3:] = -device.rotation @ (device.centre_mm - base)
    return change.ravel()


@dataclass(frozen=True, slots=True)
class PointSensitivity:
    """Derivatives of n measured points.

    by_parameter : (n, 3, p) float64, mm per unit of each of the p parameters of all devices. by_noise : (n, 3, e)
    float64, mm per pixel for each of e independent errors of the light; NaN without light. visible : (n,) bool, True if
    enough devices see the point; the derivatives of the others are undefined.
    projection : (n, m, 3) float64, maps a displacement to the part that is stated as the error of a point: along the
    first camera's ray r (m = 1), for a single camera across it (m = 3, 1 - r rᵀ).
    """

    by_parameter: FloatArray
    by_noise: FloatArray
    visible: NDArray[np.bool_]
    projection: FloatArray


class RigidMotion(NamedTuple):
    """Common motion of points: turn_deg about their centre and shift_mm of it."""

    turn_deg: float
    shift_mm: float

    @property
    def description(self) -> str:
        """Turn and shift for use in a sentence."""
        return f"a turn of {self.turn_deg:.2g}° and a shift of {self.shift_mm:.2g} mm"


class _ProjectionDerivatives(NamedTuple):
    """by_point : (n, 2, 3) and by_parameter : (n, 2, 15) float64, of the pixel; inside : (n,) bool, in the image."""

    by_point: FloatArray
    by_parameter: FloatArray
    inside: NDArray[np.bool_]


def point_sensitivity(
    cameras: Sequence[Pinhole], projector: Pinhole | None, points_mm: FloatArray, /
) -> PointSensitivity:
    """Derivatives of points (n, 3) in the world by the parameters of the cameras, in order, then of the projector.

    Without a projector, a point is triangulated by the first camera and the one that shares most of the points with it.
    """
    views = [_project(camera, points_mm) for camera in cameras]
    ray = _normalise(points_mm - cameras[0].centre_mm)
    if projector is None and len(cameras) == 1:
        return _one_camera_sensitivity(views[0], ray)
    if projector is None:
        return _two_camera_sensitivity(cameras, views, points_mm, ray)
    light = _project(projector, points_mm)
    axis = triangulated_axis(cameras, projector)
    coordinate = 0 if axis is Axis.COLUMN else 1
    light_ray = _normalise(points_mm - projector.centre_mm)
    sensitive = np.array(depth_sensitive_cameras(axis, cameras, projector))
    squared_motion = [(np.einsum("nij,nj->ni", view.by_point, light_ray) ** 2).sum(axis=1) for view in views]
    weights = np.stack([np.where(view.inside, m, 0.0) for view, m in zip(views, squared_motion, strict=True)])
    weights *= sensitive[:, None]
    total = weights.sum(axis=0)
    weights = weights / np.where(total > 0, total, 1.0)
    by_parameter = np.zeros((len(points_mm), 3, _PARAMETER_COUNT * (len(cameras) + 1)))
    noises = []
    for index, (view, weight) in enumerate(zip(views, weights, strict=True)):
        inverse = _invert(np.concatenate([view.by_point, light.by_point[:, coordinate, None]], axis=1))
        # Zero the contribution of a camera that does not see a point, even where it is not a number.
        inverse = np.where(weight[:, None, None] > 0, inverse * weight[:, None, None], 0.0)
        own = slice(_PARAMETER_COUNT * index, _PARAMETER_COUNT * (index + 1))
        by_parameter[:, :, own] = -inverse[:, :, :2] @ np.nan_to_num(view.by_parameter)
        by_parameter[:, :, -_PARAMETER_COUNT:] -= inverse[:, :, 2:] @ light.by_parameter[:, coordinate, None]
        noises.append(inverse[:, :, 2])
    return PointSensitivity(by_parameter, np.stack(noises, axis=2), light.inside & (total > 0), ray[:, None])


def cell_centres(box_mm: FloatArray, counts: Sequence[int], /) -> FloatArray:
    """(n, 3) float64: centres of equal cells of a box (2, 3), mm; counts : number of cells along each axis."""
    axes = [
        low + (high - low) * (np.arange(count) + 0.5) / count for low, high, count in zip(*box_mm, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def project_out_rigid_motion(points_mm: FloatArray, fields: FloatArray, /) -> FloatArray:
    """Subtract from each displacement field (n, 3, k) its nearest small rigid motion.

    A small rigid motion moves X by t + ω × X; t and ω minimise the sum of squares.
    """
    from_centre = points_mm - points_mm.mean(axis=0)
    scale = max(float(np.abs(from_centre).max()), 1e-300)
    motions = np.zeros((len(points_mm), 3, 6))
    motions[:, :, :3] = np.eye(3)
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], from_centre / scale)
    flat = fields.reshape(3 * len(points_mm), -1)
    basis, _ = np.linalg.qr(motions.reshape(-1, 6))
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(fields.shape))


def remove_rigid_motion(before_mm: FloatArray, after_mm: FloatArray, /) -> tuple[FloatArray, RigidMotion]:
    """Displacements of points (n, 3) beyond their nearest rigid motion, (n, 3), and that motion, of any size.

    Turn and shift minimise the sum of squares (Kabsch 1976). Two solves of one rig differ by such a motion, because
    each takes its own first camera for the world; no measurement of a shape notices it. mrcal removes it from the
    difference of two camera models for the same reason (mrcal.secretsauce.net/differencing.html).
    """
    # Imported here: the service imports the classes of this module and calls none of its functions.
    from scipy.spatial.transform import Rotation

    centre = before_mm.mean(axis=0)
    shift = after_mm.mean(axis=0) - centre
    turn, _ = Rotation.align_vectors(after_mm - centre - shift, before_mm - centre)
    rest = after_mm - centre - shift - turn.apply(before_mm - centre)
    return rest, RigidMotion(float(np.degrees(turn.magnitude())), float(np.linalg.norm(shift)))


def covariance_modes(covariance: FloatArray, /) -> FloatArray:
    """(p, k): independent changes of the parameters by one standard deviation each: modes @ modes.T = covariance.

    Focal lengths and angles differ by many orders of magnitude, so the parameters are first divided by their standard
    deviations.
    """
    sigma = np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    known = sigma > 0
    scaled = covariance[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    positive = values > 0
    modes = np.zeros((len(covariance), int(positive.sum())))
    modes[known] = sigma[known, None] * vectors[:, positive] * np.sqrt(values[positive])
    return modes


def projected_deviation(projection: FloatArray, fields: FloatArray, /) -> FloatArray:
    """(n,): root of the sum of squares of k independent displacement fields (n, 3, k), each projected.

    projection : see `PointSensitivity`.
    """
    return np.asarray(np.sqrt(((projection @ fields) ** 2).sum(axis=(1, 2))))


def _one_camera_sensitivity(view: _ProjectionDerivatives, ray: FloatArray) -> PointSensitivity:
    inverse = _invert(np.concatenate([view.by_point, ray[:, None]], axis=1))
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    return PointSensitivity(
        -inverse[:, :, :2] @ view.by_parameter, np.full((len(ray), 3, 1), np.nan), view.inside, across
    )


def _two_camera_sensitivity(
    cameras: Sequence[Pinhole], views: list[_ProjectionDerivatives], points_mm: FloatArray, ray: FloatArray
) -> PointSensitivity:
    shared = [view.inside & views[0].inside for view in views[1:]]
    other = 1 + int(np.argmax([each.sum() for each in shared]))
    first, second = views[0], views[other]
    along = _normalise(np.einsum("nij,nj->ni", second.by_point, ray))
    second_ray = points_mm - cameras[other].centre_mm
    across = _normalise(np.einsum("nij,nj->ni", first.by_point, second_ray))
    third = np.einsum("ni,nij->nj", along, second.by_point)
    inverse = _invert(np.concatenate([first.by_point, third[:, None]], axis=1))
    by_parameter = np.zeros((len(points_mm), 3, _PARAMETER_COUNT * len(cameras)))
    by_parameter[:, :, :_PARAMETER_COUNT] = -inverse[:, :, :2] @ first.by_parameter
    along_by_parameter = np.einsum("ni,nip->np", along, second.by_parameter)
    own = slice(_PARAMETER_COUNT * other, _PARAMETER_COUNT * (other + 1))
    by_parameter[:, :, own] = -inverse[:, :, 2:] * along_by_parameter[:, None]
    # A stripe is located with an error across it in either image.
    first_noise = np.einsum("nij,nj->ni", inverse[:, :, :2], across)
    by_noise = np.stack([inverse[:, :, 2], first_noise], axis=2)
    return PointSensitivity(by_parameter, by_noise, shared[other - 1], ray[:, None])


def _project(device: Pinhole, points_mm: FloatArray) -> _ProjectionDerivatives:
    """Project points into a device, with the derivatives by the point and by the device's parameters."""
    rotated = points_mm @ device.rotation.T
    x, y, z = (rotated + device.translation_mm).T
    in_front = z > 0
    z = np.where(in_front, z, np.nan)
    x, y = x / z, y / z
    xd, yd, xx, xy, yy = distort(device.distortion, x, y)
    matrix = device.matrix[:2, :2]
    pixel = np.stack([xd, yd], axis=1) @ matrix.T + device.matrix[:2, 2]
    by_normalised = matrix @ np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    perspective = np.zeros((len(x), 2, 3))
    perspective[:, 0, 0] = perspective[:, 1, 1] = 1 / z
    perspective[:, 0, 2], perspective[:, 1, 2] = -x / z, -y / z
    by_device = by_normalised @ perspective
    by_parameter = np.zeros((len(x), 2, _PARAMETER_COUNT))
    by_parameter[:, 0, 0], by_parameter[:, 1, 1] = xd, yd
    by_parameter[:, 0, 2] = by_parameter[:, 1, 3] = 1
    for row in range(2):
        by_parameter[:, row, 4:9] = np.stack(distortion_by_terms(matrix[row, 0], matrix[row, 1], x, y), axis=1)
    # R' X = R X + turn x (R X).
    by_parameter[:, :, 9:12] = np.cross(rotated[:, None, :], by_device)
    by_parameter[:, :, 12:15] = by_device
    inside = in_front & (pixel > -0.5).all(axis=1)
    inside &= (pixel[:, 0] < device.size.width_px - 0.5) & (pixel[:, 1] < device.size.height_px - 0.5)
    # Beyond the radius at which its distortion folds back, the lens model is not valid.
    inside &= xx * yy - xy * xy > 0
    return _ProjectionDerivatives(by_device @ device.rotation, by_parameter, inside)


def _normalise(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _invert(matrices: FloatArray) -> FloatArray:
    """Invert matrices (n, 3, 3); NaN where one is singular or not finite."""
    finite = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2)))
    regular = finite[np.abs(np.linalg.det(matrices[finite])) > 0]
    result = np.full_like(matrices, np.nan)
    result[regular] = np.linalg.inv(matrices[regular])
    return result

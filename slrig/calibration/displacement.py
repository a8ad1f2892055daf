"""By how much a measured point moves when the devices are not quite what a calibration says.

A point X is found from three equations h(X, θ) = m: its pixel (u, v) in a camera, and a third one, m fixed as it was
measured. A small change of the devices' parameters θ moves it by

    dX = -(∂h/∂X)⁻¹ ∂h/∂θ dθ

(the implicit function theorem). The third equation is the projector's column (or row) of the light; without a
projector, the second camera's coordinate along the epipolar line, as for a stripe that runs straight across it. One
camera alone has no third measurement: there r · X = m with the viewing ray r, as if the distance were known.

Where several cameras see the light of one projector pixel, a scan takes the mean of their points, weighted by inverse
variance; with equal noise in all of them the weight is the square of how far a camera sees the point move, in pixels,
when it moves along the projector's ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.solution import PARAMETERS
from slrig.model import Axis, FloatArray, Pinhole, depth_sensitive_cameras, triangulated_axis
from slrig.model.lens import distort, distortion_by_terms

_EACH = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class Moved:
    """How n points move. by_parameter : (n, 3, p) float64, mm per unit of each of the p parameters of all devices.

    by_noise : (n, 3, e) float64, mm for each of e independent errors of one pixel of the light that a point is found
    by; NaN where no light finds it. seen : (n,) bool, whether enough devices see the point; the numbers of the others
    mean nothing. stated : (n, m, 3) float64, what of a displacement is stated as the error of a point, the part along
    each of m rows: along the first camera's ray r, m = 1; of one camera alone across it, the m = 3 rows of 1 - r rᵀ.
    """

    by_parameter: FloatArray
    by_noise: FloatArray
    seen: NDArray[np.bool_]
    stated: FloatArray


class RigidMotion(NamedTuple):
    """How far points move as one: turn_deg, about their middle, and shift_mm, of their middle."""

    turn_deg: float
    shift_mm: float

    @property
    def words(self) -> str:
        """As a sentence has it."""
        return f"a turn of {self.turn_deg:.2g}° and a shift of {self.shift_mm:.2g} mm"


class _Projected(NamedTuple):
    """by_point : (n, 2, 3) and by_parameter : (n, 2, 15) float64, of the pixel; inside : (n,) bool, in the image."""

    by_point: FloatArray
    by_parameter: FloatArray
    inside: NDArray[np.bool_]


def moved_points(cameras: Sequence[Pinhole], projector: Pinhole | None, points_mm: FloatArray, /) -> Moved:
    """How points (n, 3) in the world move with the parameters of the cameras, in order, then of the projector.

    Without a projector, a point is found by the first camera and the one that shares most of the points with it. One
    camera alone moves it across its ray only.
    """
    views = [_projected(camera, points_mm) for camera in cameras]
    sight = _unit(points_mm - cameras[0].centre_mm)
    if projector is None and len(cameras) == 1:
        return _by_one_camera(views[0], sight)
    if projector is None:
        return _by_two_cameras(cameras, views, points_mm, sight)
    light = _projected(projector, points_mm)
    axis = triangulated_axis(cameras, projector)
    coordinate = 0 if axis is Axis.COLUMN else 1
    ray = _unit(points_mm - projector.centre_mm)
    told = np.array(depth_sensitive_cameras(axis, cameras, projector))
    seen_to_move = [(np.einsum("nij,nj->ni", view.by_point, ray) ** 2).sum(axis=1) for view in views]
    weights = np.stack([np.where(view.inside, m, 0.0) for view, m in zip(views, seen_to_move, strict=True)])
    weights *= told[:, None]
    total = weights.sum(axis=0)
    weights = weights / np.where(total > 0, total, 1.0)
    by_parameter = np.zeros((len(points_mm), 3, _EACH * (len(cameras) + 1)))
    noises = []
    for index, (view, weight) in enumerate(zip(views, weights, strict=True)):
        inverse = _inverses(np.concatenate([view.by_point, light.by_point[:, coordinate, None]], axis=1))
        # A camera that does not see a point has no part in it, not even one that is not a number.
        inverse = np.where(weight[:, None, None] > 0, inverse * weight[:, None, None], 0.0)
        own = slice(_EACH * index, _EACH * (index + 1))
        by_parameter[:, :, own] = -inverse[:, :, :2] @ np.nan_to_num(view.by_parameter)
        by_parameter[:, :, -_EACH:] -= inverse[:, :, 2:] @ light.by_parameter[:, coordinate, None]
        noises.append(inverse[:, :, 2])
    return Moved(by_parameter, np.stack(noises, axis=2), light.inside & (total > 0), sight[:, None])


def cell_centres(box_mm: FloatArray, counts: Sequence[int], /) -> FloatArray:
    """(n, 3) float64: the middles of equal cells, so many along each axis, of a box (2, 3), mm."""
    axes = [
        low + (high - low) * (np.arange(count) + 0.5) / count for low, high, count in zip(*box_mm, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def rigid_free(points_mm: FloatArray, fields: FloatArray, /) -> FloatArray:
    """(n, 3, k): fields of displacement (n, 3, k), each without the rigid motion that is nearest to it.

    A small rigid motion moves X by t + ω × X; t and ω are those that leave the least sum of squares.
    """
    from_middle = points_mm - points_mm.mean(axis=0)
    scale = max(float(np.abs(from_middle).max()), 1e-300)
    motions = np.zeros((len(points_mm), 3, 6))
    motions[:, :, :3] = np.eye(3)
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], from_middle / scale)
    flat = fields.reshape(3 * len(points_mm), -1)
    basis, _ = np.linalg.qr(motions.reshape(-1, 6))
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(fields.shape))


def without_rigid_motion(before_mm: FloatArray, after_mm: FloatArray, /) -> tuple[FloatArray, RigidMotion]:
    """How far points (n, 3) moved beyond the rigid motion nearest to their moves, (n, 3); and that motion, of any size.

    The turn and the shift are those that leave the least sum of squares (Kabsch 1976). Two solves of one rig differ by
    such a motion, because each takes its own first camera for the world: no measurement of a shape notices it. mrcal's
    difference of two camera models removes it for the same reason (mrcal.secretsauce.net/differencing.html).
    """
    # Late: the service knows the values of this module, and computes none of them.
    from scipy.spatial.transform import Rotation

    middle = before_mm.mean(axis=0)
    shift = after_mm.mean(axis=0) - middle
    turn, _ = Rotation.align_vectors(after_mm - middle - shift, before_mm - middle)
    left = after_mm - middle - shift - turn.apply(before_mm - middle)
    return left, RigidMotion(float(np.degrees(turn.magnitude())), float(np.linalg.norm(shift)))


def modes_of(covariance: FloatArray, /) -> FloatArray:
    """(p, k): independent changes of the parameters by one standard deviation each: modes @ modes.T = covariance.

    The parameters are divided by their deviations first: focal lengths and angles differ by many orders.
    """
    deviation = np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    known = deviation > 0
    scaled = covariance[np.ix_(known, known)] / np.outer(deviation[known], deviation[known])
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    kept = values > 0
    modes = np.zeros((len(covariance), int(kept.sum())))
    modes[known] = deviation[known, None] * vectors[:, kept] * np.sqrt(values[kept])
    return modes


def stated_deviation(stated: FloatArray, fields: FloatArray, /) -> FloatArray:
    """(n,): root of the sum of squares of what is `Moved.stated` of k independent fields of displacement (n, 3, k)."""
    return np.asarray(np.sqrt(((stated @ fields) ** 2).sum(axis=(1, 2))))


def _by_one_camera(view: _Projected, sight: FloatArray) -> Moved:
    inverse = _inverses(np.concatenate([view.by_point, sight[:, None]], axis=1))
    across = np.eye(3) - sight[:, :, None] * sight[:, None]
    return Moved(-inverse[:, :, :2] @ view.by_parameter, np.full((len(sight), 3, 1), np.nan), view.inside, across)


def _by_two_cameras(
    cameras: Sequence[Pinhole], views: list[_Projected], points_mm: FloatArray, sight: FloatArray
) -> Moved:
    shared = [view.inside & views[0].inside for view in views[1:]]
    other = 1 + int(np.argmax([each.sum() for each in shared]))
    first, second = views[0], views[other]
    along = _unit(np.einsum("nij,nj->ni", second.by_point, sight))
    back = points_mm - cameras[other].centre_mm
    across = _unit(np.einsum("nij,nj->ni", first.by_point, back))
    third = np.einsum("ni,nij->nj", along, second.by_point)
    inverse = _inverses(np.concatenate([first.by_point, third[:, None]], axis=1))
    by_parameter = np.zeros((len(points_mm), 3, _EACH * len(cameras)))
    by_parameter[:, :, :_EACH] = -inverse[:, :, :2] @ first.by_parameter
    moved = np.einsum("ni,nip->np", along, second.by_parameter)
    by_parameter[:, :, _EACH * other : _EACH * (other + 1)] = -inverse[:, :, 2:] * moved[:, None]
    # A stripe is found with an error across it in either image.
    own = np.einsum("nij,nj->ni", inverse[:, :, :2], across)
    return Moved(by_parameter, np.stack([inverse[:, :, 2], own], axis=2), shared[other - 1], sight[:, None])


def _projected(device: Pinhole, points_mm: FloatArray) -> _Projected:
    """Project points into a device, with the derivatives by the point and by the device's parameters."""
    turned = points_mm @ device.rotation.T
    x, y, z = (turned + device.translation_mm).T
    before = z > 0
    z = np.where(before, z, np.nan)
    x, y = x / z, y / z
    xd, yd, xx, xy, yy = distort(device.distortion, x, y)
    matrix = device.matrix[:2, :2]
    pixel = np.stack([xd, yd], axis=1) @ matrix.T + device.matrix[:2, 2]
    by_normalised = matrix @ np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    perspective = np.zeros((len(x), 2, 3))
    perspective[:, 0, 0] = perspective[:, 1, 1] = 1 / z
    perspective[:, 0, 2], perspective[:, 1, 2] = -x / z, -y / z
    by_device = by_normalised @ perspective
    by = np.zeros((len(x), 2, _EACH))
    by[:, 0, 0], by[:, 1, 1] = xd, yd
    by[:, 0, 2] = by[:, 1, 3] = 1
    for row in range(2):
        by[:, row, 4:9] = np.stack(distortion_by_terms(matrix[row, 0], matrix[row, 1], x, y), axis=1)
    # R' X = R X + turn x (R X).
    by[:, :, 9:12] = np.cross(turned[:, None, :], by_device)
    by[:, :, 12:15] = by_device
    inside = before & (pixel > -0.5).all(axis=1)
    inside &= (pixel[:, 0] < device.size.width_px - 0.5) & (pixel[:, 1] < device.size.height_px - 0.5)
    # Beyond the radius at which its distortion turns back a lens sees nothing, whatever the polynomial says there.
    inside &= xx * yy - xy * xy > 0
    return _Projected(by_device @ device.rotation, by, inside)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _inverses(matrices: FloatArray) -> FloatArray:
    """(n, 3, 3): the inverses; NaN where there is none, or where a matrix is not finite."""
    finite = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2)))
    good = finite[np.abs(np.linalg.det(matrices[finite])) > 0]
    result = np.full_like(matrices, np.nan)
    result[good] = np.linalg.inv(matrices[good])
    return result

"""What a solve gives: the devices, how well each number is known, and what is left over.

Parameters of a device, 15 in this order, each with its row and column in the covariance:
fx, fy, cx, cy (px), k1, k2, p1, p2, k3, a small turn (three angles, rad: R' = exp([turn]x) R), translation (mm).
The world is the first camera's frame, so that its pose has no variance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.model import Axis, Calibration, FloatArray, IntArray, Pinhole, told_depth, triangulated_axis
from slrig.model.lens import LENS_TERMS, by_terms, distorted

PARAMETERS = ("fx", "fy", "cx", "cy", *LENS_TERMS, "turn_x", "turn_y", "turn_z", "x_mm", "y_mm", "z_mm")
CELLS = 6
"""Residual maps have 6 x 6 cells over the image."""

LEAST_HALVED = 8
"""So many poses are solved as two halves as well: four are the least of which a solve can hold any out, and so tell one
lens from another by itself."""

PROJECTOR = "projector"
"""The projector's name among devices."""


def device_title(name: str) -> str:
    """A device's name as a sentence has it.

    >>> device_title("left"), device_title("projector")
    ("camera 'left'", 'the projector')
    """
    return "the projector" if name == PROJECTOR else f"camera '{name}'"


def devices_of(calibration: Calibration, /) -> dict[str, Pinhole]:
    """Cameras in order, then the projector where there is one: the order of the covariance."""
    light = {} if calibration.projector is None else {PROJECTOR: calibration.projector}
    return {**calibration.cameras, **light}


def covariance_of(calibration: Calibration, /, *names: str, board: bool = True) -> FloatArray:
    """(15 k, 15 k) float64: the covariance of the named devices, of all without names; zeros where none is stated.

    board : False leaves out what the size of the board's squares is unsure by, for what is seen of the same board.
    """
    order = list(devices_of(calibration))
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
    """Where the board stood: X_world = rotation @ X_board + translation_mm; (3, 3) and (3,) float64."""

    rotation: FloatArray
    translation_mm: FloatArray

    def placed(self, points_mm: FloatArray) -> FloatArray:
        """(n, 3) float64: points of the board (n, 3) where they lie."""
        return np.asarray(points_mm @ self.rotation.T + self.translation_mm)


@dataclass(frozen=True, slots=True)
class DeviceResiduals:
    """What is left of one device's observations, px: rms of the distance for a camera's corners (both coordinates), rms
    per coordinate for the projector's light.

    count : observations; outlying : of them, given next to no weight, and in no other figure; stated_rms_px : what
    their own deviations predict; held_out_rms_px : rms at poses that the solve had not seen, NaN if there were too
    few; pose_rms_px : by pose. map_rms_px : (6, 6) float64, NaN where nothing was seen; map_count : (6, 6) int32;
    map_mean_px : (6, 6, 2) float64, the mean residual vector of a cell.
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
    """How far out of flat the board is: height_mm from its lowest corner to its highest, sigma_mm its deviation.

    solved : whether the solve took the board for bent; without it, the bow is what the poses would tell of one.
    """

    height_mm: float
    sigma_mm: float
    solved: bool


@dataclass(frozen=True, slots=True)
class BoardSize:
    """What is known of a print's size, in shares. scale_sigma : deviation of the mean of width and height, which no
    pose tells. stretch : width over height less 1, beyond what the board says of itself, as the poses tell it, and its
    deviation stretch_sigma.
    """

    scale_sigma: float = 0.0
    stretch: float = 0.0
    stretch_sigma: float = 0.0


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """What a scan with this calibration may be wrong by, mm, over the volume in which the board was held.

    Root mean squares over the volume of one standard deviation each. Errors of position as a whole, which move and
    turn everything alike, are no errors of a measurement and are left out.

    volume_mm : (2, 3) float64, opposite corners of the volume's box in the world.
    point_mm : of a point along the first camera's viewing ray, from the calibration alone. noise_mm : from the noise of
    one point's light alone, that of a surface as bright as the board's paper; NaN where no light was observed.
    total_mm : both. length_share : of a length over that length, from the calibration alone, for lengths of half the
    volume's diagonal in all directions that occur in it. board_mm : the part of point_mm that the size of the board's
    squares makes, as far as that is known.
    grid_mm : (n, 3) float64, places in the volume that the devices see; grid_point_mm : (n,) float64, point_mm there.
    across : the calibration is of one camera alone, which tells no depth: point_mm is across its viewing ray, of points
    whose distance is known from elsewhere, and noise_mm, total_mm and length_share are NaN.
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
    def point_words(self) -> str:
        """What `point_mm` is the error of."""
        return "a point of known distance" if self.across else "a scanned point"

    @property
    def way_words(self) -> str:
        """In which direction `point_mm` is, to be put behind it; empty where that need not be said."""
        return " across the line of sight" if self.across else ""


@dataclass(frozen=True, slots=True)
class Half:
    """What the odd or the even poses of a solve give alone. poses : their names. change : (15 d,) float64, its
    parameters less those of the whole solve; covariance : (15 d, 15 d) float64.
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
    poses : by name, those that were used; outliers : those left out, each with the reason in words.
    residuals : by device, PROJECTOR among them.
    board_shape_mm : (n, 3) float64, by how much each corner lies off its place, or None where that was not solved.
    bow : how far out of flat the board is; None where a person said that it is flat.
    halves : what the odd poses and the even ones give, each alone; empty where there are too few.
    size : of the board's print; its scale is in the covariance (`scale_mode`).
    """

    calibration: Calibration
    covariance: FloatArray
    distortion: Mapping[str, tuple[str, ...]]
    poses: Mapping[str, BoardPose]
    outliers: Mapping[str, str]
    residuals: Mapping[str, DeviceResiduals]
    board_shape_mm: FloatArray | None = None
    bow: Bow | None = None
    halves: tuple[Half, ...] = ()
    size: BoardSize = BoardSize()


def scale_mode(calibration: Calibration, /) -> FloatArray:
    """(15 d,) float64: by how much each parameter changes, per unit, when everything is larger by one share.

    The first camera stands still, and the distance of all others from it grows: of all parameters, translations alone.
    """
    base = next(iter(calibration.cameras.values())).centre_mm
    change = np.zeros((len(devices_of(calibration)), len(PARAMETERS)))
    for row, device in zip(change, devices_of(calibration).values(), strict=True):
        # A device at the centre c goes to base + (1 + s)(c - base), and its translation is -R c.
        row[-3:] = -device.rotation @ (device.centre_mm - base)
    return change.ravel()


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
    told = np.array(told_depth(axis, cameras, projector))
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
    xd, yd, xx, xy, yy = distorted(device.distortion, x, y)
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
        by[:, row, 4:9] = np.stack(by_terms(matrix[row, 0], matrix[row, 1], x, y), axis=1)
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

"""Axis, angles and planes of a turntable, from registered views, from a board at several angles, or from an empty scan.

If B_i are poses of a board on the turntable, T_i = B_0 B_i⁻¹ are rotations about its axis, as the poses of views are:
`fit_axis` fits both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from slrig.errors import TurntableRefusedError
from slrig.meshing import used_vertices
from slrig.model import FloatArray, MeasuredAxis, Mesh, PlaneKind, RotationAxis, TurntablePlane
from slrig.multiview.registration import START_ERROR_MM, Registration, register_views

MARGIN_MM, MARGIN_SIGMAS = 1.0, 4.0  # margin of a plane: for its unevenness, and for its noise
_MAX_PLANES = 4
_MIN_SHARE = 0.1  # share of a scan's vertices in a plate or a backdrop
_PLANE_REACH_MM, _PLANE_SIGMAS = 1.0, 4.0
"""Distance of a plane's vertices at first, and in standard deviations then. A surface that needs all of the former is
curved."""
_TRIALS, _TRIAL_SAMPLE = 600, 4000
"""Planes through three random vertices, enough to hit a plane of a fifth of all with 99 %; vertices to count."""
_MIN_FLAT = 0.8  # share of a plane's vertices whose normals are within 30° of its own
_FLAT_COSINE = 0.87
_PLATE_COSINE = 0.97  # of a plate's normal and the axis: 14°, more than a plate wobbles and less than a backdrop leans
_MIN_LEFT = 0.01  # share of a view's vertices that a cut has to leave


def find_turntable_planes(empty: Mesh, axis: RotationAxis | None = None) -> tuple[TurntablePlane, ...]:
    """Find the plate and backdrops in a scan of an empty turntable, the largest first.

    axis : of the turntable, identifies the plate; without it all planes are backdrops.

    Raises TurntableRefusedError: no plane was found.
    """
    points, normals = empty.vertices_mm.astype(np.float64), empty.normals.astype(np.float64)
    if len(points) < 3:
        raise TurntableRefusedError(
            f"expected a scan of the empty turntable, found {len(points)} vertices: scan it again"
        )
    random = np.random.default_rng(len(points))  # reproducible
    remaining = np.ones(len(points), dtype=np.bool_)
    found: list[TurntablePlane] = []
    while len(found) < _MAX_PLANES and remaining.sum() > max(_MIN_SHARE * len(points), 3):
        own, middle, normal, sigma = _find_plane(points, remaining, random)
        flat = float(np.mean(np.abs(normals[own] @ normal) > _FLAT_COSINE)) if own.any() else 0.0
        if own.mean() < _MIN_SHARE or flat < _MIN_FLAT or _PLANE_SIGMAS * sigma > _PLANE_REACH_MM:
            break
        found.append(_build_plane(points[own], normals[own], middle, normal, sigma, axis))
        # Surface near or behind the plane belongs to it or is hidden by it.
        remaining &= (points - middle) @ found[-1].normal > found[-1].margin_mm
    if not found:
        raise TurntableRefusedError(
            f"expected a plate or a backdrop in the scan of the empty turntable, found no plane that holds "
            f"{_MIN_SHARE:.0%} of its {len(points):,} vertices and is flat to {_PLANE_REACH_MM / _PLANE_SIGMAS:g} mm: "
            "take the object away, light the plate, and scan it again"
        )
    return tuple(found)


def fit_plane(points: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """Point (3,), normal (3,) and standard deviation of the plane through most of the points (n, 3); None if that holds
    half of them or less.
    """
    if len(points) < 3:
        return None
    everywhere = np.ones(len(points), dtype=np.bool_)
    own, middle, normal, sigma = _find_plane(points, everywhere, np.random.default_rng(len(points)))
    return (middle, normal, sigma) if own.mean() > 0.5 else None


def _find_plane(
    points: FloatArray, remaining: NDArray[np.bool_], random: np.random.Generator
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray, float]:
    """Mask of the points of the plane that most of those remaining are near to, its middle, normal and σ.

    RANSAC over planes through three points, then least squares within a shrinking reach.
    """
    candidates = points[remaining]
    sample = candidates[random.integers(len(candidates), size=_TRIAL_SAMPLE)]
    a, b, c = candidates[random.integers(len(candidates), size=(3, _TRIALS))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0, length, np.inf)
    near = np.abs(sample @ normals.T - (a * normals).sum(axis=1)) < _PLANE_REACH_MM
    best = int(np.argmax(np.where(length[:, 0] > 0, near.sum(axis=0), -1)))
    middle, normal, reach, sigma = a[best], normals[best], _PLANE_REACH_MM, _PLANE_REACH_MM
    own = remaining & (np.abs((points - middle) @ normal) < reach)
    for _ in range(6):
        if own.sum() < 3:
            break
        middle = points[own].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[own] - middle).T))[1][:, 0]
        off = (points - middle) @ normal
        sigma = float(1.4826 * np.median(np.abs(off[own])))
        reach = min(_PLANE_REACH_MM, max(_PLANE_SIGMAS * sigma, 1e-3))
        own = remaining & (np.abs(off) < reach)
    return own, middle, normal, sigma


def _build_plane(
    points: FloatArray,
    normals: FloatArray,
    middle: FloatArray,
    normal: FloatArray,
    sigma: float,
    axis: RotationAxis | None,
) -> TurntablePlane:
    # Normals of a scan's vertices point towards the camera.
    normal = normal * (1.0 if np.nanmedian(normals @ normal) > 0 else -1.0)
    radius = float(np.percentile(np.linalg.norm(points - middle, axis=1), 99))
    cosine = 0.0 if axis is None else abs(float(normal @ axis.direction))
    kind = PlaneKind.PLATE if cosine > _PLATE_COSINE else PlaneKind.BACKDROP
    margin = MARGIN_MM + MARGIN_SIGMAS * sigma
    if kind is PlaneKind.PLATE:
        # As it turns, a plate tilted against the axis rises at its rim by twice its tilt.
        margin += 2 * radius * float(np.sqrt(max(1 - cosine**2, 0.0)))
    return TurntablePlane(kind, middle, normal, sigma, radius, margin)


class CutView(NamedTuple):
    """A view without the planes of the turntable. removed : share of its vertices removed by each plane in order;
    vertices behind several count for the first.
    """

    mesh: Mesh
    removed: tuple[float, ...]


def cut_view(view: Mesh, planes: Sequence[TurntablePlane], *, name: str = "the view") -> CutView:
    """Remove the vertices behind planes or within their margin in front of them, and all triangles of these vertices.

    Raises TurntableRefusedError: less than a hundredth would be left.
    """
    if not planes:
        return CutView(view, ())
    points = view.vertices_mm.astype(np.float64)
    remaining = np.ones(len(points), dtype=np.bool_)
    removed = []
    for plane in planes:
        in_front = (points - plane.point_mm) @ plane.normal > plane.margin_mm
        removed.append(float(np.mean(remaining & ~in_front)))
        remaining &= in_front
    faces = view.faces[remaining[view.faces].all(axis=1)]
    used = used_vertices(faces, len(points))
    if used.mean() < _MIN_LEFT:
        shares = ", ".join(f"{plane.kind} {share:.0%}" for plane, share in zip(planes, removed, strict=True))
        raise TurntableRefusedError(
            f"{name}: expected an object in front of the turntable's planes, found that a cut would leave "
            f"{used.mean():.1%} of the view ({shares}). The turntable or the cameras were moved: scan the empty "
            "turntable again, or do not cut"
        )
    numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
    mesh = Mesh(
        vertices_mm=view.vertices_mm[used],
        faces=numbers[faces],
        normals=view.normals[used],
        colour=view.colour[used],
        mark=view.mark[used],
        sigma_mm=view.sigma_mm[used],
        stripe=view.stripe[used],
    )
    return CutView(mesh, tuple(removed))


_POSE_FLOOR_MM = 1e-3  # least standard deviation of a pose
_FREE_SIGMA_MM = 10.0  # standard deviation along free directions: far more than any other, and than any start's error
_MAX_ROUNDS = 5
_SETTLED_MM = 0.001  # change of the axis, at the object, at which the rounds end
_MIN_ROTATION_RAD = np.deg2rad(1.0)


def turntable_poses(axis_point_mm: FloatArray, axis_direction: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """(N, 4, 4): poses of views of an object on a turntable before fixed cameras: each turns a view back to the first.

    axis_point_mm, axis_direction : (3,), in the frame of the views. angles_rad : (N,), of the turntable, right-handed
    about the direction.
    """
    direction = np.asarray(axis_direction, dtype=np.float64) / np.linalg.norm(axis_direction)
    back = angles_rad[0] - np.asarray(angles_rad, dtype=np.float64)
    turns = Rotation.from_rotvec(back[:, None] * direction).as_matrix()
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = axis_point_mm - turns @ axis_point_mm
    return poses


@dataclass(frozen=True, slots=True)
class TurntableAxis:
    """Axis of poses that are turns about it, and its uncertainty.

    point_mm : (3,), its point nearest to the object's middle; direction : (3,), unit; angles_rad : (N,), of the
    turntable, within half a turn of 0. point_sigma_mm, direction_sigma_rad : standard deviations across the axis, rms
    of both directions. rms_mm : deviation of the poses from pure turns, at the object's radius; rms_over_sigma : the
    same by their covariance, about 1 if it is due to noise. covariance : as that of `MeasuredAxis`.
    """

    point_mm: FloatArray
    direction: FloatArray
    angles_rad: FloatArray
    point_sigma_mm: float
    direction_sigma_rad: float
    rms_mm: float
    rms_over_sigma: float
    covariance: FloatArray

    @property
    def measured_axis(self) -> MeasuredAxis:
        """The axis alone."""
        return MeasuredAxis(self.point_mm, self.direction, self.covariance)


def axis_from_registration(registration: Registration, towards: FloatArray) -> TurntableAxis | None:
    """Fit the axis to a registration's poses, see `fit_axis`, without weight along their free directions."""
    radius = registration.radius_mm
    scale = np.tile(np.repeat([1 / radius, 1.0], 3), len(registration.poses) - 1)
    free = registration.free_directions * scale[:, None]
    covariance = registration.covariance + _FREE_SIGMA_MM**2 * free @ free.T
    return fit_axis(registration.poses, covariance, registration.middle_mm, radius, towards)


def register_on_turntable(
    views: Sequence[Mesh],
    axis_point_mm: FloatArray,
    axis_direction: FloatArray,
    angles_rad: FloatArray,
    *,
    names: Sequence[str] | None = None,
    start_error_mm: float = START_ERROR_MM,
    on_round: Callable[[int], None] = lambda _: None,
) -> tuple[Registration, TurntableAxis | None]:
    """Register views of an object on a turntable, and find the turntable's axis, starting from an approximate one.

    Free motions keep the start's value: between the sides of a box only the turntable determines the distance. So the
    axis is fitted to all other motions, and the views are registered again from there. on_round : called with the
    number of each round. Other parameters as of `turntable_poses` and `register_views`. Raises as `register_views`.
    """
    point, direction = axis_point_mm, axis_direction / np.linalg.norm(axis_direction)
    for number in range(_MAX_ROUNDS):
        on_round(number)
        starts = turntable_poses(point, direction, angles_rad)
        found = register_views(views, starts, names=names, start_error_mm=start_error_mm)
        axis = axis_from_registration(found, direction)
        if axis is None or not found.free or number == _MAX_ROUNDS - 1:
            break
        across = np.cross(axis.point_mm - point, direction)
        moved_mm = np.linalg.norm(across) + found.radius_mm * np.linalg.norm(axis.direction - direction)
        if moved_mm < _SETTLED_MM:
            break
        point, direction = axis.point_mm, axis.direction
    return found, axis


def fit_axis(
    poses: FloatArray, covariance: FloatArray, middle_mm: FloatArray, radius_mm: float, towards: FloatArray
) -> TurntableAxis | None:
    """Fit the axis and angles of a turntable to poses by least squares; None if the poses are hardly turned.

    poses : (N, 4, 4), covariance : (6 (N - 1), 6 (N - 1)), middle_mm and radius_mm : of an object, as those of a
    `Registration`. towards : (3,), a direction at an acute angle to the axis'.
    """
    middle, radius = middle_mm, radius_mm
    vectors = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    if np.linalg.norm(vectors, axis=1).max() < _MIN_ROTATION_RAD:
        return None
    direction = np.linalg.svd(vectors)[2][0]
    direction *= 1.0 if direction @ towards > 0 else -1.0
    # Points of the axis are fixed: T x = x.
    fixed = (np.eye(3) - poses[:, :3, :3]).reshape(-1, 3)
    point = middle + np.linalg.lstsq(fixed, poses[:, :3, 3].ravel() - fixed @ middle, rcond=1e-6)[0]
    across = np.linalg.svd(direction[None])[2][1:]
    scale = np.tile(np.repeat([radius, 1.0], 3), len(poses) - 1)
    scaled = covariance * scale[:, None] * scale
    whiten = np.linalg.inv(np.linalg.cholesky(scaled + _POSE_FLOOR_MM**2 * np.eye(len(scale))))

    def axis_at(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        tilted = direction + parameters[2:4] @ across / radius
        return point + parameters[:2] @ across, tilted / np.linalg.norm(tilted)

    def residuals(parameters: FloatArray) -> FloatArray:
        change = poses @ np.linalg.inv(turntable_poses(*axis_at(parameters), np.append(0.0, parameters[4:])))
        turns = radius * Rotation.from_matrix(change[:, :3, :3]).as_rotvec()
        return np.hstack([turns, change[:, :3, :3] @ middle + change[:, :3, 3] - middle])[1:].ravel()

    def whitened_residuals(parameters: FloatArray) -> FloatArray:
        return np.asarray(whiten @ residuals(parameters))

    begin = np.concatenate([np.zeros(4), -(vectors @ direction)[1:]])
    fit = least_squares(whitened_residuals, begin)
    over = float(np.sqrt(2 * fit.cost / (len(fit.fun) - len(fit.x))))
    slopes = np.asarray(fit.jac)
    # Deviations from pure turns beyond the covariance make the axis less certain.
    known = max(1.0, over) ** 2 * np.linalg.pinv(slopes.T @ slopes)[:4, :4]
    squared = np.square(residuals(fit.x)).reshape(-1, 6).sum(axis=1)
    place, direction_found = axis_at(fit.x)
    angles = np.append(0.0, fit.x[4:])
    along = direction_found @ (middle - place)
    tilts = across.T / radius
    by_fit = np.block([[across.T, along * tilts], [np.zeros((3, 2)), tilts]])
    measured = MeasuredAxis(place + direction_found * along, direction_found, by_fit @ known @ by_fit.T)
    return TurntableAxis(
        point_mm=measured.point_mm,
        direction=direction_found,
        angles_rad=(angles + np.pi) % (2 * np.pi) - np.pi,
        point_sigma_mm=measured.point_sigma_mm,
        direction_sigma_rad=measured.direction_sigma_rad,
        rms_mm=float(np.sqrt(squared.mean())),
        rms_over_sigma=over,
        covariance=measured.covariance,
    )


MIN_POSES = 3
MIN_TURN_DEG = 20.0
"""Range of a board's angles: the arc over 20° bends by 1.5 % of its radius, enough to measure the radius."""
_MIN_SLIP_MM, _SLIP_SIGMAS = 0.05, 2.0
"""Below either limit the rms residual is due to bearings or noise; of three poses one in 2000 has more."""
_MAX_RESIDUAL_MM = 0.5  # largest rms residual of turns about one axis: plastic bearings have 0.1 to 0.3 mm
_SLIP_SHARE = 0.5  # share of the residual that may remain without the pose that slipped
_UP = np.array([0.0, -1.0, -1.0])
"""Direction of an axis without stated angles: up in the first camera's image, and towards the camera."""


class BoardAxis(NamedTuple):
    """The axis of a turntable from a board on it.

    residual_mm : by pose, rms distance of the board's corners from their places after a pure turn. angles_deg : by
    pose, from the first one on; errors_deg : these less the stated angles and the mean of that; empty without stated
    angles.
    """

    axis: TurntableAxis
    residual_mm: dict[str, float]
    angles_deg: dict[str, float]
    errors_deg: dict[str, float]


def axis_from_board(
    names: Sequence[str],
    poses: FloatArray,
    covariance: FloatArray,
    points_mm: FloatArray,
    angles_deg: Sequence[float] | FloatArray | None = None,
) -> BoardAxis:
    """Measure the axis from poses of a board that is fixed to the turntable.

    poses : (m, 4, 4), board to world. covariance : (6 m, 6 m), as `slrig.calibration.health.drift` has both.
    points_mm : (n, 3), the board's corners. angles_deg : (m,), stated by the turntable; their sense determines the
    direction of the axis. Without them it points up in the first camera's image.

    Raises TurntableRefusedError: there are fewer than three poses, or the board was turned by less than 20°, slipped,
    or does not turn about one axis.
    """
    if len(names) < MIN_POSES:
        raise TurntableRefusedError(
            f"expected {MIN_POSES} poses or more of a board on the turntable, found {len(names)}: turn the turntable "
            "and shoot the board again, best at six angles all around"
        )
    board = _TurnedBoard(names, poses, covariance, points_mm)
    axis = board.fit(range(len(names)))
    turn_deg = 0.0 if axis is None else _span_deg(axis.angles_rad)
    if axis is None or turn_deg < MIN_TURN_DEG:
        raise TurntableRefusedError(
            f"expected a board turned by {MIN_TURN_DEG:g}° or more in all, found {turn_deg:.1f}° over {len(names)} "
            "poses: turn the turntable further between them"
        )
    residual = board.residuals_mm(axis)
    if axis.rms_mm > _MIN_SLIP_MM and axis.rms_over_sigma > _SLIP_SIGMAS:
        board.require_fixed(axis, residual)
    stated = np.rad2deg(axis.angles_rad) if angles_deg is None else np.asarray(angles_deg, dtype=np.float64)
    errors = _wrap_deg(np.rad2deg(axis.angles_rad) - stated)
    reversed_errors = _wrap_deg(-np.rad2deg(axis.angles_rad) - stated)
    if np.std(reversed_errors) < np.std(errors):
        axis, errors = board.fit(range(len(names)), -axis.direction) or axis, reversed_errors
    return BoardAxis(
        axis=axis,
        residual_mm=dict(zip(names, residual.tolist(), strict=True)),
        angles_deg=dict(zip(names, np.rad2deg(axis.angles_rad).tolist(), strict=True)),
        errors_deg={} if angles_deg is None else dict(zip(names, (errors - errors.mean()).tolist(), strict=True)),
    )


class _TurnedBoard(NamedTuple):
    """See `axis_from_board`."""

    names: Sequence[str]
    poses: FloatArray
    covariance: FloatArray
    points_mm: FloatArray

    def fit(self, which: Sequence[int], towards: FloatArray = _UP) -> TurntableAxis | None:
        """The axis of some of the poses."""
        corners = self._corners_at(self.poses)
        middle = corners.reshape(-1, 3).mean(axis=0)
        radius = float(np.sqrt(np.square(corners - middle).sum(axis=2).mean()))
        return fit_axis(*self._relative_poses(which, middle), middle, radius, towards)

    def residuals_mm(self, axis: TurntableAxis) -> FloatArray:
        """(m,): rms distance of the corners, turned back by the angles, from their means over the poses."""
        back = turntable_poses(axis.point_mm, axis.direction, axis.angles_rad) @ self.poses
        corners = self._corners_at(back)
        return np.asarray(np.sqrt(np.square(corners - corners.mean(axis=0)).sum(axis=2).mean(axis=1)))

    def require_fixed(self, axis: TurntableAxis, residual: FloatArray) -> None:
        """Raises TurntableRefusedError: the board moved on the turntable, for one pose or from one on."""
        best = min(self._slips(), default=(np.inf, ""))
        if best[0] < min(_SLIP_SHARE * axis.rms_mm, _MAX_RESIDUAL_MM):
            raise TurntableRefusedError(
                f"{best[1]}: the poses are off turns about one axis by {axis.rms_mm:.3f} mm rms, without that by "
                f"{best[0]:.3f} mm. Fix the board to the turntable, and shoot all poses again, or leave that out"
            )
        if axis.rms_mm > _MAX_RESIDUAL_MM:
            worst = int(np.argmax(residual))
            raise TurntableRefusedError(
                f"expected a board that turns about one axis, found poses that are off by {axis.rms_mm:.2f} mm rms, "
                f"'{self.names[worst]}' by {residual[worst]:.2f} mm, the most: the board slipped more than once, or "
                "was hand-held. Fix it to the turntable, and shoot all poses again"
            )

    def _corners_at(self, poses: FloatArray) -> FloatArray:
        """(m, n, 3): the board's corners at the poses."""
        return self.points_mm @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]

    def _relative_poses(self, which: Sequence[int], middle: FloatArray) -> tuple[FloatArray, FloatArray]:
        """T_i = B_0 B_i⁻¹ (k, 4, 4) of some poses, and their covariance (6 (k - 1), 6 (k - 1)) about the middle.

        With small motions ε of both poses it is ε_0 - T_i ε_i T_i⁻¹.
        """
        poses = self.poses[list(which)]
        turns = poses[:1] @ np.linalg.inv(poses)
        by_pose = np.zeros((6 * len(poses), 6 * len(poses)))
        for i, (turn, pose) in enumerate(zip(turns, poses, strict=True)):
            own = slice(6 * i, 6 * i + 6)
            by_pose[own, :6] += _adjoint(np.eye(4), poses[0, :3, 3], middle)
            by_pose[own, own] -= _adjoint(turn, pose[:3, 3], middle)
        where = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in which])
        covariance = by_pose @ self.covariance[np.ix_(where, where)] @ by_pose.T
        return turns, covariance[6:, 6:]

    def _slips(self) -> Iterator[tuple[float, str]]:
        """Rms residual, mm, if the board slipped for one pose or between two, and the description of that."""
        count = len(self.names)
        everyone = range(count)
        for i in everyone:
            yield self._rms_mm([each for each in everyone if each != i]), f"the board slipped in '{self.names[i]}'"
        for k in range(2, count - 1):
            parts = [self._rms_mm(part) for part in (everyone[:k], everyone[k:]) if len(part) >= MIN_POSES]
            yield max(parts, default=np.inf), f"the board slipped between '{self.names[k - 1]}' and '{self.names[k]}'"

    def _rms_mm(self, which: Sequence[int]) -> float:
        """Rms residual of some poses; infinite if they are too few or hardly turned."""
        axis = self.fit(which) if len(which) >= MIN_POSES else None
        return np.inf if axis is None or _span_deg(axis.angles_rad) < MIN_TURN_DEG else axis.rms_mm


def _adjoint(turn: FloatArray, origin_mm: FloatArray, middle_mm: FloatArray) -> FloatArray:
    """(6, 6): from a small rotation and shift of a body's origin to those of the middle, after a motion by `turn`.

    The moved body's point at the middle is the one that was at T⁻¹ m.
    """
    rotation = turn[:3, :3]
    arm = rotation.T @ (middle_mm - turn[:3, 3]) - origin_mm
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = rotation
    adjoint[3:, :3] = rotation @ np.cross(np.eye(3), arm).T
    return adjoint


def _wrap_deg(angles: FloatArray) -> FloatArray:
    """Angles within half a turn of the first one."""
    return np.asarray((angles - angles[0] + 180) % 360 - 180 + angles[0])


def _span_deg(angles_rad: FloatArray) -> float:
    """Smallest range that contains all angles."""
    angles = np.sort(np.rad2deg(angles_rad) % 360)
    return float(360 - np.diff(angles, append=angles[0] + 360).max())

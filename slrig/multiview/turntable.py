"""Axis and angles of a turntable, from a board or planes at several angles, and its change over time.

Where a board's poses B_i are those of one body that a stage turned, T_i = B_0 B_i⁻¹ turns about the axis, as the poses
of views do: both are fitted by `slrig.multiview.turntable`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from slrig.errors import StageRefusedError
from slrig.meshing import used_vertices
from slrig.model import FloatArray, MeasuredAxis, Mesh, PlaneKind, StageAxis, StagePlane
from slrig.multiview.registration import START_ERROR_MM, Registration, registered

FAR_MM = 50.0
"""How far from the object's middle, along the axis, a difference of two axes is told."""
MOST_SIGMAS = 5.0
"""Of the distance of two axes in all four of their numbers: as rare (5e-5) as 4 standard deviations in one."""
_DRIFT_MM, _DRIFT_RAD = 0.005, 5e-5
"""What a rig moves against its stage from one model to the next: 1 K over 0.2 m of aluminium, and that over 0.1 m."""


class Noted(NamedTuple):
    """What an axis that was found anew says of the one on record.

    axis : both in one, by their covariances; the one on record where they are too far apart. moved_mm : how far they
    are apart, at most, up to 50 mm either way of the new one's point along it; moved_deg : their angle; sigmas : their
    distance over its deviation, in all four numbers of an axis.
    """

    axis: MeasuredAxis
    moved_mm: float
    moved_deg: float
    sigmas: float

    @property
    def agrees(self) -> bool:
        """Whether they are one axis."""
        return self.sigmas <= MOST_SIGMAS


def noted(record: MeasuredAxis, found: MeasuredAxis) -> Noted:
    """Improve an axis by another measurement of it (Kalman's filter, the axis drifting a little in between)."""
    way = record.direction
    sense = 1.0 if found.direction @ way > 0 else -1.0
    base = record.point_mm + way * (way @ (found.point_mm - record.point_mm))
    across = np.linalg.svd(way[None])[2][1:]
    drift = np.diag([_DRIFT_MM**2] * 2 + [_DRIFT_RAD**2] * 2)
    _, before = _in(StageAxis(base, way), across, record)
    difference, of_found = _in(StageAxis(base, way), across, found)
    before = before + drift
    gain = before @ np.linalg.inv(before + of_found)
    offset, tilt = difference[:2], difference[2:]
    ends = [float(np.linalg.norm(offset + s * tilt)) for s in (-FAR_MM, FAR_MM)]
    sigmas = float(np.sqrt(difference @ np.linalg.solve(before + of_found, difference)))
    axis = record
    if sigmas <= MOST_SIGMAS:
        change = gain @ difference
        direction = way + change[2:] @ across
        known = (np.eye(4) - gain) @ before
        spread = np.kron(np.eye(2), across.T)
        axis = MeasuredAxis(
            base + change[:2] @ across, direction / np.linalg.norm(direction), spread @ known @ spread.T
        )
    angle = np.arccos(np.clip(sense * (found.direction @ way), -1.0, 1.0))
    return Noted(axis, max(ends), float(np.rad2deg(angle)), sigmas)


def _in(base: StageAxis, across: FloatArray, axis: MeasuredAxis) -> tuple[FloatArray, FloatArray]:
    """(4,), (4, 4): where an axis crosses the plane through `base` square to it, along `across` (2, 3), mm, and its
    slopes there; and their covariance.
    """
    slope = axis.direction / (axis.direction @ base.direction)
    along = (base.point_mm - axis.point_mm) @ base.direction
    there = np.kron([[1.0, along], [0.0, 1.0]], across)
    numbers = np.concatenate([across @ (axis.point_mm + along * slope - base.point_mm), across @ slope])
    return numbers, there @ axis.covariance @ there.T


MARGIN_MM, MARGIN_SIGMAS = 1.0, 4.0
"""Of a plane: what is not flat, and turns with a plate that is not square to its axis; and its noise."""
_MOST_PLANES = 4
_LEAST_SHARE = 0.1
"""Of a scan's vertices: what is smaller is no plate and no backdrop."""
_FAR_MM, _NEAR_SIGMAS = 1.0, 4.0
"""How far a vertex of a plane may be from it at first, and of all deviations then. A surface that needs all of that
is curved.
"""
_TRIALS, _TRIED = 600, 4000
"""Planes through three vertices, of which one hits a plane of a fifth of all with 99 %; vertices that judge them."""
_LEAST_FLAT = 0.8
"""Share of a plane's vertices whose normal is within 30° of it: noise tilts triangles, and a crowd has any normal."""
_COSINE = 0.87
_PLATE_COSINE = 0.97
"""Of a plate's normal and the axis: 14°, more than any plate wobbles, and less than a backdrop leans."""
_LEAST_LEFT = 0.01
"""Of a view's vertices, after a cut: less is dust, and what is to be modelled lies behind the planes."""


def stage_planes(empty: Mesh, axis: StageAxis | None = None) -> tuple[StagePlane, ...]:
    """The planes of an empty stage, the largest first. axis : tells the plate from backdrops; without, all are those.

    Raises
    ------
    StageRefusedError
        Nothing in the scan is planar.
    """
    points, normals = empty.vertices_mm.astype(np.float64), empty.normals.astype(np.float64)
    if len(points) < 3:
        raise StageRefusedError(f"expected a scan of the empty stage, found {len(points)} vertices: scan it again")
    random = np.random.default_rng(len(points))  # by chance, and the same every time
    left = np.ones(len(points), dtype=np.bool_)
    found: list[StagePlane] = []
    while len(found) < _MOST_PLANES and left.sum() > max(_LEAST_SHARE * len(points), 3):
        middle, normal = _commonest(points[left], random)
        mine, middle, normal, sigma = _fitted(points, left, middle, normal)
        flat = float(np.mean(np.abs(normals[mine] @ normal) > _COSINE)) if mine.any() else 0.0
        if mine.mean() < _LEAST_SHARE or flat < _LEAST_FLAT or _NEAR_SIGMAS * sigma > _FAR_MM:
            break
        found.append(_plane(points[mine], normals[mine], middle, normal, sigma, axis))
        # What is near it, and behind it, is part of it or hidden by it.
        left &= (points - middle) @ found[-1].normal > found[-1].margin_mm
    if not found:
        raise StageRefusedError(
            f"expected a plate or a backdrop in the scan of the empty stage, found no plane that holds "
            f"{_LEAST_SHARE:.0%} of its {len(points):,} vertices and is flat to {_FAR_MM / _NEAR_SIGMAS:g} mm: take "
            "the object away, light the plate, and scan it again"
        )
    return tuple(found)


def fitted_plane(points: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """A point (3,) and the normal (3,) of the plane that most points (n, 3) lie on, and the deviation of those; None
    where that is not half of them.
    """
    if len(points) < 3:
        return None
    everywhere = np.ones(len(points), dtype=np.bool_)
    mine, middle, normal, sigma = _fitted(points, everywhere, *_commonest(points, np.random.default_rng(len(points))))
    return (middle, normal, sigma) if mine.mean() > 0.5 else None


def _commonest(points: FloatArray, random: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A point and the normal of the plane through three points that is near to most."""
    tried = points[random.integers(len(points), size=_TRIED)]
    a, b, c = points[random.integers(len(points), size=(3, _TRIALS))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0, length, np.inf)
    near = np.abs(tried @ normals.T - (a * normals).sum(axis=1)) < _FAR_MM
    best = int(np.argmax(np.where(length[:, 0] > 0, near.sum(axis=0), -1)))
    return a[best], normals[best]


def _fitted(
    points: FloatArray, left: NDArray[np.bool_], middle: FloatArray, normal: FloatArray
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray, float]:
    """Which points are of a plane, and its middle, normal and deviation, by least squares within a narrowing reach."""
    reach, sigma = _FAR_MM, _FAR_MM
    mine = left & (np.abs((points - middle) @ normal) < reach)
    for _ in range(6):
        if mine.sum() < 3:
            break
        middle = points[mine].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[mine] - middle).T))[1][:, 0]
        off = (points - middle) @ normal
        sigma = float(1.4826 * np.median(np.abs(off[mine])))
        reach = min(_FAR_MM, max(_NEAR_SIGMAS * sigma, 1e-3))
        mine = left & (np.abs(off) < reach)
    return mine, middle, normal, sigma


def _plane(
    points: FloatArray, seen: FloatArray, middle: FloatArray, normal: FloatArray, sigma: float, axis: StageAxis | None
) -> StagePlane:
    # Normals of a scan's vertices point to the side from which they were seen.
    normal = normal * (1.0 if np.nanmedian(seen @ normal) > 0 else -1.0)
    radius = float(np.percentile(np.linalg.norm(points - middle, axis=1), 99))
    square = 0.0 if axis is None else abs(float(normal @ axis.direction))
    kind = PlaneKind.PLATE if square > _PLATE_COSINE else PlaneKind.BACKDROP
    margin = MARGIN_MM + MARGIN_SIGMAS * sigma
    if kind is PlaneKind.PLATE:
        # As it turns, a plate that leans against the axis rises at its rim, as seen, by twice what it leans.
        margin += 2 * radius * float(np.sqrt(max(1 - square**2, 0.0)))
    return StagePlane(kind, middle, normal, sigma, radius, margin)


class Cut(NamedTuple):
    """A view without the stage. removed : share of its vertices that went, by plane in order: of what is behind
    several, the first one's.
    """

    mesh: Mesh
    removed: tuple[float, ...]


def cut(view: Mesh, planes: Sequence[StagePlane], *, name: str = "the view") -> Cut:
    """A view without what lies behind planes or within their margin before them; triangles go with any vertex.

    Raises
    ------
    StageRefusedError
        Less than a hundredth would be left.
    """
    if not planes:
        return Cut(view, ())
    points = view.vertices_mm.astype(np.float64)
    kept = np.ones(len(points), dtype=np.bool_)
    removed = []
    for plane in planes:
        before = (points - plane.point_mm) @ plane.normal > plane.margin_mm
        removed.append(float(np.mean(kept & ~before)))
        kept &= before
    faces = view.faces[kept[view.faces].all(axis=1)]
    used = used_vertices(faces, len(points))
    if used.mean() < _LEAST_LEFT:
        told = ", ".join(f"{plane.kind} {share:.0%}" for plane, share in zip(planes, removed, strict=True))
        raise StageRefusedError(
            f"{name}: expected an object before the planes of the stage, found that a cut would leave "
            f"{used.mean():.1%} of the view ({told}). The stage or the cameras were moved: scan the empty stage again, "
            "or do not cut"
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
    return Cut(mesh, tuple(removed))


_EXACT_MM = 1e-3
"""Deviation that poses are given in any case: none is known better."""
_HELD_MM = 10.0
"""Deviation of a motion that was held as the start has it: far more than any other's, and any start's error."""
_MOST_ROUNDS = 5
_SETTLED_MM = 0.001
"""By which an axis that was found again may differ at the object: below what its poses are known by."""
_LEAST_TURN_RAD = np.deg2rad(1.0)


def turntable(axis_point_mm: FloatArray, axis_direction: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """(N, 4, 4): the poses of views of an object that a stage turned, as the cameras that stand still see it.

    axis_point_mm, axis_direction : (3,), in the frame of the views. angles_rad : (N,), how far the stage stood turned
    about that direction, right-handed. A pose takes a view back to the first one's angle.
    """
    direction = np.asarray(axis_direction, dtype=np.float64) / np.linalg.norm(axis_direction)
    back = angles_rad[0] - np.asarray(angles_rad, dtype=np.float64)
    turns = Rotation.from_rotvec(back[:, None] * direction).as_matrix()
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = axis_point_mm - turns @ axis_point_mm
    return poses


@dataclass(frozen=True, slots=True)
class FoundAxis:
    """The axis that poses turn about, and how well it is known.

    point_mm : (3,), the point of it nearest to the object's middle; direction : (3,), unit; angles_rad : (N,), of the
    stage, as the poses have them, within half a turn of 0. point_sigma_mm, direction_sigma_rad : standard deviations
    across the axis, rms of both directions. rms_mm : how far from a pure turn the poses are, at the object's radius;
    rms_over_sigma : that by their covariance, about 1 where they are within it. covariance : as that of `MeasuredAxis`.
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
    def measured(self) -> MeasuredAxis:
        """The axis alone."""
        return MeasuredAxis(self.point_mm, self.direction, self.covariance)


def found_axis(registration: Registration, towards: FloatArray) -> FoundAxis | None:
    """The axis and angles of a turntable that fit a registration's poses best; see `axis_of`. What the registration
    held as its start has it tells nothing of them.
    """
    radius = registration.radius_mm
    scale = np.tile(np.repeat([1 / radius, 1.0], 3), len(registration.poses) - 1)
    held = registration.held * scale[:, None]
    covariance = registration.covariance + _HELD_MM**2 * held @ held.T
    return axis_of(registration.poses, covariance, registration.middle_mm, radius, towards)


def registered_on_stage(
    views: Sequence[Mesh],
    axis_point_mm: FloatArray,
    axis_direction: FloatArray,
    angles_rad: FloatArray,
    *,
    names: Sequence[str] | None = None,
    start_error_mm: float = START_ERROR_MM,
    begun: Callable[[int], None] = lambda _: None,
) -> tuple[Registration, FoundAxis | None]:
    """Register views of an object that a stage turned, and find the stage's axis, near which the one given is.

    Motions that no shape tells of are held as the stage has them: a box leaves open how far its sides are apart. So the
    axis has to be right first, and is found from all else, and the views are registered again from there. Parameters
    as of `turntable` and `registered`. Raises as `registered`.
    """
    point, direction = axis_point_mm, axis_direction / np.linalg.norm(axis_direction)
    for rounds in range(_MOST_ROUNDS):
        begun(rounds)
        starts = turntable(point, direction, angles_rad)
        found = registered(views, starts, names=names, start_error_mm=start_error_mm)
        axis = found_axis(found, direction)
        if axis is None or not found.free or rounds == _MOST_ROUNDS - 1:
            break
        across = np.cross(axis.point_mm - point, direction)
        moved_mm = np.linalg.norm(across) + found.radius_mm * np.linalg.norm(axis.direction - direction)
        if moved_mm < _SETTLED_MM:
            break
        point, direction = axis.point_mm, axis.direction
    return found, axis


def axis_of(
    poses: FloatArray, covariance: FloatArray, middle_mm: FloatArray, radius_mm: float, towards: FloatArray
) -> FoundAxis | None:
    """The axis and angles of a turntable that fit poses best, by their covariance; None where nothing was turned.

    poses : (N, 4, 4), covariance : (6 (N - 1), 6 (N - 1)), middle_mm and radius_mm : of an object, as those of a
    `Registration`. towards : (3,), a direction that the axis is to have an acute angle with, as that of the start.
    """
    middle, radius = middle_mm, radius_mm
    vectors = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    if np.linalg.norm(vectors, axis=1).max() < _LEAST_TURN_RAD:
        return None
    direction = np.linalg.svd(vectors)[2][0]
    direction *= 1.0 if direction @ towards > 0 else -1.0
    # Points of the axis stay where they are: T x = x.
    still = (np.eye(3) - poses[:, :3, :3]).reshape(-1, 3)
    point = middle + np.linalg.lstsq(still, poses[:, :3, 3].ravel() - still @ middle, rcond=1e-6)[0]
    across = np.linalg.svd(direction[None])[2][1:]
    scale = np.tile(np.repeat([radius, 1.0], 3), len(poses) - 1)
    scaled = covariance * scale[:, None] * scale
    whiten = np.linalg.inv(np.linalg.cholesky(scaled + _EXACT_MM**2 * np.eye(len(scale))))

    def axis(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        tilted = direction + parameters[2:4] @ across / radius
        return point + parameters[:2] @ across, tilted / np.linalg.norm(tilted)

    def apart(parameters: FloatArray) -> FloatArray:
        change = poses @ np.linalg.inv(turntable(*axis(parameters), np.append(0.0, parameters[4:])))
        turns = radius * Rotation.from_matrix(change[:, :3, :3]).as_rotvec()
        return np.hstack([turns, change[:, :3, :3] @ middle + change[:, :3, 3] - middle])[1:].ravel()

    def whitened(parameters: FloatArray) -> FloatArray:
        return np.asarray(whiten @ apart(parameters))

    begin = np.concatenate([np.zeros(4), -(vectors @ direction)[1:]])
    fit = least_squares(whitened, begin)
    over = float(np.sqrt(2 * fit.cost / (len(fit.fun) - len(fit.x))))
    slopes = np.asarray(fit.jac)
    # Where poses are no pure turns within their deviations, the axis is known the less.
    known = max(1.0, over) ** 2 * np.linalg.pinv(slopes.T @ slopes)[:4, :4]
    left = np.square(apart(fit.x)).reshape(-1, 6).sum(axis=1)
    place, way = axis(fit.x)
    turned = np.append(0.0, fit.x[4:])
    along = way @ (middle - place)
    tilts = across.T / radius
    by_fit = np.block([[across.T, along * tilts], [np.zeros((3, 2)), tilts]])
    axis_found = MeasuredAxis(place + way * along, way, by_fit @ known @ by_fit.T)
    return FoundAxis(
        point_mm=axis_found.point_mm,
        direction=way,
        angles_rad=(turned + np.pi) % (2 * np.pi) - np.pi,
        point_sigma_mm=axis_found.point_sigma_mm,
        direction_sigma_rad=axis_found.direction_sigma_rad,
        rms_mm=float(np.sqrt(left.mean())),
        rms_over_sigma=over,
        covariance=axis_found.covariance,
    )


FEWEST_POSES = 3
LEAST_TURN_DEG = 20.0
"""In all: the arc over a turn of 20° bends by 1.5 % of its radius, which is what tells the radius."""
_LEAST_SLIP_MM, _SLIP_SIGMAS = 0.05, 2.0
"""Below either, the rms of what is left is bearings and wood, or noise: of three poses one in 2000 has more."""
_MOST_LEFT_MM = 0.5
"""Of any stage that turns about one axis: bearings of plastic have 0.1 to 0.3 mm."""
_SLIP_SHARE = 0.5
"""Of what is left over, that remains without the pose that slipped."""
_UPWARDS = np.array([0.0, -1.0, -1.0])
"""The side an axis points to where no angle tells: up in the first camera's image, and to the camera."""


class BoardAxis(NamedTuple):
    """The axis that a board was turned about.

    residual_mm : by pose, rms distance of the board's corners from where a pure turn puts them. angles_deg : by pose,
    from the first one on; errors_deg : those less what the table told, and their mean; empty where it told none.
    """

    found: FoundAxis
    residual_mm: dict[str, float]
    angles_deg: dict[str, float]
    errors_deg: dict[str, float]


def board_axis(
    names: Sequence[str],
    poses: FloatArray,
    covariance: FloatArray,
    points_mm: FloatArray,
    angles_deg: Sequence[float] | FloatArray | None = None,
) -> BoardAxis:
    """The axis from poses of a board that stood still on the stage.

    poses : (m, 4, 4), board to world. covariance : (6 m, 6 m), as `slrig.calibration.health.drift` has both.
    points_mm : (n, 3), the board's corners. angles_deg : (m,), where the stage says that it stood; its sense tells the
    axis' direction. Without, it points up in the first camera's image.

    Raises
    ------
    StageRefusedError
        There are fewer than three poses; the board was turned by less than 20° in all; it slipped, or is not turned
        about one axis.
    """
    if len(names) < FEWEST_POSES:
        raise StageRefusedError(
            f"expected {FEWEST_POSES} poses or more of a board that stands on the stage, found {len(names)}: turn the "
            "stage and shoot it again, best at six angles all around"
        )
    shot = _Shot(names, poses, covariance, points_mm)
    found = shot.fit(range(len(names)))
    turn_deg = 0.0 if found is None else _span_deg(found.angles_rad)
    if found is None or turn_deg < LEAST_TURN_DEG:
        raise StageRefusedError(
            f"expected a board that the stage turned by {LEAST_TURN_DEG:g}° or more in all, found {turn_deg:.1f}° over "
            f"{len(names)} poses: turn the stage further between them"
        )
    left = shot.left_mm(found)
    if found.rms_mm > _LEAST_SLIP_MM and found.rms_over_sigma > _SLIP_SIGMAS:
        shot.require_one_body(found, left)
    told = np.rad2deg(found.angles_rad) if angles_deg is None else np.asarray(angles_deg, dtype=np.float64)
    errors = _wrapped_deg(np.rad2deg(found.angles_rad) - told)
    other = _wrapped_deg(-np.rad2deg(found.angles_rad) - told)
    if np.std(other) < np.std(errors):
        found, errors = shot.fit(range(len(names)), -found.direction) or found, other
    return BoardAxis(
        found=found,
        residual_mm=dict(zip(names, left.tolist(), strict=True)),
        angles_deg=dict(zip(names, np.rad2deg(found.angles_rad).tolist(), strict=True)),
        errors_deg={} if angles_deg is None else dict(zip(names, (errors - errors.mean()).tolist(), strict=True)),
    )


class _Shot(NamedTuple):
    """See `board_axis`."""

    names: Sequence[str]
    poses: FloatArray
    covariance: FloatArray
    points_mm: FloatArray

    @property
    def _body(self) -> tuple[FloatArray, float]:
        """The middle of all placed corners, and their rms distance from it."""
        placed = self.points_mm @ self.poses[:, :3, :3].transpose(0, 2, 1) + self.poses[:, None, :3, 3]
        middle = placed.reshape(-1, 3).mean(axis=0)
        return middle, float(np.sqrt(np.square(placed - middle).sum(axis=2).mean()))

    def _between(self, which: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """T_i = B_0 B_i⁻¹ (k, 4, 4) of some poses, and their covariance (6 (k - 1), 6 (k - 1)) about the middle.

        With small motions ε of both poses it is ε_0 - T_i ε_i T_i⁻¹.
        """
        middle, poses = self._body[0], self.poses[list(which)]
        turns = poses[:1] @ np.linalg.inv(poses)
        by_pose = np.zeros((6 * len(poses), 6 * len(poses)))
        for i, (turn, pose) in enumerate(zip(turns, poses, strict=True)):
            mine = slice(6 * i, 6 * i + 6)
            by_pose[mine, :6] += _carried(np.eye(4), poses[0, :3, 3], middle)
            by_pose[mine, mine] -= _carried(turn, pose[:3, 3], middle)
        where = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in which])
        covariance = by_pose @ self.covariance[np.ix_(where, where)] @ by_pose.T
        return turns, covariance[6:, 6:]

    def fit(self, which: Sequence[int], towards: FloatArray = _UPWARDS) -> FoundAxis | None:
        """The axis of some of the poses."""
        return axis_of(*self._between(which), *self._body, towards)

    def left_mm(self, found: FoundAxis) -> FloatArray:
        """(m,): rms distance of corners, turned back by the stage's angles, from their mean over the poses."""
        back = turntable(found.point_mm, found.direction, found.angles_rad) @ self.poses
        placed = self.points_mm @ back[:, :3, :3].transpose(0, 2, 1) + back[:, None, :3, 3]
        return np.asarray(np.sqrt(np.square(placed - placed.mean(axis=0)).sum(axis=2).mean(axis=1)))

    def require_one_body(self, found: FoundAxis, left: FloatArray) -> None:
        """Raises StageRefusedError: some pose, or all from one on, stand elsewhere on the stage than the others."""
        best = min(self._without(), default=(np.inf, ""))
        if best[0] < min(_SLIP_SHARE * found.rms_mm, _MOST_LEFT_MM):
            raise StageRefusedError(
                f"{best[1]}: the poses are off turns about one axis by {found.rms_mm:.3f} mm rms, without that by "
                f"{best[0]:.3f} mm. Fix the board to the stage, and shoot all poses again, or leave that out"
            )
        if found.rms_mm > _MOST_LEFT_MM:
            worst = int(np.argmax(left))
            raise StageRefusedError(
                f"expected a board that turns about one axis, found poses that are off by {found.rms_mm:.2f} mm rms, "
                f"'{self.names[worst]}' by {left[worst]:.2f} mm, the most: the board slipped more than once, or was "
                "held by hand. Fix it to the stage, and shoot all poses again"
            )

    def _without(self) -> Iterator[tuple[float, str]]:
        """What is left over where the board slipped for one pose, or at some instant, rms mm, and where."""
        count = len(self.names)
        everyone = range(count)
        for i in everyone:
            yield self._rms_mm([each for each in everyone if each != i]), f"the board slipped in '{self.names[i]}'"
        for k in range(2, count - 1):
            parts = [self._rms_mm(part) for part in (everyone[:k], everyone[k:]) if len(part) >= FEWEST_POSES]
            yield max(parts, default=np.inf), f"the board slipped between '{self.names[k - 1]}' and '{self.names[k]}'"

    def _rms_mm(self, which: Sequence[int]) -> float:
        """Infinite where so few poses, or such that hardly turned, tell nothing."""
        found = self.fit(which) if len(which) >= FEWEST_POSES else None
        return np.inf if found is None or _span_deg(found.angles_rad) < LEAST_TURN_DEG else found.rms_mm


def _carried(turn: FloatArray, origin_mm: FloatArray, middle_mm: FloatArray) -> FloatArray:
    """(6, 6): from a small turn and a shift of a body's origin to those of the middle, the body carried on by `turn`.

    The carried body's point at the middle is the one that was at T⁻¹ m.
    """
    rotation = turn[:3, :3]
    arm = rotation.T @ (middle_mm - turn[:3, 3]) - origin_mm
    carried = np.zeros((6, 6))
    carried[:3, :3] = carried[3:, 3:] = rotation
    carried[3:, :3] = rotation @ np.cross(np.eye(3), arm).T
    return carried


def _wrapped_deg(angles: FloatArray) -> FloatArray:
    """Angles within half a turn of the first one."""
    return np.asarray((angles - angles[0] + 180) % 360 - 180 + angles[0])


def _span_deg(angles_rad: FloatArray) -> float:
    """The part of a turn that holds all angles."""
    turned = np.sort(np.rad2deg(angles_rad) % 360)
    return float(360 - np.diff(turned, append=turned[0] + 360).max())

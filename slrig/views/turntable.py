"""Poses of an object that a stage turns about one axis, and that axis from poses that were found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray, MeasuredAxis, Mesh
from slrig.views.registration import START_ERROR_MM, Registration, registered

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

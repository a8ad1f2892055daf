"""Pose of a device that moved since its calibration, from the redundant equations of several cameras.

Each point of two cameras on one light sheet gives one equation, the distance r across the stripe in the second image
(`redundancy`). They determine the pose of one of the three devices in so far as it matters: a motion along the stripes
changes neither the equations nor the surface. The pose minimises the sum of ρ((r / σ)²) + (turn / 1°)² +
(shift / 1 % of the baseline)², with ρ(z) = 2 √(1 + z) − 2 at the scale of the scatter, so that points of different
surfaces count little. Curves are matched again after each step, as in iterative closest points (Chen and Medioni 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slrig.model import DEVICE_PARAMETERS, Axis, FloatArray, Pinhole
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.redundancy import (
    DEVIATIONS_PER_MEDIAN,
    MIN_POINTS,
    PairEquations,
    pair_equations,
    stripe_residuals,
)
from slrig.reconstruction.triangulation import triangulate_camera_projector

MAX_TURN_DEG = 3.0
"""Of a device that was bumped; one that moved more has to be calibrated again."""

MAX_SHIFT = 0.05
"""Of a device that was bumped, as a part of its baseline."""

_TURN_RAD = np.deg2rad(1.0)  # standard deviation of a bump before anything is measured
_SHIFT = 0.01  # the same for its shift, as a part of the baseline
_POINTS = 15_000  # of each camera, on whole curves
_EQUATIONS = 5000  # of a pair: neighbours along a stripe share most of their light, and add little
_ROUNDS = 30
_MOST_STEP = 0.5  # of each parameter in one round: farther, wrong neighbours mislead the search
_STEP = 1e-3  # of the parameters, for derivatives: a hundredth of a pixel
_LEAST_GAIN = 0.99  # of the scatter in one round: what still changes then moves along the stripes


@dataclass(frozen=True, slots=True)
class RefinedPose:
    """Pose of one device that makes cameras agree.

    device : index among the cameras; their number for the projector. turn_deg : angle between both poses; shift_mm :
    distance between both centres. covariance : (15, 15) float64, of the parameters of `SolveRecord`, zero except for
    the pose. equations : number of equations; scatter_sigma : robust standard deviation of r / σ that is left.
    """

    device: int
    pose: Pinhole
    turn_deg: float
    shift_mm: float
    baseline_mm: float
    covariance: FloatArray
    equations: int
    scatter_sigma: float

    @property
    def move(self) -> float:
        """Turn and shift in the standard deviations of a bump."""
        return float(np.hypot(np.deg2rad(self.turn_deg) / _TURN_RAD, self.shift_mm / (_SHIFT * self.baseline_mm)))

    @property
    def is_small(self) -> bool:
        """True if the device can have been bumped so far."""
        return _is_small(np.deg2rad([self.turn_deg]), np.array([self.shift_mm]), self.baseline_mm)


def refine_pose(
    ensembles: Sequence[StripeEnsemble],
    cameras: Sequence[Pinhole],
    projector: Pinhole,
    axis: Axis,
    moved: int,
    pairs: Sequence[tuple[int, int]],
    /,
    *,
    widest_gap_px: float,
) -> RefinedPose | None:
    """Find the pose of one device from the equations of pairs of cameras; None if they share too few points.

    ensembles : stripes of each camera; moved : index of the device, len(cameras) for the projector; pairs : indices of
    two cameras each, of which one is `moved` unless that is the projector; widest_gap_px : as for `merge_curves`.
    """
    # Half a second to load, and few scans need it.
    from scipy.optimize import least_squares

    devices = [*cameras, projector]
    others = [projector] if moved < len(cameras) else [cameras[k] for pair in pairs for k in pair]
    baseline_mm = min(float(np.linalg.norm(devices[moved].centre_mm - each.centre_mm)) for each in others)
    scale = np.repeat([_TURN_RAD, _SHIFT * baseline_mm], 3)
    ensembles = _thin(ensembles)
    parameters, left = np.zeros(6), np.inf

    def poses(values: FloatArray) -> list[Pinhole]:
        return [_move_device(each, values * scale) if k == moved else each for k, each in enumerate(devices)]

    for _ in range(_ROUNDS):
        equations = _match(ensembles, poses(parameters), axis, pairs, widest_gap_px)
        if sum(len(each.feet_px) for each in equations) < MIN_POINTS:
            return None
        system = _PoseEquations(equations, pairs, poses, axis, parameters)
        scatter = DEVIATIONS_PER_MEDIAN * float(np.median(np.abs(system.start - np.median(system.start))))
        found = least_squares(
            system.residuals, parameters, system.derivatives, loss="soft_l1", f_scale=max(1.0, scatter), max_nfev=10,
            bounds=(parameters - _MOST_STEP, parameters + _MOST_STEP),
        )  # fmt: skip
        before, parameters = left, found.x
        left = DEVIATIONS_PER_MEDIAN * float(np.median(np.abs(system.residuals(parameters)[:-6])))
        turn, shift_mm = np.split(parameters * scale, 2)
        if left > _LEAST_GAIN * before or not _is_small(turn, shift_mm, baseline_mm, factor=2.0):
            break
    slopes = system.derivatives(parameters)
    slopes[:-6] /= max(1.0, left)
    pose = poses(parameters)[moved]
    covariance: FloatArray = np.asarray(np.linalg.inv(slopes.T @ slopes) * np.outer(scale, scale), dtype=np.float64)
    return RefinedPose(
        device=moved,
        pose=pose,
        turn_deg=float(np.rad2deg(np.linalg.norm(turn))),
        shift_mm=float(np.linalg.norm(shift_mm)),
        baseline_mm=baseline_mm,
        covariance=_parameter_covariance(pose, covariance),
        equations=len(system.start),
        scatter_sigma=left,
    )


class _PoseEquations:
    """The equations of matched curves over their standard deviations, (m,), and the six parameters themselves, as
    functions of the parameters.
    """

    def __init__(
        self,
        equations: Sequence[PairEquations],
        pairs: Sequence[tuple[int, int]],
        poses: Callable[[FloatArray], list[Pinhole]],
        axis: Axis,
        parameters: FloatArray,
    ) -> None:
        self._equations, self._pairs, self._poses, self._axis = equations, pairs, poses, axis
        self.start = np.zeros(sum(len(each.feet_px) for each in equations))
        self.start = self.residuals(parameters)[:-6]

    def residuals(self, parameters: FloatArray) -> FloatArray:
        *cameras, projector = self._poses(parameters)
        parts = [
            each.residual_px(self._axis, cameras[a], cameras[b], projector) / each.sigma_px
            for each, (a, b) in zip(self._equations, self._pairs, strict=True)
        ]
        values = np.concatenate(parts)
        # A point that leaves the projector's image gains nothing by it.
        return np.concatenate([np.where(np.isfinite(values), values, self.start), parameters])

    def derivatives(self, parameters: FloatArray) -> FloatArray:
        start = self.residuals(parameters)
        return np.stack([(self.residuals(parameters + step) - start) / _STEP for step in _STEP * np.eye(6)], axis=1)


def _is_small(turn: FloatArray, shift_mm: FloatArray, baseline_mm: float, *, factor: float = 1.0) -> bool:
    """True if a turn, rad, and a shift are within the limits of a bump times a factor."""
    return bool(
        np.linalg.norm(turn) <= factor * np.deg2rad(MAX_TURN_DEG)
        and np.linalg.norm(shift_mm) <= factor * MAX_SHIFT * baseline_mm
    )


def _move_device(device: Pinhole, motion: FloatArray) -> Pinhole:
    """The device turned about its centre by a rotation vector, rad, and shifted, mm, (6,), in its own frame."""
    rotation = np.asarray(cv2.Rodrigues(motion[:3])[0]) @ device.rotation
    centre_mm = device.centre_mm + device.rotation.T @ motion[3:]
    return Pinhole(device.size, device.matrix, device.distortion, rotation, -rotation @ centre_mm)


def _parameter_covariance(pose: Pinhole, covariance: FloatArray) -> FloatArray:
    """(15, 15): covariance (6, 6) of a motion in the parameters of `SolveRecord`, R' X + t: dt = turn x t - shift."""
    x, y, z = pose.translation_mm
    motion = np.zeros((DEVICE_PARAMETERS, 6))
    motion[9:12, :3] = np.eye(3)
    motion[12:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    motion[12:, 3:] = -np.eye(3)
    return np.asarray(motion @ covariance @ motion.T)


def _match(
    ensembles: Sequence[StripeEnsemble],
    devices: Sequence[Pinhole],
    axis: Axis,
    pairs: Sequence[tuple[int, int]],
    widest_gap_px: float,
) -> list[PairEquations]:
    *cameras, projector = devices
    parts = {
        k: triangulate_camera_projector(ensembles[k], cameras[k], projector, axis)[0]
        for k in {index for pair in pairs for index in pair}
    }
    equations = []
    for a, b in pairs:
        residuals = stripe_residuals(parts[a], parts[b], cameras[b], axis, widest_gap_px=widest_gap_px)
        equations.append(pair_equations(parts[a], residuals, cameras[b], at_most=_EQUATIONS))
    return equations


def _thin(ensembles: Sequence[StripeEnsemble]) -> list[StripeEnsemble]:
    """The same evenly chosen light sheets of all cameras, of about 15 000 points each."""
    positions = np.unique(np.concatenate([each.position_px for each in ensembles]))
    step = max(1, max(len(each.points_px) for each in ensembles) // _POINTS)
    return [_select_curves(each, positions[::step]) for each in ensembles]


def _select_curves(ensemble: StripeEnsemble, positions_px: FloatArray) -> StripeEnsemble:
    chosen = np.isin(ensemble.position_px, positions_px)
    counts = np.diff(ensemble.offsets)
    points = np.repeat(chosen, counts)
    return StripeEnsemble(
        offsets=np.concatenate([[0], np.cumsum(counts[chosen])]).astype(np.int32),
        position_px=ensemble.position_px[chosen],
        points_px=ensemble.points_px[points],
        normals=ensemble.normals[points],
        sigma_px=ensemble.sigma_px[points],
        stripe=ensemble.stripe[points],
        bridge_after=ensemble.bridge_after[points],
    )

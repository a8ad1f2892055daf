"""Hand-eye calibration: the pose of a rig in a robot's frames, by poses of a board or positions of a sphere.

X is the rig in the flange (in hand) or in the base (fixed), Z the target in the base or in the flange, T the flange in
the base, B the target in the rig. Every pose should give

    B = X⁻¹ G Z,    G = T⁻¹ (in hand) or T (fixed).

Both X and Z are solved for by generalised least squares. A residual's covariance is that of B and, through the
derivatives by T, that of the robot, so that T itself needs no unknowns; to first order that is the maximum likelihood
of a bundle adjustment. The robot's noise, if it is not stated, maximises the restricted likelihood of the residuals
(Patterson and Thompson 1971). The start of boards is Shah's closed form (2013); spheres start from 24 rotations.

Errors of a pose are a small turn w (rad, R' = exp([w]x) R) and a shift of its translation (mm), in this order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import product
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f, t

from slrig.errors import CalibrationError, SolveRefusedError
from slrig.model import FloatArray

EulerOrder = Literal["xyz", "zyx", "zyz", "zxz", "XYZ", "ZYX", "ZYZ", "ZXZ"]
"""Order of three angles, as in scipy: about fixed axes (small letters), or about axes that turn along."""

MIN_POSES = 4
USUAL_NOISE = (0.1, 0.02)
"""Noise of an industrial robot's pose, mm and degrees, with which motions are judged."""

_STEPS, _SETTLED = 60, 1e-9
_DETERMINED = 1e-9  # of the largest eigenvalue of the scaled information, along which steps are made
_REGULAR = 1e-10
_MAX_STEP_RAD = 0.5
_MAX_REACH_MM = 1e5  # of a robot on rails, far less of others
_MIN_TURN_DEG = 1.0
"""Least turn about a second axis, rms: less does not determine the rig's position along the first one."""
_MAX_SIGMA_MM, _MAX_SIGMA_DEG = 5.0, 1.0
"""With the usual noise; beyond, the motion leaves something undetermined."""
_POOR_MM, _POOR_DEG = 1.0, 0.2
"""Noise of a robot beyond which a cause in the input is searched."""
_REFUSED_MM, _REFUSED_DEG = 5.0, 1.0
_MUCH_BETTER = 5.0  # times less rms that another reading of the poses must have
_KEPT = 0.75
_ROUNDS = 4
_RARE = 1e-3
_NEXT_TURN_DEG = 30.0
_SCALE_SIGMAS = 4.0


class HandEyeKind(StrEnum):
    """in-hand : the rig is on the flange, the target does not move. fixed : the robot holds the target."""

    IN_HAND = "in-hand"
    FIXED = "fixed"

    @property
    def other(self) -> HandEyeKind:
        """The other kind."""
        return HandEyeKind.FIXED if self is HandEyeKind.IN_HAND else HandEyeKind.IN_HAND

    @property
    def frame(self) -> str:
        """Frame of the rig's pose."""
        return "flange" if self is HandEyeKind.IN_HAND else "base"

    def motion(self, flange: FloatArray) -> FloatArray:
        """G of the equation above, (…, 4, 4), of poses of the flange."""
        return np.asarray(np.linalg.inv(flange) if self is HandEyeKind.IN_HAND else flange)


@dataclass(frozen=True, slots=True)
class RobotPoses:
    """Poses of a robot's flange in its base, as its controller reports them.

    names : of the n poses; poses : (n, 4, 4) float64, mm. euler : order of the angles that they were read from;
    None if they were read from something else.

    Raises CalibrationError if one is not a rigid motion.
    """

    names: tuple[str, ...]
    poses: FloatArray
    euler: EulerOrder | None = None

    def __post_init__(self) -> None:
        for name, pose in zip(self.names, self.poses, strict=True):
            turn = pose[:3, :3]
            off = np.abs(turn @ turn.T - np.eye(3)).max() if np.isfinite(pose).all() else np.inf
            if not off < 1e-3 or np.linalg.det(turn) < 0 or not np.allclose(pose[3], (0, 0, 0, 1)):
                message = (
                    f"robot pose '{name}': expected a rotation and a translation, rows of a matrix [R t; 0 0 0 1], "
                    f"found {np.round(pose, 4).tolist()}: check the order of its numbers"
                )
                raise CalibrationError(message)
            if np.abs(pose[:3, 3]).max() > _MAX_REACH_MM:
                message = (
                    f"robot pose '{name}': expected a place within {_MAX_REACH_MM / 1000:g} m, found "
                    f"{np.round(pose[:3, 3]).tolist()} mm: are its numbers in mm?"
                )
                raise CalibrationError(message)

    def select(self, chosen: NDArray[np.intp]) -> RobotPoses:
        """Those with the chosen numbers."""
        return replace(self, names=tuple(self.names[each] for each in chosen), poses=self.poses[chosen])


@dataclass(frozen=True, slots=True)
class TargetPoses:
    """Poses of the target in the rig. poses : (n, 4, 4) float64, target to rig, mm; of a sphere only the centre.

    covariance : (6 n, 6 n) float64 of a board, (3 n, 3 n) of a sphere's centres.
    """

    names: tuple[str, ...]
    poses: FloatArray
    covariance: FloatArray

    @property
    def terms(self) -> int:
        """Numbers observed in each pose: 6, or 3 of a sphere."""
        return len(self.covariance) // max(len(self.names), 1)

    def select(self, chosen: NDArray[np.intp]) -> TargetPoses:
        """Those with the chosen numbers."""
        rows = (self.terms * chosen[:, None] + np.arange(self.terms)).ravel()
        return TargetPoses(
            tuple(self.names[each] for each in chosen), self.poses[chosen], self.covariance[np.ix_(rows, rows)]
        )


class NextMove(NamedTuple):
    """The most informative next pose of the flange. sigma_mm : worst standard deviation of the rig's position then."""

    flange: FloatArray
    sigma_mm: float
    text: str


@dataclass(frozen=True, slots=True)
class HandEye:
    """A solved hand-eye calibration.

    rig : (4, 4) float64, rig to flange (in hand) or to base (fixed). target : (4, 4) float64, target to base (in hand)
    or to flange (fixed); of a sphere its rotation is meaningless. covariance : (12, 12) float64 of both, (9, 9) with a
    sphere. robot_sigma : of each coordinate, mm, and of each turn, degrees; estimated : whether from the residuals.
    names, residual_mm, residual_deg : of the poses that count: distance and turn of the target from where it should
    be, NaN degrees of a sphere. left_out : poses that contradict the others, with reasons.
    """

    kind: HandEyeKind
    rig: FloatArray
    target: FloatArray
    covariance: FloatArray
    robot_sigma: tuple[float, float]
    estimated: bool
    names: tuple[str, ...]
    residual_mm: FloatArray
    residual_deg: FloatArray
    left_out: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    next_move: NextMove | None = None

    @property
    def rig_covariance(self) -> FloatArray:
        """(6, 6) of `rig`."""
        return self.covariance[:6, :6]

    @property
    def inverse(self) -> tuple[FloatArray, FloatArray]:
        """Flange or base in the rig, (4, 4), and its covariance, (6, 6)."""
        inverse = np.linalg.inv(self.rig)
        change = _inverse_change(self.rig)
        return np.asarray(inverse), change @ self.rig_covariance @ change.T


class Drift(NamedTuple):
    """New poses compared with a calibration: the rig's move since then if nothing else moved, its deviation, and the
    chance of residuals as large without any. residual_mm, residual_deg : by pose.
    """

    shift_mm: float
    turn_deg: float
    sigma_mm: float
    sigma_deg: float
    probability: float
    residual_mm: FloatArray
    residual_deg: FloatArray

    @property
    def holds(self) -> bool:
        """True if the residuals are within the stated deviations."""
        return self.probability > _RARE


class _Problem(NamedTuple):
    robot: RobotPoses
    views: TargetPoses
    kind: HandEyeKind

    def select(self, chosen: NDArray[np.intp]) -> _Problem:
        return _Problem(self.robot.select(chosen), self.views.select(chosen), self.kind)


class _Fit(NamedTuple):
    """squares : of all residuals, weighted; by_pose : of each, against the prediction of the others. scale : by how
    much the rig's distances are longer than the robot's moves, over themselves, and the deviation.
    """

    rig: FloatArray
    target: FloatArray
    covariance: FloatArray
    noise: tuple[float, float]
    residual: FloatArray
    squares: float
    by_pose: FloatArray
    terms: int
    scale: tuple[float, float]

    @property
    def freedom(self) -> int:
        return len(self.residual) - len(self.covariance)

    @property
    def sizes(self) -> tuple[FloatArray, FloatArray]:
        return _sizes(self.residual, self.terms)

    @property
    def rms(self) -> tuple[float, float]:
        mm, degrees = (float(np.sqrt(np.mean(each**2))) for each in self.sizes)
        return mm, degrees


def solve_hand_eye(
    robot: RobotPoses, views: TargetPoses, kind: HandEyeKind, /, *, robot_sigma: tuple[float, float] | None = None
) -> HandEye:
    """Solve for rig and target by poses of robot and target in the same order.

    robot_sigma : the robot's noise, mm and degrees; None estimates it.

    Raises SolveRefusedError if the motions leave something undetermined, or no reading of the poses fits;
    CalibrationError: the noise is not above 0.
    """
    if robot_sigma is not None and not all(each > 0 for each in robot_sigma):
        message = f"the robot's noise: expected mm and degrees above 0, found {robot_sigma[0]:g} and {robot_sigma[1]:g}"
        raise CalibrationError(message)
    if not len(robot.names) == len(views.names) >= MIN_POSES:
        message = (
            f"expected {MIN_POSES} poses or more, each of robot and target, found {len(robot.names)} and "
            f"{len(views.names)}; 12 that turn by 30° about two axes are good"
        )
        raise SolveRefusedError(message)
    problem = whole = _Problem(robot, views, kind)
    _require_turns(problem)
    left_out: dict[str, str] = {}
    fit = _fit(problem, robot_sigma)
    while len(problem.robot.names) > max(MIN_POSES, _KEPT * len(robot.names)):
        worst = _wrong_pose(fit, estimated=robot_sigma is None)
        if worst is None:
            break
        rest = problem.select(np.delete(np.arange(len(problem.robot.names)), worst))
        without = _fit(rest, robot_sigma)
        mm, degrees = _sizes(_linearise(without.rig, without.target, problem)[0], views.terms)
        turned = "" if np.isnan(degrees[worst]) else f" and {degrees[worst]:.2g}°"
        left_out[problem.robot.names[worst]] = (
            f"contradicts the other poses by {mm[worst]:.2g} mm{turned}: most likely the robot still moved when its "
            "pose was read, or the target slipped; take it again"
        )
        problem, fit = rest, without
    _require_fit(fit, whole)
    _require_turns(problem)
    _require_determined(_posterior(fit.rig, fit.target, problem, USUAL_NOISE), kind)
    covariance, remarks = _stated_covariance(fit, robot_sigma)
    if abs(fit.scale[0]) > _SCALE_SIGMAS * fit.scale[1]:
        longer, expected = 100 * fit.scale[0], 100 * fit.scale[1]
        remarks += (
            f"the rig measures {longer:+.3f} % longer than the robot moves, where {expected:.3f} % are expected: "
            "was the board's print measured when the rig was calibrated?",
        )
    found = HandEye(
        kind, fit.rig, fit.target, covariance, fit.noise, robot_sigma is None, problem.robot.names, *fit.sizes,
        left_out, remarks,
    )  # fmt: skip
    return replace(found, next_move=_next_move(found, problem))


def check_hand_eye(found: HandEye, robot: RobotPoses, views: TargetPoses, /) -> Drift:
    """Compare new poses of the same target, at its earlier place, with a hand-eye calibration.

    Raises CalibrationError if it is another kind of target.
    """
    if len(found.covariance) != 6 + views.terms:
        kinds = ("a sphere", "a board") if views.terms == 6 else ("a board", "a sphere")
        message = (
            f"the hand-eye calibration is by {kinds[0]}, and these poses are of {kinds[1]}: show it the same target"
        )
        raise CalibrationError(message)
    residual, slopes, by_robot = _linearise(found.rig, found.target, _Problem(robot, views, found.kind))
    own = _residual_covariance(views, by_robot, found.robot_sigma)
    total = own + slopes @ found.covariance @ slopes.T
    weighted = np.linalg.solve(own, slopes[:, :6])
    # A sphere in one or two poses leaves some moves open: the least of those that explain it is returned.
    gain = np.linalg.pinv(weighted.T @ slopes[:, :6], rtol=1e-9, hermitian=True) @ weighted.T
    move, sigma = gain @ residual, np.sqrt(np.diagonal(gain @ total @ gain.T))
    return Drift(
        float(np.linalg.norm(move[3:])), float(np.degrees(np.linalg.norm(move[:3]))),
        float(np.linalg.norm(sigma[3:])), float(np.degrees(np.linalg.norm(sigma[:3]))),
        _chance(found, float(residual @ np.linalg.solve(total, residual)), len(residual)),
        *_sizes(residual, views.terms),
    )  # fmt: skip


def _chance(found: HandEye, squares: float, count: int) -> float:
    """Chance of so large a sum of squares of `count` residuals, whose deviations may be estimates themselves."""
    terms = len(found.covariance) - 6
    freedom = terms * len(found.names) - len(found.covariance)
    return float(f.sf(squares / count, count, freedom) if found.estimated else chi2.sf(squares, count))


def _skew(vectors: FloatArray) -> FloatArray:
    """(…, 3, 3): matrices of the cross product by vectors (…, 3)."""
    return -np.cross(vectors[..., None, :], np.eye(3))


def _blocks(turned: FloatArray, shift_by_turn: FloatArray) -> FloatArray:
    """(…, 6, 6): [[turned, 0], [shift_by_turn, turned]]."""
    return np.block(
        [[turned, np.zeros_like(shift_by_turn)], [shift_by_turn, np.broadcast_to(turned, shift_by_turn.shape)]]
    )


def _inverse_change(pose: FloatArray) -> FloatArray:
    """(…, 6, 6): error of the inverse of poses (…, 4, 4) by theirs."""
    back = np.swapaxes(pose[..., :3, :3], -1, -2)
    return _blocks(-back, -back @ _skew(pose[..., :3, 3]))


def _linearise(rig: FloatArray, target: FloatArray, problem: _Problem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals, measured minus predicted, (n k,); derivatives of the prediction by rig and target, (n k, 6 + k);
    and by the robot's poses, (n, k, 6).
    """
    robot, views, kind = problem
    moved = kind.motion(robot.poses)
    predicted = np.linalg.inv(rig) @ moved @ target
    back, turned = np.broadcast_to(rig[:3, :3].T, (len(moved), 3, 3)), moved[:, :3, :3]
    lever = turned @ target[:3, 3]
    by_rig = _blocks(-back, back @ _skew(lever + moved[:, :3, 3] - rig[:3, 3]))
    by_target = _blocks(back @ turned, np.zeros_like(turned))
    by_robot = _blocks(back, -back @ _skew(lever))
    if kind is HandEyeKind.IN_HAND:
        by_robot = by_robot @ _inverse_change(robot.poses)
    turn = Rotation.from_matrix(views.poses[:, :3, :3] @ np.swapaxes(predicted[:, :3, :3], 1, 2)).as_rotvec()
    residual = np.hstack([turn, views.poses[:, :3, 3] - predicted[:, :3, 3]])
    # A sphere's centre has a position, but no orientation.
    first = 6 - views.terms
    slopes = np.concatenate([by_rig[:, first:], by_target[:, first:, first:]], axis=2)
    return residual[:, first:].ravel(), slopes.reshape(-1, 6 + views.terms), by_robot[:, first:]


def _robot_covariance(by_robot: FloatArray, noise: tuple[float, float]) -> FloatArray:
    """Covariance of the residuals from the robot's noise alone."""
    scaled = by_robot * np.repeat([np.radians(noise[1]), noise[0]], 3)
    return np.asarray(block_diag(*(scaled @ np.swapaxes(scaled, 1, 2))))


def _residual_covariance(views: TargetPoses, by_robot: FloatArray, noise: tuple[float, float]) -> FloatArray:
    return _regular(views.covariance + _robot_covariance(by_robot, noise))


def _regular(covariance: FloatArray) -> FloatArray:
    """Increase the diagonal a little, to allow inversion wherever poses that do not fit lead a solve."""
    return covariance + _REGULAR * np.diag(np.diagonal(covariance))


def _apply_step(pose: FloatArray, step: FloatArray) -> FloatArray:
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def _iterate(
    rig: FloatArray, target: FloatArray, problem: _Problem, noise: tuple[float, float], *, steps: int = _STEPS
) -> tuple[FloatArray, FloatArray, float]:
    """Rig, target and sum of squares, from a start; steps of Gauss and Newton."""
    squares = np.inf
    for _ in range(steps):
        residual, slopes, by_robot = _linearise(rig, target, problem)
        weighted = cho_factor(_residual_covariance(problem.views, by_robot, noise))
        pull = slopes.T @ cho_solve(weighted, np.column_stack([slopes, residual]))
        squares = float(residual @ cho_solve(weighted, residual))
        sigma = 1 / np.sqrt(np.diagonal(pull) + 1e-300)
        step = sigma * np.linalg.lstsq(pull[:, :-1] * np.outer(sigma, sigma), sigma * pull[:, -1], rcond=_DETERMINED)[0]
        sizes = np.abs(step[:3]).max() / _MAX_STEP_RAD, np.abs(step[3:]).max() / _MAX_REACH_MM
        step /= max(1.0, *sizes)
        rig = _apply_step(rig, step[:6])
        target = _apply_step(target, np.concatenate([np.zeros(6 - problem.views.terms), step[6:]]))
        if np.abs(step / sigma).max() < _SETTLED:
            break
    return rig, target, squares


def _posterior(rig: FloatArray, target: FloatArray, problem: _Problem, noise: tuple[float, float]) -> FloatArray:
    """Covariance of rig and target, very large along undetermined directions."""
    _, slopes, by_robot = _linearise(rig, target, problem)
    weights = np.linalg.inv(_residual_covariance(problem.views, by_robot, noise))
    information = slopes.T @ weights @ slopes
    scale = 1 / np.sqrt(np.diagonal(information) + 1e-300)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    modes = scale[:, None] * vectors / np.sqrt(np.maximum(values, 1e-12))
    return np.asarray(modes @ modes.T)


def _start(problem: _Problem) -> tuple[FloatArray, FloatArray]:
    """Rough rig and target."""
    robot, views, kind = problem
    moved = kind.motion(robot.poses)
    turns = moved[:, :3, :3]
    system = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), -turns], axis=2).reshape(-1, 6)

    def with_shifts(rig_turn: FloatArray, target_turn: FloatArray) -> tuple[FloatArray, FloatArray]:
        # R_X t_B + t_X = R_G t_Z + t_G is linear in t_X and t_Z.
        aim = moved[:, :3, 3] - views.poses[:, :3, 3] @ rig_turn.T
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[:, :3, :3] = rig_turn, target_turn
        poses[:, :3, 3] = np.linalg.lstsq(system, aim.ravel(), rcond=1e-9)[0].reshape(2, 3)
        return poses[0], poses[1]

    if views.terms == 6:
        # Shah 2013: the sum of G ⊗ B has the rotations of rig and target as its first singular vectors.
        kron = np.einsum("nij,nkl->ikjl", turns, views.poses[:, :3, :3]).reshape(9, 9)
        left, _, right = np.linalg.svd(kron)
        return with_shifts(_nearest_rotation(left[:, 0].reshape(3, 3)), _nearest_rotation(right[0].reshape(3, 3)))
    starts = Rotation.create_group("O").as_matrix()
    tried = [_iterate(*with_shifts(turn, np.eye(3)), problem, USUAL_NOISE, steps=8) for turn in starts]
    rig, target, _ = min(tried, key=lambda each: each[2])
    return rig, target


def _nearest_rotation(matrix: FloatArray) -> FloatArray:
    u, _, vt = np.linalg.svd(matrix * (np.sign(np.linalg.det(matrix)) or 1.0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _fit(problem: _Problem, stated: tuple[float, float] | None) -> _Fit:
    rig, target = _start(problem)
    noise = stated or USUAL_NOISE
    for _ in range(_ROUNDS):
        rig, target, _ = _iterate(rig, target, problem, noise)
        before, noise = noise, stated or _estimate_noise(rig, target, problem, noise)
        if np.allclose(before, noise, rtol=0.01):
            break
    residual, slopes, by_robot = _linearise(rig, target, problem)
    weights = np.linalg.inv(_residual_covariance(problem.views, by_robot, noise))
    covariance = _posterior(rig, target, problem, noise)
    # Each pose against the one that all others predict, by the inverse of the partitioned covariance.
    left = weights - weights @ slopes @ covariance @ slopes.T @ weights
    pulled, terms = left @ residual, problem.views.terms
    rows = np.arange(len(residual)).reshape(-1, terms)
    by_pose = [pulled[own] @ np.linalg.pinv(left[np.ix_(own, own)], hermitian=True) @ pulled[own] for own in rows]
    longer = np.zeros((len(rows), terms))
    longer[:, -3:] = problem.views.poses[:, :3, 3]
    weight = longer.ravel() @ left @ longer.ravel()
    scale = float(longer.ravel() @ pulled / weight), float(1 / np.sqrt(weight))
    return _Fit(rig, target, covariance, noise, residual, float(residual @ pulled), np.array(by_pose), terms, scale)


def _estimate_noise(
    rig: FloatArray, target: FloatArray, problem: _Problem, start: tuple[float, float]
) -> tuple[float, float]:
    """The robot's noise, mm and degrees; by a sphere, which shows no turns, in the ratio of the usual noise."""
    residual, slopes, by_robot = _linearise(rig, target, problem)
    place, turn = _robot_covariance(by_robot, (1.0, 0.0)), _robot_covariance(by_robot, (0.0, 1.0))
    measured = [0, 1] if problem.views.terms == 6 else [0, 0]

    def cost(logarithms: FloatArray) -> float:
        mm, degrees = (np.exp(logarithms[measured]) * USUAL_NOISE) ** 2
        factor = cho_factor(_regular(problem.views.covariance + mm * place + degrees * turn))
        weighted = cho_solve(factor, np.column_stack([slopes, residual]))
        information, pull = slopes.T @ weighted[:, :-1], slopes.T @ weighted[:, -1]
        left = residual @ weighted[:, -1] - pull @ np.linalg.lstsq(information, pull, rcond=1e-13)[0]
        return float(2 * np.log(np.diagonal(factor[0])).sum() + np.linalg.slogdet(information)[1] + left)

    found = minimize(cost, np.log(np.array(start) / USUAL_NOISE), method="L-BFGS-B", bounds=[(-6.0, 9.0)] * 2)
    mm, degrees = (np.exp(found.x[measured]) * USUAL_NOISE).tolist()
    return mm, degrees


def _sizes(residual: FloatArray, terms: int) -> tuple[FloatArray, FloatArray]:
    """Distances, mm, and turns, degrees, of residuals (n k,)."""
    rows = residual.reshape(-1, terms)
    turns = np.degrees(np.linalg.norm(rows[:, :3], axis=1)) if terms == 6 else np.full(len(rows), np.nan)
    return np.linalg.norm(rows[:, -3:], axis=1), turns


def _wrong_pose(fit: _Fit, *, estimated: bool) -> int | None:
    """The pose that contradicts the others most, if it does beyond chance."""
    worst = int(np.argmax(fit.by_pose))
    own, others = float(fit.by_pose[worst]), fit.freedom - fit.terms
    if others < fit.terms:
        return None
    # Against the scatter of the others, too, where the noise is stated: it may be stated too small.
    ratio = own / fit.terms / max((fit.squares - own) / others, 1e-12)
    chance = max(f.sf(ratio, fit.terms, others), 0.0 if estimated else chi2.sf(own, fit.terms))
    return worst if chance < _RARE / len(fit.by_pose) else None


def _require_turns(problem: _Problem) -> None:
    """Refuse motions without turns about two axes."""
    in_hand = problem.kind is HandEyeKind.IN_HAND
    _, sizes, axes = _turns(problem.robot.poses, own_axes=in_hand)
    frame, advice = problem.kind.frame, f"turn the flange by {_NEXT_TURN_DEG:g}° or more"
    board_deg = _turns(problem.views.poses, own_axes=False)[1][0] if problem.views.terms == 6 else 0.0
    if board_deg > 5 * max(sizes[0], _MIN_TURN_DEG):
        message = (
            f"the robot's poses turn by {sizes[0]:.2g}° (rms), and the board turns by {board_deg:.2g}°: are their "
            "angles in radians and read as degrees, or are they of other moments?"
        )
        raise SolveRefusedError(message)
    if sizes[0] < _MIN_TURN_DEG:
        message = (
            f"the robot moved without turning ({sizes[0]:.2g}° rms): the rig's place in the {frame} is undetermined "
            f"along all axes; {advice}, in some poses about one axis and in others about another, and shoot again"
        )
        raise SolveRefusedError(message)
    if sizes[1] < _MIN_TURN_DEG:
        across = np.cross(axes[0], np.eye(3)[int(np.argmin(np.abs(axes[0])))])
        message = (
            f"all turns of the robot are about one axis, {_direction(axes[0])} of the {frame} (others: {sizes[1]:.2g}° "
            f"rms): the rig's place along it is undetermined; {advice} about another axis as well, such as "
            f"{_direction(across)}, and shoot again"
        )
        raise SolveRefusedError(message)


def _turns(poses: FloatArray, *, own_axes: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Singular vectors and values, degrees (rms), of the turns of poses from their mean, about their own axes, or
    about those of the frame that they are in.
    """
    turns = Rotation.from_matrix(poses[:, :3, :3])
    middle = turns.mean()
    away = (middle.inv() * turns if own_axes else turns * middle.inv()).as_rotvec(degrees=True)
    left, sizes, axes = np.linalg.svd(away / np.sqrt(len(away)))
    return left, sizes, axes


def _direction(vector: FloatArray) -> str:
    unit = vector / np.linalg.norm(vector) * (np.sign(vector[int(np.argmax(np.abs(vector)))]) or 1.0)
    return "(" + ", ".join(f"{each + 0.0:.2f}" for each in np.round(unit, 2)) + ")"


def _require_determined(covariance: FloatArray, kind: HandEyeKind) -> None:
    """Refuse poses that leave a direction open at the usual noise, and name that direction."""
    for own, unit, limit, name, what, remedy in (
        (slice(0, 3), 180 / np.pi, _MAX_SIGMA_DEG, "°", "turn about", "at places of the view that lie farther apart"),
        (slice(3, 6), 1.0, _MAX_SIGMA_MM, " mm", "place along", "turned by 30° more about two axes"),
    ):
        values, vectors = np.linalg.eigh(covariance[own, own])
        sigma = unit * float(np.sqrt(values[-1]))
        if sigma > limit:
            message = (
                f"the rig's {what} {_direction(vectors[:, -1])} of the {kind.frame} is undetermined by these poses: "
                f"with a robot of the usual noise it is known to {sigma:.2g}{name}. Show the target {remedy}, and "
                "solve again"
            )
            raise SolveRefusedError(message)


def _readings(problem: _Problem) -> Iterator[tuple[str, _Problem]]:
    """Other readings of the same numbers, each with its description."""
    robot, views, kind = problem
    count, turns = len(robot.names), Rotation.from_matrix(robot.poses[:, :3, :3])

    def turned(text: str, other: Rotation) -> tuple[str, _Problem]:
        poses = robot.poses.copy()
        poses[:, :3, :3] = other.as_matrix()
        return text, _Problem(replace(robot, poses=poses), views, kind)

    yield (
        f"the rig is {kind.other} and not {kind}, or these are poses of the base in the flange, to be inverted",
        _Problem(robot, views, kind.other),
    )
    for unit, factor in (("m", 1000.0), ("cm", 10.0), ("inch", 25.4)):
        scaled = robot.poses * np.array([1.0, 1.0, 1.0, factor]) ** [[1], [1], [1], [0]]
        if np.abs(scaled[:, :3, 3]).max() < _MAX_REACH_MM:
            text = f"the robot's positions are in {unit}, and not in mm"
            yield text, _Problem(replace(robot, poses=scaled), views, kind)
    for order, roll in (("w, x, y, z", -1), ("x, y, z, w", 1)):
        quaternions = Rotation.from_quat(np.roll(turns.as_quat(), roll, axis=1))
        yield turned(f"the quaternions are in the order {order}, and not as stated", quaternions)
    yield turned("the rotations are of the base in the flange: transpose them", turns.inv())
    for order in get_args(EulerOrder) if robot.euler else ():
        angles = turns.as_euler(robot.euler or order)
        yield turned(f"the angles are in the order {order}, and not {robot.euler}", Rotation.from_euler(order, angles))
    for side, first, last in (("before", 1, 0), ("after", 0, 1)):
        listed, pictured = np.arange(last, count - first), np.arange(first, count - last)
        yield (
            f"pictures and poses are out of step: each picture belongs to the pose listed {side} it",
            _Problem(robot.select(listed), views.select(pictured), kind),
        )


def _require_fit(fit: _Fit, problem: _Problem) -> None:
    """Refuse poses that do not fit, with the reading of them that does. problem : with all poses."""
    mm, degrees = fit.rms
    if not (mm > _POOR_MM or degrees > _POOR_DEG):
        return
    refusal = f"the poses of robot and target do not fit, by {mm:.2g} mm" + (
        "" if np.isnan(degrees) else f" and {degrees:.2g}°"
    )
    for text, other in _readings(problem):
        better = _fit(other, USUAL_NOISE).rms if len(other.robot.names) >= MIN_POSES else fit.rms
        if better[0] < min(_POOR_MM, mm / _MUCH_BETTER):
            raise SolveRefusedError(f"{refusal} (rms). They do, to {better[0]:.2g} mm, if {text}")
    if mm > _REFUSED_MM or degrees > _REFUSED_DEG:
        message = (
            f"{refusal} (rms), in no other order or unit. Is each picture of the robot's pose next to it, is the "
            "target fixed, and is the board's square as measured?"
        )
        raise SolveRefusedError(message)


def _stated_covariance(fit: _Fit, stated: tuple[float, float] | None) -> tuple[FloatArray, tuple[str, ...]]:
    """The covariance to state, and remarks: wider where the noise was estimated, or is larger than stated."""
    if stated is None:
        # So that one standard deviation holds 68 %, as of a normal distribution.
        return fit.covariance * float(t.ppf(0.8413, fit.freedom)) ** 2, ()
    if chi2.sf(fit.squares, fit.freedom) > _RARE:
        return fit.covariance, ()
    ratio = fit.squares / fit.freedom
    remark = (
        f"residuals are {np.sqrt(ratio):.1f} times what a robot of {stated[0]:g} mm and {stated[1]:g}° leaves, and "
        "deviations are stated as much larger: was its noise stated too small, or is something loose?"
    )
    return fit.covariance * ratio, (remark,)


def _next_move(found: HandEye, problem: _Problem) -> NextMove:
    """Turn of the flange round the target, from the middle of the poses, that determines the rig's position best."""
    robot, views, kind = problem
    places = robot.poses[:, :3, 3]
    middle = int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    more = problem.select(np.append(np.arange(len(places)), middle))
    # In addition to the given poses, independent of them.
    more.views.covariance[: -views.terms, -views.terms :] = 0
    more.views.covariance[-views.terms :, : -views.terms] = 0
    pivot = ((robot.poses[middle] if kind is HandEyeKind.FIXED else np.eye(4)) @ found.target)[:3, 3]
    moves = []
    for axis, degrees in product("xyz", (_NEXT_TURN_DEG, -_NEXT_TURN_DEG)):
        turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        flange = more.robot.poses[-1]
        flange[:3, :3] = turn @ robot.poses[middle, :3, :3]
        flange[:3, 3] = pivot + turn @ (places[middle] - pivot)
        more.views.poses[-1] = np.linalg.inv(found.rig) @ kind.motion(flange) @ found.target
        covariance = _posterior(found.rig, found.target, more, found.robot_sigma)
        text = (
            f"from pose '{robot.names[middle]}' turn the flange by {degrees:+g}° about the base's {axis} axis, round "
            "the target, which then stays in view"
        )
        moves.append(NextMove(flange.copy(), float(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])), text))
    return min(moves, key=lambda each: each.sigma_mm)

"""Bundle adjustment by Levenberg-Marquardt: devices, poses and shape of the board.

The cost is Σ ρ(r/σ) with Cauchy's ρ(z) = c²/2 log(1 + z²/c²), c = 2.385 (95 % efficient for normal errors), minimised
by weights 1/(1 + z²/c²) that follow the residuals (Holland and Welsch 1977). Observations beyond six standard
deviations at the start of an adjustment have no weight in it. Normal equations are accumulated block by block, one
camera and pose at a time.

Each device has a noise model. The stated standard deviations are scaled down if the residuals are smaller; if they are
larger, a constant is added in quadrature. Neighbours err alike, so the weights are divided by a design effect: the
variance of sums over groups of neighbours over that of independent errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board
from slrig.calibration.solving.projection import (
    BEND,
    CORNER_TERMS,
    DEVICE,
    POSE,
    Geometry,
    Measurements,
    ParameterLayout,
    corner_residuals,
    find_groups,
    match_residuals,
    weighted_blocks,
)
from slrig.kernels import kernel
from slrig.model import FloatArray, IntArray

LENS_SIGMA = np.array([0.5, 0.5, 0.01, 0.01, 0.5])
"""Prior standard deviations of k1, k2, p1, p2 and k3 about 0, several times the values of usual lenses: they matter
only for terms that the poses do not determine."""
CAUCHY = 2.385
OUTLIER_SIGMAS = 6.0
_MAX_STEPS = 60
_MAX_OUTLIER_ROUNDS = 3
_MIN_GAIN = 3e-4
"""In squared deviations: a step that gains less changes each parameter by a small fraction of its own deviation."""
_INITIAL_DAMPING = 1e-6
_MAX_DAMPING = 1e8
_MIN_DAMPING = 1e-12
_MEDIAN = 0.6745  # of the absolute value of a standard normal
_MEDIAN_2 = 0.8326  # of the distance of two standard normals, over √2
_MIN_SCALE = 0.05
_MIN_EXCESS_PX = 1e-5
_LIGHT_CELLS = (6, 12, 24)
_CORNER_CELLS = 3
_MAP_CELLS = 6
_MIN_GROUPS = 3.0

Weights = tuple[FloatArray, FloatArray]
"""Of corners (n,) and of matches (k,)."""


@dataclass(frozen=True, slots=True)
class Residuals:
    """Projected minus measured: corners (n, 2), px, and matches (k,), projector px."""

    corners: FloatArray
    matches: FloatArray


@dataclass(frozen=True, slots=True)
class Deviations:
    """Standard deviations of observations: corners (n,) and matches (k,), px.

    corner_weight, match_weight : (n,) and (k,), weight of each observation, less than 1 where neighbours err alike. It
    does not enter the test for outliers.
    """

    corners: FloatArray
    matches: FloatArray
    corner_weight: FloatArray
    match_weight: FloatArray


@dataclass(frozen=True, slots=True)
class ShapePrior:
    """Prior standard deviations of the board's shape, mm.

    bend_sigma_mm : of each coefficient of the bend. offset_sigma_mm : of each coordinate of a corner's offset; None if
    the corners are at their nominal positions.
    """

    bend_sigma_mm: float
    offset_sigma_mm: float | None = None

    @property
    def has_offsets(self) -> bool:
        """True if corners may be off their nominal positions."""
        return self.offset_sigma_mm is not None


@dataclass(frozen=True, slots=True)
class Adjustment:
    """Result of an adjustment. converged : True if the cost no longer fell."""

    geometry: Geometry
    residuals: Residuals
    converged: bool


def compute_residuals(geometry: Geometry, measurements: Measurements) -> Residuals:
    """Residuals of corners and matches, without derivatives."""
    corners, _ = corner_residuals(geometry, measurements, jacobian=False)
    matches, _ = match_residuals(geometry, measurements, jacobian=False)
    return Residuals(corners, matches)


def normalised_residuals(residuals: Residuals, deviations: Deviations) -> tuple[FloatArray, FloatArray]:
    """Residuals over their deviations, corners (n,) and matches (k,); of a corner its distance over √2."""
    corner = np.hypot(residuals.corners[:, 0], residuals.corners[:, 1]) / deviations.corners / np.sqrt(2)
    return corner, np.abs(residuals.matches) / deviations.matches


def inlier_weights(residuals: Residuals, deviations: Deviations) -> Weights:
    """1 for inliers, 0 for outliers and for observations without a residual."""
    corner, matches = normalised_residuals(residuals, deviations)
    return (corner <= OUTLIER_SIGMAS).astype(np.float64), (matches <= OUTLIER_SIGMAS).astype(np.float64)


def robust_weights(residuals: Residuals, deviations: Deviations, inliers: Weights) -> Weights:
    """Robust weights over the variance, 0 for outliers. Both coordinates of a corner share one weight."""
    corner, matches = normalised_residuals(residuals, deviations)
    return (
        _cauchy_weights(corner, inliers[0]) / deviations.corners**2 * deviations.corner_weight,
        _cauchy_weights(matches, inliers[1]) / deviations.matches**2 * deviations.match_weight,
    )


def _cauchy_weights(z: FloatArray, inliers: FloatArray) -> FloatArray:
    return np.where(inliers > 0, 1 / (1 + (np.where(inliers > 0, z, 0.0) / CAUCHY) ** 2), 0.0)


def adjust(
    geometry: Geometry, measurements: Measurements, free: NDArray[np.bool_], deviations: Deviations, /, *,
    prior: ShapePrior | None = None, inliers: Weights | None = None, max_steps: int = _MAX_STEPS,
) -> Adjustment:  # fmt: skip
    """Minimise the cost from an initial geometry. free : (N,) bool over the whole parameter vector.

    inliers : observations that count (`inlier_weights`). By default they are found at the start, relative to the median
    residual there, and again after each minimisation until they no longer change.
    """
    if inliers is not None:
        return _minimise(geometry, measurements, free, deviations, inliers, prior, max_steps)
    residuals = compute_residuals(geometry, measurements)
    inliers = _initial_inlier_weights(residuals, deviations)
    result = _minimise(geometry, measurements, free, deviations, inliers, prior, max_steps)
    for _ in range(_MAX_OUTLIER_ROUNDS):
        new_inliers = inlier_weights(result.residuals, deviations)
        if all(np.array_equal(before, after) for before, after in zip(inliers, new_inliers, strict=True)):
            break
        inliers = new_inliers
        result = _minimise(result.geometry, measurements, free, deviations, inliers, prior, max_steps)
    return result


def _initial_inlier_weights(residuals: Residuals, deviations: Deviations) -> Weights:
    """As `inlier_weights`, but with a limit that grows with the median residual: initial values may be far off."""
    inliers = []
    for z in normalised_residuals(residuals, deviations):
        median = float(np.nanmedian(z)) if np.isfinite(z).any() else 0.0
        inliers.append((z <= OUTLIER_SIGMAS * max(1.0, median)).astype(np.float64))
    return inliers[0], inliers[1]


def _minimise(
    geometry: Geometry, measurements: Measurements, free: NDArray[np.bool_], deviations: Deviations, inliers: Weights,
    prior: ShapePrior | None, max_steps: int,
) -> Adjustment:  # fmt: skip
    residuals = compute_residuals(geometry, measurements)
    cost = _cost(geometry, residuals, deviations, inliers, prior)
    damping, converged = _INITIAL_DAMPING, False
    for _ in range(max_steps):
        matrix, gradient = normal_equations(
            geometry, measurements, robust_weights(residuals, deviations, inliers), prior=prior
        )
        matrix, gradient = matrix[np.ix_(free, free)], gradient[free]
        converged = True
        while damping < _MAX_DAMPING:
            step = np.zeros(len(free))
            step[free] = -_damped_step(matrix, gradient, damping)
            if not np.isfinite(step).all():
                damping *= 10
                continue
            trial_geometry = geometry.apply_step(step)
            new_residuals = compute_residuals(trial_geometry, measurements)
            new_cost = _cost(trial_geometry, new_residuals, deviations, inliers, prior)
            if new_cost < cost:
                converged = cost - new_cost < _MIN_GAIN
                geometry, residuals, cost = trial_geometry, new_residuals, new_cost
                damping = max(damping / 10, _MIN_DAMPING)
                break
            # At the minimum, rounding alone decides whether the cost falls.
            if new_cost - cost < _MIN_GAIN:
                break
            damping *= 10
        if converged:
            break
    return Adjustment(geometry, residuals, converged)


def _damped_step(matrix: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    """(H + damping diag H)⁻¹ g, computed with a unit diagonal; NaN if singular."""
    diagonal = np.sqrt(np.diagonal(matrix))
    diagonal = np.where(diagonal > 0, diagonal, 1.0)
    scaled = matrix / np.outer(diagonal, diagonal)
    scaled[np.diag_indices_from(scaled)] += damping
    return solve_positive_definite(scaled, gradient / diagonal) / diagonal


def normal_equations(
    geometry: Geometry, measurements: Measurements, weights: Weights, /, *, prior: ShapePrior | None = None
) -> tuple[FloatArray, FloatArray]:
    """Jᵀ W J, (N, N), and Jᵀ W r, (N,), over the whole parameter vector. weights : see `robust_weights`."""
    layout = geometry.layout
    matrix, gradient = np.zeros((layout.count, layout.count)), np.zeros(layout.count)
    corners, corner_jacobian = corner_residuals(geometry, measurements, jacobian=True)
    matches, match_jacobian = match_residuals(geometry, measurements, jacobian=True)
    _add_corner_equations(
        layout, measurements.corner_where, corners, corner_jacobian, weights[0],
        prior is not None and prior.has_offsets, matrix, gradient,
    )  # fmt: skip
    _add_match_equations(layout, measurements.match_where, matches, match_jacobian, weights[1], matrix, gradient)
    _add_lens_prior(geometry, matrix, gradient)
    if prior is not None:
        _add_shape_prior(geometry, prior, matrix, gradient)
    return matrix, gradient


def _add_corner_equations(
    layout: ParameterLayout, where: IntArray, residual: FloatArray, jacobian: FloatArray, weight: FloatArray,
    with_offsets: bool, matrix: FloatArray, gradient: FloatArray,
) -> None:  # fmt: skip
    groups = find_groups(where, columns=2)
    bend = CORNER_TERMS - BEND
    common = jacobian[:, :, np.r_[0 : DEVICE + POSE, bend:CORNER_TERMS]]
    starts = np.array([0, *(2 * group.stop for group in groups)])
    blocks, pulls = weighted_blocks(
        np.ascontiguousarray(common.reshape(-1, DEVICE + POSE + BEND)), residual.ravel(), np.repeat(weight, 2), starts
    )
    for group, block, pull in zip(groups, blocks, pulls, strict=True):
        camera, pose = where[group.start, :2]
        rows = np.concatenate([_device_indices(camera), _pose_indices(layout, pose), _bend_indices(layout)])
        matrix[rows[:, None], rows] += block
        gradient[rows] += pull
        if not with_offsets:
            continue
        used = np.arange(group.start, group.stop)[weight[group] > 0]
        offset = jacobian[used, :, DEVICE + POSE : bend]
        offset_rows = layout.first_offset + 2 * where[used, 2][:, None] + np.arange(2)
        mixed = np.einsum("nki,nkj,n->nij", common[used], offset, weight[used])
        for k in range(2):
            matrix[rows[:, None], offset_rows[:, k]] += mixed[:, :, k].T
            matrix[offset_rows[:, k][:, None], rows] += mixed[:, :, k]
        own = np.einsum("nki,nkj,n->nij", offset, offset, weight[used])
        matrix[offset_rows[:, :, None], offset_rows[:, None, :]] += own
        gradient[offset_rows] += np.einsum("nki,nk,n->ni", offset, residual[used], weight[used])


def _add_match_equations(
    layout: ParameterLayout, where: IntArray, residual: FloatArray, jacobian: FloatArray, weight: FloatArray,
    matrix: FloatArray, gradient: FloatArray,
) -> None:  # fmt: skip
    groups = find_groups(where, columns=2)
    starts = np.array([0, *(group.stop for group in groups)])
    blocks, pulls = weighted_blocks(jacobian, residual, weight, starts)
    for group, block, pull in zip(groups, blocks, pulls, strict=True):
        camera, pose = where[group.start, :2]
        devices = _device_indices(camera), _device_indices(layout.devices - 1)
        rows = np.concatenate([*devices, _pose_indices(layout, pose), _bend_indices(layout)])
        matrix[rows[:, None], rows] += block
        gradient[rows] += pull


def _add_lens_prior(geometry: Geometry, matrix: FloatArray, gradient: FloatArray) -> None:
    """Add the prior of the lens terms, `LENS_SIGMA`."""
    for device, row in enumerate(geometry.devices):
        own = DEVICE * device + 4 + np.arange(len(LENS_SIGMA))
        matrix[own, own] += 1 / LENS_SIGMA**2
        gradient[own] += row[4:9] / LENS_SIGMA**2


def _lens_cost(geometry: Geometry) -> float:
    return float(np.sum((geometry.devices[:, 4:9] / LENS_SIGMA) ** 2)) / 2


def _add_shape_prior(geometry: Geometry, prior: ShapePrior, matrix: FloatArray, gradient: FloatArray) -> None:
    """Add the prior of bend and offsets, and fix what offsets shift, turn, scale and stretch the board by to 0."""
    layout, bend = geometry.layout, _bend_indices(geometry.layout)
    matrix[bend, bend] += 1 / prior.bend_sigma_mm**2
    gradient[bend] += geometry.bend / prior.bend_sigma_mm**2
    if prior.offset_sigma_mm is None:
        return
    weight = 1 / prior.offset_sigma_mm**2
    offsets = np.arange(layout.first_offset, layout.first_bend)
    matrix[offsets, offsets] += weight
    gradient[offsets] += weight * geometry.offsets.ravel()
    for row in _gauge_rows(geometry, prior.offset_sigma_mm):
        matrix[np.ix_(offsets, offsets)] += np.outer(row, row)
        gradient[offsets] += row * (row @ geometry.offsets.ravel())


def _gauge_rows(geometry: Geometry, sigma_mm: float) -> FloatArray:
    """(5, 2 corners) float64: shift, turn, scale and stretch of the board by offsets, over a thousandth of sigma."""
    x, y = ((geometry.points - geometry.frame[:2]) / geometry.frame[2]).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    pairs = ((one, zero), (zero, one), (-y, x), (x, y), (x, -y))
    rows = np.array([np.stack(pair, axis=1).ravel() for pair in pairs])
    return np.asarray(rows * 1e3 / sigma_mm / np.sqrt(len(x)))


def _shape_cost(geometry: Geometry, prior: ShapePrior) -> float:
    cost = float(np.sum(geometry.bend**2)) / prior.bend_sigma_mm**2
    if prior.offset_sigma_mm is not None:
        offsets = geometry.offsets.ravel()
        gauge = _gauge_rows(geometry, prior.offset_sigma_mm) @ offsets
        cost += float(offsets @ offsets) / prior.offset_sigma_mm**2 + float(gauge @ gauge)
    return cost / 2


def _cost(
    geometry: Geometry, residuals: Residuals, deviations: Deviations, inliers: Weights, prior: ShapePrior | None
) -> float:
    """Half of Σ c² log(1 + z²/c²) plus priors; infinite if an inlier has no residual."""
    corner, matches = robust_losses(residuals, deviations)
    total = float(np.sum(corner[inliers[0] > 0]) + np.sum(matches[inliers[1] > 0]))
    if not np.isfinite(total):
        return np.inf
    return total / 2 + _lens_cost(geometry) + (0.0 if prior is None else _shape_cost(geometry, prior))


def robust_losses(residuals: Residuals, deviations: Deviations) -> tuple[FloatArray, FloatArray]:
    """Weight times c² log(1 + z²/c²), about z² for small z: of corners (n,), both coordinates, and matches (k,)."""
    corner, matches = (
        CAUCHY**2 * np.log1p((size / CAUCHY) ** 2) for size in normalised_residuals(residuals, deviations)
    )
    return 2 * corner * deviations.corner_weight, matches * deviations.match_weight


def _device_indices(number: int) -> IntArray:
    return np.arange(DEVICE, dtype=np.int32) + DEVICE * number


def _pose_indices(layout: ParameterLayout, number: int) -> IntArray:
    return np.arange(POSE, dtype=np.int32) + layout.first_pose + POSE * number


def _bend_indices(layout: ParameterLayout) -> IntArray:
    return np.arange(layout.first_bend, layout.count, dtype=np.int32)


def solve_positive_definite(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve matrix x = right, (n,), for a symmetric matrix (n, n); NaN if it is not positive definite.

    Uses Cholesky factors UᵀU in one thread: with a few hundred unknowns, a multithreaded BLAS spends more time waiting
    for its threads than computing.
    """
    factor = matrix.copy()
    x = right.copy()
    if not _solve_kernel(factor, x):
        x[:] = np.nan
    return x


@kernel(in_every_scan=False)
def _solve_kernel(a: Any, x: Any) -> bool:
    """Write U to the upper triangle of a, and the solution to x; return False if a pivot is not positive."""
    count = len(x)
    for k in range(count):
        if not a[k, k] > 0:
            return False
        pivot = np.sqrt(a[k, k])
        for j in range(k, count):
            a[k, j] /= pivot
        x[k] /= pivot
        for i in range(k + 1, count):
            factor = a[k, i]
            # Poses are coupled only through the devices: most of these are 0.
            if factor != 0:
                for j in range(i, count):
                    a[i, j] -= factor * a[k, j]
                x[i] -= factor * x[k]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            x[k] -= a[k, j] * x[j]
        x[k] /= a[k, k]
    return True


@dataclass(frozen=True, slots=True)
class DeviceNoise:
    """Noise model of one device: scale and excess_px of its standard deviations, and its design effect."""

    scale: float = 1.0
    excess_px: float = 0.0
    design_effect: float = 1.0


@dataclass(frozen=True, slots=True)
class AdjustmentProblem:
    """Measurements to adjust to. devices : names, cameras first; pose_names : all poses, used or not.

    with_projector : True if the last device is the projector. prior : None for a flat board with nominal corners.
    """

    devices: tuple[str, ...]
    pose_names: tuple[str, ...]
    with_projector: bool
    measurements: Measurements
    prior: ShapePrior | None = None

    @property
    def used(self) -> NDArray[np.bool_]:
        """(m,) bool: poses with measurements."""
        used = np.zeros(len(self.pose_names), dtype=np.bool_)
        used[self.measurements.corner_where[:, 1]] = True
        return used

    def is_projector(self, device: int) -> bool:
        """True if the device with this number is the projector."""
        return self.with_projector and device == len(self.devices) - 1

    def deviations(self, noise: Sequence[DeviceNoise]) -> Deviations:
        """Standard deviation of each observation, px, and its weight."""
        return observation_deviations(self.measurements, noise, self.with_projector)

    def exclude_poses(self, poses: NDArray[np.bool_]) -> AdjustmentProblem:
        """Remove the measurements of some poses, (m,) bool."""
        return replace(self, measurements=self.measurements.select_poses(~poses))


@dataclass(frozen=True, slots=True)
class Fit:
    """Adjusted geometry, its residuals, and the noise of each device."""

    geometry: Geometry
    residuals: Residuals
    noise: tuple[DeviceNoise, ...]


def flat_geometry(board: Board, devices: FloatArray, poses: FloatArray) -> Geometry:
    """Geometry with a flat board and nominal corners."""
    points = board.points_mm[:, :2]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    half = float(np.ptp(points, axis=0).max()) / 2
    return Geometry(
        devices, poses, points.copy(), np.zeros_like(points), np.zeros(7), np.array([middle[0], middle[1], half])
    )


def free_parameters(problem: AdjustmentProblem, geometry: Geometry, /) -> NDArray[np.bool_]:
    """(N,) bool over the whole parameter vector: parameters that are adjusted."""
    bend = problem.prior is not None
    offsets = problem.prior is not None and problem.prior.has_offsets
    return geometry.layout.free_mask(problem.used, bend=bend, offsets=offsets)


def clear_unsolved_shape(geometry: Geometry, problem: AdjustmentProblem, /) -> Geometry:
    """Set the parts of the board's shape to 0 that the problem does not solve for."""
    bend = geometry.bend if problem.prior is not None else np.zeros_like(geometry.bend)
    has_offsets = problem.prior is not None and problem.prior.has_offsets
    offsets = geometry.offsets if has_offsets else np.zeros_like(geometry.offsets)
    return replace(geometry, offsets=offsets, bend=bend)


def fit_geometry(
    problem: AdjustmentProblem, geometry: Geometry, /, *, rounds: int = 4, correlated: bool = False,
    noise: Sequence[DeviceNoise] | None = None,
) -> Fit:  # fmt: skip
    """Adjust the geometry and estimate the noise in turns, since each needs the other.

    correlated : estimate design effects. noise : initial noise; estimated from the initial residuals by default.
    """
    geometry = clear_unsolved_shape(geometry, problem)
    free = free_parameters(problem, geometry)
    measurements, count = problem.measurements, len(problem.devices)
    residuals = compute_residuals(geometry, measurements)
    current = noise or estimate_noise(residuals, measurements, count, problem.with_projector)
    for number in range(rounds):
        result = adjust(geometry, measurements, free, problem.deviations(current), prior=problem.prior)
        geometry, residuals, before = result.geometry, result.residuals, current
        current = estimate_noise(residuals, measurements, count, problem.with_projector)
        if correlated:
            current = add_design_effects(current, geometry, residuals, measurements, problem.with_projector)
        if number and _noise_converged(before, current):
            break
    return Fit(geometry, residuals, tuple(current))


def _noise_converged(first: Sequence[DeviceNoise], second: Sequence[DeviceNoise]) -> bool:
    """True if two noise models agree to 2 %."""
    a, b = (np.array([[one.scale, one.excess_px, one.design_effect] for one in noise]) for noise in (first, second))
    return bool((np.abs(a - b) <= 0.02 * np.maximum(np.abs(a), np.abs(b)) + 1e-4).all())


def estimate_noise(
    residuals: Residuals, measurements: Measurements, devices: int, with_projector: bool, /
) -> list[DeviceNoise]:
    """Estimate scale and excess of each device from medians. with_projector : True if the last one is the projector."""
    noise = []
    for device in range(devices):
        if with_projector and device == devices - 1:
            noise.append(_estimate_device_noise(np.abs(residuals.matches), measurements.match_sigma, _MEDIAN))
            continue
        own = measurements.corner_where[:, 0] == device
        views = len(np.unique(measurements.corner_where[own, 1]))
        count = 2 * int(own.sum())
        # Residuals are smaller by the degrees of freedom of the views' poses.
        inflation = count / max(count - 6 * views - 4, count / 4, 1)
        distance = np.hypot(*residuals.corners[own].T) / np.sqrt(2) * np.sqrt(inflation)
        noise.append(_estimate_device_noise(distance, measurements.corner_sigma[own], _MEDIAN_2))
    return noise


def _estimate_device_noise(size: FloatArray, stated: FloatArray, median: float) -> DeviceNoise:
    good = np.isfinite(size)
    size, stated = size[good], stated[good]
    if not len(size):
        return DeviceNoise()
    ratio = float(np.median(size / stated)) / median
    if ratio <= 1:
        return DeviceNoise(max(ratio, _MIN_SCALE), _MIN_EXCESS_PX)
    low, high = 0.0, float(np.median(size)) / median * 2 + float(np.max(stated))
    for _ in range(25):
        middle = (low + high) / 2
        if float(np.median(size / np.hypot(stated, middle))) > median:
            low = middle
        else:
            high = middle
    return DeviceNoise(1.0, high)


def observation_deviations(
    measurements: Measurements, noise: Sequence[DeviceNoise], with_projector: bool, /
) -> Deviations:
    """Standard deviation of each observation, px, and its weight."""
    scale = np.array([one.scale for one in noise])
    excess = np.array([one.excess_px for one in noise])
    design_effect = np.array([one.design_effect for one in noise])
    device = measurements.corner_where[:, 0]
    corners = np.hypot(scale[device] * measurements.corner_sigma, excess[device])
    projector = noise[-1] if with_projector else DeviceNoise()
    matches = np.hypot(projector.scale * measurements.match_sigma, projector.excess_px)
    return Deviations(corners, matches, 1 / design_effect[device], np.full(len(matches), 1 / projector.design_effect))


def add_design_effects(
    noise: Sequence[DeviceNoise], geometry: Geometry, residuals: Residuals, measurements: Measurements,
    with_projector: bool, /,
) -> list[DeviceNoise]:  # fmt: skip
    """Estimate the design effect of each device."""
    plain = [replace(one, design_effect=1.0) for one in noise]
    sigma = observation_deviations(measurements, plain, with_projector)
    result = []
    for device, one in enumerate(plain):
        if with_projector and device == len(plain) - 1:
            design_effect = _match_design_effect(residuals.matches / sigma.matches, measurements)
        else:
            own = measurements.corner_where[:, 0] == device
            z = residuals.corners / sigma.corners[:, None]
            design_effect = _corner_design_effect(geometry, z, measurements, own)
        result.append(replace(one, design_effect=design_effect))
    return result


def _match_design_effect(z: FloatArray, measurements: Measurements) -> float:
    good = np.isfinite(z) & (np.abs(z) < OUTLIER_SIGMAS)
    worst = 1.0
    for cells in _LIGHT_CELLS:
        key = np.zeros(len(z), dtype=np.int32)
        first = 0
        for rows in find_groups(measurements.match_where):
            key[rows] = first + _cell_numbers(measurements.match_pixel[rows], cells)
            first += cells * cells
        poses = len(np.unique(measurements.match_where[:, 1])) if len(z) else 0
        worst = max(worst, _design_effect(z[good], key[good], 6 * poses))
    for axis in (0, 1):
        on_axis = good & (measurements.match_where[:, 2] == axis)
        worst = max(worst, _design_effect(z[on_axis], _cell_numbers(measurements.match_pixel[on_axis], _MAP_CELLS), 5))
    return worst


def _corner_design_effect(
    geometry: Geometry, z: FloatArray, measurements: Measurements, own: NDArray[np.bool_]
) -> float:
    good = own & np.isfinite(z).all(axis=1) & (np.abs(z).max(axis=1, initial=0.0) < OUTLIER_SIGMAS)
    where = measurements.corner_where
    key = np.zeros(len(z), dtype=np.int64)
    first = 0
    for rows in find_groups(where, columns=2):
        key[rows] = first + _cell_numbers(measurements.corner_px[rows], _CORNER_CELLS)
        first += _CORNER_CELLS * _CORNER_CELLS
    views = len(np.unique(where[good, 1]))
    both = np.concatenate([z[good, 0], z[good, 1]])
    worst = max(1.0, _design_effect(both, np.concatenate([key[good], key[good] + first]), 6 * views))
    # An error of the print is the same at one corner in all poses, in the board's own directions.
    poses = geometry.poses[where[:, 1]].reshape(-1, 12)
    devices = geometry.devices[where[:, 0]]
    turn = np.einsum("nij,njk->nik", devices[:, 9:18].reshape(-1, 3, 3), poses[:, :9].reshape(-1, 3, 3))[:, :2, :2]
    on_board = np.einsum("nij,ni->nj", turn, z)[good]
    corner = where[good, 2].astype(np.int64)
    by_axis = np.concatenate([corner, corner + len(geometry.points)])
    if views >= _MIN_GROUPS:
        worst = max(worst, _design_effect(on_board.T.ravel(), by_axis, 6))
    return worst


def _cell_numbers(points_px: FloatArray, cells: int) -> IntArray:
    """(n,) int: cell of each point, of cells x cells over the extent of the points."""
    if not len(points_px):
        return np.zeros(0, dtype=np.int32)
    least = points_px.min(axis=0)
    extent = np.maximum(points_px.max(axis=0) - least, 1e-9)
    cell = np.minimum((points_px - least) / extent * cells, cells - 1).astype(np.int32)
    return np.asarray(cell[:, 1] * cells + cell[:, 0], dtype=np.int32)


def _design_effect(z: FloatArray, key: IntArray, fitted: int) -> float:
    """Σ over groups (Σ z)² / Σ z², corrected for the `fitted` parameters that made the groups' sums smaller."""
    if not len(z):
        return 1.0
    groups, index = np.unique(key, return_inverse=True)
    sums = np.bincount(index, weights=z)
    remaining = len(groups) - fitted
    if remaining < _MIN_GROUPS:
        return 1.0
    return float(np.sum(sums**2) / np.sum(z**2)) * len(groups) / remaining

"""Bundle adjustment by Levenberg-Marquardt: devices, poses and shape of the board.

The cost is Σ ρ(r/σ) with Cauchy's ρ(z) = c²/2 log(1 + z²/c²), c = 2.385 (95 % efficient for normal errors), minimised
by weights 1/(1 + z²/c²) that follow the residuals (Holland and Welsch 1977). What lies beyond six deviations when an
adjustment starts has no weight in it at all. Normal equations are gathered block by block, one camera and pose at a
time.
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
    LIGHT_TERMS,
    POSE,
    Geometry,
    Layout,
    Measurements,
    corner_rows,
    groups,
    match_rows,
    weighed_blocks,
)
from slrig.kernels import kernel
from slrig.model import FloatArray, IntArray

LENS_SIGMA = np.array([0.5, 0.5, 0.01, 0.01, 0.5])
"""What is known beforehand of k1, k2, p1, p2 and k3 of any lens: standard deviations about 0. Lenses of rigs have k1 of
some -0.4 to 0.1 and p1, p2 of a thousandth; where the poses tell of a term at all, they tell far more than this."""
CAUCHY = 2.385
OUTLYING = 6.0
_MOST_STEPS = 60
_MOST_JUDGEMENTS = 3
_LEAST_GAIN = 3e-4
"""In squared deviations: a step that gains less moves no number by more than a small share of its own deviation."""
_FIRST_DAMPING = 1e-6
_MOST_DAMPING = 1e8
_LEAST_DAMPING = 1e-12

Weights = tuple[FloatArray, FloatArray]
"""Of corners (n,) and of matches (k,)."""


@dataclass(frozen=True, slots=True)
class Residuals:
    """What is left: corners (n, 2), px, and matches (k,), projector px; projected minus measured."""

    corners: FloatArray
    matches: FloatArray


@dataclass(frozen=True, slots=True)
class Deviations:
    """The deviations that observations are weighed with: corners (n,) and matches (k,), px.

    corner_weight, match_weight : (n,) and (k,), how much of an observation each tells; less than 1 where neighbours err
    alike. It takes weight from all, and makes none of them more or less of an outlier.
    """

    corners: FloatArray
    matches: FloatArray
    corner_weight: FloatArray
    match_weight: FloatArray


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known beforehand of a board's shape, where it is solved for: standard deviations, mm.

    bend_sigma_mm : of each number of the bend. offset_sigma_mm : of each coordinate of a corner's offset; None where
    corners lie as printed.
    """

    bend_sigma_mm: float
    offset_sigma_mm: float | None = None

    @property
    def offsets(self) -> bool:
        """Whether corners may lie off their printed places."""
        return self.offset_sigma_mm is not None


@dataclass(frozen=True, slots=True)
class Adjustment:
    """The end of an adjustment. settled : the cost no longer fell."""

    geometry: Geometry
    residuals: Residuals
    settled: bool


def residuals_of(geometry: Geometry, measurements: Measurements) -> Residuals:
    """The residuals alone."""
    return Residuals(
        corner_terms(geometry, measurements, jacobian=False)[0], match_terms(geometry, measurements, jacobian=False)[0]
    )


def sizes_of(residuals: Residuals, deviations: Deviations) -> tuple[FloatArray, FloatArray]:
    """Residuals over their deviations, of corners (n,) and matches (k,); a corner's is its distance over √2."""
    corner = np.hypot(residuals.corners[:, 0], residuals.corners[:, 1]) / deviations.corners / np.sqrt(2)
    return corner, np.abs(residuals.matches) / deviations.matches


def kept_of(residuals: Residuals, deviations: Deviations) -> Weights:
    """1 for what is not outlying, 0 for what is, or has no residual."""
    corner, matches = sizes_of(residuals, deviations)
    return (corner <= OUTLYING).astype(np.float64), (matches <= OUTLYING).astype(np.float64)


def weights_of(residuals: Residuals, deviations: Deviations, kept: Weights) -> Weights:
    """The robust weight over the variance, 0 where nothing is kept. Both coordinates of a corner have one weight."""
    corner, matches = sizes_of(residuals, deviations)
    return (
        _robust(corner, kept[0]) / deviations.corners**2 * deviations.corner_weight,
        _robust(matches, kept[1]) / deviations.matches**2 * deviations.match_weight,
    )


def _robust(z: FloatArray, kept: FloatArray) -> FloatArray:
    return np.where(kept > 0, 1 / (1 + (np.where(kept > 0, z, 0.0) / CAUCHY) ** 2), 0.0)


def adjusted(
    geometry: Geometry, measurements: Measurements, free: NDArray[np.bool_], deviations: Deviations, /, *,
    prior: Prior | None = None, kept: Weights | None = None, most_steps: int = _MOST_STEPS,
) -> Adjustment:  # fmt: skip
    """The geometry of least cost, from a start. `free` is over the whole vector.

    kept : what counts (`kept_of`); without it, what is outlying is judged at the start, by how far off all else is
    there, and again at each end until no more changes.
    """
    if kept is not None:
        return _adjusted(geometry, measurements, free, deviations, kept, prior, most_steps)
    left = residuals_of(geometry, measurements)
    kept = _kept_at_start(left, deviations)
    made = _adjusted(geometry, measurements, free, deviations, kept, prior, most_steps)
    for _ in range(_MOST_JUDGEMENTS):
        again = kept_of(made.residuals, deviations)
        if all(np.array_equal(one, other) for one, other in zip(kept, again, strict=True)):
            break
        kept = again
        made = _adjusted(made.geometry, measurements, free, deviations, kept, prior, most_steps)
    return made


def _kept_at_start(left: Residuals, deviations: Deviations) -> Weights:
    """As `kept_of`, but where half of the corners or of the matches is off, as from a start, that half counts."""
    kept = []
    for size in sizes_of(left, deviations):
        middle = float(np.nanmedian(size)) if np.isfinite(size).any() else 0.0
        kept.append((size <= OUTLYING * max(1.0, middle)).astype(np.float64))
    return kept[0], kept[1]


def _adjusted(
    geometry: Geometry, measurements: Measurements, free: NDArray[np.bool_], deviations: Deviations, kept: Weights,
    prior: Prior | None, most_steps: int,
) -> Adjustment:  # fmt: skip
    left = residuals_of(geometry, measurements)
    cost = _cost(geometry, left, deviations, kept, prior)
    damping, settled = _FIRST_DAMPING, False
    for _ in range(most_steps):
        matrix, gradient = normal_equations(geometry, measurements, weights_of(left, deviations, kept), prior=prior)
        matrix, gradient = matrix[np.ix_(free, free)], gradient[free]
        settled = True
        while damping < _MOST_DAMPING:
            step = np.zeros(len(free))
            step[free] = -_damped_step(matrix, gradient, damping)
            if not np.isfinite(step).all():
                damping *= 10
                continue
            trial = geometry.moved(step)
            after = residuals_of(trial, measurements)
            new = _cost(trial, after, deviations, kept, prior)
            if new < cost:
                settled = cost - new < _LEAST_GAIN
                geometry, left, cost = trial, after, new
                damping = max(damping / 10, _LEAST_DAMPING)
                break
            # Where nothing is left to gain, rounding alone decides whether the cost falls.
            if new - cost < _LEAST_GAIN:
                break
            damping *= 10
        if settled:
            break
    return Adjustment(geometry, left, settled)


def _damped_step(matrix: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    """(H + damping diag H)⁻¹ g, scaled to a unit diagonal; NaN where that is singular."""
    diagonal = np.sqrt(np.diagonal(matrix))
    diagonal = np.where(diagonal > 0, diagonal, 1.0)
    scaled = matrix / np.outer(diagonal, diagonal)
    scaled[np.diag_indices_from(scaled)] += damping
    return solved(scaled, gradient / diagonal) / diagonal


def normal_equations(
    geometry: Geometry, measurements: Measurements, weights: Weights, /, *, prior: Prior | None = None
) -> tuple[FloatArray, FloatArray]:
    """Jᵀ W J, (N, N), and Jᵀ W r, (N,), over the whole vector, free or not, for given weights (see `weights_of`)."""
    layout = geometry.layout
    matrix, gradient = np.zeros((layout.count, layout.count)), np.zeros(layout.count)
    corners, corner_jacobian = corner_terms(geometry, measurements, jacobian=True)
    matches, match_jacobian = match_terms(geometry, measurements, jacobian=True)
    _add_corners(
        layout, measurements.corner_where, corners, corner_jacobian, weights[0],
        prior is not None and prior.offsets, matrix, gradient,
    )  # fmt: skip
    _add_matches(layout, measurements.match_where, matches, match_jacobian, weights[1], matrix, gradient)
    _add_lens_prior(geometry, matrix, gradient)
    if prior is not None:
        _add_prior(geometry, prior, matrix, gradient)
    return matrix, gradient


def _add_corners(
    layout: Layout, where: IntArray, residual: FloatArray, jacobian: FloatArray, weight: FloatArray,
    shape: bool, matrix: FloatArray, gradient: FloatArray,
) -> None:  # fmt: skip
    runs = groups(where, columns=2)
    bend = CORNER_TERMS - BEND
    common = jacobian[:, :, np.r_[0 : DEVICE + POSE, bend:CORNER_TERMS]]
    starts = np.array([0, *(2 * run.stop for run in runs)])
    blocks, pulls = weighed_blocks(
        np.ascontiguousarray(common.reshape(-1, DEVICE + POSE + BEND)), residual.ravel(), np.repeat(weight, 2), starts
    )
    for run, block, pull in zip(runs, blocks, pulls, strict=True):
        place = np.concatenate([_device(where[run.start, 0]), _pose(layout, where[run.start, 1]), _bend(layout)])
        matrix[place[:, None], place] += block
        gradient[place] += pull
        if not shape:
            continue
        used = np.arange(run.start, run.stop)[weight[run] > 0]
        offset = jacobian[used, :, DEVICE + POSE : bend]
        own = layout.first_offset + 2 * where[used, 2][:, None] + np.arange(2)
        crossed = np.einsum("nki,nkj,n->nij", common[used], offset, weight[used])
        for k in range(2):
            matrix[place[:, None], own[:, k]] += crossed[:, :, k].T
            matrix[own[:, k][:, None], place] += crossed[:, :, k]
        matrix[own[:, :, None], own[:, None, :]] += np.einsum("nki,nkj,n->nij", offset, offset, weight[used])
        gradient[own] += np.einsum("nki,nk,n->ni", offset, residual[used], weight[used])


def _add_matches(
    layout: Layout, where: IntArray, residual: FloatArray, jacobian: FloatArray, weight: FloatArray,
    matrix: FloatArray, gradient: FloatArray,
) -> None:  # fmt: skip
    runs = groups(where, columns=2)
    starts = np.array([0, *(run.stop for run in runs)])
    blocks, pulls = weighed_blocks(jacobian, residual, weight, starts)
    for run, block, pull in zip(runs, blocks, pulls, strict=True):
        place = np.concatenate([
            _device(where[run.start, 0]), _device(layout.devices - 1), _pose(layout, where[run.start, 1]),
            _bend(layout),
        ])  # fmt: skip
        matrix[place[:, None], place] += block
        gradient[place] += pull


def _add_lens_prior(geometry: Geometry, matrix: FloatArray, gradient: FloatArray) -> None:
    """Lens terms are about as small as those of lenses are."""
    for device, row in enumerate(geometry.devices):
        own = DEVICE * device + 4 + np.arange(len(LENS_SIGMA))
        matrix[own, own] += 1 / LENS_SIGMA**2
        gradient[own] += row[4:9] / LENS_SIGMA**2


def _lens_cost(geometry: Geometry) -> float:
    return float(np.sum((geometry.devices[:, 4:9] / LENS_SIGMA) ** 2)) / 2


def _add_prior(geometry: Geometry, prior: Prior, matrix: FloatArray, gradient: FloatArray) -> None:
    """Offsets and bend are about as small as stated; offsets move, turn, scale and stretch the board by nothing."""
    layout, bend = geometry.layout, _bend(geometry.layout)
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
    """(5, 2 corners) float64: what offsets move, turn, scale and stretch the board by, over a thousandth of their
    deviation.
    """
    x, y = ((geometry.points - geometry.frame[:2]) / geometry.frame[2]).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    pairs = ((one, zero), (zero, one), (-y, x), (x, y), (x, -y))
    rows = np.array([np.stack(pair, axis=1).ravel() for pair in pairs])
    return np.asarray(rows * 1e3 / sigma_mm / np.sqrt(len(x)))


def _prior_cost(geometry: Geometry, prior: Prior) -> float:
    cost = float(np.sum(geometry.bend**2)) / prior.bend_sigma_mm**2
    if prior.offset_sigma_mm is not None:
        offsets = geometry.offsets.ravel()
        held = _gauge_rows(geometry, prior.offset_sigma_mm) @ offsets
        cost += float(offsets @ offsets) / prior.offset_sigma_mm**2 + float(held @ held)
    return cost / 2


def _cost(geometry: Geometry, left: Residuals, deviations: Deviations, kept: Weights, prior: Prior | None) -> float:
    """Half of Σ c² log(1 + z²/c²); infinite where an observation that counts has no residual."""
    corner, matches = losses_of(left, deviations)
    total = float(np.sum(corner[kept[0] > 0]) + np.sum(matches[kept[1] > 0]))
    if not np.isfinite(total):
        return np.inf
    return total / 2 + _lens_cost(geometry) + (0.0 if prior is None else _prior_cost(geometry, prior))


def losses_of(left: Residuals, deviations: Deviations) -> tuple[FloatArray, FloatArray]:
    """Of corners (n,), both coordinates, and matches (k,): their weight times c² log(1 + z²/c²), z² where small."""
    corner, matches = (CAUCHY**2 * np.log1p((size / CAUCHY) ** 2) for size in sizes_of(left, deviations))
    return 2 * corner * deviations.corner_weight, matches * deviations.match_weight


def _device(number: int) -> IntArray:
    return np.arange(DEVICE, dtype=np.int32) + DEVICE * number


def _pose(layout: Layout, number: int) -> IntArray:
    return np.arange(POSE, dtype=np.int32) + layout.first_pose + POSE * number


def _bend(layout: Layout) -> IntArray:
    return np.arange(layout.first_bend, layout.count, dtype=np.int32)


def corner_terms(geometry: Geometry, m: Measurements, /, *, jacobian: bool) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, 2) of the corners and their derivatives; see `corner_rows`."""
    points = geometry.points + geometry.offsets
    return corner_rows(
        geometry.devices, geometry.poses, points, geometry.bend, geometry.frame, m.corner_where, m.corner_px,
        jacobian=jacobian,
    )  # fmt: skip


def match_terms(geometry: Geometry, m: Measurements, /, *, jacobian: bool) -> tuple[FloatArray, FloatArray]:
    """Residuals (k,) of the matches and their derivatives; see `match_rows`."""
    if not len(m.match_where):
        return np.zeros(0), np.zeros((0, LIGHT_TERMS))
    return match_rows(
        geometry.devices, geometry.poses, geometry.bend, geometry.frame, m.match_where, m.match_pixel, m.match_px,
        jacobian=jacobian,
    )  # fmt: skip


def solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """(n,) float64: x with matrix x = right, for a symmetric positive definite matrix (n, n); NaN where it is not that.

    By Cholesky's factors UᵀU, in one thread: for a few hundred unknowns, solved a thousand times, a BLAS that spreads
    its work over threads waits longer for them than it works.
    """
    factor = matrix.copy()
    x = right.copy()
    if not _solve_kernel(factor, x):
        x[:] = np.nan
    return x


@kernel(in_every_scan=False)
def _solve_kernel(a: Any, x: Any) -> bool:
    """Leave U in the upper triangle of a, and the solution in x; False for a pivot that is not positive."""
    count = len(x)
    for k in range(count):
        if not a[k, k] > 0:
            return False
        pivot = np.sqrt(a[k, k])
        for j in range(k, count):
            a[k, j] /= pivot
        x[k] /= pivot
        for i in range(k + 1, count):
            share = a[k, i]
            # Poses meet only through the devices: most of these are 0.
            if share != 0:
                for j in range(i, count):
                    a[i, j] -= share * a[k, j]
                x[i] -= share * x[k]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            x[k] -= a[k, j] * x[j]
        x[k] /= a[k, k]
    return True


_MEDIAN = 0.6745  # of the absolute value of a standard normal
_MEDIAN_2 = 0.8326  # of the distance of two standard normals, over √2
_LEAST_SCALE = 0.05
_LEAST_PX = 1e-5
_LIGHT_CELLS = (6, 12, 24)
_CORNER_CELLS = (3,)
_MAP_CELLS = 6
_LEAST_IN_GROUPS = 3.0


@dataclass(frozen=True, slots=True)
class DeviceNoise:
    """scale (1), excess_px and inflation (1) of one device; see above."""

    scale: float = 1.0
    excess_px: float = 0.0
    design_effect: float = 1.0


@dataclass(frozen=True, slots=True)
class Problem:
    """Measurements of poses by devices. devices : names, cameras first; pose_names : all poses, used or not.

    with_projector : whether the last device is the projector. prior : None for a flat board that is as printed.
    """

    devices: tuple[str, ...]
    pose_names: tuple[str, ...]
    with_projector: bool
    measurements: Measurements
    prior: Prior | None = None

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names of the cameras."""
        return self.devices[:-1] if self.with_projector else self.devices

    @property
    def used(self) -> NDArray[np.bool_]:
        """(m,) bool: poses of which there are measurements."""
        used = np.zeros(len(self.pose_names), dtype=np.bool_)
        used[self.measurements.corner_where[:, 1]] = True
        return used

    def beam(self, device: int) -> bool:
        """Whether a device, by its number, is the projector."""
        return self.with_projector and device == len(self.devices) - 1

    def deviations(self, noise: Sequence[DeviceNoise]) -> Deviations:
        """The deviation of each observation, px, and its weight beside others."""
        return deviations_of(self.measurements, noise, self.with_projector)

    def without(self, poses: NDArray[np.bool_]) -> Problem:
        """The same without some poses, (m,) bool."""
        return replace(self, measurements=self.measurements.of_poses(~poses))


@dataclass(frozen=True, slots=True)
class Fit:
    """A geometry that fits, what is left, and what the observations weigh by it."""

    geometry: Geometry
    residuals: Residuals
    noise: tuple[DeviceNoise, ...]


def flat_geometry(board: Board, devices: FloatArray, poses: FloatArray) -> Geometry:
    """The geometry of a board that is flat and as printed."""
    points = board.points_mm[:, :2]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    half = float(np.ptp(points, axis=0).max()) / 2
    return Geometry(
        devices, poses, points.copy(), np.zeros_like(points), np.zeros(7), np.array([middle[0], middle[1], half])
    )


def free_of(problem: Problem, geometry: Geometry, /) -> NDArray[np.bool_]:
    """(N,) bool over the whole vector: what may move."""
    prior = problem.prior
    return geometry.layout.free(problem.used, bend=prior is not None, offsets=prior is not None and prior.offsets)


def in_shape(geometry: Geometry, problem: Problem, /) -> Geometry:
    """The same geometry, of the board's shape that set to 0 which is not solved for."""
    bend = geometry.bend if problem.prior is not None else np.zeros_like(geometry.bend)
    keeps = problem.prior is not None and problem.prior.offsets
    offsets = geometry.offsets if keeps else np.zeros_like(geometry.offsets)
    return replace(geometry, offsets=offsets, bend=bend)


def fitted(
    problem: Problem, geometry: Geometry, /, *, rounds: int = 4, correlated: bool = False,
    noise: Sequence[DeviceNoise] | None = None,
) -> Fit:  # fmt: skip
    """The geometry that fits, and deviations that fit it: in turns, since the weights need both.

    correlated : take into account that neighbours err alike. noise : what to start from; without it, the residuals
    tell.
    """
    geometry = in_shape(geometry, problem)
    free = free_of(problem, geometry)
    measurements, count = problem.measurements, len(problem.devices)
    current = noise or noise_of(residuals_of(geometry, measurements), measurements, count, problem.with_projector)
    left = None
    for turn in range(rounds):
        made = adjusted(geometry, measurements, free, problem.deviations(current), prior=problem.prior)
        geometry, left, before = made.geometry, made.residuals, current
        current = noise_of(left, measurements, count, problem.with_projector)
        if correlated:
            current = with_design_effect(current, geometry, left, measurements, problem.with_projector)
        if turn and _same(before, current):
            break
    if left is None:
        message = f"a fit takes at least one round, and {rounds} were asked for"
        raise ValueError(message)
    return Fit(geometry, left, tuple(current))


def _same(first: Sequence[DeviceNoise], second: Sequence[DeviceNoise]) -> bool:
    """Whether the weights are all but what they were."""
    a, b = (np.array([[one.scale, one.excess_px, one.design_effect] for one in noise]) for noise in (first, second))
    return bool((np.abs(a - b) <= 0.02 * np.maximum(np.abs(a), np.abs(b)) + 1e-4).all())


def noise_of(
    residuals: Residuals, measurements: Measurements, devices: int, with_projector: bool, /
) -> list[DeviceNoise]:
    """Scale and excess of each device, with no design effect. `with_projector` : the last device is the projector."""
    noise = []
    for device in range(devices):
        if with_projector and device == devices - 1:
            noise.append(_device_noise(np.abs(residuals.matches), measurements.match_sigma, _MEDIAN))
            continue
        mine = measurements.corner_where[:, 0] == device
        views = len(np.unique(measurements.corner_where[mine, 1]))
        count = 2 * int(mine.sum())
        # What the views' poses take of the residuals.
        left = count / max(count - 6 * views - 4, count / 4, 1)
        distance = np.hypot(*residuals.corners[mine].T) / np.sqrt(2) * np.sqrt(left)
        noise.append(_device_noise(distance, measurements.corner_sigma[mine], _MEDIAN_2))
    return noise


def _device_noise(size: FloatArray, stated: FloatArray, median: float) -> DeviceNoise:
    good = np.isfinite(size)
    size, stated = size[good], stated[good]
    if not len(size):
        return DeviceNoise()
    ratio = float(np.median(size / stated)) / median
    if ratio <= 1:
        return DeviceNoise(max(ratio, _LEAST_SCALE), _LEAST_PX)
    low, high = 0.0, float(np.median(size)) / median * 2 + float(np.max(stated))
    for _ in range(25):
        middle = (low + high) / 2
        if float(np.median(size / np.hypot(stated, middle))) > median:
            low = middle
        else:
            high = middle
    return DeviceNoise(1.0, high)


def deviations_of(measurements: Measurements, noise: Sequence[DeviceNoise], with_projector: bool, /) -> Deviations:
    """The deviation of each observation, px, and its weight beside others."""
    scale = np.array([one.scale for one in noise])
    excess = np.array([one.excess_px for one in noise])
    design_effect = np.array([one.design_effect for one in noise])
    device = measurements.corner_where[:, 0]
    corners = np.hypot(scale[device] * measurements.corner_sigma, excess[device])
    last = noise[-1] if with_projector else DeviceNoise()
    lit = np.hypot(last.scale * measurements.match_sigma, last.excess_px)
    return Deviations(corners, lit, 1 / design_effect[device], np.full(len(lit), 1 / last.design_effect))


def with_design_effect(
    noise: Sequence[DeviceNoise], geometry: Geometry, residuals: Residuals, measurements: Measurements,
    with_projector: bool, /,
) -> list[DeviceNoise]:  # fmt: skip
    """The same noise, with how much neighbours err alike."""
    plain = [replace(one, design_effect=1.0) for one in noise]
    sigma = deviations_of(measurements, plain, with_projector)
    made = []
    for device, one in enumerate(plain):
        if with_projector and device == len(plain) - 1:
            design_effect = _of_matches(residuals.matches / sigma.matches, measurements)
        else:
            mine = measurements.corner_where[:, 0] == device
            z = residuals.corners / sigma.corners[:, None]
            design_effect = _of_corners(geometry, z, measurements, mine)
        made.append(replace(one, design_effect=design_effect))
    return made


def _of_matches(z: FloatArray, measurements: Measurements) -> float:
    good = np.isfinite(z) & (np.abs(z) < OUTLYING)
    worst = 1.0
    for cells in _LIGHT_CELLS:
        key = np.zeros(len(z), dtype=np.int32)
        first = 0
        for rows in groups(measurements.match_where):
            key[rows] = first + _cells(measurements.match_pixel[rows], cells)
            first += cells * cells
        poses = len(np.unique(measurements.match_where[:, 1])) if len(z) else 0
        worst = max(worst, _design_effect(z[good], key[good], 6 * poses))
    for axis in (0, 1):
        mine = good & (measurements.match_where[:, 2] == axis)
        worst = max(worst, _design_effect(z[mine], _cells(measurements.match_pixel[mine], _MAP_CELLS), 5))
    return worst


def _of_corners(geometry: Geometry, z: FloatArray, measurements: Measurements, mine: NDArray[np.bool_]) -> float:
    good = mine & np.isfinite(z).all(axis=1) & (np.abs(z).max(axis=1, initial=0.0) < OUTLYING)
    where = measurements.corner_where
    worst = 1.0
    for cells in _CORNER_CELLS:
        key = np.zeros(len(z), dtype=np.int64)
        first = 0
        for rows in groups(where, columns=2):
            key[rows] = first + _cells(measurements.corner_px[rows], cells)
            first += cells * cells
        views = len(np.unique(where[good, 1]))
        both = np.concatenate([z[good, 0], z[good, 1]])
        worst = max(worst, _design_effect(both, np.concatenate([key[good], key[good] + first]), 6 * views))
    # A print that is off errs alike at one corner in all poses, in the board's own directions.
    across = geometry.poses[where[:, 1]].reshape(-1, 12)
    device = geometry.devices[where[:, 0]]
    turn = np.einsum("nij,njk->nik", device[:, 9:18].reshape(-1, 3, 3), across[:, :9].reshape(-1, 3, 3))[:, :2, :2]
    along = np.einsum("nij,ni->nj", turn, z)[good]
    corner = where[good, 2].astype(np.int64)
    shifted = np.concatenate([corner, corner + len(geometry.points)])
    if len(np.unique(where[good, 1])) >= _LEAST_IN_GROUPS:
        worst = max(worst, _design_effect(along.T.ravel(), shifted, 6))
    return worst


def _cells(points_px: FloatArray, cells: int) -> IntArray:
    """(n,) int: the number of the cell, of cells x cells over the extent of the points."""
    if not len(points_px):
        return np.zeros(0, dtype=np.int32)
    least = points_px.min(axis=0)
    extent = np.maximum(points_px.max(axis=0) - least, 1e-9)
    cell = np.minimum((points_px - least) / extent * cells, cells - 1).astype(np.int32)
    return np.asarray(cell[:, 1] * cells + cell[:, 0], dtype=np.int32)


def _design_effect(z: FloatArray, key: IntArray, taken: int) -> float:
    """Σ over groups (Σ z)² / Σ z², made up for the `taken` numbers that a fit takes of the groups' sums."""
    if not len(z):
        return 1.0
    groups_found, index = np.unique(key, return_inverse=True)
    sums = np.bincount(index, weights=z)
    left = len(groups_found) - taken
    if left < _LEAST_IN_GROUPS:
        return 1.0
    return float(np.sum(sums**2) / np.sum(z**2)) * len(groups_found) / left

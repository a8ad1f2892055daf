"""What one solve works on: what was measured, who measured it, and the adjustment of it with deviations that fit.

A device's deviation is sqrt(scale² stated² + excess²), and each of its observations weighs 1/design_effect of one.
Where residuals are less than stated, `scale` is below 1; where they are more, `excess` fills up: both so that the
median of |residual|/deviation is that of a normal error, 0.6745. The design effect (Kish 1965) is of errors that
neighbours share (blur, albedo, a print that is off): of n residuals that err independently, the square of a sum is on
average the sum of squares, and where neighbours err alike it is more, by as much as their number tells less than it
seems to. It is taken over cells of several sizes, and the worst counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board
from slrig.calibration.solving.adjustment import (
    OUTLYING,
    Deviations,
    Prior,
    Residuals,
    adjusted,
    residuals_of,
)
from slrig.calibration.solving.measurements import Measurements, groups
from slrig.calibration.solving.parameters import Geometry
from slrig.model import FloatArray, IntArray

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

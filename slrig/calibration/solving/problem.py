"""What one solve works on: what was measured, who measured it, and the adjustment of it with deviations that fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board
from slrig.calibration.solving.adjustment import Adjustment, Prior, Residuals, adjusted, residuals_of
from slrig.calibration.solving.deviations import DeviceNoise, deviations_of, noise_of, with_design_effect
from slrig.calibration.solving.measurements import Measurements
from slrig.calibration.solving.parameters import Geometry
from slrig.model import FloatArray

Terms = Mapping[str, tuple[str, ...]]


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


def free_of(problem: Problem, geometry: Geometry, terms: Terms, /) -> NDArray[np.bool_]:
    """(N,) bool over the whole vector: what may move."""
    chosen = [terms[name] for name in problem.devices]
    prior = problem.prior
    return geometry.layout.free(
        chosen, problem.used, bend=prior is not None, offsets=prior is not None and prior.offsets
    )


def with_terms(geometry: Geometry, problem: Problem, terms: Terms, /) -> Geometry:
    """The same geometry, those lens terms set to 0 that are not in `terms`, and of the shape what is not solved for."""
    devices = geometry.devices.copy()
    for device, name in enumerate(problem.devices):
        for k, term in enumerate(("k1", "k2", "p1", "p2", "k3")):
            if term not in terms[name]:
                devices[device, 4 + k] = 0.0
    bend = geometry.bend if problem.prior is not None else np.zeros_like(geometry.bend)
    keeps = problem.prior is not None and problem.prior.offsets
    offsets = geometry.offsets if keeps else np.zeros_like(geometry.offsets)
    return replace(geometry, devices=devices, offsets=offsets, bend=bend)


def fitted(
    problem: Problem, geometry: Geometry, terms: Terms, /, *, rounds: int = 4, correlated: bool = False,
    noise: Sequence[DeviceNoise] | None = None,
) -> Fit:  # fmt: skip
    """The geometry that fits, and deviations that fit it: in turns, since the weights need both.

    correlated : take into account that neighbours err alike. noise : what to start from; without it, the residuals
    tell.
    """
    geometry = with_terms(geometry, problem, terms)
    free = free_of(problem, geometry, terms)
    measurements = problem.measurements
    count = len(problem.devices)
    current = tuple(noise) if noise is not None else None
    made: Adjustment | None = None
    for turn in range(rounds):
        if current is None:
            current = tuple(noise_of(residuals_of(geometry, measurements), measurements, count, problem.with_projector))
        sigma = deviations_of(measurements, current, problem.with_projector)
        made = adjusted(geometry, measurements, free, sigma, prior=problem.prior)
        geometry = made.geometry
        before = current
        current = tuple(noise_of(made.residuals, measurements, count, problem.with_projector))
        if correlated:
            current = tuple(with_design_effect(current, geometry, made.residuals, measurements, problem.with_projector))
        if turn and _same(before, current):
            break
    if made is None or current is None:
        message = f"a fit takes at least one round, and {rounds} were asked for"
        raise ValueError(message)
    return Fit(geometry, made.residuals, current)


def _same(first: Sequence[DeviceNoise], second: Sequence[DeviceNoise]) -> bool:
    """Whether the weights are all but what they were."""
    for one, other in zip(first, second, strict=True):
        for a, b in (
            (one.scale, other.scale),
            (one.excess_px, other.excess_px),
            (one.design_effect, other.design_effect),
        ):
            if abs(a - b) > 0.02 * max(abs(a), abs(b)) + 1e-4:
                return False
    return True

"""The numbers that are told of a solved calibration: each with its standard deviation, its unit and what it means."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from slrig.calibrate.solving import CalibrationResult
from slrig.calibration import PARAMETERS, PROJECTOR, Board, BoardPose, DeviceResiduals
from slrig.calibration.poses import attitude
from slrig.model import LENS_TERMS, Calibration, FloatArray, Pinhole, Size

_INNER = PARAMETERS[:9]
_TURN = slice(9, 12)
_SHIFT = slice(12, 15)


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its standard deviation, which is 0 for a number that was held and not solved."""

    value: float
    sigma: float

    def shown(self, number: float) -> str:
        """A number with so many decimals that the deviation shows two digits, four if it is 0, and a true minus sign.

        >>> Figure(-1810.4, 0.213).shown(-1810.4), Figure(-0.12, 0.00031).shown(0.00031), Figure(842.0, 15.0).shown(15)
        ('−1810.40', '0.00031', '15')
        """
        digits = min(max(1 - math.floor(math.log10(self.sigma)), 0), 9) if self.sigma > 0 else 4
        return f"{number:.{digits}f}".replace("-", "−")


@dataclass(frozen=True, slots=True)
class DeviceFigures:
    """One device: what was solved of it, and what is left over.

    values : by the names of `PARAMETERS` that describe the lens, and of `terms` only; centre_mm : its centre of
    projection in the world, a figure for each of x, y, z.
    """

    name: str
    size: Size
    terms: tuple[str, ...]
    values: Mapping[str, Figure]
    centre_mm: tuple[Figure, Figure, Figure]
    residuals: DeviceResiduals

    @property
    def solved(self) -> Mapping[str, Figure]:
        """Its `values`, and where it is unless that was held."""
        placed = any(axis.sigma > 0 for axis in self.centre_mm)
        place = dict(zip(("x_mm", "y_mm", "z_mm"), self.centre_mm, strict=True))
        return {**self.values, **place} if placed else self.values

    @property
    def held_out_ratio(self) -> float:
        """The rms at poses that the solve had not seen over the rms at those that it had; NaN if there were too few."""
        return self.residuals.held_out_rms_px / self.residuals.rms_px if self.residuals.rms_px > 0 else math.nan


@dataclass(frozen=True, slots=True)
class Baseline:
    """Two devices: how far apart they are, and at what angle they look at the middle of the working volume."""

    first: str
    second: str
    length_mm: Figure
    angle_deg: Figure


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """One pose of the board: rms by device; its tilt against the first camera's line of sight, and its distance.

    `left_out` is the reason why it was, and empty for a pose that was used; figures that need its place are NaN then.
    """

    name: str
    rms_px: Mapping[str, float]
    tilt_deg: float
    distance_mm: float
    left_out: str


def device_figures(result: CalibrationResult) -> tuple[DeviceFigures, ...]:
    """Every device, cameras in order, then the projector."""
    found = []
    for name, device, place in _placed(result.calibration):
        covariance = result.solution.covariance[place, place]
        terms = tuple(term for term in LENS_TERMS if term in result.solution.distortion.get(name, ()))
        numbers = [device.matrix[0, 0], device.matrix[1, 1], device.matrix[0, 2], device.matrix[1, 2]]
        numbers += device.distortion.tolist()
        sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        values = {
            each: Figure(float(number), float(sigma))
            for each, number, sigma in zip(_INNER, numbers, sigmas, strict=False)
            if each not in LENS_TERMS or each in terms
        }
        x, y, z = (_propagated([device], covariance, partial(_centre_mm, axis)) for axis in range(3))
        found.append(DeviceFigures(name, device.size, terms, values, (x, y, z), result.solution.residuals[name]))
    return tuple(found)


def baselines(result: CalibrationResult) -> tuple[Baseline, ...]:
    """Every pair of devices, in the order of the devices."""
    middle = result.expected.volume_mm.mean(axis=0)
    found = []
    for (first, one, own), (second, other, its) in combinations(_placed(result.calibration), 2):
        rows = np.r_[own, its]
        shared = result.solution.covariance[np.ix_(rows, rows)]
        length = _propagated((one, other), shared, lambda pair: float(np.linalg.norm(pair[1][1] - pair[0][1])))
        angle = _propagated((one, other), shared, lambda pair: _angle_deg(pair, middle))
        found.append(Baseline(first, second, length, angle))
    return tuple(found)


def pose_figures(result: CalibrationResult, board: Board, names: Sequence[str]) -> tuple[PoseFigures, ...]:
    """Every pose of `names`, in their order, and then those that the result knows beside them."""
    solution = result.solution
    known = [*solution.poses, *solution.outliers]
    first = next(iter(result.calibration.cameras.values()))
    middle_mm = board.points_mm.mean(axis=0)
    found = []
    for name in dict.fromkeys([*(name for name in names if name in known), *known]):
        rms = {
            device: residuals.pose_rms_px[name]
            for device, residuals in solution.residuals.items()
            if name in residuals.pose_rms_px
        }
        tilt = distance = math.nan
        if (pose := solution.poses.get(name)) is not None:
            turned, moved_mm = first.rotation @ pose.rotation, first.rotation @ pose.translation_mm
            seen = attitude(BoardPose(turned, moved_mm + first.translation_mm), middle_mm)
            tilt, distance = seen.incidence_deg, seen.distance_mm
        found.append(PoseFigures(name, rms, tilt, distance, solution.outliers.get(name, "")))
    return tuple(found)


def named_devices(calibration: Calibration) -> Mapping[str, Pinhole]:
    """Every device by its name, cameras in order, then the projector."""
    projector = {} if calibration.projector is None else {PROJECTOR: calibration.projector}
    return {**calibration.cameras, **projector}


def _placed(calibration: Calibration) -> list[tuple[str, Pinhole, slice]]:
    """Each device with its rows in the covariance."""
    rows = len(PARAMETERS)
    named = named_devices(calibration).items()
    return [(name, device, slice(rows * at, rows * (at + 1))) for at, (name, device) in enumerate(named)]


Posed = tuple[FloatArray, FloatArray]
"""A device's rotation, world to device, and its centre in the world, mm."""


def _centre_mm(axis: int, devices: Sequence[Posed]) -> float:
    """One coordinate of the first device's centre in the world."""
    return float(devices[0][1][axis])


def _propagated(
    devices: Sequence[Pinhole], covariance: FloatArray, number: Callable[[Sequence[Posed]], float]
) -> Figure:
    """A number of devices' poses with its standard deviation: sqrt(J C Jᵀ), J by differences one deviation wide."""
    rows = len(PARAMETERS)
    value = number([_moved(device, np.zeros(rows)) for device in devices])
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    slopes = np.zeros(len(sigmas))
    for row in np.flatnonzero(sigmas):
        ends = []
        for step in (-sigmas[row], sigmas[row]):
            change = np.zeros((len(devices), rows))
            change.flat[row] = step
            ends.append(number([_moved(device, own) for device, own in zip(devices, change, strict=True)]))
        slopes[row] = (ends[1] - ends[0]) / (2 * sigmas[row])
    return Figure(value, math.sqrt(max(float(slopes @ covariance @ slopes), 0.0)))


def _moved(device: Pinhole, change: FloatArray) -> Posed:
    rotation = Rotation.from_rotvec(change[_TURN]).as_matrix() @ device.rotation
    return rotation, -rotation.T @ (device.translation_mm + change[_SHIFT])


def _angle_deg(pair: Sequence[Posed], middle_mm: FloatArray) -> float:
    one, other = (middle_mm - centre for _, centre in pair)
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other)))

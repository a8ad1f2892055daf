"""Whether a new calibration has the scale of an earlier one of the same rig: a wrong square size shows nowhere else."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.poses.coverage import device_title
from slrig.calibration.solution import PARAMETERS, PROJECTOR, Solution
from slrig.model import Calibration, FloatArray, Pinhole

_OFF = 0.01
_ALIKE = 0.005
_TURNED_DEG = 1.0
_SURE = 3.0
_SHIFT = slice(PARAMETERS.index("x_mm"), PARAMETERS.index("z_mm") + 1)


def check_scale(solution: Solution, earlier: Calibration, board: Board) -> tuple[str, ...]:
    """Return in words what is wrong with the scale, nothing where it is that of the earlier calibration.

    The distance of two devices is compared with what it was. All distances off by one ratio, by more than 1 % and more
    than their own uncertainty, while the devices look in the same directions: the board's squares are not as large as
    they were said to be. Off otherwise: the rig was rebuilt. Devices that are not in both are left out. Fewer than two
    in both have no distance, and that is said.
    """
    now, before = _devices(solution.calibration), _devices(earlier)
    common = [name for name in now if name in before]
    if len(common) < 2:
        shared = ", ".join(device_title(name) for name in common) or "no device"
        return (
            f"the scale is not checked: that takes two devices which the earlier calibration has too, found {shared}; "
            "measure the printed ruler of the board",
        )
    order = list(now)
    ratios: dict[tuple[str, str], float] = {}
    changed: list[str] = []
    turned = False
    for first, second in combinations(common, 2):
        new_mm, old_mm = _distance_mm(now, first, second), _distance_mm(before, first, second)
        if old_mm <= 0 or new_mm <= 0:
            continue
        ratio = new_mm / old_mm
        sigma = _sigma_mm(solution.covariance, order.index(first), order.index(second)) / old_mm
        if abs(ratio - 1) > max(_OFF, _SURE * sigma):
            ratios[first, second] = ratio
            changed.append(f"{device_title(first)} to {device_title(second)}: {new_mm:.1f} mm, before {old_mm:.1f} mm")
        angle = max(_angle_deg(now, before, first, second), _leaning_deg(now, before, first, second))
        turned = turned or angle > _TURNED_DEG
    if not ratios:
        return ()
    found = list(ratios.values())
    pairs = len(common) * (len(common) - 1) // 2
    told = "; ".join(changed)
    if len(ratios) == pairs and max(found) - min(found) < _ALIKE * min(found) and not turned:
        ratio = float(np.mean(found))
        side_mm = board.square_mm / ratio
        return (
            f"everything is {abs(ratio - 1):.1%} {'larger' if ratio > 1 else 'smaller'} than in the earlier "
            f"calibration ({told}): the board's squares measure {side_mm:.4g} mm instead of {board.square_mm:.4g} mm, "
            "or the rig was rebuilt; measure the printed ruler, and say the size that it has",
        )
    return (
        f"the devices do not stand as in the earlier calibration ({told}): the rig was rebuilt, or a device was "
        "bumped. If neither is so, measure the printed ruler of the board, and calibrate again",
    )


def _devices(calibration: Calibration) -> Mapping[str, Pinhole]:
    devices = dict(calibration.cameras)
    if calibration.projector is not None:
        devices[PROJECTOR] = calibration.projector
    return devices


def _distance_mm(devices: Mapping[str, Pinhole], first: str, second: str) -> float:
    return float(np.linalg.norm(devices[second].centre_mm - devices[first].centre_mm))


def _angle_deg(now: Mapping[str, Pinhole], before: Mapping[str, Pinhole], first: str, second: str) -> float:
    """Return by how much one device turned as the other sees it, degrees."""
    new = now[second].rotation @ now[first].rotation.T
    old = before[second].rotation @ before[first].rotation.T
    return float(np.degrees(np.arccos(np.clip((np.trace(new @ old.T) - 1) / 2, -1, 1))))


def _leaning_deg(now: Mapping[str, Pinhole], before: Mapping[str, Pinhole], first: str, second: str) -> float:
    """Return by how much the direction to one device changed as the other sees it, degrees."""
    ways = []
    for devices in (now, before):
        way = devices[first].rotation @ (devices[second].centre_mm - devices[first].centre_mm)
        ways.append(way / np.linalg.norm(way))
    return float(np.degrees(np.arccos(np.clip(ways[0] @ ways[1], -1, 1))))


def _sigma_mm(covariance: FloatArray, first: int, second: int) -> float:
    """Return a bound on the deviation of two devices' distance: that of both translations together."""
    each = len(PARAMETERS)
    places = [slice(each * index, each * (index + 1)) for index in (first, second)]
    blocks = [covariance[place, place] for place in places]
    return float(np.sqrt(sum(np.linalg.eigvalsh(block[_SHIFT, _SHIFT])[-1] for block in blocks)))

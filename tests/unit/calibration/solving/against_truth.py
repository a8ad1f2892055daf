"""A solved calibration against the true one: both in the first camera's frame, errors in the solve's own deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slrig.calibration.solution import PARAMETERS, PROJECTOR, Solution, scale_mode
from slrig.calibration.solving.projection import device_difference
from slrig.model import Calibration, FloatArray, Pinhole
from tests.unit.calibration.solving.test_projection import row_of


def in_first_camera(calibration: Calibration) -> Calibration:
    """The same devices in the first camera's frame."""
    camera = next(iter(calibration.cameras.values()))
    turn, shift = camera.rotation, camera.translation_mm

    def moved(device: Pinhole) -> Pinhole:
        rotation = device.rotation @ turn.T
        return replace(device, rotation=rotation, translation_mm=device.translation_mm - rotation @ shift)

    assert calibration.projector is not None
    return Calibration({name: moved(each) for name, each in calibration.cameras.items()}, moved(calibration.projector))


def rows_of(calibration: Calibration) -> FloatArray:
    """(d, 21): its cameras and its projector as kernels take them."""
    return np.array([row_of(one) for one in (*calibration.cameras.values(), calibration.projector) if one is not None])


def exact_covariance(solution: Solution) -> FloatArray:
    """What the solve states, but for the board's size, as if that were exact."""
    mode = solution.size.scale_sigma * scale_mode(solution.calibration)
    return np.asarray(solution.covariance - np.outer(mode, mode))


def in_deviations(solution: Solution, truth: Calibration, *, exact_board: bool = True) -> dict[str, float]:
    """Focal lengths, principal points, turns and baselines of all devices: error over its own stated deviation.

    exact_board : the board was as large as it was said to be, so that no deviation of its size explains anything.
    """
    stated = exact_covariance(solution) if exact_board else solution.covariance
    names = [*truth.cameras, *([PROJECTOR] if truth.projector else [])]
    rows = [rows_of(solution.calibration), rows_of(truth)]
    off = device_difference(*rows)
    found = {}
    for device, name in enumerate(names):
        own = slice(15 * device, 15 * device + 15)
        covariance = stated[own, own]
        for k, parameter in enumerate(PARAMETERS[:12]):
            if parameter[0] in "fct" and covariance[k, k] > 0:
                found[f"{name} {parameter}"] = float(off[device, k] / np.sqrt(covariance[k, k]))
        if device:
            shift = rows[1][device, 18:]
            along = shift / np.linalg.norm(shift)
            baseline = float(np.linalg.norm(rows[0][device, 18:]) - np.linalg.norm(shift))
            found[f"{name} baseline"] = baseline / float(np.sqrt(along @ covariance[12:, 12:] @ along))
    return found

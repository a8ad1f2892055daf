"""Hand-eye calibration beside OpenCV's methods: errors over seeds, and how many are within what is stated.

    pip install --no-deps --target cv4 opencv-python-headless==4.12.0.88
    PYTHONPATH=cv4 pytest -m slow tests/bench/test_hand_eye.py -s

OpenCV 5.0 lost both functions. Seeds: SLRIG_SEEDS (40) of each kind, 12 poses, robot noise 0.1 mm and 0.02° per
coordinate, board noise and motions of `tests.unit.calibration.robot_cells`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.calibration.hand_eye import HandEyeKind, solve_hand_eye
from slrig.model import FloatArray
from tests.unit.calibration.robot_cells import RobotCell, cell, error_of

SEEDS = int(os.environ.get("SLRIG_SEEDS") or 40)
AX_XB = {
    "Tsai": cv2.CALIB_HAND_EYE_TSAI,
    "Park": cv2.CALIB_HAND_EYE_PARK,
    "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
AX_ZB = {"Shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "Li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}


def parts(poses: FloatArray) -> tuple[list[FloatArray], list[FloatArray]]:
    return [each[:3, :3] for each in poses], [each[:3, 3] for each in poses]


def matrix(turn: FloatArray, place: FloatArray) -> FloatArray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = turn, np.ravel(place)
    return made


def by_opencv(made: RobotCell, method: str) -> FloatArray:
    # A fixed rig is one in hand with the robot's poses inverted.
    fixed = made.kind is HandEyeKind.FIXED
    flange: FloatArray = np.asarray(np.linalg.inv(made.robot.poses) if fixed else made.robot.poses)
    opencv: Any = cv2
    if method in AX_XB:
        return matrix(*opencv.calibrateHandEye(*parts(flange), *parts(made.seen.poses), method=AX_XB[method]))
    inverse = np.asarray(np.linalg.inv(flange))
    found = opencv.calibrateRobotWorldHandEye(*parts(made.seen.poses), *parts(inverse), method=AX_ZB[method])
    return np.asarray(np.linalg.inv(matrix(found[2], found[3])))


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="OpenCV 5.0 has no calibrateHandEye: see above")
@pytest.mark.parametrize("kind", list(HandEyeKind))
def test_errors_beside_opencv(kind: HandEyeKind) -> None:
    cells = [cell(kind, seed) for seed in range(SEEDS)]
    ours = [solve_hand_eye(each.robot, each.seen, kind) for each in cells]
    ways: dict[str, Callable[[int], FloatArray]] = {"slrig": lambda at: ours[at].rig}
    for method in (*AX_XB, *AX_ZB):
        ways[method] = lambda at, method=method: by_opencv(cells[at], method)  # type: ignore[misc]
    rms = {}
    for name, way in ways.items():
        errors = np.array([error_of(way(at), each.rig) for at, each in enumerate(cells)])
        rms[name] = float(np.sqrt((errors[:, 3:] ** 2).sum(axis=1).mean()))
        degrees = np.degrees(np.sqrt((errors[:, :3] ** 2).sum(axis=1).mean()))
        print(f"{kind:8} {name:11} {rms[name]:8.4f} mm {degrees:8.4f}°")  # noqa: T201
    ratios = np.array([
        np.abs(error_of(found.rig, each.rig)) / np.sqrt(np.diagonal(found.rig_covariance))
        for found, each in zip(ours, cells, strict=True)
    ])  # fmt: skip
    print(f"{kind:8} within stated {np.mean(ratios < 1):.1%}, within twice {np.mean(ratios < 2):.1%}")  # noqa: T201
    assert rms["slrig"] <= 1.02 * min(rms.values())

"""A robot with a rig and a board, with rotations by Rodrigues' formula: independent of the code under test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from slrig.calibration.hand_eye import HandEyeKind, RobotPoses, TargetPoses
from slrig.model import FloatArray, Mesh

NOISE = (0.1, 0.02)
"""Of the robot: mm and degrees."""
BOARD_SIGMA = [*np.radians([0.01, 0.01, 0.004]), 0.01, 0.01, 0.03]
SPHERE_SIGMA = [0.005, 0.005, 0.015]


def pose(turn_deg: FloatArray | list[float], place_mm: FloatArray | list[float]) -> FloatArray:
    """(4, 4) of a rotation vector, degrees, and a place."""
    vector = np.radians(np.asarray(turn_deg, dtype=np.float64))
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle > 0 else vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    matrix[:3, 3] = place_mm
    return matrix


def error_of(found: FloatArray, true: FloatArray) -> FloatArray:
    """(6,): small turn (rad) and shift (mm) from the true pose to the found one."""
    turn = found[:3, :3] @ true[:3, :3].T
    vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([vector, found[:3, 3] - true[:3, 3]])


@dataclass
class RobotCell:
    """rig : in flange or base; target : in base or flange; robot and seen : what both measured; shown : the target in
    the rig, as it was.
    """

    kind: HandEyeKind
    rig: FloatArray
    target: FloatArray
    robot: RobotPoses
    seen: TargetPoses
    shown: FloatArray


def cell(
    kind: HandEyeKind,
    seed: int,
    *,
    count: int = 12,
    turns_deg: tuple[float, float, float] = (30.0, 30.0, 60.0),
    sphere: bool = False,
    spread_mm: float = 60.0,
    place_mm: tuple[float, float, float] = (0.0, 0.0, 400.0),
) -> RobotCell:
    """Poses in which the target is turned by up to `turns_deg` about each axis of the rig, and lies up to `spread_mm`
    each way from a place before it.
    """
    random = np.random.default_rng(seed)
    in_hand = kind is HandEyeKind.IN_HAND
    rig = (
        pose([4.0, -7.0, 88.0], [35.0, -60.0, 110.0]) if in_hand else pose([-100.0, 20.0, 15.0], [900.0, 250.0, 640.0])
    )
    target = (
        pose([178.0, 5.0, 10.0], [620.0, -140.0, 35.0]) if in_hand else pose([10.0, 80.0, 3.0], [20.0, -30.0, 95.0])
    )
    sigma = np.array(SPHERE_SIGMA if sphere else BOARD_SIGMA)
    robot, seen, true = [], [], []
    for _ in range(count):
        shown = pose(random.uniform(-1, 1, 3) * turns_deg, place_mm + spread_mm * random.uniform(-1, 1, 3))
        at = target @ np.linalg.inv(shown) @ np.linalg.inv(rig) if in_hand else rig @ shown @ np.linalg.inv(target)
        told = pose(random.normal(0, NOISE[1], 3), [0, 0, 0]) @ at
        told[:3, 3] = at[:3, 3] + random.normal(0, NOISE[0], 3)
        error = random.normal(size=len(sigma)) * sigma
        turn = [0.0, 0.0, 0.0] if sphere else np.degrees(error[:3])
        measured = pose(turn, [0, 0, 0]) @ shown
        measured[:3, 3] = shown[:3, 3] + error[-3:]
        if sphere:
            measured[:3, :3] = np.eye(3)
        true.append(shown)
        robot.append(told)
        seen.append(measured)
    names = tuple(f"{number:02}" for number in range(1, count + 1))
    covariance = np.diag(np.tile(sigma**2, count))
    return RobotCell(
        kind, rig, target, RobotPoses(names, np.array(robot)), TargetPoses(names, np.array(seen), covariance),
        np.array(true),
    )  # fmt: skip


def sphere_mesh(centre_mm: FloatArray, diameter_mm: float, seed: int) -> Mesh:
    """What a scan has of a sphere: the side that faces the rig, with noise."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    outwards = ball.vertices[ball.vertices[:, 2] < -0.25]
    count = len(outwards)
    noise = np.random.default_rng(seed).normal(0, 0.01, (count, 1))
    return Mesh(
        vertices_mm=(centre_mm + outwards * (diameter_mm / 2 + noise)).astype(np.float32),
        faces=np.zeros((1, 3), dtype=np.int32),
        normals=outwards.astype(np.float32),
        colour=np.zeros((count, 3), dtype=np.uint8),
        mark=np.zeros(count, dtype=np.uint8),
        sigma_mm=np.full(count, 0.01, dtype=np.float32),
        stripe=np.zeros(count, dtype=np.int32),
    )

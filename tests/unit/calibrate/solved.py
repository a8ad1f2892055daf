"""A solved calibration made by hand: a camera and a lens-shifted projector before twenty poses, one of them bumped.

Nothing here was solved. Corners are projected by OpenCV, noise is drawn, and the covariance says what noise of that
size would leave; what a report or a table tells of it can be held against these numbers.
"""

from __future__ import annotations

import cv2
import numpy as np

from slrig.calibrate.store import CalibrationResult, ReadPose
from slrig.calibration.accuracy import OddEven
from slrig.calibration.board import Board, BoardKind, BoardView, Correspondences, PoseObservation, ViewQuality
from slrig.calibration.judgement import judge_calibration
from slrig.calibration.poses.guidance import coverage
from slrig.calibration.solution import (
    CELLS,
    PARAMETERS,
    PROJECTOR,
    BoardPose,
    Bow,
    DeviceResiduals,
    ExpectedError,
    RigidMotion,
    Solution,
)
from slrig.model import Calibration, FloatArray, Pinhole, Size, SolveRecord

BOARD = Board(BoardKind.CHESSBOARD, 11, 8, 12.0)
BUMPED = "pose_07"
BUMP = "left moved by 1.9 px between this pose and the others; shoot it again and leave the camera alone"
POSES = tuple(f"pose_{number:02d}" for number in range(20))
NOISE_PX = {"left": 0.045, PROJECTOR: 0.08}
CALIBRATION_ID = "3f6c1f6e-9f0e-4c57-8a39-5f8a4f0c2b11"
SOLVED_AT = "2026-11-22T09:30:00+01:00"

HALVES = OddEven((10, 9), 0.0171, 0.0193, 0.52, RigidMotion(0.0021, 0.0345))
"""What its odd poses say otherwise than its even ones."""

_DEVIATIONS = {
    "left": (0.21, 0.22, 0.31, 0.28, 3e-4, 2e-3, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0),
    PROJECTOR: (0.35, 0.36, 0.52, 0.61, 5e-4, 0.0, 0.0, 0.0, 0.0, 2e-4, 2.4e-4, 9e-5, 0.011, 0.013, 0.055),
}


def _turned(*, about_x: float, about_y: float, about_z: float) -> FloatArray:
    parts = [cv2.Rodrigues(np.radians(angles))[0] for angles in np.diag([about_x, about_y, about_z])]
    return np.asarray(parts[2] @ parts[1] @ parts[0], dtype=np.float64)


def devices() -> dict[str, Pinhole]:
    """The rig: the camera in the world's frame, the projector next to it with its principal point below its image."""
    turned = _turned(about_x=0.0, about_y=-15.0, about_z=0.3)
    return {
        "left": Pinhole(
            Size(1280, 1024),
            np.array([[1810.4, 0.0, 641.2], [0.0, 1811.0, 509.7], [0.0, 0.0, 1.0]]),
            np.array([-0.121, 0.093, 0.0, 0.0, 0.0]),
            np.eye(3),
            np.zeros(3),
        ),
        PROJECTOR: Pinhole(
            Size(1280, 800),
            np.array([[1602.7, 0.0, 638.1], [0.0, 1603.3, 842.4], [0.0, 0.0, 1.0]]),
            np.array([-0.034, 0.0, 0.0, 0.0, 0.0]),
            turned,
            -turned @ np.array([-148.2, 121.6, 6.4]),
        ),
    }


def board_poses() -> dict[str, BoardPose]:
    """Where the board stood: tilts to 38 degrees about both axes, 430 to 590 mm away."""
    rng = np.random.default_rng(20261122)
    poses = {}
    for number, name in enumerate(POSES):
        around = 2.4 * number
        tilt = 14.0 + 24.0 * (number % 4) / 3
        rotation = _turned(
            about_x=tilt * np.cos(around), about_y=tilt * np.sin(around), about_z=float(rng.uniform(-40, 40))
        )
        middle = np.array([75.0 * np.cos(1.7 * number), 52.0 * np.sin(1.7 * number), 430.0 + 80.0 * (number % 3)])
        poses[name] = BoardPose(rotation, middle - rotation @ BOARD.points_mm.mean(axis=0))
    return poses


def projected(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: where a device sees points of the world, by OpenCV."""
    turn = cv2.Rodrigues(device.rotation)[0]
    pixels = cv2.projectPoints(points_mm, turn, device.translation_mm, device.matrix, device.distortion)[0]
    return np.asarray(pixels[:, 0], dtype=np.float64)


def read_poses() -> dict[str, ReadPose]:
    """What was read of each pose: corners with noise, a hundred points of light, and figures of the view."""
    rng = np.random.default_rng(7)
    rig = devices()
    poses = {}
    for number, (name, pose) in enumerate(board_poses().items()):
        world = BOARD.points_mm @ pose.rotation.T + pose.translation_mm
        pixels = projected(rig["left"], world)
        lit = projected(rig[PROJECTOR], world)
        seen = np.flatnonzero(((pixels >= 0) & (pixels <= [1279, 1023])).all(axis=1)).astype(np.int32)
        noisy = pixels[seen] + rng.normal(0, NOISE_PX["left"] / np.sqrt(2), (len(seen), 2))
        light = Correspondences(
            np.repeat(pixels[seen], 2, axis=0),
            np.tile(np.array([0, 1], dtype=np.uint8), len(seen)),
            lit[seen].ravel(),
            np.full(2 * len(seen), NOISE_PX[PROJECTOR]),
        )
        observation = PoseObservation(name, {"left": BoardView(seen, noisy, np.full(len(seen), 0.03))}, {"left": light})
        figures = ViewQuality(
            moved_px=0.01 + 0.002 * number,
            saturated=0.001,
            contrast=0.62,
            sharpness_px=1.1 + 0.02 * number,
            decoded=0.97,
        )
        poses[name] = ReadPose(observation, {"left": figures})
    return poses


def _residuals(device: str, seed: int) -> DeviceResiduals:
    rng = np.random.default_rng(seed)
    count = rng.integers(20, 90, (CELLS, CELLS)).astype(np.int32)
    count[0, 5] = 0
    spread = NOISE_PX[device] * (1 + 0.25 * rng.random((CELLS, CELLS)))
    unseen = count == 0
    mean = rng.normal(0, NOISE_PX[device] / 6, (CELLS, CELLS, 2))
    used = [name for name in POSES if name != BUMPED]
    return DeviceResiduals(
        rms_px=float(np.sqrt((spread[~unseen] ** 2 * count[~unseen]).sum() / count.sum())),
        stated_rms_px=NOISE_PX[device] * 0.93,
        held_out_rms_px=NOISE_PX[device] * 1.24,
        count=int(count.sum()),
        outlying=14,
        pose_rms_px={name: float(NOISE_PX[device] * rng.uniform(0.9, 1.4)) for name in used},
        map_rms_px=np.where(unseen, np.nan, spread),
        map_mean_px=np.where(unseen[..., None], np.nan, mean),
        map_count=count,
    )


def _expected() -> ExpectedError:
    volume = np.array([[-130.0, -95.0, 400.0], [130.0, 95.0, 620.0]])
    axes = [np.linspace(least, most, count) for least, most, count in zip(*volume, (9, 7, 5), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    off = np.hypot(grid[:, 0] / 130, grid[:, 1] / 95)
    point = 0.006 + 0.005 * off**2 + 0.004 * ((grid[:, 2] - 510) / 110) ** 2
    return ExpectedError(
        volume_mm=volume,
        point_mm=float(np.sqrt(np.mean(point**2))),
        noise_mm=0.0113,
        total_mm=float(np.sqrt(np.mean(point**2) + 0.0113**2)),
        length_share=2.9e-5,
        grid_mm=grid,
        grid_point_mm=point,
    )


def solved_result() -> CalibrationResult:
    """The result: nineteen poses used, one left out with its reason."""
    rig = devices()
    expected = _expected()
    deviations = np.concatenate([_DEVIATIONS["left"], _DEVIATIONS[PROJECTOR]])
    assert len(deviations) == 2 * len(PARAMETERS)
    covariance = np.diag(deviations**2).astype(np.float64)
    solved = SolveRecord(CALIBRATION_ID, SOLVED_AT, covariance, expected.volume_mm, expected.point_mm)
    calibration = Calibration({"left": rig["left"]}, rig[PROJECTOR], solved)
    solution = Solution(
        calibration=Calibration({"left": rig["left"]}, rig[PROJECTOR]),
        covariance=covariance,
        distortion={"left": ("k1", "k2"), PROJECTOR: ("k1",)},
        poses={name: pose for name, pose in board_poses().items() if name != BUMPED},
        outliers={BUMPED: BUMP},
        residuals={"left": _residuals("left", 3), PROJECTOR: _residuals(PROJECTOR, 4)},
        bow=Bow(0.031, 0.012, solved=False),
    )
    sizes = {"left": rig["left"].size, PROJECTOR: rig[PROJECTOR].size}
    used = [pose.observation for name, pose in read_poses().items() if name != BUMPED]
    covered = coverage(used, BOARD, sizes)
    judged = judge_calibration(solution, expected, covered, HALVES, board=BOARD)
    return CalibrationResult(solution, calibration, expected, judged, covered, HALVES)

"""A rig of pinholes with lens distortion, and the poses of a board before it, made with OpenCV's own projection."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from slrig.calibration.board import Board, BoardKind, PoseObservation, ViewQuality
from slrig.calibration.solution import PROJECTOR, BoardPose
from slrig.model import Calibration, FloatArray, Pinhole, Size
from tests.unit.calibration.synthetic import CHESSBOARD as CHESSBOARD
from tests.unit.calibration.synthetic import Recipe, observed

CHARUCO = Board(BoardKind.CHARUCO, 11, 8, 12.0)
SHARP = ViewQuality(moved_px=0.02, saturated=0.0, contrast=0.5, sharpness_px=0.8, decoded=0.9)


def looking(
    position_mm: tuple[float, float, float], *, target_mm: tuple[float, float, float] = (0, 0, 600)
) -> BoardPose:
    """The pose (world to device) of a device at a position that looks at a target, its columns downwards."""
    ahead = np.subtract(target_mm, position_mm) / np.linalg.norm(np.subtract(target_mm, position_mm))
    across = np.cross([0.0, 1.0, 0.0], ahead)
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(ahead, across), ahead])
    return BoardPose(rotation, -rotation @ np.asarray(position_mm, dtype=np.float64))


def device(
    size: Size, focal_px: float, principal_px: tuple[float, float], distortion: tuple[float, ...], pose: BoardPose
) -> Pinhole:
    matrix = np.array([[focal_px, 0, principal_px[0]], [0, 1.001 * focal_px, principal_px[1]], [0, 0, 1]])
    return Pinhole(size, matrix, np.array(distortion), pose.rotation, pose.translation_mm)


def two_cameras_and_projector() -> dict[str, Pinhole]:
    """The left camera is the world; the projector's principal point lies below its image."""
    size = Size(1280, 1024)
    upright = BoardPose(np.eye(3), np.zeros(3))
    return {
        "left": device(size, 2100.0, (650.0, 500.0), (-0.11, 0.15, -3e-4, 5e-4, 0.0), upright),
        "right": device(size, 2080.0, (630.0, 520.0), (-0.09, 0.10, 2e-4, -4e-4, 0.0), looking((170.0, 5.0, 20.0))),
        PROJECTOR: device(
            Size(1024, 768), 1700.0, (510.0, 860.0), (0.03, -0.02, 3e-4, 0.0, 0.0),
            looking((80.0, 160.0, 0.0), target_mm=(80.0, 160.0, 600.0)),
        ),
    }  # fmt: skip


def turned(about_x_deg: float, about_y_deg: float, in_plane_deg: float) -> FloatArray:
    """A board's rotation: in its plane first, then about the camera's y, then about its x."""
    rotation = np.eye(3)
    for axis, angle in ((2, in_plane_deg), (1, about_y_deg), (0, about_x_deg)):
        vector = np.zeros(3)
        vector[axis] = np.radians(angle)
        rotation = cv2.Rodrigues(vector)[0] @ rotation
    return np.asarray(rotation, dtype=np.float64)


def held(
    board: Board,
    *,
    tilt: tuple[float, float] = (0.0, 0.0),
    in_plane_deg: float = 0.0,
    middle_mm: tuple[float, float, float] = (0.0, 0.0, 600.0),
) -> BoardPose:
    """The board with its middle at a place in the world, tilted about the world's x and y."""
    rotation = turned(*tilt, in_plane_deg)
    return BoardPose(rotation, np.asarray(middle_mm, dtype=np.float64) - rotation @ board.points_mm.mean(axis=0))


@dataclass
class Shooting:
    """Shoots poses of a board with a rig of known devices. A chessboard is seen whole or not at all."""

    board: Board
    devices: dict[str, Pinhole]
    sigma_px: float = 0.05
    seed: int = 1
    random: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.random = np.random.default_rng(self.seed)

    @property
    def sizes(self) -> dict[str, Size]:
        return {name: each.size for name, each in self.devices.items()}

    def shot(self, name: str, pose: BoardPose) -> PoseObservation:
        cameras = {name: each for name, each in self.devices.items() if name != PROJECTOR}
        recipe = Recipe(board=self.board, corner_px=self.sigma_px, match_px=0.1, alike_px=0.0, outlying=0.0, side=50)
        rig = Calibration(cameras, self.devices.get(PROJECTOR))
        found = observed(recipe, rig, (pose.rotation, pose.translation_mm), self.random)
        count = 20 if self.board.kind is BoardKind.CHARUCO else self.board.corner_count
        views = {camera: view for camera, view in found.views.items() if len(view.corner) >= count}
        light = {camera: each for camera, each in found.correspondences.items() if camera in views}
        return PoseObservation(name, views, light)


def first_poses(board: Board) -> list[BoardPose]:
    """What a person begins with: three poses in the middle."""
    return [
        held(board),
        held(board, tilt=(20.0, 0.0), middle_mm=(10.0, 5.0, 590.0)),
        held(board, tilt=(0.0, -20.0), middle_mm=(-10.0, 0.0, 610.0)),
    ]

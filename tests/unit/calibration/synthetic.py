"""Observations of a made-up rig, projected by OpenCV (which shares no code with the solve), and their truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from slrig.calibration.board import (
    COLUMN,
    ROW,
    Board,
    BoardKind,
    BoardView,
    Correspondences,
    Observations,
    PoseObservation,
)
from slrig.calibration.solution import PROJECTOR
from slrig.model import Calibration, FloatArray, Pinhole, Size

CHESSBOARD = Board(BoardKind.CHESSBOARD, 11, 8, 12.0)
_FIELD = 64


@dataclass(frozen=True)
class Recipe:
    """What to make. Noise in px: corner_px white; match_px white; alike_px of an error that neighbours share, over a
    twentieth of the board; outlying : the share of light that is off by up to 40 px; stated_share : stated deviations
    over true ones. side : lit places along each side of the board. bumped : a device, and the first pose after its
    bump; moved_pose : one in which the board moves between the cameras. flipped : views counted from the other end.
    bow_mm : the board's bow at its far ends. stretched : how many times as wide and as high the print is as it says.
    """

    seed: int = 0
    poses: int = 20
    cameras: int = 1
    projector: bool = True
    corner_px: float = 0.05
    match_px: float = 0.05
    alike_px: float = 0.03
    outlying: float = 0.01
    most_tilt_deg: float = 35.0
    side: int = 60
    distorted: bool = True
    lens_shift: bool = True
    board: Board = CHESSBOARD
    stated_share: float = 1.0
    bumped: tuple[str, int] | None = None
    bump_mm: float = 1.0
    moved_pose: int | None = None
    flipped: tuple[tuple[str, int], ...] = ()
    offsets_mm: FloatArray | None = None
    stretched: tuple[float, float] = (1.0, 1.0)
    bow_mm: float = 0.0


def pinhole(
    size: Size, focal: float, centre: tuple[float, float], lens: list[float], turn: list[float], seat: list[float]
) -> Pinhole:
    """A device at a seat in the world, mm, its axes turned by a rotation vector."""
    rotation = np.asarray(cv2.Rodrigues(np.array(turn))[0], dtype=np.float64)
    matrix = np.array([[focal, 0.0, centre[0]], [0.0, focal * 1.002, centre[1]], [0.0, 0.0, 1.0]])
    return Pinhole(size, matrix, np.array(lens), rotation, -rotation @ np.array(seat))


def rig(recipe: Recipe) -> Calibration:
    """The true rig: one camera or two, a projector beside them whose image may be shifted out of its lens's axis."""
    lens = [-0.12, 0.09, 0.0006, -0.0004, 0.0] if recipe.distorted else [0.0] * 5
    other = [-0.1, 0.05, -0.0005, 0.0003, 0.0] if recipe.distorted else [0.0] * 5
    light = [-0.06, 0.03, 0.0004, 0.0002, 0.0] if recipe.distorted else [0.0] * 5
    size = Size(1280, 1024)
    cameras = {
        "left": Pinhole(
            size, np.array([[1650.0, 0, 652.0], [0, 1653.0, 505.0], [0, 0, 1]]), np.array(lens), np.eye(3), np.zeros(3)
        )
    }
    if recipe.cameras > 1:
        cameras["right"] = pinhole(size, 1630.0, (630.0, 520.0), other, [0.02, 0.36, 0.01], [180.0, 5.0, 20.0])
    if recipe.cameras > 2:
        cameras["far"] = pinhole(size, 1600.0, (650.0, 500.0), other, [-0.31, 0.02, 0.01], [10.0, 160.0, 10.0])
    projector = None
    if recipe.projector:
        centre = (520.0, 865.0) if recipe.lens_shift else (515.0, 380.0)
        turn = [0.19, 0.2, 0.0] if recipe.lens_shift else [-0.04, 0.22, 0.01]
        seat = [100.0, 60.0, 10.0] if recipe.lens_shift else [110.0, -20.0, 10.0]
        projector = pinhole(Size(1024, 768), 1500.0, centre, light, turn, seat)
    return Calibration(cameras, projector)


def board_poses(recipe: Recipe, rng: np.random.Generator) -> list[tuple[FloatArray, FloatArray]]:
    """Rotation (3, 3) and translation (3,) of each pose, board to world: all over the first camera's image."""
    points = recipe.board.points_mm
    middle = points.mean(axis=0)
    poses = []
    for number in range(recipe.poses):
        angle = 2 * np.pi * number / recipe.poses * 2.618
        tilt = np.radians(recipe.most_tilt_deg) * np.sqrt(rng.uniform(0.15, 1.0))
        upright = np.array([[0.0, 0.0, rng.uniform(-0.3, 0.3)]])
        turn = np.asarray(cv2.Rodrigues(np.array([np.cos(angle), np.sin(angle), 0.0]) * tilt)[0])
        rotation = turn @ np.asarray(cv2.Rodrigues(upright)[0])
        place = np.array([rng.uniform(-70, 70), rng.uniform(-50, 50), rng.uniform(430, 560)])
        poses.append((rotation, place - rotation @ middle))
    return poses


def seen(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: pixels of world points, by OpenCV."""
    turn = cv2.Rodrigues(device.rotation)[0]
    pixels = cv2.projectPoints(points_mm, turn, device.translation_mm, device.matrix, device.distortion)[0]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def inside(pixels: FloatArray, size: Size) -> NDArray[np.bool_]:
    """(n,) bool: pixels in the image."""
    return np.asarray(((pixels > 2) & (pixels < np.array([size.width_px - 3, size.height_px - 3]))).all(axis=1))


def made(recipe: Recipe, truth: Calibration | None = None) -> tuple[Observations, Calibration]:
    """Observations of the true rig, and that rig: of the recipe, unless another one is given."""
    rng = np.random.default_rng(recipe.seed)
    truth = rig(recipe) if truth is None else truth
    poses = [observed(recipe, truth, pose, rng, number) for number, pose in enumerate(board_poses(recipe, rng))]
    sizes = {name: camera.size for name, camera in truth.cameras.items()}
    beam = truth.projector.size if truth.projector is not None else None
    return Observations(recipe.board, sizes, beam, tuple(poses)), truth


def observed(
    recipe: Recipe, truth: Calibration, pose: tuple[FloatArray, FloatArray], rng: np.random.Generator, number: int = 0
) -> PoseObservation:
    """What the rig sees of the board in one pose, board to world."""
    rotation, shift = pose
    corners = recipe.board.points_mm * [*recipe.stretched, 1.0]
    if recipe.offsets_mm is not None:
        corners += recipe.offsets_mm
    views, light = {}, {}
    for name, camera in truth.cameras.items():
        device = _after_bump(camera, recipe, name, number)
        moved = np.array([0.4, 0.0, 0.0]) if recipe.moved_pose == number and name != "left" else np.zeros(3)
        pixels = seen(device, _bowed(corners, recipe) @ rotation.T + shift + moved)
        good = inside(pixels, camera.size)
        if good.sum() < 20:
            continue
        corner = np.flatnonzero(good).astype(np.int32)
        noisy = pixels[good] + rng.normal(0, recipe.corner_px, (len(corner), 2))
        if (name, number) in recipe.flipped:
            corner, noisy = (recipe.board.corner_count - 1 - corner)[::-1].copy(), noisy[::-1].copy()
        sigma = np.full(len(corner), max(recipe.corner_px, 1e-4) * recipe.stated_share)
        views[name] = BoardView(corner, noisy, sigma)
        if truth.projector is not None:
            lamp = _after_bump(truth.projector, recipe, PROJECTOR, number)
            light[name] = _light(recipe, rng, device, lamp, rotation, shift)
    return PoseObservation(f"pose {number}", views, light)


def _bowed(points: FloatArray, recipe: Recipe) -> FloatArray:
    least, most = recipe.board.points_mm[0], recipe.board.points_mm[-1]
    middle, half = (least + most) / 2, float((most - least).max()) / 2
    bowed = points.copy()
    bowed[:, 2] += recipe.bow_mm * ((points[:, 0] - middle[0]) / half) ** 2
    return bowed


def _after_bump(device: Pinhole, recipe: Recipe, name: str, number: int) -> Pinhole:
    if recipe.bumped is None or recipe.bumped[0] != name or number < recipe.bumped[1]:
        return device
    turn = np.asarray(cv2.Rodrigues(np.array([0.001, -0.002, 0.001]) * recipe.bump_mm)[0])
    shift = device.translation_mm + np.array([0.5, 0.2, 0.1]) * recipe.bump_mm
    return Pinhole(device.size, device.matrix, device.distortion, turn @ device.rotation, shift)


def _light(
    recipe: Recipe, rng: np.random.Generator, camera: Pinhole, projector: Pinhole, rotation: FloatArray,
    shift: FloatArray,
) -> Correspondences:  # fmt: skip
    (left, top), (right, bottom) = recipe.board.print_mm
    x, y = np.meshgrid(np.linspace(left, right, recipe.side), np.linspace(top, bottom, recipe.side))
    flat = _bowed(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), recipe)
    points = flat @ rotation.T + shift
    pixels, positions = seen(camera, points), seen(projector, points)
    good = inside(pixels, camera.size) & inside(positions, projector.size)
    parts = []
    for axis in (COLUMN, ROW):
        cloud = gaussian_filter(rng.normal(size=(_FIELD, _FIELD)), _FIELD / 40, mode="wrap")
        cloud *= recipe.alike_px / cloud.std()
        extent = np.array([right - left, bottom - top]) + 1e-9
        cell = np.floor((flat[:, :2] - [left, top]) / extent * _FIELD).astype(int)
        shown = positions[:, axis] + rng.normal(0, recipe.match_px, len(flat)) + cloud[cell[:, 1], cell[:, 0]]
        wrong = rng.random(len(flat)) < recipe.outlying
        shown = np.where(wrong, shown + rng.uniform(-40, 40, len(flat)), shown)
        parts.append((pixels[good], np.full(good.sum(), axis, np.uint8), shown[good]))
    count = sum(len(part[1]) for part in parts)
    return Correspondences(
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
        np.concatenate([part[2] for part in parts]),
        np.full(count, max(recipe.match_px, 1e-4) * recipe.stated_share),
    )

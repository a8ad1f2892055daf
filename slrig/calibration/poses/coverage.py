"""What the poses so far cover: the image of each device, depths, tilts and turns, and which goals are still open."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.observations import PoseObservation
from slrig.calibration.poses.rough import RigGuess, rig_guess
from slrig.calibration.solution import CELLS, PROJECTOR, BoardPose, device_title
from slrig.model import FloatArray, IntArray, Size

BoolArray = NDArray[np.bool_]

FOCAL_KNOWN = 0.15
"""Distances are told once the focal length is known to this share; before, they are NaN."""

_FEWEST_LIT = 3


@dataclass(frozen=True, slots=True)
class Goals:
    """What a good set of poses has (usual in practice; the numbers marked * are ours).

    cell_share : of the 36 cells of an image, with a corner (the projector: with light on the board) in some pose.
    depths : different distances, each at least depth_step* (a share) from the next. tilt_deg : which tilts count;
    tilted* : poses wanted about each of the two axes. turns : different angles in the board's plane, turn_step_deg*
    apart. fewest*, most : poses. sigma_px* : how well a corner's place must be told in the worst cell.
    """

    cell_share: float = 0.8
    depths: int = 3
    depth_step: float = 0.05
    tilt_deg: tuple[float, float] = (15.0, 45.0)
    tilted: int = 2
    turns: int = 3
    turn_step_deg: float = 20.0
    fewest: int = 12
    most: int = 30
    sigma_px: float = 0.05


GOALS = Goals()


@dataclass(frozen=True, slots=True)
class Attitude:
    """How the board stood before one device.

    tilt_deg : (about the picture's horizontal axis, about its vertical one); positive where the top edge, or the right
    edge, was the nearer one. turn_deg : in its plane, clockwise in the picture. distance_mm : from the device to the
    board's middle along the optical axis. steep_deg : between the board's normal and the line of sight.
    """

    tilt_deg: tuple[float, float]
    turn_deg: float
    distance_mm: float
    steep_deg: float


@dataclass(frozen=True, slots=True)
class DeviceCoverage:
    """What one device has seen of the board, or lit.

    cells : (6, 6) int32, in how many poses the cell held a corner (the projector: at least three lit samples).
    reachable : (6, 6) bool, the cells that a board can be seen in at all: of a projector, those that some camera sees.
    attitudes : by pose. depths, turns : different ones. tilted : poses tilted as wanted about the horizontal and about
    the vertical axis of the picture. distance_mm : least and greatest, NaN while the focal length is not known.
    share : of the reachable cells, those that are covered.
    """

    cells: IntArray
    reachable: BoolArray
    attitudes: Mapping[str, Attitude]
    depths: int
    tilted: tuple[int, int]
    turns: int
    distance_mm: tuple[float, float]
    share: float


@dataclass(frozen=True, slots=True)
class Coverage:
    """What the poses so far cover. `missing` names each open goal in words; none is left when the set is complete."""

    poses: tuple[str, ...]
    devices: Mapping[str, DeviceCoverage]
    missing: tuple[str, ...]


def coverage(
    poses: Sequence[PoseObservation], board: Board, sizes: Mapping[str, Size], *, guess: RigGuess | None = None
) -> Coverage:
    """Return what the poses cover in each device of `sizes` (cameras by name, and PROJECTOR where there is one)."""
    known = rig_guess(poses, board, sizes) if guess is None else guess
    middle_mm = board.points_mm.mean(axis=0)
    devices = {}
    for name, size in sizes.items():
        device = known.devices[name]
        cells = np.zeros((CELLS, CELLS), dtype=np.int32)
        for pose in poses:
            cells += _cells_of(pose, name, size, known)
        reachable = _reachable(known, name) | (cells > 0)
        attitudes = {each: attitude(board_pose, middle_mm) for each, board_pose in device.poses.items()}
        distances = [each.distance_mm for each in attitudes.values()]
        turns = [each.turn_deg for each in attitudes.values()]
        told = bool(distances) and device.focal_sigma <= FOCAL_KNOWN
        devices[name] = DeviceCoverage(
            cells,
            reachable,
            attitudes,
            len(depth_groups(distances)),
            tilted(attitudes.values()),
            len(turn_groups(turns, full_turn_deg(board))),
            (min(distances), max(distances)) if told else (float("nan"), float("nan")),
            float((cells > 0)[reachable].mean()),
        )
    names = tuple(pose.name for pose in poses)
    return Coverage(names, devices, tuple(_missing(len(names), devices)))


def cells_of(points_px: FloatArray, size: Size) -> IntArray:
    """(6, 6) int32: how many points lie in each cell of an image. Points outside count nowhere."""
    extent = np.array([size.width_px, size.height_px], dtype=np.float64)
    place = np.floor((points_px + 0.5) / extent * CELLS).astype(np.int64)
    place = place[((place >= 0) & (place < CELLS)).all(axis=1)]
    counts = np.zeros((CELLS, CELLS), dtype=np.int32)
    np.add.at(counts, (place[:, 1], place[:, 0]), 1)
    return counts


def attitude(board_pose: BoardPose, middle_mm: FloatArray) -> Attitude:
    """Return how a board stood, from its pose in the device's frame."""
    normal, along = board_pose.rotation[:, 2], board_pose.rotation[:, 0]
    centre = board_pose.rotation @ middle_mm + board_pose.translation_mm
    sight = float(abs(normal @ centre) / np.linalg.norm(centre))
    return Attitude(
        (float(np.degrees(np.arctan2(-normal[1], normal[2]))), float(np.degrees(np.arctan2(normal[0], normal[2])))),
        float(np.degrees(np.arctan2(along[1], along[0]))),
        float(centre[2]),
        float(np.degrees(np.arccos(min(1.0, sight)))),
    )


def depth_groups(distances_mm: Sequence[float]) -> list[float]:
    """Return the distances that differ by at least `Goals.depth_step`, from near to far, each the nearest of its group.

    >>> depth_groups([600.0, 505.0, 500.0, 610.0, 700.0])
    [500.0, 600.0, 700.0]
    """
    groups: list[float] = []
    for distance in sorted(distances_mm):
        if not groups or distance >= (1 + GOALS.depth_step) * groups[-1]:
            groups.append(distance)
    return groups


def turn_groups(turns_deg: Sequence[float], round_deg: float) -> list[float]:
    """Return angles at least `Goals.turn_step_deg` from each other on the circle, in the order in which they came.

    round_deg : after which angle the board looks as before.

    >>> turn_groups([0.0, 178.0, 30.0, -175.0, 355.0], 360.0)
    [0.0, 178.0, 30.0]
    """
    groups: list[float] = []
    for turn in turns_deg:
        if all(abs(around(turn - other, round_deg)) >= GOALS.turn_step_deg for other in groups):
            groups.append(turn)
    return groups


def around(angle_deg: float, round_deg: float = 360.0) -> float:
    """Return an angle as the shortest way round.

    >>> around(350.0), around(175.0, 180.0)
    (-10.0, -5.0)
    """
    return (angle_deg + round_deg / 2) % round_deg - round_deg / 2


def full_turn_deg(board: Board) -> float:
    """Return after which turn in its plane a board looks as before: half a turn for some chessboards."""
    even = (board.columns + board.rows) % 2 == 0
    return 180.0 if board.kind is BoardKind.CHESSBOARD and even else 360.0


def tilted(attitudes: Iterable[Attitude]) -> tuple[int, int]:
    """Return how many poses are tilted as wanted about the horizontal, and about the vertical axis of the picture."""
    low, high = GOALS.tilt_deg
    tilts = [each.tilt_deg for each in attitudes]
    return sum(low <= abs(x) <= high for x, _ in tilts), sum(low <= abs(y) <= high for _, y in tilts)


def place_words(place: tuple[int, int]) -> str:
    """Return a place in a picture.

    >>> place_words((-1, 1)), place_words((0, 0)), place_words((1, 0))
    ('lower left corner', 'middle', 'right edge')
    """
    across, down = {-1: "left", 0: "", 1: "right"}[place[0]], {-1: "upper", 0: "", 1: "lower"}[place[1]]
    if across and down:
        return f"{down} {across} corner"
    if across or down:
        return f"{across or down} edge"
    return "middle"


def _cells_of(pose: PoseObservation, name: str, size: Size, guess: RigGuess) -> IntArray:
    if name == PROJECTOR:
        return (cells_of(guess.lit_px[pose.name], size) >= _FEWEST_LIT).astype(np.int32)
    view = pose.views.get(name)
    if view is None:
        return np.zeros((CELLS, CELLS), dtype=np.int32)
    return (cells_of(view.points_px, size) > 0).astype(np.int32)


def _reachable(guess: RigGuess, name: str) -> BoolArray:
    """(6, 6) bool: cells of a device in which a camera could see a board, at the distances of the poses so far.

    A projector may light more than the cameras see. A cell of a camera can always be reached.
    """
    everywhere = np.ones((CELLS, CELLS), dtype=np.bool_)
    projector = guess.devices[name]
    if name != PROJECTOR or not projector.poses:
        return everywhere
    cells = np.zeros((CELLS, CELLS), dtype=np.int32)
    for camera, device in guess.devices.items():
        way = guess.relative(camera, name)
        if camera == PROJECTOR or way is None:
            continue
        size = device.size
        across, down = np.linspace(0, size.width_px - 1, 25), np.linspace(0, size.height_px - 1, 25)
        pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 1, 2)
        rays = cv2.undistortPoints(pixels, device.matrix, device.distortion).reshape(-1, 2)
        distances = [pose.translation_mm[2] for pose in device.poses.values()]
        for distance in (min(distances), max(distances)):
            space = np.column_stack([rays, np.ones(len(rays))]) * distance @ way.rotation.T + way.translation_mm
            ahead = space[space[:, 2] > 0]
            points_px = ahead @ projector.matrix.T
            cells += cells_of(points_px[:, :2] / points_px[:, 2:], projector.size)
    return np.asarray(cells > 0, dtype=np.bool_) if cells.any() else everywhere


def _missing(count: int, devices: Mapping[str, DeviceCoverage]) -> list[str]:
    """Name the open goals. Tilts, turns and depths are asked of cameras only: the projector sees the same board."""
    words, goals = [], GOALS
    for name, one in devices.items():
        title = device_title(name)
        if one.share < goals.cell_share:
            what = "lit on the board" if name == PROJECTOR else "covered"
            words.append(f"{title}: {one.share:.0%} of the image {what}, {goals.cell_share:.0%} wanted")
        if name == PROJECTOR:
            continue
        if one.depths < goals.depths:
            words.append(f"{title}: {one.depths} of {goals.depths} distances, {goals.depth_step:.0%} apart")
        for axis, edge in ((0, "top or bottom"), (1, "left or right")):
            if one.tilted[axis] < goals.tilted:
                low, high = goals.tilt_deg
                words.append(
                    f"{title}: {one.tilted[axis]} of {goals.tilted} poses with the {edge} edge tilted "
                    f"{low:.0f}–{high:.0f}° towards it"
                )
        if one.turns < goals.turns:
            words.append(f"{title}: {one.turns} of {goals.turns} angles in the board's plane")
    if count < goals.fewest:
        words.append(f"{count} of at least {goals.fewest} poses")
    return words

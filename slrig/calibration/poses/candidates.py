"""Moves of the board: poses that a person could hold it in next, the open goals that each brings nearer, and the words.

Poses are places in one camera's picture, tilts, turns and distances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.poses.coverage import (
    GOALS,
    Attitude,
    Coverage,
    around,
    attitude,
    cells_of,
    depth_groups,
    full_turn_deg,
    place_words,
    tilted,
    turn_groups,
)
from slrig.calibration.poses.light_view import within
from slrig.calibration.poses.rough import DeviceGuess, RigGuess
from slrig.calibration.solution import PROJECTOR, BoardPose, device_title
from slrig.model import FloatArray
from slrig.model.lens import distorted

TILT_DEG = 30.0
"""Where a tilt tells most per corner that is lost to blur: the middle of what is wanted."""

_TILTS = ((0.0, 0.0), (TILT_DEG, 0.0), (-TILT_DEG, 0.0), (0.0, TILT_DEG), (0.0, -TILT_DEG))
_TURNS_DEG = (0.0, 35.0, 90.0)
_NEARER_FARTHER = (0.85, 1.0, 1.17)
_MUCH_FARTHER = (1.4, 1.8, 2.4)
_MARGIN = 0.015
_FILLED = 0.55
"""Share of the picture's width that a first pose should fill."""

_SETTLING = 4
_NEW_CELLS = 2
_SAME_DISTANCE = 0.04
_SAME_TURN_DEG = 10.0
_LEAST_TILT_DEG = 5.0
_TELLING_PX = 10.0
_MOST_REASONS = 3


@dataclass(frozen=True, slots=True)
class Candidate:
    """A pose to hold the board in, as one camera would see it.

    place : (-1, 0 or 1 across, the same down): left or top, middle, right or bottom. tilt_deg, turn_deg, distance_mm :
    as in `Attitude`; nominal. board_pose : in the camera's frame. outline_px : (4, 2) float64, the outer corners in its
    picture.
    """

    place: tuple[int, int]
    tilt_deg: tuple[float, float]
    turn_deg: float
    distance_mm: float
    board_pose: BoardPose
    outline_px: FloatArray


def candidates(guess: DeviceGuess, board: Board, *, distance_mm: float, upright_deg: float) -> list[Candidate]:
    """Return all poses on a small grid that the camera sees; a board that must be seen whole is seen whole.

    distance_mm : the middle distance. upright_deg : how the board usually stands in the picture.
    """
    for factors in (_NEARER_FARTHER, _MUCH_FARTHER):
        found = _placed(guess, board, [factor * distance_mm for factor in factors], upright_deg)
        if found:
            return found
    return []


def first_distance_mm(guess: DeviceGuess, board: Board) -> float:
    """Return the distance at which the board fills about half of the picture."""
    extent = board.points_mm.max(axis=0) - board.points_mm.min(axis=0)
    across = extent[0] * guess.matrix[0, 0] / guess.size.width_px
    down = extent[1] * guess.matrix[1, 1] / guess.size.height_px
    return float(max(across, down) / _FILLED)


def board_rotation(tilt_deg: tuple[float, float], turn_deg: float) -> FloatArray:
    """(3, 3) float64: turned in its plane, then about the picture's vertical axis, then about its horizontal one."""
    rotation = np.eye(3)
    for axis, angle in ((2, turn_deg), (1, tilt_deg[1]), (0, tilt_deg[0])):
        vector = np.zeros(3)
        vector[axis] = np.radians(angle)
        rotation = cv2.Rodrigues(vector)[0] @ rotation
    return np.asarray(rotation, dtype=np.float64)


def projected(guess: DeviceGuess, space_mm: FloatArray) -> FloatArray:
    """Return (..., 2) float64: where points (..., 3) of a device's frame fall; NaN behind the device.

    All candidates at once, which OpenCV's own function takes one call each for.
    """
    depth = np.where(space_mm[..., 2] > 0, space_mm[..., 2], np.nan)
    x, y = space_mm[..., 0] / depth, space_mm[..., 1] / depth
    across, down, _, _, _ = distorted(guess.distortion, x, y)
    matrix = guess.matrix
    return np.stack([matrix[0, 0] * across + matrix[0, 2], matrix[1, 1] * down + matrix[1, 2]], axis=-1)


def sample_corners(board: Board, most: int) -> FloatArray:
    """(n, 3) float64: some of the board's corners, the outer four among them, evenly in both directions."""
    grid = board.points_mm.reshape(board.rows, board.columns, 3)
    across = max(2, min(board.columns, round(float(np.sqrt(most * board.columns / board.rows)))))
    down = max(2, min(board.rows, most // across))
    rows = np.linspace(0, board.rows - 1, down).round().astype(int)
    columns = np.linspace(0, board.columns - 1, across).round().astype(int)
    return np.asarray(grid[np.ix_(rows, columns)].reshape(-1, 3), dtype=np.float64)


def outer_corners(board: Board) -> FloatArray:
    """(4, 3) float64: the outer four corners, clockwise in the print from corner 0."""
    grid = board.points_mm.reshape(board.rows, board.columns, 3)
    return np.asarray([grid[0, 0], grid[0, -1], grid[-1, -1], grid[-1, 0]], dtype=np.float64)


def _placed(guess: DeviceGuess, board: Board, distances_mm: Sequence[float], upright_deg: float) -> list[Candidate]:
    kinds = list(product(product((-1, 0, 1), (-1, 0, 1)), _TILTS, _TURNS_DEG, distances_mm))
    place = np.array([kind[0] for kind in kinds], dtype=np.float64)
    depth = np.array([kind[3] for kind in kinds])
    turns = {(tilt, turn): board_rotation(tilt, upright_deg + turn) for tilt in _TILTS for turn in _TURNS_DEG}
    rotation = np.stack([turns[kind[1], kind[2]] for kind in kinds])
    corners = outer_corners(board) - board.points_mm.mean(axis=0)
    turned = np.einsum("cij,nj->cni", rotation, corners)
    centre = np.column_stack([np.zeros((len(kinds), 2)), depth])
    extent = np.array([guess.size.width_px, guess.size.height_px], dtype=np.float64)
    focal = np.array([guess.matrix[0, 0], guess.matrix[1, 1]])
    least, most = _MARGIN * extent, (1 - _MARGIN) * extent
    outline = projected(guess, turned + centre[:, None, :])
    for _ in range(_SETTLING):
        low, high = outline.min(axis=1), outline.max(axis=1)
        wanted = np.where(place < 0, least - low, np.where(place > 0, most - high, (extent - low - high) / 2))
        centre[:, :2] += wanted * depth[:, None] / focal
        outline = projected(guess, turned + centre[:, None, :])
    low, high = outline.min(axis=1), outline.max(axis=1)
    slack = 0.5 * _MARGIN * extent
    whole = ((low >= least - slack) & (high <= most + slack)).all(axis=1)
    middle_px = projected(guess, centre[:, None, :])[:, 0]
    fits = whole if board.kind is not BoardKind.CHARUCO else within(middle_px, guess.size)
    shift = centre - rotation @ board.points_mm.mean(axis=0)
    return [
        Candidate(
            kind[0], kind[1], upright_deg + kind[2], kind[3], BoardPose(rotation[index], shift[index]), outline[index]
        )
        for index, kind in enumerate(kinds)
        if fits[index]
    ]


def goals_met(
    option: Candidate,
    guess: RigGuess,
    found: Coverage,
    ways: Mapping[str, BoardPose],
    seen_px: Mapping[str, FloatArray],
) -> dict[str, list[str]]:
    """By device, which of its open goals a candidate brings nearer: cells, tilt, distance, turn.

    ways : from the frame of the candidate's camera to each device's; seen_px : the corners that each would see.
    """
    met: dict[str, list[str]] = {}
    for name, points_px in seen_px.items():
        one, mine = found.devices[name], met.setdefault(name, [])
        if not len(points_px):
            continue
        fresh = (cells_of(points_px, guess.devices[name].size) > 0) & (one.cells == 0) & one.reachable
        if one.share < GOALS.cell_share and fresh.sum() >= _NEW_CELLS:
            mine.append("cells")
        if name == PROJECTOR:
            continue
        way, pose = ways[name], option.board_pose
        there = BoardPose(way.rotation @ pose.rotation, way.rotation @ pose.translation_mm + way.translation_mm)
        then, now = attitude(there, guess.board.points_mm.mean(axis=0)), list(one.attitudes.values())
        leaning = tilted([then])
        if any(one.tilted[axis] < GOALS.tilted and leaning[axis] for axis in (0, 1)):
            mine.append("tilt")
        distances = [each.distance_mm for each in (*now, then)]
        if one.depths < GOALS.depths and len(depth_groups(distances)) > one.depths:
            mine.append("distance")
        turns = [each.turn_deg for each in (*now, then)]
        if one.turns < GOALS.turns and len(turn_groups(turns, full_turn_deg(guess.board))) > one.turns:
            mine.append("turn")
    return met


def move_words(option: Candidate, camera: str, last: Attitude, upright_deg: float, round_deg: float) -> str:
    """Return what to do, as one clause.

    last : how the board stands now; upright_deg : how it usually does; round_deg : after which turn it looks the same.
    """
    parts = [f"move the board to the {place_words(option.place)} of camera '{camera}'"]
    about_x, about_y = option.tilt_deg
    if abs(about_x) >= _LEAST_TILT_DEG:
        parts.append(f"tilt its {'top' if about_x > 0 else 'bottom'} edge {abs(about_x):.0f}° towards the camera")
    if abs(about_y) >= _LEAST_TILT_DEG:
        parts.append(f"tilt its {'right' if about_y > 0 else 'left'} edge {abs(about_y):.0f}° towards the camera")
    if max(abs(about_x), abs(about_y)) < _LEAST_TILT_DEG:
        parts.append("let it face the camera")
    turn = 5 * round(around(option.turn_deg - last.turn_deg, round_deg) / 5)
    if abs(turn) > _SAME_TURN_DEG:
        parts.append(f"turn it {abs(turn):.0f}° {'clockwise' if turn > 0 else 'anticlockwise'} in its plane")
    elif abs(around(option.turn_deg - upright_deg, round_deg)) > _SAME_TURN_DEG:
        parts.append("leave it turned in its plane as it is")
    share = option.distance_mm / last.distance_mm - 1
    if abs(share) > _SAME_DISTANCE:
        parts.append(f"bring it {abs(share):.0%} {'farther away' if share > 0 else 'nearer'}")
    return ", ".join(parts)


def reasons(
    camera: str, met: Mapping[str, Sequence[str]], worst: Mapping[str, float], expected: Mapping[str, float],
    place: tuple[str, tuple[int, int]],
) -> str:  # fmt: skip
    """Return why. met : by device, as of `goals_met`. place : the least sure device and where in its image it is so."""
    parts = ["parts of the picture there are not covered yet"] if "cells" in met.get(camera, []) else []
    for name in (name for name, goals in met.items() if "cells" in goals and name != camera):
        image = "the projector's image" if name == PROJECTOR else f"the picture of camera '{name}'"
        parts.append(f"it covers new parts of {image}")
    for goal, words in (
        ("tilt", "too few poses are tilted that way"),
        ("distance", "the poses so far lie at too few distances"),
        ("turn", "the board was not yet turned in its plane like this"),
    ):
        if any(goal in goals for goals in met.values()):
            parts.append(words)
    parts = parts[:_MOST_REASONS]
    name, where = place
    if worst[name] < _TELLING_PX and expected[name] < worst[name]:
        parts.append(
            f"{device_title(name)} is least sure at its {place_words(where)}, ±{worst[name]:.2g} px at the worst, "
            f"and about ±{expected[name]:.2g} px after this pose"
        )
    return "; ".join(parts) if parts else "it is the pose that tells most now"


def first_words(cameras: Sequence[str], *, lit: bool) -> str:
    """Return what to do before there is any pose. lit : whether a projector is calibrated too."""
    several = " and seen by the others as well" if len(cameras) > 1 else ""
    light = ", lit by the projector" if lit else ""
    return (
        f"hold the board in the middle of the picture of camera '{cameras[0]}', facing it{several}{light}, near enough "
        "to fill about half of the picture: the first pose shows how large and how far it is"
    )


def enough_words(found: Coverage, worst: Mapping[str, float]) -> str:
    """Return that the set will do, or why no more poses are asked for."""
    count = len(found.poses)
    told = ", ".join(f"{device_title(name)} to ±{sigma:.2g} px" for name, sigma in worst.items())
    if found.missing:
        return f"{count} poses are as many as help. Still open: {'; '.join(found.missing)}. Solve, and read the verdict"
    hardly = "" if max(worst.values(), default=np.inf) <= GOALS.sigma_px else ", and another would hardly help"
    return f"enough: {count} poses tell {told} in its worst place{hardly}; solve now"

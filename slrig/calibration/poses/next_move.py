"""What to do with the board next, and why: the pose that makes the rig surest where it is least sure.

Every device's lens has an information matrix from the poses so far. Each candidate pose adds what it would tell
(Fisher information with the candidate's own pose solved for). A device's uncertainty at a place is by how far its
projection of points there may be off, px, after the whole device was moved to take up what it can: a common turn or
shift is no error of a measurement. The worst of its 6 x 6 cells counts, as in mrcal's projection uncertainty
(mrcal.secretsauce.net/uncertainty.html). Candidates that meet an open goal of the coverage go first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.observations import PoseObservation
from slrig.calibration.poses.candidates import (
    Candidate,
    candidates,
    enough_words,
    first_distance_mm,
    first_words,
    goals_met,
    move_words,
    projected,
    reasons,
    sample_corners,
)
from slrig.calibration.poses.coverage import GOALS, Coverage, coverage, full_turn_deg
from slrig.calibration.poses.light_view import LEAST_SIGMA_PX, within
from slrig.calibration.poses.rough import FEWEST_CORNERS, LENS, DeviceGuess, RigGuess, gained, lens_rows, rig_guess
from slrig.calibration.solution import CELLS, PROJECTOR, BoardPose
from slrig.model import FloatArray, Size

_CORNERS = 30
_LEAST_DEPTH = 0.1
_LEAST_GAIN = 0.03
"""A next pose that would lower the worst cell by less than this share is not worth shooting."""


@dataclass(frozen=True, slots=True)
class Advice:
    """What to move next, and why.

    words : one sentence or two for a person. enough : the set will do, and the words say so. camera : the camera in
    whose picture the move is described; None when there is no move. outline_px : (4, 2) float64, where the board's
    outer corners should come to lie in that picture, clockwise in the print from corner 0; empty without a move.
    candidate : the move itself. worst_px : by device, the uncertainty in its worst cell as the poses so far are, and
    expected_px : with the move made; px per coordinate.
    """

    words: str
    enough: bool
    camera: str | None
    outline_px: FloatArray
    candidate: Candidate | None
    worst_px: Mapping[str, float]
    expected_px: Mapping[str, float]


def next_move(
    poses: Sequence[PoseObservation],
    board: Board,
    sizes: Mapping[str, Size],
    *,
    guess: RigGuess | None = None,
    covered: Coverage | None = None,
) -> Advice:
    """Return the pose to shoot next.

    guess, covered : `rig_guess` and `coverage` of the same poses, where they are at hand already.
    """
    known = rig_guess(poses, board, sizes) if guess is None else guess
    found = coverage(poses, board, sizes, guess=known) if covered is None else covered
    seeing = [name for name in sizes if name != PROJECTOR and known.devices[name].poses]
    if not seeing:
        words = first_words([name for name in sizes if name != PROJECTOR], lit=PROJECTOR in sizes)
        return Advice(words, False, None, np.zeros((0, 2)), None, {}, {})
    reaches = {name: _reach(device) for name, device in known.devices.items() if device.poses}
    worst = {name: float(_worst(known.devices[name].information[None], reaches[name])[0]) for name in reaches}
    sure = not found.missing and max(worst.values()) <= GOALS.sigma_px
    if sure or len(poses) >= GOALS.most:
        return _enough(found, worst)
    camera = _least_sure(seeing, known, found, worst)
    device = known.devices[camera]
    board_pose = found.devices[camera].attitudes
    distance_mm = float(np.median([each.distance_mm for each in board_pose.values()]))
    upright_deg = 90.0 * round(next(iter(board_pose.values())).turn_deg / 90.0)
    options: list[Candidate] = []
    for distance in (distance_mm, first_distance_mm(device, board)):
        options = options or candidates(device, board, distance_mm=distance, upright_deg=upright_deg)
    if not options:
        return _enough(found, worst)
    lasting = _informed(options, camera, known, board)
    after = {name: _worst(lasting.information[name], reaches[name]) for name in reaches}
    met = [
        goals_met(option, known, found, lasting.ways, lasting.seen_px(index)) for index, option in enumerate(options)
    ]
    total = np.sum([(after[name] / known.devices[name].matrix[0, 0]) ** 2 for name in reaches], axis=0)
    chosen = _chosen(met, total, lasting.seeing)
    now = float(np.sum([(worst[name] / known.devices[name].matrix[0, 0]) ** 2 for name in reaches]))
    if not found.missing and float(np.sqrt(total[chosen] / now)) > 1 - _LEAST_GAIN:
        return _enough(found, worst)
    expected = {name: float(after[name][chosen]) for name in reaches}
    last = list(board_pose.values())[-1]
    why = reasons(camera, met[chosen], worst, expected, _worst_place(known.devices, reaches, worst))
    words = f"{move_words(options[chosen], camera, last, upright_deg, full_turn_deg(board))}: {why}"
    return Advice(words, False, camera, options[chosen].outline_px, options[chosen], worst, expected)


@dataclass(frozen=True, slots=True)
class _Informed:
    """By device: (c, 8, 8) information with each of c candidates added, the way to its frame from the camera's, and
    which corners of each candidate it sees. seeing : (c,), how many devices see enough of it.
    """

    information: Mapping[str, FloatArray]
    ways: Mapping[str, BoardPose]
    points_px: Mapping[str, FloatArray]
    shown: Mapping[str, NDArray[np.bool_]]
    seeing: NDArray[np.int64]

    def seen_px(self, index: int) -> dict[str, FloatArray]:
        """By device, the corners that it sees of one candidate."""
        return {name: points[index][self.shown[name][index]] for name, points in self.points_px.items()}


def _reach(device: DeviceGuess) -> FloatArray:
    """(k, 2, 36, 8) float64: how the projection of places in the volume answers to the lens, rigid moves taken out.

    Places lie in the 36 cells at k = 3 distances, over which the poses spread.
    """
    size = device.size
    across = (np.arange(CELLS) + 0.5) * size.width_px / CELLS - 0.5
    down = (np.arange(CELLS) + 0.5) * size.height_px / CELLS - 0.5
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 1, 2)
    rays = np.asarray(cv2.undistortPoints(pixels, device.matrix, device.distortion), dtype=np.float64).reshape(-1, 2)
    distances = [pose.translation_mm[2] for pose in device.poses.values()]
    middle = float(np.median(distances))
    near, far = min(*distances, (1 - _LEAST_DEPTH) * middle), max(*distances, (1 + _LEAST_DEPTH) * middle)
    depths = np.array([near, (near + far) / 2, far])
    space = (np.column_stack([rays, np.ones(len(rays))])[None] * depths[:, None, None]).reshape(-1, 3)
    _, lens, rigid = lens_rows(device, space, BoardPose(np.eye(3), np.zeros(3)))
    taken_up, *_ = np.linalg.lstsq(rigid, lens, rcond=None)
    left = lens - rigid @ taken_up
    return np.asarray(left.reshape(len(depths), CELLS * CELLS, 2, LENS).transpose(0, 2, 1, 3), dtype=np.float64)


def _cells(information: FloatArray, reach: FloatArray) -> FloatArray:
    """(c, 36) float64: the uncertainty in each cell, for each of c information matrices."""
    covariance = np.linalg.inv(information)
    flat = reach.reshape(-1, LENS)
    variance = np.einsum("ckj,kj->ck", flat @ covariance, flat)
    return np.asarray(np.sqrt(variance.reshape(len(information), -1, CELLS * CELLS).mean(axis=1)), dtype=np.float64)


def _worst(information: FloatArray, reach: FloatArray) -> FloatArray:
    return np.asarray(_cells(information, reach).max(axis=1), dtype=np.float64)


def _informed(options: Sequence[Candidate], camera: str, known: RigGuess, board: Board) -> _Informed:
    points_mm = sample_corners(board, _CORNERS)
    rotation = np.stack([option.board_pose.rotation for option in options])
    shift = np.stack([option.board_pose.translation_mm for option in options])
    information, ways, seen = {}, {}, {}
    shown: dict[str, NDArray[np.bool_]] = {}
    seeing = np.zeros(len(options), dtype=np.int64)
    for name, device in known.devices.items():
        if not device.poses:
            continue
        way = known.relative(camera, name)
        if way is None:
            information[name] = np.repeat(device.information[None], len(options), axis=0)
            continue
        turned = way.rotation @ rotation
        moved = shift @ way.rotation.T + way.translation_mm
        points_px = projected(device, points_mm @ turned.transpose(0, 2, 1) + moved[:, None, :])
        flat = within(np.nan_to_num(points_px.reshape(-1, 2), nan=-1e9), device.size)
        visible = flat.reshape(points_px.shape[:2])
        if name != PROJECTOR and board.kind is not BoardKind.CHARUCO:
            visible &= visible.all(axis=1, keepdims=True)
        sigma_px = _sigma(device) * float(np.sqrt(len(points_mm) / board.corner_count))
        held = np.repeat(device.information[None], len(options), axis=0)
        for index in np.flatnonzero(visible.sum(axis=1) >= FEWEST_CORNERS):
            board_pose = BoardPose(turned[index], moved[index])
            _, lens, pose = lens_rows(device, points_mm[visible[index]], board_pose)
            held[index] += gained(lens, pose, sigma_px)
            seeing[index] += 1
        information[name], ways[name], seen[name], shown[name] = held, way, points_px, visible
    return _Informed(information, ways, seen, shown, seeing)


def _sigma(device: DeviceGuess) -> float:
    """Deviation of one corner's coordinate: each view's was given for the few corners that it was thinned to."""
    return max(LEAST_SIGMA_PX, float(np.median([seen.corner_sigma_px for seen in device.seen.values()])))


def _least_sure(seeing: Sequence[str], known: RigGuess, found: Coverage, worst: Mapping[str, float]) -> str:
    """Return the camera with the most open goals, of several the least sure."""

    def rank(name: str) -> tuple[int, float]:
        open_goals = sum(f"'{name}'" in each for each in found.missing)
        return open_goals, worst[name] / float(known.devices[name].matrix[0, 0])

    return max(seeing, key=rank)


def _chosen(met: Sequence[Mapping[str, Sequence[str]]], total: FloatArray, seeing: NDArray[np.int64]) -> int:
    """Return the candidate that lowers the worst cells the most, of those that meet an open goal if any does.

    Candidates that more devices see go before those that fewer see.
    """
    serving = np.array([any(goals.values()) for goals in met])
    allowed = serving if serving.any() else np.ones(len(met), dtype=bool)
    allowed = allowed & (seeing == seeing[allowed].max())
    return int(np.argmin(np.where(allowed, total, np.inf)))


def _worst_place(
    devices: Mapping[str, DeviceGuess], reaches: Mapping[str, FloatArray], worst: Mapping[str, float]
) -> tuple[str, tuple[int, int]]:
    """Return the least sure device (by angle) and the place of its worst cell, as `Candidate.place`."""
    name = max(reaches, key=lambda each: worst[each] / float(devices[each].matrix[0, 0]))
    cells = _cells(devices[name].information[None], reaches[name])[0].reshape(CELLS, CELLS)
    row, column = np.unravel_index(int(np.argmax(cells)), cells.shape)
    third = CELLS // 3
    return name, (int(column) // third - 1, int(row) // third - 1)


def _enough(found: Coverage, worst: Mapping[str, float]) -> Advice:
    return Advice(enough_words(found, worst), True, None, np.zeros((0, 2)), None, worst, {})

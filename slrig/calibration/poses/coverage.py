"""Coverage of image, depth and tilt by the poses so far, and the next pose to hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.observations import PoseObservation
from slrig.calibration.poses.rough import (
    FEWEST_CORNERS,
    LEAST_SIGMA_PX,
    LENS,
    DeviceGuess,
    RigGuess,
    gained,
    lens_rows,
    rig_guess,
    within,
)
from slrig.calibration.solution import CELLS, PROJECTOR, BoardPose, device_title
from slrig.model import FloatArray, IntArray, Size
from slrig.model.lens import distort

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
    across, down, _, _, _ = distort(guess.distortion, x, y)
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

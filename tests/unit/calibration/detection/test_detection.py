"""Boards found in painted images whose every corner is known, and refused where they cannot be used.

OpenCV before 4.6 printed ChArUco boards with an even number of rows of squares with a light square first: OLD. One kind
of board per property is in the default run; the other kinds are slow.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.detection import (
    board_mask,
    find_board,
    interior_mask,
    measure_blur_px,
    paper_mask,
    refine_view,
)
from slrig.calibration.detection.lattice import equivalent_numberings
from slrig.errors import PoseRefusedError
from tests.core import parametrize_core
from tests.unit.calibration.painted import PaintedCamera, PrintStyle, as_8_bit, board_points, camera_at, paint

CHARUCO = Board(BoardKind.CHARUCO, 7, 5, 14.0)
CHESSBOARD = Board(BoardKind.CHESSBOARD, 8, 5, 14.0)
CIRCLES = Board(BoardKind.CIRCLES, 4, 7, 11.0)
EVEN_CIRCLES = Board(BoardKind.CIRCLES, 4, 6, 12.0)
ALL = [CHARUCO, CHESSBOARD, CIRCLES]
OLD = PrintStyle(light_first=True)
KINDS = [(CHARUCO, PrintStyle()), (CHESSBOARD, PrintStyle()), (CIRCLES, PrintStyle()), (CHARUCO, OLD)]
LENS = (-0.12, 0.06, 0.001, -0.001, 0.0)
FINE: dict[str, Any] = {"width": 640, "height": 512, "focal_px": 800.0}
NOISE = 0.01


def title(given: object) -> str:
    """A short name for a case."""
    if isinstance(given, PrintStyle):
        return "old" if given.light_first else "today's"
    return given.title if isinstance(given, Board) else str(given)[:30]


@cache
def board_camera(board: Board, **further: Any) -> PaintedCamera:
    given: dict[str, Any] = {
        "distance_mm": 205.0,
        "tilt_deg": (20.0, -25.0),
        "roll_deg": 12.0,
        "distortion": LENS,
        "width": 400,
        "height": 320,
        "focal_px": 500.0,
    } | further
    return camera_at(board, **given)


@cache
def shoot(
    board: Board, camera: PaintedCamera | None = None, *, noise: float = NOISE, **style: Any
) -> NDArray[np.uint8]:
    image = paint(board, camera or board_camera(board), **({"samples": 4} | style))
    found = as_8_bit(image + np.random.default_rng(1).normal(0, noise, image.shape))
    found.flags.writeable = False
    return found


def corner_errors(view: BoardView, board: Board, camera: PaintedCamera) -> NDArray[np.float64]:
    return view.points_px - camera.project(board_points(board)[view.corner])


@parametrize_core(("board", "style"), KINDS, core=[1], ids=title)
@parametrize_core(
    ("tilt_deg", "blur_px", "noise", "most_rms_px"),
    [
        ((0.0, 0.0), 0.6, 0.0, 0.007),
        ((0.0, 0.0), 1.0, 0.01, 0.015),
        ((30.0, -35.0), 0.7, 0.01, 0.02),
        ((-30.0, 20.0), 1.5, 0.03, 0.07),
    ],
    core=[2],
)
def test_corners_are_accurate_within_their_stated_deviation(
    board: Board, style: PrintStyle, tilt_deg: tuple[float, float], blur_px: float, noise: float, most_rms_px: float
) -> None:
    camera = board_camera(board, tilt_deg=tilt_deg, **FINE)
    # Four samples a side leave edges of their own making, of a size with what is measured here.
    shaded = replace(style, shading=(0.4, -0.3))
    image = shoot(board, camera, blur_px=blur_px, noise=noise, style=shaded, samples=7)
    view = find_board(image, board, full_scale=255)
    assert view.light_first is style.light_first
    assert len(view.corner) == board.corner_count
    off = corner_errors(view, board, camera)
    assert np.sqrt((off**2).mean()) < most_rms_px
    assert np.abs(off.mean(axis=0)).max() < max(0.003, 0.3 * most_rms_px)
    share = np.sqrt(((off / view.sigma_px[:, None]) ** 2).mean())
    assert share < 1.35
    if noise:
        assert share > 0.6


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.3, 0.4, 0.6])
def test_circles_of_any_radius_are_found(radius: float) -> None:
    camera = board_camera(CIRCLES, **FINE)
    view = find_board(shoot(CIRCLES, camera, style=PrintStyle(circle_radius=radius)), CIRCLES, full_scale=255)
    assert len(view.corner) == CIRCLES.corner_count
    assert np.sqrt((corner_errors(view, CIRCLES, camera) ** 2).mean()) < 0.02


@parametrize_core("roll_deg", [184.0, 107.0])
@parametrize_core(("board", "style"), KINDS, core=[1], ids=title)
def test_a_board_with_one_numbering_keeps_it_at_any_angle(board: Board, style: PrintStyle, roll_deg: float) -> None:
    camera = board_camera(board, roll_deg=roll_deg)
    view = find_board(shoot(board, camera, style=style), board, full_scale=255)
    assert np.abs(corner_errors(view, board, camera)).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("roll_deg", [10.0, 190.0])
@pytest.mark.parametrize("board", [Board(BoardKind.CHESSBOARD, 7, 5, 14.0), EVEN_CIRCLES], ids=title)
def test_equivalent_numberings_include_the_true_one(board: Board, roll_deg: float) -> None:
    camera = board_camera(board, roll_deg=roll_deg)
    view = find_board(shoot(board, camera), board, full_scale=255)
    worst = [np.abs(corner_errors(each, board, camera)).max() for each in equivalent_numberings(view, board)]
    assert min(worst) < 0.1
    assert max(worst) > 10
    grid = view.points_px.reshape(board.rows, board.columns, 2)
    assert (grid[:, -1] - grid[:, 0]).mean(axis=0)[0] > 0


@pytest.mark.slow
@pytest.mark.parametrize("full_scale", [1023.0, 1.0])
def test_any_depth_of_image_gives_the_same_corners(full_scale: float) -> None:
    image = paint(CHESSBOARD, board_camera(CHESSBOARD), samples=3)
    kind = np.float32 if full_scale == 1.0 else np.uint16
    view = find_board((image * full_scale).astype(kind), CHESSBOARD, full_scale=full_scale)
    reference = find_board(image, CHESSBOARD, full_scale=1.0)
    assert np.abs(view.points_px - reference.points_px).max() < 0.02


@pytest.mark.slow
def test_corners_of_a_dim_image_state_larger_deviations() -> None:
    bright = find_board(shoot(CHARUCO, noise=0.002), CHARUCO, full_scale=255)
    dim = paint(CHARUCO, board_camera(CHARUCO), samples=4) * 0.08
    dim_view = find_board(as_8_bit(dim + np.random.default_rng(1).normal(0, 0.002, dim.shape)), CHARUCO, full_scale=255)
    assert np.median(dim_view.sigma_px) > 2 * np.median(bright.sigma_px)


@parametrize_core("style", [PrintStyle(), OLD], ids=title)
def test_a_part_of_a_charuco_board_is_enough(style: PrintStyle) -> None:
    camera = board_camera(CHARUCO, shift_mm=(45.0, 20.0))
    view = find_board(shoot(CHARUCO, camera, style=style), CHARUCO, full_scale=255)
    assert view.light_first is style.light_first
    assert 8 <= len(view.corner) < CHARUCO.corner_count
    assert np.abs(corner_errors(view, CHARUCO, camera)).max() < 0.06
    places = camera.project(board_points(CHARUCO))
    within = ((places > 8) & (places < np.array([camera.width, camera.height]) - 9)).all(axis=1)
    assert set(np.flatnonzero(within)) - set(view.corner.tolist()) == set()


@parametrize_core(("board", "style"), KINDS, core=[3], ids=title)
def test_corners_are_refined_after_a_small_movement(board: Board, style: PrintStyle) -> None:
    before, after = board_camera(board), board_camera(board, shift_mm=(0.1, -0.05))
    view = find_board(shoot(board, before, style=style), board, full_scale=255)
    again = refine_view(shoot(board, after, style=style), view, board, full_scale=255)
    assert again.light_first is style.light_first
    assert again.corner.tolist() == view.corner.tolist()
    assert (
        np.abs(corner_errors(again, board, after).mean(axis=0)).max()
        < 0.02
        < np.abs(corner_errors(again, board, before)).max()
    )


def test_boards_of_an_odd_number_of_rows_of_squares_have_one_layout() -> None:
    odd = Board(BoardKind.CHARUCO, 7, 4, 14.0)
    assert not find_board(shoot(odd), odd, full_scale=255).light_first


def test_the_old_layout_is_that_of_opencv() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    printed = cv2.aruco.CharucoBoard((8, 6), 14.0, 10.5, dictionary)
    printed.setLegacyPattern(True)
    image = printed.generateImage((8 * 60, 6 * 60), marginSize=0)
    image = cv2.copyMakeBorder(image, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    view = find_board(image, CHARUCO, full_scale=255)
    assert view.light_first
    expected = 40 + (board_points(CHARUCO)[view.corner, :2] / 14.0 + 1) * 60 - 0.5
    assert np.abs(view.points_px - expected).max() < 0.05


def assert_refused(image: NDArray[np.uint8], board: Board, message: str) -> None:
    with pytest.raises(PoseRefusedError, match=message):
        find_board(image, board, full_scale=255)


@parametrize_core("board", ALL, ids=title)
def test_nothing_in_view_is_refused_with_the_likely_cause(board: Board) -> None:
    random = np.random.default_rng(3)
    assert_refused(as_8_bit(random.normal(0.4, 0.02, (320, 400))), board, "not in view")
    assert_refused(as_8_bit(random.normal(0.01, 0.003, (320, 400))), board, "too dark")
    assert_refused(as_8_bit(random.normal(0.4, 0.001, (320, 400))), board, "no contrast")
    assert_refused(as_8_bit(20 * paint(board, board_camera(board), samples=1)), board, "clipped to white")


@parametrize_core(("board", "blur_px"), [(CHARUCO, 9.0), (CHESSBOARD, 11.0)], ids=title)
def test_a_board_out_of_focus_is_refused(board: Board, blur_px: float) -> None:
    camera = board_camera(board, **FINE) if board is CHESSBOARD else board_camera(board)
    assert_refused(shoot(board, camera, blur_px=blur_px, samples=2), board, "out of focus")


@parametrize_core(
    ("expected", "present", "message"),
    [
        (CHESSBOARD, Board(BoardKind.CHESSBOARD, 10, 7, 11.0), "another board.*found a chessboard of 10 x 7"),
        (CHESSBOARD, Board(BoardKind.CHESSBOARD, 10, 5, 11.0), "another board.*found a chessboard of 10 x 5"),
        (CHESSBOARD, Board(BoardKind.CHESSBOARD, 6, 4, 16.0), "another board.*found a chessboard of 6 x 4"),
        (CHESSBOARD, Board(BoardKind.CHESSBOARD, 7, 6, 14.0), "another board.*found a chessboard of 7 x 6"),
        (CHESSBOARD, Board(BoardKind.CHARUCO, 8, 5, 14.0), "another board.*ChArUco.*DICT_5X5"),
        (CHESSBOARD, CIRCLES, "another board.*circles"),
        (CHARUCO, CHESSBOARD, "another board.*chessboard of 8 x 5"),
        (CHARUCO, CIRCLES, "another board.*circles"),
        (CHARUCO, Board(BoardKind.CHARUCO, 7, 5, 14.0, dictionary="DICT_4X4_100"), "another board.*DICT_4X4"),
        (CHARUCO, Board(BoardKind.CHARUCO, 9, 6, 12.0), "another board.*marker .* is in view.*9 corners in a row"),
        (CHARUCO, Board(BoardKind.CHARUCO, 5, 4, 16.0), "another board.*are not in the order.*5 corners in a row"),
        (CHARUCO, Board(BoardKind.CHARUCO, 7, 5, 14.0, marker_mm=7.7), "another board.*of a square wide.*found 0.5"),
        (CIRCLES, Board(BoardKind.CIRCLES, 4, 9, 9.0), "another board.*7 rows of 4"),
        (CIRCLES, Board(BoardKind.CIRCLES, 5, 7, 9.0), "another board.*7 rows of 4"),
        (CIRCLES, CHESSBOARD, "another board.*chessboard of 8 x 5"),
    ],
    core=[8],
    ids=title,
)
def test_another_board_is_refused_with_its_description(expected: Board, present: Board, message: str) -> None:
    assert_refused(shoot(present, board_camera(present, **FINE)), expected, message)


@parametrize_core(("count", "message"), [(15, "another board.*found 15 of DICT_4X4"), (8, "not in view")])
def test_a_dozen_unordered_markers_are_named(count: int, message: str) -> None:
    """Single markers are read into anything."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image = np.full((320, 400), 190, np.uint8)
    for place, number in enumerate(np.random.default_rng(7).permutation(50)[:count].tolist()):
        top, left = 20 + 100 * (place // 5), 15 + 76 * (place % 5)
        image[top : top + 60, left : left + 60] = cv2.aruco.generateImageMarker(dictionary, number, 60)
    assert_refused(image, CHARUCO, message)


@parametrize_core("present", [CHARUCO, CIRCLES], ids=title)
def test_swapped_corner_counts_are_named(present: Board) -> None:
    expected = Board(present.kind, present.rows, present.columns, present.square_mm)
    message = f"another board.*swap them, corners .--corners. {present.columns}x{present.rows}"
    assert_refused(shoot(present, board_camera(present)), expected, message)


def test_a_chessboard_is_found_with_swapped_corner_counts() -> None:
    camera = board_camera(CHESSBOARD)
    turned = Board(BoardKind.CHESSBOARD, CHESSBOARD.rows, CHESSBOARD.columns, CHESSBOARD.square_mm)
    view = find_board(shoot(CHESSBOARD, camera), turned, full_scale=255)
    truth = camera.project(board_points(CHESSBOARD))
    nearest = np.linalg.norm(view.points_px[:, None] - truth, axis=2)
    assert nearest.min(axis=1).max() < 0.1
    # A turned board, and no mirrored one: the print's neighbours are neighbours, in right-handed order.
    row, column = np.divmod(nearest.argmin(axis=1), CHESSBOARD.columns)
    places = np.stack([column, row], axis=-1).reshape(turned.rows, turned.columns, 2)
    across, down = places[0, 1] - places[0, 0], places[1, 0] - places[0, 0]
    assert abs(across).sum() == abs(down).sum() == 1
    assert across[0] * down[1] - across[1] * down[0] == 1


@parametrize_core("board", [CHARUCO, EVEN_CIRCLES], ids=title)
def test_a_mirrored_print_is_refused(board: Board) -> None:
    assert_refused(shoot(board, style=PrintStyle(mirrored=True)), board, "mirrored print.*without mirroring")


@pytest.mark.slow
@pytest.mark.parametrize("board", [CHESSBOARD, CIRCLES], ids=title)
def test_a_symmetric_print_is_found_mirrored(board: Board) -> None:
    camera = board_camera(board)
    view = find_board(shoot(board, camera, style=PrintStyle(mirrored=True)), board, full_scale=255)
    width = 2 * board.columns if board.kind is BoardKind.CIRCLES else board.columns
    places = board_points(board) * [-1, 1, 1] + [(width - 1) * board.square_mm, 0, 0]
    truth = camera.project(places)
    apart = np.linalg.norm(view.points_px[:, None] - truth, axis=2).min(axis=1)
    assert apart.max() < 0.1


@parametrize_core(
    ("board", "shift_mm", "side"),
    [
        (CHESSBOARD, (55.0, 0.0), "right"),
        (CHESSBOARD, (0.0, -45.0), "upper"),
        (CIRCLES, (55.0, 0.0), "right"),
        (CIRCLES, (0.0, 55.0), "lower"),
    ],
    core=[3],
    ids=title,
)
def test_half_a_board_is_refused_with_the_clipped_side(board: Board, shift_mm: tuple[float, float], side: str) -> None:
    camera = board_camera(board, shift_mm=shift_mm, roll_deg=0.0, tilt_deg=(5.0, 5.0))
    assert_refused(shoot(board, camera), board, f"half a board.*{side} side.*whole board into view, or use a ChArUco")


@pytest.mark.slow
@pytest.mark.parametrize("board", [CHESSBOARD, CIRCLES], ids=title)
def test_a_covered_board_is_refused(board: Board) -> None:
    image = shoot(board, board_camera(board, roll_deg=0.0, tilt_deg=(5.0, 5.0))).copy()
    image[:, 250:] = 90
    assert_refused(image, board, "remove what covers")


def light_to(towards_deg: float, squares: float) -> tuple[float, float, float]:
    """Light that ends so many squares beyond the chessboard's outermost corner that way, and 2 % of it farther on."""
    towards = np.array([np.cos(np.radians(towards_deg)), np.sin(np.radians(towards_deg))])
    places = board_points(CHESSBOARD)[:, :2] / CHESSBOARD.square_mm
    return towards_deg, float((places @ towards).max()) + squares, 0.02


@pytest.mark.slow
@pytest.mark.parametrize("towards", [(145.0, 1.1), (220.0, 0.6), (320.0, 0.6)])
def test_light_that_ends_near_the_print_does_not_extend_the_board(towards: tuple[float, float]) -> None:
    """Lit and unlit paper alternate with the outermost squares there, as on a board with a line more."""
    camera = board_camera(CHESSBOARD)
    view = find_board(shoot(CHESSBOARD, camera, style=PrintStyle(lit=light_to(*towards))), CHESSBOARD, full_scale=255)
    assert len(view.corner) >= CHESSBOARD.corner_count - 3
    assert np.abs(corner_errors(view, CHESSBOARD, camera)).max() < 0.15


@pytest.mark.slow
def test_a_partly_lit_board_is_numbered_correctly_or_refused_with_the_cause() -> None:
    found, refusals = 0, []
    for number in range(14):
        rng = np.random.default_rng(number)
        camera = board_camera(
            CHESSBOARD, roll_deg=rng.uniform(-180, 180), tilt_deg=(rng.uniform(-30, 30), rng.uniform(-30, 30))
        )
        style = PrintStyle(lit=light_to(rng.uniform(0, 360), rng.uniform(-2.0, 1.2)))
        try:
            view = find_board(shoot(CHESSBOARD, camera, style=style), CHESSBOARD, full_scale=255)
        except PoseRefusedError as refusal:
            refusals.append(str(refusal))
            continue
        found += 1
        # Corners in the dark are known to a pixel, and say so; one of another number would be 35 pixels off.
        assert (np.abs(corner_errors(view, CHESSBOARD, camera)).max(axis=1) < 0.15 + 5 * view.sigma_px).all(), number
    assert found >= 4
    assert len(refusals) >= 4
    assert all("most likely the projector's image ends on the board" in message for message in refusals)


def test_too_little_of_a_charuco_board_is_refused() -> None:
    image = shoot(CHARUCO, board_camera(CHARUCO, roll_deg=0.0, tilt_deg=(5.0, 5.0))).copy()
    image[:, 150:] = 90
    assert_refused(image, CHARUCO, "too little of the charuco")


@parametrize_core("style", [OLD, PrintStyle()], ids=title)
def test_markers_that_fit_both_layouts_are_refused(style: PrintStyle) -> None:
    """All markers but those of one row are covered: a step of one square aside they are the other layout's."""
    straight = camera_at(CHARUCO, distance_mm=205.0)
    image = shoot(CHARUCO, straight, style=style).copy()
    row = straight.project(np.array([[0.0, 1.3 * 14, 0.0], [0.0, 2.7 * 14, 0.0]]))[:, 1].astype(int)
    image[: row[0] - 7], image[row[1] + 7 :] = 90, 90
    assert_refused(image, CHARUCO, "too little of the charuco")


@pytest.mark.slow
@pytest.mark.parametrize(("board", "style"), KINDS, ids=title)
def test_masks_follow_the_print(board: Board, style: PrintStyle) -> None:
    camera = board_camera(board, **FINE)
    size = (camera.height, camera.width)
    bare = replace(style, paper_squares=0.0, beyond=0.4)
    image = paint(board, camera, blur_px=0.0, samples=4, style=bare)
    view = find_board(paint(board, camera, samples=4, style=style), board, full_scale=1.0)
    region = board_mask(view, board, size)
    light = paper_mask(view, board, size)
    inner = interior_mask(view, board, size, margin_px=1.5)
    on_print = np.abs(image - 0.4) > 1e-6
    assert np.mean(region == on_print) > 0.99
    # Away from edges each mask is right without an exception.
    assert inner.any()
    assert (inner & ~region).sum() == 0
    assert np.allclose(image[inner & light], style.white)
    assert np.allclose(image[inner & ~light], style.dark)
    assert not light[~region].any()
    share = np.isclose(image[on_print], style.white).mean()
    assert light[region].mean() == pytest.approx(share, abs=0.05)


@parametrize_core(("board", "style"), KINDS, core=[1], ids=title)
@parametrize_core("blur_px", [1.3, 0.7])
def test_the_blur_is_measured(board: Board, style: PrintStyle, blur_px: float) -> None:
    image = shoot(board, board_camera(board, distance_mm=170.0, tilt_deg=(5.0, 5.0)), blur_px=blur_px, style=style)
    view = find_board(image, board, full_scale=255)
    # A pixel's own extent blurs by 1/sqrt(12).
    expected = np.hypot(blur_px, 12**-0.5)
    assert measure_blur_px(image, view, board, full_scale=255) == pytest.approx(expected, rel=0.12)


def test_invalid_images_raise_value_errors() -> None:
    with pytest.raises(ValueError, match="grey image"):
        find_board(np.zeros((40, 40, 3)), CHESSBOARD, full_scale=255)
    with pytest.raises(ValueError, match="finite"):
        find_board(np.full((40, 40), np.nan), CHESSBOARD, full_scale=255)


@pytest.mark.realtime
@pytest.mark.parametrize("present", [*ALL, None], ids=title)
@pytest.mark.parametrize("expected", ALL, ids=title)
def test_a_board_is_found_or_refused_in_the_time_of_a_few_filters(expected: Board, present: Board | None) -> None:
    """A pose is answered within two seconds. Found took 0.13 to 0.22 s and refused 0.2 to 1.3 s, 8 filters 0.15 s."""
    random = np.random.default_rng(3)
    image = as_8_bit(random.normal(0.4, 0.02, (1024, 1280)))
    if present is not None:
        size: dict[str, Any] = {"width": 1280, "height": 1024, "focal_px": 1600.0}
        wrong = Board(present.kind, present.columns + 2, present.rows + 2, 0.8 * present.square_mm)
        shown = present if present == expected else wrong
        image = shoot(shown, board_camera(shown, **size))

    def filters() -> None:
        for _ in range(4):
            cv2.medianBlur(image, 21)
            cv2.adaptiveThreshold(image, 255, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, cv2.THRESH_BINARY, 51, 2)

    def answer() -> None:
        try:
            found = find_board(image, expected, full_scale=255)
        except PoseRefusedError:
            assert present != expected
        else:
            assert present == expected
            assert len(found.corner) == expected.corner_count

    assert least_s(answer) < (4 if present == expected else 15) * least_s(filters)


def least_s(action: Callable[[], object]) -> float:
    """The least processor time of three runs."""
    taken = []
    for _ in range(3):
        started = time.process_time()
        action()
        taken.append(time.process_time() - started)
    return min(taken)

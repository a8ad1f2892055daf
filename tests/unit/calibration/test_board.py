"""What a board is: its corners' places, what it refuses, and what of it is dark."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.artwork import artwork, charuco_board
from slrig.calibration.boards.lattice import equivalent_views, turned_half
from slrig.calibration.observations import BoardView
from slrig.cli.boards import board_option
from slrig.errors import CalibrationError
from tests.unit.calibration.boards.painted import board_points

BOARDS = [
    Board(BoardKind.CHARUCO, 11, 8, 12.0),
    Board(BoardKind.CHESSBOARD, 7, 9, 20.0),
    Board(BoardKind.CIRCLES, 4, 11, 15.0),
    Board(BoardKind.CIRCLES, 5, 8, 15.0),
]


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_corners_count_from_left_to_right_and_from_top_to_bottom(board: Board) -> None:
    assert np.allclose(board.points_mm, board_points(board))


def test_a_charuco_board_is_the_one_that_opencv_draws() -> None:
    board = Board(BoardKind.CHARUCO, 5, 4, 14.0, marker_mm=10.5)
    scale = 8
    drawn = charuco_board(board).generateImage((6 * 14 * scale, 5 * 14 * scale), marginSize=0, borderBits=1)
    ours = np.full(drawn.shape, 255, dtype=np.uint8)
    for least, most in artwork(board).rectangles_mm:
        left, top = np.round((least + board.square_mm) * scale).astype(int)
        right, bottom = np.round((most + board.square_mm) * scale).astype(int)
        ours[top:bottom, left:right] = 0
    assert np.array_equal(ours < 128, drawn < 128)


def test_no_dark_shape_lies_outside_the_print() -> None:
    for board in BOARDS:
        drawn = artwork(board)
        places = np.concatenate(
            [
                drawn.rectangles_mm.reshape(-1, 2),
                drawn.circles_mm[:, :2] - drawn.circles_mm[:, 2:],
                drawn.circles_mm[:, :2] + drawn.circles_mm[:, 2:],
            ]
        )
        least, most = board.print_mm
        assert (places >= least - 1e-9).all()
        assert (places <= most + 1e-9).all()


def _whole(board: Board) -> BoardView:
    count = board.corner_count
    return BoardView(np.arange(count, dtype=np.int32), board.points_mm[:, :2] + 7.0, np.full(count, 0.1))


@pytest.mark.parametrize(
    ("board", "numberings"),
    [
        (Board(BoardKind.CHARUCO, 6, 6, 10.0), 1),
        (Board(BoardKind.CHESSBOARD, 11, 8, 10.0), 1),
        (Board(BoardKind.CHESSBOARD, 7, 9, 10.0), 2),
        (Board(BoardKind.CHESSBOARD, 7, 7, 10.0), 2),
        (Board(BoardKind.CHESSBOARD, 6, 6, 10.0), 4),
        (Board(BoardKind.CIRCLES, 4, 11, 10.0), 1),
        (Board(BoardKind.CIRCLES, 4, 10, 10.0), 2),
    ],
    ids=str,
)
def test_a_print_has_as_many_numberings_as_sides_from_which_it_looks_the_same(board: Board, numberings: int) -> None:
    views = equivalent_views(_whole(board), board)
    assert len(views) == numberings
    for view in views:
        # The same points, and a turn of the board takes its places to them: no reflection.
        assert np.array_equal(np.sort(view.points_px, axis=0), np.sort(views[0].points_px, axis=0))
        turn, rest, *_ = np.linalg.lstsq(
            np.column_stack([board.points_mm[view.corner, :2], np.ones(len(view.corner))]), view.points_px, rcond=None
        )
        assert float(np.sum(rest)) < 1e-12
        assert np.linalg.det(turn[:2]) == pytest.approx(1.0)


def test_turning_by_half_twice_changes_nothing_and_a_one_sided_board_is_not_turned() -> None:
    board = Board(BoardKind.CHESSBOARD, 7, 9, 10.0)
    view = _whole(board)
    part = BoardView(view.corner[3:40], view.points_px[3:40], view.sigma_px[3:40])
    again = turned_half(turned_half(part, board), board)
    assert np.array_equal(again.corner, part.corner)
    assert np.array_equal(again.points_px, part.points_px)
    with pytest.raises(ValueError, match="one numbering"):
        turned_half(_whole(Board(BoardKind.CIRCLES, 4, 11, 10.0)), Board(BoardKind.CIRCLES, 4, 11, 10.0))


def test_the_options_of_a_command_describe_a_board() -> None:
    assert board_option("chessboard", "11x8", 12.0) == Board(BoardKind.CHESSBOARD, 11, 8, 12.0)
    charuco = board_option("charuco", "11 X 8", 12.0, 8.0, "DICT_4X4_100")
    assert charuco == Board(BoardKind.CHARUCO, 11, 8, 12.0, 8.0, "DICT_4X4_100")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("chessboard", "11", 12.0), "COLUMNSxROWS"),
        (("chessboard", "11x8", 0.0), "--square-mm"),
        (("chessboard", "11", -1.0), r"--corners.*--square-mm"),
        (("chessboard", "2x8", 12.0), "3 to 60"),
        (("chessboard", "11x8", 12.0, 9.0), "belong to a ChArUco board"),
        (("charuco", "11x8", 12.0, 13.0), "0.1 to 0.99 of the square's 12 mm"),
        (("charuco", "11x8", 12.0, 5e-324), "of the square's 12 mm, found 4.94066e-324"),
        (("charuco", "11x8", 12.0, 12 * (1 - 1e-9)), "0.1 to 0.99 of the square's 12 mm"),
        (("charuco", "11x8", 12.0, 9.0, "DICT_3X3_9"), "no dictionary 'DICT_3X3_9'; it has .*DICT_5X5_250"),
        (("charuco", "11x8", 12.0, 9.0, "DICT_4X4_50"), "needs 54 markers and DICT_4X4_50 has 50"),
    ],
)
def test_options_that_describe_no_board_are_refused(options: tuple[str, str, float], words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        board_option(*options)


def test_every_dictionary_named_is_one_of_opencvs() -> None:
    board = board_option("charuco", "5x4", 10.0, dictionary="DICT_APRILTAG_36H11")
    assert charuco_board(board).getDictionary().markerSize == 6
    assert cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11).markerSize == 6


def test_readings_of_both_scales_make_the_board_what_its_print_is() -> None:
    board = Board(BoardKind.CHARUCO, 11, 8, 12.0)
    assert board.rulers_mm == (140, 100)
    read = board.as_read(140.7, 99.9)
    assert read.square_mm == pytest.approx(12 * 1.005)
    assert read.marker_mm == pytest.approx(9 * 1.005)
    assert read.aspect == pytest.approx(0.999 / 1.005)
    width, height = np.ptp(read.points_mm, axis=0)[:2]
    assert (width, height) == (pytest.approx(120 * 1.005), pytest.approx(84 * 0.999))
    # A steel ruler's tenth of a millimetre over each of the lengths.
    assert read.square_sigma == pytest.approx(np.sqrt((0.1 / 140) ** 2 / 2 + (0.1 / 100) ** 2 / 2))
    assert board.as_read(140.7, 99.9, square_sigma=2e-4).square_sigma == 2e-4
    with pytest.raises(CalibrationError, match="the scale below the board is 140 mm long in print, read as 100 mm"):
        board.as_read(100, 100)
    with pytest.raises(CalibrationError, match="square_sigma: expected a share"):
        Board(BoardKind.CHARUCO, 11, 8, 12.0, square_sigma=0.1)

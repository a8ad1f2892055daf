"""Printed pages, measured in the rendered PDF and in the SVG's own numbers; boards and their numberings."""

from __future__ import annotations

import re
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.detection import find_board
from slrig.calibration.detection.lattice import equivalent_numberings, rotate_half_turn
from slrig.calibration.printing import FIT, PAGES_MM, artwork, board_pdf, board_svg, charuco_board
from slrig.cli.calibrate_local import board_option
from slrig.errors import CalibrationError
from tests.unit.calibration.painted import board_points

pdfium = pytest.importorskip("pypdfium2", reason="needs the test extra: pip install -e '.[test]'")

POINT_MM = 25.4 / 72
SVG = "{http://www.w3.org/2000/svg}"

BOARDS = [
    (Board(BoardKind.CHARUCO, 11, 8, 12.0), "A4", (297.0, 210.0)),
    (Board(BoardKind.CHESSBOARD, 7, 9, 20.0), "A4", (210.0, 297.0)),
    (Board(BoardKind.CIRCLES, 4, 11, 15.0), "letter", (215.9, 279.4)),
    (Board(BoardKind.CHESSBOARD, 11, 8, 13.0), "220x175", (220.0, 175.0)),
]


def painted_page(document: bytes, dots_per_mm: float) -> tuple[Any, tuple[float, float], str]:
    """The first page as grey levels, its width and height in mm, its text."""
    opened = pdfium.PdfDocument(document)
    page = opened[0]
    width, height = (extent * POINT_MM for extent in page.get_size())
    image = page.render(scale=dots_per_mm * POINT_MM, grayscale=True).to_numpy()
    text = page.get_textpage().get_text_range()
    opened.close()
    return image.reshape(image.shape[:2]), (width, height), text


@pytest.mark.parametrize(
    ("board", "page", "size_mm"),
    [pytest.param(*each, marks=pytest.mark.slow if each[0].kind is BoardKind.CHESSBOARD else ()) for each in BOARDS],
    ids=str,
)
def test_a_printed_board_has_its_true_size(board: Board, page: str, size_mm: tuple[float, float]) -> None:
    image, found_mm, _ = painted_page(board_pdf(board, page=page), 6.0)
    assert found_mm == pytest.approx(size_mm, abs=0.01)
    view = find_board(image, board, full_scale=255)
    assert len(view.corner) == board.corner_count
    # The painter rounds the page up to whole pixels and stretches it to them.
    mm_per_px = np.array(found_mm) / (image.shape[1], image.shape[0])
    places, truth = view.points_px * mm_per_px, board_points(board)[:, :2]
    off = (places - places.mean(axis=0)) - (truth - truth.mean(axis=0))
    assert np.abs(off).max() < 0.05


@pytest.mark.parametrize(("board", "page", "size_mm"), BOARDS[:3], ids=str)
def test_the_svg_has_the_same_shapes_in_millimetres(board: Board, page: str, size_mm: tuple[float, float]) -> None:
    tree = ElementTree.fromstring(board_svg(board, page=page))  # noqa: S314 - our own text
    assert tree.get("width") == f"{size_mm[0]:g}mm"
    assert tree.get("viewBox") == f"0 0 {size_mm[0]:g} {size_mm[1]:g}"
    circles = [(float(each.get("cx", "")), float(each.get("cy", ""))) for each in tree.iter(f"{SVG}circle")]
    if board.kind is BoardKind.CIRCLES:
        centres = np.array(circles)
        assert np.allclose(centres - centres[0], board_points(board)[:, :2] - board_points(board)[0, :2], atol=1e-3)
        return
    squares = next(iter(tree.iter(f"{SVG}path"))).get("d", "").split("Z")[:-1]
    full = [tuple(map(float, re.findall(r"-?[\d.]+", square)[:4])) for square in squares]
    assert len(full) == ((board.columns + 1) * (board.rows + 1) + 1) // 2
    sides = np.array([(to_x - x, to_y - y) for x, y, to_x, to_y in full])
    assert np.allclose(sides, board.square_mm, atol=2e-4)
    # Every inner corner is a tip of a dark square.
    tips = np.array([tip for x, y, to_x, to_y in full for tip in ((x, y), (to_x, to_y), (x, to_y), (to_x, y))])
    first = np.array([full[0][2], full[0][3]])
    for corner in board_points(board)[:, :2]:
        assert np.abs(tips - (first + corner)).sum(axis=1).min() < 1e-3


@pytest.mark.parametrize(("board", "page", "size_mm"), BOARDS, ids=str)
def test_both_scales_are_true(board: Board, page: str, size_mm: tuple[float, float]) -> None:
    tree = ElementTree.fromstring(board_svg(board, page=page))  # noqa: S314 - our own text
    black = [each for each in tree.iter(f"{SVG}line") if each.get("stroke") == "#000000"]
    spans = [[float(line.get(name, "")) for name in ("x1", "y1", "x2", "y2")] for line in black]
    across = sorted(x for x, y, to_x, to_y in spans if x == to_x and abs(to_y - y) < 5)
    down = sorted(y for x, y, to_x, to_y in spans if y == to_y and abs(to_x - x) < 5)
    for ticks, length_mm in zip((across, down), board.rulers_mm, strict=True):
        assert len(ticks) == length_mm + 1
        assert np.allclose(np.diff(ticks), 1.0, atol=2e-4)
        assert ticks[-1] - ticks[0] == pytest.approx(length_mm, abs=1e-3)
        assert length_mm >= 100
    assert size_mm[0] > across[-1]
    assert size_mm[1] > down[-1]


def test_a_page_names_the_board_and_the_command() -> None:
    _, _, text = painted_page(board_pdf(Board(BoardKind.CHARUCO, 11, 8, 12.0)), 1.0)
    words = " ".join(text.split())
    assert "11 x 8 inner corners, squares of 12 mm, markers of 9 mm from DICT_5X5_250" in words
    assert "Print at 100 %" in words
    command = "--board charuco --corners 11x8 --square-mm 12 --marker-mm 9 --dictionary DICT_5X5_250"
    assert f"slrig calibrate solve FOLDER {command} --measured-mm X Y --output calibration.json" in words


def test_the_same_board_gives_the_same_bytes() -> None:
    board = Board(BoardKind.CIRCLES, 4, 11, 15.0)
    assert board_pdf(board) == board_pdf(board)
    assert board_svg(board) == board_svg(board)


def test_a_page_made_to_fit_holds_small_and_huge_boards_and_their_texts() -> None:
    for board in (Board(BoardKind.CHARUCO, 3, 3, 4.0), Board(BoardKind.CHESSBOARD, 11, 8, 60.0)):
        _, (width, height), text = painted_page(board_pdf(board, page=FIT), 1.0)
        assert min(width, height) > 0
        assert "--output calibration.json" in " ".join(text.split())
        extent = board.print_mm[1] - board.print_mm[0]
        assert (np.array([width, height]) > extent).all()


def test_a_board_too_large_for_the_page_is_refused_with_the_largest_square_that_fits() -> None:
    with pytest.raises(CalibrationError, match=r"largest square that fits there is [\d.]+ mm.*fits on A3") as refused:
        board_pdf(Board(BoardKind.CHESSBOARD, 11, 8, 25.0), page="A4")
    largest = float(re.findall(r"there is ([\d.]+) mm", str(refused.value))[0])
    board_pdf(Board(BoardKind.CHESSBOARD, 11, 8, largest), page="A4")
    with pytest.raises(CalibrationError, match="largest square"):
        board_pdf(Board(BoardKind.CHESSBOARD, 11, 8, largest + 0.2), page="A4")


@pytest.mark.parametrize("page", ["A5", "210", "axb", ""])
def test_an_unknown_page_is_refused(page: str) -> None:
    with pytest.raises(CalibrationError, match="expected A4, A3, letter, fit or WIDTHxHEIGHT"):
        board_svg(Board(BoardKind.CHESSBOARD, 7, 9, 10.0), page=page)
    assert PAGES_MM["A4"] == (210.0, 297.0)


# ---- What a board is: its corners' places, what it refuses, and what of it is dark


KINDS = [
    Board(BoardKind.CHARUCO, 11, 8, 12.0),
    Board(BoardKind.CHESSBOARD, 7, 9, 20.0),
    Board(BoardKind.CIRCLES, 4, 11, 15.0),
    Board(BoardKind.CIRCLES, 5, 8, 15.0),
]


@pytest.mark.parametrize("board", KINDS, ids=str)
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
    for board in KINDS:
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
def test_a_print_has_as_many_numberings_as_symmetries(board: Board, numberings: int) -> None:
    views = equivalent_numberings(_whole(board), board)
    assert len(views) == numberings
    for view in views:
        # The same points, and a turn of the board takes its places to them: no reflection.
        assert np.array_equal(np.sort(view.points_px, axis=0), np.sort(views[0].points_px, axis=0))
        turn, rest, *_ = np.linalg.lstsq(
            np.column_stack([board.points_mm[view.corner, :2], np.ones(len(view.corner))]), view.points_px, rcond=None
        )
        assert float(np.sum(rest)) < 1e-12
        assert np.linalg.det(turn[:2]) == pytest.approx(1.0)


def test_two_half_turns_change_nothing_and_need_a_symmetry() -> None:
    board = Board(BoardKind.CHESSBOARD, 7, 9, 10.0)
    view = _whole(board)
    part = BoardView(view.corner[3:40], view.points_px[3:40], view.sigma_px[3:40])
    again = rotate_half_turn(rotate_half_turn(part, board), board)
    assert np.array_equal(again.corner, part.corner)
    assert np.array_equal(again.points_px, part.points_px)
    with pytest.raises(ValueError, match="one numbering"):
        rotate_half_turn(_whole(Board(BoardKind.CIRCLES, 4, 11, 10.0)), Board(BoardKind.CIRCLES, 4, 11, 10.0))


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
def test_options_of_an_invalid_board_are_refused(options: tuple[str, str, float], words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        board_option(*options)


def test_every_dictionary_named_is_one_of_opencvs() -> None:
    board = board_option("charuco", "5x4", 10.0, dictionary="DICT_APRILTAG_36H11")
    assert charuco_board(board).getDictionary().markerSize == 6
    assert cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11).markerSize == 6


def test_ruler_readings_correct_the_size_of_a_board() -> None:
    board = Board(BoardKind.CHARUCO, 11, 8, 12.0)
    assert board.rulers_mm == (140, 100)
    read = board.as_measured(140.7, 99.9)
    assert read.square_mm == pytest.approx(12 * 1.005)
    assert read.marker_mm == pytest.approx(9 * 1.005)
    assert read.aspect == pytest.approx(0.999 / 1.005)
    width, height = np.ptp(read.points_mm, axis=0)[:2]
    assert (width, height) == (pytest.approx(120 * 1.005), pytest.approx(84 * 0.999))
    # A steel ruler's tenth of a millimetre over each of the lengths.
    assert read.square_sigma == pytest.approx(np.sqrt((0.1 / 140) ** 2 / 2 + (0.1 / 100) ** 2 / 2))
    assert board.as_measured(140.7, 99.9, square_sigma=2e-4).square_sigma == 2e-4
    with pytest.raises(CalibrationError, match="the scale below the board is 140 mm long in print, read as 100 mm"):
        board.as_measured(100, 100)
    with pytest.raises(CalibrationError, match="square_sigma: expected a relative deviation"):
        Board(BoardKind.CHARUCO, 11, 8, 12.0, square_sigma=0.1)

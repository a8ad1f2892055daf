"""Printed pages, measured back: on the page as a reader of PDF paints it, and in the SVG's own numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.detection import find_board
from slrig.calibration.boards.printing import FIT, PAGES_MM, board_pdf, board_svg
from slrig.cli.boards import write_board
from slrig.errors import CalibrationError
from tests.unit.calibration.boards.painted import board_points

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


def test_a_page_says_what_it_is_and_how_to_go_on() -> None:
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


def test_a_page_made_to_fit_holds_small_and_huge_boards_and_all_their_words() -> None:
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
def test_a_page_that_is_none_is_refused(page: str) -> None:
    with pytest.raises(CalibrationError, match="expected A4, A3, letter, fit or WIDTHxHEIGHT"):
        board_svg(Board(BoardKind.CHESSBOARD, 7, 9, 10.0), page=page)
    assert PAGES_MM["A4"] == (210.0, 297.0)


def test_the_command_writes_either_kind_of_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    board = Board(BoardKind.CHESSBOARD, 11, 8, 12.0)
    write_board(board, tmp_path / "new" / "board.pdf", page="A4")
    write_board(board, tmp_path / "board.svg", page="A4")
    assert (tmp_path / "new" / "board.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "board.svg").read_text().startswith("<?xml")
    assert "slrig calibrate solve FOLDER --board chessboard --corners 11x8" in capsys.readouterr().out
    with pytest.raises(CalibrationError, match=r"ends in \.pdf or \.svg"):
        write_board(board, tmp_path / "board.png", page="A4")
    assert not (tmp_path / "board.png").exists()

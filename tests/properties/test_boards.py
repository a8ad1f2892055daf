"""Boards: whatever the board and the page, a page holds what it promises; whatever the view, its numberings agree."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from slrig.calibration.board import Board, BoardKind, BoardView
from slrig.calibration.detection.lattice import equivalent_numberings
from slrig.calibration.printing import FIT, PAGES_MM, artwork, board_svg
from slrig.errors import CalibrationError

SVG = "{http://www.w3.org/2000/svg}"

boards = some.builds(
    Board, some.sampled_from(BoardKind), some.integers(3, 14), some.integers(3, 14), some.floats(1.0, 60.0)
)


@settings(max_examples=8, deadline=None)
@given(board=boards, page=some.sampled_from([*PAGES_MM, FIT]))
def test_all_that_is_printed_lies_on_the_page_or_the_largest_square_is_told(board: Board, page: str) -> None:
    try:
        tree = ElementTree.fromstring(board_svg(board, page=page))  # noqa: S314 - our own text
    except CalibrationError as refused:
        assert page != FIT
        told = re.search(r"largest square that fits there is ([\d.]+) mm", str(refused))
        assert told is None or float(told[1]) < board.square_mm
        return
    width, height = (float(side) for side in tree.get("viewBox", "").split()[2:])
    shapes = [
        [float(number) for number in re.findall(r"-?[\d.]+", part)]
        for path in tree.iter(f"{SVG}path")
        for part in path.get("d", "").split("Z")[:-1]
    ]
    ends = [(x, y) for left, top, right, bottom, *_ in shapes for x, y in ((left, top), (right, bottom))]
    for circle in tree.iter(f"{SVG}circle"):
        x, y, radius = (float(circle.get(name, "")) for name in ("cx", "cy", "r"))
        ends += [(x - radius, y - radius), (x + radius, y + radius)]
    ends += [
        (float(line.get(f"x{end}", "")), float(line.get(f"y{end}", "")))
        for line in tree.iter(f"{SVG}line")
        for end in "12"
    ]
    places = np.array(ends)
    assert (places >= 0).all()
    assert (places <= [width + 1e-3, height + 1e-3]).all()
    drawn = artwork(board)
    assert len(shapes) == len(drawn.rectangles_mm)
    assert float(tree.get("width", "").removesuffix("mm")) == pytest.approx(width)


@settings(max_examples=20, deadline=None)
@given(board=boards, seed=some.integers(0, 999))
def test_numberings_come_back_to_where_they_began(board: Board, seed: int) -> None:
    random = np.random.default_rng(seed)
    corner = np.flatnonzero(random.random(board.corner_count) < 0.7).astype(np.int32)
    view = BoardView(corner, random.random((len(corner), 2)), random.random(len(corner)))
    views = equivalent_numberings(view, board)
    numbers = {tuple(each.corner.tolist()) for each in views}
    for each in views:
        assert (np.diff(each.corner) > 0).all()
        again = {tuple(other.corner.tolist()) for other in equivalent_numberings(each, board)}
        assert again == numbers

"""Boards to print in true size: artwork, and pages as SVG or PDF with rulers that check the printer.

Everything is drawn in vectors, from one list of shapes in millimetres from the page's upper left corner.
"""

from __future__ import annotations

import html
import io
import math
import re
import textwrap
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardKind
from slrig.errors import CalibrationError
from slrig.model import FloatArray, IntArray

CIRCLE_RADIUS = 0.5
"""A printed circle's radius over `square_mm`, the distance of two rows. Detection takes circles of any radius."""

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name.upper() == name))
"""OpenCV's marker dictionaries, by name."""


@dataclass(frozen=True, slots=True)
class Artwork:
    """The dark shapes of a board. Everything else is paper.

    rectangles_mm : (n, 2, 2) float64, the least and the greatest (x, y) of each; group : (n,) int32, rising,
    rectangles of one number belong in one path, so that no seam shows where they touch: 0 the squares, then one number
    for each marker.
    circles_mm : (m, 3) float64, x, y, radius.
    """

    rectangles_mm: FloatArray
    group: IntArray
    circles_mm: FloatArray


def artwork(board: Board, *, light_first: bool = False) -> Artwork:
    """Every dark shape of a board: the squares (the one up and left of corner 0 is dark, unless `light_first`), the
    markers, the circles.

    Raises CalibrationError where OpenCV has no such dictionary, or it has fewer markers than the board needs.
    """
    no_rectangles, no_circles = np.zeros((0, 2, 2)), np.zeros((0, 3))
    if board.kind is BoardKind.CIRCLES:
        centres = board.points_mm[:, :2]
        radius = np.full((len(centres), 1), CIRCLE_RADIUS * board.square_mm)
        return Artwork(no_rectangles, np.zeros(0, dtype=np.int32), np.hstack([centres, radius]))
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1]
    dark = (row + column) % 2 == int(light_first)
    least = np.column_stack([column[dark], row[dark]]) - 1.0
    shapes = [np.stack([least, least + 1], axis=1) * board.square_mm]
    if board.kind is BoardKind.CHARUCO:
        shapes += _markers(board, light_first)
    group = np.repeat(np.arange(len(shapes), dtype=np.int32), [len(shape) for shape in shapes])
    return Artwork(np.concatenate(shapes), group, no_circles)


def charuco_board(board: Board, *, light_first: bool = False) -> Any:
    """OpenCV's own description of a ChArUco board: `cv2.aruco.CharucoBoard`, its origin one square up and left of ours.

    light_first : the layout of OpenCV before 4.6 (`setLegacyPattern`); another one only where the number of rows of
    squares is even.

    Raises CalibrationError where OpenCV has no such dictionary, or it has fewer markers than the board needs.
    """
    markers = marker_dictionary(str(board.dictionary))
    needed, held = (board.columns + 1) * (board.rows + 1) // 2, len(markers.bytesList)
    if needed > held:
        message = (
            f"the board: {board.title} needs {needed} markers and {board.dictionary} has {held}: "
            "take fewer corners, or a dictionary of more markers, DICT_5X5_1000 for one"
        )
        raise CalibrationError(message)
    squares = (board.columns + 1, board.rows + 1)
    described = cv2.aruco.CharucoBoard(squares, board.square_mm, float(board.marker_mm or 0), markers)
    described.setLegacyPattern(light_first)
    return described


def marker_dictionary(name: str) -> Any:
    """OpenCV's dictionary of markers of this name: `cv2.aruco.Dictionary`.

    Raises CalibrationError where there is none of this name.
    """
    if name not in DICTIONARIES:
        message = f"the board: OpenCV has no dictionary {name!r}; it has {', '.join(DICTIONARIES)}"
        raise CalibrationError(message)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _markers(board: Board, light_first: bool) -> list[FloatArray]:
    """The dark cells of each marker, runs within a row joined: (n, 2, 2) float64 each, mm."""
    described = charuco_board(board, light_first=light_first)
    dictionary = described.getDictionary()
    cells = int(dictionary.markerSize) + 2
    shapes = []
    for number, corners in zip(described.getIds().ravel(), described.getObjPoints(), strict=True):
        dark: NDArray[np.bool_] = cv2.aruco.generateImageMarker(dictionary, int(number), cells) == 0
        origin = np.asarray(corners, dtype=np.float64)[0, :2] - board.square_mm
        runs = [(row, *run) for row in range(cells) for run in _runs(dark[row])]
        shape = np.array([[(first, row), (beyond, row + 1)] for row, first, beyond in runs], dtype=np.float64)
        shapes.append(origin + shape * (float(board.marker_mm or 0) / cells))
    return shapes


def _runs(dark: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The first cell of each run of dark cells, and the one beyond its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(np.int8)))
    return [(int(first), int(beyond)) for first, beyond in edges.reshape(-1, 2)]


PAGES_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of pages by name, upright."""

FIT = "fit"
"""The page that is as large as the board needs."""

_MARGIN_MM = 6.0
_QUIET_MM = 5.0
_RULER_MM = 9.0
_LINE_MM = 3.6
_FONT_MM = 2.6
_LETTER = 0.53
"""Width of a letter of the font over its size, on average and a little more."""
_LEAST_WIDTH_MM = 90.0
"""Of a page that is made to fit: a line of the foot wants some room."""
_STROKE_MM = 0.15
_BORDER_GREY, _INK_GREY = 0.8, 0.25


class _Text(NamedTuple):
    """x_mm, y_mm : of the line's start, or its middle; turned : written upwards."""

    text: str
    x_mm: float
    y_mm: float
    size_mm: float
    centred: bool = False
    turned: bool = False


class _Line(NamedTuple):
    x_mm: float
    y_mm: float
    to_x_mm: float
    to_y_mm: float
    grey: float


@dataclass(frozen=True, slots=True)
class _Page:
    """rectangles_mm : per shape, (n, 2, 2), drawn as one path; circles_mm : (m, 3), x, y, radius."""

    width_mm: float
    height_mm: float
    title: str
    rectangles_mm: list[FloatArray]
    circles_mm: FloatArray
    lines: list[_Line]
    texts: list[_Text]


def board_svg(board: Board, *, page: str = "A4") -> str:
    """A page with the board as an SVG document, to be printed at 100 %.

    page : A4, A3, letter; `fit`, a page as large as the board needs; or WIDTHxHEIGHT in mm, 600x400. A page is turned
    on its side where the board needs it.

    Raises
    ------
    CalibrationError
        There is no such page, or the board does not fit on it.
    """
    drawn = _laid_out(board, page)
    width, height = _number(drawn.width_mm), _number(drawn.height_mm)
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}">',
        f"<title>{html.escape(drawn.title)}</title>",
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for shape in drawn.rectangles_mm:
        path = "".join(
            f"M{_number(x)} {_number(y)}H{_number(to_x)}V{_number(to_y)}H{_number(x)}Z"
            for (x, y), (to_x, to_y) in shape
        )
        parts.append(f'<path d="{path}" fill="#000"/>')
    parts += [
        f'<circle cx="{_number(x)}" cy="{_number(y)}" r="{_number(radius)}" fill="#000"/>'
        for x, y, radius in drawn.circles_mm
    ]
    for line in drawn.lines:
        x, y, to_x, to_y = (_number(place) for place in line[:4])
        stroke = f'stroke="{_colour(line.grey)}" stroke-width="{_STROKE_MM}"'
        parts.append(f'<line x1="{x}" y1="{y}" x2="{to_x}" y2="{to_y}" {stroke}/>')
    for text in drawn.texts:
        x, y, size = (_number(place) for place in text[1:4])
        anchor = ' text-anchor="middle"' if text.centred else ""
        turn = f' transform="rotate(-90 {x} {y})"' if text.turned else ""
        parts.append(
            f'<text x="{x}" y="{y}" font-family="Helvetica, Arial, sans-serif" font-size="{size}" '
            f'fill="{_colour(_INK_GREY)}"{anchor}{turn}>{html.escape(text.text)}</text>'
        )
    return "\n".join([*parts, "</svg>", ""])


def board_pdf(board: Board, *, page: str = "A4") -> bytes:
    """The same page as a PDF document. The same board and page give the same bytes.

    Raises CalibrationError as `board_svg` does.
    """
    from reportlab.lib.units import mm
    from reportlab.pdfgen.canvas import Canvas

    drawn = _laid_out(board, page)
    held = io.BytesIO()
    canvas = Canvas(held, pagesize=(drawn.width_mm * mm, drawn.height_mm * mm), invariant=1)
    canvas.setTitle(drawn.title)
    canvas.setCreator("slrig")
    # No scaling as the print dialogue's first choice: most readers heed it.
    canvas.setViewerPreference("PrintScaling", "None")
    top_mm = drawn.height_mm
    canvas.setFillGray(0)
    for shape in drawn.rectangles_mm:
        path = canvas.beginPath()
        for (x, y), (to_x, to_y) in shape:
            path.rect(x * mm, (top_mm - to_y) * mm, (to_x - x) * mm, (to_y - y) * mm)
        canvas.drawPath(path, stroke=0, fill=1)
    for x, y, radius in drawn.circles_mm:
        canvas.circle(x * mm, (top_mm - y) * mm, radius * mm, stroke=0, fill=1)
    canvas.setLineWidth(_STROKE_MM * mm)
    for line in drawn.lines:
        canvas.setStrokeGray(line.grey)
        canvas.line(line.x_mm * mm, (top_mm - line.y_mm) * mm, line.to_x_mm * mm, (top_mm - line.to_y_mm) * mm)
    canvas.setFillGray(_INK_GREY)
    for text in drawn.texts:
        canvas.saveState()
        canvas.translate(text.x_mm * mm, (top_mm - text.y_mm) * mm)
        canvas.rotate(90 if text.turned else 0)
        canvas.setFont("Helvetica", text.size_mm * mm)
        (canvas.drawCentredString if text.centred else canvas.drawString)(0, 0, text.text)
        canvas.restoreState()
    canvas.save()
    return held.getvalue()


def solve_command(board: Board) -> str:
    """The command that calibrates from poses of this board."""
    charuco = board.kind is BoardKind.CHARUCO
    further = f" --marker-mm {board.marker_mm:g} --dictionary {board.dictionary}" if charuco else ""
    return (
        f"slrig calibrate solve FOLDER --board {board.kind} --corners {board.columns}x{board.rows} "
        f"--square-mm {board.square_mm:g}{further} --measured-mm X Y "
        "--output calibration.json"
    )


def _laid_out(board: Board, page: str) -> _Page:
    """The page: the board in its quiet zone, a ruler left of it and one below, text at the foot."""
    (left, top), (right, bottom) = board.print_mm
    wide_mm, high_mm = float(right - left), float(bottom - top)
    width_mm, height_mm = _page_mm(board, page)
    needed, texts = _needed_mm(board, width_mm), _foot(board, width_mm)
    # The board stands in the middle of what rulers and text leave.
    x_mm = _MARGIN_MM + _RULER_MM + _QUIET_MM + (width_mm - needed[0]) / 2
    y_mm = _MARGIN_MM + _QUIET_MM + (height_mm - needed[1]) / 2
    art = artwork(board)
    origin = [x_mm - left, y_mm - top]
    shapes = [art.rectangles_mm[art.group == group] + origin for group in range(int(art.group.max(initial=-1)) + 1)]
    circles = art.circles_mm + np.array([*origin, 0.0])
    below_mm = y_mm + high_mm + _QUIET_MM
    (west, north), (east, south) = (x_mm - _QUIET_MM, y_mm - _QUIET_MM), (x_mm + wide_mm + _QUIET_MM, below_mm)
    border = [(west, north), (east, north), (east, south), (west, south), (west, north)]
    lines = [_Line(*one, *other, _BORDER_GREY) for one, other in pairwise(border)]
    foot_mm = height_mm - _MARGIN_MM - _LINE_MM * (len(texts) - 0.75)
    written = [_Text(text, _MARGIN_MM, foot_mm + _LINE_MM * index, _FONT_MM) for index, text in enumerate(texts)]
    across_mm, down_mm = board.rulers_mm
    for upright, start_x, start_y, length_mm in (
        (False, x_mm, below_mm + 1.0, across_mm),
        (True, x_mm - _QUIET_MM - 1.0, y_mm, down_mm),
    ):
        ticks, numbers = _ruler(start_x, start_y, length_mm, upright=upright)
        lines += ticks
        written += numbers
    return _Page(width_mm, height_mm, f"slrig: {board.title}", shapes, circles, lines, written)


def _foot(board: Board, width_mm: float) -> list[str]:
    """The lines at the foot of a page of this width: what the board is, how to print it, how to calibrate with it."""
    said = (
        f"slrig: {board.description}",
        "Print at 100 % (actual size). Hold a ruler to both scales, and give their lengths as measured.",
        solve_command(board),
    )
    letters = max(20, int((width_mm - 2 * _MARGIN_MM) / (_LETTER * _FONT_MM)))
    return [line for text in said for line in textwrap.wrap(text, letters, break_on_hyphens=False)]


def _needed_mm(board: Board, width_mm: float) -> tuple[float, float]:
    """Width and height, mm, that the board needs with margins, quiet zone, rulers and its foot on a page this wide."""
    wide_mm, high_mm = (board.print_mm[1] - board.print_mm[0]).tolist()
    around_mm = 2 * _MARGIN_MM + 2 * _QUIET_MM + _RULER_MM
    return wide_mm + around_mm, high_mm + around_mm + _LINE_MM * len(_foot(board, width_mm))


def _page_mm(board: Board, page: str) -> tuple[float, float]:
    """Width and height of the page, mm, turned on its side where the board needs that."""
    if page == FIT:
        width_mm = max(_needed_mm(board, _LEAST_WIDTH_MM)[0], _LEAST_WIDTH_MM)
        return width_mm, _needed_mm(board, width_mm)[1]
    sides = _sides_mm(page)
    turned = _turned_to_fit(board, sides)
    if turned is not None:
        return turned
    squares = ((board.print_mm[1] - board.print_mm[0]) / board.square_mm).tolist()
    largest = 0.0
    for width_mm, height_mm in (sides, sides[::-1]):
        needed = _needed_mm(board, width_mm)
        spare = (width_mm - needed[0], height_mm - needed[1])
        largest = max(largest, board.square_mm + min(spare[0] / squares[0], spare[1] / squares[1]))
    largest = math.floor(10 * largest + 1e-9) / 10
    advice = f"the largest square that fits there is {largest:g} mm" if largest > 0 else "no square fits there"
    other = [name for name in PAGES_MM if _turned_to_fit(board, PAGES_MM[name])]
    if other:
        advice += f"; it fits on {' and '.join(other)}"
    needed = _needed_mm(board, max(sides))
    message = (
        f"the board: {board.title} needs a page of {needed[0]:.0f} x {needed[1]:.0f} mm with its rulers, and {page} "
        f"has {sides[0]:g} x {sides[1]:g} mm: {advice}; page {FIT} (--page {FIT}) is as large as it needs"
    )
    raise CalibrationError(message)


def _turned_to_fit(board: Board, sides: tuple[float, float]) -> tuple[float, float] | None:
    """The page upright or on its side, whichever is as the board is and holds it; None where neither does."""
    wide_mm, high_mm = (board.print_mm[1] - board.print_mm[0]).tolist()
    for width_mm, height_mm in sorted((sides, sides[::-1]), reverse=wide_mm > high_mm):
        needed = _needed_mm(board, width_mm)
        if needed[0] <= width_mm and needed[1] <= height_mm:
            return width_mm, height_mm
    return None


def _sides_mm(page: str) -> tuple[float, float]:
    named = {name.lower(): sides for name, sides in PAGES_MM.items()}.get(page.lower())
    if named is not None:
        return named
    given = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page)
    if given is None:
        message = f"the page: expected {', '.join(PAGES_MM)}, {FIT} or WIDTHxHEIGHT in mm (600x400), found {page!r}"
        raise CalibrationError(message)
    return float(given[1]), float(given[2])


def _ruler(x_mm: float, y_mm: float, length: int, *, upright: bool) -> tuple[list[_Line], list[_Text]]:
    """A scale in mm from (x_mm, y_mm): to the right, its ticks downwards, or downwards, its ticks to the left."""
    ticks, numbers = [], []

    def place(along: float, away: float) -> tuple[float, float]:
        return (x_mm - away, y_mm + along) if upright else (x_mm + along, y_mm + away)

    for at in range(length + 1):
        tick = 4.0 if at % 10 == 0 else 3.0 if at % 5 == 0 else 2.0
        ticks.append(_Line(*place(at, 0), *place(at, tick), 0.0))
        if at % 10 == 0:
            told = f"{at} mm" if at == length - length % 10 else str(at)
            numbers.append(_Text(told, *place(at, 4.7 if upright else 6.7), 2.2, centred=True, turned=upright))
    return [*ticks, _Line(x_mm, y_mm, *place(length, 0), 0.0)], numbers


def _number(value: float) -> str:
    """Millimetres to a tenth of a micrometre, without needless zeros."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _colour(grey: float) -> str:
    return "#" + 3 * f"{round(255 * grey):02x}"

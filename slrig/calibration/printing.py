"""Boards to print in true size, on pages in SVG or PDF with scales that check the printer.

Vector graphics from one list of shapes, in millimetres from the page's upper left corner.
"""

from __future__ import annotations

import html
import math
import re
import textwrap
import zlib
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
"""Radius of a printed circle over `square_mm`. Detection accepts other radii."""

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name.upper() == name))
"""Names of OpenCV's marker dictionaries."""
PAGES_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of pages by name, upright."""
FIT = "fit"
"""Name of a page that is as large as the board requires."""
_MARGIN_MM = 6.0
_QUIET_MM = 5.0
_RULER_MM = 9.0
_LINE_MM = 3.6
_FONT_MM = 2.6
_LETTER_WIDTH = 0.53
"""Mean width of a letter over the font size, rounded up."""
_MIN_WIDTH_MM = 90.0
"""Least width of a page made to fit, for the lines of the footer."""
_STROKE_MM = 0.15
_BORDER_GREY, _INK_GREY = 0.8, 0.25
_POINTS_PER_MM = 72 / 25.4
_STREAM = 4
"""Number of the object of a PDF that holds the drawing."""


@dataclass(frozen=True, slots=True)
class Artwork:
    """Dark shapes of a board on paper.

    rectangles_mm : (n, 2, 2) float64, least and greatest (x, y) of each; group : (n,) int32, ascending: 0 for the
    squares, then one number per marker. Rectangles of one group share a path, so that no seam shows between them.
    circles_mm : (m, 3) float64, x, y, radius.
    """

    rectangles_mm: FloatArray
    group: IntArray
    circles_mm: FloatArray


def artwork(board: Board, *, light_first: bool = False) -> Artwork:
    """Dark squares, marker cells and circles of a board. The square up and left of corner 0 is dark, unless
    `light_first`.

    Raises CalibrationError where OpenCV has no such dictionary, or it has too few markers for the board.
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
        shapes += _marker_cells(board, light_first)
    group = np.repeat(np.arange(len(shapes), dtype=np.int32), [len(shape) for shape in shapes])
    return Artwork(np.concatenate(shapes), group, no_circles)


def charuco_board(board: Board, *, light_first: bool = False) -> Any:
    """OpenCV's `cv2.aruco.CharucoBoard` of a ChArUco board, its origin one square up and left of corner 0.

    light_first : the layout of OpenCV before 4.6 (`setLegacyPattern`), which differs only for an even number of rows of
    squares.

    Raises CalibrationError where OpenCV has no such dictionary, or it has too few markers for the board.
    """
    markers = marker_dictionary(str(board.dictionary))
    needed, available = (board.columns + 1) * (board.rows + 1) // 2, len(markers.bytesList)
    if needed > available:
        message = (
            f"the board: {board.title} needs {needed} markers and {board.dictionary} has {available}: "
            "choose fewer corners, or a dictionary with more markers, such as DICT_5X5_1000"
        )
        raise CalibrationError(message)
    squares = (board.columns + 1, board.rows + 1)
    layout = cv2.aruco.CharucoBoard(squares, board.square_mm, float(board.marker_mm or 0), markers)
    layout.setLegacyPattern(light_first)
    return layout


def marker_dictionary(name: str) -> Any:
    """OpenCV's `cv2.aruco.Dictionary` of this name.

    Raises CalibrationError where OpenCV has none of this name.
    """
    if name not in DICTIONARIES:
        message = f"the board: OpenCV has no dictionary {name!r}; it has {', '.join(DICTIONARIES)}"
        raise CalibrationError(message)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _marker_cells(board: Board, light_first: bool) -> list[FloatArray]:
    """(n, 2, 2) float64 mm per marker: its dark cells, joined to runs within a row."""
    layout = charuco_board(board, light_first=light_first)
    dictionary = layout.getDictionary()
    cells = int(dictionary.markerSize) + 2
    shapes = []
    for number, corners in zip(layout.getIds().ravel(), layout.getObjPoints(), strict=True):
        dark: NDArray[np.bool_] = cv2.aruco.generateImageMarker(dictionary, int(number), cells) == 0
        origin = np.asarray(corners, dtype=np.float64)[0, :2] - board.square_mm
        # Each run starts at one edge and ends at the next.
        row, edge = np.nonzero(np.diff(np.pad(dark.astype(np.int8), ((0, 0), (1, 1)))))
        row, first, end = row[::2], edge[::2], edge[1::2]
        shape = np.stack([np.column_stack([first, row]), np.column_stack([end, row + 1])], axis=1)
        shapes.append(origin + shape * (float(board.marker_mm or 0) / cells))
    return shapes


class _Text(NamedTuple):
    """A line of text. x_mm, y_mm : its start, or its middle where centred; vertical : written upwards."""

    text: str
    x_mm: float
    y_mm: float
    size_mm: float
    centred: bool = False
    vertical: bool = False


class _Line(NamedTuple):
    x_mm: float
    y_mm: float
    to_x_mm: float
    to_y_mm: float
    grey: float


@dataclass(frozen=True, slots=True)
class _Page:
    """Contents of a page. rectangles_mm : per path, (n, 2, 2); circles_mm : (m, 3), x, y, radius."""

    width_mm: float
    height_mm: float
    title: str
    rectangles_mm: list[FloatArray]
    circles_mm: FloatArray
    lines: list[_Line]
    texts: list[_Text]


def board_svg(board: Board, *, page: str = "A4") -> str:
    """A page with the board as an SVG document, to be printed at 100 %.

    page : A4, A3, letter; `fit`, as large as the board requires; or WIDTHxHEIGHT in mm (600x400). Pages are used
    upright or on their side.

    Raises CalibrationError if the page is not known, or the board does not fit on it.
    """
    content = _lay_out_page(board, page)
    width, height = _format_mm(content.width_mm), _format_mm(content.height_mm)
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}">',
        f"<title>{html.escape(content.title)}</title>",
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for shape in content.rectangles_mm:
        path = "".join(
            f"M{_format_mm(x)} {_format_mm(y)}H{_format_mm(to_x)}V{_format_mm(to_y)}H{_format_mm(x)}Z"
            for (x, y), (to_x, to_y) in shape
        )
        parts.append(f'<path d="{path}" fill="#000"/>')
    parts += [
        f'<circle cx="{_format_mm(x)}" cy="{_format_mm(y)}" r="{_format_mm(radius)}" fill="#000"/>'
        for x, y, radius in content.circles_mm
    ]
    for line in content.lines:
        x, y, to_x, to_y = (_format_mm(place) for place in line[:4])
        stroke = f'stroke="{_colour(line.grey)}" stroke-width="{_STROKE_MM}"'
        parts.append(f'<line x1="{x}" y1="{y}" x2="{to_x}" y2="{to_y}" {stroke}/>')
    for text in content.texts:
        x, y, size = (_format_mm(place) for place in text[1:4])
        anchor = ' text-anchor="middle"' if text.centred else ""
        turn = f' transform="rotate(-90 {x} {y})"' if text.vertical else ""
        parts.append(
            f'<text x="{x}" y="{y}" font-family="Helvetica, Arial, sans-serif" font-size="{size}" '
            f'fill="{_colour(_INK_GREY)}"{anchor}{turn}>{html.escape(text.text)}</text>'
        )
    return "\n".join([*parts, "</svg>", ""])


def board_pdf(board: Board, *, page: str = "A4") -> bytes:
    """The same page as a PDF document. Equal boards and pages give equal bytes.

    Raises CalibrationError as `board_svg` does.
    """
    content = _lay_out_page(board, page)
    width, height = (_format_mm(extent * _POINTS_PER_MM) for extent in (content.width_mm, content.height_mm))
    # From here on in millimetres from the upper left corner, y down.
    drawn = [f"{_POINTS_PER_MM:.8f} 0 0 {-_POINTS_PER_MM:.8f} 0 {height} cm 0 g"]
    for shape in content.rectangles_mm:
        sides = ((*least, *(most - least)) for least, most in shape)
        drawn += [" ".join(map(_format_mm, each)) + " re" for each in sides] + ["f"]
    drawn += [_circle_path(*circle) for circle in content.circles_mm]
    drawn.append(f"{_STROKE_MM} w")
    for line in content.lines:
        x, y, to_x, to_y = map(_format_mm, line[:4])
        drawn.append(f"{line.grey} G {x} {y} m {to_x} {to_y} l S")
    drawn.append(f"{_INK_GREY} g")
    for text in content.texts:
        before_mm = sum(map(_letter_width, text.text)) * text.size_mm / 2 if text.centred else 0.0
        x_mm, y_mm = (text.x_mm, text.y_mm + before_mm) if text.vertical else (text.x_mm - before_mm, text.y_mm)
        turn = "0 -1 -1 0" if text.vertical else "1 0 0 -1"
        x, y, size = map(_format_mm, (x_mm, y_mm, text.size_mm))
        drawn.append(f"BT /F1 {size} Tf {turn} {x} {y} Tm {_pdf_text(text.text)} Tj ET")
    stream = zlib.compress("\n".join(drawn).encode("cp1252", "replace"))
    objects = [
        # Most readers then offer printing without scaling first.
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width} {height}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>",
        f"<< /Length {len(stream)} /Filter /FlateDecode >>\nstream\n",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        f"<< /Title {_pdf_text(content.title)} /Creator (slrig) >>",
    ]
    document, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        places.append(f"{len(document):010} 00000 n \n")
        inside = body.encode("cp1252", "replace") + (stream + b"\nendstream" if number == _STREAM else b"")
        document += b"%d 0 obj\n%b\nendobj\n" % (number, inside)
    count = len(objects) + 1
    ending = (
        f"xref\n0 {count}\n0000000000 65535 f \n{''.join(places)}trailer\n<< /Size {count} /Root 1 0 R /Info 6 0 R >>\n"
    )
    return document + f"{ending}startxref\n{len(document)}\n%%EOF\n".encode()


def _circle_path(x_mm: float, y_mm: float, radius_mm: float) -> str:
    """A filled circle of four cubic curves, whose radius is true to 0.03 %."""
    handle = 4 / 3 * (math.sqrt(2) - 1)
    parts = [f"{_format_mm(x_mm + radius_mm)} {_format_mm(y_mm)} m"]
    for cosine, sine in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        corners = ((cosine - handle * sine, sine + handle * cosine), (handle * cosine - sine, handle * sine + cosine))
        points = (*corners, (-sine, cosine))
        parts.append(
            " ".join(_format_mm(at + radius_mm * off) for x, y in points for at, off in ((x_mm, x), (y_mm, y))) + " c"
        )
    return " ".join([*parts, "f"])


def _letter_width(letter: str) -> float:
    """Width of a letter of a scale's numbers in Helvetica, over the font size."""
    return {" ": 0.278, "m": 0.833}.get(letter, 0.556)


def _pdf_text(text: str) -> str:
    return "(" + re.sub(r"([\\()])", r"\\\1", text) + ")"


def solve_command(board: Board) -> str:
    """The command that calibrates from poses of this board."""
    is_charuco = board.kind is BoardKind.CHARUCO
    marker_options = f" --marker-mm {board.marker_mm:g} --dictionary {board.dictionary}" if is_charuco else ""
    return (
        f"slrig calibrate solve FOLDER --board {board.kind} --corners {board.columns}x{board.rows} "
        f"--square-mm {board.square_mm:g}{marker_options} --measured-mm X Y "
        "--output calibration.json"
    )


def _lay_out_page(board: Board, page: str) -> _Page:
    """Place the board in its quiet zone, a scale left of it and one below, and text at the bottom."""
    board_width_mm, board_height_mm = board.print_size_mm
    width_mm, height_mm = _page_size_mm(board, page)
    required_mm, footer = _required_size_mm(board, width_mm), _footer_lines(board, width_mm)
    # The board is centred in the space that scales and text leave.
    x_mm = _MARGIN_MM + _RULER_MM + _QUIET_MM + (width_mm - required_mm[0]) / 2
    y_mm = _MARGIN_MM + _QUIET_MM + (height_mm - required_mm[1]) / 2
    art = artwork(board)
    origin = np.array([x_mm, y_mm]) - board.print_mm[0]
    shapes = [art.rectangles_mm[art.group == group] + origin for group in range(int(art.group.max(initial=-1)) + 1)]
    circles = art.circles_mm + np.append(origin, 0.0)
    west, north = x_mm - _QUIET_MM, y_mm - _QUIET_MM
    east, south = x_mm + board_width_mm + _QUIET_MM, y_mm + board_height_mm + _QUIET_MM
    border = [(west, north), (east, north), (east, south), (west, south), (west, north)]
    lines = [_Line(*start, *end, _BORDER_GREY) for start, end in pairwise(border)]
    footer_mm = height_mm - _MARGIN_MM - _LINE_MM * (len(footer) - 0.75)
    texts = [_Text(text, _MARGIN_MM, footer_mm + _LINE_MM * index, _FONT_MM) for index, text in enumerate(footer)]
    across_mm, down_mm = board.rulers_mm
    across = _ruler(x_mm, south + 1.0, across_mm, vertical=False)
    down = _ruler(west - 1.0, y_mm, down_mm, vertical=True)
    lines += across[0] + down[0]
    texts += across[1] + down[1]
    return _Page(width_mm, height_mm, f"slrig: {board.title}", shapes, circles, lines, texts)


def _footer_lines(board: Board, width_mm: float) -> list[str]:
    """Lines of text for a page of this width: the board, how to print it and how to calibrate with it."""
    texts = (
        f"slrig: {board.description}",
        "Print at 100 % (actual size). Hold a ruler to both scales, and give their lengths as measured.",
        solve_command(board),
    )
    letters = max(20, int((width_mm - 2 * _MARGIN_MM) / (_LETTER_WIDTH * _FONT_MM)))
    return [line for text in texts for line in textwrap.wrap(text, letters, break_on_hyphens=False)]


def _required_size_mm(board: Board, width_mm: float) -> tuple[float, float]:
    """Width and height of the board with margins, quiet zone, scales and the footer of a page of this width."""
    board_width_mm, board_height_mm = board.print_size_mm
    around_mm = 2 * _MARGIN_MM + 2 * _QUIET_MM + _RULER_MM
    return board_width_mm + around_mm, board_height_mm + around_mm + _LINE_MM * len(_footer_lines(board, width_mm))


def _page_size_mm(board: Board, page: str) -> tuple[float, float]:
    """Width and height of the page, upright or on its side as the board requires."""
    if page == FIT:
        width_mm = max(_required_size_mm(board, _MIN_WIDTH_MM)[0], _MIN_WIDTH_MM)
        return width_mm, _required_size_mm(board, width_mm)[1]
    sides = _parse_page_mm(page)
    oriented_mm = _oriented_page_mm(board, sides)
    if oriented_mm is not None:
        return oriented_mm
    columns, rows = (extent / board.square_mm for extent in board.print_size_mm)
    largest = 0.0
    for width_mm, height_mm in (sides, sides[::-1]):
        required_mm = _required_size_mm(board, width_mm)
        spare_mm = min((width_mm - required_mm[0]) / columns, (height_mm - required_mm[1]) / rows)
        largest = max(largest, board.square_mm + spare_mm)
    largest = math.floor(10 * largest + 1e-9) / 10
    advice = f"the largest square that fits there is {largest:g} mm" if largest > 0 else "no square fits there"
    other_pages = [name for name in PAGES_MM if _oriented_page_mm(board, PAGES_MM[name])]
    if other_pages:
        advice += f"; it fits on {' and '.join(other_pages)}"
    required_mm = _required_size_mm(board, max(sides))
    message = (
        f"the board: {board.title} needs {required_mm[0]:.0f} x {required_mm[1]:.0f} mm with its scales, and {page} "
        f"has {sides[0]:g} x {sides[1]:g} mm: {advice}; page {FIT} (--page {FIT}) is as large as required"
    )
    raise CalibrationError(message)


def _oriented_page_mm(board: Board, sides: tuple[float, float]) -> tuple[float, float] | None:
    """The page in the orientation of the board if it fits, else in the other one; None if it fits in neither."""
    board_width_mm, board_height_mm = board.print_size_mm
    for width_mm, height_mm in sorted((sides, sides[::-1]), reverse=board_width_mm > board_height_mm):
        required_mm = _required_size_mm(board, width_mm)
        if required_mm[0] <= width_mm and required_mm[1] <= height_mm:
            return width_mm, height_mm
    return None


def _parse_page_mm(page: str) -> tuple[float, float]:
    for name, sides in PAGES_MM.items():
        if name.lower() == page.lower():
            return sides
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page)
    if match is None:
        message = f"the page: expected {', '.join(PAGES_MM)}, {FIT} or WIDTHxHEIGHT in mm (600x400), found {page!r}"
        raise CalibrationError(message)
    return float(match[1]), float(match[2])


def _ruler(x_mm: float, y_mm: float, length: int, *, vertical: bool) -> tuple[list[_Line], list[_Text]]:
    """A scale in mm from (x_mm, y_mm): to the right with ticks downwards, or downwards with ticks to the left."""
    ticks, numbers = [], []

    def place(along: float, away: float) -> tuple[float, float]:
        return (x_mm - away, y_mm + along) if vertical else (x_mm + along, y_mm + away)

    for tick_mm in range(length + 1):
        tick = 4.0 if tick_mm % 10 == 0 else 3.0 if tick_mm % 5 == 0 else 2.0
        ticks.append(_Line(*place(tick_mm, 0), *place(tick_mm, tick), 0.0))
        if tick_mm % 10 == 0:
            label = f"{tick_mm} mm" if tick_mm == length - length % 10 else str(tick_mm)
            numbers.append(
                _Text(label, *place(tick_mm, 4.7 if vertical else 6.7), 2.2, centred=True, vertical=vertical)
            )
    return [*ticks, _Line(x_mm, y_mm, *place(length, 0), 0.0)], numbers


def _format_mm(value: float) -> str:
    """Millimetres to a tenth of a micrometre, without trailing zeros."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _colour(grey: float) -> str:
    return "#" + 3 * f"{round(255 * grey):02x}"

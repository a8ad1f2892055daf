"""Calibration boards of a scene: what is printed on them, with defects on demand, and where each corner truly is.

A board's own frame, as every object's, has x to the right, y down and z away from the devices; its origin is the
middle of the corners. What is printed is piecewise constant: dark and light rectangles between two sets of lines, or
dark discs on a light ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from simulated_rig.placed import SceneObject
from simulated_rig.shapes import MeshPart, bent_sheet, rectangle_between
from simulated_rig.tables import NotNegative, Positive
from slrig.model import FloatArray

Albedo = Annotated[float, Field(gt=0, le=1)]
Corners = Annotated[int, Field(ge=2, le=60)]


@dataclass(frozen=True, slots=True)
class BoardPrint:
    """What is printed on a flat or bent sheet, in coordinates along it, mm, from its frame's origin.

    across_mm, down_mm : (n,), (m,) float64, ascending lines; dark : (m - 1, n - 1) uint8, 1 where the rectangle
    between them is dark. centres_mm : (k, 2) float64, of dark discs of radius_mm instead. Elsewhere it is light.
    dark_share : albedo of the dark over that of the light. curvature_per_mm : the sheet is z = curvature x²; 0 is flat.
    """

    across_mm: FloatArray
    down_mm: FloatArray
    dark: NDArray[np.uint8]
    centres_mm: FloatArray
    radius_mm: float
    dark_share: float
    curvature_per_mm: float


class PrintedBoard(SceneObject):
    """A calibration board: `shape = "board"`.

    kind, columns, rows : "chessboard" or "charuco" with so many inner corners, or "circles": rows of so many circles,
    every other row moved by half their distance. square_mm : side of a square; of circles, the distance of two rows.
    marker_mm, dictionary : of a ChArUco board; absent, 0.75 of the square. circle_mm : diameter; absent, square_mm.
    margin_mm : of light paper around the print. The pose is that of the middle of the corners.

    mirrored : printed the wrong way round. scale : the printer's, in x and y; 1.05 makes 12 mm squares 12.6 mm wide.
    bow_mm : the sheet is bent about y, its middle so much nearer to the devices than its left and right ends
    (negative: farther); its length along the bend stays.
    """

    shape: Literal["board"]
    kind: Literal["chessboard", "charuco", "circles"]
    columns: Corners
    rows: Corners
    square_mm: Positive
    marker_mm: Positive | None = None
    dictionary: str = "DICT_5X5_250"
    circle_mm: Positive | None = None
    margin_mm: NotNegative = 10.0
    albedo_light: Albedo = 0.85
    albedo_dark: Albedo = 0.05
    mirrored: bool = False
    scale: Annotated[tuple[Positive, Positive], Field(strict=False)] = (1.0, 1.0)
    bow_mm: float = 0.0

    @model_validator(mode="after")
    def _printable(self) -> PrintedBoard:
        if self.albedo_dark >= self.albedo_light:
            message = "albedo_dark must lie below albedo_light"
            raise ValueError(message)
        if self.kind == "charuco":
            if not self._marker_mm < self.square_mm:
                message = f"marker_mm must lie below square_mm, {self.square_mm} mm"
                raise ValueError(message)
            held, needed = len(self._markers().bytesList), (self.columns + 1) * (self.rows + 1) // 2
            if held < needed:
                message = f"the board needs {needed} markers, {self.dictionary} has {held}; choose a larger dictionary"
                raise ValueError(message)
        elif self.marker_mm is not None:
            message = "marker_mm belongs to a ChArUco board"
            raise ValueError(message)
        half_mm = self.print_mm[:, 0] @ (-0.5, 0.5) + self.margin_mm
        if abs(self.bow_mm) > half_mm / 4:
            message = f"bow_mm must lie within a quarter of half the board's width, {half_mm / 4:.1f} mm"
            raise ValueError(message)
        return self

    @property
    def _marker_mm(self) -> float:
        return 0.75 * self.square_mm if self.marker_mm is None else self.marker_mm

    @property
    def _circle_mm(self) -> float:
        return self.square_mm if self.circle_mm is None else self.circle_mm

    def _markers(self) -> cv2.aruco.Dictionary:
        number: int | None = getattr(cv2.aruco, self.dictionary, None) if self.dictionary[:5] == "DICT_" else None
        if number is None:
            message = f"there is no dictionary {self.dictionary!r}; OpenCV's are called DICT_4X4_50, DICT_5X5_250, …"
            raise ValueError(message)
        return cv2.aruco.getPredefinedDictionary(number)

    @property
    def middle_mm(self) -> tuple[float, float]:
        """The middle of the corners from corner 0, as designed."""
        across = 2 * self.columns - 1 if self.kind == "circles" else self.columns - 1
        return across * self.square_mm / 2, (self.rows - 1) * self.square_mm / 2

    @property
    def corners_mm(self) -> FloatArray:
        """(n, 3) float64: where the print's corners (its circles' centres) truly lie, in the board's own frame.

        With the printer's scale and the bend. A mirrored print has its corner 0 at the right.
        """
        row, column = (each.ravel() for each in np.mgrid[: self.rows, : self.columns])
        across = 2 * column + row % 2 if self.kind == "circles" else column
        designed = np.column_stack([across, row]) * self.square_mm - self.middle_mm
        along = designed * self.scale * (-1.0 if self.mirrored else 1.0, 1.0)
        return self.on_sheet_mm(along)

    @property
    def print_mm(self) -> FloatArray:
        """(2, 2) float64: least and greatest (x, y) of the paper without its margin, along the sheet."""
        border = self.square_mm if self.kind != "circles" else self.square_mm / 2 + self._circle_mm / 2
        reach = (np.array(self.middle_mm) + border) * self.scale
        return np.stack([-reach, reach])

    @property
    def paper_mm(self) -> FloatArray:
        """(2, 2) float64: least and greatest (x, y) of the paper, along the sheet."""
        outwards = np.array([[-1.0], [1.0]])
        return self.print_mm + self.margin_mm * outwards

    @property
    def curvature_per_mm(self) -> float:
        """How the sheet is bent: z = curvature x²."""
        half_mm = float(self.paper_mm[1, 0])
        # The ends' x follows from their length along the bend; to first order it is that length, then corrected.
        reach = half_mm
        for _ in range(20):
            curvature = self.bow_mm / reach**2
            reach = float(x_at_arc_length_mm(np.array([half_mm]), curvature)[0])
        return self.bow_mm / reach**2

    def on_sheet_mm(self, along_mm: FloatArray) -> FloatArray:
        """(n, 3) float64: points of the sheet in the board's own frame, from (n, 2) coordinates along it."""
        curvature = self.curvature_per_mm
        x = x_at_arc_length_mm(along_mm[:, 0], curvature)
        return np.column_stack([x, along_mm[:, 1], curvature * x**2])

    def parts(self, _folder: Path) -> list[MeshPart]:
        """The paper: a rectangle, or a bent sheet."""
        least, most = self.paper_mm
        if self.bow_mm == 0:
            return [rectangle_between(least, most)]
        reach = float(x_at_arc_length_mm(most[:1], self.curvature_per_mm)[0])
        return [bent_sheet((-reach, reach), (least[1], most[1]), self.curvature_per_mm)]

    def material(self) -> tuple[float, ...]:
        """See `Placed.material`: that of the light paper."""
        return (self.albedo_light, 0.0, 0.0, 1.0, self.specular.strength, self.specular.exponent)

    def printed(self) -> BoardPrint:
        """What is printed."""
        ratio = self.albedo_dark / self.albedo_light
        if self.kind == "circles":
            row, column = (each.ravel() for each in np.mgrid[: self.rows, : self.columns])
            designed = np.column_stack([2 * column + row % 2, row]) * self.square_mm - self.middle_mm
            centres = designed * self.scale * (-1.0 if self.mirrored else 1.0, 1.0)
            none = np.zeros(2)
            # A printer that stretches unequally makes ellipses: discs of the mean radius stand for them.
            radius = self._circle_mm / 2 * float(np.sqrt(self.scale[0] * self.scale[1]))
            return BoardPrint(none, none, np.zeros((1, 1), np.uint8), centres, radius, ratio, self.curvature_per_mm)
        across, down, dark = self._rectangles()
        across, down = (across - self.middle_mm[0]) * self.scale[0], (down - self.middle_mm[1]) * self.scale[1]
        if self.mirrored:
            across, dark = -across[::-1], dark[:, ::-1]
        dark = np.ascontiguousarray(dark)
        return BoardPrint(across, down, dark, np.zeros((0, 2)), 0.0, ratio, self.curvature_per_mm)

    def _rectangles(self) -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
        """Lines across and down from corner 0, mm, and which rectangles between them are dark, as designed."""
        squares = (np.indices((self.rows + 1, self.columns + 1)).sum(axis=0) + 1) % 2  # top left is dark
        if self.kind == "chessboard":
            across, down = (np.arange(-1.0, n + 1) * self.square_mm for n in (self.columns, self.rows))
            return across, down, squares.astype(np.uint8)
        markers = self._markers()
        modules = markers.markerSize + 2
        border = (self.square_mm - self._marker_mm) / 2
        inside = np.concatenate([[0.0], border + self._marker_mm * np.arange(modules + 1) / modules])
        across, down = (
            np.append((np.arange(-1, n)[:, None] * self.square_mm + inside).ravel(), n * self.square_mm)
            for n in (self.columns, self.rows)
        )
        size = modules + 2
        dark = np.kron(squares, np.ones((size, size), np.int64)).astype(np.uint8)
        # Markers stand in the light squares, numbered by rows.
        for number, (row, column) in enumerate(np.argwhere(squares == 0)):
            drawn = markers.generateImageMarker(number, modules)
            top, left = row * size + 1, column * size + 1
            dark[top : top + modules, left : left + modules] = drawn == 0
        return across, down, dark


def arc_length_mm(x_mm: FloatArray, curvature_per_mm: float) -> FloatArray:
    """Length along z = c x² from 0 to x, mm: x √(1 + 4c²x²) / 2 + asinh(2 c x) / (4 c)."""
    if curvature_per_mm == 0:
        return x_mm
    steep = 2 * curvature_per_mm * x_mm
    return np.asarray(x_mm * np.sqrt(1 + steep**2) / 2 + np.arcsinh(steep) / (4 * curvature_per_mm), np.float64)


def x_at_arc_length_mm(along_mm: FloatArray, curvature_per_mm: float) -> FloatArray:
    """The x of the points so far along z = c x², mm: the inverse of `arc_length_mm`, by Newton's method."""
    x = np.array(along_mm, np.float64)
    for _ in range(8):
        x = x - (arc_length_mm(x, curvature_per_mm) - along_mm) / np.sqrt(1 + (2 * curvature_per_mm * x) ** 2)
    return x

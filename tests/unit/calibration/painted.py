"""Boards painted through a pinhole camera with a lens, for tests that need the true position of every corner.

Independent of slrig's geometry: each pixel's ray is undistorted by iteration and intersected with the board's plane,
the print is sampled several times within the pixel, then blurred, and noise is added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slrig.calibration.board import Board, BoardKind

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PaintedCamera:
    """A camera in front of a board: X_camera = rotation @ X_board + translation_mm."""

    rotation: Array
    translation_mm: Array
    width: int = 640
    height: int = 512
    focal_px: float = 800.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    centre_px: tuple[float, float] | None = None

    @property
    def principal(self) -> tuple[float, float]:
        return self.centre_px or ((self.width - 1) / 2, (self.height - 1) / 2)

    def project(self, points_mm: Array) -> Array:
        """(n, 2): image of points of the board, (n, 3)."""
        x, y, z = self.rotation @ points_mm.T + self.translation_mm[:, None]
        u, v = _distort(x / z, y / z, self.distortion)
        return np.column_stack([self.focal_px * u + self.principal[0], self.focal_px * v + self.principal[1]])


@dataclass(frozen=True)
class PrintStyle:
    """Print and light of a board. lit : a direction on the board, degrees from its x axis, extent of the light in that
    direction, in squares from corner 0, and the fraction of light beyond.
    """

    white: float = 0.75
    dark: float = 0.06
    beyond: float = 0.35
    circle_radius: float = 0.5
    paper_squares: float = 1.0
    mirrored: bool = False
    swapped: bool = False
    light_first: bool = False
    shading: tuple[float, float] = field(default=(0.0, 0.0))
    lit: tuple[float, float, float] | None = None


def camera_at(
    board: Board,
    *,
    distance_mm: float,
    tilt_deg: tuple[float, float] = (0.0, 0.0),
    roll_deg: float = 0.0,
    shift_mm: tuple[float, float] = (0.0, 0.0),
    **options: object,
) -> PaintedCamera:
    """A camera in front of the board's centre, rotated about x, then y, then the viewing direction."""
    centre = board_points(board).mean(axis=0)
    a, b, c = np.radians([*tilt_deg, roll_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    rotation = about_z @ about_y @ about_x
    return PaintedCamera(rotation, np.array([*shift_mm, distance_mm]) - rotation @ centre, **options)  # type: ignore[arg-type]


def board_points(board: Board) -> Array:
    """(n, 3): corners (centres) of the board, computed independently."""
    points = []
    for row in range(board.rows):
        for column in range(board.columns):
            across = 2 * column + (1 if row % 2 else 0) if board.kind is BoardKind.CIRCLES else column
            points.append((across * board.square_mm, row * board.square_mm, 0.0))
    return np.array(points)


def paint(
    board: Board,
    camera: PaintedCamera,
    /,
    *,
    style: PrintStyle | None = None,
    blur_px: float = 0.7,
    noise: float = 0.0,
    seed: int = 0,
    samples: int = 5,
) -> Array:
    """(H, W) float64, 0 to 1 and not clipped: the board in the camera's image; `noise` is white and Gaussian."""
    style = style or PrintStyle()
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    place = _board_positions(camera)
    by_column = np.stack([np.gradient(each, axis=1) for each in place])
    by_row = np.stack([np.gradient(each, axis=0) for each in place])
    image = _reflectance(board, style, *place)
    # Several samples only where the print changes within two pixels.
    edge = ndimage.maximum_filter(image, 5) != ndimage.minimum_filter(image, 5)
    total = np.zeros(int(edge.sum()))
    # No two samples in one row or column, so that edges in all directions are sampled alike.
    count = samples**2
    stride = min(
        (step for step in range(1, count + 1) if math.gcd(step, count) == 1), key=lambda g: abs(g - 0.62 * count)
    )
    for index in range(count):
        across, down = (index + 0.5) / count - 0.5, (index * stride % count + 0.5) / count - 0.5
        x, y = place[:, edge] + across * by_column[:, edge] + down * by_row[:, edge]
        total += _reflectance(board, style, x, y)
    image[edge] = total / samples**2
    if blur_px > 0:
        image = ndimage.gaussian_filter(image, blur_px, mode="nearest", truncate=6)
    light = 1 + style.shading[0] * (columns / camera.width - 0.5) + style.shading[1] * (rows / camera.height - 0.5)
    image = image * light
    if noise:
        image = image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.asarray(image, dtype=np.float64)


def as_8_bit(image: Array) -> NDArray[np.uint8]:
    """The image in 8 bits."""
    return np.clip(np.round(image * 255), 0, 255).astype(np.uint8)


def _distort(x: Array, y: Array, distortion: tuple[float, ...]) -> tuple[Array, Array]:
    """Brown's lens: undistorted to distorted directions."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@cache
def _board_positions(camera: PaintedCamera) -> Array:
    """(2, H, W): intersection of each pixel's ray with the board's plane."""
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    u, v = (columns - camera.principal[0]) / camera.focal_px, (rows - camera.principal[1]) / camera.focal_px
    x, y = u.copy(), v.copy()
    for _ in range(60 if any(camera.distortion) else 0):
        distorted_x, distorted_y = _distort(x, y, camera.distortion)
        off_x, off_y = u - distorted_x, v - distorted_y
        x, y = x + off_x, y + off_y
        if max(np.abs(off_x).max(), np.abs(off_y).max()) < 1e-10:
            break
    normal = camera.rotation[:, 2]
    depth = (normal @ camera.translation_mm) / (normal[0] * x + normal[1] * y + normal[2])
    point = np.stack([x * depth, y * depth, depth]) - camera.translation_mm[:, None, None]
    return np.asarray(np.einsum("ki,khw->ihw", camera.rotation[:, :2], point))


def _reflectance(board: Board, style: PrintStyle, x_mm: Array, y_mm: Array) -> Array:
    """Reflectance of the board at positions of its plane."""
    across, down = x_mm / board.square_mm, y_mm / board.square_mm
    circles = board.kind is BoardKind.CIRCLES
    width, height = (2 * board.columns, board.rows) if circles else (board.columns, board.rows)
    if style.mirrored:
        across = (width - 1) - across
    border = style.paper_squares
    paper = (across > -1 - border) & (across < width + border) & (down > -1 - border) & (down < height + border)
    dark = _circles(board, style, across, down) if circles else _squares(board, across, down, int(style.light_first))
    if style.swapped:
        dark = ~dark & (across > -1) & (across < width) & (down > -1) & (down < height)
    image = np.where(paper, np.where(dark, style.dark, style.white), style.beyond)
    if style.lit is not None:
        towards, reach, share = np.radians(style.lit[0]), style.lit[1], style.lit[2]
        # In the board's own frame, so that a mirrored print is lit from the same side.
        ahead = np.cos(towards) * x_mm / board.square_mm + np.sin(towards) * down
        image = np.where(ahead < reach, image, share * image)
    return np.asarray(image, dtype=np.float64)


def _circles(board: Board, style: PrintStyle, across: Array, down: Array) -> NDArray[np.bool_]:
    dark = np.zeros(across.shape, dtype=bool)
    # Two lattices of spacing (2, 2), the second shifted by (1, 1).
    for shift in (0, 1):
        column = np.clip(np.round((across - shift) / 2), 0, board.columns - 1)
        row = np.clip(np.round((down - shift) / 2), 0, (board.rows - 1 - shift) // 2)
        dark |= np.hypot(across - shift - 2 * column, down - shift - 2 * row) < style.circle_radius
    return dark


def _squares(board: Board, across: Array, down: Array, first: int) -> NDArray[np.bool_]:
    column, row = np.floor(across).astype(int) + 1, np.floor(down).astype(int) + 1
    inside = (column >= 0) & (column <= board.columns) & (row >= 0) & (row <= board.rows)
    dark = inside & ((column + row) % 2 == first)
    if board.kind is BoardKind.CHARUCO:
        cells = _cells(board, first)
        count = cells.shape[-1]
        share = (board.marker_mm or 0) / board.square_mm
        column, row = np.clip(column, 0, board.columns), np.clip(row, 0, board.rows)
        right = np.floor((across + 1 - column - (1 - share) / 2) / share * count).astype(int)
        below = np.floor((down + 1 - row - (1 - share) / 2) / share * count).astype(int)
        on_marker = inside & ~dark & (right >= 0) & (right < count) & (below >= 0) & (below < count)
        right, below = np.clip(right, 0, count - 1), np.clip(below, 0, count - 1)
        dark = dark | (on_marker & cells[row, column, below, right])
    return np.asarray(dark)


def _cells(board: Board, first: int) -> NDArray[np.bool_]:
    """(rows + 1, columns + 1, cells, cells): dark cells of the marker in each white square, counted row by row."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.dictionary)))
    count = dictionary.markerSize + 2
    cells = np.zeros((board.rows + 1, board.columns + 1, count, count), dtype=bool)
    number = 0
    for row in range(board.rows + 1):
        for column in range(board.columns + 1):
            if (row + column) % 2 != first:
                cells[row, column] = cv2.aruco.generateImageMarker(dictionary, number, count) == 0
                number += 1
    return cells

"""The albedo of a printed sheet under a camera's samples, averaged exactly over what each sample sees of it.

A sample stands for a cell of its pixel. The cell's rays meet the sheet in a small quadrilateral; the share of it that
is dark follows from clipping it at the lines of the print, so that no edge lies where the samples happen to be.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from simulated_rig.boards import BoardPrint
from simulated_rig.optics import LensArray, lens_array, undistort
from simulated_rig.scene import SceneSurface
from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, IntArray, Pinhole

_REACH = 0.9
"""Of a cell's side: more than half its diagonal, with room for the lens's stretch. Farther edges need no clipping."""

_MAX_CORNERS = 12


def print_reflectance(
    points: FloatArray,
    normals: FloatArray,
    triangle: IntArray,
    u: FloatArray,
    v: FloatArray,
    camera: Pinhole,
    surface: SceneSurface,
    *,
    footprint_px: float,
) -> FloatArray:
    """(n,) float64: what prints leave of the albedo at the points that a camera's rays through u, v met; else 1.

    Each point of a print is moved, in place, to the middle of the light that its cell sends back: a cell half in the
    dark is lit where its light half lies. footprint_px : side of a sample's cell; 0 takes the print at the point.
    """
    out = np.ones(len(u))
    for part, shown in surface.prints.items():
        _fill_reflectance(
            out,
            points,
            normals,
            triangle,
            u,
            v,
            surface.part,
            part,
            surface.to_object[part],
            camera.centre_mm,
            lens_array(camera),
            camera.rotation,
            footprint_px,
            *_numbers(shown),
        )
    return out


def _numbers(
    shown: BoardPrint,
) -> tuple[FloatArray, FloatArray, NDArray[np.uint8], FloatArray, float, float, float]:
    return (
        shown.across_mm,
        shown.down_mm,
        shown.dark,
        shown.centres_mm,
        shown.radius_mm,
        shown.dark_share,
        shown.curvature_per_mm,
    )


@kernel_part
def _arc_length(x: float, curvature: float) -> float:
    """Length along the sheet z = c x² from 0 to x."""
    if curvature == 0.0:
        return x
    steep = 2.0 * curvature * x
    return float(x * np.sqrt(1.0 + steep * steep) / 2.0 + np.arcsinh(steep) / (4.0 * curvature))


@kernel_part
def _clip_polygon(polygon: FloatArray, count: int, a: float, b: float, limit: float, out: FloatArray) -> int:
    """Keep of a convex polygon what has a x + b y <= limit (Sutherland and Hodgman 1974). Returns its corner count."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here = a * polygon[i, 0] + b * polygon[i, 1] - limit
        there = a * polygon[j, 0] + b * polygon[j, 1] - limit
        if here <= 0.0:
            out[kept, 0], out[kept, 1] = polygon[i, 0], polygon[i, 1]
            kept += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            share = here / (here - there)
            out[kept, 0] = polygon[i, 0] + share * (polygon[j, 0] - polygon[i, 0])
            out[kept, 1] = polygon[i, 1] + share * (polygon[j, 1] - polygon[i, 1])
            kept += 1
    return kept


@kernel_part
def _moments(polygon: FloatArray, count: int) -> tuple[float, float, float]:
    """Area of a polygon and its first moments in x and y; the area's sign is that of the way round."""
    area, mx, my = 0.0, 0.0, 0.0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        cross = polygon[i, 0] * polygon[j, 1] - polygon[j, 0] * polygon[i, 1]
        area += cross
        mx += cross * (polygon[i, 0] + polygon[j, 0])
        my += cross * (polygon[i, 1] + polygon[j, 1])
    return area / 2.0, mx / 6.0, my / 6.0


@kernel_part
def _dark_in_rectangles(
    cell: FloatArray,
    x0: float,
    y0: float,
    across: FloatArray,
    down: FloatArray,
    dark: NDArray[np.uint8],
    first: FloatArray,
    second: FloatArray,
) -> tuple[float, float, float]:
    """Dark area of a cell, its corners about (x0, y0), and that area's first moments."""
    area, mx, my = 0.0, 0.0, 0.0
    left, right = cell[:, 0].min() + x0, cell[:, 0].max() + x0
    top, bottom = cell[:, 1].min() + y0, cell[:, 1].max() + y0
    i0 = max(np.searchsorted(down, top, "right") - 1, 0)
    j0 = max(np.searchsorted(across, left, "right") - 1, 0)
    for i in range(i0, len(down) - 1):
        if down[i] >= bottom:
            break
        for j in range(j0, len(across) - 1):
            if across[j] >= right:
                break
            if dark[i, j] == 0:
                continue
            count = _clip_polygon(cell, 4, -1.0, 0.0, -(across[j] - x0), first)
            count = _clip_polygon(first, count, 1.0, 0.0, across[j + 1] - x0, second)
            count = _clip_polygon(second, count, 0.0, -1.0, -(down[i] - y0), first)
            count = _clip_polygon(first, count, 0.0, 1.0, down[i + 1] - y0, second)
            a, x, y = _moments(second, count)
            area, mx, my = area + a, mx + x, my + y
    return area, mx, my


@kernel_part
def _nearest_disc(x: float, y: float, centres: FloatArray) -> tuple[int, float]:
    best, least = 0, np.inf
    for k in range(len(centres)):
        square = (centres[k, 0] - x) ** 2 + (centres[k, 1] - y) ** 2
        if square < least:
            best, least = k, square
    return best, np.sqrt(least)


@kernel_part
def _print_at_point(
    x: float,
    y: float,
    reach: float,
    across: FloatArray,
    down: FloatArray,
    dark: NDArray[np.uint8],
    centres: FloatArray,
    radius: float,
) -> tuple[bool, bool]:
    """Whether the print is dark at a point, and whether it is the same everywhere within `reach` of it."""
    if len(centres) > 0:
        _best, distance = _nearest_disc(x, y, centres)
        return distance < radius, abs(distance - radius) > reach
    j, i = np.searchsorted(across, x, "right") - 1, np.searchsorted(down, y, "right") - 1
    if i < 0 or j < 0 or i >= len(down) - 1 or j >= len(across) - 1:
        outside = x < across[0] - reach or x > across[-1] + reach or y < down[0] - reach or y > down[-1] + reach
        return False, outside
    same = x - across[j] > reach and across[j + 1] - x > reach and y - down[i] > reach and down[i + 1] - y > reach
    return dark[i, j] == 1, same


@kernel(in_every_scan=False)
def _fill_reflectance(
    out: FloatArray,
    points: FloatArray,
    normals: FloatArray,
    triangle: IntArray,
    u: FloatArray,
    v: FloatArray,
    part: IntArray,
    own: int,
    frame: FloatArray,
    eye: FloatArray,
    lens: LensArray,
    rotation: FloatArray,
    footprint: float,
    across: FloatArray,
    down: FloatArray,
    dark: NDArray[np.uint8],
    centres: FloatArray,
    radius: float,
    dark_share: float,
    curvature: float,
) -> None:
    """Fill `out` at the hits of part `own`, and move their points. See `print_reflectance`."""
    cell = np.zeros((4, 2))
    first, second = np.zeros((_MAX_CORNERS, 2)), np.zeros((_MAX_CORNERS, 2))
    ray = np.zeros(3)
    narrow = min(lens[0], lens[1])
    for k in range(len(u)):
        if triangle[k] < 0 or part[triangle[k]] != own or not np.isfinite(points[k, 0]):
            continue
        p, n = points[k], normals[k]
        x = frame[0, 0] * p[0] + frame[0, 1] * p[1] + frame[0, 2] * p[2] + frame[0, 3]
        y = frame[1, 0] * p[0] + frame[1, 1] * p[1] + frame[1, 2] * p[2] + frame[1, 3]
        s = _arc_length(x, curvature)
        d0, d1, d2 = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
        distance = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        # Distance to the sheet's plane; over the distance along the ray, the cosine at which it is met.
        height = -(n[0] * d0 + n[1] * d1 + n[2] * d2)
        reach = _REACH * footprint * distance / narrow * distance / max(height, 1e-9)
        inked, same = _print_at_point(s, y, reach, across, down, dark, centres, radius)
        if same or footprint == 0.0:
            if inked:
                out[k] = dark_share
            continue
        # The cell's four corners on the plane that touches the sheet here, along the sheet and about this point.
        cu = (np.floor((u[k] + 0.5) / footprint) + 0.5) * footprint - 0.5
        cv = (np.floor((v[k] + 0.5) / footprint) + 0.5) * footprint - 0.5
        for corner in range(4):
            du = -0.5 if corner == 0 or corner == 3 else 0.5
            dv = -0.5 if corner < 2 else 0.5
            a, b = undistort((cu + du * footprint - lens[2]) / lens[0], (cv + dv * footprint - lens[3]) / lens[1], lens)
            for axis in range(3):
                ray[axis] = rotation[0, axis] * a + rotation[1, axis] * b + rotation[2, axis]
            t = -height / (n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2])
            q0, q1, q2 = eye[0] + t * ray[0], eye[1] + t * ray[1], eye[2] + t * ray[2]
            qx = frame[0, 0] * q0 + frame[0, 1] * q1 + frame[0, 2] * q2 + frame[0, 3]
            qy = frame[1, 0] * q0 + frame[1, 1] * q1 + frame[1, 2] * q2 + frame[1, 3]
            cell[corner, 0], cell[corner, 1] = _arc_length(qx, curvature) - s, qy - y
        area, mx, my = _moments(cell, 4)
        if len(centres) > 0:
            # So near its rim a disc of many cells is a half-plane.
            best, off = _nearest_disc(s, y, centres)
            a, b = (s - centres[best, 0]) / off, (y - centres[best, 1]) / off
            count = _clip_polygon(cell, 4, a, b, radius - off, first)
            inked_area, ix, iy = _moments(first, count)
        else:
            inked_area, ix, iy = _dark_in_rectangles(cell, s, y, across, down, dark, first, second)
        lost = (1.0 - dark_share) * inked_area / area
        out[k] = 1.0 - lost
        # From the cell's middle to the middle of what it sends back, in the sheet's plane.
        move_x = (mx - (1.0 - dark_share) * ix) / (area * out[k]) - mx / area
        move_y = (my - (1.0 - dark_share) * iy) / (area * out[k]) - my / area
        rise, slope = 0.0, 0.0
        for axis in range(3):
            rise -= n[axis] * (move_x * frame[0, axis] + move_y * frame[1, axis])
            slope += n[axis] * frame[2, axis]
        for axis in range(3):
            points[k, axis] += move_x * frame[0, axis] + move_y * frame[1, axis] + rise / slope * frame[2, axis]

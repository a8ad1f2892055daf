"""Sharp edges of a dual mesh: no vertex lies on them by itself, and triangles across would cut them off."""

from __future__ import annotations

from typing import Any

import numpy as np

from slrig.kernels import kernel
from slrig.model import FloatArray, IntArray

_SHARP = 0.8  # cosine of 37°: noise turns normals less from vertex to vertex
# Of the quadric's trace: holds a vertex in place along the edge, and where noise makes an edge of a surface. Of a box
# at 0.2 mm the error is 6.8 µm rms with it, 7.2 with 0.1, and 10.1 with edges cut off.
_STAY = 0.03


def sharpened(points_mm: FloatArray, normals: FloatArray, quads: IntArray, /, *, furthest_mm: float) -> FloatArray:
    """(m, 3) float64: the points, those at sharp edges moved to where the tangent planes about them meet.

    It is the least sum of squared distances to the planes of the vertices that share a quadrangle with it (Garland and
    Heckbert 1997, "Surface simplification using quadric error metrics"; as in dual contouring, Ju et al. 2002).

    points_mm, normals : (m, 3) float64, normals unit or NaN; quads : (q, 4) int32. furthest_mm : no vertex goes
    further.
    """
    sharp = np.zeros(len(points_mm), dtype=np.bool_)
    _mark_sharp(quads, normals, sharp)
    number = np.where(sharp, np.cumsum(sharp) - 1, -1)
    count = int(np.count_nonzero(sharp))
    quadrics, sides = np.zeros((count, 3, 3)), np.zeros((count, 3, 1))
    _add_planes(quads, points_mm, normals, number, quadrics, sides)
    # A sharp vertex has two neighbours at least, so that no trace is 0.
    held = quadrics + _STAY * np.trace(quadrics, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    step = np.linalg.solve(held, sides)[:, :, 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    moved = points_mm.copy()
    moved[sharp] += step * np.minimum(1.0, furthest_mm / np.maximum(length, 1e-12))
    return moved


@kernel(in_every_scan=False)
def _mark_sharp(quads: Any, normals: Any, sharp: Any) -> None:
    for quad in range(len(quads)):
        for i in range(3):
            for j in range(i + 1, 4):
                a, b = quads[quad, i], quads[quad, j]
                cosine = normals[a, 0] * normals[b, 0] + normals[a, 1] * normals[b, 1] + normals[a, 2] * normals[b, 2]
                if cosine < _SHARP:
                    sharp[a] = sharp[b] = True


@kernel(in_every_scan=False)
def _add_planes(quads: Any, points: Any, normals: Any, number: Any, quadrics: Any, sides: Any) -> None:
    """Of each numbered vertex, the sum of n nᵀ and of n (n . (p - x)) over the others of its quadrangles."""
    for quad in range(len(quads)):
        for i in range(4):
            vertex = quads[quad, i]
            row = number[vertex]
            if row < 0:
                continue
            for j in range(4):
                other = quads[quad, j]
                height = 0.0
                for axis in range(3):
                    height += normals[other, axis] * (points[other, axis] - points[vertex, axis])
                if j == i or np.isnan(height):
                    continue
                for axis in range(3):
                    sides[row, axis, 0] += height * normals[other, axis]
                    for second in range(3):
                        quadrics[row, axis, second] += normals[other, axis] * normals[other, second]

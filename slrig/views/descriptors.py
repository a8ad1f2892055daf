"""What the surface about a point looks like, so that the same place is known again in another view.

Spin images (Johnson and Hebert 1999, "Using spin images for efficient object recognition in cluttered 3D scenes"): the
area about a point by its distance from the line of the point's normal and its height along it. No motion changes that;
what a view does not see of it does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slrig.model import FloatArray, Mesh
from slrig.views.matching import Side

_SUPPORT = 2500
"""Vertices of a view that stand for its surface."""
_KEYPOINTS = 500
_RADII = (0.25, 0.12)
"""Of a spin image, by the square root of the area that a view sees: of parts of the object, and of details."""
_SMOOTHED = 0.7
"""Of a cell, the radius that a keypoint's normal is the mean of."""
_ACROSS, _ALONG = 8, 12


@dataclass(frozen=True, slots=True)
class Keypoints:
    """Places of a view, one in each cell of a grid, in the view's frame.

    points_mm, normals : (k, 3) float64; spins : (k, d) float32, unit, whose products are the likeness of two places.
    """

    points_mm: FloatArray
    normals: FloatArray
    spins: FloatArray


def seen_mm2(view: Mesh) -> FloatArray:
    """(V,) float64: the area of surface that each vertex stands for."""
    a, b, c = (view.vertices_mm[view.faces[:, corner]].astype(np.float64) for corner in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    sums = np.bincount(view.faces.ravel(), np.repeat(third, 3), len(view.vertices_mm))
    return np.asarray(sums, dtype=np.float64)


def cell_mm(area_mm2: float) -> float:
    """Edge of the grid that keypoints are chosen by, where a view sees so much surface."""
    return float(np.sqrt(area_mm2 / _KEYPOINTS))


def keypoints(side: Side, weights_mm2: FloatArray, area_mm2: float) -> Keypoints:
    """Keypoints of a view. weights_mm2 : (V,), see `seen_mm2`; area_mm2 : what a view sees; the same for all views."""
    chosen = side.order[:_SUPPORT]
    points, normals = side.points_mm[chosen], side.normals[chosen]
    # Fewer vertices than there are stand for the same area.
    weights = weights_mm2[chosen] * (weights_mm2[side.order].sum() / max(weights_mm2[chosen].sum(), 1e-12))
    cell = cell_mm(area_mm2)
    first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)[1]
    middles = points[first]
    # A vertex's own normal has the noise of its neighbours: the mean over a cell tilts a spin image less.
    which, other = np.nonzero(_squares(middles, points) < (_SMOOTHED * cell) ** 2)
    mean = np.zeros((len(middles), 3))
    for axis in range(3):
        mean[:, axis] = np.bincount(which, (normals[:, axis] * weights)[other], len(middles))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    spins = [_spins(middles, mean, points, weights, share * float(np.sqrt(area_mm2))) for share in _RADII]
    return Keypoints(middles, mean, np.hstack(spins) / np.sqrt(len(spins)))


def _squares(a: FloatArray, b: FloatArray) -> FloatArray:
    """(k, n): squared distances of points (k, 3) from others (n, 3)."""
    return np.asarray((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T)


def _spins(
    middles: FloatArray, normals: FloatArray, points: FloatArray, weights: FloatArray, radius_mm: float
) -> FloatArray:
    """(k, bins) float32, unit: square roots of shares of area, whose products are Bhattacharyya's coefficient."""
    squares = _squares(middles, points)
    which, other = np.nonzero(squares < radius_mm**2)
    along = ((points[other] - middles[which]) * normals[which]).sum(axis=1)
    across = np.sqrt(np.maximum(squares[which, other] - along**2, 0.0))
    # Each point counts in the four bins about it by its nearness, so that a small shift changes little.
    u = across / radius_mm * _ACROSS - 0.5
    v = (along / radius_mm + 1) / 2 * _ALONG - 0.5
    image = np.zeros(len(middles) * _ACROSS * _ALONG)
    for i in (0, 1):
        for j in (0, 1):
            row, column = np.floor(u).astype(np.int64) + i, np.floor(v).astype(np.int64) + j
            share = (1 - np.abs(u - row)) * (1 - np.abs(v - column)) * weights[other]
            row, column = np.clip(row, 0, _ACROSS - 1), np.clip(column, 0, _ALONG - 1)
            image += np.bincount((which * _ACROSS + row) * _ALONG + column, share, len(image))
    flat = image.reshape(len(middles), -1)
    shares = flat / np.maximum(flat.sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(np.sqrt(shares), dtype=np.float32)

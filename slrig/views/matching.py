"""Which points of two views see the same place, and what each such match says of how one view has to move.

A match is a vertex of one view and the nearest vertex of the other. Its residual is their distance along the mean of
both normals, which leaves out that they are not the same point of a curved surface (Rusinkiewicz 2019, "A symmetric
objective function for ICP"). Its deviation has what both surfaces state, and the floor of what no surface states.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slrig.meshing import boundary_vertices
from slrig.model import AlbedoMark, FloatArray, IntArray, Mesh

CORRELATED_MM = 0.005
"""Of a match: what two surfaces err by together with their neighbours, and do not state. Rendered scans: 3 to 5 µm."""
_HUBER = 2.0
"""Deviations beyond which a residual counts by its size and no longer by its square: 99 % efficient."""
_LEAST_COSINE = 0.9
"""Of two normals that may belong to one place: 26°, far more than their noise and any start's error."""
_NOISE_SIGMAS = 4.0
"""A residual within so many of its own deviations is never out of reach."""
_SPACINGS = 1.5
"""How far the nearest vertex may be along the surface where two views coincide, in edges of the mesh."""

_BORDER_ROWS, _BLURRED_ROWS = 2, 4
"""Of vertices left out beside borders, and beside sharp bends and borders where enough remain. What scans say there,
rounded by the camera's blur, errs alike in all the views that see it, and in opposite senses in those that see an edge
from its two sides. Worst views of a coin on its rim, a box and a flange, rendered and scanned from 12 sides: 14, 23 and
8 µm off with two rows beside borders, 10, 2 and 4 with four; five help the coin and harm the flange. They cost views
that no lens has blurred (rows of 0.5 mm, errors alike over 3 mm): 13 µm for 11, the mean of ten draws."""
_FEWEST = 3000
"""Vertices away from bends, and twice as many from borders as well: fewer, as of a coarse scan of a small thing, are
needed for what all of them tell."""
_BEND_DEG = 20.0
"""Between normals of neighbours: chosen, well above their noise and below what blur makes of an edge."""


@dataclass(frozen=True, slots=True)
class Side:
    """A view as matching takes it, in its own frame.

    points_mm, normals : (V, 3) float64; variance_mm2 : (V,) float64; usable : (V,) bool; order : (n,) int64, the usable
    vertices in random order; spacing_mm : median edge; tree : of all points.
    """

    points_mm: FloatArray
    normals: FloatArray
    variance_mm2: FloatArray
    usable: NDArray[np.bool_]
    order: NDArray[np.int64]
    spacing_mm: float
    tree: cKDTree


class Matches(NamedTuple):
    """k matches of vertices of a first view with a second, in the frame of the model.

    at_mm : (k, 3), the middles. normals : (k, 3), unit, the means of `first` and `second`, (k, 3), the normals of the
    two. residual_mm : (k,), the first view's point less the second's. sigma_mm : (k,). asked : number of vertices that
    a match was looked for. All float64.
    """

    at_mm: FloatArray
    normals: FloatArray
    first: FloatArray
    second: FloatArray
    residual_mm: FloatArray
    sigma_mm: FloatArray
    asked: int


class Terms(NamedTuple):
    """What matches say of the motion (6,) of the first view, r ≈ J · motion; the second's has the other sign.

    A motion is (ρ ω, t) in mm: a turn ω about the object's middle times the object's radius ρ, and a shift. information
    : (…, 6, 6), Σ w Jᵀ J. agreed : (…, 6, 6), the part of it that the normals of both surfaces bear out. gradient :
    (…, 6), Σ w Jᵀ r. With one more dimension in front where matches are told apart by their places.
    """

    information: FloatArray
    agreed: FloatArray
    gradient: FloatArray


def side_of(view: Mesh, *, whole: bool = False) -> Side:
    """A view prepared. Left out: what has no normal or deviation, is clipped or seen grazing; borders, and what lies
    beside them and beside sharp bends, unless the view is wanted whole.
    """
    points, normals = view.vertices_mm.astype(np.float64), view.normals.astype(np.float64)
    edges = points[view.faces[:, 0]] - points[view.faces[:, 1]]
    usable = (
        np.isfinite(normals[:, 0] + normals[:, 1] + normals[:, 2] + view.sigma_mm)  # one sum: an axis of three is slow
        & ~np.isin(view.mark, (AlbedoMark.SATURATED, AlbedoMark.GRAZING))
    )
    border = boundary_vertices(view.faces, len(usable))
    usable &= ~border
    if not whole:
        usable = _away(usable, border, view.faces, _BORDER_ROWS)
        usable = _away(usable, _bent(view), view.faces, _BLURRED_ROWS, fewest=_FEWEST)
        usable = _away(usable, border, view.faces, _BLURRED_ROWS, fewest=2 * _FEWEST)
    return Side(
        points_mm=points,
        normals=normals,
        variance_mm2=view.sigma_mm.astype(np.float64) ** 2,
        usable=usable,
        # The same vertices for the same views: the same files for the same scans.
        order=np.random.default_rng(0).permutation(np.flatnonzero(usable)),
        spacing_mm=float(np.median(np.sqrt(np.einsum("ij,ij->i", edges, edges)))) if len(edges) else 0.0,
        # Of 500 000 points: 0.3 of the time of the defaults, for faster answers.
        tree=cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False),
    )


def _away(
    usable: NDArray[np.bool_], edge: NDArray[np.bool_], faces: IntArray, rows: int, fewest: float = 0
) -> NDArray[np.bool_]:
    """(V,) bool: what is usable less an edge's vertices and as many rows of those beside it as leave enough."""
    left, fewest = usable, max(fewest, np.count_nonzero(usable) / 2)
    first, second, third = np.ascontiguousarray(faces.T)
    for row in range(rows + 1):
        if row:
            edge = edge.copy()
            edge[faces[edge[first] | edge[second] | edge[third]]] = True
        if np.count_nonzero(usable & ~edge) < fewest:
            break
        left = usable & ~edge
    return left


def _bent(view: Mesh) -> NDArray[np.bool_]:
    """(V,) bool: vertices of faces whose normals at the corners differ as only those at a sharp bend do."""
    a, b, c = (view.normals[view.faces[:, corner]] for corner in range(3))
    cosine = np.min([np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a))], axis=0)
    bent = np.zeros(len(view.vertices_mm), dtype=np.bool_)
    bent[view.faces[cosine < np.cos(np.deg2rad(_BEND_DEG))]] = True
    return bent


def moved(pose: FloatArray, points_mm: NDArray[np.floating[Any]]) -> FloatArray:
    """Points (n, 3) where a pose (4, 4) takes them."""
    return turned(pose, points_mm) + pose[:3, 3]


def turned(pose: FloatArray, vectors: NDArray[np.floating[Any]]) -> FloatArray:
    """Directions (n, 3) as a pose (4, 4) turns them. Not by BLAS: its threads spin for ten times what this takes."""
    return np.asarray(np.einsum("nj,ij->ni", vectors.astype(np.float64), pose[:3, :3]))


def matched(first: Side, second: Side, poses: tuple[FloatArray, FloatArray], *, reach_mm: float, most: int) -> Matches:
    """Matches of up to `most` vertices of the first view; a residual of more than `reach_mm` is none."""
    chosen = np.sort(first.order[:most])  # neighbours in turn walk the same nodes: 0.8 of the time
    points = moved(poses[0], first.points_mm[chosen])
    back = np.asarray(np.linalg.inv(poses[1]), dtype=np.float64)
    near_mm = reach_mm + _SPACINGS * second.spacing_mm
    answer = second.tree.query(moved(back, points), distance_upper_bound=near_mm)
    distance, nearest = np.asarray(answer[0]), np.asarray(answer[1])
    found = np.flatnonzero(np.isfinite(distance))
    found = found[second.usable[nearest[found]]]
    chosen, points, nearest = chosen[found], points[found], nearest[found]
    of_first = turned(poses[0], first.normals[chosen])
    of_second = turned(poses[1], second.normals[nearest])
    others = moved(poses[1], second.points_mm[nearest])
    mean = of_first + of_second
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    residual = ((points - others) * mean).sum(axis=1)
    sigma = np.sqrt(first.variance_mm2[chosen] + second.variance_mm2[nearest] + CORRELATED_MM**2)
    kept = (of_first * of_second).sum(axis=1) > _LEAST_COSINE
    kept &= np.abs(residual) < np.maximum(reach_mm, _NOISE_SIGMAS * sigma)
    return Matches(
        at_mm=((points + others) / 2)[kept],
        normals=mean[kept],
        first=of_first[kept],
        second=of_second[kept],
        residual_mm=residual[kept],
        sigma_mm=sigma[kept],
        asked=len(first.order[:most]),
    )


def terms_of(
    matches: Matches, middle_mm: FloatArray, radius_mm: float, *, places: tuple[IntArray, int] | None = None
) -> Terms:
    """Sums over all matches, or over those of each place. places : (k,) int, each match's, and how many there are.

    Noise of a normal is a motion that seems to matter and does not: it turns a ball into something that cannot be
    turned. It is not the same in both views, so that the mixed products Σ w (Jᵀ K + Kᵀ J) / 2 of the two normals' rows
    J and K are, in the mean, free of it.
    """
    scaled = matches.residual_mm / matches.sigma_mm
    weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(scaled), 1e-9)) / matches.sigma_mm**2
    arm = (matches.at_mm - middle_mm) / radius_mm
    mean, one, two = (
        np.hstack([np.cross(arm, normals), normals]) for normals in (matches.normals, matches.first, matches.second)
    )
    if places is None:
        mixed = (one * weight[:, None]).T @ two
        weighed = mean * weight[:, None]
        return Terms(weighed.T @ mean, (mixed + mixed.T) / 2, weighed.T @ matches.residual_mm)
    place, count = places

    def summed(rows: FloatArray, columns: FloatArray) -> FloatArray:
        each = np.zeros((count, rows.shape[1], columns.shape[1]))
        np.add.at(each, place, (rows * weight[:, None])[:, :, None] * columns[:, None, :])
        return each

    mixed = summed(one, two)
    gradient = summed(mean, matches.residual_mm[:, None])[:, :, 0]
    return Terms(summed(mean, mean), (mixed + mixed.swapaxes(1, 2)) / 2, gradient)


def assembled(pairs: Iterable[tuple[tuple[int, int], Terms]], count: int) -> Terms:
    """The terms of pairs (first, second) of `count` views as those of the motions of all but view 0, (6 (N - 1),)."""
    each = list(pairs)
    lead = each[0][1].gradient.shape[:-1]
    information, agreed = np.zeros((2, *lead, 6 * count, 6 * count))
    gradient = np.zeros((*lead, 6 * count))
    for (i, j), terms in each:
        a, b = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
        for rows, columns, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            information[..., rows, columns] += sign * terms.information
            agreed[..., rows, columns] += sign * terms.agreed
        gradient[..., a] += terms.gradient
        gradient[..., b] -= terms.gradient
    return Terms(information[..., 6:, 6:], agreed[..., 6:, 6:], gradient[..., 6:])

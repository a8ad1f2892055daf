"""Matches between two views: points of the same place, their evidence, and the uncertainty of the pose.

A match is a vertex of one view and the nearest vertex of the other. Its residual is their distance along the mean of
both normals, which leaves out that they are not the same point of a curved surface (Rusinkiewicz 2019, "A symmetric
objective function for ICP"). Its deviation has what both surfaces state, and the floor of what no surface states.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

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


SAMPLE = 500
_REFINING = 300
_STEPS = 10
_LEAST_MATCHES = 15
_AGREE_SIGMAS = 5.0
_SLACK_MM = 0.03
"""What poses are still off by while only pairs of views have been fitted."""
_MEDIAN = 0.6745
_REACH_SIGMAS = 4.0
_FACING = 0.95
"""Of a view's faces, that are seen from the origin if the camera stands there, as that of a scan's own frame does."""
_PIXELS = 1.0
"""A pixel of what a camera saw, in edges of the mesh."""
_MARGIN = 3.0
"""How far before what a camera saw a surface has to stand, in edges of the mesh."""
_DAMPING = 1e-4


class Evidence(NamedTuple):
    """Of the points of both views that were asked: how many agree, and how many contradict."""

    agree: float
    against: float


@dataclass(frozen=True, slots=True)
class Sight:
    """What the camera at a view's origin saw.

    nearest_mm : (h, w), the nearest depth in each pixel and those beside it, -inf where it saw nothing. pixel : of
    x / z and y / z. corner : (2,) int64, of the first one.
    """

    nearest_mm: FloatArray
    corner: IntArray
    pixel: float
    margin_mm: float

    def stands_before(self, points_mm: FloatArray) -> int:
        """How many points (n, 3), in the view's frame, lie before what the camera saw."""
        ahead = points_mm[points_mm[:, 2] > 0]
        at = np.floor(ahead[:, :2] / ahead[:, 2:] / self.pixel).astype(np.int64) - self.corner
        inside = ((at >= 0) & (at < self.nearest_mm.shape)).all(axis=1)
        saw = self.nearest_mm[tuple(at[inside].T)]
        return int((ahead[inside, 2] < saw - self.margin_mm).sum())


@dataclass(frozen=True, slots=True)
class Seen:
    """A view, and what its camera saw through; None where the mesh does not lie before a camera at the origin."""

    side: Side
    sight: Sight | None


def seen_by(view: Mesh) -> Seen:
    """A view prepared."""
    side = side_of(view, whole=True)  # that tells most of a box; how well it fits is asked afterwards
    points = side.points_mm
    a, b, c = (points[view.faces[:, corner]] for corner in range(3))
    facing = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    if not len(facing) or facing.mean() < _FACING or points[:, 2].min() <= 0:
        return Seen(side, None)
    pixel = _PIXELS * side.spacing_mm / float(np.median(points[:, 2]))
    # Faces seen at a slant span several pixels: their edges' middles and their own fill those between.
    points = np.concatenate([points, (a + b) / 2, (b + c) / 2, (c + a) / 2, (a + b + c) / 3])
    at = np.floor(points[:, :2] / points[:, 2:] / pixel).astype(np.int64)
    corner = at.min(axis=0)
    nearest = np.full(tuple(at.max(axis=0) - corner + 1), np.inf)
    np.minimum.at(nearest, tuple((at - corner).T), points[:, 2])
    # What was too steep to be measured may stand where nothing was, and reach into the pixels beside it.
    nearest = minimum_filter(np.where(np.isinf(nearest), -np.inf, nearest), size=3, mode="constant", cval=-np.inf)
    return Seen(side, Sight(nearest, corner, pixel, _MARGIN * side.spacing_mm))


def evidence(first: Seen, second: Seen, pose: FloatArray, near_mm: float, most: int = SAMPLE) -> Evidence:
    """Of a pose (4, 4) that takes the first view to the second. near_mm : within which surfaces are compared; most : of
    the points of each view, how many are asked.
    """
    still = np.eye(4)
    agree = against = 0.0
    for one, two, poses in ((first, second, (pose, still)), (second, first, (still, pose))):
        found = matched(one.side, two.side, poses, reach_mm=near_mm, most=most)
        limit = np.hypot(_AGREE_SIGMAS * found.sigma_mm, _AGREE_SIGMAS * _SLACK_MM)
        alike = int((np.abs(found.residual_mm) < limit).sum())
        agree += alike
        against += len(limit) - alike
        if two.sight is not None:
            chosen = one.side.points_mm[one.side.order[:most]]
            against += two.sight.stands_before(moved(np.linalg.inv(poses[1]) @ poses[0], chosen))
    return Evidence(agree, against)


class Facing(NamedTuple):
    """A view that moves, one that stands still, and the poses (4, 4) that take them to one frame."""

    moving: Side
    still: Side
    pose: FloatArray
    still_pose: FloatArray


def fitted(pairs: Sequence[Facing], change: FloatArray, reach_mm: float) -> FloatArray:
    """The change (4, 4) of all views that move, as one, at which surfaces lie on one another, from one near it."""
    points = np.concatenate(
        [moved(each.still_pose, each.still.points_mm[each.still.order[:_REFINING]]) for each in pairs]
    )
    middle = points.mean(axis=0)
    radius = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))
    for _ in range(_STEPS):
        found = [
            matched(each.moving, each.still, (change @ each.pose, each.still_pose), reach_mm=reach_mm, most=_REFINING)
            for each in pairs
        ]
        residual = np.concatenate([each.residual_mm for each in found])
        if len(residual) < _LEAST_MATCHES:
            return change
        # As view 1 of two, whose view 0 stands still.
        terms = assembled([((1, 0), terms_of(each, middle, radius)) for each in found], 2)
        held = terms.information + _DAMPING * np.trace(terms.information) * np.eye(6)
        motion = -np.linalg.solve(held, terms.gradient)
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(motion[:3] / radius).as_matrix()
        step[:3, 3] = middle + motion[3:] - step[:3, :3] @ middle
        change = step @ change
        reach_mm = min(reach_mm, _REACH_SIGMAS * float(np.median(np.abs(residual)) / _MEDIAN))
        if np.linalg.norm(motion) < _SLACK_MM / 10:
            break
    return change


_COARSE, _FINE = 2, 4
"""Blocks in the object's radius. Of eight views with errors of 4 µm that are alike over 2, 4 and 8 mm of an object of
35 mm, these leave 1.1, 1.3 and 2.2 of squared errors over stated ones; blocks of one size 1.2, 1.6 and 3.2."""


def inflation(
    matches: Mapping[tuple[int, int], Matches],
    count: int,
    middle_mm: FloatArray,
    radius_mm: float,
    covariance: FloatArray,
) -> float:
    """The factor f of standard deviations, at least 1. matches : of pairs of the `count` views, where they are placed.

    covariance : (p, p), the inverse of the information of all, in mm², 0 along directions that are held.
    """
    coarse, fine = (
        _at_blocks(matches, count, middle_mm, radius_mm, radius_mm / parts, covariance) for parts in (_COARSE, _FINE)
    )
    return max(2 * coarse - fine, coarse, 1.0)


def _at_blocks(
    matches: Mapping[tuple[int, int], Matches],
    count: int,
    middle_mm: FloatArray,
    radius_mm: float,
    size_mm: float,
    covariance: FloatArray,
) -> float:
    blocks = _by_block(matches, count, middle_mm, radius_mm, size_mm)
    found = np.einsum("bi,ij,bj->", blocks.gradient, covariance, blocks.gradient)
    share = covariance @ blocks.information
    expected = np.einsum("bii->", share) - np.einsum("bij,bji->", share, share)
    return float(np.sqrt(found / expected)) if expected > 0 else 1.0


def _by_block(
    matches: Mapping[tuple[int, int], Matches], count: int, middle_mm: FloatArray, radius_mm: float, size_mm: float
) -> Terms:
    """The terms of each cube of the model's space that matches lie in: all pairs together, whose errors are shared."""
    cubes = [np.floor((each.at_mm - middle_mm) / size_mm).astype(np.int32) for each in matches.values()]
    numbers = np.unique(np.concatenate(cubes), axis=0, return_inverse=True)[1].ravel().astype(np.int32)
    blocks: list[IntArray] = np.split(numbers, np.cumsum([len(each) for each in cubes])[:-1])
    number = int(numbers.max()) + 1
    return assembled(
        (
            (pair, terms_of(each, middle_mm, radius_mm, places=(mine, number)))
            for (pair, each), mine in zip(matches.items(), blocks, strict=True)
        ),
        count,
    )

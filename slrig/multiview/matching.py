"""Point matches between two views, the check of a pose against them, and the uncertainty of registered poses.

A match joins a vertex of one view and the nearest vertex of another. Its residual is their distance along the mean of
both normals: this symmetric form cancels the curvature between the two points (Rusinkiewicz 2019, "A symmetric
objective function for ICP"). Its standard deviation combines the σ of both vertices and `CORRELATED_MM`.
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

Pair = tuple[int, int]
"""Numbers of two views."""

CORRELATED_MM = 0.005
"""Standard deviation of the error that a match shares with its neighbours and that no vertex σ includes."""
_HUBER = 2.0  # Huber's threshold, in standard deviations: 99 % efficient
_MIN_COSINE = 0.9  # of the normals of a match: 26°, far more than noise and any start error turn them
_NOISE_SIGMAS = 4.0  # residuals within so many of their own standard deviations are always accepted
_SEARCH_EDGES = 1.5  # radius of the search for the nearest vertex, on top of the reach, in edges of the mesh

_BORDER_ROWS, _BLUR_ROWS = 2, 4
"""Rows of vertices left out along borders, and, if enough vertices remain, along sharp bends and borders. The camera's
blur rounds edges, with opposite errors in views from the two sides of an edge; four rows remove most of it."""
_MIN_VERTICES = 3000
"""Vertices that have to remain without the rows along bends, and twice as many without those along borders."""
_BEND_DEG = 20.0
"""Angle between normals of neighbours at a sharp bend: well above their noise, and below that of a blurred edge."""


@dataclass(frozen=True, slots=True)
class PreparedView:
    """A view prepared for matching, in its own frame.

    points_mm, normals : (V, 3) float64; variance_mm2 : (V,) float64; usable : (V,) bool; order : (n,) int64, the usable
    vertices in random order; spacing_mm : median edge length; tree : of all points.
    """

    points_mm: FloatArray
    normals: FloatArray
    variance_mm2: FloatArray
    usable: NDArray[np.bool_]
    order: NDArray[np.int64]
    spacing_mm: float
    tree: cKDTree


class PointMatches(NamedTuple):
    """k matches of a first view's vertices with a second view, in the model's frame, float64.

    midpoints_mm : (k, 3), between the two points. normals : (k, 3), unit, the means of `first` and `second`, (k, 3),
    the normals in the two views. residual_mm : (k,), first view less second. sigma_mm : (k,). queried : number of
    vertices for which a match was searched.
    """

    midpoints_mm: FloatArray
    normals: FloatArray
    first: FloatArray
    second: FloatArray
    residual_mm: FloatArray
    sigma_mm: FloatArray
    queried: int


class NormalEquations(NamedTuple):
    """Normal equations of matches for the motion (6,) of the first view, r ≈ J · motion; of the second with sign -1.

    A motion is (ρ ω, t) in mm: a rotation vector ω about the object's middle times the object's radius ρ, and a shift.
    information : (…, 6, 6), Σ w Jᵀ J. unbiased : (…, 6, 6), an estimate of it free of the noise of the normals.
    gradient : (…, 6), Σ w Jᵀ r. A leading dimension counts blocks of the surface.
    """

    information: FloatArray
    unbiased: FloatArray
    gradient: FloatArray


def prepare_view(view: Mesh, *, whole: bool = False) -> PreparedView:
    """Prepare a view for matching.

    Vertices without normal or σ, clipped ones, grazing ones and borders are not usable; nor, unless `whole`, are the
    rows next to borders and sharp bends.
    """
    points, normals = view.vertices_mm.astype(np.float64), view.normals.astype(np.float64)
    edges = points[view.faces[:, 0]] - points[view.faces[:, 1]]
    usable = (
        np.isfinite(normals[:, 0] + normals[:, 1] + normals[:, 2] + view.sigma_mm)  # one sum: a reduction is slow
        & ~np.isin(view.mark, (AlbedoMark.SATURATED, AlbedoMark.GRAZING))
    )
    border = boundary_vertices(view.faces, len(usable))
    usable &= ~border
    if not whole:
        usable = _interior_vertices(usable, border, view.faces, _BORDER_ROWS)
        usable = _interior_vertices(usable, _bend_vertices(view), view.faces, _BLUR_ROWS, min_count=_MIN_VERTICES)
        usable = _interior_vertices(usable, border, view.faces, _BLUR_ROWS, min_count=2 * _MIN_VERTICES)
    return PreparedView(
        points_mm=points,
        normals=normals,
        variance_mm2=view.sigma_mm.astype(np.float64) ** 2,
        usable=usable,
        # A fixed seed: the same scans give the same files.
        order=np.random.default_rng(0).permutation(np.flatnonzero(usable)),
        spacing_mm=float(np.median(np.sqrt(np.einsum("ij,ij->i", edges, edges)))) if len(edges) else 0.0,
        # Faster to build than the default tree; queries take no longer.
        tree=cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False),
    )


def _interior_vertices(
    usable: NDArray[np.bool_], edge: NDArray[np.bool_], faces: IntArray, rows: int, min_count: float = 0
) -> NDArray[np.bool_]:
    """(V,) bool: `usable` without an edge's vertices and up to `rows` rows next to them, as long as enough remain."""
    remaining, min_count = usable, max(min_count, np.count_nonzero(usable) / 2)
    first, second, third = np.ascontiguousarray(faces.T)
    for row in range(rows + 1):
        if row:
            edge = edge.copy()
            edge[faces[edge[first] | edge[second] | edge[third]]] = True
        if np.count_nonzero(usable & ~edge) < min_count:
            break
        remaining = usable & ~edge
    return remaining


def _bend_vertices(view: Mesh) -> NDArray[np.bool_]:
    """(V,) bool: vertices of faces whose corner normals differ by more than `_BEND_DEG`."""
    a, b, c = (view.normals[view.faces[:, corner]] for corner in range(3))
    cosine = np.min([np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a))], axis=0)
    bend = np.zeros(len(view.vertices_mm), dtype=np.bool_)
    bend[view.faces[cosine < np.cos(np.deg2rad(_BEND_DEG))]] = True
    return bend


def transform_points(pose: FloatArray, points_mm: NDArray[np.floating[Any]]) -> FloatArray:
    """Transform points (n, 3) by a pose (4, 4)."""
    return rotate_vectors(pose, points_mm) + pose[:3, 3]


def rotate_vectors(pose: FloatArray, vectors: NDArray[np.floating[Any]]) -> FloatArray:
    """Rotate vectors (n, 3) by a pose (4, 4). Not with BLAS, whose threads cost more than they save here."""
    return np.asarray(np.einsum("nj,ij->ni", vectors.astype(np.float64), pose[:3, :3]))


def match_points(
    first: PreparedView, second: PreparedView, poses: tuple[FloatArray, FloatArray], *, reach_mm: float, max_count: int
) -> PointMatches:
    """Match up to `max_count` vertices of the first view with the second; residuals are limited to `reach_mm`."""
    chosen = np.sort(first.order[:max_count])  # sorted: successive queries walk the same nodes of the tree
    points = transform_points(poses[0], first.points_mm[chosen])
    inverse = np.asarray(np.linalg.inv(poses[1]), dtype=np.float64)
    radius_mm = reach_mm + _SEARCH_EDGES * second.spacing_mm
    answer = second.tree.query(transform_points(inverse, points), distance_upper_bound=radius_mm)
    distance, nearest = np.asarray(answer[0]), np.asarray(answer[1])
    found = np.flatnonzero(np.isfinite(distance))
    found = found[second.usable[nearest[found]]]
    chosen, points, nearest = chosen[found], points[found], nearest[found]
    first_normals = rotate_vectors(poses[0], first.normals[chosen])
    second_normals = rotate_vectors(poses[1], second.normals[nearest])
    others = transform_points(poses[1], second.points_mm[nearest])
    mean = first_normals + second_normals
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    residual = ((points - others) * mean).sum(axis=1)
    sigma = np.sqrt(first.variance_mm2[chosen] + second.variance_mm2[nearest] + CORRELATED_MM**2)
    accepted = (first_normals * second_normals).sum(axis=1) > _MIN_COSINE
    accepted &= np.abs(residual) < np.maximum(reach_mm, _NOISE_SIGMAS * sigma)
    return PointMatches(
        midpoints_mm=((points + others) / 2)[accepted],
        normals=mean[accepted],
        first=first_normals[accepted],
        second=second_normals[accepted],
        residual_mm=residual[accepted],
        sigma_mm=sigma[accepted],
        queried=len(first.order[:max_count]),
    )


def normal_equations(
    matches: PointMatches, middle_mm: FloatArray, radius_mm: float, *, blocks: tuple[IntArray, int] | None = None
) -> NormalEquations:
    """Sum over all matches, or over those of each block. blocks : (k,) int, the block of each match, and their number.

    Noise of the normals adds to Jᵀ J, so that even a rotation of a ball would seem to be determined. The noise of the
    two views is independent: the mixed products Σ w (Jᵀ K + Kᵀ J) / 2 of both normals' rows J and K are unbiased.
    """
    scaled = matches.residual_mm / matches.sigma_mm
    weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(scaled), 1e-9)) / matches.sigma_mm**2
    arm = (matches.midpoints_mm - middle_mm) / radius_mm
    mean, first, second = (
        np.hstack([np.cross(arm, normals), normals]) for normals in (matches.normals, matches.first, matches.second)
    )
    if blocks is None:
        mixed = (first * weight[:, None]).T @ second
        weighted = mean * weight[:, None]
        return NormalEquations(weighted.T @ mean, (mixed + mixed.T) / 2, weighted.T @ matches.residual_mm)
    block, count = blocks

    def block_sums(rows: FloatArray, columns: FloatArray) -> FloatArray:
        sums = np.zeros((count, rows.shape[1], columns.shape[1]))
        np.add.at(sums, block, (rows * weight[:, None])[:, :, None] * columns[:, None, :])
        return sums

    mixed = block_sums(first, second)
    gradient = block_sums(mean, matches.residual_mm[:, None])[:, :, 0]
    return NormalEquations(block_sums(mean, mean), (mixed + mixed.swapaxes(1, 2)) / 2, gradient)


def assemble_equations(pairs: Iterable[tuple[Pair, NormalEquations]], count: int) -> NormalEquations:
    """Assemble the equations of pairs (first, second) of `count` views for the motions (6 (N - 1),) of views 1, 2, …"""
    pairs = list(pairs)
    lead = pairs[0][1].gradient.shape[:-1]
    information, unbiased = np.zeros((2, *lead, 6 * count, 6 * count))
    gradient = np.zeros((*lead, 6 * count))
    for (i, j), equations in pairs:
        a, b = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
        for rows, columns, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            information[..., rows, columns] += sign * equations.information
            unbiased[..., rows, columns] += sign * equations.unbiased
        gradient[..., a] += equations.gradient
        gradient[..., b] -= equations.gradient
    return NormalEquations(information[..., 6:, 6:], unbiased[..., 6:, 6:], gradient[..., 6:])


SAMPLE = 500
_ALIGN_SAMPLE = 300
_MAX_STEPS = 10
_MIN_MATCHES = 15
_AGREE_SIGMAS = 5.0
_SLACK_MM = 0.03  # error that poses still have while only pairs of views have been aligned
_MEDIAN_PER_SIGMA = 0.6745
_REACH_SIGMAS = 4.0
_MIN_FACING = 0.95  # share of a view's faces that face the origin if the camera is there, as in a scan's own frame
_EDGES_PER_PIXEL = 1.0  # size of a pixel of a depth buffer, in edges of the mesh
_DEPTH_MARGIN = 3.0  # least distance of a point in front of a depth buffer, in edges of the mesh
_DAMPING = 1e-4


class PoseEvidence(NamedTuple):
    """Number of points of both views that agree with a pose, and of those that contradict it."""

    agree: float
    contradict: float


@dataclass(frozen=True, slots=True)
class DepthBuffer:
    """Depth of a view as seen by a camera at the origin.

    depth_mm : (h, w), the nearest depth in each pixel and its neighbours, -inf where nothing was measured. pixel : its
    size in x / z and y / z. corner : (2,) int64, of the first pixel. margin_mm : see `_DEPTH_MARGIN`.
    """

    depth_mm: FloatArray
    corner: IntArray
    pixel: float
    margin_mm: float

    def count_in_front(self, points_mm: FloatArray) -> int:
        """Number of points (n, 3), in the view's frame, in front of the measured surface."""
        ahead = points_mm[points_mm[:, 2] > 0]
        at = np.floor(ahead[:, :2] / ahead[:, 2:] / self.pixel).astype(np.int64) - self.corner
        inside = ((at >= 0) & (at < self.depth_mm.shape)).all(axis=1)
        depth = self.depth_mm[tuple(at[inside].T)]
        return int((ahead[inside, 2] < depth - self.margin_mm).sum())


@dataclass(frozen=True, slots=True)
class ViewWithDepth:
    """A prepared view and its depth buffer, None unless the mesh faces a camera at the origin."""

    view: PreparedView
    depth: DepthBuffer | None


def prepare_with_depth(mesh: Mesh) -> ViewWithDepth:
    """Prepare a view, borders and bends included, and its depth buffer."""
    view = prepare_view(mesh, whole=True)  # the rows along bends are most of what locates a box
    points = view.points_mm
    a, b, c = (points[mesh.faces[:, corner]] for corner in range(3))
    facing = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    if not len(facing) or facing.mean() < _MIN_FACING or points[:, 2].min() <= 0:
        return ViewWithDepth(view, None)
    pixel = _EDGES_PER_PIXEL * view.spacing_mm / float(np.median(points[:, 2]))
    # Slanted faces span several pixels: the midpoints of their edges and their centroids fill those between.
    points = np.concatenate([points, (a + b) / 2, (b + c) / 2, (c + a) / 2, (a + b + c) / 3])
    at = np.floor(points[:, :2] / points[:, 2:] / pixel).astype(np.int64)
    corner = at.min(axis=0)
    nearest = np.full(tuple(at.max(axis=0) - corner + 1), np.inf)
    np.minimum.at(nearest, tuple((at - corner).T), points[:, 2])
    # Surface too steep to be measured may be where nothing was, and reach into the next pixels.
    nearest = minimum_filter(np.where(np.isinf(nearest), -np.inf, nearest), size=3, mode="constant", cval=-np.inf)
    return ViewWithDepth(view, DepthBuffer(nearest, corner, pixel, _DEPTH_MARGIN * view.spacing_mm))


def compare_views(
    first: ViewWithDepth, second: ViewWithDepth, pose: FloatArray, reach_mm: float, max_count: int = SAMPLE
) -> PoseEvidence:
    """Count the points that agree with a pose (4, 4) of the first view in the second's frame, and those against it.

    reach_mm : distance within which surfaces are compared; max_count : number of points of each view.
    """
    fixed = np.eye(4)
    agree = contradict = 0.0
    for one, two, poses in ((first, second, (pose, fixed)), (second, first, (fixed, pose))):
        found = match_points(one.view, two.view, poses, reach_mm=reach_mm, max_count=max_count)
        limit = np.hypot(_AGREE_SIGMAS * found.sigma_mm, _AGREE_SIGMAS * _SLACK_MM)
        close = int((np.abs(found.residual_mm) < limit).sum())
        agree += close
        contradict += len(limit) - close
        if two.depth is not None:
            chosen = one.view.points_mm[one.view.order[:max_count]]
            contradict += two.depth.count_in_front(transform_points(np.linalg.inv(poses[1]) @ poses[0], chosen))
    return PoseEvidence(agree, contradict)


class ViewPair(NamedTuple):
    """A moving view, a fixed one, and their poses (4, 4) in a common frame."""

    moving: PreparedView
    fixed: PreparedView
    pose: FloatArray
    fixed_pose: FloatArray


def align_views(pairs: Sequence[ViewPair], change: FloatArray, reach_mm: float) -> FloatArray:
    """Align all moving views, as one body, to the fixed ones. change : (4, 4), where the iteration starts.

    Returns the change (4, 4) of the moving views' poses.
    """
    points = np.concatenate(
        [transform_points(pair.fixed_pose, pair.fixed.points_mm[pair.fixed.order[:_ALIGN_SAMPLE]]) for pair in pairs]
    )
    middle = points.mean(axis=0)
    radius = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))
    for _ in range(_MAX_STEPS):
        found = [
            match_points(moving, fixed, (change @ pose, fixed_pose), reach_mm=reach_mm, max_count=_ALIGN_SAMPLE)
            for moving, fixed, pose, fixed_pose in pairs
        ]
        residual = np.concatenate([each.residual_mm for each in found])
        if len(residual) < _MIN_MATCHES:
            return change
        # As view 1 of two, of which view 0 is fixed.
        equations = assemble_equations([((1, 0), normal_equations(each, middle, radius)) for each in found], 2)
        damped = equations.information + _DAMPING * np.trace(equations.information) * np.eye(6)
        motion = -np.linalg.solve(damped, equations.gradient)
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(motion[:3] / radius).as_matrix()
        step[:3, 3] = middle + motion[3:] - step[:3, :3] @ middle
        change = step @ change
        reach_mm = min(reach_mm, _REACH_SIGMAS * float(np.median(np.abs(residual)) / _MEDIAN_PER_SIGMA))
        if np.linalg.norm(motion) < _SLACK_MM / 10:
            break
    return change


_COARSE_BLOCKS, _FINE_BLOCKS = 2, 4  # blocks in the object's radius, two sizes to extrapolate to long correlations


def inflation_factor(
    matches: Mapping[Pair, PointMatches], count: int, middle_mm: FloatArray, radius_mm: float, covariance: FloatArray
) -> float:
    """Factor of the poses' standard deviations, at least 1, for errors that neighbouring points share.

    matches : of pairs of the `count` views at their final poses. covariance : (p, p), mm², the inverse of the
    information, 0 along free directions. The residuals' sums over blocks of the surface show their correlation. Blocks
    are cubes of the model's space, the same for all pairs, which share the errors in them.
    """

    def at_block_size(size_mm: float) -> float:
        cubes = [np.floor((each.midpoints_mm - middle_mm) / size_mm).astype(np.int32) for each in matches.values()]
        numbers = np.unique(np.concatenate(cubes), axis=0, return_inverse=True)[1].ravel().astype(np.int32)
        by_pair: list[IntArray] = np.split(numbers, np.cumsum([len(each) for each in cubes])[:-1])
        number = int(numbers.max()) + 1
        pairs = (
            (pair, normal_equations(each, middle_mm, radius_mm, blocks=(own, number)))
            for (pair, each), own in zip(matches.items(), by_pair, strict=True)
        )
        blocks = assemble_equations(pairs, count)
        found = np.einsum("bi,ij,bj->", blocks.gradient, covariance, blocks.gradient)
        share = covariance @ blocks.information
        expected = np.einsum("bii->", share) - np.einsum("bij,bji->", share, share)
        return float(np.sqrt(found / expected)) if expected > 0 else 1.0

    coarse, fine = (at_block_size(radius_mm / parts) for parts in (_COARSE_BLOCKS, _FINE_BLOCKS))
    return max(2 * coarse - fine, coarse, 1.0)

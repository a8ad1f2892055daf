"""Initial poses of views without any known pose: found from the surfaces, or refused.

Spin images of keypoints (Johnson and Hebert 1999, "Using spin images for efficient object recognition in cluttered 3D
scenes") yield candidate poses of each pair of views. Starting from the pair that agrees best, views are added while all
of their surfaces agree (`slrig.multiview.matching`). Then each view, and each group that a single pair connects to the
rest, is tried at its other candidates. It moves where that agrees better; where another answer agrees nearly as well,
both are rejected as ambiguous.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from slrig.errors import RegistrationRefusedError
from slrig.model import FloatArray, IntArray, Mesh
from slrig.multiview.matching import (
    SAMPLE,
    Pair,
    PoseEvidence,
    PreparedView,
    ViewPair,
    ViewWithDepth,
    align_views,
    compare_views,
    prepare_with_depth,
    transform_points,
)
from slrig.multiview.registration import register_views

_SUPPORT_VERTICES = 2500  # vertices of a view that represent its surface
_KEYPOINTS = 500
_RADII = (0.25, 0.12)
"""Radii of spin images, over the square root of a view's area: for parts of the object, and for details."""
_NORMAL_RADIUS = 0.7  # radius, in keypoint spacings, over which a keypoint's normal is averaged
_ACROSS, _ALONG = 8, 12


@dataclass(frozen=True, slots=True)
class Keypoints:
    """Keypoints of a view, one in each cell of a grid, in the view's frame.

    points_mm, normals : (k, 3) float64; spin_images : (k, d) float32, unit: their products are similarities.
    """

    points_mm: FloatArray
    normals: FloatArray
    spin_images: FloatArray


def vertex_areas_mm2(view: Mesh) -> FloatArray:
    """(V,) float64: a third of the area of the triangles at each vertex."""
    a, b, c = (view.vertices_mm[view.faces[:, corner]].astype(np.float64) for corner in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    sums = np.bincount(view.faces.ravel(), np.repeat(third, 3), len(view.vertices_mm))
    return np.asarray(sums, dtype=np.float64)


def keypoint_spacing_mm(area_mm2: float) -> float:
    """Edge of the grid's cells for a view with this area."""
    return float(np.sqrt(area_mm2 / _KEYPOINTS))


def select_keypoints(view: PreparedView, weights_mm2: FloatArray, area_mm2: float) -> Keypoints:
    """Select keypoints. weights_mm2 : (V,), see `vertex_areas_mm2`; area_mm2 : of a view, the same for all views."""
    chosen = view.order[:_SUPPORT_VERTICES]
    points, normals = view.points_mm[chosen], view.normals[chosen]
    # The chosen vertices represent the area of all.
    weights = weights_mm2[chosen] * (weights_mm2[view.order].sum() / max(weights_mm2[chosen].sum(), 1e-12))
    cell = keypoint_spacing_mm(area_mm2)
    first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)[1]
    middles = points[first]
    # A mean normal has less noise than the vertex's own, and tilts a spin image less.
    which, other = np.nonzero(_squared_distances(middles, points) < (_NORMAL_RADIUS * cell) ** 2)
    mean = np.zeros((len(middles), 3))
    for axis in range(3):
        mean[:, axis] = np.bincount(which, (normals[:, axis] * weights)[other], len(middles))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    images = [_spin_images(middles, mean, points, weights, share * float(np.sqrt(area_mm2))) for share in _RADII]
    return Keypoints(middles, mean, np.hstack(images) / np.sqrt(len(images)))


def _squared_distances(a: FloatArray, b: FloatArray) -> FloatArray:
    """(k, n): squared distances of points (k, 3) from others (n, 3)."""
    return np.asarray((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T)


def _spin_images(
    middles: FloatArray, normals: FloatArray, points: FloatArray, weights: FloatArray, radius_mm: float
) -> FloatArray:
    """(k, bins) float32, unit: square roots of shares of area, so that products are Bhattacharyya coefficients."""
    squares = _squared_distances(middles, points)
    which, other = np.nonzero(squares < radius_mm**2)
    along = ((points[other] - middles[which]) * normals[which]).sum(axis=1)
    across = np.sqrt(np.maximum(squares[which, other] - along**2, 0.0))
    # Bilinear: each point counts in the four bins around it, so that small shifts change little.
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


_NEAREST_KEYPOINTS = 3  # most similar keypoints of the other view that each keypoint is paired with
_REFERENCE_RANK = 20
"""Rank of the keypoint that a distinctive one has to be clearly less similar to: on a plane all are alike."""
_MAX_PAIRS = 600
_MAX_COSINE_DIFFERENCE = 0.25
_MIN_PAIRS = 6  # pairs that agree on a pose: three determine it
_MIN_COSINE = 0.8
_SPARSE_STEP = 12
_CANDIDATE_SEPARATION = 3.0
"""Distance of poses, over that of equal keypoints, below which alignment leads to the same pose."""
_HYPOTHESES = 700
"""Enough to find a pose again and again if one pair of keypoints in eight is right, and so one hypothesis in fifty."""


def candidate_poses(first: Keypoints, second: Keypoints, *, within_mm: float, max_count: int) -> FloatArray:
    """(c, 4, 4), c up to `max_count`: poses of the first view in the frame of the second, those with most pairs first.

    within_mm : distance of the same place in both views, since keypoints are selected independently.
    """
    a, b = _match_keypoints(first.spin_images, second.spin_images)
    p, q, m, n = first.points_mm[a], second.points_mm[b], first.normals[a], second.normals[b]
    compatible = _compatible_pairs(p, q, m, n, within_mm)
    ones, twos = np.nonzero(compatible)
    if not len(ones):
        return np.zeros((0, 4, 4))
    # Each pair is drawn equally often, however many others it is compatible with.
    share = 1 / compatible.sum(axis=1)[ones]
    drawn = np.random.default_rng(0).choice(len(ones), _HYPOTHESES, p=share / share.sum())
    both = np.stack([ones[drawn], twos[drawn]], axis=1)
    # Two points with their normals determine a pose: as four points.
    arm = np.linalg.norm(p[both[:, 1]] - p[both[:, 0]], axis=1)[:, None, None]
    poses = rigid_motions(np.hstack([p[both], p[both] + arm * m[both]]), np.hstack([q[both], q[both] + arm * n[both]]))
    consistent = _consistent_pairs(p, q, m, n, poses, within_mm)
    counts = consistent.sum(axis=1)
    found: list[FloatArray] = []
    for each in np.argsort(-counts, kind="stable"):
        if counts[each] < _MIN_PAIRS or len(found) == max_count:
            break
        distances = (pose_distance_mm(poses[each], other, p[::_SPARSE_STEP]) for other in found)
        if all(distance > _CANDIDATE_SEPARATION * within_mm for distance in distances):
            found.append(rigid_motions(p[consistent[each]], q[consistent[each]]))
    return np.array(found).reshape(-1, 4, 4)


def pose_distance_mm(pose: FloatArray, other: FloatArray, points_mm: FloatArray) -> float:
    """Rms distance of points (n, 3) between two poses (4, 4)."""
    apart = transform_points(pose, points_mm) - transform_points(other, points_mm)
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def _consistent_pairs(
    p: FloatArray, q: FloatArray, m: FloatArray, n: FloatArray, poses: FloatArray, within_mm: float
) -> NDArray[np.bool_]:
    """(h, k): True if pose h (4, 4) takes point k, with its normal, to its partner."""
    turns = poses[:, :3, :3].astype(np.float32)
    there = p.astype(np.float32) @ turns.swapaxes(1, 2) + poses[:, None, :3, 3].astype(np.float32)
    near = ((there - q.astype(np.float32)) ** 2).sum(axis=2) < within_mm**2
    cosine = ((m.astype(np.float32) @ turns.swapaxes(1, 2)) * n.astype(np.float32)).sum(axis=2)
    return np.asarray(near & (cosine > _MIN_COSINE))


def rigid_motions(source: FloatArray, target: FloatArray) -> FloatArray:
    """(…, 4, 4): least-squares motions of points (…, n, 3) to others (Umeyama 1991, without scale)."""
    middle, goal = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    left, _, right = np.linalg.svd((target - goal).swapaxes(-1, -2) @ (source - middle))
    # A reflection becomes a rotation by reversing the direction with the least singular value.
    left[..., :, 2] *= np.linalg.det(left @ right)[..., None]
    pose = np.broadcast_to(np.eye(4), (*source.shape[:-2], 4, 4)).copy()
    pose[..., :3, :3] = left @ right
    pose[..., :3, 3] = (goal - middle @ pose[..., :3, :3].swapaxes(-1, -2))[..., 0, :]
    return pose


def _match_keypoints(first: FloatArray, second: FloatArray) -> tuple[IntArray, IntArray]:
    """Indices (p,) of similar keypoints of both views, the most distinctive pairs."""
    similarity = first @ second.T
    found = []
    for table, flip in ((similarity, False), (similarity.T, True)):
        rank = min(_REFERENCE_RANK, table.shape[1] - 1)
        best = np.argpartition(-table, rank, axis=1)[:, : rank + 1]
        value = np.take_along_axis(table, best, axis=1)
        order = np.argsort(-value, axis=1)
        best, value = np.take_along_axis(best, order, axis=1), np.take_along_axis(value, order, axis=1)
        ratio = (1 - value[:, :_NEAREST_KEYPOINTS]) / np.maximum(1 - value[:, -1:], 1e-9)
        rows = np.repeat(np.arange(len(table)), ratio.shape[1])
        columns = best[:, :_NEAREST_KEYPOINTS].ravel()
        pair = (columns, rows) if flip else (rows, columns)
        found.append(np.stack([*pair, ratio.ravel()]))
    both = np.concatenate(found, axis=1)
    both = both[:, np.argsort(both[2], kind="stable")]
    unique = np.sort(np.unique(both[:2], axis=1, return_index=True)[1])[:_MAX_PAIRS]
    a, b = both[:2, unique].astype(np.int64)
    return a, b


def _compatible_pairs(
    p: FloatArray, q: FloatArray, m: FloatArray, n: FloatArray, within_mm: float
) -> NDArray[np.bool_]:
    """(n, n): True if two pairs of points p, q (n, 3) with normals m, n (n, 3) may belong to one pose."""
    one, two = _relations(p, m), _relations(q, n)
    distance, along, cosine = (np.abs(x - y) for x, y in zip(one, two, strict=True))
    both = (distance < within_mm) & (along < within_mm) & (within_mm > along.T) & (cosine < _MAX_COSINE_DIFFERENCE)
    # Points near to one another are so in any pose.
    return np.asarray(both & (one[0] > 2 * within_mm))


def _relations(points: FloatArray, normals: FloatArray) -> tuple[FloatArray, ...]:
    """(n, n) each: distances; heights of the second point over the first's plane; cosines of the normals."""
    points, normals = points.astype(np.float32), normals.astype(np.float32)
    squares = (points**2).sum(axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares - 2 * points @ points.T, 0))
    along = normals @ points.T - (normals * points).sum(axis=1)[:, None]
    return distance, along, normals @ normals.T


_MAX_FITTED, _MAX_CANDIDATES = 12, 6  # poses of a pair that are aligned, and those that remain, the best ones
_REACH_SPACINGS = 2.0
_CONTRADICTION_WEIGHT = 8.0
"""Points in agreement that outweigh a contradicting one: at true poses one point in fifty contradicts, at steps and
slits; at wrong poses of repetitive objects one in ten or more."""
_MIN_AGREE = 0.02  # share of the points of both views, as `register_views` requires it
_AMBIGUOUS_SHARE = 0.5  # score of an alternative, over the best one, that makes the answer ambiguous
_BETTER_SHARE = 1.1  # score of an alternative, over the best one, that makes it the best one; all are then tried again
_COARSE_SAMPLE, _COARSE_RATIO, _COARSE_PAIRS = 100, 2.0, 4
"""Before an alternative is aligned: points of a view that are compared, points in agreement for each contradicting one,
and pairs that it is then aligned by."""
_ALTERNATIVE_SEPARATION = 2.0  # distance of alternatives, over the reach, below which they are the same
_ADVICE = (
    "Scan it with something that is fixed to it and has no symmetry, or state where to start from: the turntable's "
    "angle and axis, or poses"
)


class _CandidatePose(NamedTuple):
    """A pose (4, 4) of view `first` in the frame of view `second`, and its score."""

    first: int
    second: int
    pose: FloatArray
    score: float


class _Alternative(NamedTuple):
    """A part of the views (k,), its motion (4, 4) to another place, and its score there over the one here."""

    part: IntArray
    change: FloatArray
    share: float


def find_start_poses(views: Sequence[Mesh], *, names: Sequence[str] | None = None) -> FloatArray:
    """(N, 4, 4): registered poses of the views in the frame of the first, from their surfaces alone.

    Free space is checked if a mesh faces a camera at its origin. names : of the views, for messages.

    Raises RegistrationRefusedError: no poses agree with the views, or others agree nearly as well: the object is
    symmetric or repeats itself.
    """
    names = names or [f"view {number}" for number in range(len(views))]
    if len(views) < 2:
        message = f"expected two views or more, found {len(views)}; scan the object from another side"
        raise RegistrationRefusedError(message)
    search = _build_search([prepare_with_depth(view) for view in views], views, names)
    poses = search.assemble()
    for _ in range(2 * len(views)):
        # Wrong poses may not converge: an alternative is better, or none is right.
        refused = None
        try:
            found = register_views(views, poses, names=names, start_error_mm=search.reach_mm)
            poses = found.poses
        except RegistrationRefusedError as error:
            refused = error
        alternative = search.best_alternative(poses)
        if alternative is None or alternative.share < _BETTER_SHARE:
            break
        poses[alternative.part] = alternative.change @ poses[alternative.part]
        poses = np.linalg.inv(poses[0]) @ poses
    if alternative is not None:
        raise RegistrationRefusedError(search.ambiguity_message(alternative, poses))
    if refused is not None:
        raise refused
    if found.free:
        motion = found.free[0]
        message = (
            f"{names[motion.view]}: expected a shape that determines the poses, found that this view may {motion}, and "
            f"no start that fixes it. {_ADVICE}"
        )
        raise RegistrationRefusedError(message)
    return poses


@dataclass(frozen=True, slots=True)
class _Search:
    """Views, and the candidate poses of pairs of them, the best first."""

    views: Sequence[ViewWithDepth]
    names: Sequence[str]
    reach_mm: float
    candidates: Sequence[_CandidatePose]

    def assemble(self) -> FloatArray:
        """Poses (N, 4, 4) of all views in the frame of the first.

        Raises RegistrationRefusedError: a view has no place.
        """
        count = len(self.views)
        poses, group = np.tile(np.eye(4), (count, 1, 1)), np.arange(count)
        for each in self.candidates:
            some, others = (group == group[view] for view in (each.first, each.second))
            if each.score <= 0 or group[each.first] == group[each.second]:
                continue
            pairs = list(product(np.flatnonzero(some).tolist(), np.flatnonzero(others).tolist()))
            change = self._align(pairs, poses, _candidate_change(each, poses))
            if sum(_score(self._evidence(pair, poses, change, SAMPLE)) for pair in pairs) > 0:
                poses[some] = change @ poses[some]
                group[some] = group[each.second]
        if len(np.unique(group)) > 1:
            largest = np.bincount(group).argmax()
            apart = ", ".join(name for name, own in zip(self.names, group, strict=True) if own != largest)
            message = (
                f"{apart}: expected surface that matches other views, found none that does. Scan from between, so that "
                f"neighbours share half of their surface. {_ADVICE}"
            )
            raise RegistrationRefusedError(message)
        return np.asarray(np.linalg.inv(poses[0]) @ poses)

    def best_alternative(self, poses: FloatArray) -> _Alternative | None:
        """The best other place of a part of the views; None if none agrees nearly as well."""
        count = len(self.views)
        scores = np.zeros((count, count))
        for i, j in combinations(range(count), 2):
            scores[i, j] = scores[j, i] = _score(self._evidence((i, j), poses, np.eye(4), SAMPLE))
        found: _Alternative | None = None
        for part in _parts(scores):
            rest = np.setdiff1d(np.arange(count), part)
            best = max(float(scores[np.ix_(part, rest)].sum()), 1.0)
            pairs = list(product(part.tolist(), rest.tolist()))
            for change in self._changes(part, poses):
                share = self._score_after(pairs, poses, change, _AMBIGUOUS_SHARE * best) / best
                if share > max(_AMBIGUOUS_SHARE, found.share if found else 0):
                    found = _Alternative(part, change, share)
        return found

    def ambiguity_message(self, alternative: _Alternative, poses: FloatArray) -> str:
        """Message that the answer is ambiguous."""
        angle = np.rad2deg(np.linalg.norm(Rotation.from_matrix(alternative.change[:3, :3]).as_rotvec()))
        points = np.concatenate([transform_points(poses[view], self._points_mm(view)) for view in alternative.part])
        away_mm = pose_distance_mm(alternative.change, np.eye(4), points)
        return (
            f"{', '.join(self.names[view] for view in alternative.part)}: expected one place that agrees with the "
            f"other views, found a second one, turned by {angle:.0f}° and {away_mm:.0f} mm from the first, that agrees "
            f"{alternative.share:.0%} as well: the object is symmetric or repeats itself. {_ADVICE}"
        )

    def _changes(self, part: IntArray, poses: FloatArray) -> Iterator[FloatArray]:
        """Motions (4, 4) of a part of the views to where candidates with the other views place it."""
        points = np.concatenate([transform_points(poses[view], self._points_mm(view)) for view in part])
        tried = [np.eye(4)]
        for each in self.candidates:
            if (each.first in part) != (each.second in part):
                change = _candidate_change(each, poses)
                if each.second in part:
                    change = np.asarray(np.linalg.inv(change), dtype=np.float64)
                distances = (pose_distance_mm(change, other, points) for other in tried)
                if all(distance > _ALTERNATIVE_SEPARATION * self.reach_mm for distance in distances):
                    tried.append(change)
                    yield change

    def _score_after(self, pairs: Sequence[Pair], poses: FloatArray, change: FloatArray, min_score: float) -> float:
        """Score of a part with the rest after a motion of it and alignment; -inf if a sample is far from agreement."""
        coarse = [(pair, self._evidence(pair, poses, change, _COARSE_SAMPLE)) for pair in pairs]
        agree, contradict = np.array([found for _, found in coarse]).sum(axis=0)
        if agree < _COARSE_RATIO * contradict or agree * SAMPLE / _COARSE_SAMPLE < min_score:
            return -np.inf
        best = sorted(coarse, key=lambda each: -each[1].agree)[:_COARSE_PAIRS]
        aligned = self._align([pair for pair, _ in best], poses, change)
        return sum(_score(self._evidence(pair, poses, aligned, SAMPLE)) for pair in pairs)

    def _align(self, pairs: Sequence[Pair], poses: FloatArray, change: FloatArray) -> FloatArray:
        both = [ViewPair(self.views[i].view, self.views[j].view, poses[i], poses[j]) for i, j in pairs]
        return align_views(both, change, self.reach_mm)

    def _evidence(self, pair: Pair, poses: FloatArray, change: FloatArray, max_count: int) -> PoseEvidence:
        """Evidence of a pair of views at poses, after a motion of the first one."""
        i, j = pair
        relative = np.linalg.inv(poses[j]) @ change @ poses[i]
        return compare_views(self.views[i], self.views[j], relative, self.reach_mm, max_count)

    def _points_mm(self, number: int) -> FloatArray:
        view = self.views[number].view
        return view.points_mm[view.order[:_COARSE_SAMPLE]]


def _build_search(prepared: Sequence[ViewWithDepth], views: Sequence[Mesh], names: Sequence[str]) -> _Search:
    for name, each in zip(names, prepared, strict=True):
        if not len(each.view.order):
            raise RegistrationRefusedError(
                f"{name}: expected a surface, found no vertex that can be used; scan it again"
            )
    weights = [vertex_areas_mm2(view) for view in views]
    area = float(np.median([each.sum() for each in weights]))
    keypoints = [select_keypoints(each.view, own, area) for each, own in zip(prepared, weights, strict=True)]
    spacing = keypoint_spacing_mm(area)
    reach_mm = _REACH_SPACINGS * spacing
    candidates = []
    for i, j in combinations(range(len(prepared)), 2):
        of_pair: list[_CandidatePose] = []
        for start in candidate_poses(keypoints[i], keypoints[j], within_mm=spacing, max_count=_MAX_FITTED):
            pose = align_views([ViewPair(prepared[i].view, prepared[j].view, np.eye(4), np.eye(4))], start, reach_mm)
            if all(pose_distance_mm(pose, other.pose, keypoints[i].points_mm) > spacing for other in of_pair):
                found = compare_views(prepared[i], prepared[j], pose, reach_mm)
                if found.agree > _MIN_AGREE * 2 * SAMPLE:
                    of_pair.append(_CandidatePose(i, j, pose, _score(found)))
        candidates += sorted(of_pair, key=lambda each: -each.score)[:_MAX_CANDIDATES]
    return _Search(prepared, names, reach_mm, sorted(candidates, key=lambda each: -each.score))


def _score(found: PoseEvidence) -> float:
    return found.agree - _CONTRADICTION_WEIGHT * found.contradict


def _candidate_change(each: _CandidatePose, poses: FloatArray) -> FloatArray:
    """(4, 4): motion of the first view, and of all connected to it, that gives the pair its candidate pose."""
    return np.asarray(poses[each.second] @ each.pose @ np.linalg.inv(poses[each.first]))


def _parts(scores: FloatArray) -> list[IntArray]:
    """Each view alone, and both sides of each edge of the tree of best scores. scores : (N, N), of pairs."""
    # The tree of the highest scores is that of least cost; a cost of 0 would be no edge.
    cost = np.triu(scores.max() + 1 - scores, 1)
    tree = minimum_spanning_tree(cost).toarray()
    parts = [np.array([view]) for view in range(len(scores))]
    for edge in np.argwhere(tree):
        rest = tree.copy()
        rest[tuple(edge)] = 0
        group = connected_components(rest, directed=False)[1]
        parts.append(np.flatnonzero(group == group[edge[0]]))
    return [part for part in parts if len(part) < len(scores)]

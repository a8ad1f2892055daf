"""Initial poses of views without any known pose: found from the surfaces, or refused.

Each pair of views yields candidate poses. Starting from the pair that agrees best, views are added while all of their
surfaces agree (`slrig.multiview.matching`). Then each view, and each group that a single pair connects to the rest, is
tried at its other candidates. It moves where that agrees better; where another answer agrees nearly as well, both are
rejected as ambiguous.
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
from slrig.multiview.matching import SAMPLE, Evidence, Facing, Seen, Side, evidence, fitted, moved, seen_by
from slrig.multiview.registration import registered

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


_ALIKE = 3
"""Of the other view, for each place of one: the likest, and as many of the next."""
_OTHERS = 20
"""Which one a place has to be clearly less like, to be a place that is known again: a plane is like itself all over."""
_MOST_PAIRS = 600
_TURNED = 0.25
"""What a cosine of two normals may differ by."""
_LEAST = 6
"""Pairs that agree on a pose: three determine it."""
_LEAST_COSINE = 0.8
_SPARSE = 12
_CANDIDATES_APART = 3.0
"""Poses nearer to one another are fitted to the same one, in what places may be apart."""
_CANDIDATES_TRIED = 700
"""Hypotheses: where one place of eight is a right one, so is one hypothesis of fifty, and it is found again."""


def candidate_poses(first: Keypoints, second: Keypoints, *, within_mm: float, most: int) -> FloatArray:
    """(c, 4, 4), c up to `most`: poses that take the first view to the second, those with most pairs first.

    within_mm : how far the same place may be apart in both, since keypoints are not chosen alike.
    """
    a, b = _alike(first.spins, second.spins)
    p, q, m, n = first.points_mm[a], second.points_mm[b], first.normals[a], second.normals[b]
    compatible = _compatible(p, q, m, n, within_mm)
    ones, twos = np.nonzero(compatible)
    if not len(ones):
        return np.zeros((0, 4, 4))
    # A pair of every place as often as that of any other, however many it is compatible with.
    share = 1 / compatible.sum(axis=1)[ones]
    tried = np.random.default_rng(0).choice(len(ones), _CANDIDATES_TRIED, p=share / share.sum())
    both = np.stack([ones[tried], twos[tried]], axis=1)
    # Two places with their normals determine a pose: as four points do.
    arm = np.linalg.norm(p[both[:, 1]] - p[both[:, 0]], axis=1)[:, None, None]
    poses = rigid(np.hstack([p[both], p[both] + arm * m[both]]), np.hstack([q[both], q[both] + arm * n[both]]))
    agreeing = _agreeing(p, q, m, n, poses, within_mm)
    counts = agreeing.sum(axis=1)
    found: list[FloatArray] = []
    for each in np.argsort(-counts, kind="stable"):
        if counts[each] < _LEAST or len(found) == most:
            break
        if all(apart_mm(poses[each], other, p[::_SPARSE]) > _CANDIDATES_APART * within_mm for other in found):
            found.append(rigid(p[agreeing[each]], q[agreeing[each]]))
    return np.array(found).reshape(-1, 4, 4)


def apart_mm(pose: FloatArray, other: FloatArray, points_mm: FloatArray) -> float:
    """Rms distance by which two poses (4, 4) part points (n, 3)."""
    return float(np.sqrt(((moved(pose, points_mm) - moved(other, points_mm)) ** 2).sum(axis=1).mean()))


def _agreeing(
    p: FloatArray, q: FloatArray, m: FloatArray, n: FloatArray, poses: FloatArray, within_mm: float
) -> NDArray[np.bool_]:
    """(h, k): which places, with their normals, poses (h, 4, 4) take to one another."""
    turns = poses[:, :3, :3].astype(np.float32)
    there = p.astype(np.float32) @ turns.swapaxes(1, 2) + poses[:, None, :3, 3].astype(np.float32)
    near = ((there - q.astype(np.float32)) ** 2).sum(axis=2) < within_mm**2
    cosine = ((m.astype(np.float32) @ turns.swapaxes(1, 2)) * n.astype(np.float32)).sum(axis=2)
    return np.asarray(near & (cosine > _LEAST_COSINE))


def rigid(source: FloatArray, target: FloatArray) -> FloatArray:
    """(…, 4, 4): poses that take points (…, n, 3) nearest to others, by squares (Umeyama 1991, without scale)."""
    middle, goal = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    left, _, right = np.linalg.svd((target - goal).swapaxes(-1, -2) @ (source - middle))
    # No mirror: the least of the three directions turns round.
    left[..., :, 2] *= np.linalg.det(left @ right)[..., None]
    pose = np.broadcast_to(np.eye(4), (*source.shape[:-2], 4, 4)).copy()
    pose[..., :3, :3] = left @ right
    pose[..., :3, 3] = (goal - middle @ pose[..., :3, :3].swapaxes(-1, -2))[..., 0, :]
    return pose


def _alike(first: FloatArray, second: FloatArray) -> tuple[IntArray, IntArray]:
    """Indices (p,) of places of both that look alike, the most telling ones."""
    likeness = first @ second.T
    found = []
    for table, flip in ((likeness, False), (likeness.T, True)):
        rank = min(_OTHERS, table.shape[1] - 1)
        best = np.argpartition(-table, rank, axis=1)[:, : rank + 1]
        value = np.take_along_axis(table, best, axis=1)
        order = np.argsort(-value, axis=1)
        best, value = np.take_along_axis(best, order, axis=1), np.take_along_axis(value, order, axis=1)
        ratio = (1 - value[:, :_ALIKE]) / np.maximum(1 - value[:, -1:], 1e-9)
        rows = np.repeat(np.arange(len(table)), ratio.shape[1])
        pair = (best[:, :_ALIKE].ravel(), rows) if flip else (rows, best[:, :_ALIKE].ravel())
        found.append(np.stack([*pair, ratio.ravel()]))
    both = np.concatenate(found, axis=1)
    both = both[:, np.argsort(both[2], kind="stable")]
    keep = np.sort(np.unique(both[:2], axis=1, return_index=True)[1])[:_MOST_PAIRS]
    a, b = both[:2, keep].astype(np.int64)
    return a, b


def _compatible(p: FloatArray, q: FloatArray, m: FloatArray, n: FloatArray, within_mm: float) -> NDArray[np.bool_]:
    """(n, n): whether pairs of places p, q (n, 3) with normals m, n (n, 3), may belong to one pose."""
    one, two = _relations(p, m), _relations(q, n)
    distance, along, cosine = (np.abs(x - y) for x, y in zip(one, two, strict=True))
    both = (distance < within_mm) & (along < within_mm) & (within_mm > along.T) & (cosine < _TURNED)
    # Places near to one another are so in any pose.
    return np.asarray(both & (one[0] > 2 * within_mm))


def _relations(points: FloatArray, normals: FloatArray) -> tuple[FloatArray, ...]:
    """(n, n) each: distances; heights of the second point over the first's plane; cosines of the normals."""
    points, normals = points.astype(np.float32), normals.astype(np.float32)
    squares = (points**2).sum(axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares - 2 * points @ points.T, 0))
    along = normals @ points.T - (normals * points).sum(axis=1)[:, None]
    return distance, along, normals @ normals.T


_TRIED, _KEPT = 12, 6
"""Poses of a pair that are fitted, and that are kept: those that agree best."""
_NEAR_CELLS = 2.0
_AGAINST = 8.0
"""How many points that agree one outweighs that contradicts: true poses have one of fifty, at steps and slits, wrong
ones of objects that repeat themselves one of ten and more."""
_LEAST_AGREE = 0.02
"""Of the points of both views, as `registered` wants it."""
_RIVAL = 0.5
"""What a second answer may have of the best one's agreement, less contradictions."""
_BETTER = 1.1
"""Of the best one's agreement, what makes a second answer the best one; a view that is moved there is tried again."""
_FEW, _COARSE, _FITTED = 100, 2.0, 4
"""Of a second answer before it is fitted: points of a view that are asked, how many have to agree for one that
contradicts, and the pairs that it is then fitted by."""
_APART = 2.0
"""Answers nearer to one another are the same, in what is near."""
_ADVICE = (
    "Scan it with something that is fixed to it and has no symmetry, or tell where to start from: the stage's angle "
    "and axis, or poses"
)


Pair = tuple[int, int]


class _Held(NamedTuple):
    """A pose (4, 4) of view `first` in the frame of view `second`, and how well they agree there."""

    first: int
    second: int
    pose: FloatArray
    score: float


class _Rival(NamedTuple):
    """A part of the views (k,), what takes it elsewhere (4, 4), and how well it agrees there, of how it does here."""

    part: IntArray
    change: FloatArray
    share: float


def found_starts(views: Sequence[Mesh], *, names: Sequence[str] | None = None) -> FloatArray:
    """(N, 4, 4): poses of the views in the frame of the first, from what they see alone, at rest.

    Free space is looked at where a mesh lies before a camera at its origin. names : of the views, for messages.

    Raises
    ------
    RegistrationRefusedError
        No poses agree with what was seen, or others agree nearly as well: the object is symmetric or repeats itself.
    """
    names = names or [f"view {number}" for number in range(len(views))]
    if len(views) < 2:
        message = f"expected two views or more to put into one frame, found {len(views)}; scan the object turned"
        raise RegistrationRefusedError(message)
    search = _search([seen_by(view) for view in views], views, names)
    poses = search.put_together()
    for _ in range(2 * len(views)):
        # Poses that are wrong may not come to rest: then there is a better answer, or none.
        refused = None
        try:
            found = registered(views, poses, names=names, start_error_mm=search.near_mm)
            poses = found.poses
        except RegistrationRefusedError as error:
            refused = error
        rival = search.rival(poses)
        if rival is None or rival.share < _BETTER:
            break
        poses[rival.part] = rival.change @ poses[rival.part]
        poses = np.linalg.inv(poses[0]) @ poses
    if rival is not None:
        raise RegistrationRefusedError(search.second_answer(rival, poses))
    if refused is not None:
        raise refused
    if found.free:
        each = found.free[0]
        message = (
            f"{names[each.view]}: expected a shape that holds the views, found that this one may {each}, and no start "
            f"that tells by how much. {_ADVICE}"
        )
        raise RegistrationRefusedError(message)
    return poses


def _search(seen: Sequence[Seen], views: Sequence[Mesh], names: Sequence[str]) -> _Search:
    for name, each in zip(names, seen, strict=True):
        if not len(each.side.order):
            raise RegistrationRefusedError(
                f"{name}: expected a surface, found no vertex that can be used; scan it again"
            )
    weights = [seen_mm2(view) for view in views]
    area = float(np.median([each.sum() for each in weights]))
    places = [keypoints(each.side, mine, area) for each, mine in zip(seen, weights, strict=True)]
    cell = cell_mm(area)
    near_mm = _NEAR_CELLS * cell
    held = []
    for i, j in combinations(range(len(seen)), 2):
        near: list[_Held] = []
        for start in candidate_poses(places[i], places[j], within_mm=cell, most=_TRIED):
            pose = fitted([Facing(seen[i].side, seen[j].side, np.eye(4), np.eye(4))], start, near_mm)
            if all(apart_mm(pose, other.pose, places[i].points_mm) > cell for other in near):
                found = evidence(seen[i], seen[j], pose, near_mm)
                if found.agree > _LEAST_AGREE * 2 * SAMPLE:
                    near.append(_Held(i, j, pose, _score(found)))
        held += sorted(near, key=lambda each: -each.score)[:_KEPT]
    return _Search(seen, names, near_mm, sorted(held, key=lambda each: -each.score))


def _score(found: Evidence) -> float:
    return found.agree - _AGAINST * found.against


@dataclass(frozen=True, slots=True)
class _Search:
    """Views, and the poses that pairs of them may have, the best first."""

    seen: Sequence[Seen]
    names: Sequence[str]
    near_mm: float
    held: Sequence[_Held]

    def put_together(self) -> FloatArray:
        """Poses (N, 4, 4) of all views in the frame of the first.

        Raises RegistrationRefusedError: not all views have a place.
        """
        count = len(self.seen)
        poses, group = np.tile(np.eye(4), (count, 1, 1)), np.arange(count)
        for each in self.held:
            some, others = (group == group[view] for view in (each.first, each.second))
            if each.score <= 0 or group[each.first] == group[each.second]:
                continue
            pairs = list(product(np.flatnonzero(some).tolist(), np.flatnonzero(others).tolist()))
            change = self._fitted(pairs, poses, _change(each, poses))
            if sum(_score(self._evidence(pair, poses, change, SAMPLE)) for pair in pairs) > 0:
                poses[some] = change @ poses[some]
                group[some] = group[each.second]
        if len(np.unique(group)) > 1:
            largest = np.bincount(group).argmax()
            apart = ", ".join(name for name, mine in zip(self.names, group, strict=True) if mine != largest)
            message = (
                f"{apart}: expected surface that is known again in other views and fits it there, found none that "
                f"does. Scan from between, so that neighbours share half of what they see. {_ADVICE}"
            )
            raise RegistrationRefusedError(message)
        return np.asarray(np.linalg.inv(poses[0]) @ poses)

    def rival(self, poses: FloatArray) -> _Rival | None:
        """The place of a part of the views elsewhere that agrees best, if it is nearly as well as where they are."""
        count = len(self.seen)
        scores = np.zeros((count, count))
        for i, j in combinations(range(count), 2):
            scores[i, j] = scores[j, i] = _score(self._evidence((i, j), poses, np.eye(4), SAMPLE))
        found: _Rival | None = None
        for part in _parts(scores):
            rest = np.setdiff1d(np.arange(count), part)
            best = max(float(scores[np.ix_(part, rest)].sum()), 1.0)
            pairs = list(product(part.tolist(), rest.tolist()))
            for change in self._changes(part, poses):
                share = self._placed_score(pairs, poses, change, _RIVAL * best) / best
                if share > max(_RIVAL, found.share if found else 0):
                    found = _Rival(part, change, share)
        return found

    def _changes(self, part: IntArray, poses: FloatArray) -> Iterator[FloatArray]:
        """(4, 4) each: what takes a part of the views to where their pairs with others may have them."""
        points = np.concatenate([moved(poses[view], self._points_mm(view)) for view in part])
        tried = [np.eye(4)]
        for each in self.held:
            if (each.first in part) != (each.second in part):
                change = _change(each, poses)
                if each.second in part:
                    change = np.asarray(np.linalg.inv(change), dtype=np.float64)
                if all(apart_mm(change, other, points) > _APART * self.near_mm for other in tried):
                    tried.append(change)
                    yield change

    def _placed_score(self, pairs: Sequence[Pair], poses: FloatArray, change: FloatArray, least: float) -> float:
        """How well one part agrees with the rest after a change of it and a fit; -inf where it does not by far."""
        few = [(pair, self._evidence(pair, poses, change, _FEW)) for pair in pairs]
        agree, against = np.array([found for _, found in few]).sum(axis=0)
        if agree < _COARSE * against or agree * SAMPLE / _FEW < least:
            return -np.inf
        most = sorted(few, key=lambda each: -each[1].agree)[:_FITTED]
        at = self._fitted([pair for pair, _ in most], poses, change)
        return sum(_score(self._evidence(pair, poses, at, SAMPLE)) for pair in pairs)

    def _fitted(self, pairs: Sequence[Pair], poses: FloatArray, change: FloatArray) -> FloatArray:
        facing = [Facing(self.seen[i].side, self.seen[j].side, poses[i], poses[j]) for i, j in pairs]
        return fitted(facing, change, self.near_mm)

    def _evidence(self, pair: Pair, poses: FloatArray, change: FloatArray, most: int) -> Evidence:
        """Of a pair of views at poses, the first one's changed."""
        i, j = pair
        return evidence(self.seen[i], self.seen[j], np.linalg.inv(poses[j]) @ change @ poses[i], self.near_mm, most)

    def _points_mm(self, view: int) -> FloatArray:
        side = self.seen[view].side
        return side.points_mm[side.order[:_FEW]]

    def second_answer(self, rival: _Rival, poses: FloatArray) -> str:
        """In words, that there is one."""
        angle = np.rad2deg(np.linalg.norm(Rotation.from_matrix(rival.change[:3, :3]).as_rotvec()))
        points = np.concatenate([moved(poses[view], self._points_mm(view)) for view in rival.part])
        away_mm = apart_mm(rival.change, np.eye(4), points)
        return (
            f"{', '.join(self.names[view] for view in rival.part)}: expected one place that agrees with the other "
            f"views, found a second one, turned by {angle:.0f}° and {away_mm:.0f} mm from the first, that agrees "
            f"{rival.share:.0%} as well: the object is symmetric or repeats itself. {_ADVICE}"
        )


def _change(each: _Held, poses: FloatArray) -> FloatArray:
    """(4, 4): what moves the first view, and all that lies with it, so that the pair lies as it is held."""
    return np.asarray(poses[each.second] @ each.pose @ np.linalg.inv(poses[each.first]))


def _parts(scores: FloatArray) -> list[IntArray]:
    """Each view alone, and what each pair of the tree that agrees best holds to the rest. scores : (N, N), of pairs."""
    # The tree of most agreement is that of least cost; a cost of 0 would be no edge.
    cost = np.triu(scores.max() + 1 - scores, 1)
    tree = minimum_spanning_tree(cost).toarray()
    parts = [np.array([view]) for view in range(len(scores))]
    for cut in np.argwhere(tree):
        rest = tree.copy()
        rest[tuple(cut)] = 0
        group = connected_components(rest, directed=False)[1]
        parts.append(np.flatnonzero(group == group[cut[0]]))
    return [part for part in parts if len(part) < len(scores)]

"""Start poses of views that nobody knows the poses of: found from the surfaces, or refused.

Each pair of views has poses that it may have (`slrig.views.candidates`). From the pair that agrees best on, views are
put together as long as all that they have seen agrees (`slrig.views.evidence`). Then each view, and each part that one
pair holds to the rest, is tried wherever else its pairs may have it: what agrees better there is moved, and where it
agrees nearly as well there are two answers, and none is given.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from slrig.errors import RegistrationRefusedError
from slrig.model import FloatArray, IntArray, Mesh
from slrig.views.candidates import apart_mm, candidate_poses
from slrig.views.descriptors import cell_mm, keypoints, seen_mm2
from slrig.views.evidence import SAMPLE, Evidence, Facing, Seen, evidence, fitted, seen_by
from slrig.views.matching import moved
from slrig.views.registration import registered

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

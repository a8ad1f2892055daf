"""Poses of views from markers that turn with the object.

The poses T_i and the corners X of all markers minimise Σ |T_i p - X|² / σ² over the corners p that views see, by Gauss
and Newton's steps with the corners eliminated. What does not agree with what other views see of a marker, because that
moved or was misread, counts less and less (Geman and McClure 1987), and is left out in the end, and named. View 0
stands still.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from slrig.errors import RegistrationRefusedError
from slrig.model import FloatArray

_OFF_SIGMAS = 5.0
"""Of what is usual among all markers: what is farther off has moved or was misread."""
_DOUBTED_SIGMAS = 3.0
"""From here on a marker counts for much less while the poses are looked for."""
_LEAST_WEIGHT = 1e-6
_NEAR = 3.0
"""Over the median of a pair's markers: those that tell the same motion."""
_MOST_STEPS, _SETTLED_MM = 60, 1e-6


class SeenMarker(NamedTuple):
    """A marker as one view sees it. corners_mm : (4, 3) float64, in the view's frame, in the order of its print.

    sigma_mm : (4,) float64, standard deviation of each coordinate of a corner.
    """

    corners_mm: FloatArray
    sigma_mm: FloatArray


MarkersSeen = Mapping[int, SeenMarker]
"""By the marker's number."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A marker that is elsewhere in one view than others see it: by how much, rms of its corners."""

    view: int
    marker: int
    off_mm: float
    off_over_sigma: float


@dataclass(frozen=True, slots=True)
class MarkerFit:
    """Where markers put views.

    poses : (N, 4, 4) float64, view coordinates to those of view 0. covariance : (6 (N - 1), 6 (N - 1)) float64, of a
    small turn (rad) about the origin of view 0's frame and a shift (mm) of it, view by view from 1 on; where the
    markers agree less well than their deviations say, it is larger by that. sigma_mm : (N,) float64, rms standard
    deviation of where a view's surface is put. rms_over_sigma : (N,) float64, of the corners' distances. used : per
    view, the markers that it shares with another one.
    """

    poses: FloatArray
    covariance: FloatArray
    sigma_mm: FloatArray
    rms_over_sigma: FloatArray
    used: tuple[tuple[int, ...], ...]
    left_out: tuple[LeftOut, ...]


def marker_poses(
    views: Sequence[MarkersSeen], surfaces: Sequence[FloatArray], *, names: Sequence[str], most_sigma_mm: float
) -> MarkerFit:
    """Where the markers that views share put them. surfaces : (n, 3) each, points of the object in the view's frame.

    most_sigma_mm : a view whose surface is put less well is refused, however many markers it shares: two small ones
    side by side tell less than a large one.

    Raises
    ------
    RegistrationRefusedError
        A view shares no marker with those that are joined to the first, or too little to be put well.
    """
    _require_joined(views, views, (), names)
    seen = _Seen.of(views)
    poses = _through_a_tree(views)
    poses, off_mm, off = seen.settled(poses, robust=True)
    left_out = tuple(
        LeftOut(int(seen.view[k]), int(seen.marker[k]), float(off_mm[k]), float(off[k]))
        for k in np.flatnonzero(off > _OFF_SIGMAS * _usual(off))
    )
    apart = {(each.view, each.marker) for each in left_out}
    kept = [{m: each for m, each in view.items() if (v, m) not in apart} for v, view in enumerate(views)]
    _require_joined(kept, views, left_out, names)
    seen = _Seen.of(kept)
    found = seen.result(seen.settled(poses, robust=False)[0], surfaces)
    worst = int(np.argmax(found.sigma_mm))
    if found.sigma_mm[worst] > most_sigma_mm:
        message = (
            f"{names[worst]}: expected markers that put it to {most_sigma_mm:.2g} mm (1 σ), found that "
            f"{_listed(found.used[worst])}, which it shares with other views, put it to {found.sigma_mm[worst]:.2g} "
            "mm. Lay more of them around the object, or larger ones, and so that neighbouring views see the same"
        )
        raise RegistrationRefusedError(message)
    return replace(found, left_out=left_out)


@dataclass(frozen=True, slots=True)
class _Seen:
    """All that is seen twice, k markers in views. view, marker : (k,). corners_mm : (k, 4, 3); sigma_mm : (k, 4).

    number : (k,), of the marker, from 0 on without a gap.
    """

    view: NDArray[np.int64]
    marker: NDArray[np.int64]
    number: NDArray[np.int64]
    corners_mm: FloatArray
    sigma_mm: FloatArray

    @classmethod
    def of(cls, views: Sequence[MarkersSeen]) -> _Seen:
        times = Counter(m for view in views for m in view)
        found = [(v, m, each) for v, view in enumerate(views) for m, each in view.items() if times[m] > 1]
        marker = np.array([m for _, m, _ in found])
        return cls(
            np.array([v for v, _, _ in found]),
            marker,
            np.unique(marker, return_inverse=True)[1],
            np.array([each.corners_mm for _, _, each in found]),
            np.array([each.sigma_mm for _, _, each in found]),
        )

    def placed(self, poses: FloatArray) -> FloatArray:
        """(k, 4, 3): the corners in the frame of view 0."""
        mine = poses[self.view]
        return self.corners_mm @ mine[:, :3, :3].swapaxes(1, 2) + mine[:, None, :3, 3]

    def _summed(self, each: FloatArray) -> FloatArray:
        """(markers, ...): sums of (k, ...) over what is seen of each marker."""
        sums = np.zeros((int(self.number.max()) + 1, *each.shape[1:]))
        np.add.at(sums, self.number, each)
        return sums

    def _rest(self, placed: FloatArray, by: FloatArray) -> FloatArray:
        """(k, 4, 3): from the weighted mean of all that is seen of a corner."""
        mean = self._summed(by[..., None] * placed) / self._summed(by)[..., None]
        return np.asarray(placed - mean[self.number])

    def _off(self, poses: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(k,) twice: rms distance of a marker's corners from where the other views see them, mm, and per coordinate
        over its deviation.
        """

        def of_others(each: FloatArray) -> FloatArray:
            return np.asarray(self._summed(each)[self.number] - each)

        placed, even = self.placed(poses), self.sigma_mm**-2
        by = weight[:, None] * even
        squared = np.square(placed - of_others(by[..., None] * placed) / of_others(by)[..., None]).sum(axis=2)
        # By the deviations as stated: what counts little, as both of two that differ do, is no less known for that.
        expected = 3 * (self.sigma_mm**2 + 1 / of_others(even))
        return np.sqrt(squared.mean(axis=1)), np.sqrt((squared / expected).mean(axis=1))

    def settled(self, poses: FloatArray, *, robust: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Poses at rest, and how far each is off there, see `_off`. robust : what does not agree counts less."""
        weight = np.ones(len(self.view))
        for _ in range(_MOST_STEPS):
            if robust:
                off = self._off(poses, weight)[1]
                weight = np.maximum((1 + (off / (_DOUBTED_SIGMAS * _usual(off))) ** 2) ** -2, _LEAST_WEIGHT)
            poses, step_mm = self._stepped(poses, weight)
            if step_mm < _SETTLED_MM:
                break
        return poses, *self._off(poses, weight)

    def _equations(self, poses: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Information (6 N, 6 N) and gradient (6 N,) of a small turn about the markers' middle and a shift, of all
        views, and that middle (3,).
        """
        placed, by = self.placed(poses), weight[:, None] / self.sigma_mm**2
        middle, count = placed.reshape(-1, 3).mean(axis=0), len(poses)
        total, rest = self._summed(by), self._rest(placed, by)
        slopes = moved_by(placed - middle)
        information, gradient = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
        np.add.at(gradient, self.view, np.einsum("kcap,kc,kca->kp", slopes, by, rest))
        own = np.einsum("kcap,kc,kcaq->kpq", slopes, by, slopes)
        for v in range(count):
            information[v, :, v] = own[self.view == v].sum(axis=0)
        for number in range(len(total)):
            mine = np.flatnonzero(self.number == number)
            weighted = by[mine][..., None, None] * slopes[mine]
            shared = np.einsum("icap,c,jcaq->ijpq", weighted, 1 / total[number], weighted)
            for i, each in zip(self.view[mine], shared, strict=True):
                information[i, :, self.view[mine]] -= each
        return information.reshape(6 * count, 6 * count), gradient.ravel(), middle

    def _stepped(self, poses: FloatArray, weight: FloatArray) -> tuple[FloatArray, float]:
        """Poses after one step, and how far it moved them, at the markers, at most."""
        information, gradient, middle = self._equations(poses, weight)
        motions = np.append(np.zeros(6), -np.linalg.solve(information[6:, 6:], gradient[6:])).reshape(-1, 6)
        change = np.tile(np.eye(4), (len(poses), 1, 1))
        change[:, :3, :3] = Rotation.from_rotvec(motions[:, :3]).as_matrix()
        change[:, :3, 3] = middle + motions[:, 3:] - change[:, :3, :3] @ middle
        after = change @ poses
        return after, float(np.linalg.norm(self.placed(after) - self.placed(poses), axis=2).max())

    def result(self, poses: FloatArray, surfaces: Sequence[FloatArray]) -> MarkerFit:
        """With nothing left out."""
        even = np.ones(len(self.view))
        information, _, middle = self._equations(poses, even)
        placed, by = self.placed(poses), 1 / self.sigma_mm**2
        squared = by * np.square(self._rest(placed, by)).sum(axis=2)
        beyond = 3 * (by.size - 4 * (self.number.max() + 1)) - 6 * (len(poses) - 1)
        factor = max(1.0, float(squared.sum() / beyond)) if beyond > 0 else 1.0
        covariance = factor * np.linalg.inv(information[6:, 6:])
        sigma, over = np.zeros(len(poses)), np.zeros(len(poses))
        for v, surface in enumerate(surfaces):
            over[v] = np.sqrt(squared[self.view == v].mean() / 3)
            if v:
                mine = slice(6 * v - 6, 6 * v)
                slopes = moved_by(surface @ poses[v, :3, :3].T + poses[v, :3, 3] - middle)
                sigma[v] = np.sqrt(
                    np.einsum("nap,pq,naq->", slopes, covariance[mine, mine], slopes) / max(len(slopes), 1)
                )
        # A shift of the origin is that of the middle and what the turn adds.
        to_origin = np.kron(np.eye(len(poses) - 1), np.block([[np.eye(3), np.zeros((3, 3))], [moved_by(-middle)]]))
        used = tuple(tuple(np.sort(self.marker[self.view == v]).tolist()) for v in range(len(poses)))
        return MarkerFit(poses, to_origin @ covariance @ to_origin.T, sigma, over, used, ())


def moved_by(arm: FloatArray) -> FloatArray:
    """(..., 3, 6): how points, (..., 3) from a middle, move with a small turn about it and a shift: ω × arm + t."""
    turned = np.cross(np.eye(3), arm[..., None, :]).swapaxes(-1, -2)
    return np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], axis=-1)


def _usual(off: FloatArray) -> float:
    return max(1.0, float(np.median(off)))


def _listed(markers: Sequence[int]) -> str:
    return f"marker{'' if len(markers) == 1 else 's'} {', '.join(map(str, sorted(markers)))}" if markers else "none"


def _require_joined(
    kept: Sequence[MarkersSeen], views: Sequence[MarkersSeen], left_out: Sequence[LeftOut], names: Sequence[str]
) -> None:
    """Raises RegistrationRefusedError: a view is not joined to the first by markers that two see."""
    shared = np.array([[bool(one.keys() & other.keys()) for other in kept] for one in kept])
    group = connected_components(shared, directed=False)[1]
    apart = [v for v in range(len(views)) if group[v] != group[0]]
    if not apart:
        return
    sees = "; ".join(f"{names[v]} sees {_listed(list(views[v]))}" for v in (0, *apart))
    off = ", ".join(f"marker {each.marker} in {names[each.view]}, {each.off_mm:.2g} mm off" for each in left_out)
    message = (
        f"{', '.join(names[v] for v in apart)}: expected a marker that a view sees too which is joined to {names[0]}, "
        f"found none: {sees}{'; left out: ' if off else ''}{off}. Lay markers so that each view shares two or more "
        "with the next, fix them to what turns, light them, and say their dictionary"
    )
    raise RegistrationRefusedError(message)


def _through_a_tree(views: Sequence[MarkersSeen]) -> FloatArray:
    """(N, 4, 4): about where views belong, each put to the one before it that it shares most markers with."""
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    joined, left = [0], set(range(1, len(views)))
    while left:
        i, j = max(((i, j) for i in joined for j in sorted(left)), key=lambda pair: len(
            views[pair[0]].keys() & views[pair[1]].keys()))  # fmt: skip
        poses[j] = poses[i] @ _between(views[i], views[j])
        joined.append(j)
        left.remove(j)
    return poses


def _between(first: MarkersSeen, second: MarkersSeen) -> FloatArray:
    """(4, 4): from the second to the first, by the markers that agree with that one which most agree with (LMedS)."""
    common = sorted(first.keys() & second.keys())
    to, of = (np.array([view[m].corners_mm for m in common]) for view in (first, second))

    def off_mm(pose: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(of @ pose[:3, :3].T + pose[:3, 3] - to, axis=2).max(axis=1))

    tried = [off_mm(_rigid(to[k], of[k])) for k in range(len(common))]
    best = min(tried, key=lambda off: float(np.median(off)))
    good = best <= _NEAR * np.median(best)
    return _rigid(to[good].reshape(-1, 3), of[good].reshape(-1, 3))


def _rigid(to: FloatArray, of: FloatArray) -> FloatArray:
    """(4, 4): the motion that takes points (n, 3) nearest to others (Kabsch 1976)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.align_vectors(to - to.mean(axis=0), of - of.mean(axis=0))[0].as_matrix()
    pose[:3, 3] = to.mean(axis=0) - pose[:3, :3] @ of.mean(axis=0)
    return pose

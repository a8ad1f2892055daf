"""Poses of one view in another's frame that its surface may have, when nothing is known of where it is.

Places that look alike (`slrig.views.descriptors`) are mostly not the same. Two pairs of them are compatible where both
views have them as far apart, and their normals alike to the line between them, which few wrong ones are. Pairs that
share many compatible ones belong to one pose (second-order compatibility: Chen, Sun, Yang and Tao 2022, "SC²-PCR";
graphs of compatible pairs: Yang, Shi and Carlone 2021, "TEASER"; Lim et al. 2025, "KISS-Matcher").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray
from slrig.views.descriptors import Keypoints
from slrig.views.matching import moved

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
_APART = 3.0
"""Poses nearer to one another are fitted to the same one, in what places may be apart."""
_TRIED = 700
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
    tried = np.random.default_rng(0).choice(len(ones), _TRIED, p=share / share.sum())
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
        if all(apart_mm(poses[each], other, p[::_SPARSE]) > _APART * within_mm for other in found):
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

"""How well poses agree with what views have seen: surface on surface, and nothing where a camera saw through.

Two surfaces that face the same way and lie close, but not on one another, contradict one another: the one in front
would hide the other from a camera that saw it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray, IntArray, Mesh
from slrig.views.matching import Side, assembled, matched, moved, side_of, terms_of

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

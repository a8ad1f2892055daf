"""Poses of views from markers that turn with the object.

The poses T_i and the corners X of all markers minimise Σ |T_i p - X|² / σ² over the observed corners p, by Gauss-Newton
steps with the corners eliminated. Markers that moved or were misread get little weight (Geman and McClure 1987) and are
rejected and named at the end. View 0 is fixed.
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

_REJECT_SIGMAS = 5.0  # deviation, over the median of all markers, above which a marker has moved or was misread
_ROBUST_SIGMAS = 3.0  # deviation, over that median, above which a marker has little weight
_MIN_WEIGHT = 1e-6
_INLIER_FACTOR = 3.0  # distance, over the median of a pair's markers, within which they share one motion
_MAX_STEPS, _SETTLED_MM = 60, 1e-6


class MarkerObservation(NamedTuple):
    """A marker in one view. corners_mm : (4, 3) float64, in the view's frame, in the order of its print.

    sigma_mm : (4,) float64, standard deviation of each coordinate of a corner.
    """

    corners_mm: FloatArray
    sigma_mm: FloatArray


MarkerObservations = Mapping[int, MarkerObservation]
"""The markers of one view by number."""


@dataclass(frozen=True, slots=True)
class RejectedMarker:
    """A marker that one view measures elsewhere than the others. off_mm : rms distance of its corners."""

    view: int
    marker: int
    off_mm: float
    off_over_sigma: float


@dataclass(frozen=True, slots=True)
class MarkerFit:
    """Poses of views from markers.

    poses : (N, 4, 4) float64, from view coordinates to those of view 0. covariance : (6 (N - 1), 6 (N - 1)) float64, of
    a small rotation (rad) about the origin of view 0's frame and a shift (mm) of it, view by view from 1 on, scaled up
    if the markers agree less well than their σ. sigma_mm : (N,) float64, rms standard deviation of the position of a
    view's surface. rms_over_sigma : (N,) float64, of the corners' distances. used : per view, the markers that it
    shares with another one.
    """

    poses: FloatArray
    covariance: FloatArray
    sigma_mm: FloatArray
    rms_over_sigma: FloatArray
    used: tuple[tuple[int, ...], ...]
    rejected: tuple[RejectedMarker, ...]


def marker_poses(
    views: Sequence[MarkerObservations], surfaces: Sequence[FloatArray], *, names: Sequence[str], max_sigma_mm: float
) -> MarkerFit:
    """Estimate the poses of views from the markers that they share.

    surfaces : (n, 3) each, points of the object in the view's frame. max_sigma_mm : limit of a view's `sigma_mm`; few,
    small or close markers exceed it.

    Raises RegistrationRefusedError: no chain of shared markers connects a view to the first, or its pose is less
    certain than `max_sigma_mm`.
    """
    _require_connected(views, views, (), names)
    adjustment = _MarkerAdjustment.from_views(views)
    poses, off_mm, off = adjustment.solve(_initial_poses(views), robust=True)
    rejected = tuple(
        RejectedMarker(int(adjustment.view[k]), int(adjustment.marker[k]), float(off_mm[k]), float(off[k]))
        for k in np.flatnonzero(off > _REJECT_SIGMAS * _typical(off))
    )
    outliers = {(each.view, each.marker) for each in rejected}
    inliers = [{m: each for m, each in view.items() if (v, m) not in outliers} for v, view in enumerate(views)]
    _require_connected(inliers, views, rejected, names)
    adjustment = _MarkerAdjustment.from_views(inliers)
    found = adjustment.result(adjustment.solve(poses, robust=False)[0], surfaces)
    worst = int(np.argmax(found.sigma_mm))
    if found.sigma_mm[worst] > max_sigma_mm:
        shared = _list_markers(found.used[worst])
        message = (
            f"{names[worst]}: expected markers that locate it to {max_sigma_mm:.2g} mm (1 σ), found that {shared}, "
            f"which it shares with other views, locate it to {found.sigma_mm[worst]:.2g} mm. Lay more or larger "
            "markers around the object, so that neighbouring views share them"
        )
        raise RegistrationRefusedError(message)
    return replace(found, rejected=rejected)


@dataclass(frozen=True, slots=True)
class _MarkerAdjustment:
    """Least squares over the k observations of markers that two or more views share.

    view, marker : (k,). number : (k,), of the marker, consecutive from 0. corners_mm : (k, 4, 3); sigma_mm : (k, 4).
    """

    view: NDArray[np.int64]
    marker: NDArray[np.int64]
    number: NDArray[np.int64]
    corners_mm: FloatArray
    sigma_mm: FloatArray

    @classmethod
    def from_views(cls, views: Sequence[MarkerObservations]) -> _MarkerAdjustment:
        counts = Counter(m for view in views for m in view)
        shared = [(v, m, each) for v, view in enumerate(views) for m, each in view.items() if counts[m] > 1]
        marker = np.array([m for _, m, _ in shared])
        return cls(
            np.array([v for v, _, _ in shared]),
            marker,
            np.unique(marker, return_inverse=True)[1],
            np.array([each.corners_mm for _, _, each in shared]),
            np.array([each.sigma_mm for _, _, each in shared]),
        )

    def solve(self, poses: FloatArray, *, robust: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Final poses, and the deviations there, see `_deviations`. robust : outliers get little weight."""
        weight = np.ones(len(self.view))
        for _ in range(_MAX_STEPS):
            if robust:
                off = self._deviations(poses, weight)[1]
                weight = np.maximum((1 + (off / (_ROBUST_SIGMAS * _typical(off))) ** 2) ** -2, _MIN_WEIGHT)
            poses, step_mm = self._step(poses, weight)
            if step_mm < _SETTLED_MM:
                break
        return poses, *self._deviations(poses, weight)

    def result(self, poses: FloatArray, surfaces: Sequence[FloatArray]) -> MarkerFit:
        """The fit with its uncertainty, without rejected markers."""
        information, _, middle = self._normal_equations(poses, np.ones(len(self.view)))
        corners, weight = self._corners_at(poses), 1 / self.sigma_mm**2
        squared = weight * np.square(self._residuals(corners, weight)).sum(axis=2)
        degrees_of_freedom = 3 * (weight.size - 4 * (self.number.max() + 1)) - 6 * (len(poses) - 1)
        factor = max(1.0, float(squared.sum() / degrees_of_freedom)) if degrees_of_freedom > 0 else 1.0
        covariance = factor * np.linalg.inv(information[6:, 6:])
        sigma, over = np.zeros(len(poses)), np.zeros(len(poses))
        for v, surface in enumerate(surfaces):
            over[v] = np.sqrt(squared[self.view == v].mean() / 3)
            if v:
                own = slice(6 * v - 6, 6 * v)
                rows = motion_jacobian(surface @ poses[v, :3, :3].T + poses[v, :3, 3] - middle)
                sigma[v] = np.sqrt(np.einsum("nap,pq,naq->", rows, covariance[own, own], rows) / max(len(rows), 1))
        # A shift of the origin is that of the middle and the part that the rotation adds.
        about = np.block([[np.eye(3), np.zeros((3, 3))], [motion_jacobian(-middle)]])
        to_origin = np.kron(np.eye(len(poses) - 1), about)
        used = tuple(tuple(np.sort(self.marker[self.view == v]).tolist()) for v in range(len(poses)))
        return MarkerFit(poses, to_origin @ covariance @ to_origin.T, sigma, over, used, ())

    def _corners_at(self, poses: FloatArray) -> FloatArray:
        """(k, 4, 3): the corners in the frame of view 0."""
        by_observation = poses[self.view]
        return self.corners_mm @ by_observation[:, :3, :3].swapaxes(1, 2) + by_observation[:, None, :3, 3]

    def _sum_by_marker(self, values: FloatArray) -> FloatArray:
        """(markers, ...): sums of (k, ...) over the observations of each marker."""
        sums = np.zeros((int(self.number.max()) + 1, *values.shape[1:]))
        np.add.at(sums, self.number, values)
        return sums

    def _residuals(self, corners: FloatArray, weight: FloatArray) -> FloatArray:
        """(k, 4, 3): distances from the weighted mean of all observations of a corner."""
        mean = self._sum_by_marker(weight[..., None] * corners) / self._sum_by_marker(weight)[..., None]
        return np.asarray(corners - mean[self.number])

    def _deviations(self, poses: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(k,) twice: rms distance of a marker's corners from their mean in the other views, in mm, and per coordinate
        in standard deviations.
        """

        def sum_of_others(values: FloatArray) -> FloatArray:
            return np.asarray(self._sum_by_marker(values)[self.number] - values)

        corners, even = self._corners_at(poses), self.sigma_mm**-2
        by = weight[:, None] * even
        mean_of_others = sum_of_others(by[..., None] * corners) / sum_of_others(by)[..., None]
        squared = np.square(corners - mean_of_others).sum(axis=2)
        # By the stated σ: of two observations that contradict each other both have little weight.
        expected = 3 * (self.sigma_mm**2 + 1 / sum_of_others(even))
        return np.sqrt(squared.mean(axis=1)), np.sqrt((squared / expected).mean(axis=1))

    def _normal_equations(self, poses: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Information (6 N, 6 N) and gradient (6 N,) of a small rotation about the markers' middle and a shift, of all
        views, and that middle (3,).
        """
        corners, by = self._corners_at(poses), weight[:, None] / self.sigma_mm**2
        middle, count = corners.reshape(-1, 3).mean(axis=0), len(poses)
        total, residuals = self._sum_by_marker(by), self._residuals(corners, by)
        rows = motion_jacobian(corners - middle)
        information, gradient = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
        np.add.at(gradient, self.view, np.einsum("kcap,kc,kca->kp", rows, by, residuals))
        own = np.einsum("kcap,kc,kcaq->kpq", rows, by, rows)
        for v in range(count):
            information[v, :, v] = own[self.view == v].sum(axis=0)
        for number in range(len(total)):
            which = np.flatnonzero(self.number == number)
            weighted = by[which][..., None, None] * rows[which]
            shared = np.einsum("icap,c,jcaq->ijpq", weighted, 1 / total[number], weighted)
            for i, each in zip(self.view[which], shared, strict=True):
                information[i, :, self.view[which]] -= each
        return information.reshape(6 * count, 6 * count), gradient.ravel(), middle

    def _step(self, poses: FloatArray, weight: FloatArray) -> tuple[FloatArray, float]:
        """Poses after one step, and the largest displacement of a marker by it."""
        information, gradient, middle = self._normal_equations(poses, weight)
        motions = np.append(np.zeros(6), -np.linalg.solve(information[6:, 6:], gradient[6:])).reshape(-1, 6)
        change = np.tile(np.eye(4), (len(poses), 1, 1))
        change[:, :3, :3] = Rotation.from_rotvec(motions[:, :3]).as_matrix()
        change[:, :3, 3] = middle + motions[:, 3:] - change[:, :3, :3] @ middle
        after = change @ poses
        return after, float(np.linalg.norm(self._corners_at(after) - self._corners_at(poses), axis=2).max())


def motion_jacobian(arm: FloatArray) -> FloatArray:
    """(..., 3, 6): displacement ω × arm + t of points, (..., 3) from a middle, by a small rotation and a shift."""
    by_rotation = np.cross(np.eye(3), arm[..., None, :]).swapaxes(-1, -2)
    return np.concatenate([by_rotation, np.broadcast_to(np.eye(3), by_rotation.shape)], axis=-1)


def _typical(off: FloatArray) -> float:
    return max(1.0, float(np.median(off)))


def _list_markers(markers: Sequence[int]) -> str:
    return f"marker{'' if len(markers) == 1 else 's'} {', '.join(map(str, sorted(markers)))}" if markers else "none"


def _require_connected(
    inliers: Sequence[MarkerObservations],
    views: Sequence[MarkerObservations],
    rejected: Sequence[RejectedMarker],
    names: Sequence[str],
) -> None:
    """Raises RegistrationRefusedError: no chain of shared markers connects a view to the first."""
    shared = np.array([[bool(one.keys() & other.keys()) for other in inliers] for one in inliers])
    group = connected_components(shared, directed=False)[1]
    apart = [v for v in range(len(views)) if group[v] != group[0]]
    if not apart:
        return
    visible = "; ".join(f"{names[v]} sees {_list_markers(list(views[v]))}" for v in (0, *apart))
    off = ", ".join(f"marker {each.marker} in {names[each.view]}, {each.off_mm:.2g} mm off" for each in rejected)
    message = (
        f"{', '.join(names[v] for v in apart)}: expected a marker in common with a view that is connected to "
        f"{names[0]}, found none: {visible}{'; left out: ' if off else ''}{off}. Lay markers so that each view shares "
        "two or more with the next, fix them to the turntable, light them, and state their dictionary"
    )
    raise RegistrationRefusedError(message)


def _initial_poses(views: Sequence[MarkerObservations]) -> FloatArray:
    """(N, 4, 4): approximate poses, each from the already connected view that it shares most markers with."""
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    connected, remaining = [0], set(range(1, len(views)))
    while remaining:
        i, j = max(((i, j) for i in connected for j in sorted(remaining)), key=lambda pair: len(
            views[pair[0]].keys() & views[pair[1]].keys()))  # fmt: skip
        poses[j] = poses[i] @ _relative_pose(views[i], views[j])
        connected.append(j)
        remaining.remove(j)
    return poses


def _relative_pose(first: MarkerObservations, second: MarkerObservations) -> FloatArray:
    """(4, 4): from the second view to the first, by least median of squares over the markers that they share."""
    common = sorted(first.keys() & second.keys())
    target, source = (np.array([view[m].corners_mm for m in common]) for view in (first, second))

    def off_mm(pose: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(source @ pose[:3, :3].T + pose[:3, 3] - target, axis=2).max(axis=1))

    trials = [off_mm(_rigid_motion(source[k], target[k])) for k in range(len(common))]
    best = min(trials, key=lambda off: float(np.median(off)))
    inlier = best <= _INLIER_FACTOR * np.median(best)
    return _rigid_motion(source[inlier].reshape(-1, 3), target[inlier].reshape(-1, 3))


def _rigid_motion(source: FloatArray, target: FloatArray) -> FloatArray:
    """(4, 4): the least-squares motion of points (n, 3) to others (Kabsch 1976)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))[0].as_matrix()
    pose[:3, 3] = target.mean(axis=0) - pose[:3, :3] @ source.mean(axis=0)
    return pose

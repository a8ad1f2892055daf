"""Poses by markers whose corners are known: truth, noise, markers that moved or that nobody shares."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.errors import RegistrationRefusedError
from slrig.model import FloatArray
from slrig.multiview.markers import MarkerFit, MarkerObservation, MarkerObservations, marker_poses
from slrig.multiview.turntable import turntable_poses
from tests.turned_views import AXIS, AXIS_POINT_MM

POSES = turntable_poses(AXIS_POINT_MM, AXIS, np.deg2rad(45.0 * np.arange(8)))
NAMES = [f"view {number}" for number in range(8)]
UP = Rotation.align_vectors([AXIS, [1.0, 0.0, 0.03]], [[0, 0, 1], [1, 0, 0]], weights=[1e6, 1])[0]


def plate(side_mm: float = 12.0) -> FloatArray:
    """(12, 4, 3): markers in a ring of 45 mm on the turntable, in the frame of the first view."""
    angles = np.deg2rad(30.0 * np.arange(12))
    middles = 45 * np.stack([np.cos(angles), np.sin(angles), np.zeros(12)], axis=1)
    square = side_mm / 2 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return np.asarray(UP.apply((middles[:, None] + square).reshape(-1, 3)).reshape(12, 4, 3) + AXIS_POINT_MM)


def seen(
    markers: FloatArray, noise_mm: float = 0.0, *, stated_mm: float = 0.05, seed: int = 0
) -> list[MarkerObservations]:
    """Each view sees the seven markers in front of the object, in its own frame."""
    random = np.random.default_rng(seed)
    views: list[MarkerObservations] = []
    for pose in POSES:
        mine = (markers - pose[:3, 3]) @ pose[:3, :3]
        nearest = np.argsort(mine.mean(axis=1)[:, 2])[:7].tolist()
        views.append(
            {m: MarkerObservation(mine[m] + random.normal(0, noise_mm, (4, 3)), np.full(4, stated_mm)) for m in nearest}
        )
    return views


def solved(views: Sequence[MarkerObservations], *, first: int = 0) -> MarkerFit:
    surface = AXIS_POINT_MM + UP.apply(np.random.default_rng(2).uniform((-20, -20, 0), (20, 20, 60), (200, 3)))
    surfaces = [(surface - pose[:3, 3]) @ pose[:3, :3] for pose in POSES[first : first + len(views)]]
    return marker_poses(views, surfaces, names=NAMES, max_sigma_mm=1.0)


def motions(found: MarkerFit) -> FloatArray:
    """(6 (N - 1),): turn, rad, and shift, mm, of the origin, from the true poses to those found."""
    change = found.poses @ np.linalg.inv(POSES[: len(found.poses)])
    return np.hstack([Rotation.from_matrix(change[:, :3, :3]).as_rotvec(), change[:, :3, 3]])[1:].ravel()


def test_poses_are_exact_without_noise_and_within_their_covariance_with_it() -> None:
    assert np.abs(motions(solved(seen(plate())))).max() < 1e-8
    over = []
    for seed in range(20):
        found = solved(seen(plate(), 0.05, seed=seed))
        wrong = motions(found)
        over.append(wrong @ np.linalg.solve(found.covariance, wrong) / len(wrong))
        assert found.rejected == ()
        assert found.rms_over_sigma == pytest.approx(np.ones(8), abs=0.5)
    assert 0.7 < np.mean(over) < 1.3, over
    assert 0.01 < found.sigma_mm[1:].max() < 0.2
    assert found.sigma_mm[0] == 0
    # Corners with three times the stated error triple the uncertainty of the poses.
    optimistic = [solved(seen(plate(), 0.15, seed=seed)).sigma_mm.max() for seed in range(3)]
    assert np.mean(optimistic) == pytest.approx(3 * found.sigma_mm.max(), rel=0.3)


def test_moved_markers_are_rejected_and_named_and_the_poses_are_right_without_them() -> None:
    views = [dict(view) for view in seen(plate(), 0.05, seed=3)]
    shared = [m for m in views[2] if m in views[3]]
    shift = np.array([0.8, 0.0, 0.0])
    # One slid in one view, and two were exchanged.
    slid, (a, b) = shared[0], [m for m in views[5] if sum(m in view for view in views) > 3][:2]
    views[2][slid] = views[2][slid]._replace(corners_mm=views[2][slid].corners_mm + shift)
    views[5][a], views[5][b] = views[5][b], views[5][a]
    found = solved(views)
    assert {(each.view, each.marker) for each in found.rejected} == {(2, slid), (5, a), (5, b)}
    assert next(each.off_mm for each in found.rejected if each.view == 2) == pytest.approx(0.8, abs=0.2)
    assert slid not in found.used[2]
    wrong = motions(found)
    assert wrong @ np.linalg.solve(found.covariance, wrong) / len(wrong) < 2
    # With two views it is unknown which of them is right.
    found = solved(views[2:4], first=2)
    assert {(each.view, each.marker) for each in found.rejected} == {(0, slid), (1, slid)}


def test_views_that_share_too_little_are_named() -> None:
    views = seen(plate(), 0.05)[:4]
    views[2] = {m + 100: each for m, each in views[2].items()}
    with pytest.raises(RegistrationRefusedError, match=r"^view 2: .* view 0 sees markers .*; view 2 sees markers 10"):
        solved(views)
    # One marker of 12 mm next to the object is enough, with a large uncertainty; one of 2 mm is not.
    for side_mm, does in ((12.0, True), (2.0, False)):
        pair = seen(plate(side_mm), 0.02)[:2]
        one = next(iter(pair[0].keys() & pair[1].keys()))
        pair = [{one: view[one]} for view in pair]
        if does:
            found = solved(pair)
            assert found.used == ((one,), (one,))
            assert 0.1 < found.sigma_mm[1] < 1
        else:
            with pytest.raises(
                RegistrationRefusedError, match=rf"^view 1: .* that marker {one}, which it shares .* mm"
            ):
                solved(pair)

"""Eight views of a turntable from an axis that is 0.5° and 1 mm wrong: where they come to, and what is stated of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.meshing.topology import topology_counts
from slrig.model import FloatArray
from slrig.multiview.fusion import PoseErrors, fuse_views
from slrig.multiview.matching import rotate_vectors as turned_by
from slrig.multiview.matching import transform_points
from slrig.multiview.registration import Registration, register_views
from slrig.multiview.turntable import axis_from_registration, register_on_turntable, turntable_poses
from tests.turned_views import AXIS, bumpy, displacement_mm, off_surface_mm, seen, wrong_axis
from tests.unit.multiview.known_views import Noise, plate_on_box, views_of

UP: FloatArray = np.array([0.0, 0.0, 1.0])
ANGLES = [45.0 * number for number in range(8)]
WITHIN_MM = 0.014
"""Of ten draws the worst of the seven views is 11 to 16 µm off; 8 to 15 were fewer rows beside borders left out, which
these views do not need: no lens has blurred them. Those of scans are in `tests/bench/test_turned_scans.py`."""
SEEDS = 10


@pytest.mark.slow
def test_eight_views_come_to_where_they_belong_and_are_fused_to_less_error_than_one_has() -> None:
    turned = seen(bumpy, ANGLES, pitch_mm=0.5)
    ones, models, over_sigma = [], [], []
    for seed in range(3):
        # An error of 4 µm that is alike over 3 mm, beside noise of 8 to 50 µm.
        views = turned.noisy(seed, length_mm=3.0)
        found = register_views(views, wrong_axis(ANGLES))
        wrong = [displacement_mm(*each) for each in zip(views, found.poses, turned.poses, strict=True)]
        assert max(wrong) < WITHIN_MM, np.round(wrong, 4)
        assert found.free == ()
        axis = axis_from_registration(found, AXIS)
        assert axis is not None
        assert np.linalg.norm(np.cross(axis.direction, AXIS)) < np.deg2rad(0.01)
        # As a model has it: its deviations hold how well the poses are known.
        errors = PoseErrors.from_registration(found.covariance, found.middle_mm)
        whole = fuse_views(views, found.poses, pose_errors=errors)
        assert topology_counts(whole.mesh.faces).nonmanifold_edges == 0
        ones.append(off_surface_mm(bumpy, views[0]))
        models.append(off_surface_mm(bumpy, whole.mesh))
        over_sigma.append(np.abs(models[-1]) / whole.mesh.sigma_mm)
    one, rms = (float(np.sqrt(np.mean(np.concatenate(each) ** 2))) for each in (ones, models))
    last = float(np.quantile(np.abs(np.concatenate(models)), 0.99))
    over = float(np.quantile(np.concatenate(over_sigma), 0.68))
    print(f"rms {1e3 * rms:.1f} µm of {1e3 * one:.1f}, p99 {1e3 * last:.0f}, error over σ {over:.2f}")  # noqa: T201
    assert rms < 0.8 * one
    assert last < 0.040
    assert 0.8 < over < 1.25


@pytest.mark.slow
def test_a_box_whose_sides_no_view_joins_is_as_large_as_the_stage_says() -> None:
    # Views of a single side and the top slide along it, and what joins two opposite sides is the stage alone.
    box = plate_on_box()
    box.apply_scale(3.0)
    angles, lean = np.deg2rad(ANGLES), np.deg2rad(25.0)
    turns = angles + np.deg2rad(0.03) * np.append(0.0, np.random.default_rng(1).normal(size=len(angles) - 1))
    ring = np.stack([np.cos(lean) * np.cos(turns), -np.cos(lean) * np.sin(turns), np.full(8, np.sin(lean))], axis=1)
    poses = turntable_poses(np.zeros(3), UP, turns)
    views = []
    for view, pose in zip(views_of(box, ring, 0.7, Noise(0.010, 0.004, 3.0)), poses, strict=True):
        seen_from = np.linalg.inv(pose) @ view.pose
        vertices, normals = transform_points(seen_from, view.mesh.vertices_mm), turned_by(seen_from, view.mesh.normals)
        views.append(replace(view.mesh, vertices_mm=vertices.astype("f4"), normals=normals.astype("f4")))
    off = Rotation.from_rotvec(np.deg2rad(0.5) * np.array([0.6, 0.8, 0.0])).apply(UP)
    found, axis = register_on_turntable(views, np.array([0.7, 0.7, 0.0]), off, angles)
    assert found.free != ()
    assert axis is not None
    assert np.linalg.norm(np.cross(axis.direction, UP)) < np.deg2rad(0.01)
    wrong = [displacement_mm(*each) for each in zip(views, found.poses, poses, strict=True)]
    print(np.round(wrong, 4))  # noqa: T201
    assert max(wrong) < 0.020


@pytest.mark.slow
def test_stated_covariances_hold_over_seeds() -> None:
    turned = seen(bumpy, ANGLES, pitch_mm=1.0)
    starts = wrong_axis(ANGLES)
    over, raw = [], []
    for seed in range(SEEDS):
        found = register_views(turned.noisy(seed, length_mm=2.0), starts)
        error = _motions(found, turned.poses)
        over.append(error @ np.linalg.solve(found.covariance, error) / len(error))
        raw.append(over[-1] * found.inflation**2)
    # Were matches independent of one another, squared errors would be nine times what is stated.
    assert np.mean(raw) > 5.0
    assert 0.7 < np.mean(over) < 1.5, (np.mean(over), np.min(over), np.max(over))


def _motions(found: Registration, true: list[FloatArray]) -> FloatArray:
    """(6 (N - 1),): turn, rad, about the object's middle and shift of it, mm, from the true poses to those found."""
    change = found.poses @ np.linalg.inv(true)
    small = (change[:, :3, :3] - change[:, :3, :3].swapaxes(1, 2)) / 2
    turns = np.stack([small[:, 2, 1], small[:, 0, 2], small[:, 1, 0]], axis=1)
    shifts = change[:, :3, :3] @ found.middle_mm + change[:, :3, 3] - found.middle_mm
    return np.hstack([turns, shifts])[1:].ravel()

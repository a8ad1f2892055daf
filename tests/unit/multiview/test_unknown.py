"""Views without known poses: three at a time here, eight in tests/golden/test_unknown_poses.py."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.errors import RegistrationRefusedError
from slrig.multiview.matching import compare_views, prepare_with_depth, transform_points
from slrig.multiview.unknown_poses import find_start_poses, rigid_motions
from tests.known_objects import OBJECTS, seen_from
from tests.turned_views import displacement_mm
from tests.unit.multiview.known_views import View

ANGLES = np.deg2rad([0.0, 45.0, 90.0])
FROM = np.stack([np.cos(ANGLES), np.sin(ANGLES), np.full(3, 0.4)], axis=1) / np.hypot(1, 0.4)


@pytest.fixture(scope="module")
def three() -> list[View]:
    """The figure from three sides, 45° apart."""
    return seen_from(OBJECTS["figure"](), FROM)


@pytest.mark.slow
def test_views_are_registered_without_a_start(three: list[View]) -> None:
    found = find_start_poses([view.mesh for view in three])
    for view, pose in zip(three, found, strict=True):
        assert displacement_mm(view.mesh, pose, np.linalg.inv(three[0].pose) @ view.pose) < 0.03


@pytest.mark.slow
def test_a_vase_is_refused_with_what_to_do(three: list[View]) -> None:
    views = seen_from(OBJECTS["vase"](), FROM[:2])
    with pytest.raises(
        RegistrationRefusedError, match=r"(a second one, turned by|no start that fixes it).* or state where to start"
    ):
        find_start_poses([view.mesh for view in views])
    with pytest.raises(RegistrationRefusedError, match=r"expected surface that matches other views"):
        find_start_poses([three[0].mesh, views[0].mesh])


def test_a_surface_in_front_of_the_depth_buffer_contradicts_a_pose(three: list[View]) -> None:
    one, two = (prepare_with_depth(view.mesh) for view in three[:2])
    true = np.linalg.inv(three[1].pose) @ three[0].pose
    right = compare_views(one, two, true, 3.0)
    assert right.agree > 300
    assert right.contradict < right.agree / 20
    nearer = true.copy()
    nearer[2, 3] -= 60.0  # towards the second camera: no surface is near, and all of it is in front of the other
    wrong = compare_views(one, two, nearer, 3.0)
    assert wrong.contradict > 200 > 20 * wrong.agree


def test_a_pose_from_points_is_never_a_reflection() -> None:
    random = np.random.default_rng(1)
    points = random.normal(size=(5, 4, 3))
    turn, shift = Rotation.random(rng=random).as_matrix(), random.normal(size=3)
    poses = rigid_motions(points, points @ turn.T + shift)
    np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(turn, (5, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(transform_points(poses[0], points[0]), points[0] @ turn.T + shift, atol=1e-12)
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    assert np.linalg.det(rigid_motions(flat, flat * [1, -1, 1])[:3, :3]) == pytest.approx(1.0)

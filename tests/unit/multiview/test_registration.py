"""Registration of views whose true poses are known; small ones here, eight at a time in tests/golden/test_views.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.errors import RegistrationRefusedError
from slrig.meshing.topology import boundary_vertices
from slrig.model import AlbedoMark, FloatArray, Mesh
from slrig.multiview.matching import prepare_view
from slrig.multiview.registration import Motion, register_views
from slrig.multiview.turntable import axis_from_registration, turntable_poses
from tests.turned_views import AXIS, AXIS_POINT_MM, Turned, bumpy, displacement_mm, plane, seen, vase, wrong_axis
from tests.unit.meshing.plain import grid_faces, mesh_of

ANGLES = [0.0, 40.0, 80.0]


@pytest.fixture(scope="module")
def three() -> Turned:
    """Three views of an object that no motion maps on itself."""
    return seen(bumpy, ANGLES, pitch_mm=1.0)


def test_three_views_are_registered_from_a_wrong_axis(three: Turned) -> None:
    views, starts = three.noisy(1, length_mm=2.0), wrong_axis(ANGLES)
    found = register_views(views, starts)
    wrong = [displacement_mm(*each) for each in zip(views, found.poses, three.poses, strict=True)]
    assert displacement_mm(views[2], starts[2], three.poses[2]) > 1.0
    assert wrong[0] == 0.0
    assert max(wrong) < 0.012
    # The stated uncertainty is right, and each pair has its own figures.
    assert max(wrong) < 3 * found.sigma_mm.max()
    assert found.free == ()
    by_pair = {(each.first, each.second): each for each in found.pairs}
    assert set(by_pair) == {(0, 1), (0, 2), (1, 2)}
    assert by_pair[0, 1].overlap > by_pair[0, 2].overlap > 0.19
    assert all(0.9 < each.rms_over_sigma < 1.2 and each.closure_mm < 0.02 for each in found.pairs)
    # The turntable's axis is found from the object itself.
    axis = axis_from_registration(found, AXIS)
    assert axis is not None
    aside = np.cross(axis.point_mm - AXIS_POINT_MM, AXIS)
    assert np.linalg.norm(aside) < 0.01
    assert np.linalg.norm(np.cross(axis.direction, AXIS)) < np.deg2rad(0.02)
    assert np.rad2deg(axis.angles_rad) == pytest.approx(ANGLES, abs=0.02)


@pytest.mark.slow
def test_a_vase_is_free_to_turn_about_its_axis_and_keeps_the_starting_angle() -> None:
    turned = seen(vase, ANGLES, pitch_mm=1.0)
    views, starts = turned.noisy(1, length_mm=2.0), wrong_axis(ANGLES)
    found = register_views(views, starts)
    assert [(each.view, each.motion) for each in found.free] == [(1, Motion.TURN), (2, Motion.TURN)]
    for each in found.free:
        assert np.linalg.norm(np.cross(each.direction, AXIS)) < 0.01
        assert each.free_mm > 1.0
    # The angle is the start's, to the second order of the axis's error, and all else is found.
    for pose, start, true in zip(found.poses[1:], starts[1:], turned.poses[1:], strict=True):
        change, left = pose[:3, :3] @ start[:3, :3].T, pose[:3, :3] @ true[:3, :3].T
        assert abs(_turn_about(AXIS, change)) < np.deg2rad(0.005)
        across = np.linalg.norm(np.cross(AXIS, left @ AXIS))
        assert across < np.deg2rad(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("noisy", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_two_planes_have_three_free_motions(*, noisy: bool) -> None:
    turned = plane([0.0, 3.0])
    views = turned.noisy(0, length_mm=2.0) if noisy else turned.exact
    found = register_views(views, turned.poses)
    assert sorted(each.motion for each in found.free) == [Motion.SHIFT, Motion.SHIFT, Motion.TURN]
    assert displacement_mm(turned.exact[1], found.poses[1], turned.poses[1]) < 0.01


@pytest.mark.slow
def test_a_view_that_overlaps_no_other_is_named() -> None:
    turned = seen(bumpy, [0.0, 40.0, 180.0], pitch_mm=2.0)
    with pytest.raises(RegistrationRefusedError, match=r"^back: .* share more than 2% of the surface"):
        register_views(turned.exact, turned.poses, names=["front", "side", "back"])
    with pytest.raises(RegistrationRefusedError, match="two views or more"):
        register_views(turned.exact[:1], turned.poses[:1])


@pytest.mark.slow
def test_a_view_of_another_shape_is_named(three: Turned) -> None:
    stretched = replace(three.exact[1], vertices_mm=three.exact[1].vertices_mm * np.float32(1.03))
    views = [three.exact[0], stretched, three.exact[2]]
    with pytest.raises(RegistrationRefusedError, match=r"^side: expected a surface that agrees"):
        register_views(views, three.poses, names=["front", "side", "other side"])


def test_marked_and_boundary_vertices_are_not_matched(three: Turned) -> None:
    mesh = three.exact[0]
    usable = prepare_view(mesh).usable
    assert 0 < (~usable).sum() < len(usable) / 2
    inner = ~boundary_vertices(mesh.faces, len(mesh.vertices_mm))
    mark = np.where(inner, AlbedoMark.SATURATED, AlbedoMark.NONE).astype(np.uint8)
    with pytest.raises(RegistrationRefusedError, match="none of its"):
        register_views([replace(mesh, mark=mark), mesh], [np.eye(4), np.eye(4)])


def sheet(high: int, *, folded: bool = False) -> Mesh:
    """400 vertices wide; folded by 90° at the 200th."""
    points = np.array([(x, y, 0.0) for y in range(high) for x in range(400)], dtype=np.float32)
    if folded:
        points[:, 2] = np.maximum(points[:, 0] - 199, 0)
        points[:, 0] = np.minimum(points[:, 0], 199)
    return mesh_of(points, grid_faces(high, 400), sigma_mm=1.0, colour=0)


@pytest.mark.parametrize(("high", "rows"), [(40, 5), (20, 3), (10, 2), (6, 1)])
def test_rows_next_to_a_border_are_not_matched_but_half_of_a_narrow_surface_is(high: int, rows: int) -> None:
    usable = prepare_view(sheet(high)).usable.reshape(high, 400)
    middle = np.zeros_like(usable)
    middle[rows:-rows, rows:-rows] = True
    np.testing.assert_array_equal(usable, middle)


@pytest.mark.parametrize(("high", "left"), [(40, [*range(5, 194), *range(205, 395)]), (10, list(range(2, 398)))])
def test_rows_next_to_a_sharp_bend_are_not_matched_unless_few_vertices_remain(high: int, left: list[int]) -> None:
    assert np.flatnonzero(prepare_view(sheet(high, folded=True)).usable.reshape(high, 400)[high // 2]).tolist() == left
    assert prepare_view(sheet(high, folded=True), whole=True).usable.reshape(high, 400)[high // 2, 1:-1].all()


def _turn_about(axis: FloatArray, turn: FloatArray) -> float:
    """Angle about an axis of a small turn, rad."""
    skew = (turn - turn.T) / 2
    return float(axis @ np.array([skew[2, 1], skew[0, 2], skew[1, 0]]))


def test_turntable_poses_turn_views_back_to_the_first() -> None:
    point = np.array([1.0, 2.0, 3.0])
    first, second = turntable_poses(point, np.array([0.0, 0.0, 2.0]), np.deg2rad([10.0, 100.0]))
    assert first == pytest.approx(np.eye(4))
    # A point that the turntable took from x to y comes back to x; the axis is fixed.
    assert second @ np.array([1.0, 3.0, 3.0, 1.0]) == pytest.approx([2.0, 2.0, 3.0, 1.0])
    assert second[:3, :3] @ point + second[:3, 3] == pytest.approx(point)

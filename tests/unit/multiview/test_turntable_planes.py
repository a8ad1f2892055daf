"""The planes of an empty turntable in synthetic scans, and views that are cut by them."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.errors import TurntableRefusedError
from slrig.model import FloatArray, Mesh, PlaneKind, RotationAxis
from slrig.multiview.turntable import cut_view, find_turntable_planes
from tests.unit.meshing.plain import grid_faces, joined, mesh_of

__all__ = ["AXIS", "PLATE", "WALL", "joined"]

UP = np.array([0.0, -0.8, -0.6])
"""Of a turntable that a camera in the origin looks down on."""
STAGE_MM = np.array([5.0, 40.0, 500.0])
AXIS = RotationAxis(STAGE_MM, UP)
BACK = np.array([0.0, 0.0, -1.0])


def patch(middle: FloatArray, normal: FloatArray, size_mm: float, noise_mm: float, seed: int = 0) -> Mesh:
    """A square of a plane, a vertex each millimetre, off by noise along its normal."""
    across = np.linalg.svd(normal[None])[2][1:]
    steps = np.arange(-size_mm / 2, size_mm / 2 + 0.5)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    points = middle + grid.reshape(-1, 2) @ across
    points += noise_mm * np.random.default_rng(seed).normal(size=(len(points), 1)) * normal
    return mesh_of(points, grid_faces(len(steps), len(steps)), normals=normal)


def ball(middle: FloatArray, radius_mm: float) -> Mesh:
    """The half of a ball that is seen from the origin."""
    u = np.linspace(-0.99, 0.99, 80)
    x, y = (each.ravel() for each in np.meshgrid(u, u, indexing="ij"))
    z = -np.sqrt(np.clip(1 - (x**2 + y**2) / 2, 0, 1))
    way = np.column_stack([x / np.sqrt(2), y / np.sqrt(2), z])
    return mesh_of(middle + radius_mm * way, grid_faces(len(u), len(u)), normals=way)


PLATE = patch(STAGE_MM, UP, 120.0, 0.03)
WALL = patch(STAGE_MM + np.array([0.0, -60.0, 90.0]), BACK, 150.0, 0.05, 1)


def test_plate_and_backdrop_are_found_and_distinguished() -> None:
    wall, plate = find_turntable_planes(joined(PLATE, WALL), AXIS)
    assert (wall.kind, plate.kind) == (PlaneKind.BACKDROP, PlaneKind.PLATE)
    for plane, normal, sigma_mm, through in ((wall, BACK, 0.05, WALL), (plate, UP, 0.03, PLATE)):
        assert plane.normal @ normal > np.cos(2e-4)
        assert plane.sigma_mm == pytest.approx(sigma_mm, rel=0.05)
        off = (through.vertices_mm - plane.point_mm) @ plane.normal
        assert abs(off.mean()) < 0.003
    assert plate.margin_mm == pytest.approx(1 + 4 * 0.03, abs=0.05)
    assert {plane.kind for plane in find_turntable_planes(joined(PLATE, WALL))} == {PlaneKind.BACKDROP}


def test_a_cut_leaves_the_object_and_reports_the_removed_share() -> None:
    planes = find_turntable_planes(joined(PLATE, WALL), AXIS)
    thing = ball(STAGE_MM + 15 * UP, 12.0)
    found = cut_view(joined(PLATE, thing, WALL), planes)
    assert len(found.mesh.vertices_mm) == len(thing.vertices_mm)
    assert np.array_equal(found.mesh.vertices_mm[found.mesh.faces], thing.vertices_mm[thing.faces])
    assert sum(found.removed) == pytest.approx(1 - len(thing.vertices_mm) / sum(map(_count, (PLATE, thing, WALL))))


def test_an_object_on_the_plate_loses_only_the_margin() -> None:
    (plate,) = find_turntable_planes(PLATE, AXIS)
    box_side = patch(STAGE_MM + 20 * UP, np.array([0.0, 0.6, -0.8]), 40.0, 0.0)
    height = (cut_view(box_side, [plate]).mesh.vertices_mm - STAGE_MM) @ UP
    assert height.min() == pytest.approx(plate.margin_mm, abs=1.0)
    assert height.max() == pytest.approx(((box_side.vertices_mm - STAGE_MM) @ UP).max())


def test_a_tilted_plate_is_cut_as_high_as_it_rises() -> None:
    leaning = UP + np.array([0.01, 0.0, 0.0])
    (plate,) = find_turntable_planes(patch(STAGE_MM, leaning / np.linalg.norm(leaning), 120.0, 0.03), AXIS)
    assert plate.kind is PlaneKind.PLATE
    assert plate.margin_mm == pytest.approx(1.12 + 2 * 0.01 * plate.radius_mm, abs=0.1)


def test_a_scan_without_a_plane_is_refused() -> None:
    with pytest.raises(TurntableRefusedError, match="no plane that holds 10% of its 6,400"):
        find_turntable_planes(ball(STAGE_MM, 40.0), AXIS)


def test_a_view_of_the_empty_turntable_is_refused_by_name() -> None:
    with pytest.raises(TurntableRefusedError, match=r"side: .* leave 0\.0% of the view \(backdrop 61%, plate 39%\)"):
        cut_view(joined(PLATE, WALL), find_turntable_planes(joined(PLATE, WALL), AXIS), name="side")


def _count(mesh: Mesh) -> int:
    return len(mesh.vertices_mm)

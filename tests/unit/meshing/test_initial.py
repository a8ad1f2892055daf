"""From curves to the initial mesh: strips, drops that are counted, and a front that faces the camera."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.meshing.strips import InitialMesh, initial_mesh
from slrig.meshing.surface import vertex_normals
from slrig.meshing.topology import neighbours
from slrig.model import FloatArray, IntArray

EYE_MM = np.array([5.0, 5.0, -400.0])
COLUMNS, ROWS = 12, 15


def relief(depth_mm: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Points of a sheet over a lattice of 1 mm, curve by curve: depth_mm (COLUMNS, ROWS), away from the eye."""
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    points = np.stack([x, y, depth_mm], axis=-1).reshape(-1, 3).astype(np.float64)
    offsets = np.arange(0, COLUMNS * ROWS + 1, ROWS, dtype=np.int32)
    return points, offsets, 8.0 * np.arange(COLUMNS, dtype=np.float64)


def meshed(
    points: FloatArray, offsets: IntArray, position: FloatArray, *, eye_mm: FloatArray = EYE_MM,
    bridge_after: NDArray[np.bool_] | None = None, keep_holes: bool = False, widest_step_px: float = 8.0,
) -> InitialMesh:  # fmt: skip
    return initial_mesh(
        points, offsets, position,
        np.zeros(len(points), dtype=np.bool_) if bridge_after is None else bridge_after,
        np.ones(len(points)), eye_mm,
        widest_step_px=widest_step_px, depth_edge_ratio=6.0, keep_holes=keep_holes,
    )  # fmt: skip


def facing(mesh: InitialMesh, points: FloatArray, eye_mm: FloatArray) -> NDArray[np.bool_]:
    corners = points[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(((eye_mm - corners.mean(axis=1)) * normal).sum(axis=1) > 0)


def wave() -> FloatArray:
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    return np.asarray(2 * np.sin(x / 3) + np.cos(y / 4))


def test_a_sheet_is_meshed_whole() -> None:
    points, offsets, position = relief(wave())
    mesh = meshed(points, offsets, position)
    assert mesh.strip_pairs == COLUMNS - 1
    assert mesh.strip_triangles == len(mesh.faces) == (COLUMNS - 1) * (2 * ROWS - 2)
    assert mesh.dropped_triangles == mesh.dropped_at_depth_edges == mesh.dropped_at_bridges == 0
    assert mesh.faces.dtype == np.int32


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("behind", [False, True])
def test_the_front_faces_the_eye(*, mirrored: bool, behind: bool) -> None:
    # Columns may run to the right or to the left of the camera, and the camera may stand on either side.
    points, offsets, position = relief(wave())
    if mirrored:
        points = points * [-1, 1, 1]
    eye = EYE_MM * [1, 1, -1] if behind else EYE_MM
    mesh = meshed(points, offsets, position, eye_mm=eye)
    assert facing(mesh, points, eye).all()
    towards = ((eye - points) * vertex_normals(points, mesh.faces)).sum(axis=1)
    assert (towards > 0).all()
    assert mesh.faces.flags.c_contiguous


def test_a_cliff_is_not_skinned() -> None:
    depth = wave()
    depth[6:] += 40
    points, offsets, position = relief(depth)
    mesh = meshed(points, offsets, position)
    assert mesh.dropped_at_depth_edges == mesh.dropped_triangles == 2 * ROWS - 2
    assert len(mesh.faces) == mesh.strip_triangles - mesh.dropped_triangles
    side = points[mesh.faces][:, :, 0] < 5.5
    assert (side.all(axis=1) | ~side.any(axis=1)).all()


def test_a_speck_beyond_a_cliff_is_dust() -> None:
    depth = np.zeros((COLUMNS, ROWS))
    depth[-2:, -3:] = 50.0
    points, offsets, position = relief(depth)
    mesh = meshed(points, offsets, position)
    assert mesh.dropped_as_dust == 2 * (3 - 1)
    assert mesh.dropped_triangles == mesh.dropped_at_depth_edges + mesh.dropped_as_dust
    assert len(mesh.faces) == mesh.strip_triangles - mesh.dropped_triangles
    assert (points[mesh.faces][..., 2] == 0).all()


def test_bridges_are_dropped_on_request_and_drops_overlap_in_the_count() -> None:
    depth = wave()
    depth[6:] += 40
    points, offsets, position = relief(depth)
    bridge = np.zeros(len(points), dtype=np.bool_)
    # One bridge on a curve of the upper sheet, one on that at the cliff.
    bridge[[3 * ROWS + 7, 6 * ROWS + 7]] = True
    skinned = meshed(points, offsets, position, bridge_after=bridge)
    assert (skinned.dropped_at_bridges, skinned.dropped_triangles) == (0, 2 * ROWS - 2)
    holed = meshed(points, offsets, position, bridge_after=bridge, keep_holes=True)
    assert holed.dropped_at_bridges == 4
    assert holed.dropped_at_depth_edges == 2 * ROWS - 2
    assert holed.dropped_triangles == 2 * ROWS - 2 + 3


@pytest.mark.parametrize("behind", [False, True])
def test_the_mesh_knows_its_neighbours_after_the_drop(*, behind: bool) -> None:
    depth = wave()
    depth[6:, 4:] += 40
    points, offsets, position = relief(depth)
    bridge = np.zeros(len(points), dtype=np.bool_)
    bridge[3 * ROWS + 7] = True
    eye = EYE_MM * [1, 1, -1] if behind else EYE_MM
    mesh = meshed(points, offsets, position, eye_mm=eye, bridge_after=bridge, keep_holes=True)
    assert mesh.dropped_triangles > 10
    np.testing.assert_array_equal(mesh.adjacency, neighbours(mesh.faces, vertex_count=len(points)))


def test_the_side_with_more_area_towards_the_eye_is_the_front() -> None:
    # A ridge of which the eye sees both sides, one of them from behind; areas in plain numpy.
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    points, offsets, position = relief(np.where(x < 5, 4.0 * x, 40.0 - 4 * x) + 0.1 * y)
    for eye in (np.array([-300.0, 5, 0]), np.array([300.0, 5, 0])):
        mesh = meshed(points, offsets, position, eye_mm=eye)
        corners = points[mesh.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        towards = np.sign(((eye - corners.mean(axis=1)) * normal).sum(axis=1))
        assert (towards * np.linalg.norm(normal, axis=1)).sum() > 0
        assert not (towards > 0).all()

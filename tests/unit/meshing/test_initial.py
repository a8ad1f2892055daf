"""From curves to the initial mesh: strips, drops that are counted, and a front that faces its devices."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.meshing.facing import Viewpoints
from slrig.meshing.strips import InitialMesh, initial_mesh
from slrig.meshing.surface import vertex_normals
from slrig.meshing.topology import neighbours
from slrig.model import FloatArray, IntArray

EYE_MM, LAMP_MM = np.array([5.0, 5.0, -400.0]), np.array([90.0, 5.0, -400.0])
COLUMNS, ROWS = 12, 15


def relief(depth_mm: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Points of a sheet over a lattice of 1 mm, curve by curve: depth_mm (COLUMNS, ROWS), away from the eye."""
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    points = np.stack([x, y, depth_mm], axis=-1).reshape(-1, 3).astype(np.float64)
    offsets = np.arange(0, COLUMNS * ROWS + 1, ROWS, dtype=np.int32)
    return points, offsets, 8.0 * np.arange(COLUMNS, dtype=np.float64)


def meshed(
    points: FloatArray, offsets: IntArray, position: FloatArray, *, eyes_mm: FloatArray = EYE_MM,
    second_mm: FloatArray = LAMP_MM, camera: NDArray[np.int32] | None = None, sigma_mm: float = 0.0,
    bridge_after: NDArray[np.bool_] | None = None, keep_holes: bool = False, widest_step_px: float = 8.0,
) -> InitialMesh:  # fmt: skip
    return initial_mesh(
        points, offsets, position,
        np.zeros(len(points), dtype=np.bool_) if bridge_after is None else bridge_after,
        np.ones(len(points)),
        Viewpoints(
            np.vstack([eyes_mm, second_mm]), np.zeros(len(points), dtype=np.int32) if camera is None else camera,
            np.full(len(points), len(np.atleast_2d(eyes_mm)), dtype=np.int32),
            np.full((len(points), 3), (0.0, 0.0, sigma_mm)),
        ),
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
    eye, lamp = (each * [1, 1, -1] if behind else each for each in (EYE_MM, LAMP_MM))
    mesh = meshed(points, offsets, position, eyes_mm=eye, second_mm=lamp)
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
    eye, lamp = (each * [1, 1, -1] if behind else each for each in (EYE_MM, LAMP_MM))
    mesh = meshed(points, offsets, position, eyes_mm=eye, second_mm=lamp, bridge_after=bridge, keep_holes=True)
    assert mesh.dropped_triangles > 10
    np.testing.assert_array_equal(mesh.adjacency, neighbours(mesh.faces, vertex_count=len(points)))


def ridge(fall: float) -> tuple[FloatArray, IntArray, FloatArray]:
    """Level up to the sixth curve, then away from the eye by `fall` for each."""
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    return relief(fall * np.maximum(x - 5.0, 0.0) + 0.1 * y)


ASIDE_MM = np.array([-300.0, 5.0, -100.0])
"""Sees a fall of 4 from behind: the lamp does not."""


def test_triangles_that_face_only_one_device_are_mirror_images() -> None:
    points, offsets, position = ridge(4.0)
    mesh = meshed(points, offsets, position, eyes_mm=ASIDE_MM)
    assert len(mesh.mirror_faces) == 6 * (2 * ROWS - 2)
    assert points[mesh.mirror_faces][..., 0].min() == 5
    assert len(mesh.faces) == 5 * (2 * ROWS - 2)
    assert facing(mesh, points, ASIDE_MM).all()
    np.testing.assert_array_equal(mesh.adjacency, neighbours(mesh.faces, vertex_count=len(points)))
    assert len(meshed(points, offsets, position).mirror_faces) == 0


def test_what_noise_turned_is_no_mirror_image() -> None:
    # Seen at 1° by the camera; one point is off.
    points, offsets, position = relief(0 * wave())
    points[6 * ROWS + 7, 2] += 0.03
    eye = np.array([-1000.0, 7.0, -17.5])
    noisy, sharp = (meshed(points, offsets, position, eyes_mm=eye, sigma_mm=each) for each in (0.02, 0.0001))
    assert len(noisy.mirror_faces) == noisy.dropped_triangles == 0
    assert not facing(noisy, points, eye).all()
    # A few beyond noise are a fold, and dropped as dust.
    assert len(sharp.mirror_faces) == 0
    assert sharp.dropped_as_dust == sharp.dropped_triangles == (~facing(noisy, points, eye)).sum()
    assert facing(sharp, points, eye).all()


def test_a_triangle_has_to_face_the_camera_that_measured_it_and_no_other() -> None:
    points, offsets, position = ridge(4.0)
    other = np.repeat(np.arange(COLUMNS) >= 5, ROWS)
    eyes = np.stack([ASIDE_MM, EYE_MM])
    mesh = meshed(points, offsets, position, eyes_mm=eyes, camera=other.astype(np.int32))
    assert len(mesh.mirror_faces) == 0
    mesh = meshed(points, offsets, position, eyes_mm=eyes, camera=(~other).astype(np.int32))
    assert len(mesh.mirror_faces) == 6 * (2 * ROWS - 2)


def test_a_part_that_both_cameras_of_a_pair_see_lit_by_way_of_a_mirror_is_turned_to_them() -> None:
    # Behind the fifth curve the columns run back again, over a part that lies lower.
    points, offsets, position = relief(wave())
    points[5 * ROWS :, 0] = 30.0 - points[5 * ROWS :, 0]
    mesh = meshed(points, offsets, position)
    assert len(mesh.mirror_faces) == 0
    assert len(mesh.faces) == mesh.strip_triangles - (2 * ROWS - 2)
    assert facing(mesh, points, EYE_MM).all()
    np.testing.assert_array_equal(mesh.adjacency, neighbours(mesh.faces, vertex_count=len(points)))

"""Topology of small meshes whose answers are known, and of random ones against plain numpy."""

from __future__ import annotations

from collections import Counter

import numba
import numpy as np
import pytest

from slrig.meshing.adjacency import neighbours
from slrig.meshing.normals import vertex_normals
from slrig.meshing.topology import (
    boundary_vertices,
    component_sizes,
    degenerate_faces,
    duplicate_face_count,
    kept_faces,
    topology_counts,
    used_vertices,
)
from slrig.model import FloatArray, IntArray
from tests.unit.meshing.plain import boundary_edges

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)


def faces_of(*rows: tuple[int, int, int]) -> IntArray:
    return np.array(rows, dtype=np.int32).reshape(-1, 3)


def grid(rows: int, columns: int) -> IntArray:
    """Two triangles per cell of a grid of vertices."""
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = (index[s, t].ravel() for s in (np.s_[:-1], np.s_[1:]) for t in (np.s_[:-1], np.s_[1:]))
    return np.concatenate((np.stack((a, b, c), 1), np.stack((b, d, c), 1)))


def test_a_closed_tetrahedron_has_no_border_and_characteristic_two() -> None:
    counts = topology_counts(TETRAHEDRON)
    assert (counts.vertices, counts.edges, counts.euler_characteristic, counts.components) == (4, 6, 2, 1)
    assert counts.boundary_edges == counts.boundary_vertices == 0
    assert counts.nonmanifold_edges == counts.misoriented_edges == 0
    assert counts.duplicate_faces == counts.degenerate_faces == 0


def test_a_grid_has_the_border_of_a_rectangle() -> None:
    faces = grid(5, 7)
    counts = topology_counts(faces)
    assert counts.boundary_vertices == counts.boundary_edges == 2 * (4 + 6)
    border = boundary_vertices(faces, 36)  # one more than there are: unused
    assert not border[35]
    assert border[:35].reshape(5, 7)[1:-1, 1:-1].sum() == 0
    assert border.sum() == 2 * (4 + 6)
    assert counts.euler_characteristic == 1
    assert counts.misoriented_edges == counts.nonmanifold_edges == 0


def test_random_faces_agree_with_counting_one_by_one() -> None:
    random = np.random.default_rng(9)
    for most in (4, 12, 300):
        faces = random.integers(0, most, (150, 3)).astype(np.int32)
        counts = topology_counts(faces)
        directed = Counter((int(f[i]), int(f[(i + 1) % 3])) for f in faces for i in range(3))
        undirected = Counter((min(e), max(e)) for e in directed.elements())
        alone = [edge for edge, uses in undirected.items() if uses == 1]
        assert counts.edges == len(undirected)
        assert counts.boundary_edges == len(alone) == len(boundary_edges(faces))
        assert counts.boundary_vertices == len({end for edge in alone for end in edge})
        assert counts.nonmanifold_edges == sum(uses > 2 for uses in undirected.values())
        assert counts.misoriented_edges == sum(uses > 1 for uses in directed.values())
        assert counts.duplicate_faces == len(faces) - len({tuple(sorted(f)) for f in faces.tolist()})
        assert counts.degenerate_faces == degenerate_faces(faces).sum()
        assert counts.vertices == len(np.unique(faces))


def test_each_random_count_has_something_to_count() -> None:
    counts = topology_counts(np.random.default_rng(3).integers(0, 12, (150, 3)).astype(np.int32))
    assert counts.nonmanifold_edges > 0
    assert counts.misoriented_edges > 0
    assert counts.duplicate_faces > 0


def test_boundary_edges_keep_the_direction_of_their_triangle() -> None:
    faces = faces_of((5, 1, 2), (2, 1, 3))
    assert sorted(map(tuple, boundary_edges(faces).tolist())) == [(1, 3), (2, 5), (3, 2), (5, 1)]


def test_a_triangle_turned_over_is_misoriented_on_each_shared_edge() -> None:
    turned = TETRAHEDRON.copy()
    turned[0] = turned[0, ::-1]
    assert topology_counts(turned).misoriented_edges == 3
    assert topology_counts(turned).nonmanifold_edges == 0


def test_a_third_triangle_on_an_edge_is_nonmanifold() -> None:
    assert topology_counts(faces_of((0, 1, 2), (1, 0, 3), (0, 1, 4))).nonmanifold_edges == 1


def test_a_duplicate_is_found_whatever_the_order_of_its_corners() -> None:
    assert duplicate_face_count(faces_of((0, 1, 2), (2, 1, 0), (1, 2, 0), (0, 1, 3))) == 2


def test_faces_that_use_a_vertex_twice_are_degenerate() -> None:
    assert degenerate_faces(faces_of((0, 0, 1), (0, 1, 2), (3, 4, 3), (5, 6, 6))).tolist() == [True, False, True, True]


def test_components_are_joined_by_a_vertex() -> None:
    faces = faces_of((8, 9, 7), (0, 1, 2), (9, 10, 11), (3, 4, 5), (5, 1, 6))
    assert component_sizes(faces, np.ones(5, dtype=np.bool_)).tolist() == [2, 3, 2, 3, 3]
    assert topology_counts(faces).components == 2


def flooded(faces: IntArray) -> IntArray:
    """(F,): the connected piece of each face, numbered from 0, by spreading the lowest number over shared vertices."""
    labels = np.arange(len(faces))
    while True:
        lowest = np.full(int(faces.max()) + 1, len(faces))
        np.minimum.at(lowest, faces.ravel(), np.repeat(labels, 3))
        spread = np.minimum(labels, lowest[faces].min(axis=1))
        if (spread == labels).all():
            return np.asarray(np.unique(labels, return_inverse=True)[1])
        labels = spread


def test_sizes_of_components_agree_with_flooding() -> None:
    random = np.random.default_rng(6)
    faces = random.permutation(grid(30, 40))
    among = np.asarray(random.random(len(faces)) < 0.2)
    labels = flooded(faces[among])
    assert topology_counts(faces[among]).components == labels.max() + 1 > 20
    wanted = np.zeros(len(faces), dtype=np.int64)
    wanted[among] = np.bincount(labels)[labels]
    assert component_sizes(faces, among).tolist() == wanted.tolist()
    assert len(np.unique(wanted)) > 3
    assert component_sizes(faces[:0], among[:0]).shape == (0,)


def test_kept_faces_keep_their_neighbours() -> None:
    faces = grid(6, 9)
    kept = np.asarray(np.random.default_rng(8).random(len(faces)) < 0.6)
    rest, across = kept_faces(faces, neighbours(faces, vertex_count=54), kept)
    np.testing.assert_array_equal(rest, faces[kept])
    np.testing.assert_array_equal(across, neighbours(rest, vertex_count=54))
    assert rest.dtype == across.dtype == np.int32


def test_used_vertices_are_those_of_faces() -> None:
    assert np.flatnonzero(used_vertices(faces_of((7, 2, 4), (4, 2, 9)), 11)).tolist() == [2, 4, 7, 9]


def test_no_face_is_no_fault() -> None:
    none = np.zeros((0, 3), dtype=np.int32)
    counts = topology_counts(none)
    assert counts.vertices == counts.edges == counts.components == counts.euler_characteristic == 0
    assert boundary_edges(none).shape == (0, 2)
    assert not used_vertices(none, 4).any()
    assert np.isnan(vertex_normals(np.zeros((4, 3)), none)).all()


def plain_vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """The sum over corners of angle times unit normal, with the angle from the arc cosine."""
    sums = np.zeros((len(vertices), 3))
    for face in faces:
        corners = vertices[face]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        for i in range(3):
            u, v = corners[(i + 1) % 3] - corners[i], corners[(i + 2) % 3] - corners[i]
            sums[face[i]] += np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)) * normal
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))


def test_vertex_normals_agree_with_plain_numpy() -> None:
    random = np.random.default_rng(1)
    faces = grid(6, 9)
    rows, columns = np.divmod(np.arange(54), 9)
    vertices = np.stack((columns + random.normal(0, 0.1, 54), rows, random.normal(0, 0.4, 54)), axis=1)
    found = vertex_normals(vertices, faces)
    assert found.dtype == np.float32
    assert found == pytest.approx(plain_vertex_normals(vertices, faces), abs=1e-6)


def test_vertex_normals_of_a_cube_do_not_depend_on_its_diagonals() -> None:
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = faces_of(*(row for a, b, c, d in sides for row in ((a, b, c), (a, c, d))))
    assert topology_counts(faces).euler_characteristic == 2
    assert vertex_normals(corners, faces) == pytest.approx(corners / np.sqrt(3), abs=1e-6)


def test_a_vertex_without_area_has_no_normal() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [9, 9, 9]], dtype=np.float64)
    normals = vertex_normals(vertices, faces_of((0, 1, 2), (0, 1, 3)))
    assert normals[:3].tolist() == [[0, 0, 1]] * 3
    assert np.isnan(normals[3:]).all()


def test_vertex_normals_are_the_same_for_any_number_of_threads() -> None:
    random = np.random.default_rng(2)
    # Names in no order, so that every triangle concerns several threads.
    faces = random.permutation(54).astype(np.int32)[grid(6, 9)]
    vertices = random.normal(0, 1, (54, 3))
    most = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = vertex_normals(vertices, faces)
    finally:
        numba.set_num_threads(most)
    assert vertex_normals(vertices, faces).tobytes() == one.tobytes()
    assert one == pytest.approx(plain_vertex_normals(vertices, faces), abs=1e-5)

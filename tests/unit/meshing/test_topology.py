"""Topology of small meshes whose answers are known, and of random ones against plain numpy."""

from __future__ import annotations

from collections import Counter

import numpy as np

from slrig.meshing.boundary import boundary_half_edges
from slrig.meshing.flips import BLOCK, GAMMA, angle_rad, prefer_flips, prefers_flip
from slrig.meshing.surface import compact_mesh, vertex_normals
from slrig.meshing.topology import (
    boundary_vertices,
    component_sizes,
    degenerate_faces,
    neighbours,
    select_faces,
    topology_counts,
    used_vertices,
)
from slrig.model import IntArray
from tests.unit.meshing.plain import boundary_edges, faces_of, grid_faces, soup

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)


def test_a_closed_tetrahedron_has_no_border_and_characteristic_two() -> None:
    counts = topology_counts(TETRAHEDRON)
    assert (counts.vertices, counts.edges, counts.euler_characteristic, counts.components) == (4, 6, 2, 1)
    assert counts.boundary_edges == counts.boundary_vertices == 0
    assert counts.nonmanifold_edges == counts.misoriented_edges == 0
    assert counts.duplicate_faces == counts.degenerate_faces == 0


def test_a_grid_has_the_border_of_a_rectangle() -> None:
    faces = grid_faces(5, 7)
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
        assert (min(counts.nonmanifold_edges, counts.misoriented_edges, counts.duplicate_faces) > 0) == (most < 300)


def test_components_are_joined_by_a_vertex() -> None:
    faces = faces_of((8, 9, 7), (0, 1, 2), (9, 10, 11), (3, 4, 5), (5, 1, 6))
    assert component_sizes(faces, np.ones(5, dtype=np.bool_)).tolist() == [2, 3, 2, 3, 3]
    counted = np.array([False, True, True, False, True])
    assert component_sizes(faces, np.ones(5, dtype=np.bool_), counted=counted).tolist() == [1, 2, 1, 2, 2]
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
    faces = random.permutation(grid_faces(30, 40))
    among = np.asarray(random.random(len(faces)) < 0.2)
    labels = flooded(faces[among])
    assert topology_counts(faces[among]).components == labels.max() + 1 > 20
    wanted = np.zeros(len(faces), dtype=np.int64)
    wanted[among] = np.bincount(labels)[labels]
    assert component_sizes(faces, among).tolist() == wanted.tolist()
    assert len(np.unique(wanted)) > 3
    assert component_sizes(faces[:0], among[:0]).shape == (0,)


def test_kept_faces_keep_their_neighbours() -> None:
    faces = grid_faces(6, 9)
    kept = np.asarray(np.random.default_rng(8).random(len(faces)) < 0.6)
    rest, across = select_faces(faces, neighbours(faces, vertex_count=54), kept)
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


def test_a_vertex_without_area_has_no_normal() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [9, 9, 9]], dtype=np.float64)
    normals = vertex_normals(vertices, faces_of((0, 1, 2), (0, 1, 3)))
    assert normals[:3].tolist() == [[0, 0, 1]] * 3
    assert np.isnan(normals[3:]).all()


def test_angles_are_those_of_the_library() -> None:
    random = np.random.default_rng(0)
    sines, cosines = np.abs(random.normal(size=20_000)), random.normal(size=20_000) * 10.0 ** random.integers(-8, 8)
    sines[:6], cosines[:6] = (0, 0, 0, 1, 1, 1), (0, 1, -1, 0, 1, -1)
    found = [angle_rad(*pair) for pair in zip(sines.tolist(), cosines.tolist(), strict=True)]
    np.testing.assert_allclose(found, np.arctan2(sines, cosines), rtol=1e-15, atol=0)


def test_normals_are_means_weighted_by_angle() -> None:
    points, faces = soup(1)
    faces[7] = faces[7, 0]  # no area: of no weight
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    twice = np.linalg.norm(normals, axis=1)
    sums = np.zeros_like(points)
    for k, (apex, left, right) in enumerate(((a, b, c), (b, c, a), (c, a, b))):
        angle = np.arctan2(twice, ((left - apex) * (right - apex)).sum(axis=1))
        ahead = twice > 0
        np.add.at(sums, faces[ahead, k], (angle / np.where(ahead, twice, 1))[ahead, None] * normals[ahead])
    expected = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(points, faces), expected, atol=1e-6)


def test_many_edges_at_once_are_judged_as_each_alone() -> None:
    points = np.random.default_rng(2).normal(size=(60, 3))
    named = np.random.default_rng(3).integers(0, 60, size=(BLOCK, 4))
    cosine, sine = np.cos(GAMMA), np.sin(GAMMA)
    corners = np.zeros(12 * BLOCK)
    corners.reshape(12, BLOCK)[:] = points[named].reshape(BLOCK, 12).T
    flips = np.zeros(BLOCK, dtype=np.bool_)
    prefer_flips(BLOCK, corners, cosine, sine, flips)
    assert flips.tolist() == [prefers_flip(points, *map(int, four), cosine, sine) for four in named]
    assert 0.2 < flips.mean() < 0.8


def test_boundary_half_edges_rise() -> None:
    adjacency = np.random.default_rng(4).integers(-1, 9, size=(10_000, 3)).astype(np.int32)
    np.testing.assert_array_equal(boundary_half_edges(adjacency), np.flatnonzero(adjacency.ravel() < 0))
    assert not len(boundary_half_edges(np.zeros((0, 3), dtype=np.int32)))


def test_a_mesh_is_gathered_from_the_points_in_use() -> None:
    points, faces = soup(9, faces=200)
    random = np.random.default_rng(10)
    normals, sigma = random.normal(size=(700, 3)).astype(np.float32), random.random(700)
    colour, mark = random.integers(0, 256, (700, 3)).astype(np.uint8), random.integers(0, 6, 700).astype(np.uint8)
    offsets = np.array([0, 100, 100, 420, 700], dtype=np.int32)
    columns = np.array([3.9, 4.5, 6.0, 11.2])
    mesh = compact_mesh(faces, points, normals, colour, mark, sigma, offsets, columns)
    used = np.unique(faces)
    assert len(used) < 500
    np.testing.assert_array_equal(used[mesh.faces], faces)
    np.testing.assert_array_equal(mesh.vertices_mm, points[used].astype(np.float32))
    np.testing.assert_array_equal(mesh.normals, normals[used])
    np.testing.assert_array_equal(mesh.colour, colour[used])
    np.testing.assert_array_equal(mesh.mark, mark[used])
    np.testing.assert_array_equal(mesh.sigma_mm, sigma[used].astype(np.float32))
    np.testing.assert_array_equal(mesh.stripe, np.repeat([3, 4, 6, 11], np.diff(offsets))[used])

"""The kernels behind a finished mesh's vertices, each against the same in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing.angles import angle_rad
from slrig.meshing.boundary_rules import boundary_half_edges
from slrig.meshing.flips import BLOCK, GAMMA, prefer_flips, prefers_flip
from slrig.meshing.normals import vertex_normals
from slrig.meshing.quality import mesh_figures, weighted_percentiles
from slrig.meshing.topology import duplicate_face_count
from slrig.meshing.vertices import compact_mesh
from slrig.model import FloatArray, IntArray


def soup(seed: int, *, points: int = 700, faces: int = 5000) -> tuple[FloatArray, IntArray]:
    """Triangles between random points, three different ones each."""
    random = np.random.default_rng(seed)
    corners = np.stack([random.permutation(points)[:3] for _ in range(faces)])
    return random.normal(size=(points, 3)), corners.astype(np.int32)


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


def test_duplicate_faces_have_the_vertices_of_an_earlier_one() -> None:
    _, faces = soup(5, points=14, faces=900)
    assert duplicate_face_count(faces) == len(faces) - len(np.unique(np.sort(faces, axis=1), axis=0)) > 500


def test_weighted_percentiles_are_those_of_all_values_sorted() -> None:
    random = np.random.default_rng(6)
    values, weights = random.gamma(2.0, size=9000), random.random(9000)
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    percents = (0.0, 1.0, 5.0, 50.0, 99.9, 100.0)
    at = np.searchsorted(cumulated, np.array(percents[:-1]) / 100 * cumulated[-1])
    assert weighted_percentiles(values, weights, percents)[:-1] == values[order][at].tolist()
    assert weighted_percentiles(values, weights, percents)[-1] == pytest.approx(values.max(), rel=1e-2)
    assert weighted_percentiles(np.full(5, 3.0), np.ones(5), (50.0,)) == [3.0]
    assert np.isnan(weighted_percentiles(values, np.zeros(9000), (50.0,))).all()


def test_figures_of_any_triangles_are_those_of_plain_numpy() -> None:
    points, faces = soup(7)
    figures = mesh_figures(points, faces)
    sides = points[faces] - points[np.roll(faces, 1, axis=1)]
    twice = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    angles = [np.arctan2(twice, -(sides[:, k] * sides[:, (k + 1) % 3]).sum(axis=1)) for k in range(3)]
    assert figures["area_mm2"] == pytest.approx(twice.sum() / 2)
    assert figures["harmonic_index_mean"] == pytest.approx(((sides**2).sum(axis=(1, 2)) / (twice / 2)).mean())
    slivers = np.degrees(np.min(angles, axis=0)) < 10
    assert figures["sliver_fraction_below_10deg"] == pytest.approx(slivers.mean())


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

"""Distances and rays of the tree against every triangle tried in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing.quality import SearchTree
from slrig.model import FloatArray, IntArray
from tests.unit.meshing.plain import grid_faces


def soup(count: int, seed: int) -> tuple[FloatArray, IntArray]:
    """Random triangles of many sizes, some collapsed to a segment or a point, some slivers."""
    random = np.random.default_rng(seed)
    centres = random.uniform(-10, 10, (count, 1, 3))
    corners = centres + random.normal(size=(count, 3, 3)) * random.uniform(0.01, 4, (count, 1, 1))
    corners[::17, 2] = corners[::17, 1]
    corners[::23] = corners[::23, :1]
    corners[::29, 2] = corners[::29, :2].mean(axis=1) + 1e-7
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def plain_distance(point: FloatArray, corners: FloatArray) -> float:
    """Least over all triangles of the distance to a plane foot that lies inside, or to a side."""
    best = np.inf
    for i in range(3):
        start, along = corners[:, i], corners[:, (i + 1) % 3] - corners[:, i]
        square = np.maximum((along**2).sum(1), 1e-300)
        t = np.clip(((point - start) * along).sum(1) / square, 0, 1)
        best = min(best, float(np.linalg.norm(start + t[:, None] * along - point, axis=1).min()))
    for a, b, c in corners:
        basis = np.stack((b - a, c - a), axis=1)
        if np.linalg.matrix_rank(basis, tol=1e-6) == 2:
            u, v = np.linalg.lstsq(basis, point - a, rcond=None)[0]
            if u >= 0 and v >= 0 and u + v <= 1:
                best = min(best, float(np.linalg.norm(a + basis @ (u, v) - point)))
    return best


def plain_reaches(origin: FloatArray, direction: FloatArray, corners: FloatArray) -> list[float]:
    """Where a ray meets each triangle, solved as a 3 x 3 system."""
    found = []
    for a, b, c in corners:
        system = np.stack((b - a, c - a, -direction), axis=1)
        if np.linalg.matrix_rank(system, tol=1e-9) == 3:
            u, v, t = np.linalg.solve(system, origin - a)
            if u >= 0 and v >= 0 and u + v <= 1 and t > 0:
                found.append(float(t))
    return found


@pytest.mark.parametrize("count", [1, 3, 4, 5, 61, 300])
def test_distances_are_those_of_trying_every_triangle(count: int) -> None:
    vertices, faces = soup(count, count)
    points = np.random.default_rng(0).uniform(-15, 15, (20, 3))
    expected = [plain_distance(point, vertices[faces]) for point in points]
    assert SearchTree.build(vertices, faces).distances_mm(points) == pytest.approx(np.array(expected), abs=1e-6)


def test_rays_are_those_of_trying_every_triangle() -> None:
    vertices, faces = soup(250, 9)
    random = np.random.default_rng(2)
    origin = np.array([1.0, -30.0, 4.0])
    directions = random.uniform(-8, 8, (40, 3)) - origin
    directions[0] = (0.0, 1.0, 0.0)
    tree = SearchTree.build(vertices, faces)
    reaches = [plain_reaches(origin, direction, vertices[faces]) for direction in directions]
    assert max(map(len, reaches)) > 2
    assert tree.first_hits(origin, directions) == pytest.approx(np.array([min(r, default=np.inf) for r in reaches]))
    assert tree.crossing_counts(origin, directions).tolist() == [len(r) for r in reaches]


def test_a_ray_through_vertices_and_along_edges_does_not_slip_through() -> None:
    side = np.arange(-20.0, 21.0)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    vertices = np.stack((x, y, 0.01 * x * y), axis=1)
    faces = grid_faces(41, 41)
    eye = np.array([3.7, -2.9, -90.3])
    inner = vertices[(np.abs(vertices[:, :2]) < 20).all(axis=1)]
    reach = SearchTree.build(vertices, faces).first_hits(eye, inner - eye)
    assert reach == pytest.approx(np.ones(len(inner)), abs=1e-6)


def test_a_tree_of_nothing_is_infinitely_far() -> None:
    tree = SearchTree.build(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    assert tree.distances_mm(np.zeros((2, 3))).tolist() == [np.inf, np.inf]
    assert tree.first_hits(np.zeros(3), np.ones((1, 3))).tolist() == [np.inf]


def test_a_point_that_is_not_finite_has_no_distance() -> None:
    vertices, faces = soup(10, 1)
    points = np.array([[0, 0, np.nan], [np.inf, 0, 0], [0, 0, 0]])
    found = SearchTree.build(vertices, faces).distances_mm(points)
    assert np.isnan(found).tolist() == [True, True, False]


def test_a_vertex_that_is_not_finite_is_refused_if_it_is_used() -> None:
    vertices, faces = soup(10, 1)
    vertices[4] = np.nan
    with pytest.raises(ValueError, match="finite vertices"):
        SearchTree.build(vertices, faces)
    assert np.isfinite(SearchTree.build(vertices, faces[3:]).distances_mm(np.zeros((1, 3)))).all()

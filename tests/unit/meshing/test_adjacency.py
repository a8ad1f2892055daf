"""Neighbours of triangles against counting edges one by one."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing.topology import neighbours, sort_into_groups
from slrig.model import IntArray
from tests.unit.meshing.plain import faces_of


def plain_neighbours(faces: IntArray) -> list[list[int]]:
    """The face that runs along each edge in the other direction, by a dictionary."""
    runs = {(int(f[k]), int(f[(k + 1) % 3])): i for i, f in enumerate(faces) for k in range(3)}
    return [[runs.get((int(f[(k + 2) % 3]), int(f[(k + 1) % 3])), -1) for k in range(3)] for f in faces]


def patch(rows: int, columns: int, seed: int) -> IntArray:
    """A grid of vertices under random names, cells cut along random diagonals, some left out, faces in any order."""
    random = np.random.default_rng(seed)
    names = random.permutation(rows * columns).reshape(rows, columns)
    faces = []
    for i in range(rows - 1):
        for j in range(columns - 1):
            a, b, c, d = names[i, j], names[i, j + 1], names[i + 1, j + 1], names[i + 1, j]
            faces += [(a, b, c), (a, c, d)] if random.random() < 0.5 else [(a, b, d), (b, c, d)]
    kept = random.permutation(np.array(faces, dtype=np.int32))[: int(0.8 * len(faces))]
    turned = [np.roll(face, random.integers(3)) for face in kept]
    return np.array(turned, dtype=np.int32)


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_agree_with_a_dictionary_of_edges(seed: int) -> None:
    faces = patch(9, 13, seed)
    found = neighbours(faces, vertex_count=9 * 13)
    assert found.dtype == np.int32
    assert found.tolist() == plain_neighbours(faces)
    assert (found == -1).any()
    assert (found >= 0).any()


def test_faces_back_to_back_are_neighbours_three_times_and_those_that_meet_in_a_vertex_are_none() -> None:
    assert (neighbours(faces_of((0, 1, 2), (0, 3, 4)), vertex_count=5) == -1).all()
    assert neighbours(faces_of((0, 1, 2), (0, 2, 1)), vertex_count=3).tolist() == [[1, 1, 1], [0, 0, 0]]


def test_no_face_has_no_neighbours() -> None:
    assert neighbours(faces_of(), vertex_count=7).shape == (0, 3)
    assert neighbours(faces_of(), vertex_count=0).shape == (0, 3)


@pytest.mark.parametrize(
    ("faces", "said"),
    [
        (faces_of((0, 1, 2), (1, 0, 3), (0, 1, 4)), "same direction"),
        (faces_of((0, 1, 2), (0, 1, 3)), "same direction"),
        (faces_of((0, 1, 2), (1, 2, 0)), "same direction"),
        (faces_of((0, 1, 2), (3, 3, 4)), "uses a vertex twice"),
        (faces_of((0, 1, 9)), "vertices 0 to 9, there are 5"),
        (faces_of((-1, 1, 2)), "vertices -1 to 2"),
    ],
)
def test_what_is_no_wound_manifold_is_refused(faces: IntArray, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        neighbours(faces, vertex_count=5)


def test_groups_list_corners_by_vertex() -> None:
    faces = patch(6, 7, 3)
    starts, corners = sort_into_groups(faces.ravel(), 50)
    for vertex in range(50):
        wanted = [3 * i + k for i, face in enumerate(faces.tolist()) for k in range(3) if face[k] == vertex]
        assert corners[starts[vertex] : starts[vertex + 1]].tolist() == wanted
    assert starts[-1] == len(corners) == faces.size

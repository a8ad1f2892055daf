"""How the triangles of a mesh hang together: edges, borders, faults of orientation, components.

`faces` is (F, 3) int32, vertex indices, throughout. Coordinates play no part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.adjacency import in_groups
from slrig.model import IntArray


@dataclass(frozen=True, slots=True)
class TopologyCounts:
    """What is right and wrong with how a mesh hangs together.

    vertices : those that a face uses. boundary_edges : used by one triangle; boundary_vertices : their ends.
    nonmanifold_edges : used by more than two triangles.
    misoriented_edges : run along in the same direction by more than one triangle.
    duplicate_faces : faces with the three vertices of an earlier one. degenerate_faces : a vertex comes twice.
    components : pieces that share no vertex. euler_characteristic : vertices - edges + faces.
    """

    vertices: int
    edges: int
    boundary_edges: int
    boundary_vertices: int
    nonmanifold_edges: int
    misoriented_edges: int
    duplicate_faces: int
    degenerate_faces: int
    components: int
    euler_characteristic: int


def duplicate_face_count(faces: IntArray) -> int:
    """Number of faces whose three vertices, in any order, an earlier face has already."""
    if not len(faces):
        return 0
    faces = np.ascontiguousarray(faces)
    bound = _vertex_bound(faces)
    a, b, c = faces.T
    lowest = np.minimum(np.minimum(a, b), c)  # a tenth of the time of a minimum over an axis of three
    return sum(in_bands(_duplicates, bound, faces, *in_groups(lowest, bound)))


def degenerate_faces(faces: IntArray) -> NDArray[np.bool_]:
    """(F,) bool: a vertex comes twice in the face."""
    a, b, c = faces.T
    return np.asarray((a == b) | (b == c) | (c == a))


def component_sizes(faces: IntArray, among: NDArray[np.bool_]) -> IntArray:
    """(F,) int32: number of faces in the connected piece that each face belongs to, in a mesh of those `among` alone.

    among : (F,) bool. 0 for the others. Faces that share a vertex belong together.
    """
    faces = np.ascontiguousarray(faces)
    piece = _joined(faces, among, _vertex_bound(faces))[faces[:, 0]]
    sizes = np.bincount(piece[among], minlength=_vertex_bound(faces)).astype(np.int32)
    return np.where(among, sizes[piece], np.int32(0))


def topology_counts(faces: IntArray) -> TopologyCounts:
    """All the counts of this module at once."""
    faces = np.ascontiguousarray(faces)
    bound = _vertex_bound(faces)
    border = np.zeros(bound, dtype=np.bool_)
    half_edges = in_groups(np.minimum(faces, faces[:, [1, 2, 0]]).ravel(), bound)
    counted = in_bands(_edge_counts, bound, faces, *half_edges, border)
    edges, boundary, nonmanifold, misoriented = (sum(each) for each in zip(*counted, strict=True))
    used = used_vertices(faces, bound)
    vertices = int(np.count_nonzero(used))
    roots = _joined(faces, np.ones(len(faces), dtype=np.bool_), bound)
    return TopologyCounts(
        vertices=vertices,
        edges=edges,
        boundary_edges=boundary,
        boundary_vertices=int(np.count_nonzero(border)),
        nonmanifold_edges=nonmanifold,
        misoriented_edges=misoriented,
        duplicate_faces=duplicate_face_count(faces),
        degenerate_faces=int(degenerate_faces(faces).sum()),
        components=int(np.count_nonzero(used & (roots == np.arange(bound)))),
        euler_characteristic=vertices - edges + len(faces),
    )


def boundary_vertices(faces: IntArray, vertex_count: int) -> NDArray[np.bool_]:
    """(vertex_count,) bool: the ends of edges that one triangle alone uses."""
    faces = np.ascontiguousarray(faces)
    border = np.zeros(vertex_count, dtype=np.bool_)
    half_edges = in_groups(np.minimum(faces, faces[:, [1, 2, 0]]).ravel(), vertex_count)
    in_bands(_edge_counts, vertex_count, faces, *half_edges, border)
    return border


def used_vertices(faces: IntArray, vertex_count: int) -> NDArray[np.bool_]:
    """(vertex_count,) bool: the vertices that a face uses."""
    used = np.zeros(vertex_count, dtype=np.bool_)
    _mark(np.ascontiguousarray(faces), used)
    return used


@kernel
def _mark(faces: IntArray, used: Any) -> None:
    for face in range(len(faces)):
        for corner in range(3):
            used[faces[face, corner]] = True


def kept_faces(faces: IntArray, adjacency: IntArray, kept: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """The faces that stay, (F,) bool, in their order, and their neighbours in the new numbering: (K, 3) int32 each."""
    numbers = np.where(kept, np.cumsum(kept, dtype=np.int32) - np.int32(1), np.int32(-1))
    rest = np.zeros((int(np.count_nonzero(kept)), 3), dtype=np.int32)
    across = np.zeros_like(rest)
    given = np.ascontiguousarray(faces), np.ascontiguousarray(adjacency)
    in_bands(_keep, len(faces), *given, numbers, rest, across)
    return rest, across


@kernel
def _keep(
    first: int, last: int, faces: IntArray, adjacency: IntArray, numbers: IntArray, rest: Any, across: Any
) -> None:
    for face in range(first, last):
        number = numbers[face]
        if number >= 0:
            for corner in range(3):
                other = adjacency[face, corner]
                rest[number, corner] = faces[face, corner]
                across[number, corner] = numbers[other] if other >= 0 else -1


def _vertex_bound(faces: IntArray) -> int:
    return int(faces.max()) + 1 if faces.size else 0


@kernel
def _edge_counts(
    first: int, last: int, faces: IntArray, starts: IntArray, halves: IntArray, border: Any
) -> tuple[int, int, int, int]:
    """Edges; those of one triangle, marking their ends; those of more than two; directions run along more than once."""
    edges, boundary, nonmanifold, misoriented = 0, 0, 0, 0
    most = 0
    for vertex in range(first, last):
        most = max(most, starts[vertex + 1] - starts[vertex])
    # Of the half-edges at one vertex, read once: the other ends, and whether they run there from the vertex.
    ends, away = np.zeros(most, dtype=np.int32), np.zeros(most, dtype=np.int32)
    for vertex in range(first, last):
        count = starts[vertex + 1] - starts[vertex]
        for at in range(count):
            half = halves[starts[vertex] + at]
            face = half // 3
            corner = half - 3 * face
            origin, target = faces[face, corner], faces[face, corner + 1 if corner < 2 else 0]
            ends[at] = origin + target - vertex
            away[at] = origin == vertex
        for at in range(count):
            known, uses, outward = False, 0, 0
            for each in range(count):
                if ends[each] == ends[at]:
                    known |= each < at
                    uses += 1
                    outward += away[each]
            if known:
                continue
            edges += 1
            if uses == 1:
                boundary += 1
                border[vertex], border[ends[at]] = True, True
            nonmanifold += uses > 2
            misoriented += (outward > 1) + (uses - outward > 1)
    return edges, boundary, nonmanifold, misoriented


@kernel
def _duplicates(first: int, last: int, faces: IntArray, starts: IntArray, order: IntArray) -> int:
    count = 0
    for vertex in range(first, last):
        for at in range(starts[vertex], starts[vertex + 1]):
            a, b, c = faces[order[at]]
            middle, high = a + b + c - vertex - max(a, b, c), max(a, b, c)
            for earlier in range(starts[vertex], at):
                d, e, f = faces[order[earlier]]
                if max(d, e, f) == high and d + e + f - vertex - high == middle:
                    count += 1
                    break
    return count


@kernel_part
def _root(parents: IntArray, vertex: int) -> int:
    while parents[vertex] != vertex:
        parents[vertex] = parents[parents[vertex]]
        vertex = parents[vertex]
    return vertex


@kernel
def _joined(faces: IntArray, among: Any, vertex_bound: int) -> IntArray:
    """The lowest vertex of each vertex's piece, by union-find with path halving, the lower index always the root."""
    parents = np.arange(vertex_bound).astype(np.int32)
    for face in range(len(faces)):
        if not among[face]:
            continue
        first = _root(parents, faces[face, 0])
        if parents[faces[face, 1]] == first and parents[faces[face, 2]] == first:
            continue
        for corner in (1, 2):
            second = _root(parents, faces[face, corner])
            if first < second:
                parents[second] = first
            else:
                parents[first] = second
                first = second
    # A parent comes before its child, so one pass leaves everyone below their root.
    for vertex in range(vertex_bound):
        parents[vertex] = parents[parents[vertex]]
    return parents

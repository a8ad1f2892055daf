"""How the triangles of a mesh hang together: edges, borders, faults of orientation, components.

`faces` is (F, 3) int32, vertex indices, throughout. Coordinates play no part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
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


class CompactIndex(NamedTuple):
    """How to leave out the vertices that no face uses.

    kept : (K,) int32, old indices of the vertices that stay, rising: `vertices_mm[kept]`.
    faces : (F, 3) int32, the faces in the new numbering.
    """

    kept: IntArray
    faces: IntArray


def duplicate_face_count(faces: IntArray) -> int:
    """Number of faces whose three vertices, in any order, an earlier face has already."""
    if not len(faces):
        return 0
    faces = np.ascontiguousarray(faces)
    bound = _vertex_bound(faces)
    return sum(in_bands(_duplicates, bound, faces, *_faces_by_lowest_vertex(faces, bound)))


def degenerate_faces(faces: IntArray) -> NDArray[np.bool_]:
    """(F,) bool: a vertex comes twice in the face."""
    a, b, c = faces.T
    return np.asarray((a == b) | (b == c) | (c == a))


def component_sizes(faces: IntArray, among: NDArray[np.bool_]) -> IntArray:
    """(F,) int32: number of faces in the connected piece that each face belongs to, in a mesh of those `among` alone.

    among : (F,) bool. 0 for the others. Faces that share a vertex belong together.
    """
    faces = np.ascontiguousarray(faces)
    return np.asarray(_component_sizes(faces, among, _joined(faces, among, _vertex_bound(faces))))


def topology_counts(faces: IntArray) -> TopologyCounts:
    """All the counts of this module at once."""
    faces = np.ascontiguousarray(faces)
    bound = _vertex_bound(faces)
    border = np.zeros(bound, dtype=np.bool_)
    counted = in_bands(_edge_counts, bound, faces, *_halves_by_lower_vertex(faces, bound), border)
    edges, boundary, nonmanifold, misoriented = (sum(each) for each in zip(*counted, strict=True))
    vertices, components = _used_and_roots(faces, _joined(faces, np.ones(len(faces), dtype=np.bool_), bound))
    return TopologyCounts(
        vertices=vertices,
        edges=edges,
        boundary_edges=boundary,
        boundary_vertices=int(np.count_nonzero(border)),
        nonmanifold_edges=nonmanifold,
        misoriented_edges=misoriented,
        duplicate_faces=duplicate_face_count(faces),
        degenerate_faces=int(degenerate_faces(faces).sum()),
        components=components,
        euler_characteristic=vertices - edges + len(faces),
    )


def compact(faces: IntArray, *, vertex_count: int) -> CompactIndex:
    """How to leave out the vertices that no face uses, keeping the order of the others."""
    faces = np.ascontiguousarray(faces)
    renumbered, kept = _renumbered(faces, vertex_count)
    return CompactIndex(kept, renumbered[faces])


def _vertex_bound(faces: IntArray) -> int:
    return int(faces.max()) + 1 if faces.size else 0


@kernel
def _halves_by_lower_vertex(faces: IntArray, vertex_bound: int) -> tuple[IntArray, IntArray]:
    """Where each vertex's half-edges begin; half-edges, 4 * face + first corner, sorted by the lower of their ends."""
    starts = np.zeros(vertex_bound + 2, dtype=np.int32)
    for face in range(len(faces)):
        for corner in range(3):
            starts[min(faces[face, corner], faces[face, corner + 1 if corner < 2 else 0]) + 2] += 1
    for vertex in range(vertex_bound):
        starts[vertex + 2] += starts[vertex + 1]
    halves = np.zeros(faces.size, dtype=np.int32)
    for face in range(len(faces)):
        for corner in range(3):
            # A vertex's start stands one place to the right until its half-edges have moved it on to its end.
            place = min(faces[face, corner], faces[face, corner + 1 if corner < 2 else 0]) + 1
            halves[starts[place]] = 4 * face + corner
            starts[place] += 1
    return starts, halves


@kernel_part(inline="always")
def _far_end(faces: IntArray, half: int, vertex: int) -> int:
    face, corner = half >> 2, half & 3
    return int(faces[face, corner] + faces[face, corner + 1 if corner < 2 else 0] - vertex)


@kernel
def _edge_counts(
    first: int, last: int, faces: IntArray, starts: IntArray, halves: IntArray, border: Any
) -> tuple[int, int, int, int]:
    """Edges; those of one triangle, marking their ends; those of more than two; directions run along more than once."""
    edges, boundary, nonmanifold, misoriented = 0, 0, 0, 0
    for vertex in range(first, last):
        for at in range(starts[vertex], starts[vertex + 1]):
            other, known, uses, outward = _far_end(faces, halves[at], vertex), False, 0, 0
            for each in range(starts[vertex], starts[vertex + 1]):
                if _far_end(faces, halves[each], vertex) == other:
                    known |= each < at
                    uses += 1
                    outward += faces[halves[each] >> 2, halves[each] & 3] == vertex
            if known:
                continue
            edges += 1
            if uses == 1:
                boundary += 1
                border[vertex], border[other] = True, True
            nonmanifold += uses > 2
            misoriented += (outward > 1) + (uses - outward > 1)
    return edges, boundary, nonmanifold, misoriented


@kernel
def _faces_by_lowest_vertex(faces: IntArray, vertex_bound: int) -> tuple[IntArray, IntArray]:
    """Where the faces of each lowest vertex begin, and the faces in that order."""
    starts = np.zeros(vertex_bound + 2, dtype=np.int32)
    for face in range(len(faces)):
        starts[min(faces[face, 0], faces[face, 1], faces[face, 2]) + 2] += 1
    for vertex in range(vertex_bound):
        starts[vertex + 2] += starts[vertex + 1]
    order = np.zeros(len(faces), dtype=np.int32)
    for face in range(len(faces)):
        # A start stands one place to the right until its faces have moved it on to its end.
        place = min(faces[face, 0], faces[face, 1], faces[face, 2]) + 1
        order[starts[place]] = face
        starts[place] += 1
    return starts, order


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


@kernel
def _used_and_roots(faces: IntArray, roots: IntArray) -> tuple[int, int]:
    """Number of vertices that a face uses, and of those among them that stand for their piece."""
    used = np.zeros(len(roots), dtype=np.bool_)
    for face in range(len(faces)):
        for corner in range(3):
            used[faces[face, corner]] = True
    vertices, pieces = 0, 0
    for vertex in range(len(roots)):
        vertices += used[vertex]
        pieces += used[vertex] and roots[vertex] == vertex
    return vertices, pieces


@kernel
def _renumbered(faces: IntArray, vertex_count: int) -> tuple[IntArray, IntArray]:
    """The new number of each vertex, and the old number of each that stays."""
    used = np.zeros(vertex_count, dtype=np.bool_)
    for face in range(len(faces)):
        for corner in range(3):
            used[faces[face, corner]] = True
    renumbered = np.zeros(vertex_count, dtype=np.int32)
    count = 0
    for vertex in range(vertex_count):
        renumbered[vertex] = count
        count += used[vertex]
    kept = np.zeros(count, dtype=np.int32)
    for vertex in range(vertex_count):
        if used[vertex]:
            kept[renumbered[vertex]] = vertex
    return renumbered, kept


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


@kernel
def _component_sizes(faces: IntArray, among: Any, roots: IntArray) -> IntArray:
    counts = np.zeros(len(roots), dtype=np.int32)
    for face in range(len(faces)):
        if among[face]:
            counts[roots[faces[face, 0]]] += 1
    sizes = np.zeros(len(faces), dtype=np.int32)
    for face in range(len(faces)):
        if among[face]:
            sizes[face] = counts[roots[faces[face, 0]]]
    return sizes

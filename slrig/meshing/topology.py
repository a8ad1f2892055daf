"""Topology of a mesh: adjacency, borders, orientation faults, connected components.

`faces` is (F, 3) int32, vertex indices, throughout. Coordinates play no part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray

_CROWDED, _REPEATED = 1, 2  # fault of a face: at an edge, of a vertex


@kernel
def sort_into_groups(groups: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Offset of each group's first member, (count + 1,) int32, and the members by group, ascending, (n,) int32.

    groups : (n,) int32, the group of each, from 0 to count - 1. A counting sort.
    """
    starts = np.zeros(count + 2, dtype=np.int32)
    for group in groups:
        starts[group + 2] += 1
    for group in range(count):
        starts[group + 2] += starts[group + 1]
    members = np.zeros(len(groups), dtype=np.int32)
    for member in range(len(groups)):
        # A group's start is one place to the right until its members have moved it to its end.
        place = groups[member] + 1
        members[starts[place]] = member
        starts[place] += 1
    return starts[:-1], members


def neighbours(faces: IntArray, *, vertex_count: int) -> IntArray:
    """Adjacency, (F, 3) int32: entry k is the face across the edge opposite corner k, -1 at a boundary.

    Linear in F as long as no vertex has very many triangles. Faces that share only a vertex are not neighbours.

    Raises ValueError: a face has a missing vertex or the same one twice, or two faces run along an edge in the same
    direction, as on every edge of more than two faces.
    """
    faces = np.ascontiguousarray(faces)
    if faces.size and (faces.min() < 0 or faces.max() >= vertex_count):
        message = (
            f"faces name vertices {faces.min()} to {faces.max()}, there are {vertex_count}; "
            "pass the number of points that the faces index"
        )
        raise ValueError(message)
    across = np.full(faces.shape, -1, dtype=np.int32)
    fault = np.zeros(len(faces), dtype=np.uint8)
    in_bands(_neighbours, len(faces), faces, *sort_into_groups(faces.ravel(), vertex_count), across, fault)
    if fault.any():
        face = int(np.flatnonzero(fault)[0])
        named = faces[face].tolist()
        message = (
            f"face {face} {named} uses a vertex twice; remove degenerate faces first"
            if fault[face] == _REPEATED
            else f"face {face} {named} shares an edge with a face that runs along it in the same direction; "
            "remove non-manifold edges, and wind all faces alike"
        )
        raise ValueError(message)
    return across


@kernel(in_every_scan=False)
def _neighbours(first: int, last: int, faces: Any, starts: Any, corners: Any, across: Any, fault: Any) -> None:
    for face in range(first, last):
        for corner in range(3):
            after = corner + 1 if corner < 2 else 0
            # The edge from a to b, opposite the third corner; a neighbour runs from b to a.
            a, b = faces[face, corner], faces[face, after]
            if a == b:
                fault[face] = _REPEATED
            found, alike = -1, 0
            for at in range(starts[b], starts[b + 1]):
                other, origin = corners[at] // 3, corners[at] % 3
                if faces[other, origin + 1 if origin < 2 else 0] == a:
                    alike += found >= 0
                    found = other
                elif faces[other, origin - 1 if origin else 2] == a:
                    # This face itself, or another that runs along the edge in the same direction.
                    alike += other != face
            across[face, after + 1 if after < 2 else 0] = found
            if alike:
                fault[face] = max(fault[face], _CROWDED)


@dataclass(frozen=True, slots=True)
class OpenBorders:
    """Borders of a mesh, longest first: length_mm, area_mm2 (n,) float64; edges : their total number.

    The area is that of the loop's largest projection, |½ Σ p × q| over its edges: exact for a flat hole, and a lower
    limit else. Loops that meet in a vertex count as one.
    """

    edges: int
    length_mm: FloatArray
    area_mm2: FloatArray


def open_borders(points_mm: NDArray[np.floating[Any]], faces: IntArray) -> OpenBorders:
    """Open borders of a mesh: points (n, 3), faces (F, 3). Raises ValueError: not a manifold (see `neighbours`)."""
    face, corner = np.divmod(np.flatnonzero(neighbours(faces, vertex_count=len(points_mm)) < 0), 3)
    if not len(face):
        return OpenBorders(0, np.zeros(0), np.zeros(0))
    begin, end = faces[face, (corner + 1) % 3], faces[face, (corner + 2) % 3]
    # Each edge as a face without area.
    edges = np.column_stack((begin, end, end)).astype(np.int32)
    roots = _component_roots(edges, np.ones(len(edges), dtype=np.bool_), len(points_mm))
    loop = np.unique(roots[begin], return_inverse=True)[1].ravel()
    # Near the origin, to avoid cancellation: the sum over a closed loop does not depend on it.
    points = points_mm.astype(np.float64) - points_mm[begin].mean(axis=0, dtype=np.float64)
    across = np.cross(points[begin], points[end]) / 2
    area = np.linalg.norm(np.stack([np.bincount(loop, across[:, axis]) for axis in range(3)]), axis=0)
    length = np.bincount(loop, np.linalg.norm(points[end] - points[begin], axis=1)).astype(np.float64)
    order = np.argsort(-length, kind="stable")
    return OpenBorders(len(begin), length[order], area[order])


@dataclass(frozen=True, slots=True)
class TopologyCounts:
    """Counts of vertices, edges and components, and of topological faults.

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
    """Number of faces with the same three vertices, in any order, as an earlier face."""
    if not len(faces):
        return 0
    faces = np.ascontiguousarray(faces)
    bound = _vertex_bound(faces)
    a, b, c = faces.T
    lowest = np.minimum(np.minimum(a, b), c)  # a minimum over three columns is slow
    return sum(in_bands(_duplicates, bound, faces, *sort_into_groups(lowest, bound)))


def degenerate_faces(faces: IntArray) -> NDArray[np.bool_]:
    """(F,) bool: faces with a repeated vertex."""
    a, b, c = faces.T
    return np.asarray((a == b) | (b == c) | (c == a))


def component_sizes(faces: IntArray, among: NDArray[np.bool_], *, counted: NDArray[np.bool_] | None = None) -> IntArray:
    """(F,) int32: number of faces in the connected component of each face, in a mesh of those `among` alone.

    among : (F,) bool. 0 for the others. Faces that share a vertex belong together. counted : (F,) bool, count these
    faces of a component only; by default all.
    """
    faces = np.ascontiguousarray(faces)
    piece = _component_roots(faces, among, _vertex_bound(faces))[faces[:, 0]]
    members = piece[among if counted is None else among & counted]
    sizes = np.bincount(members, minlength=_vertex_bound(faces)).astype(np.int32)
    return np.where(among, sizes[piece], np.int32(0))


def topology_counts(faces: IntArray) -> TopologyCounts:
    """Count edges, faults and components of a mesh."""
    faces = np.ascontiguousarray(faces)
    bound = _vertex_bound(faces)
    border = np.zeros(bound, dtype=np.bool_)
    half_edges = sort_into_groups(np.minimum(faces, faces[:, [1, 2, 0]]).ravel(), bound)
    counted = in_bands(_edge_counts, bound, faces, *half_edges, border)
    edges, boundary, nonmanifold, misoriented = (sum(each) for each in zip(*counted, strict=True))
    used = used_vertices(faces, bound)
    vertices = int(np.count_nonzero(used))
    roots = _component_roots(faces, np.ones(len(faces), dtype=np.bool_), bound)
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
    """(vertex_count,) bool: ends of edges with a single triangle."""
    faces = np.ascontiguousarray(faces)
    border = np.zeros(vertex_count, dtype=np.bool_)
    half_edges = sort_into_groups(np.minimum(faces, faces[:, [1, 2, 0]]).ravel(), vertex_count)
    in_bands(_edge_counts, vertex_count, faces, *half_edges, border)
    return border


def used_vertices(faces: IntArray, vertex_count: int) -> NDArray[np.bool_]:
    """(vertex_count,) bool: vertices of at least one face."""
    used = np.zeros(vertex_count, dtype=np.bool_)
    _mark(np.ascontiguousarray(faces), used)
    return used


@kernel
def _mark(faces: IntArray, used: Any) -> None:
    for face in range(len(faces)):
        for corner in range(3):
            used[faces[face, corner]] = True


def select_faces(faces: IntArray, adjacency: IntArray, mask: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Selected faces, mask : (F,) bool, in order, and their neighbours in the new numbering: (K, 3) int32 each."""
    numbers = np.where(mask, np.cumsum(mask, dtype=np.int32) - np.int32(1), np.int32(-1))
    rest = np.zeros((int(np.count_nonzero(mask)), 3), dtype=np.int32)
    across = np.zeros_like(rest)
    given = np.ascontiguousarray(faces), np.ascontiguousarray(adjacency)
    in_bands(_select_faces, len(faces), *given, numbers, rest, across)
    return rest, across


@kernel
def _select_faces(
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
    """Numbers of edges, of those with one triangle (marks their ends), with more than two, and misoriented ones."""
    edges, boundary, nonmanifold, misoriented = 0, 0, 0, 0
    most = 0
    for vertex in range(first, last):
        most = max(most, starts[vertex + 1] - starts[vertex])
    # The other ends of the half-edges at one vertex, read once, and their directions.
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
def _component_roots(faces: IntArray, among: Any, vertex_bound: int) -> IntArray:
    """Lowest vertex of each vertex's component, by union-find with path halving; the lower index is the root."""
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
    # A parent comes before its child, so one pass links each vertex to its root.
    for vertex in range(vertex_bound):
        parents[vertex] = parents[parents[vertex]]
    return parents

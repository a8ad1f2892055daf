"""Global optimisation: against a plain one, against Delaunay, and on meshes small enough to say what comes out."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from slrig.meshing.flips import INDEX, NO_FLIPS, ROUND_LIMIT, EdgeOptimisation, optimise_edges
from slrig.meshing.strips import runs_of_whole_curves, strips
from slrig.meshing.topology import neighbours, topology_counts
from slrig.model import FlipRule, FloatArray, IntArray
from tests.unit.meshing.plain import harmonic_indices
from tests.unit.meshing.test_flips import delaunay, verdict


def all_strips(points: FloatArray, offsets: IntArray) -> IntArray:
    """Strips between each curve and the next."""
    count = len(offsets) - 1
    return strips(points, runs_of_whole_curves(np.stack([np.arange(count - 1), np.arange(1, count)], axis=1), offsets))


def joined(curves: list[FloatArray]) -> tuple[FloatArray, IntArray]:
    """Points and offsets of curves."""
    return np.concatenate(curves), np.concatenate([[0], np.cumsum([len(c) for c in curves])]).astype(np.int32)


def bends_deg(points: FloatArray, faces: IntArray) -> FloatArray:
    """Angle between the normals on both sides of each interior edge."""
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = neighbours(faces, vertex_count=len(points))
    face, corner = np.nonzero(across > np.arange(len(faces))[:, None])
    cosine = (normals[face] * normals[across[face, corner]]).sum(axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def wandering(
    rows: int, columns: int, seed: int, *, across: float = 0.3, depth: float = 0.2
) -> tuple[FloatArray, IntArray]:
    """Curves that stray into one another, more so for larger `across`, and their strips."""
    random = np.random.default_rng(seed)
    curves = [
        np.stack(
            [
                x + random.normal(0, across, rows),
                np.cumsum(random.uniform(0.1, 2, rows)),
                random.normal(0, depth, rows),
            ],
            axis=1,
        )
        for x in range(columns)
    ]
    points, offsets = joined(curves)
    return points, all_strips(points, offsets)


def as_set(faces: IntArray) -> set[tuple[int, ...]]:
    """The faces whatever their order, each beginning with its lowest vertex."""
    return {tuple(np.roll(face, -int(np.argmin(face))).tolist()) for face in faces}


def mean_index(points: FloatArray, faces: IntArray) -> float:
    return float(harmonic_indices(points[faces]).mean())


def plain_wishes(
    points: FloatArray, faces: list[list[int]], face: int, *, constrained: bool
) -> Iterator[tuple[int, int, int, int, int, bool]]:
    """Edges pq of this face that the rule would make fw: the other face, p, q, f, w, and whether fw exists."""
    runs = {(f[k], f[(k + 1) % 3]): i for i, f in enumerate(faces) for k in range(3)}
    for k in range(3):
        f, p, q = (faces[face][(k + s) % 3] for s in range(3))
        other = runs.get((q, p))
        if other is None:
            continue
        w = next(v for v in faces[other] if v not in (p, q))
        quad = points[[p, q, f, w]]
        if verdict(*quad)[0] if constrained else delaunay(quad):
            yield other, p, q, f, w, (f, w) in runs or (w, f) in runs


def plain_turn(
    points: FloatArray, faces: list[list[int]], queue: set[int], *, constrained: bool, must_fall: bool
) -> tuple[int, int, set[int]]:
    """Section 3.3, one turn, changing `faces`: tested, flipped, and what to test in the next turn."""
    indices = harmonic_indices(points[np.array(faces)])
    replaced: set[int] = set()
    again: set[int] = set()
    tested = flipped = 0
    for face in sorted(queue, key=lambda i: (-indices[i], i)):
        if face in replaced:
            continue
        tested += 1
        for other, p, q, f, w, exists in plain_wishes(points, faces, face, constrained=constrained):
            if exists:
                again.add(face)
                continue
            old, new = (mean_index(points, np.array(two)) for two in ([[f, p, q], [w, q, p]], [[f, p, w], [w, q, f]]))
            if must_fall and not new < old:
                continue
            faces[face][faces[face].index(q)] = w
            faces[other][faces[other].index(p)] = f
            flipped += 1
            pair = {face, other}
            across = neighbours(np.array(faces, dtype=np.int32), vertex_count=len(points))
            replaced |= pair
            again |= pair | {int(n) for i in pair for n in across[i] if n >= 0}
            break
    return tested, flipped, again


def plain_optimised(
    points: FloatArray, start: IntArray, *, constrained: bool
) -> tuple[IntArray, list[tuple[int, int]], str]:
    """The method with lists, dictionaries and arc cosines."""
    faces: list[list[int]] = start.tolist()
    queue = {i for i in range(len(faces)) if any(plain_wishes(points, faces, i, constrained=constrained))}
    turns: list[tuple[int, int]] = []
    must_fall = False
    while not turns or turns[-1][1]:
        before = [list(f) for f in faces]
        tested, flipped, again = plain_turn(points, faces, queue, constrained=constrained, must_fall=must_fall)
        if flipped and not must_fall and not mean_index(points, np.array(faces)) < mean_index(points, np.array(before)):
            faces, must_fall = before, True
            tested, flipped, again = plain_turn(points, faces, queue, constrained=constrained, must_fall=True)
        turns.append((tested if turns else len(faces), flipped))
        queue = again
    return np.array(faces, dtype=np.int32), turns, INDEX if must_fall else NO_FLIPS


@pytest.mark.parametrize("rule", FlipRule)
@pytest.mark.parametrize("seed", range(3))
def test_the_course_is_that_of_a_plain_one(seed: int, rule: FlipRule) -> None:
    points, faces = wandering(9, 7, seed)
    wanted, turns, ended_by = plain_optimised(points, faces, constrained=rule is FlipRule.CONSTRAINED)
    found = optimise_edges(points, faces, rule=rule)
    assert found.faces.tolist() == wanted.tolist()
    assert [(turn.tested_triangles, turn.flipped_edges) for turn in found.turns] == turns
    assert found.ended_by == ended_by
    assert sum(turn.flipped_edges for turn in found.turns) > 4
    assert found.harmonic_index_before == pytest.approx(mean_index(points, faces), rel=1e-6)
    assert found.turns[-1].harmonic_index == pytest.approx(mean_index(points, wanted), rel=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_without_a_constraint_a_plane_becomes_its_delaunay_triangulation(seed: int) -> None:
    flat = np.random.default_rng(seed).random((300, 2))
    # Stretched points have the same hull and another triangulation.
    start = Delaunay(flat * [5, 1]).simplices.astype(np.int32)
    wanted = Delaunay(flat).simplices.astype(np.int32)
    points = np.column_stack([flat, np.zeros(300)])
    found = optimise_edges(points, start, rule=FlipRule.DELAUNAY)
    assert as_set(start) != as_set(wanted)
    assert as_set(found.faces) == as_set(wanted)
    assert found.ended_by == NO_FLIPS
    # In a plane γ changes the verdict on some edges: it is another triangulation.
    assert as_set(optimise_edges(points, start).faces) != as_set(wanted)
    assert as_set(optimise_edges(points, start, gamma=math.pi).faces) == as_set(wanted)


def test_figure_5_six_points_of_a_cylinder() -> None:
    around, heights = np.radians([-62, -62, -14, -14, 50, 50]), [0.1, 2.9, 0.0, 2.7, 0.2, 2.6]
    points = np.stack([np.sin(around), heights, -np.cos(around)], axis=1)
    start = all_strips(points, np.array([0, 2, 4, 6], dtype=np.int32))

    def off_radial_deg(faces: IntArray) -> float:
        corners = points[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        radial = corners.mean(axis=1) * [1, 0, 1]
        cosine = abs((normals * radial).sum(axis=1)) / np.linalg.norm(normals, axis=1) / np.linalg.norm(radial, axis=1)
        return float(np.degrees(np.arccos(cosine)).max())

    ours, theirs = optimise_edges(points, start).faces, optimise_edges(points, start, rule=FlipRule.DELAUNAY).faces
    assert as_set(ours) != as_set(theirs)
    # "This mesh not only contains some sharp triangles, but exits a sharp edge": not so with the constraint.
    assert off_radial_deg(ours) < 12 < 70 < off_radial_deg(theirs)
    assert bends_deg(points, ours).max() < 57 < 80 < bends_deg(points, theirs).max()


def test_turns_are_limited() -> None:
    points, faces = wandering(20, 20, 1)
    everything = optimise_edges(points, faces)
    assert len(everything.turns) > 3
    for most in range(3):
        found = optimise_edges(points, faces, max_turns=most)
        assert found.turns == everything.turns[:most]
        assert found.ended_by == ROUND_LIMIT
    assert optimise_edges(points, faces, max_turns=0).faces.tolist() == faces.tolist()


def test_an_optimal_mesh_has_one_turn_without_flips() -> None:
    points, faces = wandering(20, 20, 1, across=0.05, depth=0.05)
    once = optimise_edges(points, faces)
    assert once.ended_by == NO_FLIPS
    again = optimise_edges(points, once.faces)
    assert again.faces.tolist() == once.faces.tolist()
    assert [(t.tested_triangles, t.flipped_edges) for t in again.turns] == [(len(faces), 0)]
    assert again.turns[0].harmonic_index == again.harmonic_index_before == once.turns[-1].harmonic_index
    assert again.ended_by == NO_FLIPS


def spoilt(best: EdgeOptimisation, face: int) -> tuple[IntArray, NDArray[np.bool_]]:
    """The mesh with one edge of this face flipped for the worse, and which two triangles those are."""
    faces = best.faces.copy()
    other = int(best.adjacency[face].max())
    corner = best.adjacency[face].tolist().index(other)
    f, p, q = np.roll(faces[face], -corner)
    w = next(v for v in faces[other] if v not in (p, q))
    faces[face], faces[other] = (f, p, w), (w, q, f)
    return faces, np.isin(np.arange(len(faces)), (face, other))


def test_among_limits_where_flips_begin() -> None:
    points, faces = wandering(20, 20, 1, across=0.05, depth=0.05)
    best = optimise_edges(points, faces)
    worse, here = spoilt(best, 150)
    assert topology_counts(worse).nonmanifold_edges == 0
    repaired = optimise_edges(points, worse, among=here)
    assert as_set(repaired.faces) == as_set(best.faces)
    assert repaired.turns[0].tested_triangles == 2
    elsewhere = ~here
    elsewhere[best.adjacency[here].ravel()] = False
    elsewhere[here] = False
    assert optimise_edges(points, worse, among=elsewhere).faces.tolist() == worse.tolist()


def test_an_edge_that_exists_is_not_made() -> None:
    # Each edge of a tetrahedron has its opposite edge in the mesh already.
    corners = np.array([[0, 0, 0], [9, 0, 0], [0, 1, 0], [3, 1, 5]], dtype=np.float64)
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
    assert optimise_edges(corners, tetrahedron).faces.tolist() == tetrahedron.tolist()
    # Two triangles back to back.
    pillow = np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)
    assert optimise_edges(corners, pillow).faces.tolist() == pillow.tolist()


def test_an_edge_that_exists_beyond_a_pinched_vertex_is_not_made() -> None:
    # Edge 0-1 wants to become 2-3; far from it in the mesh, triangle 4 joins 2 and 3.
    points = np.array([[-3, 0, 0], [3, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 9]], dtype=np.float64)
    quad, beyond = [[2, 0, 1], [3, 1, 0]], [2, 3, 4]
    alone = optimise_edges(points, np.array(quad, dtype=np.int32))
    assert alone.turns[0].flipped_edges == 1
    both = np.array([*quad, beyond], dtype=np.int32)
    assert topology_counts(optimise_edges(points, both).faces).nonmanifold_edges == 0
    assert optimise_edges(points, both).turns[0].flipped_edges == 0
    # Pinched at 2 alone, nothing is in the way.
    elsewhere = np.array([*quad, [2, 5, 4]], dtype=np.int32)
    assert optimise_edges(np.concatenate([points, [[5, 5, 5]]]), elsewhere).turns[0].flipped_edges == 1


def test_flat_triangles_are_flipped_away_and_leave_the_mean_alone() -> None:
    points = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [1, -1, 0]], dtype=np.float64)
    # Corner 2 lies on edge 0-1.
    faces = np.array([[0, 1, 2], [1, 0, 3]], dtype=np.int32)
    found = optimise_edges(points, faces)
    assert found.harmonic_index_before == pytest.approx(8)
    assert as_set(found.faces) == {(0, 3, 2), (1, 2, 3)}
    assert found.turns[-1].harmonic_index == pytest.approx(8)
    only_flat = optimise_edges(np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32))
    assert math.isnan(only_flat.harmonic_index_before)


def test_no_face_is_no_fault() -> None:
    found = optimise_edges(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    assert found.faces.shape == (0, 3)
    assert found.ended_by == NO_FLIPS
    assert math.isnan(found.harmonic_index_before)


def test_what_does_not_fit_is_refused() -> None:
    points, faces = wandering(5, 5, 3)
    with pytest.raises(ValueError, match="among: expected shape"):
        optimise_edges(points, faces, among=np.ones(3, dtype=np.bool_))
    with pytest.raises(ValueError, match="adjacency: expected shape"):
        optimise_edges(points, faces, adjacency=np.zeros((3, 3), dtype=np.int32))
    with pytest.raises(ValueError, match="angle from 0 to π"):
        optimise_edges(points, faces, gamma=4.0)
    with pytest.raises(ValueError, match="same direction"):
        optimise_edges(points, np.concatenate([faces, faces[:1]]))

"""What holds for the boundary of every mesh: torn grids and strips between ragged curves."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from slrig.meshing.boundary import smooth_boundary
from slrig.meshing.strips import neighbouring_curves, runs_of_whole_curves, strips
from slrig.meshing.topology import neighbours, topology_counts
from slrig.model import FloatArray, IntArray
from tests.unit.meshing.plain import boundary_edges, grid_faces

# The first call of a kernel compiles it.
unhurried = settings(deadline=None, max_examples=15)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def torn_grids(draw: st.DrawFn) -> tuple[FloatArray, IntArray]:
    """A grid, shaken or exact, with triangles missing."""
    rows, columns = draw(st.integers(2, 9)), draw(st.integers(2, 9))
    rng = np.random.default_rng(draw(seeds))
    faces = grid_faces(rows, columns)
    y, x = np.divmod(np.arange(rows * columns), columns)
    points = np.stack((x, y, np.zeros(len(x))), axis=1) + rng.normal(0, draw(st.sampled_from((0, 0.2))), (len(x), 3))
    return points, faces[rng.random(len(faces)) >= draw(st.floats(0, 0.6))]


@st.composite
def ragged_strips(draw: st.DrawFn) -> tuple[FloatArray, IntArray]:
    """Curves that begin and end where they like."""
    lengths = draw(st.lists(st.integers(0, 14), min_size=2, max_size=8))
    rng = np.random.default_rng(draw(seeds))
    curves = [
        np.stack((x + rng.normal(0, 0.1, n), rng.integers(0, 4) + np.arange(n) * 0.8, rng.normal(0, 0.3, n)), axis=1)
        for x, n in enumerate(lengths)
    ]
    offsets = np.concatenate(([0], np.cumsum(lengths))).astype(np.int32)
    points = np.concatenate([np.zeros((0, 3)), *curves])
    pairs = neighbouring_curves(np.arange(len(lengths), dtype=np.float64), offsets, widest_step_px=1.0)
    return points, strips(points, runs_of_whole_curves(pairs, offsets))


meshes = torn_grids() | ragged_strips()


def edge_pieces(faces: IntArray, point_count: int) -> int:
    """Pieces of faces that hang together by edges."""
    across = neighbours(faces, vertex_count=point_count)
    face, corner = np.nonzero(across >= 0)
    links = coo_array((np.ones(len(face)), (face, across[face, corner])), shape=(len(faces), len(faces)))
    return int(connected_components(links, directed=False)[0])


def touching_corners(faces: IntArray) -> int:
    """Corners of the boundary beyond the first at each vertex: where boundaries touch in a point."""
    return len(boundary_edges(faces)) - topology_counts(faces).boundary_vertices


def hold_together(faces: IntArray, adjacency: IntArray, point_count: int) -> None:
    found = topology_counts(faces)
    assert found.nonmanifold_edges == found.misoriented_edges == found.duplicate_faces == found.degenerate_faces == 0
    np.testing.assert_array_equal(adjacency, neighbours(faces, vertex_count=point_count))


@unhurried
@given(meshes, st.floats(0.3, 3.0), st.floats(0.0, 6.0), st.integers(0, 9) | st.just(10**6))
def test_smoothing_keeps_what_makes_a_mesh_and_ends(
    mesh: tuple[FloatArray, IntArray], psi: float, allowed: float, rounds: int
) -> None:
    points, faces = mesh
    before = points.copy(), faces.copy()
    result = smooth_boundary(points, faces, np.full(len(points), allowed), psi_rad=psi, max_rounds=rounds)
    hold_together(result.faces, result.adjacency, len(points))
    assert len(result.faces) == len(faces) - result.removed_triangles + result.added.sum()
    assert result.rounds <= rounds
    # What was there keeps its order, and what was added comes last.
    rows = {tuple(face): k for k, face in enumerate(faces.tolist())}
    kept = [rows[tuple(face)] for face in result.faces[~result.added].tolist()]
    assert kept == sorted(kept)
    assert not result.added[: len(kept)].any()
    # No post is cut through, and no two boundaries come to touch.
    assert edge_pieces(result.faces, len(points)) == edge_pieces(faces, len(points))
    assert touching_corners(result.faces) <= touching_corners(faces)
    assert len(boundary_edges(result.faces)) <= len(boundary_edges(faces)) + result.removed_triangles
    corners = points[result.faces[result.added]]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert (sides <= allowed + 1e-9).all()
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    # The smallest angle lies opposite the shortest side: its sine is 2 area / (product of the other two).
    assert (2 * area * sides.min(axis=1, initial=np.inf) / sides.prod(axis=1) >= math.sin(math.radians(9.99))).all()
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(faces, before[1])

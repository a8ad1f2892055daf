"""What holds for every tetrahedron, every pair of curves and every surface of curves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from slrig.meshing.flips import NO_FLIPS, optimise_edges, prefers_flip
from slrig.meshing.strips import neighbouring_curves, runs_of_whole_curves, strips
from slrig.meshing.topology import neighbours, topology_counts
from slrig.model import FlipRule, FloatArray, IntArray
from tests.unit.meshing.plain import boundary_edges

# The first call of a kernel compiles it.
unhurried = settings(deadline=None, max_examples=40)
seeds = st.integers(0, 2**32 - 1)
# A lattice makes squares, collinear and coincident points common.
lattice = arrays.arrays(np.float64, (4, 3), elements=st.integers(-2, 2).map(float))
anywhere = arrays.arrays(np.float64, (4, 3), elements=st.floats(-1e3, 1e3))
counts = st.lists(st.integers(0, 12), min_size=1, max_size=7)


@unhurried
@given(lattice | anywhere)
def test_an_edge_never_flips_there_and_back(points: FloatArray) -> None:
    assert not (prefers_flip(points, 0, 1, 2, 3) and prefers_flip(points, 2, 3, 0, 1))


@unhurried
@given(lattice.filter(lambda points: len(np.unique(points, axis=0)) == 4))
def test_the_verdict_does_not_depend_on_names(points: FloatArray) -> None:
    wanted = prefers_flip(points, 0, 1, 2, 3)
    assert prefers_flip(points, 1, 0, 2, 3) == wanted
    assert prefers_flip(points, 0, 1, 3, 2) == wanted


def surface(lengths: list[int], seed: int) -> tuple[FloatArray, IntArray]:
    """Wandering curves of these lengths, left to right."""
    rng = np.random.default_rng(seed)
    curves = [
        np.stack([x + rng.normal(0, 0.3, n), np.cumsum(rng.uniform(0.1, 2, n)), rng.normal(0, 0.5, n)], axis=1)
        for x, n in enumerate(lengths)
    ]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return np.concatenate([np.zeros((0, 3)), *curves]), offsets


@unhurried
@given(counts, seeds, st.sampled_from(FlipRule), st.floats(0.5, 1))
def test_optimisation_keeps_what_makes_a_surface(lengths: list[int], seed: int, rule: FlipRule, share: float) -> None:
    points, offsets = surface(lengths, seed)
    pairs = neighbouring_curves(np.arange(len(lengths), dtype=np.float64), offsets, widest_step_px=1.0)
    everything = strips(points, runs_of_whole_curves(pairs, offsets))
    # What is left has holes and pinched vertices.
    faces = everything[np.random.default_rng(seed).random(len(everything)) < share]
    found = optimise_edges(points, faces, rule=rule)
    before, after = topology_counts(faces), topology_counts(found.faces)
    assert after.nonmanifold_edges == after.misoriented_edges == after.duplicate_faces == after.degenerate_faces == 0
    assert (after.vertices, after.edges, after.euler_characteristic) == (
        before.vertices, before.edges, before.euler_characteristic,
    )  # fmt: skip
    assert sorted(boundary_edges(found.faces).tolist()) == sorted(boundary_edges(faces).tolist())
    np.testing.assert_array_equal(found.adjacency, neighbours(found.faces, vertex_count=len(points)))
    course = [found.harmonic_index_before, *(turn.harmonic_index for turn in found.turns if turn.flipped_edges)]
    assert all(later < earlier for earlier, later in pairwise(course))
    assert found.turns[0].tested_triangles == len(faces)
    # What it ends with is the end.
    if found.ended_by == NO_FLIPS:
        assert optimise_edges(points, found.faces, rule=rule).faces.tolist() == found.faces.tolist()

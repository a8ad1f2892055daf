"""Which parts of curves are joined where some curves are there only in parts."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing.strips import (
    neighbouring_curves,
    runs_of_curve_parts,
    runs_of_whole_curves,
    strip_neighbours,
    strips,
)
from slrig.meshing.topology import neighbours
from slrig.model import FloatArray, IntArray


def parts(*along: list[float], widest_step_px: float = 2.0, widest_gap_px: float = 3.0) -> list[list[int]]:
    """The runs of curves at 0, 1, 2, ... with points at these places."""
    offsets = np.concatenate([[0], np.cumsum([len(each) for each in along])]).astype(np.int32)
    runs: list[list[int]] = runs_of_curve_parts(
        np.arange(len(along), dtype=np.float64), offsets, np.concatenate([np.array(each, float) for each in along]),
        widest_step_px=widest_step_px, widest_gap_px=widest_gap_px,
    ).tolist()  # fmt: skip
    return runs


def test_where_a_curve_ends_its_neighbours_are_joined() -> None:
    places = [float(k) for k in range(6)]
    # The one in the middle is there from 0 to 2: beyond, the others meet, from the points that its strips end in.
    assert parts(places, places[:3], places) == [[0, 2, 6, 8], [2, 5, 11, 14], [6, 8, 9, 11]]
    # And not if they are too far apart: the rest of each is a fan about its last point.
    assert parts(places, places[:3], places, widest_step_px=1.0) == [[0, 5, 6, 8], [6, 8, 9, 14]]


def test_curves_without_neighbours_have_no_runs() -> None:
    assert parts([0.0, 1.0, 2.0]) == []
    assert parts([0.0, 4.0, 8.0], [0.0, 4.0, 8.0]) == []


def test_a_gap_in_a_curve_is_closed_by_its_neighbours() -> None:
    places = [float(k) for k in range(10)]
    torn = [0.0, 1.0, 2.0, 7.0, 8.0, 9.0]
    runs = parts(places, torn, places)
    assert [2, 7, 18, 23] in runs
    assert len(runs) == 5
    assert parts(places, torn, places, widest_gap_px=6.0) == [[0, 9, 10, 15], [10, 15, 16, 25]]


def test_between_two_parts_beside_it_each_has_half_of_a_curve() -> None:
    places = [float(k) for k in range(11)]
    torn = [0.0, 1.0, 2.0, 8.0, 9.0, 10.0]
    assert parts(places, torn, widest_step_px=1.0) == [[0, 5, 11, 13], [5, 10, 14, 16]]
    assert parts(torn, places, widest_step_px=1.0) == [[0, 2, 6, 11], [3, 5, 11, 16]]


def test_curves_without_gaps_are_joined_to_their_ends() -> None:
    rng = np.random.default_rng(4)
    first, last = rng.integers(0, 8, 30), rng.integers(12, 30, 30)
    along = [np.arange(a, b, dtype=np.float64) for a, b in zip(first, last, strict=True)]
    offsets = np.concatenate([[0], np.cumsum(last - first)]).astype(np.int32)
    whole = runs_of_whole_curves(neighbouring_curves(np.arange(30.0), offsets, widest_step_px=1.0), offsets)
    assert parts(*(each.tolist() for each in along), widest_step_px=1.0) == whole.tolist()


def torn_curves(seed: int) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Points, offsets, positions and places of curves with gaps, some sparse, some empty, some with places swapped."""
    rng = np.random.default_rng(seed)
    position = np.cumsum(rng.integers(1, 3, 14)).astype(np.float64)
    along = []
    for _ in position:
        place = np.cumsum(rng.choice([0.0, 0.4, 1.0, 9.0], 60, p=[0.05, 0.4, 0.5, 0.05])) + rng.normal(0, 0.2, 60)
        kept = rng.random(60) < rng.choice([0.0, 0.1, 0.5, 1.0])
        along.append(np.sort(place)[kept] + (rng.random(kept.sum()) < 0.05))
    offsets = np.concatenate([[0], np.cumsum([len(each) for each in along])]).astype(np.int32)
    curve = np.repeat(position, np.diff(offsets))
    places = np.concatenate(along)
    return np.stack([curve, places, rng.normal(0, 0.1, len(places))], axis=1), offsets, position, places


@pytest.mark.parametrize("seed", range(20))
def test_strips_are_a_manifold_whatever_the_curves(seed: int) -> None:
    points, offsets, position, along = torn_curves(seed)
    runs = runs_of_curve_parts(position, offsets, along, widest_step_px=4.0, widest_gap_px=2.0)
    assert (runs[:, 0] <= runs[:, 1]).all()
    assert (runs[:, 2] <= runs[:, 3]).all()
    curve = np.searchsorted(offsets, np.arange(len(points)), side="right") - 1
    assert (curve[runs[:, 0]] == curve[runs[:, 1]]).all()
    assert (curve[runs[:, 2]] == curve[runs[:, 3]]).all()
    assert (position[curve[runs[:, 2]]] - position[curve[runs[:, 0]]] <= 4.0).all()
    faces = strips(points, runs)
    assert len(faces) > 0
    # It refuses what is no manifold, and knows each neighbour by looking for it.
    np.testing.assert_array_equal(
        strip_neighbours(faces, runs, len(points)), neighbours(faces, vertex_count=len(points))
    )

"""Strips of triangles between neighbouring curves, and the triangles that do not belong to the surface."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.meshing.strips import faces_to_drop, neighbouring_curves, runs_of_whole_curves, strip_neighbours, strips
from slrig.meshing.topology import neighbours
from slrig.model import FloatArray, IntArray
from tests.unit.meshing.test_flips import verdict


def curve(x: float, heights: FloatArray, *, depth: float = 0.0) -> FloatArray:
    return np.stack([np.full(len(heights), x), heights, np.full(len(heights), depth)], axis=1)


def offsets_of(*curves: FloatArray) -> IntArray:
    return np.concatenate([[0], np.cumsum([len(each) for each in curves])]).astype(np.int32)


def between(*curves: FloatArray) -> IntArray:
    """Strips between each curve and the next."""
    pairs = np.stack([np.arange(len(curves) - 1), np.arange(1, len(curves))], axis=1).astype(np.int32)
    return strips(np.concatenate(curves), runs_of_whole_curves(pairs, offsets_of(*curves)))


def wandering(seed: int, x: float, count: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.stack(
        [x + rng.normal(0, 0.2, count), np.cumsum(rng.uniform(0.2, 1.5, count)), rng.normal(0, 0.4, count)], axis=1
    )


def walked(first: FloatArray, second: FloatArray) -> list[tuple[int, int, int]]:
    """Section 3.2: of the two triangles on the current edge, that which the flip rule keeps."""
    points = np.concatenate([first, second])
    i, j = 0, len(first)
    triangles = []
    while i < len(first) - 1 or j < len(points) - 1:
        if i == len(first) - 1:
            first_moves = False
        elif j == len(points) - 1:
            first_moves = True
        else:
            # The quadrilateral's diagonals are (i, j + 1) and (i + 1, j); the second is taken when it is better.
            first_moves, _, _ = verdict(points[i], points[j + 1], points[j], points[i + 1])
        triangles.append((i, i + 1, j) if first_moves else (i, j + 1, j))
        i, j = (i + 1, j) if first_moves else (i, j + 1)
    return triangles


@pytest.mark.parametrize("seed", range(8))
def test_the_walk_is_that_of_the_paper(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = wandering(seed, 0.0, int(rng.integers(1, 60))), wandering(seed + 50, 1.0, int(rng.integers(1, 60)))
    assert [tuple(face) for face in between(first, second).tolist()] == walked(first, second)


def test_triangles_are_counter_clockwise_in_an_image_with_curves_running_down() -> None:
    # x to the right, y down, seen from the front: counter-clockwise is a negative area there.
    heights = np.arange(6.0)
    faces = between(curve(0.0, heights), curve(1.0, heights), curve(2.5, heights[1:4]))
    points = np.concatenate([curve(0.0, heights), curve(1.0, heights), curve(2.5, heights[1:4])])[faces]
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    assert (normal[:, 2] < 0).all()
    assert (normal[:, :2] == 0).all()


def test_no_pairs_give_no_triangles() -> None:
    none = runs_of_whole_curves(np.zeros((0, 2), dtype=np.int32), np.zeros(1, dtype=np.int32))
    assert strips(np.zeros((0, 3)), none).shape == (0, 3)
    assert strips(curve(0.0, np.arange(4.0)), none).shape == (0, 3)


def pairs_of(position_px: list[float], counts: list[int], *, widest_step_px: float = 1.0) -> list[list[int]]:
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    pairs: list[list[int]] = neighbouring_curves(np.array(position_px), offsets, widest_step_px=widest_step_px).tolist()
    return pairs


@pytest.mark.parametrize(
    ("position_px", "counts", "widest_step_px", "pairs"),
    [
        ([3.0, 4.0, 5.0, 7.0, 8.0], [5] * 5, 1.0, [[0, 1], [1, 2], [3, 4]]),
        ([3.0, 4.0, 6.0, 9.0], [5] * 4, 2.0, [[0, 1], [1, 2]]),
        # An empty curve has no neighbours and may be stepped over.
        ([3.0, 4.0, 5.0], [5, 0, 5], 1.0, []),
        ([3.0, 4.0, 5.0], [5, 0, 5], 2.0, [[0, 2]]),
        ([], [], 1.0, []),
        ([3.0], [9], 1.0, []),
    ],
)
def test_neighbours_are_consecutive_codes(
    position_px: list[float], counts: list[int], widest_step_px: float, pairs: list[list[int]]
) -> None:
    assert pairs_of(position_px, counts, widest_step_px=widest_step_px) == pairs


def test_a_step_that_is_a_third_of_a_pixel_is_not_lost_to_rounding() -> None:
    assert len(pairs_of([k / 3 for k in range(100)], [2] * 100, widest_step_px=1 / 3)) == 99


def dropped(
    points: FloatArray, faces: IntArray, *, bridge_after: NDArray[np.bool_] | None = None, keep_holes: bool = False,
    sampling: FloatArray | None = None, ratio: float = 6.0,
) -> tuple[list[bool], list[bool], list[bool]]:  # fmt: skip
    none = np.zeros(len(points), dtype=np.bool_)
    spacing = np.ones(len(points)) if sampling is None else sampling
    depth_edge, bridge = faces_to_drop(
        points, faces, none if bridge_after is None else bridge_after, spacing,
        depth_edge_ratio=ratio, keep_holes=keep_holes,
    )  # fmt: skip
    return depth_edge.tolist(), bridge.tolist(), (depth_edge | bridge).tolist()


TRIANGLES = np.array([[0, 1, 2], [0, 3, 4]], dtype=np.int32)


def test_a_triangle_with_a_long_edge_crosses_a_depth_edge() -> None:
    # Longest edges 5 and 7, whichever of the three it is.
    for turn in range(3):
        points = np.array([[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 0, 7], [0, 1, 0]])
        faces = np.roll(TRIANGLES, turn, axis=1)
        assert dropped(points, faces) == ([False, True], [False, False], [False, True])
        assert dropped(points, faces, ratio=4.9)[0] == [True, True]
        assert dropped(points, faces, ratio=7.1)[0] == [False, False]


def test_an_edge_across_is_no_step_over_a_bridge() -> None:
    # The bridge after point 2 is to point 3; edges of 2 to other points do not use it.
    points = np.concatenate([curve(0.0, np.arange(4.0)), curve(1.0, np.arange(4.0))])
    bridge = np.zeros(8, dtype=np.bool_)
    bridge[2] = True
    faces = np.array([[1, 2, 5], [2, 6, 5], [2, 3, 6]], dtype=np.int32)
    assert dropped(points, faces, bridge_after=bridge, keep_holes=True)[1] == [False, False, True]


@pytest.mark.parametrize("seed", range(4))
def test_strips_know_their_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    curves = [wandering(seed + k, float(k), int(rng.integers(1, 30))) for k in range(9)]
    points, offsets = np.concatenate(curves), offsets_of(*curves)
    position = np.cumsum(rng.integers(1, 3, 9)).astype(np.float64)
    for widest in (1.0, 2.0):
        pairs = neighbouring_curves(position, offsets, widest_step_px=widest)
        runs = runs_of_whole_curves(pairs, offsets)
        faces = strips(points, runs)
        found = strip_neighbours(faces, runs, len(points))
        assert found.dtype == np.int32
        np.testing.assert_array_equal(found, neighbours(faces, vertex_count=len(points)))


@pytest.mark.parametrize("keep_holes", [False, True])
def test_drops_agree_with_plain_numpy(*, keep_holes: bool) -> None:
    rng = np.random.default_rng(4)
    curves = [wandering(k, float(k), 40) for k in range(12)]
    points, faces = np.concatenate(curves), between(*curves)
    points[rng.random(len(points)) < 0.02] = np.nan
    sampling, bridge = rng.uniform(0.5, 2, len(points)), np.asarray(rng.random(len(points)) < 0.2)
    corners, after = points[faces], np.roll(faces, -1, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    far = ~(longest <= 1.2 * sampling[faces].mean(axis=1))
    over = ((abs(faces - after) == 1) & bridge[np.minimum(faces, after)]).any(axis=1) & keep_holes
    found = dropped(points, faces, bridge_after=bridge, keep_holes=keep_holes, sampling=sampling, ratio=1.2)
    assert found == (far.tolist(), over.tolist(), (far | over).tolist())
    assert 0.05 < far.mean() < 0.95

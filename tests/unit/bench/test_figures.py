"""Folds of a mesh are counted by geometry alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.bench.peers.figures import fold_count


def two_triangles(bend_deg: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """An edge along x, one triangle in the plane, the other bent by `bend_deg` out of it."""
    bend = np.radians(bend_deg)
    return np.array([(0, 0, 0), (2, 0, 0), (0.5, 1, 0), (1.5, -np.cos(bend), np.sin(bend))])


@pytest.mark.parametrize(("bend_deg", "folds"), [(0.0, 0), (59.0, 0), (-59.0, 0), (61.0, 1), (-61.0, 1), (179.0, 1)])
@pytest.mark.parametrize("other", [(1, 0, 3), (0, 1, 3)], ids=["same winding", "opposite winding"])
def test_an_edge_is_a_fold_when_it_bends_by_more_than_60_degrees(
    bend_deg: float, folds: int, other: tuple[int, int, int]
) -> None:
    assert fold_count(two_triangles(bend_deg), np.array([(0, 1, 2), other], dtype=np.int32)) == folds


def test_an_edge_of_three_triangles_is_not_a_fold() -> None:
    vertices = np.concatenate((two_triangles(90.0), [(1.0, 0.0, -1.0)]))
    faces = np.array([(0, 1, 2), (1, 0, 3), (0, 1, 4)], dtype=np.int32)
    assert fold_count(vertices, faces) == 0

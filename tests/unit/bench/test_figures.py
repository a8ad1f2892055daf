"""Folds are counted by geometry alone, and phases are charged to the right account."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.bench.peers.figures import fold_count
from tests.bench.peers.measuring import Phase


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


TAKES_MEMORY = """
import json
import numpy as np
from tests.bench.peers.measuring import Meter, Phase, measured

def run(meter: Meter) -> int:
    meter.enter(Phase.POINTS)
    points = np.ones(64 * 2**20, dtype=np.uint8)
    count = len(points)
    del points
    meter.enter(Phase.MESH)
    return count

count, cost = measured(run, compiles=True)
print(json.dumps([count, cost.warm_runs, sorted(cost.warm_s), cost.peak_mb]))
"""


def test_memory_is_charged_to_the_phase_that_took_it() -> None:
    taken_mb = 64
    # In a process of its own, as the methods have: this one gives back what other tests took, at any moment.
    told = subprocess.run(  # noqa: S603 - our own interpreter and text
        [sys.executable, "-c", TAKES_MEMORY], cwd=Path(__file__).parents[3], capture_output=True, text=True, check=True
    )
    count, warm_runs, phases, peak_mb = json.loads(told.stdout)
    assert count == taken_mb * 2**20
    assert warm_runs >= 1
    assert phases == sorted([Phase.POINTS, Phase.MESH])
    assert 0.9 * taken_mb < peak_mb[Phase.POINTS] < 1.5 * taken_mb
    assert peak_mb[Phase.MESH] < 0.5 * taken_mb

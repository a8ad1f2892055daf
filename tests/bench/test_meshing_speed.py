"""How fast curves become an optimised mesh. Run by name: `pytest tests/bench/test_meshing_speed.py -s`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numba
import numpy as np
import pytest

from slrig.meshing.initial import initial_mesh
from slrig.meshing.normals import vertex_normals
from slrig.meshing.optimisation import Optimised, optimised
from slrig.meshing.runs import whole_curves
from slrig.meshing.strips import strip_neighbours, strips
from slrig.meshing.topology import topology_counts
from slrig.model import FloatArray, IntArray
from tests.unit.meshing.plain import smallest_angles_deg
from tests.unit.meshing.test_optimisation import face_curves, joined, mean_index, uneven

_RUNS = 11
_GOAL_POINTS_PER_S = 2e6
_STEP_MM = 0.36


class Scan(NamedTuple):
    """Curves of one scan: points (n, 3) float64 mm, offsets (c + 1,) int32, the step along curves in mm."""

    points_mm: FloatArray
    offsets: IntArray
    step_mm: float

    @property
    def runs(self) -> IntArray:
        """(c - 1, 4) int32: each curve and the next."""
        first = np.arange(len(self.offsets) - 2, dtype=np.int32)
        return whole_curves(np.stack([first, first + 1], axis=1), self.offsets)


def _median_s(work: Callable[[], object]) -> float:
    """Warm: the first run, which compiles, does not count."""
    work()
    times = []
    for _ in range(_RUNS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def _local_and_global(scan: Scan) -> Optimised:
    """The paper's sections 3.2 and 3.3."""
    faces = strips(scan.points_mm, scan.runs)
    return optimised(scan.points_mm, faces, adjacency=strip_neighbours(faces, scan.runs, len(scan.points_mm)))


def _grid_mesh(scan: Scan) -> IntArray:
    """The honest rival: numpy, a grid of (stripe, row), two triangles to each cell with four points.

    It needs rows that are aligned, as they are here but for noise: a point's row is its height over the step. Where a
    point is missing it leaves a hole of four cells; compare the numbers of triangles.
    """
    stripe = np.repeat(np.arange(len(scan.offsets) - 1), np.diff(scan.offsets))
    row = np.rint(scan.points_mm[:, 1] / scan.step_mm).astype(np.int64)
    row -= row.min()
    cells = np.full((len(scan.offsets) - 1, int(row.max()) + 1), -1, dtype=np.int32)
    cells[stripe, row] = np.arange(len(row), dtype=np.int32)
    a, b, c, d = cells[:-1, :-1], cells[:-1, 1:], cells[1:, 1:], cells[1:, :-1]
    full = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    a, b, c, d = a[full], b[full], c[full], d[full]
    p = scan.points_mm
    shorter = ((p[a] - p[c]) ** 2).sum(axis=1) <= ((p[b] - p[d]) ** 2).sum(axis=1)
    first = np.where(shorter[:, None], np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(shorter[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return np.concatenate([first, second])


def _show(line: str) -> None:
    sys.stdout.write(line + "\n")


@pytest.fixture(scope="module")
def scans() -> dict[str, Scan]:
    curves = face_curves(271, step_mm=_STEP_MM)
    return {
        "dense": Scan(*joined(curves), _STEP_MM),
        "uneven 35-80 %": Scan(*joined(uneven(curves)), _STEP_MM),
        "dense x 4": Scan(*joined(face_curves(542, step_mm=_STEP_MM / 2, noise_mm=0.01)), _STEP_MM / 2),
    }


def test_strips_and_global_optimisation(scans: dict[str, Scan]) -> None:
    _show(f"\n{numba.get_num_threads()} threads, medians of {_RUNS} warm runs; grid: its time over ours")
    _show(
        "scan           method             points      ms  M points/s  triangles  angle 5 %   index  flips turns  grid"
    )
    for name, scan in scans.items():
        ours_s, rival_s = _median_s(partial(_local_and_global, scan)), _median_s(partial(_grid_mesh, scan))
        found, rival = _local_and_global(scan), _grid_mesh(scan)
        flips = sum(turn.flipped_edges for turn in found.turns)
        for method, took_s, faces, course in (
            ("strips + global", ours_s, found.faces, f"{flips:6} {len(found.turns):5} {rival_s / ours_s:5.2f}"),
            ("grid", rival_s, rival, f"{'-':>6} {'-':>5}"),
        ):
            count = len(scan.points_mm)
            angle_deg = np.percentile(smallest_angles_deg(scan.points_mm[faces]), 5)
            _show(
                f"{name:14} {method:15} {count:9} {took_s * 1e3:7.1f} {count / took_s / 1e6:11.2f} {len(faces):10} "
                f"{angle_deg:10.1f} {mean_index(scan.points_mm, faces):7.3f} {course}"
            )
        assert topology_counts(found.faces).nonmanifold_edges == 0
        if name == "dense":
            assert len(scan.points_mm) >= 100_000
            assert len(scan.points_mm) / ours_s >= _GOAL_POINTS_PER_S


def test_stages(scans: dict[str, Scan]) -> None:
    _show("\nms             strips  adjacency  global  initial_mesh  normals")
    for name, scan in scans.items():
        points, offsets, runs = scan.points_mm, scan.offsets, scan.runs
        faces = strips(points, runs)
        across = strip_neighbours(faces, runs, len(points))
        whole = partial(
            initial_mesh, points, offsets, np.arange(len(offsets) - 1.0), np.zeros(len(points), dtype=np.bool_),
            np.ones(len(points)), np.zeros(3), widest_step_px=1.0, depth_edge_ratio=60.0, keep_holes=False,
        )  # fmt: skip
        times_ms = [
            1e3 * _median_s(work)
            for work in (
                partial(strips, points, runs),
                partial(strip_neighbours, faces, runs, len(points)),
                partial(optimised, points, faces, adjacency=across),
                whole,
                partial(vertex_normals, points, faces),
            )
        ]
        _show("{:14} {:6.1f} {:10.1f} {:7.1f} {:13.1f} {:8.1f}".format(name, *times_ms))
        # The drop, dust and orientation cost little beside what they follow.
        assert times_ms[3] < 10 * (times_ms[0] + times_ms[1])

"""Figures of meshes that can be worked out on paper."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slrig.meshing.quality import mesh_figures
from slrig.model import FloatArray, IntArray
from tests.unit.meshing.plain import harmonic_indices, smallest_angles_deg


def lattice(rows: int, columns: int) -> tuple[FloatArray, IntArray]:
    """Equilateral triangles of side 1 mm."""
    row, column = (index.ravel() for index in np.mgrid[:rows, :columns])
    vertices = np.stack((column + row / 2, row * math.sqrt(3) / 2, np.zeros(rows * columns)), axis=1)
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    return vertices, np.concatenate((np.stack((a, b, c), 1), np.stack((b, d, c), 1)))


def test_equilateral_triangles_have_the_least_harmonic_index() -> None:
    vertices, faces = lattice(6, 9)
    figures = mesh_figures(vertices.astype(np.float32), faces)
    assert figures["triangles"] == 2 * 5 * 8
    assert figures["vertices"] == 54
    assert figures["boundary_points"] == 2 * (5 + 8)
    assert figures["components"] == figures["euler_characteristic"] == 1
    assert figures["harmonic_index_mean"] == pytest.approx(4 * math.sqrt(3), rel=1e-5)
    assert figures["min_angle_p1_deg"] == pytest.approx(60, abs=1e-3)
    assert figures["min_angle_p50_deg"] == pytest.approx(60, abs=1e-3)
    assert figures["area_mm2"] == pytest.approx(80 * math.sqrt(3) / 4, rel=1e-5)
    assert figures["sliver_fraction_below_10deg"] == figures["degenerate_faces"] == 0


def test_harmonic_index_is_four_times_the_sum_of_cotangents() -> None:
    corners = np.random.default_rng(0).normal(size=(50, 3, 3))
    angles = []
    for i in range(3):
        u, v = corners[:, (i + 1) % 3] - corners[:, i], corners[:, (i + 2) % 3] - corners[:, i]
        cosines = (u * v).sum(1) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
        angles.append(np.arccos(cosines))
    expected = 4 * sum(1 / np.tan(angle) for angle in angles)
    assert harmonic_indices(corners) == pytest.approx(expected)
    assert smallest_angles_deg(corners) == pytest.approx(np.degrees(np.min(angles, axis=0)))


def test_a_flat_triangle_is_degenerate_and_left_out_of_the_mean_index() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], dtype=np.float64)
    figures = mesh_figures(vertices, np.array([[0, 1, 2], [0, 1, 3], [2, 2, 1]], dtype=np.int32))
    assert figures["degenerate_faces"] == 2
    assert figures["harmonic_index_mean"] == pytest.approx(4 * (0 + 1 + 1))
    assert figures["sliver_fraction_below_10deg"] == pytest.approx(2 / 3)
    assert figures["min_angle_p5_deg"] == pytest.approx(45)


def test_angles_are_weighted_by_area() -> None:
    # One right triangle of legs 10 mm (45°), and ten small ones with a smallest angle of atan(1/10).
    big = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0]], dtype=np.float64)
    small = np.array([[0, 0, 1], [1, 0, 1], [0, 0.1, 1]], dtype=np.float64)
    vertices = np.concatenate((big, *(small + np.array((2.0 * i, 0, 0)) for i in range(10))))
    figures = mesh_figures(vertices, np.arange(33, dtype=np.int32).reshape(-1, 3))
    assert figures["min_angle_p5_deg"] == pytest.approx(45)
    assert figures["sliver_fraction_below_10deg"] == pytest.approx(10 / 11)
    assert figures["components"] == 11


def test_no_triangle_has_no_shape() -> None:
    figures = mesh_figures(np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32))
    assert figures["triangles"] == figures["boundary_points"] == figures["components"] == 0
    assert math.isnan(figures["harmonic_index_mean"])
    assert math.isnan(figures["min_angle_p50_deg"])

"""Scores of meshes whose error against the truth is known beforehand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.meshing.normals import vertex_normals
from slrig.meshing.quality import TruthScore, score
from slrig.model import FloatArray, IntArray, Mesh, Surface

HALF_MM = 50.0
CELLS = 200
EYE_MM = np.array([20.0, -10.0, -400.0])


def grid(heights_mm: FloatArray) -> Mesh:
    """The square |x|, |y| ≤ 50 mm at the heights (CELLS + 1, CELLS + 1) given, its front towards negative z."""
    side = np.linspace(-HALF_MM, HALF_MM, CELLS + 1)
    x, y = np.meshgrid(side, side)
    vertices = np.stack((x, y, heights_mm), axis=2).reshape(-1, 3).astype(np.float32)
    index = np.arange((CELLS + 1) ** 2, dtype=np.int32).reshape(CELLS + 1, CELLS + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    faces = np.stack((np.stack((a, c, b), 1), np.stack((b, c, d), 1)), axis=1).reshape(-1, 3)
    return mesh_of(vertices, faces)


def mesh_of(vertices: NDArray[np.floating[Any]], faces: IntArray, sigma_mm: float = 0.05) -> Mesh:
    count = len(vertices)
    return Mesh(
        vertices_mm=np.asarray(vertices, dtype=np.float32),
        faces=faces,
        normals=vertex_normals(vertices, faces),
        colour=np.zeros((count, 3), dtype=np.uint8),
        mark=np.zeros(count, dtype=np.uint8),
        sigma_mm=np.full(count, sigma_mm, dtype=np.float32),
        stripe=np.zeros(count, dtype=np.int32),
    )


def flat(height_mm: float = 0.0) -> Mesh:
    return grid(np.full((CELLS + 1, CELLS + 1), height_mm))


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in meshes)])
    faces = [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=False)]
    return mesh_of(np.concatenate([mesh.vertices_mm for mesh in meshes]), np.concatenate(faces))


def part(mesh: Mesh, *, beyond_x_mm: float) -> Mesh:
    """The cells of a grid whose middle lies beyond x."""
    cells = mesh.vertices_mm[mesh.faces].reshape(-1, 6, 3).mean(axis=1)[:, 0] > beyond_x_mm
    return mesh_of(mesh.vertices_mm, mesh.faces.reshape(-1, 2, 3)[cells].reshape(-1, 3))


def scored(mesh: Mesh) -> TruthScore:
    """Against the plane z = 0, two large triangles that reach far beyond, seen at 40 000 random points."""
    far = 2 * HALF_MM
    corners = np.array([[-far, -far, 0], [far, -far, 0], [-far, far, 0], [far, far, 0]], dtype=np.float64)
    truth = Surface(corners, np.array([[0, 2, 1], [1, 2, 3]], dtype=np.int32))
    points = np.random.default_rng(7).uniform(-HALF_MM + 1, HALF_MM - 1, (40_000, 3)) * (1, 1, 0)
    return score(mesh, truth, points, EYE_MM)


def test_the_truth_itself_is_without_error() -> None:
    found = scored(flat())
    assert found.rms_mm == found.p99_mm == found.gross_fraction == found.false_area_05mm == 0
    assert found.complete_01mm == found.complete_03mm == found.facing_camera_fraction == 1
    assert found.extra_layer_fraction == 0
    assert found.nonmanifold_edges == found.misoriented_edges == found.duplicate_faces == found.degenerate_faces == 0


@pytest.mark.parametrize("shift_mm", [0.07, -0.2, 0.4])
def test_a_shifted_plane_is_off_by_the_shift_everywhere(shift_mm: float) -> None:
    found = scored(flat(shift_mm))
    for figure in (found.rms_mm, found.p50_mm, found.p95_mm, found.p99_mm):
        assert figure == pytest.approx(abs(shift_mm), rel=1e-6)
    assert found.complete_01mm == (abs(shift_mm) < 0.1)
    assert found.complete_03mm == (abs(shift_mm) < 0.3)
    assert found.error_over_sigma_p68 == pytest.approx(abs(shift_mm) / 0.05, rel=1e-5)


def test_noise_of_the_stated_deviation() -> None:
    sigma_mm = 0.05
    heights = np.random.default_rng(0).normal(0, sigma_mm, (CELLS + 1, CELLS + 1))
    found = scored(grid(heights))
    # Independent errors σ at the corners, mixed by barycentric weights: the mean of λ₁² + λ₂² + λ₃² over a triangle
    # is ½, so the error over the area is σ/√2.
    assert found.rms_mm == pytest.approx(sigma_mm / math.sqrt(2), rel=0.02)
    # At the vertices it is σ, of which the 68.27th percentile of the absolute value is the definition.
    assert found.error_over_sigma_p68 == pytest.approx(1, rel=0.02)
    assert found.complete_03mm == 1


def test_a_hole_costs_completeness_in_proportion_and_nothing_else() -> None:
    found = scored(part(flat(), beyond_x_mm=-20.0))
    expected = (49 + 20) / 98
    assert found.complete_01mm == pytest.approx(expected, abs=0.01)
    assert found.complete_03mm == pytest.approx(expected, abs=0.01)
    assert found.rms_mm == found.gross_fraction == 0


def test_a_sheet_in_front_hides_what_is_behind_it() -> None:
    sheet = part(flat(-3.0), beyond_x_mm=25.0)
    found = scored(joined(flat(), sheet))
    # The eye sees the sheet's edge x = 25 at z = -3 before the plane at 25 + (25 - 20) · 3/397.
    hidden = (49 - 25.04) / 98
    assert found.complete_03mm == pytest.approx(1 - hidden, abs=0.01)
    assert found.extra_layer_fraction == pytest.approx(hidden, abs=0.01)
    assert found.gross_fraction == pytest.approx(0.25 / 1.25, abs=1e-3)
    assert found.rms_mm == 0


def test_a_sheet_behind_hides_nothing_and_is_still_false_area() -> None:
    found = scored(joined(flat(), part(flat(0.7), beyond_x_mm=25.0)))
    assert found.complete_01mm == 1
    assert found.gross_fraction == 0
    assert found.false_area_05mm == pytest.approx(0.25 / 1.25, abs=1e-3)
    assert found.rms_mm == pytest.approx(0.7 * math.sqrt(0.2), rel=1e-2)


def test_extra_vertices_do_not_dilute_errors() -> None:
    # One large wrong triangle weighs as much as its area, whatever fine mesh is added where the error is nil.
    wrong = mesh_of(np.array([[-50, -50, 0.6], [50, -50, 0.6], [-50, 50, 0.6]]), np.array([[0, 2, 1]], dtype=np.int32))
    found = scored(joined(flat(), wrong))
    assert found.false_area_05mm == pytest.approx(1 / 3, abs=1e-3)


def test_faults_of_topology_are_counted_after_welding() -> None:
    mesh = flat()
    doubled = mesh_of(
        mesh.vertices_mm[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3)
    )
    found = scored(doubled)
    assert found.nonmanifold_edges == found.misoriented_edges == found.duplicate_faces == 0
    faces = np.concatenate((mesh.faces, mesh.faces[:3], [[5, 5, 6]])).astype(np.int32)
    faces[1000] = faces[1000, ::-1]
    spoilt = scored(mesh_of(mesh.vertices_mm, faces))
    assert spoilt.duplicate_faces == 3
    assert spoilt.degenerate_faces == 1
    # Copies 0, 1, 2 share two edges among them: 9 directed edges come twice; the turned triangle adds its own three.
    assert spoilt.misoriented_edges == 9 + 3
    # Of their 7 undirected edges 3 lie on the border, where the copy makes two triangles: no more than allowed.
    assert spoilt.nonmanifold_edges == 7 - 3


def test_a_mesh_turned_inside_out_faces_away() -> None:
    mesh = flat()
    assert scored(replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1]))).facing_camera_fraction == 0


def test_a_mesh_without_stated_uncertainty_has_no_ratio() -> None:
    mesh = flat(0.1)
    unstated = replace(mesh, sigma_mm=np.full(len(mesh.vertices_mm), np.nan, dtype=np.float32))
    assert math.isnan(scored(unstated).error_over_sigma_p68)


def test_a_mesh_without_triangles_covers_nothing() -> None:
    found = scored(mesh_of(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)))
    assert found.complete_01mm == found.complete_03mm == 0
    assert all(map(math.isnan, (found.rms_mm, found.p50_mm, found.gross_fraction, found.false_area_05mm)))


def test_the_same_mesh_scores_the_same_twice_under_the_names_of_the_report() -> None:
    mesh = grid(np.random.default_rng(1).normal(0, 0.1, (CELLS + 1, CELLS + 1)))
    first = scored(mesh).as_dict()
    assert first == scored(mesh).as_dict()
    assert {"rms_mm", "false_area_0.5mm", "complete_0.1mm", "complete_0.3mm", "facing_camera_area"} <= first.keys()

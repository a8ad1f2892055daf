"""Figures of meshes that can be worked out on paper, and their scores where the error against the truth is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from slrig.meshing.quality import TruthScore, mesh_figures, score, weighted_percentiles
from slrig.meshing.topology import open_borders
from slrig.model import FloatArray, Mesh, Surface
from tests.core import parametrize_core
from tests.unit.meshing.plain import grid_faces, joined, mesh_of, soup


def test_equilateral_triangles_have_the_least_harmonic_index() -> None:
    row, column = (index.ravel() for index in np.mgrid[:6, :9])
    vertices, faces = np.stack((column + row / 2, row * math.sqrt(3) / 2, 0 * row), axis=1), grid_faces(6, 9)
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


def test_weighted_percentiles_are_those_of_all_values_sorted() -> None:
    random = np.random.default_rng(6)
    values, weights = random.gamma(2.0, size=9000), random.random(9000)
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    percents = (0.0, 1.0, 5.0, 50.0, 99.9, 100.0)
    at = np.searchsorted(cumulated, np.array(percents[:-1]) / 100 * cumulated[-1])
    assert weighted_percentiles(values, weights, percents)[:-1] == values[order][at].tolist()
    assert weighted_percentiles(values, weights, percents)[-1] == pytest.approx(values.max(), rel=1e-2)
    assert weighted_percentiles(np.full(5, 3.0), np.ones(5), (50.0,)) == [3.0]
    assert np.isnan(weighted_percentiles(values, np.zeros(9000), (50.0,))).all()


def test_figures_of_any_triangles_are_those_of_plain_numpy() -> None:
    points, faces = soup(7)
    figures = mesh_figures(points, faces)
    sides = points[faces] - points[np.roll(faces, 1, axis=1)]
    twice = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    angles = [np.arctan2(twice, -(sides[:, k] * sides[:, (k + 1) % 3]).sum(axis=1)) for k in range(3)]
    assert figures["area_mm2"] == pytest.approx(twice.sum() / 2)
    assert figures["harmonic_index_mean"] == pytest.approx(((sides**2).sum(axis=(1, 2)) / (twice / 2)).mean())
    slivers = np.degrees(np.min(angles, axis=0)) < 10
    assert figures["sliver_fraction_below_10deg"] == pytest.approx(slivers.mean())


HALF_MM = 50.0
CELLS = 100
SIGMA_MM = 0.05
EYE_MM = np.array([20.0, -10.0, -400.0])


def grid(heights_mm: FloatArray) -> Mesh:
    """The square |x|, |y| ≤ 50 mm at the heights (CELLS + 1, CELLS + 1) given, its front towards negative z."""
    side = np.linspace(-HALF_MM, HALF_MM, CELLS + 1)
    vertices = np.stack((*np.meshgrid(side, side), heights_mm), axis=2).reshape(-1, 3)
    # Two triangles of a cell follow one another.
    faces = grid_faces(CELLS + 1, CELLS + 1)[:, ::-1].reshape(2, -1, 3).swapaxes(0, 1).reshape(-1, 3)
    return mesh_of(vertices, np.ascontiguousarray(faces), sigma_mm=SIGMA_MM)


def flat(height_mm: float = 0.0) -> Mesh:
    return grid(np.full((CELLS + 1, CELLS + 1), height_mm))


def part(mesh: Mesh, *, beyond_x_mm: float) -> Mesh:
    """The cells of a grid whose middle lies beyond x."""
    cells = mesh.vertices_mm[mesh.faces].reshape(-1, 6, 3).mean(axis=1)[:, 0] > beyond_x_mm
    return mesh_of(mesh.vertices_mm, mesh.faces.reshape(-1, 2, 3)[cells].reshape(-1, 3))


def scored(mesh: Mesh) -> TruthScore:
    """Against the plane z = 0, two large triangles that reach far beyond, seen at 10 000 random points."""
    far = 2 * HALF_MM
    corners = np.array([[-far, -far, 0], [far, -far, 0], [-far, far, 0], [far, far, 0]], dtype=np.float64)
    truth = Surface(corners, np.array([[0, 2, 1], [1, 2, 3]], dtype=np.int32))
    points = np.random.default_rng(7).uniform(-HALF_MM + 1, HALF_MM - 1, (10_000, 3)) * (1, 1, 0)
    return score(mesh, truth, points, EYE_MM)


def test_the_truth_itself_is_without_error() -> None:
    found = scored(flat())
    assert found.rms_mm == found.p99_mm == found.gross_fraction == found.false_area_05mm == 0
    assert found.complete_01mm == found.complete_03mm == found.facing_camera_fraction == 1
    assert found.extra_layer_fraction == 0
    assert found.nonmanifold_edges == found.misoriented_edges == found.duplicate_faces == found.degenerate_faces == 0


@parametrize_core("shift_mm", [0.07, -0.2, 0.4])
def test_a_shifted_plane_is_off_by_the_shift_everywhere(shift_mm: float) -> None:
    found = scored(flat(shift_mm))
    for figure in (found.rms_mm, found.p50_mm, found.p95_mm, found.p99_mm):
        assert figure == pytest.approx(abs(shift_mm), rel=1e-6)
    assert found.complete_01mm == (abs(shift_mm) < 0.1)
    assert found.complete_03mm == (abs(shift_mm) < 0.3)
    assert found.error_over_sigma_p68 == pytest.approx(abs(shift_mm) / SIGMA_MM, rel=1e-5)


def test_noise_of_the_stated_deviation() -> None:
    heights = np.random.default_rng(0).normal(0, SIGMA_MM, (CELLS + 1, CELLS + 1))
    found = scored(grid(heights))
    # Independent errors σ at the corners, mixed by barycentric weights: the mean of λ₁² + λ₂² + λ₃² over a triangle
    # is ½, so the error over the area is σ/√2.
    assert found.rms_mm == pytest.approx(SIGMA_MM / math.sqrt(2), rel=0.02)
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


def test_faults_of_topology_are_counted_after_welding() -> None:
    mesh = flat()
    doubled = mesh_of(
        mesh.vertices_mm[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3)
    )
    found = scored(doubled)
    assert found.nonmanifold_edges == found.misoriented_edges == found.duplicate_faces == 0
    faces = np.concatenate((mesh.faces, mesh.faces[:3], [[5, 5, 6]])).astype(np.int32)
    faces[1100] = faces[1100, ::-1]
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


def test_a_mesh_may_face_any_of_the_cameras() -> None:
    mesh = flat()
    turned = replace(mesh, faces=np.where(mesh.faces[:, :1] % 2 == 0, mesh.faces, mesh.faces[:, ::-1]))
    truth = Surface(mesh.vertices_mm.astype(np.float64), mesh.faces)
    assert score(turned, truth, np.zeros((1, 3)), EYE_MM).facing_camera_fraction == pytest.approx(0.5, abs=0.02)
    assert score(turned, truth, np.zeros((1, 3)), EYE_MM, -EYE_MM).facing_camera_fraction == 1


def test_a_mesh_without_stated_uncertainty_has_no_ratio() -> None:
    mesh = flat(0.1)
    unstated = replace(mesh, sigma_mm=np.full(len(mesh.vertices_mm), np.nan, dtype=np.float32))
    assert math.isnan(scored(unstated).error_over_sigma_p68)


def test_a_mesh_without_triangles_covers_nothing() -> None:
    found = scored(mesh_of(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)))
    assert found.complete_01mm == found.complete_03mm == 0
    assert all(map(math.isnan, (found.rms_mm, found.p50_mm, found.gross_fraction, found.false_area_05mm)))


def test_each_open_border_has_its_length_and_area_far_from_the_origin() -> None:
    box = trimesh.creation.box()
    closed = open_borders(np.asarray(box.vertices), np.asarray(box.faces, np.int32))
    assert (closed.edges, len(closed.length_mm), len(closed.area_mm2)) == (0, 0, 0)
    tube = trimesh.creation.cylinder(5.0, 20.0, sections=64)
    side = np.abs(np.asarray(tube.face_normals)[:, 2]) < 0.5
    square = trimesh.creation.box((3.0, 7.0, 1.0))
    square.apply_translation((40, 0, 0))
    lid = np.asarray(square.face_normals)[:, 2] < 0.5
    faces = np.concatenate([tube.faces[side], square.faces[lid] + len(tube.vertices)]).astype(np.int32)
    points = np.concatenate([tube.vertices, square.vertices]) + np.array((1000.0, -2000.0, 500.0))
    borders = open_borders(points.astype(np.float32), faces)
    around, disc = 2 * 64 * 5 * np.sin(np.pi / 64), 32 * 25 * np.sin(2 * np.pi / 64)
    assert borders.edges == 64 + 64 + 4
    assert borders.length_mm == pytest.approx([around, around, 20.0], rel=1e-4)
    assert borders.area_mm2 == pytest.approx([disc, disc, 21.0], rel=1e-4)

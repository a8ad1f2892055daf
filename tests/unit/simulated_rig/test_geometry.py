"""Depth, silhouettes, shadows, normals and projector coordinates of known shapes, from formulas written out here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from simulated_rig import shapes
from simulated_rig.device import SimulatedHead
from simulated_rig.scene import build_surface, read_scene
from slrig.model import FloatArray, IntArray
from slrig.scan.formats import encode_mesh_glb
from tests.core import parametrize_core
from tests.unit.scan.test_mesh_formats import half_ball
from tests.unit.simulated_rig.building import FACING_PLATE, small_head

STRAIGHT = {"position_mm": [0.0, 0.0, -500.0], "target_mm": [0.0, 0.0, 0.0]}


def depth_of(head: SimulatedHead, camera: str = "eye") -> FloatArray:
    return head.truth().cameras[camera].depth_mm


def test_depth_of_a_facing_plate_is_its_distance_everywhere(tmp_path: Path) -> None:
    head = small_head(tmp_path, camera=STRAIGHT | {"distortion": [-0.2, 0.1, 0.001, -0.002, 0.0]})
    np.testing.assert_allclose(depth_of(head), 500.0, atol=1e-9)


def test_depth_of_a_tilted_plate_follows_the_plane_equation(tmp_path: Path) -> None:
    scene = FACING_PLATE + "rotation_deg = [20.0, 0.0, 0.0]\nposition_mm = [0.0, 0.0, 10.0]\n"
    head = small_head(tmp_path, scene, camera=STRAIGHT | {"principal_px": [30.0, 20.0]})
    # Turned by 20° about x, the plate's normal is (0, sin 20°, -cos 20°) up to sign: z = 10 + y tan 20°.
    y_over_z = (np.arange(48) - 20.0) / 400.0
    slope = np.tan(np.deg2rad(20.0))
    depth = 510.0 / (1 - slope * y_over_z)
    np.testing.assert_allclose(depth_of(head), np.broadcast_to(depth[:, None], (48, 64)), atol=1e-7)


def test_a_ball_has_the_exact_depth_and_silhouette_of_a_sphere(tmp_path: Path) -> None:
    camera = STRAIGHT | {"size_px": [200, 200], "focal_px": [1000.0, 1000.0]}
    head = small_head(tmp_path, '[[object]]\nshape = "sphere"\nradius_mm = 30.0\n', camera=camera)
    depth = depth_of(head)
    # The rim is seen under the angle asin(30/500), not atan(30/500).
    radius_px = 1000.0 * 30.0 / np.sqrt(500.0**2 - 30.0**2)
    assert np.sqrt(np.isfinite(depth).sum() / np.pi) == pytest.approx(radius_px, abs=0.05)
    x, y = np.meshgrid((np.arange(200) - 99.5) / 1000, (np.arange(200) - 99.5) / 1000)
    a = 1 + x**2 + y**2
    inside = 500.0**2 - a * (500.0**2 - 30.0**2)
    expected = (500.0 - np.sqrt(np.where(inside > 0, inside, np.nan))) / a
    seen = np.isfinite(depth) & (inside > 1)
    assert seen.sum() > 11000
    np.testing.assert_allclose(depth[seen], expected[seen], atol=1e-8)


def test_projector_coordinates_agree_with_opencv_for_every_visible_point(tmp_path: Path) -> None:
    scene = '[[object]]\nshape = "sphere"\nradius_mm = 30.0\n' + FACING_PLATE + "position_mm = [0.0, 0.0, 40.0]\n"
    head = small_head(tmp_path, scene, projector={"distortion": [-0.2, 0.1, 0.001, -0.002, 0.05]})
    truth, lens = head.truth().cameras["eye"], head.exact_calibration.projector
    assert lens is not None
    rotation, _ = cv2.Rodrigues(lens.rotation)
    pixels, _ = cv2.projectPoints(truth.visible_points_mm, rotation, lens.translation_mm, lens.matrix, lens.distortion)
    found = truth.projector_px[np.isfinite(truth.projector_px[..., 0])]
    assert len(found) == len(truth.visible_points_mm) > 1000
    np.testing.assert_allclose(found, np.asarray(pixels).reshape(-1, 2), atol=1e-8)


def test_visible_points_lie_on_the_surface_and_within_the_projector_image(tmp_path: Path) -> None:
    head = small_head(tmp_path, '[[object]]\nshape = "sphere"\nradius_mm = 30.0\n')
    truth = head.truth().cameras["eye"]
    np.testing.assert_allclose(np.linalg.norm(truth.visible_points_mm, axis=1), 30.0, atol=1e-9)
    lit = truth.projector_px[np.isfinite(truth.projector_px[..., 0])]
    assert lit.min() >= -0.5
    assert lit[:, 0].max() <= 79.5
    assert lit[:, 1].max() <= 59.5


def test_a_ball_throws_its_shadow_where_the_tangents_meet_the_plate(tmp_path: Path) -> None:
    scene = '[[object]]\nshape = "sphere"\nradius_mm = 10.0\nposition_mm = [0.0, 0.0, -60.0]\n' + FACING_PLATE
    wide = {"size_px": [512, 129], "focal_px": [1600.0, 1600.0], "position_mm": [-150.0, 0.0, -500.0]}
    head = small_head(
        tmp_path, scene, camera=wide, projector={"position_mm": [100.0, 0.0, -500.0], "focal_px": [200.0, 200.0]}
    )
    truth = head.truth().cameras["eye"]
    # In the plane y = 0, as an angle from the plate's normal at the lamp: the ball's centre, and the tangents.
    centre, half = np.arctan2(100.0, 440.0), np.arcsin(10.0 / np.hypot(100.0, 440.0))
    edges = 100.0 - 500.0 * np.tan(np.array([centre + half, centre - half]))
    camera = head.exact_calibration.cameras["eye"]
    row = 64
    pixel_ray = np.column_stack([(np.arange(512) - 255.5) / 1600, np.zeros(512), np.ones(512)])
    points = (pixel_ray * truth.depth_mm[row][:, None] - camera.translation_mm) @ camera.rotation
    dark = np.isnan(truth.projector_px[row, :, 0]) & (np.abs(points[:, 2]) < 1e-6)
    assert points[dark, 0].min() == pytest.approx(edges[0], abs=0.4)
    assert points[dark, 0].max() == pytest.approx(edges[1], abs=0.4)
    assert np.diff(np.flatnonzero(dark)).max() == 1


def test_stairs_rise_step_by_step_towards_the_devices(tmp_path: Path) -> None:
    scene = '[[object]]\nshape = "stairs"\nsteps = 4\ntread_mm = 15.0\nrise_mm = 5.0\nheight_mm = 60.0\n'
    head = small_head(tmp_path, scene, camera=STRAIGHT)
    depth = depth_of(head)[24]
    levels = np.unique(depth[np.isfinite(depth)].round(6))
    for level in (507.5, 502.5, 497.5, 492.5):
        assert np.isclose(levels, level).any()
    middle = depth[np.isfinite(depth)]
    assert (np.diff(middle) < 1e-9).all()


def test_a_ball_bar_has_its_balls_at_the_given_distance(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        '[[object]]\nshape = "ball_bar"\nradius_mm = 10.0\ndistance_mm = 50.0\nbar_radius_mm = 2.0\n'
        "rotation_deg = [0.0, 0.0, 90.0]\nposition_mm = [1.0, 2.0, 3.0]\n"
    )
    surface = build_surface(read_scene(tmp_path / "s.toml"), tmp_path)
    np.testing.assert_allclose(surface.sphere_mm[0], [1, -23, 3, 10], atol=1e-12)
    np.testing.assert_allclose(surface.sphere_mm[1], [1, 27, 3, 10], atol=1e-12)
    bar = surface.vertices_mm[surface.faces[surface.part == 2]].reshape(-1, 3)
    np.testing.assert_allclose(np.hypot(bar[:, 0] - 1, bar[:, 2] - 3), 2.0, atol=1e-12)


def test_a_relief_has_the_height_of_its_formula(tmp_path: Path) -> None:
    scene = """
    [[object]]
    shape = "relief"
    size_mm = [60.0, 50.0]
    step_mm = 0.25
    wave = [{ amplitude_mm = 3.0, wavelength_mm = 40.0, direction_deg = 90.0, phase_deg = 30.0 }]
    bump = [{ centre_mm = [5.0, -4.0], height_mm = 8.0, sigma_mm = 12.0 }]
    """
    head = small_head(tmp_path, scene)
    points = head.truth().cameras["eye"].visible_points_mm
    x, y, z = points.T
    hill = 8.0 * np.exp(-((x - 5) ** 2 + (y + 4) ** 2) / (2 * 144))
    height = 3.0 * np.sin(2 * np.pi * y / 40.0 + np.pi / 6) + hill
    assert len(points) > 1000
    np.testing.assert_allclose(-z, height, atol=0.002)


def test_a_turned_vessel_passes_through_its_profile_and_is_fluted(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        '[[object]]\nshape = "turned"\nprofile_mm = [[20.0, -30.0], [30.0, 0.0], [15.0, 30.0]]\n'
        "flutes = 6\nflute_depth_mm = 1.0\n"
    )
    vertices = build_surface(read_scene(tmp_path / "s.toml"), tmp_path).vertices_mm
    for radius, height in ((20.0, -30.0), (30.0, 0.0), (15.0, 30.0)):
        ring = vertices[np.isclose(vertices[:, 1], -height)]
        spread = np.hypot(ring[:, 0], ring[:, 2])
        assert spread.max() == pytest.approx(radius + 1.0, abs=0.02)
        assert spread.min() == pytest.approx(radius - 1.0, abs=0.02)


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "glb"])
def test_a_mesh_file_stands_in_its_pose_and_unit(tmp_path: Path, suffix: str) -> None:
    trimesh.creation.box(extents=(2.0, 4.0, 6.0)).export(tmp_path / f"box.{suffix}")
    scene = f'[[object]]\nshape = "mesh"\nfile = "box.{suffix}"\nunit_mm = 10.0\nposition_mm = [0.0, 0.0, 7.0]\n'
    scene += "rotation_deg = [90.0, 0.0, 0.0]\n"
    head = small_head(tmp_path, scene, camera=STRAIGHT)
    # Turned about x, the 40 mm side points along z: its face lies at 7 - 20.
    assert depth_of(head)[24, 32] == pytest.approx(487.0, abs=1e-4)
    extent = np.ptp(head.truth().surface.vertices_mm, axis=0)
    np.testing.assert_allclose(extent, [20, 60, 40], atol=1e-4)


def test_a_scan_s_own_glb_can_be_put_back_where_it_was_scanned(tmp_path: Path) -> None:
    mesh = half_ball()
    (tmp_path / "scan.glb").write_bytes(encode_mesh_glb(mesh))
    scene = '[[object]]\nshape = "mesh"\nfile = "scan.glb"\nunit_mm = 1000.0\nrotation_deg = [180.0, 0.0, 0.0]\n'
    (tmp_path / "s.toml").write_text(scene)
    surface = build_surface(read_scene(tmp_path / "s.toml"), tmp_path)
    wanted = mesh.vertices_mm[mesh.faces]
    np.testing.assert_allclose(surface.vertices_mm[surface.faces], wanted, rtol=0, atol=1e-4)


SHAPES = {
    "plane": "size_mm = [50.0, 40.0]",
    "sphere": "radius_mm = 20.0",
    "stairs": "steps = 3\ntread_mm = 15.0\nrise_mm = 5.0\nheight_mm = 40.0",
    "relief": "size_mm = [60.0, 40.0]\nbump = [{ centre_mm = [0.0, 0.0], height_mm = 10.0, sigma_mm = 9.0 }]",
    "turned": "profile_mm = [[20.0, -30.0], [30.0, 0.0], [15.0, 30.0]]",
    "ball_bar": "radius_mm = 10.0\ndistance_mm = 40.0\nbar_radius_mm = 3.0",
}


@parametrize_core("shape", SHAPES, core=[0, 5])
def test_triangles_run_counter_clockwise_seen_from_the_devices(tmp_path: Path, shape: str) -> None:
    head = small_head(tmp_path, f'[[object]]\nshape = "{shape}"\n{SHAPES[shape]}\n', camera=STRAIGHT)
    surface = head.truth().surface
    a, b, c = surface.vertices_mm[surface.faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    assert (np.linalg.norm(normal, axis=1) > 0).all()
    view = head._views["eye"]
    hit = view._scene.rays.first_hit(np.array([0.0, 0, -500]), _directions_to(a + (b - a + c - a) / 3))
    first = hit == np.arange(len(hit))
    assert first.sum() >= 2
    assert (normal[first] @ np.array([0.0, 0, 1]) < 1e-9).mean() > 0.97
    towards = (a - np.array([0.0, 0, -500]))[first]
    assert ((normal[first] * towards).sum(axis=1) < 1e-9).all()


def _directions_to(points: FloatArray) -> FloatArray:
    towards = points - np.array([0.0, 0, -500])
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


@pytest.mark.slow
def test_facets_of_a_ball_stay_within_the_stated_error(tmp_path: Path) -> None:
    for radius in (3.0, 20.0, 60.0):
        (tmp_path / "s.toml").write_text(f'[[object]]\nshape = "sphere"\nradius_mm = {radius}\n')
        surface = build_surface(read_scene(tmp_path / "s.toml"), tmp_path)
        middle = surface.vertices_mm[surface.faces].mean(axis=1)
        assert (radius - np.linalg.norm(middle, axis=1)).max() < 0.003


def folded(angle_deg: float) -> tuple[FloatArray, IntArray]:
    """Two unequal triangles that share an edge and bend by an angle."""
    turn = np.deg2rad(angle_deg)
    far = (3 * np.cos(turn), 0.5, 3 * np.sin(turn))
    vertices = np.array([(0, 0, 0), (0, 1, 0), (-1, 0.5, 0), far], np.float64)
    return vertices, np.array([(0, 1, 2), (1, 0, 3)], np.int32)


@pytest.mark.parametrize(("angle_deg", "smooth"), [(20.0, True), (40.0, False)])
def test_normals_are_shared_up_to_the_crease_angle(angle_deg: float, smooth: bool) -> None:
    vertices, faces = folded(angle_deg)
    part = shapes._smooth_part(vertices, faces, crease_rad=np.deg2rad(30.0))
    shared = part.corner_normals[0, 0], part.corner_normals[1, 1]
    assert np.allclose(*shared) is smooth
    if not smooth:
        for face in range(2):
            np.testing.assert_allclose(part.corner_normals[face], part.corner_normals[face, [0, 0, 0]], atol=1e-12)


def test_a_box_file_keeps_flat_faces(tmp_path: Path) -> None:
    """Faces of very different area: the mean normal at a corner leans close to the largest of them."""
    trimesh.creation.box(extents=(100.0, 80.0, 4.0)).export(tmp_path / "box.ply")
    part = shapes.mesh_file(tmp_path / "box.ply", 1.0, crease_rad=np.deg2rad(30.0))
    assert np.isin(np.abs(part.corner_normals).round(12), (0.0, 1.0)).all()


def test_a_fine_ball_file_is_shaded_like_a_ball(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=4, radius=10.0).export(tmp_path / "ball.stl")
    part = shapes.mesh_file(tmp_path / "ball.stl", 1.0, crease_rad=np.deg2rad(30.0))
    radial = part.vertices_mm[part.faces] / 10.0
    assert (part.corner_normals * radial).sum(axis=2).min() > np.cos(np.deg2rad(0.5))


def test_corner_normal_kernel_equals_plain_python() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=10.0)
    vertices, faces = np.asarray(ball.vertices, np.float64) * (1, 0.5, 2), np.asarray(ball.faces, np.int32)
    part = shapes._smooth_part(vertices, faces, crease_rad=0.5)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    weighted = np.cross(b - a, c - a)
    unit = weighted / np.linalg.norm(weighted, axis=1, keepdims=True)
    for face in range(len(faces)):
        for corner in range(3):
            near = (faces == faces[face, corner]).any(axis=1) & (unit @ unit[face] >= np.cos(0.5))
            mean = weighted[near].sum(axis=0)
            np.testing.assert_allclose(part.corner_normals[face, corner], mean / np.linalg.norm(mean), atol=1e-12)
    assert (np.abs(part.corner_normals - unit[:, None]).max(axis=(1, 2)) > 0.01).mean() > 0

"""Shading and sampling: Lambert, inverse square, the lobe, textures, and the ray casters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from simulated_rig import transport
from simulated_rig.optics import lens_array, world_directions
from simulated_rig.transport import EMBREE, EmbreeCaster, Hits, RayCaster, TreeCaster, texture_value
from slrig.model import FloatArray, IntArray
from tests.unit.simulated_rig.building import FACING_PLATE, small_head

LAMP = np.array([60.0, 0, -500])
EYE = np.array([-60.0, 0, -500])


def traced(folder: Path, scene: str, u: FloatArray, v: FloatArray) -> Hits:
    view = small_head(folder, scene)._views["eye"]
    stage = view._scene
    return transport.trace_rays(
        u, v, view._camera, stage.projector, stage.surface, stage.rays, working_distance_mm=stage.working_distance_mm
    )


U, V = (a.ravel().astype(np.float64) for a in np.meshgrid(np.arange(0, 64, 7), np.arange(0, 48, 5)))


def test_a_diffuse_plate_is_lit_by_cosine_and_inverse_square(tmp_path: Path) -> None:
    hits = traced(tmp_path, FACING_PLATE, U, V)
    distance = np.linalg.norm(hits.points_mm - LAMP, axis=1)
    working = np.hypot(60.0, 500.0)
    expected = 0.8 * (500.0 / distance) * (working / distance) ** 2
    np.testing.assert_allclose(hits.weight, expected, rtol=1e-6)
    np.testing.assert_allclose(hits.albedo, 0.8, rtol=1e-6)


def test_the_lobe_is_brightest_in_the_mirror_direction(tmp_path: Path) -> None:
    glossy = FACING_PLATE + "specular = { strength = 0.5, exponent = 30.0 }\n"
    hits, dull = traced(tmp_path, glossy, U, V), traced(tmp_path, FACING_PLATE, U, V)
    to_point = hits.points_mm - LAMP
    distance = np.linalg.norm(to_point, axis=1)
    light, back = to_point / distance[:, None], EYE - hits.points_mm
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    mirrored = light * np.array([1.0, 1, -1])
    lobe = 0.5 * np.clip((mirrored * back).sum(axis=1), 0, None) ** 30
    expected = lobe * (np.hypot(60.0, 500.0) / distance) ** 2
    np.testing.assert_allclose(hits.weight - dull.weight, expected, atol=2e-6)
    # Lamp and eye are mirror images about x = 0, so the highlight is where the plate meets that plane.
    assert abs(hits.points_mm[expected.argmax(), 0]) < 6


def test_a_surface_turned_away_from_the_lamp_is_dark(tmp_path: Path) -> None:
    scene = '[[object]]\nshape = "plane"\nsize_mm = [80.0, 80.0]\nrotation_deg = [0.0, 85.0, 0.0]\n'
    hits = traced(tmp_path, scene, np.array([31.5]), np.array([23.5]))
    facing_eye = small_head(tmp_path, scene).truth().cameras["eye"].depth_mm
    assert np.isfinite(facing_eye).any()
    assert hits.is_hit.all() != hits.is_lit.any()


def test_a_checker_alternates_squares_in_the_object_own_frame(tmp_path: Path) -> None:
    scene = FACING_PLATE + (
        "texture = { kind = 'checker', contrast = 0.5, scale_mm = 10.0 }\n"
        "position_mm = [3.0, 4.0, 0.0]\nrotation_deg = [0.0, 0.0, 30.0]\n"
    )
    hits = traced(tmp_path, scene, U, V)
    x, y = hits.points_mm[:, 0] - 3, hits.points_mm[:, 1] - 4
    turn = np.deg2rad(30.0)
    own_x, own_y = x * np.cos(turn) + y * np.sin(turn), -x * np.sin(turn) + y * np.cos(turn)
    dark = (np.floor(own_x / 10) + np.floor(own_y / 10)) % 2 == 1
    assert 0.2 < dark.mean() < 0.8
    np.testing.assert_allclose(hits.albedo, np.where(dark, 0.4, 0.8), rtol=1e-6)


def test_noise_texture_is_smooth_bounded_and_equal_to_plain_python() -> None:
    positions = np.random.default_rng(8).uniform(-40, 40, (200, 3))
    values = np.array([texture_value(2, *p) for p in positions])
    plain = np.array([texture_value.py_func(2, *p) for p in positions])
    np.testing.assert_allclose(values, plain, rtol=1e-12)
    assert values.min() >= 0
    assert values.max() <= 1
    assert values.std() > 0.08
    near = np.array([texture_value(2, *(p + 1e-4)) for p in positions])
    assert np.abs(near - values).max() < 2e-3


def test_uniform_texture_is_not_dark_anywhere() -> None:
    assert texture_value(0, 1.5, -2.5, 3.0) == 0.0


def test_hit_kernel_equals_plain_python(tmp_path: Path) -> None:
    scene = (
        '[[object]]\nshape = "sphere"\nradius_mm = 25.0\n'
        '[[object]]\nshape = "relief"\nsize_mm = [300.0, 300.0]\nstep_mm = 10.0\nposition_mm = [0.0, 0.0, 40.0]\n'
        "bump = [{ centre_mm = [0.0, 0.0], height_mm = 9.0, sigma_mm = 30.0 }]\n"
    )
    view = small_head(tmp_path, scene)._views["eye"]
    surface = view._scene.surface
    rays = world_directions(U, V, lens_array(view._camera), view._camera.rotation)
    triangle = view._scene.rays.first_hit(EYE, rays)
    triangle[0] = -1
    arguments = (
        EYE[None],
        rays,
        triangle,
        surface.vertices_mm,
        surface.faces,
        surface.corner_normals,
        surface.part,
        surface.sphere_mm,
    )
    points, normals = transport._hit_points(*arguments)
    plain_points, plain_normals = transport._hit_points.py_func(*arguments)
    np.testing.assert_allclose(points, plain_points, atol=1e-9)
    np.testing.assert_allclose(normals, plain_normals, atol=1e-9)
    assert np.isnan(points[0]).all()
    np.testing.assert_allclose(np.linalg.norm(normals[1:], axis=1), 1, atol=1e-9)
    assert ((normals[1:] * rays[1:]).sum(axis=1) < 0).all()


@pytest.mark.parametrize("jitter", [False, True])
def test_samples_stay_in_the_cells_of_their_pixel(jitter: bool) -> None:
    rng = np.random.default_rng(1) if jitter else None
    u, v = transport.sample_positions(2, 4, 5, 3, rng)
    u, v = u.reshape(2, 5, 3, 3), v.reshape(2, 5, 3, 3)
    for sample in range(3):
        column_cell = u[..., sample] - np.arange(5)[None, :, None]
        row_cell = v[:, :, sample, :] - np.arange(2, 4)[:, None, None]
        for cell in (column_cell, row_cell):
            assert cell.min() >= sample / 3 - 0.5
            assert cell.max() <= (sample + 1) / 3 - 0.5
            if not jitter:
                np.testing.assert_allclose(cell, (sample + 0.5) / 3 - 0.5)
            else:
                assert np.ptp(cell) > 0.1


def test_threads_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "BLOCK_RAYS", 1000)
    one = small_head(tmp_path, workers=1, jitter=True)._views["eye"].prepare()
    many = small_head(tmp_path, workers=3, jitter=True)._views["eye"].prepare()
    np.testing.assert_array_equal(one.column_px, many.column_px)
    np.testing.assert_array_equal(one.weight, many.weight)


def first_hits(rays: RayCaster) -> IntArray:
    target = np.random.default_rng(3).uniform(-14, 14, (300, 3))
    towards = target - np.array([0.0, 0, -100])
    return rays.first_hit(np.array([0.0, 0, -100]), towards / np.linalg.norm(towards, axis=1, keepdims=True))


def test_embree_finds_the_nearest_of_two_boxes() -> None:
    if not EMBREE:
        pytest.skip("embreex has no wheel for this processor")
    near = trimesh.creation.box(extents=(10.0, 10, 10))
    far = trimesh.creation.box(extents=(400.0, 400, 10))
    far.apply_translation((0, 0, 50))
    both = trimesh.util.concatenate([near, far])
    hits = first_hits(EmbreeCaster(np.asarray(both.vertices), np.asarray(both.faces, np.int32)))
    assert (hits >= 0).all()
    assert 20 < (hits < 12).sum() < 200


def test_both_casters_find_the_same_triangles() -> None:
    pytest.importorskip("rtree", reason="trimesh's own caster needs rtree; it is installed where embreex is not")
    if not EMBREE:
        pytest.skip("embreex has no wheel for this processor")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    np.testing.assert_array_equal(first_hits(EmbreeCaster(vertices, faces)), first_hits(TreeCaster(vertices, faces)))

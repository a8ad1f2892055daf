"""Normals for shading: smooth over gentle bends, sharp at creases."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from simulated_rig import shapes
from slrig.model import FloatArray, IntArray


def folded(angle_deg: float) -> tuple[FloatArray, IntArray]:
    """Two unequal triangles that share an edge and bend by an angle."""
    turn = np.deg2rad(angle_deg)
    far = (3 * np.cos(turn), 0.5, 3 * np.sin(turn))
    vertices = np.array([(0, 0, 0), (0, 1, 0), (-1, 0.5, 0), far], np.float64)
    return vertices, np.array([(0, 1, 2), (1, 0, 3)], np.int32)


@pytest.mark.parametrize(("angle_deg", "smooth"), [(20.0, True), (40.0, False)])
def test_normals_are_shared_up_to_the_crease_angle(angle_deg: float, smooth: bool) -> None:
    vertices, faces = folded(angle_deg)
    part = shapes._smooth(vertices, faces, crease_rad=np.deg2rad(30.0))
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
    part = shapes._smooth(vertices, faces, crease_rad=0.5)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    weighted = np.cross(b - a, c - a)
    unit = weighted / np.linalg.norm(weighted, axis=1, keepdims=True)
    for face in range(len(faces)):
        for corner in range(3):
            near = (faces == faces[face, corner]).any(axis=1) & (unit @ unit[face] >= np.cos(0.5))
            mean = weighted[near].sum(axis=0)
            np.testing.assert_allclose(part.corner_normals[face, corner], mean / np.linalg.norm(mean), atol=1e-12)
    assert (np.abs(part.corner_normals - unit[:, None]).max(axis=(1, 2)) > 0.01).mean() > 0

"""The open borders of a surface: how long they are, and what they enclose."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from slrig.meshing.open_borders import open_borders


def test_a_closed_surface_has_none() -> None:
    box = trimesh.creation.box()
    borders = open_borders(np.asarray(box.vertices), np.asarray(box.faces, np.int32))
    assert (borders.edges, len(borders.length_mm), len(borders.area_mm2)) == (0, 0, 0)


def test_each_border_has_its_length_and_area_far_from_the_origin() -> None:
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

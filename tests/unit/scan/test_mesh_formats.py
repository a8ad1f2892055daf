"""GLB, STL and OBJ, read back by trimesh and by hand."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from slrig.model import Mesh
from slrig.scan import mesh_formats
from slrig.scan.artefacts import encode_mesh_ply
from slrig.scan.mesh_formats import encode_mesh_glb, encode_mesh_obj, encode_mesh_stl
from tests.unit.scan.test_artefacts import example_mesh

ENCODERS: Mapping[str, Callable[[Mesh], bytes | bytearray]] = {
    "ply": encode_mesh_ply,
    "glb": encode_mesh_glb,
    "stl": encode_mesh_stl,
    "obj": encode_mesh_obj,
}


def half_ball(rows: int = 12, columns: int = 20) -> Mesh:
    """A dome of radius 50 mm that looks along −z, so its triangles are counter-clockwise seen from −z."""
    polar, around = np.meshgrid(np.linspace(0.2, 1.5, rows), np.linspace(0, 2 * np.pi, columns)[:-1], indexing="ij")
    outward = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), -np.cos(polar)], axis=-1)
    index = np.arange(rows * (columns - 1)).reshape(rows, columns - 1)
    a, b = index[:-1], index[1:]
    c, d = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, c, b), (c, d, b))])
    normals = outward.reshape(-1, 3).astype(np.float32)
    count = len(normals)
    return Mesh(
        vertices_mm=50 * normals + np.array([3, -4, 500], dtype=np.float32),
        faces=faces.astype(np.int32),
        normals=normals,
        colour=(np.arange(count)[:, None] * (1, 3, 7) % 256).astype(np.uint8),
        mark=np.zeros(count, dtype=np.uint8),
        sigma_mm=np.linspace(0.01, 0.02, count, dtype=np.float32),
        stripe=np.arange(count, dtype=np.int32),
    )


def load(data: bytes | bytearray, kind: str) -> Any:
    return trimesh.load(io.BytesIO(data), file_type=kind, process=False)


def in_mm(data: bytes | bytearray, kind: str) -> trimesh.Trimesh:
    """One mesh as a reader places it in its scene, brought back from glTF's axes (y up, front to +z) and metres."""
    found = load(data, kind)
    if isinstance(found, trimesh.Scene):
        (found,) = found.dump()
        found.apply_transform(np.diag([1000, -1000, -1000, 1]))
    return found


@pytest.mark.parametrize("kind", ENCODERS)
def test_positions_winding_and_normals_come_back(kind: str) -> None:
    mesh = half_ball()
    found = in_mm(ENCODERS[kind](mesh), kind)
    wanted = mesh.vertices_mm[mesh.faces].astype(np.float64)
    # Same triangles, same order of corners: 5 decimals in OBJ, single precision elsewhere.
    np.testing.assert_allclose(found.triangles, wanted, rtol=0, atol=6e-5)
    assert found.is_winding_consistent or kind == "stl"  # STL has no shared corners
    outward = found.triangles_center - [3, -4, 500]
    assert ((found.face_normals * outward).sum(axis=1) > 45).all()


@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
def test_normals_and_colours_of_vertices_come_back(kind: str) -> None:
    mesh = half_ball()
    found = load(ENCODERS[kind](mesh), kind)
    if isinstance(found, trimesh.Scene):
        (found,) = found.geometry.values()
    corners, wanted = np.asarray(found.faces).ravel(), mesh.faces.ravel()
    np.testing.assert_allclose(found.vertex_normals[corners], mesh.normals[wanted], atol=1e-4)
    colours = found.visual.vertex_attributes["color"] if kind == "glb" else found.visual.vertex_colors
    colours = np.asarray(colours)[corners, :3]
    # Other programs take the numbers of PLY and OBJ as sRGB; glTF has light, by the curve of IEC 61966-2-1.
    share = mesh.colour[wanted] / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    np.testing.assert_array_equal(colours, np.rint(65535 * light) if kind == "glb" else mesh.colour[wanted])


def glb_tree(data: bytes) -> Any:
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_glb_is_in_metres_with_y_up_and_its_front_to_plus_z_by_its_node() -> None:
    mesh = half_ball()
    data = encode_mesh_glb(mesh)
    (stored,) = load(data, "glb").geometry.values()
    assert np.array_equal(stored.vertices, mesh.vertices_mm)
    assert np.array_equal(stored.faces, mesh.faces)
    tree = glb_tree(data)
    assert tree["nodes"] == [{"name": "scan", "rotation": [1, 0, 0, 0], "scale": [0.001] * 3, "mesh": 0}]
    (placed,) = load(data, "glb").dump()
    # (x right, y down, z away) mm stands at (x right, y up, z towards the viewer) m.
    assert placed.vertices == pytest.approx(mesh.vertices_mm * [1e-3, -1e-3, -1e-3], rel=1e-6)


def test_glb_is_laid_out_as_the_specification_says() -> None:
    mesh = half_ball()
    data = encode_mesh_glb(mesh)
    words = np.frombuffer(data[:20], dtype="<u4")
    assert data[:4] == b"glTF"
    assert words[1:3].tolist() == [2, len(data)]
    assert data[16:20] == b"JSON"
    start = 20 + int(words[3])
    assert start % 4 == 0
    length = int.from_bytes(data[start : start + 4], "little")
    assert data[start + 4 : start + 8] == b"BIN\0"
    body = data[start + 8 :]
    assert len(body) == length
    tree = glb_tree(data)
    assert tree["buffers"] == [{"byteLength": length}]
    views = tree["bufferViews"]
    assert [view["byteOffset"] for view in views] == [0, *np.cumsum([view["byteLength"] for view in views])[:-1]]
    assert sum(view["byteLength"] for view in views) == length
    (primitive,) = tree["meshes"][0]["primitives"]
    position = tree["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == mesh.vertices_mm.min(axis=0).tolist()
    assert position["max"] == mesh.vertices_mm.max(axis=0).tolist()
    assert position["count"] == len(mesh.vertices_mm)
    assert tree["accessors"][primitive["indices"]]["count"] == mesh.faces.size


def test_glb_has_a_dull_material_and_colours_and_leaves_unknown_normals_out() -> None:
    mesh = example_mesh()
    tree = glb_tree(encode_mesh_glb(mesh))
    (primitive,) = tree["meshes"][0]["primitives"]
    assert {"POSITION", "NORMAL", "COLOR_0"} == primitive["attributes"].keys()
    assert tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0
    (primitive,) = glb_tree(encode_mesh_glb(with_unknown_normal(mesh)))["meshes"][0]["primitives"]
    assert {"POSITION", "COLOR_0"} == primitive["attributes"].keys()


def with_unknown_normal(mesh: Mesh) -> Mesh:
    unknown = mesh.normals.copy()
    unknown[2] = np.nan
    return replace(mesh, normals=unknown)


def test_obj_leaves_unknown_normals_out() -> None:
    mesh = example_mesh()
    text = encode_mesh_obj(with_unknown_normal(mesh)).decode("ascii")
    assert "vn" not in text
    assert text.splitlines()[-4:] == ["f 1 2 5", "f 2 3 5", "f 3 4 5", "f 4 1 5"]
    np.testing.assert_allclose(in_mm(text.encode(), "obj").triangles, mesh.vertices_mm[mesh.faces], rtol=0, atol=6e-6)


def test_obj_is_the_plain_text_that_formatting_gives() -> None:
    mesh = half_ball(200, 200)
    lines = ["# slrig mesh, millimetres; v x y z red green blue", "o scan"]
    for point, colour in zip(mesh.vertices_mm.astype(np.float64), mesh.colour.tolist(), strict=True):
        x, y, z = (unsigned_zero(f"{value:.5f}") for value in np.rint(point * 1e5) / 1e5)
        lines.append(" ".join(["v", x, y, z, *(f"{value / 255:.4f}" for value in colour)]))
    lines += [
        " ".join(["vn", *(unsigned_zero(f"{value:.4f}") for value in np.rint(normal * 1e4) / 1e4)])
        for normal in mesh.normals.astype(np.float64)
    ]
    lines += [" ".join(["f", *(f"{k}//{k}" for k in face)]) for face in (mesh.faces + 1).tolist()]
    # More than one slice of rows is written.
    assert len(mesh.faces) > mesh_formats._MOST_ROWS < len(mesh.vertices_mm)
    assert encode_mesh_obj(mesh).decode("ascii").splitlines() == lines


def unsigned_zero(text: str) -> str:
    return text[1:] if float(text) == 0 and text.startswith("-") else text


def test_stl_is_in_millimetres_and_a_flat_triangle_has_no_normal() -> None:
    mesh = half_ball(80, 250)
    flat = np.array([[0, 0, 1]], dtype=np.int32)
    mesh = replace(mesh, faces=np.concatenate([mesh.faces, flat]))
    assert len(mesh.faces) > mesh_formats._MOST_ROWS
    data = encode_mesh_stl(mesh)
    assert len(data) == 84 + 50 * len(mesh.faces)
    assert not data.startswith(b"solid")
    rows: NDArray[np.void] = np.frombuffer(
        data[84:], dtype=[("normal", "<f4", 3), ("corners", "<f4", 9), ("rest", "u2")]
    )
    assert np.array_equal(rows["corners"].reshape(-1, 3, 3), mesh.vertices_mm[mesh.faces])
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces[:-1]].astype(np.float64), 1, 0)
    wanted = np.cross(b - a, c - a)
    wanted /= np.linalg.norm(wanted, axis=1)[:, None]
    np.testing.assert_allclose(rows["normal"][:-1], wanted, atol=2e-3)
    assert rows["normal"][-1].tolist() == [0, 0, 0]


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_mesh_without_triangles_can_be_written(kind: str) -> None:
    points = replace(example_mesh(), faces=np.zeros((0, 3), dtype=np.int32))
    data = ENCODERS[kind](points)
    if kind == "stl":
        assert len(data) == 84
    elif kind == "glb":
        (primitive,) = glb_tree(bytes(data))["meshes"][0]["primitives"]
        assert primitive["mode"] == 0
        (stored,) = load(data, kind).geometry.values()
        np.testing.assert_array_equal(stored.vertices, points.vertices_mm)
    else:
        assert data


def test_a_glb_of_nothing_has_no_empty_buffer() -> None:
    mesh = example_mesh()
    nothing = Mesh(*(getattr(mesh, each.name)[:0] for each in fields(Mesh)))
    tree = glb_tree(encode_mesh_glb(nothing))
    assert not {"buffers", "accessors", "meshes"} & tree.keys()

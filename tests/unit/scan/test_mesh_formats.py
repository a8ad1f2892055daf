"""GLB, whole, quantised and coarse, STL and OBJ, read back by trimesh and by hand."""

from __future__ import annotations

import hashlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from slrig.errors import InvalidInputError, StorageError
from slrig.model import Mesh, MeshAxes, PointCurves, Refusal, Size
from slrig.scan import formats as mesh_formats
from slrig.scan.artefacts import (
    MESH,
    ON_REQUEST,
    REPORT,
    FileAxes,
    decode_mesh_ply,
    encode_mesh_ply,
    encode_points_ply,
    write_converted,
    write_report,
)
from slrig.scan.formats import (
    MEDIA_TYPES,
    coarse_mesh,
    encode_coarse_glb,
    encode_mesh_glb,
    encode_mesh_obj,
    encode_mesh_stl,
    encode_view_glb,
)

IN_BASE = ((0.0, 0.6, 0.8, 1250.5), (-1.0, 0.0, 0.0, -340.25), (0.0, -0.8, 0.6, 800.125), (0.0, 0.0, 0.0, 1.0))
"""A rig in the base of a robot."""

ENCODERS: Mapping[str, Callable[[Mesh], bytes | bytearray]] = {
    "ply": partial(encode_mesh_ply, axes=FileAxes.of(MeshAxes.RIG)),
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


def example_mesh(seed: int = 0) -> Mesh:
    """A pyramid of four faces, its corners in no special place."""
    random = np.random.default_rng(seed)
    normals = random.normal(size=(5, 3))
    return Mesh(
        vertices_mm=(random.normal(size=(5, 3)) * 100).astype(np.float32),
        faces=np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], dtype=np.int32),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        colour=np.array([[0, 1, 2], [10, 9, 8], [100, 50, 25], [200, 0, 7], [255, 255, 254]], dtype=np.uint8),
        mark=np.array([0, 1, 2, 3, 5], dtype=np.uint8),
        sigma_mm=np.array([0.01, 0.02, np.nan, 0.04, 0.05], dtype=np.float32),
        stripe=np.array([7, 8, 9, 10, 1023], dtype=np.int32),
    )


COMPONENTS = {5120: "<i1", 5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class Read:
    """What a GLB holds: its JSON, and each accessor's elements as they are stored."""

    tree: Any
    stored: dict[str, NDArray[Any]]

    @property
    def extras(self) -> Any:
        return self.tree["nodes"][0]["extras"]

    @property
    def points_mm(self) -> NDArray[np.float64]:
        """(V, 3), by the extras."""
        found: NDArray[np.float64] = self.extras["origin_mm"] + self.extras["step_mm"] * self.stored["POSITION"]
        return found


def read(data: bytes) -> Read:
    start = 20 + int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20:start])
    assert len(data) == int.from_bytes(data[8:12], "little")
    assert (len(data) % 4, start % 4) == (0, 0)
    if "meshes" not in tree:
        return Read(tree, {})
    body = data[start + 8 :]
    assert (int.from_bytes(data[start : start + 4], "little"), data[start + 4 : start + 8]) == (len(body), b"BIN\0")
    assert 0 <= len(body) - tree["buffers"][0]["byteLength"] < 4
    (primitive,) = tree["meshes"][0]["primitives"]
    stored = {}
    for name, index in {**primitive["attributes"], "indices": primitive.get("indices")}.items():
        if index is None:
            continue
        accessor = tree["accessors"][index]
        view = tree["bufferViews"][accessor["bufferView"]]
        kind, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        stride = view.get("byteStride", kind.itemsize * width)
        # Sections 3.6.2.4 and 3.7.2.1: an attribute's elements begin at multiples of 4 bytes.
        assert view["byteOffset"] % (kind.itemsize if name == "indices" else 4) == 0
        assert name == "indices" or stride % 4 == 0
        assert view["byteLength"] >= stride * (accessor["count"] - 1) + kind.itemsize * width
        part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        rows = np.ndarray((accessor["count"], width), kind, part, strides=(stride, kind.itemsize))
        stored[name] = rows[:, 0] if width == 1 else rows
    return Read(tree, stored)


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


def test_glb_is_in_metres_with_y_up_and_its_front_to_plus_z_by_its_node() -> None:
    mesh = half_ball()
    data = encode_mesh_glb(mesh)
    (stored,) = load(data, "glb").geometry.values()
    assert np.array_equal(stored.vertices, mesh.vertices_mm)
    assert np.array_equal(stored.faces, mesh.faces)
    assert read(data).tree["nodes"] == [{"name": "scan", "rotation": [1, 0, 0, 0], "scale": [0.001] * 3, "mesh": 0}]
    (placed,) = load(data, "glb").dump()
    # (x right, y down, z away) mm stands at (x right, y up, z towards the viewer) m.
    assert placed.vertices == pytest.approx(mesh.vertices_mm * [1e-3, -1e-3, -1e-3], rel=1e-6)


def test_glb_has_its_extent_a_dull_material_and_colours() -> None:
    mesh = half_ball()
    found = read(encode_mesh_glb(mesh))
    views = found.tree["bufferViews"]
    assert [view["byteOffset"] for view in views] == [0, *np.cumsum([view["byteLength"] for view in views])[:-1]]
    (primitive,) = found.tree["meshes"][0]["primitives"]
    position = found.tree["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == mesh.vertices_mm.min(axis=0).tolist()
    assert position["max"] == mesh.vertices_mm.max(axis=0).tolist()
    assert {"POSITION", "NORMAL", "COLOR_0"} == primitive["attributes"].keys()
    assert found.tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0


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


def test_obj_is_the_plain_text_that_formatting_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_formats, "_MOST_ROWS", 300)
    mesh = half_ball(20, 25)
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


@pytest.mark.parametrize("kind", ["ply", "stl", "obj"])
def test_a_mesh_without_triangles_can_be_written(kind: str) -> None:
    data = ENCODERS[kind](replace(example_mesh(), faces=np.zeros((0, 3), dtype=np.int32)))
    assert len(data) == 84 if kind == "stl" else data


# The quantised GLB and the coarse one


def sheet(rows: int = 400, columns: int = 500) -> Mesh:
    """Waves of 180 mm by 140 mm, 2 triangles to each square."""
    y, x = np.meshgrid(np.linspace(-70, 70, rows), np.linspace(-90, 90, columns), indexing="ij")
    z = 500 + 6 * np.sin(x / 9) * np.cos(y / 11)
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    normals = np.stack([6 / 9 * np.cos(x / 9) * np.cos(y / 11), -6 / 11 * np.sin(x / 9) * np.sin(y / 11), -1 + 0 * x])
    normals /= np.linalg.norm(normals, axis=0)
    return Mesh(
        vertices_mm=np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32),
        faces=np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, c, b), (b, c, d))]),
        normals=normals.reshape(3, -1).T.astype(np.float32),
        colour=np.stack([index.ravel() % each for each in (251, 241, 239)], axis=1).astype(np.uint8),
        mark=np.zeros(index.size, dtype=np.uint8),
        sigma_mm=np.linspace(0.001, 0.05, index.size, dtype=np.float32),
        stripe=(index.ravel() // rows).astype(np.int32),
    )


def only(mesh: Mesh, count: int) -> Mesh:
    """Its first vertices, and no triangle."""
    values = {each.name: getattr(mesh, each.name)[:count] for each in fields(mesh) if each.name != "faces"}
    return replace(mesh, faces=mesh.faces[:0], **values)


def normal_of(mesh: Mesh) -> NDArray[np.float64]:
    """(F, 3) of each triangle, as long as twice its area."""
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces].astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("mesh", [half_ball(60, 160), sheet(), example_mesh()], ids=["ball", "sheet", "pyramid"])
def test_each_vertex_stands_within_half_a_step_of_its_place(mesh: Mesh) -> None:
    found = read(encode_view_glb(mesh))
    longest_mm = np.ptp(mesh.vertices_mm, axis=0).max()
    assert found.extras["step_mm"] == pytest.approx(longest_mm / 65535, rel=1e-6)
    # One part in a thousand for the rounding of single precision.
    assert np.abs(found.points_mm - mesh.vertices_mm).max() <= 0.501 * found.extras["step_mm"]
    accessor = found.tree["accessors"][0]
    assert accessor["min"] == found.stored["POSITION"].min(axis=0).tolist() == [0, 0, 0]
    assert accessor["max"] == found.stored["POSITION"].max(axis=0).tolist()
    np.testing.assert_array_equal(found.stored["indices"].reshape(-1, 3), mesh.faces)


def test_another_reader_finds_it_where_mesh_glb_stands() -> None:
    mesh = half_ball()
    found = in_mm(encode_view_glb(mesh), "glb")
    np.testing.assert_allclose(found.triangles, mesh.vertices_mm[mesh.faces], rtol=0, atol=100 / 65535)


def test_normals_colours_deviations_and_stripes_come_back() -> None:
    mesh = sheet()
    found = read(encode_view_glb(mesh))
    assert {index: found.tree["accessors"][index].get("normalized", False) for index in range(5)} == {
        0: False, 1: True, 2: True, 3: False, 4: False,
    }  # fmt: skip
    assert np.abs(found.stored["NORMAL"] / 127 - mesh.normals).max() <= 0.501 / 127
    # Light, as IEC 61966-2-1 has it of sRGB.
    value = mesh.colour / 255
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    assert np.abs(found.stored["COLOR_0"][:, :3] - 65535 * light).max() <= 0.501
    assert (found.stored["COLOR_0"][:, 3] == 65535).all()
    assert found.extras["sigma_step_mm"] == 1e-4
    assert np.abs(1e-4 * found.stored["_SIGMA"] - mesh.sigma_mm).max() <= 0.501 * 1e-4
    np.testing.assert_array_equal(found.stored["_STRIPE"], mesh.stripe)
    assert found.tree["extensionsRequired"] == found.tree["extensionsUsed"] == ["KHR_mesh_quantization"]


def test_what_is_too_great_or_not_known_is_the_greatest_number() -> None:
    mesh = replace(
        example_mesh(),
        sigma_mm=np.array([np.nan, np.inf, 6.5534, 7.0, 0.0], dtype=np.float32),
        stripe=np.array([-1, 65535, 65536, 2**31 - 1, 0], dtype=np.int32),
    )
    found = read(encode_view_glb(mesh))
    assert found.stored["_SIGMA"].tolist() == [65535, 65535, 65534, 65535, 0]
    assert found.stored["_STRIPE"].tolist() == [65535, 65535, 65535, 65535, 0]


def test_indices_are_short_where_that_names_each_vertex() -> None:
    mesh = sheet(260, 260)
    assert len(mesh.vertices_mm) > 65535
    assert read(encode_view_glb(mesh)).stored["indices"].dtype == np.uint32
    for count, kind in ((65536, np.uint32), (65535, np.uint16)):
        corners = np.array([[0, 1, count - 1]], dtype=np.int32)
        found = read(encode_view_glb(replace(only(mesh, count), faces=corners)))
        assert found.stored["indices"].dtype == kind
        assert found.stored["indices"].tolist() == [0, 1, count - 1]


def test_a_mesh_without_extent_in_an_axis_or_in_all_is_placed() -> None:
    mesh = half_ball()
    for axes in ([2], [0, 2], [0, 1, 2]):
        flat = mesh.vertices_mm.copy()
        flat[:, axes] = 7
        found = read(encode_view_glb(replace(mesh, vertices_mm=flat)))
        assert (found.points_mm[:, axes] == 7).all()
        assert found.extras["step_mm"] > 0
        assert np.abs(found.points_mm - flat).max() <= 0.501 * found.extras["step_mm"]


@pytest.mark.parametrize("encode", [encode_mesh_glb, encode_view_glb, encode_coarse_glb])
def test_points_nothing_and_unknown_normals(encode: Any) -> None:
    mesh = example_mesh()
    points = read(encode(only(mesh, 5)))
    assert points.tree["meshes"][0]["primitives"][0]["mode"] == 0
    assert "indices" not in points.stored
    assert len(points.stored["POSITION"]) == 5
    nothing = read(encode(only(mesh, 0)))
    assert not {"buffers", "accessors", "meshes"} & nothing.tree.keys()
    assert "NORMAL" not in read(encode(with_unknown_normal(mesh))).stored


@pytest.mark.parametrize("axis", [0, *(pytest.param(each, marks=pytest.mark.slow) for each in (1, 2))])
def test_a_coarse_mesh_has_vertices_of_the_mesh_and_its_orientation(axis: int) -> None:
    fine = sheet()
    fine = replace(fine, **{name: np.roll(getattr(fine, name), axis, axis=1) for name in ("vertices_mm", "normals")})
    # A vertex is known by its stripe.
    fine = replace(fine, stripe=np.arange(len(fine.stripe), dtype=np.int32))
    coarse = coarse_mesh(fine)
    assert 20_000 <= len(coarse.faces) <= 40_000
    assert coarse.faces.dtype == np.int32
    for name in ("vertices_mm", "normals", "colour", "sigma_mm"):
        np.testing.assert_array_equal(getattr(coarse, name), getattr(fine, name)[coarse.stripe])
    normals = normal_of(coarse)
    assert (np.linalg.norm(normals, axis=1) > 0).all()
    assert ((normals * coarse.normals[coarse.faces].mean(axis=1)).sum(axis=1) > 0).all()
    assert len(np.unique(np.sort(coarse.faces, axis=1), axis=0)) == len(coarse.faces)
    assert np.array_equal(np.unique(coarse.faces), np.arange(len(coarse.vertices_mm)))
    # It covers what the mesh does, but for the outermost cells.
    area, whole = (np.linalg.norm(normal_of(each), axis=1).sum() for each in (coarse, fine))
    assert 0.96 < area / whole < 1.02
    assert len(encode_coarse_glb(fine)) < len(encode_view_glb(fine)) / 5


def test_a_long_narrow_mesh_is_no_coarser_than_others() -> None:
    narrow = sheet(100, 4000)
    narrow = replace(narrow, vertices_mm=narrow.vertices_mm * np.array([10, 0.2, 1], dtype=np.float32))
    assert 20_000 <= len(coarse_mesh(narrow).faces) <= 40_000


def test_a_small_mesh_is_its_own_coarse_one() -> None:
    mesh = half_ball()
    assert coarse_mesh(mesh) is mesh
    assert encode_coarse_glb(mesh) == encode_view_glb(mesh)


def test_triangles_of_the_same_corners_are_kept_once_as_they_stood_first() -> None:
    mesh = sheet(100, 200)
    again = np.concatenate([mesh.faces, mesh.faces[:, [0, 2, 1]], mesh.faces[::7]])
    # Without normals nothing is turned round.
    coarse = coarse_mesh(replace(mesh, faces=again, normals=np.full_like(mesh.normals, np.nan)))
    assert len(np.unique(np.sort(coarse.faces, axis=1), axis=0)) == len(coarse.faces)
    assert (normal_of(coarse)[:, 2] < 0).mean() > 0.99


def test_where_merging_folds_the_surface_no_triangle_looks_away() -> None:
    """A sheet so rough that a cell holds vertices of two of its sides."""
    mesh = sheet()
    rough = mesh.vertices_mm.copy()
    rough[:, 2] += np.random.default_rng(1).normal(0, 0.3, len(rough))
    coarse = coarse_mesh(replace(mesh, vertices_mm=rough))
    assert len(coarse.faces) > 10_000
    assert ((normal_of(coarse) * coarse.normals[coarse.faces].mean(axis=1)).sum(axis=1) >= 0).all()


def test_points_alone_and_triangles_without_area_are_made_coarse() -> None:
    mesh = sheet()
    points = coarse_mesh(replace(mesh, faces=mesh.faces[:0]))
    assert 1_000 < len(points.vertices_mm) < len(mesh.vertices_mm) / 5
    assert len(points.faces) == 0
    one_place = replace(mesh, vertices_mm=np.full_like(mesh.vertices_mm, 3))
    found = coarse_mesh(one_place)
    assert (len(found.vertices_mm), len(found.faces)) == (1, 0)


# ---- The files of a scan, read back by another program, and what happens when the disk refuses


def example_curves() -> PointCurves:
    return PointCurves(
        offsets=np.array([0, 3, 3, 5], dtype=np.int32),
        column_px=np.array([4.0, 5.5, 7.5]),
        points_mm=np.arange(15, dtype=np.float64).reshape(5, 3) / 7,
        sigma_mm=np.array([0.1, 0.2, 0.3, 0.4, np.nan]),
        bridge_after=np.array([True, False, False, False, True]),
        source=np.array([0, 1, 2, 0, 1], dtype=np.uint8),
        colour=np.array([[1, 2, 3], [2, 3, 4], [3, 4, 5], [4, 5, 6], [255, 0, 9]], dtype=np.uint8),
        mark=np.array([0, 0, 4, 1, 2], dtype=np.uint8),
    )


def test_ply_holds_every_property_of_the_mesh() -> None:
    mesh = example_mesh()
    found = load(encode_mesh_ply(mesh, axes=FileAxes.of(MeshAxes.RIG)), "ply")
    data = found.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(found.vertices, mesh.vertices_mm)
    assert np.array_equal(found.faces, mesh.faces)
    for axis, name in enumerate(("nx", "ny", "nz")):
        assert np.array_equal(data[name].ravel(), mesh.normals[:, axis])
    for channel, name in enumerate(("red", "green", "blue")):
        assert np.array_equal(data[name].ravel(), mesh.colour[:, channel])
    assert np.array_equal(data["albedo_mark"].ravel(), mesh.mark)
    assert np.array_equal(data["sigma_mm"].ravel(), mesh.sigma_mm, equal_nan=True)
    assert np.array_equal(data["stripe"].ravel(), mesh.stripe)


def test_ply_header_names_the_unit_and_the_layout() -> None:
    header = encode_mesh_ply(example_mesh()).split(b"end_header\n")[0].decode("ascii").splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "comment unit mm" in header
    assert "element vertex 5" in header
    assert header[-2:] == ["element face 4", "property list uchar int vertex_indices"]
    assert [line.split()[1:] for line in header if line.startswith("property") and "list" not in line] == [
        *(["float", name] for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(["uchar", name] for name in ("red", "green", "blue", "albedo_mark")),
        ["float", "sigma_mm"],
        ["int", "stripe"],
    ]


@pytest.mark.parametrize("axes", MeshAxes)
def test_ply_is_read_again_as_it_was_written(axes: MeshAxes) -> None:
    mesh = example_mesh()
    found = decode_mesh_ply(encode_mesh_ply(mesh, axes=FileAxes.of(axes, IN_BASE)))
    for name in ("vertices_mm", "faces", "normals", "colour", "mark", "sigma_mm", "stripe"):
        before, after = getattr(mesh, name), getattr(found, name)
        assert after.dtype == before.dtype
        if axes is MeshAxes.ROBOT and name in ("vertices_mm", "normals"):
            # Numbers of a metre have digits of 0.1 µm.
            np.testing.assert_allclose(after, before, rtol=1e-5, atol=3e-4)
        else:
            assert np.array_equal(after, before, equal_nan=after.dtype.kind == "f")
    nothing = replace(mesh, faces=np.zeros((0, 3), dtype=np.int32))
    assert len(decode_mesh_ply(encode_mesh_ply(nothing)).faces) == 0


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"ply\n", b"plyx\n"),
        (b"property float sigma_mm\n", b""),
        (b"element vertex 5\n", b"element vertex 6\n"),
        (b"element vertex 5\n", b"element vertex five\n"),
        (b"element face 4\n", b"element face 3\n"),
        (b"end_header", b"end"),
        (b"binary_little_endian", b"ascii"),
        (b"\x03\x00\x00\x00\x00", b"\x03\x05\x00\x00\x00"),
        (b"\x03\x00\x00\x00\x00", b"\x03\xff\xff\xff\xff"),
    ],
)
def test_a_ply_that_was_changed_or_cut_is_refused(old: bytes, new: bytes) -> None:
    data = encode_mesh_ply(example_mesh())
    assert old in data
    with pytest.raises(InvalidInputError, match="reconstruct the bundle again"):
        decode_mesh_ply(data.replace(old, new, 1))
    for end in (0, 10, len(data) // 2, len(data) - 1):
        with pytest.raises(InvalidInputError, match="reconstruct the bundle again"):
            decode_mesh_ply(data[:end])
    with pytest.raises(InvalidInputError, match=r"expected .* 232 bytes after it, found 233 bytes"):
        decode_mesh_ply(data + b"x")


def test_files_for_viewers_have_y_up_and_z_towards_the_viewer() -> None:
    mesh, curves, normals = half_ball(), example_curves(), example_normals()
    found = load(encode_mesh_ply(mesh), "ply")
    # A turn by 180 degrees about x, so that triangles keep their front.
    turned = np.diag([1, -1, -1])
    assert np.array_equal(found.vertices, mesh.vertices_mm @ turned)
    assert ((found.face_normals * (found.triangles_center - [3, 4, -500])).sum(axis=1) > 45).all()
    points = load(encode_points_ply(curves, normals), "ply")
    assert points.vertices == pytest.approx(curves.points_mm @ turned, rel=1e-6)
    assert points.metadata["_ply_raw"]["vertex"]["data"]["nz"].ravel()[[0, 1]].tolist() == [1, np.float32(0.8)]


def test_a_ply_of_an_earlier_version_is_in_the_axes_of_the_calibration() -> None:
    mesh = example_mesh()
    data = encode_mesh_ply(mesh, axes=FileAxes.of(MeshAxes.RIG))
    (stated,) = [line for line in data.split(b"\n") if line.startswith(b"comment axes")]
    found = decode_mesh_ply(data.replace(stated + b"\n", b"", 1))
    assert np.array_equal(found.vertices_mm, mesh.vertices_mm)
    with pytest.raises(InvalidInputError, match="another header"):
        decode_mesh_ply(data.replace(stated, b"comment axes others", 1))


@pytest.mark.parametrize("name", ON_REQUEST)
@pytest.mark.parametrize("axes", MeshAxes)
def test_other_formats_are_made_of_the_ply_beside_them(tmp_path: Path, name: str, axes: MeshAxes) -> None:
    mesh = example_mesh()
    (tmp_path / MESH).write_bytes(encode_mesh_ply(mesh, axes=FileAxes.of(axes, IN_BASE)))
    write_converted(tmp_path, name)
    if axes is MeshAxes.ROBOT:
        if name == "mesh.obj":
            written = trimesh.load_mesh(tmp_path / name, process=False)
            at = np.array(IN_BASE)
            np.testing.assert_allclose(
                written.vertices, mesh.vertices_mm @ at[:3, :3].T + at[:3, 3], rtol=1e-6, atol=1e-3
            )
    else:
        upright = axes is MeshAxes.UPRIGHT and not name.endswith(".glb")
        turn = np.array([1, -1, -1] if upright else [1, 1, 1], dtype=np.float32)
        placed = replace(mesh, vertices_mm=mesh.vertices_mm * turn, normals=mesh.normals * turn)
        assert (tmp_path / name).read_bytes() == ON_REQUEST[name](placed)
    (tmp_path / "mesh.ply").unlink()
    with pytest.raises(StorageError, match=r"mesh\.ply: the disk refused"):
        write_converted(tmp_path, name)


def test_formats_that_are_made_on_request_are_offered() -> None:
    assert set(ON_REQUEST) < set(MEDIA_TYPES)


def example_normals() -> NDArray[np.float32]:
    """Of the points of `example_curves`: one is not known."""
    return np.array([[0, 0, -1], [0.6, 0, -0.8], [np.nan] * 3, [0, 1, 0], [0, 0, -1]], dtype=np.float32)


def test_points_hold_their_column_source_and_bridges() -> None:
    curves = example_curves()
    normals = example_normals()
    found = load(encode_points_ply(curves, normals, axes=FileAxes.of(MeshAxes.RIG)), "ply")
    data = found.metadata["_ply_raw"]["vertex"]["data"]
    assert found.vertices == pytest.approx(curves.points_mm, rel=1e-6)
    for axis, name in enumerate(("nx", "ny", "nz")):
        np.testing.assert_array_equal(data[name].ravel(), normals[:, axis])
    assert data["stripe"].ravel().tolist() == [4, 4, 4, 7, 7]
    assert data["source"].ravel().tolist() == curves.source.tolist()
    assert data["bridge_after"].ravel().tolist() == [1, 0, 0, 0, 1]
    for channel, name in enumerate(("red", "green", "blue")):
        assert data[name].ravel().tolist() == curves.colour[:, channel].tolist()
    assert data["albedo_mark"].ravel().tolist() == curves.mark.tolist()
    assert data["sigma_mm"].ravel() == pytest.approx(curves.sigma_mm, nan_ok=True)


def digest() -> str:
    """Of every file that these values give."""
    mesh, curves = example_mesh(), example_curves()
    data = b"".join(encode(mesh) for encode in ENCODERS.values()) + encode_points_ply(curves, example_normals())
    return hashlib.sha256(data).hexdigest()


@pytest.mark.slow
def test_the_same_values_give_the_same_bytes_here_and_in_another_process() -> None:
    code = "from tests.unit.scan.test_mesh_formats import digest; print(digest())"
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    other = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[3],
        env=environment,
    )
    assert digest() == digest() == other.stdout.strip()


class _Kind(StrEnum):
    GRAY = "gray"


def test_a_report_is_plain_json_in_the_order_given(tmp_path: Path) -> None:
    report = {
        "z": np.float64(1.5),
        "a": np.int32(3),
        "nan": np.float32("nan"),
        "list": (1, float("inf"), np.bool_(True), None),
        "array": np.array([[1.0, np.nan]]),
        "nested": {Refusal.NOT_LIT.name.lower(): 4, "kind": _Kind.GRAY, "cause": Refusal.SATURATED},
        "size": Size(4, 3),
        "file": Path("frames") / "0.png",
        "name": "Übung",
    }
    write_report(report, tmp_path / "report.json")
    text = (tmp_path / "report.json").read_text("utf-8")
    found = json.loads(text)
    assert list(found) == list(report)
    assert found == {
        "z": 1.5,
        "a": 3,
        "nan": None,
        "list": [1, None, True, None],
        "array": [[1.0, None]],
        "nested": {"not_lit": 4, "kind": "gray", "cause": "saturated"},
        "size": {"width_px": 4, "height_px": 3},
        "file": "frames/0.png",
        "name": "Übung",
    }
    assert "Übung" in text
    assert text.endswith("}\n")


def test_a_report_says_where_it_cannot_be_written_as_json(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"report\.stages\[1\]: JSON has no form for a set"):
        write_report({"stages": [1, {2}]}, tmp_path / "report.json")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_a_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"")
    with pytest.raises(StorageError, match="a part of the path is a file"):
        write_report({}, file / REPORT)

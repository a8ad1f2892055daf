"""The quantised GLB and the coarse one, read back by hand from what glTF says of them, and by trimesh."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Mesh
from slrig.scan.view_format import coarse_mesh, encode_coarse_glb, encode_view_glb
from tests.unit.scan.test_artefacts import example_mesh
from tests.unit.scan.test_mesh_formats import half_ball, in_mm, with_unknown_normal

COMPONENTS = {5120: "<i1", 5121: "<u1", 5123: "<u2", 5125: "<u4"}
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


@pytest.mark.parametrize("encode", [encode_view_glb, encode_coarse_glb])
def test_points_nothing_and_unknown_normals(encode: Any) -> None:
    mesh = example_mesh()
    points = read(encode(only(mesh, 5)))
    assert points.tree["meshes"][0]["primitives"][0]["mode"] == 0
    assert "indices" not in points.stored
    assert len(points.points_mm) == 5
    nothing = read(encode(only(mesh, 0)))
    assert not {"buffers", "accessors", "meshes"} & nothing.tree.keys()
    assert "NORMAL" not in read(encode(with_unknown_normal(mesh))).stored


@pytest.mark.parametrize("axis", [0, 1, 2])
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

"""The files of a scan, read back by another program, and what happens when the disk refuses."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from slrig.errors import InvalidInputError, StorageError
from slrig.model import Mesh, PointCurves, Refusal, Size
from slrig.scan.artefacts import (
    MESH,
    ON_REQUEST,
    REPORT,
    decode_mesh_ply,
    encode_mesh_ply,
    encode_points_ply,
    write_converted,
    write_report,
)
from slrig.scan.mesh_formats import encode_mesh_glb, encode_mesh_obj, encode_mesh_stl
from slrig.scan.offered import MEDIA_TYPES

ENCODERS = (encode_mesh_ply, encode_mesh_glb, encode_mesh_stl, encode_mesh_obj)


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


def load(path: Path) -> Any:
    return trimesh.load(path, process=False)


def test_ply_holds_every_property_of_the_mesh(tmp_path: Path) -> None:
    mesh = example_mesh()
    (tmp_path / MESH).write_bytes(encode_mesh_ply(mesh))
    found = load(tmp_path / "mesh.ply")
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


def test_ply_is_read_again_as_it_was_written() -> None:
    mesh = example_mesh()
    found = decode_mesh_ply(encode_mesh_ply(mesh))
    for name in ("vertices_mm", "faces", "normals", "colour", "mark", "sigma_mm", "stripe"):
        before, after = getattr(mesh, name), getattr(found, name)
        assert after.dtype == before.dtype
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
def test_a_ply_that_was_changed_is_refused(old: bytes, new: bytes) -> None:
    data = encode_mesh_ply(example_mesh())
    assert old in data
    with pytest.raises(InvalidInputError, match="reconstruct the bundle again"):
        decode_mesh_ply(data.replace(old, new, 1))


def test_a_ply_that_was_cut_is_refused() -> None:
    data = encode_mesh_ply(example_mesh())
    for end in (0, 10, len(data) // 2, len(data) - 1):
        with pytest.raises(InvalidInputError, match="reconstruct the bundle again"):
            decode_mesh_ply(data[:end])
    with pytest.raises(InvalidInputError, match=r"expected .* 232 bytes after it, found 233 bytes"):
        decode_mesh_ply(data + b"x")


@pytest.mark.parametrize("name", ON_REQUEST)
def test_other_formats_are_made_of_the_ply_beside_them(tmp_path: Path, name: str) -> None:
    mesh = example_mesh()
    (tmp_path / MESH).write_bytes(encode_mesh_ply(mesh))
    write_converted(tmp_path, name)
    assert (tmp_path / name).read_bytes() == ON_REQUEST[name](mesh)
    (tmp_path / "mesh.ply").unlink()
    with pytest.raises(StorageError, match=r"mesh\.ply: the disk refused"):
        write_converted(tmp_path, name)


def test_formats_that_are_made_on_request_are_offered() -> None:
    assert set(ON_REQUEST) < set(MEDIA_TYPES)


def example_normals() -> NDArray[np.float32]:
    """Of the points of `example_curves`: one is not known."""
    return np.array([[0, 0, -1], [0.6, 0, -0.8], [np.nan] * 3, [0, 1, 0], [0, 0, -1]], dtype=np.float32)


def test_points_hold_their_column_source_and_bridges(tmp_path: Path) -> None:
    curves = example_curves()
    normals = example_normals()
    (tmp_path / "points.ply").write_bytes(encode_points_ply(curves, normals))
    found = load(tmp_path / "points.ply")
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
    data = b"".join(encode(mesh) for encode in ENCODERS) + encode_points_ply(curves, example_normals())
    return hashlib.sha256(data).hexdigest()


def test_the_same_values_give_the_same_bytes_here_and_in_another_process() -> None:
    code = "from tests.unit.scan.test_artefacts import digest; print(digest())"
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

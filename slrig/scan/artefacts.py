"""The files of a scan: mesh and points in the formats that other programs read, and the report.

Everything is encoded in memory first and written through `write_file`, which leaves a whole file or none.
The same values give the same bytes: no file holds a time stamp, a path or a random name.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from slrig.bundle.storage import write_file
from slrig.model import Mesh, PointCurves

_METRES_PER_MM = 0.001
_PLY_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}


def write_mesh(mesh: Mesh, folder: Path) -> None:
    """Write mesh.ply, mesh.glb and mesh.stl into `folder`. Raises StorageError."""
    # One at a time: each is as large as the mesh.
    for name, encode in (("ply", encode_mesh_ply), ("glb", encode_mesh_glb), ("stl", encode_mesh_stl)):
        write_file(folder / f"mesh.{name}", encode(mesh))


def write_points(curves: PointCurves, path: Path) -> None:
    """Write the points of `curves` as PLY. Raises StorageError."""
    write_file(path, encode_points_ply(curves))


def write_report(report: Mapping[str, object], path: Path) -> None:
    """Write a report as JSON, keys in the order given. Numbers that are not finite become null.

    Raises
    ------
    StorageError
        The disk refused.
    TypeError
        The report holds something that JSON has no form for; the message says where.
    """
    text = json.dumps(_plain(report, "report"), indent=2, ensure_ascii=False, allow_nan=False)
    write_file(path, (text + "\n").encode())


def encode_mesh_ply(mesh: Mesh) -> bytes:
    """Binary little-endian PLY in mm: position, normal, colour, `sigma_mm`, `stripe` per vertex; triangles."""
    vertices = _records(
        len(mesh.vertices_mm),
        {
            **_columns(("x", "y", "z"), "f4", mesh.vertices_mm),
            **_columns(("nx", "ny", "nz"), "f4", mesh.normals),
            **_columns(("red", "green", "blue"), "u1", _rgb(mesh.grey)),
            "sigma_mm": ("f4", mesh.sigma_mm),
            "stripe": ("i4", mesh.stripe),
        },
    )
    faces = np.zeros(len(mesh.faces), dtype=[("count", "<u1"), ("vertices", "<i4", (3,))])
    faces["count"] = 3
    faces["vertices"] = mesh.faces
    header = [*_ply_header(vertices), f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return _ply(header, vertices.tobytes(), faces.tobytes())


def encode_points_ply(curves: PointCurves) -> bytes:
    """Binary little-endian PLY in mm: position, colour, `sigma_mm`, `stripe`, `source`, `bridge_after` per point.

    `stripe` is the projector column rounded down, as in the mesh; `bridge_after` is 1 where the step to the next
    point of its curve joins two stripes.
    """
    columns = np.floor(curves.column_px).astype(np.int32)
    points = _records(
        len(curves.points_mm),
        {
            **_columns(("x", "y", "z"), "f4", curves.points_mm),
            **_columns(("red", "green", "blue"), "u1", _rgb(curves.grey)),
            "sigma_mm": ("f4", curves.sigma_mm),
            "stripe": ("i4", np.repeat(columns, np.diff(curves.offsets))),
            "source": ("u1", curves.source),
            "bridge_after": ("u1", curves.bridge_after),
        },
    )
    return _ply(_ply_header(points), points.tobytes())


def encode_mesh_glb(mesh: Mesh) -> bytes:
    """Binary glTF 2.0 with normals and colours.

    glTF is in metres: the vertices keep their values in mm, under a node that scales by 0.001.
    Normals are left out if one is not known, because glTF has no form for that.
    """
    scale = np.diag((_METRES_PER_MM, _METRES_PER_MM, _METRES_PER_MM, 1.0))
    scene = trimesh.Scene()
    scene.add_geometry(_trimesh(mesh), node_name="scan", geom_name="mesh_mm", transform=scale)
    known = bool(np.isfinite(mesh.normals).all())
    return bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=known, tree_postprocessor=_made_of_plaster))


def _made_of_plaster(tree: dict[str, Any]) -> None:
    """Give the glTF tree a dull material: without one a viewer assumes metal, which shows little but reflections."""
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}, "doubleSided": True}]
    for shape in tree.get("meshes", ()):
        for primitive in shape["primitives"]:
            primitive["material"] = 0


def encode_mesh_stl(mesh: Mesh) -> bytes:
    """Binary STL, values in mm (the format has no unit)."""
    return bytes(trimesh.exchange.stl.export_stl(_trimesh(mesh)))


def _trimesh(mesh: Mesh) -> trimesh.Trimesh:
    opaque = np.concatenate((_rgb(mesh.grey), np.full((len(mesh.grey), 1), 255, dtype=np.uint8)), axis=1)
    return trimesh.Trimesh(
        vertices=mesh.vertices_mm,
        faces=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_colors=opaque,
        process=False,
        validate=False,
    )


def _rgb(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(grey[:, None], 3, axis=1)


def _columns(names: tuple[str, ...], kind: str, array: NDArray[Any]) -> dict[str, tuple[str, NDArray[Any]]]:
    return {name: (kind, array[:, index]) for index, name in enumerate(names)}


def _records(count: int, properties: Mapping[str, tuple[str, NDArray[Any]]]) -> NDArray[np.void]:
    """(count,) structured, packed, little endian."""
    records = np.zeros(count, dtype=[(name, f"<{kind}") for name, (kind, _) in properties.items()])
    for name, (_, values) in properties.items():
        records[name] = values
    return records


def _ply_header(vertices: NDArray[np.void]) -> list[str]:
    names = vertices.dtype.names or ()
    kinds = [_PLY_TYPES[vertices.dtype[name].str[1:]] for name in names]
    properties = [f"property {kind} {name}" for kind, name in zip(kinds, names, strict=True)]
    return [f"element vertex {len(vertices)}", *properties]


def _ply(elements: list[str], *bodies: bytes) -> bytes:
    comments = ["comment unit mm", "comment sigma_mm standard deviation along the surface normal"]
    header = ["ply", "format binary_little_endian 1.0", *comments, *elements, "end_header", ""]
    return "\n".join(header).encode("ascii") + b"".join(bodies)


def _plain(value: object, where: str) -> object:
    """`value` in the types that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, Enum):
        return value.value if isinstance(value, str) else value.name.lower()
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value), where)
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), where)
    if isinstance(value, list | tuple):
        return [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Path):
        return value.as_posix()
    message = f"{where}: JSON has no form for a {type(value).__name__}; give a number, text, list or mapping"
    raise TypeError(message)

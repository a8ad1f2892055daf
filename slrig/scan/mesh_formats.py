"""A mesh in the formats that other programs read: binary glTF (GLB), STL and OBJ.

They are written here, from arrays and without a step through another program's mesh: a scan has millions of triangles,
and whoever waits for it should not wait for checks of what is known. The same mesh gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Mesh, srgb_to_linear
from slrig.scan.gltf import HALF_A_TURN_ABOUT_X, INDICES, METRES_PER_MM, BufferPart, encode_glb

_MOST_ROWS = 2**15  # rows that are worked on together: they stay in the processor's cache

_OBJ_POSITION_DECIMALS, _OBJ_UNIT_DECIMALS = 5, 4


def encode_mesh_glb(mesh: Mesh) -> bytes:
    """Binary glTF 2.0 with normals and colours (Khronos, glTF 2.0 specification, sections 3 and 4).

    glTF is in metres, with y up and the front towards +z (section 3.4); a scan is in mm, with y down and the front
    towards the camera, -z. The vertices keep their values, under a node that scales by 0.001 and turns by half a turn
    about x: (x, y, z) mm stands at (x, -y, -z) / 1000 m. Normals are left out if one is not known, because glTF has no
    form for that; a mesh without triangles is shown as points. Colours are light, not sRGB (section 3.9.2), of 16 bits.
    """
    positions = np.ascontiguousarray(mesh.vertices_mm, dtype="<f4")
    # Three components of two bytes would not end on a multiple of four.
    opaque = np.full((len(mesh.colour), 4), 2**16 - 1, dtype="<u2")
    opaque[:, :3] = srgb_to_linear(mesh.colour)
    parts = []
    if len(positions):
        ends = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        parts.append(BufferPart("POSITION", positions, "VEC3", ends))
        if np.isfinite(mesh.normals).all():
            parts.append(BufferPart("NORMAL", np.ascontiguousarray(mesh.normals, dtype="<f4"), "VEC3"))
        parts.append(BufferPart("COLOR_0", opaque, "VEC4", {"normalized": True}))
    if len(mesh.faces):
        parts.append(BufferPart(INDICES, np.ascontiguousarray(mesh.faces, dtype="<u4").reshape(-1), "SCALAR"))
    node = {"name": "scan", "rotation": [*HALF_A_TURN_ABOUT_X], "scale": [METRES_PER_MM] * 3}
    return encode_glb(parts, node)


def encode_mesh_stl(mesh: Mesh) -> bytes:
    """Binary STL, values in mm (the format has no unit): per triangle its normal and its three corners."""
    triangles = np.zeros(
        len(mesh.faces), dtype=[("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    for rows in _slices(len(mesh.faces)):
        corners = mesh.vertices_mm[mesh.faces[rows]]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = np.stack(
            [
                first[:, 1] * second[:, 2] - first[:, 2] * second[:, 1],
                first[:, 2] * second[:, 0] - first[:, 0] * second[:, 2],
                first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0],
            ],
            axis=1,
        )
        length = np.sqrt((normal**2).sum(axis=1, keepdims=True))
        triangles["normal"][rows] = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
        triangles["corners"][rows] = corners
    # The header must not begin with "solid", the mark of STL as text.
    header = b"binary STL of slrig, millimetres".ljust(80) + np.array([len(triangles)], dtype="<u4").tobytes()
    return header + triangles.tobytes()


def encode_mesh_obj(mesh: Mesh) -> bytes:
    """Wavefront OBJ in mm, with vertex normals, and sRGB colours as the three numbers that many programs read after x y
    z.

    Positions have five decimals (10 nm), normals and colours four. Normals are left out if one is not known.
    """
    known = bool(np.isfinite(mesh.normals).all())
    positions = rounded(mesh.vertices_mm, _OBJ_POSITION_DECIMALS)
    vertices = np.column_stack([positions, mesh.colour / 255])
    number = f"%.{_OBJ_POSITION_DECIMALS}f"
    unit = f"%.{_OBJ_UNIT_DECIMALS}f"
    pieces = ["# slrig mesh, millimetres; v x y z red green blue\no scan\n"]
    pieces += table_lines(" ".join(["v", *[number] * 3, *[unit] * 3]), vertices)
    if known:
        pieces += table_lines(" ".join(["vn", *[unit] * 3]), rounded(mesh.normals, _OBJ_UNIT_DECIMALS))
        pieces += table_lines("f %d//%d %d//%d %d//%d", np.repeat(mesh.faces + 1, 2, axis=1))
    else:
        pieces += table_lines("f %d %d %d", mesh.faces + 1)
    return "".join(pieces).encode("ascii")


def rounded(values: NDArray[np.float32], decimals: int) -> FloatArray:
    """The values as they are written: a zero has no sign."""
    return np.asarray(np.rint(values.astype(np.float64) * 10**decimals) / 10**decimals + 0.0)


def table_lines(form: str, table: NDArray[Any]) -> Iterator[str]:
    """The rows of a table, a line each, many together: one step of Python for each would take ten times as long."""
    for rows in _slices(len(table)):
        part = table[rows]
        yield f"{form}\n" * len(part) % tuple(part.ravel().tolist())


def _slices(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _MOST_ROWS, count)) for first in range(0, count, _MOST_ROWS))

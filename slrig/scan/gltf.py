"""The container of a mesh in binary glTF 2.0 (GLB): one node with one mesh of one primitive (Khronos, glTF 2.0
specification, sections 3 and 4).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

METRES_PER_MM = 0.001
INDICES = "indices"
HALF_A_TURN_ABOUT_X = (1, 0, 0, 0)
"""A quaternion, x y z w: from y down and z away to glTF's y up and z towards the viewer."""

_MAGIC, _VERSION = b"glTF", 2
_COMPONENT_TYPES = {"|i1": 5120, "|u1": 5121, "<u2": 5123, "<u4": 5125, "<f4": 5126}
_COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_POINTS, _TRIANGLES = 0, 4


class BufferPart(NamedTuple):
    """One attribute of the vertices, or the corners of the triangles (`INDICES`). more : of the accessor.

    array : contiguous, little endian, a row for each element; longer than `kind` says where that is no multiple of 4
    bytes, at which each element of an attribute begins (section 3.6.2.4).
    """

    name: str
    array: NDArray[Any]
    kind: str
    more: Mapping[str, object] = {}


def encode_glb(parts: Sequence[BufferPart], node: Mapping[str, object], *, extensions: Sequence[str] = ()) -> bytes:
    """A GLB: of points where there are no indices. node : without its mesh; extensions : that readers must know."""
    length = sum(part.array.nbytes for part in parts)
    tree = json.dumps(_tree(parts, node, extensions, length), separators=(",", ":")).encode()
    tree += b" " * (-len(tree) % 4)
    chunks: list[bytes | memoryview] = [np.array([len(tree)], dtype="<u4").tobytes(), b"JSON", tree]
    if parts:
        filling = bytes(-length % 4)
        chunks += [np.array([length + len(filling)], dtype="<u4").tobytes(), b"BIN\0"]
        chunks += [*(part.array.reshape(-1).view(np.uint8).data for part in parts), filling]
    whole = 12 + sum(len(chunk) for chunk in chunks)
    return b"".join([_MAGIC, np.array([_VERSION, whole], dtype="<u4").tobytes(), *chunks])


def _tree(
    parts: Sequence[BufferPart], node: Mapping[str, object], extensions: Sequence[str], length: int
) -> dict[str, object]:
    tree: dict[str, object] = {
        "asset": {"version": "2.0", "generator": "slrig"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{**node, "mesh": 0} if parts else node],
    }
    if extensions:
        tree |= {"extensionsUsed": [*extensions], "extensionsRequired": [*extensions]}
    if not parts:
        return tree
    views, accessors, offset = [], [], 0
    for index, (name, array, kind, more) in enumerate(parts):
        target = _ELEMENT_ARRAY_BUFFER if name == INDICES else _ARRAY_BUFFER
        view = {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target}
        stride = array.nbytes // len(array)
        if stride != array.itemsize * _COMPONENTS[kind]:
            view["byteStride"] = stride
        views.append(view)
        component = _COMPONENT_TYPES[array.dtype.str]
        accessors.append({"bufferView": index, "count": len(array), "componentType": component, "type": kind, **more})
        offset += array.nbytes
    places = {part.name: index for index, part in enumerate(parts)}
    indices = places.pop(INDICES, None)
    drawn = {"mode": _POINTS} if indices is None else {"mode": _TRIANGLES, "indices": indices}
    tree["meshes"] = [{"name": "mesh_mm", "primitives": [{"attributes": places, "material": 0, **drawn}]}]
    # Without a dull material a viewer assumes metal, which shows little but reflections.
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}, "doubleSided": True}]
    tree |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": length}]}
    return tree

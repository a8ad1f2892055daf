"""Names and types of the files of a scan, and meshes as STL, OBJ, 3MF, glTF, and quantised for a page.

Of the latter, positions are multiples of one step, 1/65535 of the longest side, as KHR_mesh_quantization allows. In mm
and in the axes of the scan (x right, y down, z away) a vertex is at `origin_mm + step_mm * stored`, both in the node's
`extras`. The node itself places it as mesh.glb does: metres, y up, the front towards +z.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Mesh, srgb_to_linear
from slrig.plugins import formats

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


SIGMA_STEP_MM = 1e-4
COARSE_TRIANGLES = 30_000
"""What a coarse mesh has, by a third more or less."""

_MOST = 65535
_EXTENSION = "KHR_mesh_quantization"
_SAMPLED_TRIANGLES = 2**15


def encode_view_glb(mesh: Mesh) -> bytes:
    """Binary glTF 2.0 with KHR_mesh_quantization: 28 bytes for each vertex.

    POSITION uint16, NORMAL int8, COLOR_0 uint16, light as in mesh.glb; `_SIGMA` uint16, the standard deviation in
    0.1 µm (`sigma_step_mm` in the extras); `_STRIPE` uint16, the projector column. Their greatest value, 65535, says
    "that much or more, or not known". Each element begins at a multiple of 4 bytes (glTF 2.0, section 3.6.2.4), so the
    two last are 2 bytes of 4. Normals are left out if one is not known, as in mesh.glb.
    """
    count = len(mesh.vertices_mm)
    origin, step_mm = _lattice(mesh)
    node: dict[str, object] = {
        "name": "scan",
        "rotation": [*HALF_A_TURN_ABOUT_X],
        "scale": [METRES_PER_MM * step_mm] * 3,
        "translation": (METRES_PER_MM * origin * [1, -1, -1]).tolist(),
        "extras": {"origin_mm": origin.tolist(), "step_mm": step_mm, "sigma_step_mm": SIGMA_STEP_MM},
    }
    if not count:
        return encode_glb([], node, extensions=[_EXTENSION])
    positions = np.zeros((count, 4), dtype="<u2")
    positions[:, :3] = np.rint((mesh.vertices_mm - origin) / step_mm)
    ends = {"min": positions[:, :3].min(axis=0).tolist(), "max": positions[:, :3].max(axis=0).tolist()}
    parts = [BufferPart("POSITION", positions, "VEC3", ends)]
    if np.isfinite(mesh.normals).all():
        normals = np.zeros((count, 4), dtype=np.int8)
        normals[:, :3] = np.rint(mesh.normals * np.float32(127))
        parts.append(BufferPart("NORMAL", normals, "VEC3", {"normalized": True}))
    colours = np.full((count, 4), _MOST, dtype="<u2")
    colours[:, :3] = srgb_to_linear(mesh.colour)
    sigma, stripe = np.zeros((count, 2), dtype="<u2"), np.zeros((count, 2), dtype="<u2")
    sigma[:, 0] = np.fmin(np.rint(mesh.sigma_mm / np.float32(SIGMA_STEP_MM)), _MOST)
    # A negative number, read without its sign, is a great one.
    stripe[:, 0] = np.minimum(mesh.stripe.astype(np.uint32), _MOST)
    parts.append(BufferPart("COLOR_0", colours, "VEC4", {"normalized": True}))
    parts += [BufferPart("_SIGMA", sigma, "SCALAR"), BufferPart("_STRIPE", stripe, "SCALAR")]
    if len(mesh.faces):
        # The greatest value of the type names no vertex (section 3.7.2.1).
        kind = "<u2" if count <= _MOST else "<u4"
        parts.append(BufferPart(INDICES, np.ascontiguousarray(mesh.faces, dtype=kind).reshape(-1), "SCALAR"))
    return encode_glb(parts, node, extensions=[_EXTENSION])


def encode_coarse_glb(mesh: Mesh) -> bytes:
    """`coarse_mesh` as `encode_view_glb` writes it: a hundredth of the bytes, to be shown at once."""
    return encode_view_glb(coarse_mesh(mesh))


def coarse_mesh(mesh: Mesh) -> Mesh:
    """A mesh of about `COARSE_TRIANGLES` triangles, or the mesh itself where it has no more vertices and triangles.

    The vertices of each cell of a grid become one (Rossignac and Borrel 1993, "Multi-resolution 3D approximations for
    rendering complex scenes"): the one nearest to their mean, with its own normal, colour, deviation and stripe.
    Each vertex is thus one of the scan's, and what is measured between two of them holds; a mean of positions would be
    more certain than the mean or the greatest of their standard deviations says.

    Triangles keep their orientation. Those that lose a corner go, and of those with the same three corners the first
    stays. Where merging folds the surface over, so that a triangle looks away from its vertices' normals, it is turned
    round: left out it would leave a hole, and as it is it would be lit from behind. Of points alone it holds points.
    """
    if max(len(mesh.vertices_mm), len(mesh.faces)) <= COARSE_TRIANGLES:
        return mesh
    chosen, cells = _nearest_to_means(mesh)
    faces = cells[mesh.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    turned = (_twice_areas(mesh.vertices_mm[chosen], faces) * mesh.normals[chosen][faces].sum(axis=1)).sum(axis=1) < 0
    if len(faces):
        faces[turned] = faces[turned][:, ::-1]
        used, corners = np.unique(faces, return_inverse=True)
        chosen, faces = chosen[used], corners.reshape(-1, 3).astype(np.int32)
    of_vertices = {each.name: getattr(mesh, each.name)[chosen] for each in fields(mesh) if each.name != "faces"}
    return replace(mesh, faces=faces, **of_vertices)


def _nearest_to_means(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Of each cell that holds vertices, the vertex nearest to their mean, (C,); and of each vertex its cell, (V,)."""
    origin, step_mm = _lattice(mesh)
    cell_mm = max(math.sqrt(2 * _crossed_area_mm2(mesh) / COARSE_TRIANGLES), step_mm)
    x, y, z = ((mesh.vertices_mm - origin) / cell_mm).astype(np.int64).T
    places = (x * (y.max() + 1) + y) * (z.max() + 1) + z
    _, cells, sizes = np.unique(places, return_inverse=True, return_counts=True)
    away_mm2 = np.zeros(len(cells))
    for axis in mesh.vertices_mm.T:
        away_mm2 += (axis - (np.bincount(cells, axis) / sizes)[cells]) ** 2
    least_mm2 = np.full(len(sizes), np.inf)
    np.minimum.at(least_mm2, cells, away_mm2)
    nearest = np.flatnonzero(away_mm2 == least_mm2[cells])
    chosen = np.zeros(len(sizes), dtype=np.int64)
    chosen[cells[nearest]] = nearest
    return chosen, cells.astype(np.int32)


def _lattice(mesh: Mesh) -> tuple[FloatArray, float]:
    """The least corner, (3,), and the step that positions are multiples of, in mm: 1 where all are at one place."""
    if not len(mesh.vertices_mm):
        return np.zeros(3), 1.0
    origin = mesh.vertices_mm.min(axis=0).astype(np.float64)
    return origin, float((mesh.vertices_mm.max(axis=0) - origin).max()) / _MOST or 1.0


def _crossed_area_mm2(mesh: Mesh) -> float:
    """About the sum of the mesh's areas seen along x, y and z: so many cells of 1 mm does it cross, and a mesh of one
    vertex for each has twice as many triangles. Of points alone, a square.
    """
    some = mesh.faces[:: len(mesh.faces) // _SAMPLED_TRIANGLES | 1]
    shown_mm2 = float(np.abs(_twice_areas(mesh.vertices_mm, some)).sum()) / 2
    return shown_mm2 * len(mesh.faces) / max(len(some), 1) or float(np.ptp(mesh.vertices_mm, axis=0).max()) ** 2


def _twice_areas(points_mm: NDArray[np.float32], faces: NDArray[np.integer[Any]]) -> FloatArray:
    """(F, 3): the normal of each triangle, as long as twice its area."""
    a, b, c = np.moveaxis(points_mm[faces].astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)


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


_MODEL = "3D/3dmodel.model"
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_MATERIALS = "http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_XML = '<?xml version="1.0" encoding="UTF-8"?>\n'
_CONTENT_TYPES = (
    f'{_XML}<Types xmlns="{_PACKAGE}/content-types">'
    f'<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    f'<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_RELATIONS = (
    f'{_XML}<Relationships xmlns="{_PACKAGE}/relationships">'
    f'<Relationship Id="model" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel" Target="/{_MODEL}"/>'
    f"</Relationships>"
)
_POSITION_DECIMALS = 5


def encode_mesh_3mf(mesh: Mesh) -> bytes:
    """3MF in mm, with the sRGB colour of each corner of a triangle; positions have five decimals (10 nm).

    The object is called a model though its surface is open: programs that print or measure leave out what is not.
    """
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, text in (("[Content_Types].xml", _CONTENT_TYPES), ("_rels/.rels", _RELATIONS)):
            archive.writestr(_entry(name), text)
        # A piece at a time: the whole is ten times as long as the file.
        with archive.open(_entry(_MODEL), "w", force_zip64=True) as member:
            for piece in _model(mesh):
                member.write(piece.encode("ascii"))
    return out.getvalue()


def _entry(name: str) -> zipfile.ZipInfo:
    """Without a time, so that the same mesh gives the same bytes."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def _model(mesh: Mesh) -> Iterator[str]:
    packed = mesh.colour.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    palette, colour = np.unique(packed, return_inverse=True)
    yield f'{_XML}<model unit="millimeter" xml:lang="en-US" xmlns="{_CORE}" xmlns:m="{_MATERIALS}">\n<resources>\n'
    coloured = len(palette) > 0
    if coloured:
        yield '<m:colorgroup id="1">\n'
        yield from table_lines('<m:color color="#%06X"/>', palette[:, None])
        yield "</m:colorgroup>\n"
    shade = ' pid="1" pindex="0"' if coloured else ""
    yield f'<object id="2" type="model" name="scan"{shade}>\n<mesh>\n<vertices>\n'
    number = f"%.{_POSITION_DECIMALS}f"
    yield from table_lines(
        f'<vertex x="{number}" y="{number}" z="{number}"/>', rounded(mesh.vertices_mm, _POSITION_DECIMALS)
    )
    yield "</vertices>\n<triangles>\n"
    yield from table_lines(
        '<triangle v1="%d" v2="%d" v3="%d" pid="1" p1="%d" p2="%d" p3="%d"/>',
        np.hstack([mesh.faces, colour.reshape(-1)[mesh.faces]]),
    )
    yield '</triangles>\n</mesh>\n</object>\n</resources>\n<build><item objectid="2"/></build>\n</model>\n'


PREVIEW = "preview.png"
THUMBNAIL = "thumbnail.png"
"""The mesh of the preview alone, small, for lists."""

MEDIA_TYPES: Mapping[str, str] = {
    "mesh.ply": "application/octet-stream",
    "mesh.glb": "model/gltf-binary",
    "mesh.stl": "model/stl",
    "mesh.obj": "model/obj",
    "mesh.3mf": "model/3mf",
    "view.glb": "model/gltf-binary",
    "coarse.glb": "model/gltf-binary",
    "points.ply": "application/octet-stream",
    "report.json": "application/json",
    PREVIEW: "image/png",
}
"""Those that every scan that succeeded has."""

BUNDLE_ZIP = "bundle.zip"
"""The recorded frames, of a scan that failed, too."""

CALIBRATION_USED = "calibration.json"
"""The calibration that the mesh was made with: that in the bundle."""


def rejected_picture(camera: str) -> str:
    """The picture of a camera's refused pixels, for people.

    >>> rejected_picture("left")
    'rejected-left.png'
    """
    return f"rejected-{camera}.png"


def causes_picture(camera: str) -> str:
    """The same for programs: grey, a camera pixel each, whose value is the place of its cause in the report's `causes`.

    >>> causes_picture("left")
    'causes-left.png'
    """
    return f"causes-{camera}.png"


def agreement_picture(camera: str) -> str:
    """The picture of how columns and rows agree, of a scan that played both.

    >>> agreement_picture("left")
    'agreement-left.png'
    """
    return f"agreement-{camera}.png"


CLOUDS: Mapping[str, str] = {
    "points-{camera}.npz": "application/octet-stream",
    "points-{camera}.pcd": "application/octet-stream",
    "depth-{camera}.tiff": "image/tiff",
}
"""The surface in the grid of a camera, made on request by `slrig.scan.clouds`: names and media types."""


def requested_forms() -> Mapping[str, str]:
    """All files that the worker makes on request, those of plug-ins too: names and media types. Raises ConfigError."""
    return {**CLOUDS, **{each.name: each.media_type for each in formats()}}


def camera_prefixes() -> tuple[str, ...]:
    """Beginnings of the names of a camera's files.

    >>> camera_prefixes()
    ('rejected-', 'causes-', 'agreement-', 'depth-', 'points-')
    """
    of_cameras = {form.partition("{")[0] for form in requested_forms() if "{camera}" in form}
    return "rejected-", "causes-", "agreement-", *sorted(of_cameras)


def camera_files(camera: str) -> tuple[str, ...]:
    """The names of a camera's files.

    >>> camera_files("left")[:3]
    ('rejected-left.png', 'causes-left.png', 'agreement-left.png')
    """
    clouds = (form.format(camera=camera) for form in requested_forms() if "{camera}" in form)
    return rejected_picture(camera), causes_picture(camera), agreement_picture(camera), *clouds


def missing_for(name: str) -> str | None:
    """The command that installs what a file of this name, or form, needs; None if nothing is missing."""
    return next((each.missing for each in formats() if each.matches(name)), None)


def installed_by(name: str) -> str | None:
    """The command that installs what a file of this name needs where it is made; None if it needs nothing.

    >>> installed_by("points-left.e57"), installed_by("points-left.npz")
    ("pip install 'slrig[e57]'", None)
    """
    return next((each.install for each in formats() if each.matches(name)), None)


def on_demand(name: str, cameras: Iterable[str]) -> tuple[str, str | None] | None:
    """The form of `requested_forms` that a name has, and its camera; None if it has none of them.

    >>> on_demand("points-left.npz", ["left", "right"]), on_demand("scan.mcap", ["left"])
    (('points-{camera}.npz', 'left'), ('scan.mcap', None))
    """
    forms = requested_forms()
    if name in forms:
        return name, None
    known = ((form, camera) for camera in cameras for form in forms)
    return next((each for each in known if each[0].format(camera=each[1]) == name), None)


def offered(cameras: Iterable[str]) -> tuple[str, ...]:
    """The names of a scan's files. cameras : of the rig.

    >>> offered(["left"])[-4:]
    ('points-left.e57', 'scan.mcap', 'calibration.json', 'bundle.zip')
    """
    of_cameras = (name for camera in cameras for name in camera_files(camera))
    of_all = (form for form in requested_forms() if "{camera}" not in form)
    return *MEDIA_TYPES, *of_cameras, *of_all, CALIBRATION_USED, BUNDLE_ZIP

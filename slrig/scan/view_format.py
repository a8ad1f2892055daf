"""A mesh as a page shows it: quantised binary glTF with the standard deviations inside, and a coarse one to show first.

Positions are multiples of one step, 1/65535 of the longest side, as KHR_mesh_quantization allows. In mm and in the axes
of the scan (x right, y down, z away) a vertex stands at `origin_mm + step_mm * stored`, both in the node's `extras`.
The node itself places it as mesh.glb does: metres, y up, the front towards +z.
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Mesh, srgb_to_linear
from slrig.scan.gltf import HALF_A_TURN_ABOUT_X, INDICES, METRES_PER_MM, BufferPart, encode_glb

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

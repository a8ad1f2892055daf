"""Curves to a mesh: strips, the recorded step that drops what is no surface, orientation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing.runs import neighbouring_curves, whole_curves
from slrig.meshing.strips import strip_neighbours, strips, to_drop
from slrig.meshing.topology import component_sizes, kept_faces
from slrig.model import FloatArray, IntArray

_BLOCK = 4096  # faces to a sum; the sums are added up in order, the same for any number of threads
_SMALLEST_COMPONENT = 100
"""Pieces of fewer connected triangles are dust: a few stripe points that agreed by chance."""


@dataclass(frozen=True, slots=True)
class InitialMesh:
    """faces : (F, 3) int32 into the curves' points, counter-clockwise seen from the eye.
    adjacency : (F, 3) int32, entry k is the face across the edge opposite corner k, -1 at a boundary.
    strip_triangles : Σ(I + J - 2), before dropping; the drops at edges and bridges overlap, dust is what they leave in
    specks of a few triangles.
    """

    faces: IntArray
    adjacency: IntArray
    strip_pairs: int
    strip_triangles: int
    dropped_at_depth_edges: int
    dropped_at_bridges: int
    dropped_as_dust: int
    dropped_triangles: int


def initial_mesh(
    points_mm: FloatArray,
    offsets: IntArray,
    position_px: FloatArray,
    bridge_after: NDArray[np.bool_],
    sampling_mm: FloatArray,
    eye_mm: FloatArray,
    /,
    *,
    widest_step_px: float,
    depth_edge_ratio: float,
    keep_holes: bool,
    runs: IntArray | None = None,
) -> InitialMesh:
    """Mesh between neighbouring curves and drop what is no surface.

    points_mm : (n, 3) float64; offsets : (c + 1,) int32; position_px : (c,) float64; bridge_after : (n,) bool;
    sampling_mm : (n,) float64; eye_mm : (3,) float64, the camera that decides which side is the front.
    runs : (s, 4) int32, the parts to be joined, as `slrig.meshing.runs.parts_of_curves` gives them; without them whole
    neighbouring curves are.
    """
    if runs is None:
        runs = whole_curves(neighbouring_curves(position_px, offsets, widest_step_px=widest_step_px), offsets)
    everything = strips(points_mm, runs)
    adjacency = strip_neighbours(everything, runs, len(points_mm))
    at_depth_edge, at_bridge = to_drop(
        points_mm, everything, bridge_after, sampling_mm, depth_edge_ratio=depth_edge_ratio, keep_holes=keep_holes
    )
    connected = ~(at_depth_edge | at_bridge)
    kept = component_sizes(everything, connected) >= _SMALLEST_COMPONENT
    areas_mm2 = np.zeros(-(-len(everything) // _BLOCK))
    in_bands(_facing_areas, len(areas_mm2), np.ascontiguousarray(points_mm), everything, kept, eye_mm, areas_mm2)
    faces, across = kept_faces(everything, adjacency, kept)
    if areas_mm2.sum() < 0:
        faces, across = np.ascontiguousarray(faces[:, ::-1]), np.ascontiguousarray(across[:, ::-1])
    return InitialMesh(
        faces=faces,
        adjacency=across,
        strip_pairs=len(runs),
        strip_triangles=len(everything),
        dropped_at_depth_edges=int(np.count_nonzero(at_depth_edge)),
        dropped_at_bridges=int(np.count_nonzero(at_bridge)),
        dropped_as_dust=int(np.count_nonzero(connected)) - len(faces),
        dropped_triangles=len(everything) - len(faces),
    )


@kernel
def _facing_areas(first: int, last: int, points: Any, faces: Any, kept: Any, eye: Any, areas: Any) -> None:
    """For each block of faces, twice the area that faces the eye less the area that faces away."""
    # Blocks of one size, added up in order: the same sum for any number of threads.
    for block in range(first, last):
        total = 0.0
        for face in range(block * _BLOCK, min((block + 1) * _BLOCK, len(faces))):
            if not kept[face]:
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
            vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            towards = x * (eye[0] - points[a, 0]) + y * (eye[1] - points[a, 1]) + z * (eye[2] - points[a, 2])
            total += np.sign(towards) * np.sqrt(x * x + y * y + z * z)
        areas[block] = total

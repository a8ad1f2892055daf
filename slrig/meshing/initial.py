"""Curves to a mesh: strips, the recorded step that drops what is no surface, orientation, normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.meshing.strips import neighbouring_curves, strips, to_drop
from slrig.meshing.topology import component_labels, vertex_normals
from slrig.model import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class InitialMesh:
    """faces : (F, 3) int32 into the curves' points, counter-clockwise seen from the eye; normals : (n, 3) float32,
    NaN for points in no triangle. strip_triangles : Σ(I + J - 2), before dropping; the drops at edges and bridges
    overlap, dust is what they leave in specks of a few triangles.
    """

    faces: IntArray
    normals: NDArray[np.float32]
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
    smallest_component: int = 100,
) -> InitialMesh:
    """Mesh between neighbouring curves and drop what is no surface.

    points_mm : (n, 3) float64; offsets : (c + 1,) int32; position_px : (c,) float64; bridge_after : (n,) bool;
    sampling_mm : (n,) float64; eye_mm : (3,) float64, the camera that decides which side is the front.
    smallest_component : pieces of fewer connected triangles are dust: a few stripe points that agreed by chance.
    """
    pairs = neighbouring_curves(position_px, offsets, widest_step_px=widest_step_px)
    everything = strips(points_mm, offsets, pairs)
    drop = to_drop(
        points_mm, everything, bridge_after, sampling_mm, depth_edge_ratio=depth_edge_ratio, keep_holes=keep_holes
    )
    connected = everything[~drop.any]
    faces = connected[~_dust(connected, smallest_component)]
    if _facing_area_mm2(points_mm, faces, eye_mm) < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return InitialMesh(
        faces=faces,
        normals=vertex_normals(points_mm, faces),
        strip_pairs=len(pairs),
        strip_triangles=len(everything),
        dropped_at_depth_edges=int(drop.depth_edge.sum()),
        dropped_at_bridges=int(drop.bridge.sum()),
        dropped_as_dust=len(connected) - len(faces),
        dropped_triangles=len(everything) - len(faces),
    )


def _dust(faces: IntArray, smallest_component: int) -> NDArray[np.bool_]:
    """(F,) bool: triangles of pieces that are too small."""
    if not len(faces):
        return np.zeros(0, dtype=bool)
    labels = component_labels(faces)
    return np.asarray(np.bincount(labels)[labels] < smallest_component)


def _facing_area_mm2(points_mm: FloatArray, faces: IntArray, eye_mm: FloatArray) -> float:
    """Area that faces the eye less area that faces away."""
    corners = points_mm[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = np.sum((eye_mm - corners.mean(axis=1)) * normal, axis=1)
    return float(np.sum(np.sign(towards) * np.linalg.norm(normal, axis=1)) / 2)

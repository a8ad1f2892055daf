"""From curves to the finished mesh, stage by stage (Yang & Chen 2010, section 3): the rows of the paper's Table 1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.meshing.boundary import Shrunk, Smoothed, boundary_point_count, longest_boundary_edge_mm, shrunk, smoothed
from slrig.meshing.initial import InitialMesh, initial_mesh
from slrig.meshing.normals import vertex_normals
from slrig.meshing.optimisation import Optimised, optimised
from slrig.model import FlipRule, FloatArray, IntArray

FIRST_STAGE = "initial meshing"


@dataclass(frozen=True, slots=True)
class MeshingLimits:
    """How curves become a surface; the fields of the same names of a reconstruction's plan say what they mean.

    widest_step_px : neighbouring curves further apart than this are not meshed together.
    """

    widest_step_px: float
    depth_edge_ratio: float
    keep_holes: bool
    flip_rule: FlipRule
    smooth_boundary: bool


@dataclass(frozen=True, slots=True)
class Stage:
    """The mesh after one stage: a row of the paper's Table 1 but for the time."""

    name: str
    triangles: int
    boundary_points: int


@dataclass(frozen=True, slots=True)
class FinishedMesh:
    """faces : (F, 3) int32 into the curves' points, counter-clockwise seen from the eye; normals : (n, 3) float32,
    unit, NaN for points in no triangle; stages in order, and what the single steps did.

    The triangles of `smoothed` are those of `boundary_optimised`, which was done on them.
    """

    faces: IntArray
    normals: NDArray[np.float32]
    stages: tuple[Stage, ...]
    initial: InitialMesh
    optimised: Optimised
    shrunk: Shrunk | None
    smoothed: Smoothed | None
    boundary_optimised: Optimised | None


def finished_mesh(
    points_mm: FloatArray,
    offsets: IntArray,
    position_px: FloatArray,
    bridge_after: NDArray[np.bool_],
    sampling_mm: FloatArray,
    eye_mm: FloatArray,
    limits: MeshingLimits,
    /,
    *,
    entered: Callable[[str], None],
    runs: IntArray | None = None,
) -> FinishedMesh:
    """Mesh the curves: strips and what is dropped of them, global optimisation, boundary.

    Arrays as for `initial_mesh`. `entered` is told the name of each stage as it begins; `Stage.name` repeats it.
    """
    stages: list[Stage] = []

    def done(name: str, faces: IntArray, adjacency: IntArray | None) -> None:
        # Flips leave the boundary as it is: without an adjacency it is that of the stage before.
        points = stages[-1].boundary_points if adjacency is None else boundary_point_count(faces, adjacency)
        stages.append(Stage(name, len(faces), points))

    entered(FIRST_STAGE)
    initial = initial_mesh(
        points_mm, offsets, position_px, bridge_after, sampling_mm, eye_mm,
        widest_step_px=limits.widest_step_px, depth_edge_ratio=limits.depth_edge_ratio, keep_holes=limits.keep_holes,
        runs=runs,
    )  # fmt: skip
    done(FIRST_STAGE, initial.faces, initial.adjacency)
    entered("global optimisation")
    best = optimised(points_mm, initial.faces, rule=limits.flip_rule, adjacency=initial.adjacency)
    done("global optimisation", best.faces, None)
    faces, less, smooth, mended = best.faces, None, None, None
    if limits.smooth_boundary and len(faces):
        entered("shrinking boundary")
        less = shrunk(points_mm, faces, longest_boundary_edge_mm(points_mm, faces), adjacency=best.adjacency)
        done("shrinking boundary", less.faces, less.adjacency)
        entered("smoothing boundary")
        allowed_mm = limits.depth_edge_ratio * sampling_mm
        if limits.keep_holes:
            # Nothing is filled in at a bridge: what was left open there is to stay open.
            ends = np.flatnonzero(bridge_after)
            allowed_mm[np.concatenate([ends, ends + 1])] = -np.inf
        smooth = smoothed(points_mm, less.faces, allowed_mm, adjacency=less.adjacency)
        done("smoothing boundary", smooth.faces, smooth.adjacency)
        entered("optimising boundary")
        mended = optimised(
            points_mm, smooth.faces, rule=limits.flip_rule, among=smooth.added, adjacency=smooth.adjacency,
            # Nothing is flipped unless triangles were added, and then the arrays are the smoothing's own.
        )  # fmt: skip
        done("optimising boundary", mended.faces, None)
        faces = mended.faces
    entered("vertex normals")
    return FinishedMesh(
        faces=faces,
        normals=vertex_normals(points_mm, faces),
        stages=tuple(stages),
        initial=initial,
        optimised=best,
        shrunk=less,
        smoothed=smooth,
        boundary_optimised=mended,
    )

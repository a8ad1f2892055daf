"""From curves to the finished mesh, stage by stage (Yang & Chen 2010, section 3): the rows of the paper's Table 1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slrig.meshing.boundary import boundary_point_count, longest_boundary_edge_mm, shrunk, smoothed
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
    unit, NaN for points in no triangle; stages in order.

    steps : what the single steps did, in figures: their own meshes would take several times the memory of the last one.
    `initial`, `optimisation` (paper, Fig. 10, turn by turn), and `boundary` where that was smoothed.
    """

    faces: IntArray
    normals: NDArray[np.float32]
    stages: tuple[Stage, ...]
    steps: Mapping[str, Mapping[str, object]]

    def of_points(self, kept: NDArray[np.bool_], step: str, /) -> FinishedMesh:
        """The triangles all of whose points are kept, (n,) bool; `step` names this one among `steps`."""
        faces = self.faces[kept[self.faces].all(axis=1)]
        dropped = {"points": int(np.count_nonzero(~kept)), "triangles": len(self.faces) - len(faces)}
        return replace(self, faces=faces, steps={**self.steps, step: dropped})


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

    No mesh of an earlier step is kept: of millions of triangles each takes as much memory as the points.
    Arrays as for `initial_mesh`. `entered` is told the name of each stage as it begins; `Stage.name` repeats it.
    """
    stages: list[Stage] = []
    steps: dict[str, Mapping[str, object]] = {}

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
    faces, adjacency = initial.faces, initial.adjacency
    done(FIRST_STAGE, faces, adjacency)
    steps["initial"] = _of_initial(initial)
    del initial
    entered("global optimisation")
    best = optimised(points_mm, faces, rule=limits.flip_rule, adjacency=adjacency)
    faces, adjacency = best.faces, best.adjacency
    done("global optimisation", faces, None)
    steps["optimisation"] = _of_flips(best)
    del best
    if limits.smooth_boundary and len(faces):
        entered("shrinking boundary")
        less = shrunk(points_mm, faces, longest_boundary_edge_mm(points_mm, faces), adjacency=adjacency)
        faces, adjacency, shrunk_triangles = less.faces, less.adjacency, less.removed_triangles
        del less
        done("shrinking boundary", faces, adjacency)
        entered("smoothing boundary")
        allowed_mm = limits.depth_edge_ratio * sampling_mm
        if limits.keep_holes:
            # Nothing is filled in at a bridge: what was left open there is to stay open.
            ends = np.flatnonzero(bridge_after)
            allowed_mm[np.concatenate([ends, ends + 1])] = -np.inf
        smooth = smoothed(points_mm, faces, allowed_mm, adjacency=adjacency)
        faces, adjacency = smooth.faces, smooth.adjacency
        added, removed_triangles, rounds = smooth.added, smooth.removed_triangles, smooth.rounds
        del smooth
        done("smoothing boundary", faces, adjacency)
        entered("optimising boundary")
        # Nothing is flipped unless triangles were added, and then the arrays are the smoothing's own.
        mended = optimised(points_mm, faces, rule=limits.flip_rule, among=added, adjacency=adjacency)
        faces = mended.faces
        done("optimising boundary", faces, None)
        steps["boundary"] = {
            "shrunk_triangles": shrunk_triangles,
            "added_triangles": int(np.count_nonzero(added)),
            "removed_triangles": removed_triangles,
            "rounds": rounds,
            "optimisation": _of_flips(mended),
        }
        del mended
    del adjacency
    entered("vertex normals")
    return FinishedMesh(faces, vertex_normals(points_mm, faces), tuple(stages), steps)


def _of_initial(made: InitialMesh) -> dict[str, object]:
    return {
        "strips": made.strip_pairs,
        "strip_triangles": made.strip_triangles,
        "dropped_at_depth_edges": made.dropped_at_depth_edges,
        "dropped_at_bridges": made.dropped_at_bridges,
        "dropped_as_dust": made.dropped_as_dust,
        "dropped_triangles": made.dropped_triangles,
        "triangles": len(made.faces),
    }


def _of_flips(made: Optimised) -> dict[str, object]:
    return {
        "harmonic_index_before": made.harmonic_index_before,
        "turns": [asdict(turn) for turn in made.turns],
        "flipped_edges": sum(turn.flipped_edges for turn in made.turns),
        "ended_by": made.ended_by,
    }

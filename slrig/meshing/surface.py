"""Surface from curves, step by step (Yang & Chen 2010, section 3): strips, edge flips, boundary, normals.

The steps are the rows of the paper's Table 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numba import config
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.boundary import boundary_point_count, max_boundary_edge_mm, shrink_boundary, smooth_boundary
from slrig.meshing.facing import Viewpoints, facing_sides
from slrig.meshing.flips import EdgeOptimisation, angle_rad, optimise_edges
from slrig.meshing.strips import MIN_COMPONENT, InitialMesh, initial_mesh
from slrig.meshing.topology import component_sizes, select_faces, used_vertices
from slrig.model import FlipRule, FloatArray, IntArray, Mesh

_BLOCK = 488  # not a power of two: rows of a page each would share cache sets


def vertex_normals(vertices_mm: NDArray[np.floating[Any]], faces: IntArray) -> NDArray[np.float32]:
    """(V, 3) float32, unit: mean normal of the triangles at each vertex, weighted by their angle there.

    Weighting by angle makes the normal independent of how the surface is cut into triangles
    (Thürmer and Wüthrich 1998, "Computing vertex normals from polygonal facets").
    NaN where no triangle with an area meets the vertex.
    """
    points = np.ascontiguousarray(vertices_mm, dtype=np.float64)
    sums = np.zeros((len(points), 3))
    normals = np.full((len(points), 3), np.nan, dtype=np.float32)
    parts = config.NUMBA_NUM_THREADS
    in_bands(_add_normals, parts, points, np.ascontiguousarray(faces), parts, sums)
    in_bands(_unit_normals, len(points), sums, normals)
    return normals


@kernel_part
def _weight_normals(count: int, work: Any) -> None:
    """From normals as long as twice the area, (0, 1, 2), and the dots of the edges at a and b, (3, 4), of up to _BLOCK
    triangles, their unit normals and their angles at a, b and c, (3, 4, 5).

    Row r of `work` is work[r * _BLOCK :]. This loop does nothing else, so that it is vectorised.
    """
    for at in range(count):
        nx, ny, nz = work[at], work[_BLOCK + at], work[2 * _BLOCK + at]
        twice_area = np.sqrt(nx * nx + ny * ny + nz * nz)
        # The cross product of any two edges is twice the area: each angle is atan2(2 A, dot of the edges there).
        at_a = angle_rad(twice_area, work[3 * _BLOCK + at])
        at_b = angle_rad(twice_area, work[4 * _BLOCK + at])
        work[at], work[_BLOCK + at], work[2 * _BLOCK + at] = nx / twice_area, ny / twice_area, nz / twice_area
        work[3 * _BLOCK + at], work[4 * _BLOCK + at], work[5 * _BLOCK + at] = at_a, at_b, np.pi - at_a - at_b


@kernel
def _add_normals(begin: int, end: int, points: Any, faces: Any, parts: int, sums: Any) -> None:
    # Each part visits all faces and adds to a range of vertices: sums are in the order of the faces, the same for any
    # number of threads.
    for part in range(begin, end):
        low, high = len(points) * part // parts, len(points) * (part + 1) // parts
        work, listed = np.zeros(6 * _BLOCK), np.zeros(_BLOCK, dtype=np.int32)
        face = 0
        while face < len(faces):
            count = 0
            while face < len(faces) and count < _BLOCK:
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                face += 1
                if not (low <= a < high or low <= b < high or low <= c < high):
                    continue
                ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
                vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
                work[count] = uy * vz - uz * vy
                work[_BLOCK + count] = uz * vx - ux * vz
                work[2 * _BLOCK + count] = ux * vy - uy * vx
                work[3 * _BLOCK + count] = ux * vx + uy * vy + uz * vz
                work[4 * _BLOCK + count] = ux * (ux - vx) + uy * (uy - vy) + uz * (uz - vz)
                listed[count] = face - 1
                count += 1
            _weight_normals(count, work)
            for at in range(count):
                x, y, z = work[at], work[_BLOCK + at], work[2 * _BLOCK + at]
                # A triangle without area has no normal: it was divided by zero.
                if not x * x + y * y + z * z > 0.0:
                    continue
                for corner in range(3):
                    vertex, angle = faces[listed[at], corner], work[(3 + corner) * _BLOCK + at]
                    if low <= vertex < high:
                        sums[vertex, 0] += angle * x
                        sums[vertex, 1] += angle * y
                        sums[vertex, 2] += angle * z


@kernel
def _unit_normals(first: int, last: int, sums: Any, normals: Any) -> None:
    for vertex in range(first, last):
        x, y, z = sums[vertex, 0], sums[vertex, 1], sums[vertex, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            normals[vertex, 0], normals[vertex, 1], normals[vertex, 2] = x / length, y / length, z / length


def compact_mesh(
    faces: IntArray,
    points_mm: FloatArray,
    normals: NDArray[np.float32],
    colour: NDArray[np.uint8],
    mark: NDArray[np.uint8],
    sigma_mm: FloatArray,
    offsets: IntArray,
    position_px: FloatArray,
    /,
) -> Mesh:
    """Mesh of the points that faces use, in their order.

    faces : (F, 3) int32 into points_mm (n, 3) float64; normals (n, 3), colour (n, 3), mark (n,), sigma_mm (n,) of
    the points.
    offsets : (c + 1,) int32, curve i holds points offsets[i]:offsets[i + 1], all points belong to one;
    position_px : (c,) float64, projector column of each curve.
    """
    used = used_vertices(faces, len(points_mm))
    numbers, where = np.cumsum(used, dtype=np.int32) - np.int32(1), np.flatnonzero(used)
    return Mesh(
        vertices_mm=np.take(points_mm, where, axis=0).astype(np.float32),
        faces=numbers[faces],
        normals=np.take(normals, where, axis=0),
        colour=np.take(colour, where, axis=0),
        mark=np.take(mark, where),
        sigma_mm=np.take(sigma_mm, where).astype(np.float32),
        stripe=np.take(np.repeat(np.floor(position_px).astype(np.int32), np.diff(offsets)), where),
    )


FIRST_STAGE = "initial meshing"


@dataclass(frozen=True, slots=True)
class MeshingLimits:
    """Options of the meshing; see the fields of the same names in `slrig.scan.plan.ReconstructionPlan`.

    widest_step_px : neighbouring curves further apart than this are not meshed together.
    """

    widest_step_px: float
    depth_edge_ratio: float
    keep_holes: bool
    flip_rule: FlipRule
    smooth_boundary: bool


@dataclass(frozen=True, slots=True)
class MeshStage:
    """Size of the mesh after one step: a row of the paper's Table 1 without its time."""

    name: str
    triangles: int
    boundary_points: int


@dataclass(frozen=True, slots=True)
class SurfaceMesh:
    """The surface through the points of all curves.

    faces : (F, 3) int32 into the curves' points, counter-clockwise seen from their cameras; normals : (n, 3) float32,
    unit, NaN for points without a triangle. mirror_faces : (M, 3) int32, dropped mirror images. stages : in order.
    steps : statistics of each step: `initial`, `optimisation` (Fig. 10, round by round), `boundary` if it was smoothed,
    and `facing`: the triangles dropped in the end because a device that measured them sees their back, and the dust
    left by that.
    """

    faces: IntArray
    mirror_faces: IntArray
    normals: NDArray[np.float32]
    stages: tuple[MeshStage, ...]
    steps: Mapping[str, Mapping[str, object]]

    def among_points(self, mask: NDArray[np.bool_], /) -> SurfaceMesh:
        """The same faces in points without those outside the mask, (n,) bool, which no face uses; no mirror images."""
        numbers = np.cumsum(mask, dtype=np.int32) - np.int32(1)
        return replace(self, faces=numbers[self.faces], normals=self.normals[mask], mirror_faces=self.mirror_faces[:0])

    def with_points(self, mask: NDArray[np.bool_], step: str, /) -> SurfaceMesh:
        """Keep the triangles whose three points are in the mask, (n,) bool; `step` names this step in `steps`."""
        faces = self.faces[mask[self.faces].all(axis=1)]
        dropped = {"points": int(np.count_nonzero(~mask)), "triangles": len(self.faces) - len(faces)}
        return replace(self, faces=faces, steps={**self.steps, step: dropped})


def build_surface(
    points_mm: FloatArray,
    offsets: IntArray,
    position_px: FloatArray,
    bridge_after: NDArray[np.bool_],
    sampling_mm: FloatArray,
    views: Viewpoints,
    limits: MeshingLimits,
    /,
    *,
    on_step: Callable[[str], None],
    runs: IntArray | None = None,
) -> SurfaceMesh:
    """Mesh the curves: strips, dropped triangles, global optimisation, boundary.

    Meshes of earlier steps are freed: with millions of triangles each takes as much memory as the points.
    Arrays as for `initial_mesh`. on_step : called with the name of each step when it begins.
    """
    stages: list[MeshStage] = []
    steps: dict[str, Mapping[str, object]] = {}

    def add_stage(name: str, faces: IntArray, adjacency: IntArray | None) -> None:
        # Flips do not change the boundary: without an adjacency it is that of the previous step.
        points = stages[-1].boundary_points if adjacency is None else boundary_point_count(faces, adjacency)
        stages.append(MeshStage(name, len(faces), points))

    on_step(FIRST_STAGE)
    initial = initial_mesh(
        points_mm, offsets, position_px, bridge_after, sampling_mm, views,
        widest_step_px=limits.widest_step_px, depth_edge_ratio=limits.depth_edge_ratio, keep_holes=limits.keep_holes,
        runs=runs,
    )  # fmt: skip
    faces, adjacency, mirror_faces = initial.faces, initial.adjacency, initial.mirror_faces
    add_stage(FIRST_STAGE, faces, adjacency)
    steps["initial"] = _initial_figures(initial)
    del initial
    on_step("global optimisation")
    best = optimise_edges(points_mm, faces, rule=limits.flip_rule, adjacency=adjacency)
    faces, adjacency = best.faces, best.adjacency
    add_stage("global optimisation", faces, None)
    steps["optimisation"] = _flip_figures(best)
    del best
    if limits.smooth_boundary and len(faces):
        on_step("shrinking boundary")
        less = shrink_boundary(points_mm, faces, max_boundary_edge_mm(points_mm, faces), adjacency=adjacency)
        faces, adjacency, shrunk_triangles = less.faces, less.adjacency, less.removed_triangles
        del less
        add_stage("shrinking boundary", faces, adjacency)
        on_step("smoothing boundary")
        allowed_mm = limits.depth_edge_ratio * sampling_mm
        if limits.keep_holes:
            # Fill nothing at a bridge: gaps there stay open.
            ends = np.flatnonzero(bridge_after)
            allowed_mm[np.concatenate([ends, ends + 1])] = -np.inf
        smooth = smooth_boundary(points_mm, faces, allowed_mm, adjacency=adjacency)
        faces, adjacency = smooth.faces, smooth.adjacency
        added, removed_triangles, rounds = smooth.added, smooth.removed_triangles, smooth.rounds
        del smooth
        add_stage("smoothing boundary", faces, adjacency)
        on_step("optimising boundary")
        # Flips happen only if triangles were added, and then the arrays belong to the smoothing step.
        optimised = optimise_edges(points_mm, faces, rule=limits.flip_rule, among=added, adjacency=adjacency)
        faces, adjacency = optimised.faces, optimised.adjacency
        add_stage("optimising boundary", faces, None)
        steps["boundary"] = {
            "shrunk_triangles": shrunk_triangles,
            "added_triangles": int(np.count_nonzero(added)),
            "removed_triangles": removed_triangles,
            "rounds": rounds,
            "optimisation": _flip_figures(optimised),
        }
        del optimised
    fronts = facing_sides(points_mm, faces, views) > 0
    backs, dust = len(faces) - int(np.count_nonzero(fronts)), 0
    if backs:
        # Flips of edges correct most triangles that noise turned, and fold a few others over.
        remaining = component_sizes(faces, fronts) >= MIN_COMPONENT
        faces, adjacency = select_faces(faces, adjacency, remaining)
        dust = len(fronts) - backs - len(faces)
        stages[-1] = replace(stages[-1], triangles=len(faces), boundary_points=boundary_point_count(faces, adjacency))
    steps["facing"] = {"dropped_triangles": backs, "dropped_as_dust": dust}
    del adjacency
    on_step("vertex normals")
    return SurfaceMesh(faces, mirror_faces, vertex_normals(points_mm, faces), tuple(stages), steps)


def _initial_figures(made: InitialMesh) -> dict[str, object]:
    return {
        "strips": made.strip_pairs,
        "strip_triangles": made.strip_triangles,
        "dropped_at_depth_edges": made.dropped_at_depth_edges,
        "dropped_at_bridges": made.dropped_at_bridges,
        "dropped_as_mirror_images": len(made.mirror_faces),
        "dropped_as_dust": made.dropped_as_dust,
        "dropped_triangles": made.dropped_triangles,
        "triangles": len(made.faces),
    }


def _flip_figures(made: EdgeOptimisation) -> dict[str, object]:
    return {
        "harmonic_index_before": made.harmonic_index_before,
        "turns": [asdict(turn) for turn in made.turns],
        "flipped_edges": sum(turn.flipped_edges for turn in made.turns),
        "ended_by": made.ended_by,
    }

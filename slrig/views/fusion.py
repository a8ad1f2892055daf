"""Several views of one object, their poses known, to one mesh of their mean surface: watertight where it was seen.

The views' signed distances are averaged on a sparse grid (after Curless and Levoy 1996, "A volumetric method for
building complex models from range images", with exact distances to triangles and σ as weight), the surface where the
mean is zero is netted, and each vertex moved onto the mean surface along its normal: the grid decides how the mesh
hangs together, and not where it lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.errors import InvalidInputError, NothingToReconstructError
from slrig.kernels import in_bands, kernel
from slrig.meshing import component_sizes, optimise_edges, smooth_boundary, used_vertices, vertex_normals
from slrig.model import FloatArray, IntArray, Mesh
from slrig.model.arrays import require
from slrig.model.srgb import srgb_of
from slrig.views.fusion_colour import to_one_scale
from slrig.views.fusion_edges import sharpened
from slrig.views.fusion_grid import SEEN_BEYOND, Grid, corners_mm, grid_about, wanted_corners
from slrig.views.fusion_mean import (
    AGREEING_SIGMAS,
    Means,
    PoseErrors,
    Rule,
    exact_poses,
    mean_values,
    with_correlated,
)
from slrig.views.fusion_nearest import nearest_to_corners, nearest_within
from slrig.views.fusion_net import Net, net
from slrig.views.fusion_sheets import Sheets, sampling_mm, sheets

NO_STRIPE = -1
"""The stripe of a vertex that several views have found."""
LEAST_CORRELATED_MM = 0.001  # where views say nothing of one another; the line's centre is not known better
SHARED_MM = 0.002
"""The least that a calibration bends all views of a rig alike, which none of them tells; chosen, for a good rig."""
_CORNER_BEYOND = 1.5  # voxels: corners of the cells that are within what is seen
_TELLING = 0.5  # voxels: as near as this to the surface, distances to two views of it may be compared
_VERTEX_REACH = 0.5  # voxels: a cell's vertex is nearer to the mean surface
_COARSER = 1.25  # than the views' points lie apart: 0.1 µm of 5.5 more error, 0.6 of the time; 1.7 is 1.2 µm more
_FINEST = 0.2  # of the views' sampling; work and memory rise with its square
_FURTHEST = 0.75  # voxels from a cell's vertex to a sharp edge through the cell
_BORDER = 4.0  # voxels over which a view's weight rises from its border: no step where it ends, and edges are worse
_LONGEST_EDGE = 3.0  # voxels; a cell's vertex and those beside it are at most 2√2 apart
_HALVES = np.array([[[0, 1, 3], [1, 2, 3]], [[0, 1, 2], [0, 2, 3]]])
"""Corners of a quadrangle's two triangles, along its second diagonal and along its first."""
_OUTWARD, _FOLDED = 1, 2  # how a triangle faces that was seen
_FEWEST_TRIANGLES = 20  # of a piece: fewer are dust, and of a false layer: fewer are folds


@dataclass(frozen=True, slots=True)
class FusedModel:
    """One mesh in the model's frame, with stripe -1, and what supports it.

    views : (V,) int32, how many views each vertex was averaged from. voxel_mm : of the grid. correlated_mm : standard
    deviation of the error that neighbouring points of one view, poses included, were found to have in common.
    """

    mesh: Mesh
    views: IntArray
    voxel_mm: float
    correlated_mm: float

    def __post_init__(self) -> None:
        require(self.views, "FusedModel.views", (len(self.mesh.vertices_mm),), "i")


def fused(
    views: Sequence[Mesh],
    poses: Sequence[FloatArray] | FloatArray,
    /,
    *,
    voxel_mm: float | None = None,
    shared_mm: float = SHARED_MM,
    pose_errors: PoseErrors | None = None,
) -> FusedModel:
    """The mean surface of the views, where at least one has seen it.

    views : each in a frame of its own. poses : (4, 4) float64 each, X_model = R X_view + t. voxel_mm : side of the
    grid's cells, about the length of the mesh's edges; 1.25 times as far as the views' vertices are apart unless given.
    shared_mm : standard deviation of the error that all views have in common, which no comparison of them can show.
    pose_errors : how well the poses are known, which counts in the mesh's σ; exactly unless given.

    Raises
    ------
    ValueError
        A pose is not rigid.
    InvalidInputError
        A view is no manifold, or the voxels are finer than the views or than memory is meant for.
    NothingToReconstructError
        No view has a triangle, or the voxels are larger than what was seen.
    """
    sampled = sampling_mm(views)
    voxel = _COARSER * sampled if voxel_mm is None else voxel_mm
    if voxel_mm is not None and not _FINEST * sampled <= voxel_mm < np.inf:
        message = (
            f"voxel_mm: expected at least {_FINEST * sampled:.2g}, as the views have a point each {sampled:.2g} mm, "
            f"found {voxel_mm:g}; finer cells hold nothing more"
        )
        raise InvalidInputError(message)
    border = _BORDER * voxel
    seen = sheets(views, poses, inset_mm=border)
    grid = grid_about(seen, voxel)
    known = exact_poses(len(views)) if pose_errors is None else pose_errors
    least = LEAST_CORRELATED_MM
    rule, rough = _netted(seen, grid, Rule(least, least, shared_mm, _CORNER_BEYOND * voxel, border, known))
    rule = rule._replace(beyond_mm=SEEN_BEYOND * voxel)
    reach = _VERTEX_REACH * voxel + AGREEING_SIGMAS * float(np.nanmedian(seen.sigma_mm))
    nearest = nearest_within(seen, grid, rough.points_mm, rough.cells, reach_mm=reach)
    to_one_scale(seen, nearest)
    means = mean_values(seen, rough.points_mm, nearest, rule, values_only=False)
    del seen, grid, nearest  # as large as all views
    points = rough.points_mm - means.value_mm[:, None] * means.normals
    faces = _sound(points, rough.quads, means)
    points = sharpened(points, means.normals, rough.quads, furthest_mm=_FURTHEST * voxel)
    faces = _mended(points, faces, voxel)
    if not len(faces):
        message = f"no surface was found with voxels of {voxel:g} mm; ask for smaller ones than what is to be seen"
        raise NothingToReconstructError(message)
    used = used_vertices(faces, len(points))
    numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
    mesh = Mesh(
        points[used].astype(np.float32), numbers[faces], vertex_normals(points, faces)[used],
        srgb_of(means.light[used]), means.mark[used],
        means.sigma_mm[used].astype(np.float32), np.full(int(used.sum()), NO_STRIPE, dtype=np.int32),
    )  # fmt: skip
    return FusedModel(mesh, means.views[used], voxel, rule.correlated_mm)


def _netted(seen: Sheets, grid: Grid, rule: Rule) -> tuple[Rule, Net]:
    """The rule with c and d as the views tell them, and the surface as the grid has it."""
    cells = wanted_corners(seen, grid)
    corners = corners_mm(grid, cells)
    nearest = nearest_to_corners(seen, grid, corners, cells)
    rule = with_correlated(rule, seen, corners, nearest, within_mm=_TELLING * grid.voxel_mm)
    values = np.full(512 * len(grid.keys), np.nan, dtype=np.float32)
    values[cells] = mean_values(seen, corners, nearest, rule, values_only=True).value_mm
    return rule, net(grid, values)


def _sound(points: FloatArray, quads: IntArray, means: Means) -> IntArray:
    """(F, 3) int32: two triangles of each quadrangle, along its shorter diagonal, without those that are no surface.

    Those are beyond what was seen, or run through a place where the views' field jumps: they face the wrong way.
    """
    faces, facing = np.zeros((2 * len(quads), 3), dtype=np.int32), np.zeros(2 * len(quads), dtype=np.uint8)
    in_bands(_halve, len(quads), quads, points, means.normals, faces, facing)
    # A few triangles folded over at a sharp edge are no false layer.
    folded = facing == _FOLDED
    return np.ascontiguousarray(
        faces[(facing == _OUTWARD) | folded & (component_sizes(faces, folded) < _FEWEST_TRIANGLES)]
    )


@kernel(in_every_scan=False)
def _halve(first: int, last: int, quads: Any, points: Any, normals: Any, faces: Any, facing: Any) -> None:
    """Both triangles of each quadrangle, and whether one faces as the normal of a corner does; neither with a NaN."""
    for quad in range(first, last):
        one, other = 0.0, 0.0
        for axis in range(3):
            one += (points[quads[quad, 0], axis] - points[quads[quad, 2], axis]) ** 2
            other += (points[quads[quad, 1], axis] - points[quads[quad, 3], axis]) ** 2
        for half in range(2):
            face = 2 * quad + half
            for corner in range(3):
                faces[face, corner] = quads[quad, _HALVES[int(one <= other), half, corner]]
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
            vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            seen, outward = True, False
            for corner in range(3):
                normal = faces[face, corner]
                along = nx * normals[normal, 0] + ny * normals[normal, 1] + nz * normals[normal, 2]
                seen &= not np.isnan(along)
                outward |= along > 0.0
            facing[face] = 0 if not seen else _OUTWARD if outward else _FOLDED


def _mended(points: FloatArray, faces: IntArray, voxel_mm: float) -> IntArray:
    """Flipped to the shape of the surface, its border smoothed, without dust."""
    points = np.nan_to_num(points)
    best = optimise_edges(points, faces)
    allowed: NDArray[np.float64] = np.full(len(points), _LONGEST_EDGE * voxel_mm)
    smooth = smooth_boundary(points, best.faces, allowed, adjacency=best.adjacency)
    faces = optimise_edges(points, smooth.faces, among=smooth.added, adjacency=smooth.adjacency).faces
    sizes = component_sizes(faces, np.ones(len(faces), dtype=np.bool_))
    return np.ascontiguousarray(faces[sizes >= _FEWEST_TRIANGLES])

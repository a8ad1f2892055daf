"""From curves to a triangle mesh: strips, flips, boundary, quality."""

from slrig.meshing.boundary import smooth_boundary
from slrig.meshing.facing import Viewpoints
from slrig.meshing.flips import optimise_edges
from slrig.meshing.quality import mesh_figures, nearest_on_triangle, score, weighted_percentiles
from slrig.meshing.rasteriser import (
    covered_pixels,
    depth_ranges,
    merge_depth_buffers,
    rasterise,
    rasterise_normals,
)
from slrig.meshing.strips import initial_mesh, runs_of_curve_parts
from slrig.meshing.surface import (
    FIRST_STAGE,
    MeshingLimits,
    MeshStage,
    SurfaceMesh,
    build_surface,
    compact_mesh,
    vertex_normals,
)
from slrig.meshing.topology import (
    boundary_vertices,
    component_sizes,
    neighbours,
    open_borders,
    used_vertices,
)

__all__ = [
    "FIRST_STAGE",
    "MeshStage",
    "MeshingLimits",
    "SurfaceMesh",
    "Viewpoints",
    "boundary_vertices",
    "build_surface",
    "compact_mesh",
    "component_sizes",
    "covered_pixels",
    "depth_ranges",
    "initial_mesh",
    "merge_depth_buffers",
    "mesh_figures",
    "nearest_on_triangle",
    "neighbours",
    "open_borders",
    "optimise_edges",
    "rasterise",
    "rasterise_normals",
    "runs_of_curve_parts",
    "score",
    "smooth_boundary",
    "used_vertices",
    "vertex_normals",
    "weighted_percentiles",
]

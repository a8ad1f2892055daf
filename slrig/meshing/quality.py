"""Figures about a mesh: its shape by itself, and its error against a surface that is known."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.meshing.angles import angle_rad
from slrig.meshing.search_tree import SearchTree
from slrig.meshing.topology import degenerate_faces, topology_counts
from slrig.model import FloatArray, IntArray, Mesh, Surface

_MESH_SAMPLES = 200_000
_VISIBLE_SAMPLES = 60_000  # a share of so many is known to 0.2 %; rays are what takes the time
_FACES_AT_ONCE = 200_000  # some tens of megabytes
# What the figures of `TruthScore` are named for: reports are compared by them.
_GROSS_MM = 1.0
_FALSE_MM = 0.5
_WELD_MM = 1e-3
_SLIVER_DEG = 10.0
_ONE_SIGMA_PERCENT = 68.27  # of a normal distribution within one standard deviation
_BLOCK = 4096  # faces to a row of sums, which are added up in order
_CLASSES = 4096  # of values; only one of them is sorted
_FLAT_MM2 = 1e-9
_ASIDE_MM = 0.05  # off vertices and edges


@dataclass(frozen=True, slots=True)
class TruthScore:
    """How far a mesh is from the surface that was scanned, millimetres; NaN where the mesh has nothing to measure.

    rms_mm : over the mesh's area, of distances to the true surface below 1 mm.
    p50_mm, p95_mm, p99_mm : percentiles of all those distances, by area.
    gross_fraction, false_area_05mm : share of the mesh's area that is 1 mm, more than 0.5 mm from the true surface.
    complete_01mm, complete_03mm : share of the visible points that are covered to this tolerance: the mesh passes so
        near to the point, and what the camera's ray to the point meets first in the mesh is so near to the surface.
    extra_layer_fraction : share of the camera's rays that cross the mesh more than once.
    nonmanifold_edges, misoriented_edges, duplicate_faces, degenerate_faces : after welding vertices at 1 µm.
    facing_camera_fraction : share of the mesh's area whose front the camera sees.
    error_over_sigma_p68 : 68.27 % of the vertices are at most this many of their own standard deviations from the
        true surface: 1 if the stated uncertainty is honest. NaN if the mesh states none.
    """

    rms_mm: float
    p50_mm: float
    p95_mm: float
    p99_mm: float
    gross_fraction: float
    false_area_05mm: float
    complete_01mm: float
    complete_03mm: float
    extra_layer_fraction: float
    nonmanifold_edges: int
    misoriented_edges: int
    duplicate_faces: int
    degenerate_faces: int
    facing_camera_fraction: float
    error_over_sigma_p68: float

    def as_dict(self) -> dict[str, float | int]:
        """The figures under the names that a report shows."""
        shown = {
            "false_area_05mm": "false_area_0.5mm",
            "complete_01mm": "complete_0.1mm",
            "complete_03mm": "complete_0.3mm",
            "facing_camera_fraction": "facing_camera_area",
        }
        return {shown.get(name, name): value for name, value in asdict(self).items()}


def mesh_figures(vertices_mm: NDArray[np.floating[Any]], faces: IntArray) -> dict[str, float | int]:
    """Size, shape of the triangles and topology of a mesh: vertices (V, 3), faces (F, 3).

    `min_angle_*_deg` are percentiles of each triangle's smallest angle, by area. `sliver_fraction_below_10deg` is the
    share of triangles, by number. `harmonic_index_mean` is the mean of hrm = 4 (cot α + cot β + cot η) over triangles
    with an area (paper, section 3.3), 4√3 if all are equilateral. Figures of no triangle are NaN.
    """
    points, faces = np.ascontiguousarray(vertices_mm, dtype=np.float64), np.ascontiguousarray(faces)
    area_mm2, angle_deg = np.zeros(len(faces)), np.zeros(len(faces))
    # A row of sums per block, added up in order: the same for any number of threads.
    sums = np.zeros((-(-len(faces) // _BLOCK), 3))
    in_bands(_shapes, len(sums), points, faces, area_mm2, angle_deg, sums)
    total_mm2, total_index, measured = (float(total) for total in sums.sum(axis=0))
    counts = topology_counts(faces)
    p1, p5, p50 = weighted_percentiles(angle_deg, area_mm2, (1.0, 5.0, 50.0))
    return {
        "vertices": counts.vertices,
        "triangles": len(faces),
        "boundary_points": counts.boundary_vertices,
        "area_mm2": total_mm2,
        "min_angle_p1_deg": p1,
        "min_angle_p5_deg": p5,
        "min_angle_p50_deg": p50,
        "sliver_fraction_below_10deg": float((angle_deg < _SLIVER_DEG).mean()) if len(faces) else np.nan,
        "harmonic_index_mean": total_index / measured if measured else np.nan,
        "components": counts.components,
        "euler_characteristic": counts.euler_characteristic,
        "boundary_edges": counts.boundary_edges,
        "nonmanifold_edges": counts.nonmanifold_edges,
        "misoriented_edges": counts.misoriented_edges,
        "duplicate_faces": counts.duplicate_faces,
        "degenerate_faces": int((area_mm2 < _FLAT_MM2).sum()),
    }


def score(
    mesh: Mesh,
    surface: Surface,
    visible_points_mm: NDArray[np.floating[Any]],
    eye_mm: FloatArray,
) -> TruthScore:
    """The error of `mesh` against the true `surface`, all in one world frame.

    Errors are taken over points spread evenly on the mesh's area, so that extra vertices or dust cannot dilute them.

    Parameters
    ----------
    visible_points_mm : (n, 3), points of the true surface that the camera sees and the projector lights.
    eye_mm : (3,), the camera's centre of projection.
    """
    vertices, faces = _welded(np.asarray(mesh.vertices_mm, dtype=np.float64), mesh.faces)
    collapsed = degenerate_faces(faces)
    faces = np.ascontiguousarray(faces[~collapsed])
    area_mm2, facing = _areas_and_facing(vertices, faces, eye_mm)
    counts = topology_counts(faces)
    random = np.random.default_rng(0)

    truth = SearchTree.over(surface.vertices_mm, surface.faces)
    error_mm = truth.distances_mm(_points_on(vertices, faces, area_mm2, _MESH_SAMPLES, random))
    found = SearchTree.over(vertices, faces)
    near = error_mm < _GROSS_MM
    p50, p95, p99 = np.percentile(error_mm, (50, 95, 99)) if len(error_mm) else (np.nan, np.nan, np.nan)
    # Every so many of the visible points.
    visible = np.asarray(visible_points_mm[:: max(1, len(visible_points_mm) // _VISIBLE_SAMPLES)], dtype=np.float64)
    first_mm, gap_mm, layers = _seen_through(found, truth, visible, eye_mm, random)
    return TruthScore(
        rms_mm=float(np.sqrt((error_mm[near] ** 2).mean())) if near.any() else np.nan,
        p50_mm=float(p50),
        p95_mm=float(p95),
        p99_mm=float(p99),
        gross_fraction=1.0 - _share(near),
        false_area_05mm=_share(error_mm > _FALSE_MM),
        complete_01mm=_share((first_mm < 0.1) & (gap_mm < 0.1)),
        complete_03mm=_share((first_mm < 0.3) & (gap_mm < 0.3)),
        extra_layer_fraction=_share(layers > 1),
        nonmanifold_edges=counts.nonmanifold_edges,
        misoriented_edges=counts.misoriented_edges,
        duplicate_faces=counts.duplicate_faces,
        degenerate_faces=int((area_mm2 < _FLAT_MM2).sum() + collapsed.sum()),
        facing_camera_fraction=float(area_mm2[facing].sum() / area_mm2.sum()) if area_mm2.any() else np.nan,
        error_over_sigma_p68=_error_over_sigma(mesh, truth),
    )


def _seen_through(
    found: SearchTree, truth: SearchTree, points_mm: FloatArray, eye_mm: FloatArray, random: np.random.Generator
) -> tuple[FloatArray, FloatArray, IntArray]:
    """For each visible point: error of what its ray meets first, distance to the mesh, crossings of a ray beside it."""
    rays = points_mm - eye_mm
    reach = found.first_hits(eye_mm, rays)
    hit = np.isfinite(reach)
    first_mm = np.full(len(points_mm), np.inf)
    first_mm[hit] = truth.distances_mm(eye_mm + rays[hit] * reach[hit, None])
    # A ray through a vertex or along an edge crosses several triangles of one sheet: aim beside the point.
    layers = found.crossing_counts(eye_mm, rays + random.normal(0.0, _ASIDE_MM, rays.shape))
    return first_mm, found.distances_mm(points_mm), layers


def _areas_and_facing(
    vertices_mm: FloatArray, faces: IntArray, eye_mm: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(F,) float64 area and (F,) bool front towards the eye of each triangle, in bounded memory."""
    area_mm2, facing = np.zeros(len(faces)), np.zeros(len(faces), dtype=bool)
    for start in range(0, len(faces), _FACES_AT_ONCE):
        part = slice(start, start + _FACES_AT_ONCE)
        corners = vertices_mm[faces[part]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area_mm2[part] = np.linalg.norm(normals, axis=1) / 2
        facing[part] = np.einsum("ij,ij->i", eye_mm - corners.mean(axis=1), normals) > 0
    return area_mm2, facing


def _points_on(
    vertices_mm: FloatArray, faces: IntArray, area_mm2: FloatArray, count: int, random: np.random.Generator
) -> FloatArray:
    """(count, 3) float64: random points, evenly spread over the area of the triangles; none if there is no area.

    One point per equal share of the cumulated area, which spreads better than independent draws; inside its triangle
    a point is uniform (Osada et al. 2002, "Shape distributions", 3.1).
    """
    cumulated = np.cumsum(area_mm2)
    if not len(cumulated) or cumulated[-1] <= 0:
        return np.zeros((0, 3))
    at = (np.arange(count) + random.random(count)) / count * cumulated[-1]
    picked = vertices_mm[faces[np.minimum(np.searchsorted(cumulated, at, side="right"), len(cumulated) - 1)]]
    root, along = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack((1 - root, root * (1 - along), root * along), axis=1)
    return np.asarray(np.einsum("ij,ijk->ik", weights, picked))


def _welded(vertices_mm: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Vertices that round to the same micrometre made one, the first of them."""
    cells = np.rint(vertices_mm / _WELD_MM).astype(np.int64)
    if len(cells):
        cells -= cells.min(axis=0)
        extent = [int(most) + 1 for most in cells.max(axis=0)]
        if extent[0] * extent[1] * extent[2] < 2**63:
            # One number in the order of x, y, z: sorts in a fraction of the time of rows.
            cells = (cells[:, :1] * extent[1] + cells[:, 1:2]) * extent[2] + cells[:, 2:]
            cells = cells.ravel()
    _, first, number = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return vertices_mm[first], number.ravel().astype(np.int32)[faces]


def _error_over_sigma(mesh: Mesh, truth: SearchTree) -> float:
    error_mm = truth.distances_mm(mesh.vertices_mm)
    stated = np.isfinite(mesh.sigma_mm) & (mesh.sigma_mm > 0) & (error_mm < _GROSS_MM)
    if not stated.any():
        return float(np.nan)
    return float(np.percentile(error_mm[stated] / mesh.sigma_mm[stated], _ONE_SIGMA_PERCENT))


def _share(true_where: NDArray[np.bool_]) -> float:
    return float(true_where.mean()) if len(true_where) else float(np.nan)


def weighted_percentiles(values: FloatArray, weights: FloatArray, percents: tuple[float, ...], /) -> list[float]:
    """The values, (n,), below which these percents of the weight, (n,), lie; NaN if there is no weight.

    Only the values of the narrow class that a percentile falls into are sorted.
    """
    if not len(values):
        return [float(np.nan)] * len(percents)
    low, high = float(values.min()), float(values.max())
    classes = np.zeros(len(values), dtype=np.int32)
    cumulated = np.cumsum(_weight_of_classes(values, weights, low, _CLASSES / max(high - low, 1e-300), classes))
    if not cumulated[-1] > 0:
        return [float(np.nan)] * len(percents)
    found = []
    for percent in percents:
        aim = percent / 100 * cumulated[-1]
        chosen = min(int(np.searchsorted(cumulated, aim)), _CLASSES - 1)
        inside = np.flatnonzero(classes == chosen)
        inside = inside[np.argsort(values[inside], kind="stable")]
        before = cumulated[chosen - 1] if chosen else 0.0
        at = np.searchsorted(before + np.cumsum(weights[inside]), aim)
        found.append(float(values[inside[min(at, len(inside) - 1)]]))
    return found


@kernel
def _weight_of_classes(values: Any, weights: Any, low: float, per_unit: float, classes: Any) -> Any:
    """The weight in each of _CLASSES equal classes of values; which class each value is in, in `classes`."""
    total = np.zeros(_CLASSES)
    for at in range(len(values)):
        chosen = min(int((values[at] - low) * per_unit), _CLASSES - 1)
        classes[at] = chosen
        total[chosen] += weights[at]
    return total


@kernel
def _shapes(first: int, last: int, points: Any, faces: Any, area_mm2: Any, angle_deg: Any, sums: Any) -> None:
    """Area and smallest angle of each triangle; per block of them: area, harmonic indices, triangles with an area."""
    for block in range(first, last):
        for face in range(block * _BLOCK, min((block + 1) * _BLOCK, len(faces))):
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
            vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            twice = np.sqrt(x * x + y * y + z * z)
            uu, vv, uv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, ux * vx + uy * vy + uz * vz
            # All three angles have the sine 2 A over two sides: the smallest is that of the largest dot.
            area_mm2[face] = twice / 2
            angle_deg[face] = np.degrees(angle_rad(twice, max(uv, uu - uv, vv - uv)))
            sums[block, 0] += twice / 2
            if twice > 0.0:
                sums[block, 1] += 4 * (uu + vv - uv) / twice
                sums[block, 2] += 1.0

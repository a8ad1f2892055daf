"""Figures of a mesh: shape of its triangles, and error against a known surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing.flips import angle_rad
from slrig.meshing.topology import degenerate_faces, topology_counts
from slrig.model import FloatArray, IntArray, Mesh, Surface


@kernel_part
def nearest_on_triangle(
    px: float, py: float, pz: float, points: Any, a: int, b: int, c: int
) -> tuple[float, float, float, float]:
    """Squared distance from p to a triangle, and the barycentric weights of the nearest point.

    Exact for slivers and collapsed triangles too. points : (n, 3), that a, b, c are rows of. Weights are exactly 0
    where the nearest point is on an edge. It is the foot of the perpendicular if that is inside, else on an edge
    beyond which the foot is (Ericson 2004, "Real-time collision detection", 5.1).
    """
    ax, ay, az = points[a, 0] - px, points[a, 1] - py, points[a, 2] - pz
    bx, by, bz = points[b, 0] - px, points[b, 1] - py, points[b, 2] - pz
    cx, cy, cz = points[c, 0] - px, points[c, 1] - py, points[c, 2] - pz
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square = nx * nx + ny * ny + nz * nz
    at_a, at_b, at_c = -1.0, -1.0, -1.0
    if square > 0.0:
        # Areas opposite each corner, times the square of the whole: negative where the foot is beyond that edge.
        at_a = nx * (by * cz - bz * cy) + ny * (bz * cx - bx * cz) + nz * (bx * cy - by * cx)
        at_b = nx * (cy * az - cz * ay) + ny * (cz * ax - cx * az) + nz * (cx * ay - cy * ax)
        at_c = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
        if at_a >= 0.0 and at_b >= 0.0 and at_c >= 0.0:
            height = nx * ax + ny * ay + nz * az
            return height * height / square, at_a / square, at_b / square, at_c / square
    best, wa, wb, wc = -1.0, 0.0, 0.0, 0.0
    if at_c < 0.0:
        gap, t = _nearest_on_edge(ax, ay, az, ux, uy, uz)
        best, wa, wb, wc = gap, 1.0 - t, t, 0.0
    if at_b < 0.0:
        gap, t = _nearest_on_edge(ax, ay, az, vx, vy, vz)
        if best < 0.0 or gap < best:
            best, wa, wb, wc = gap, 1.0 - t, 0.0, t
    if at_a < 0.0:
        gap, t = _nearest_on_edge(bx, by, bz, cx - bx, cy - by, cz - bz)
        if best < 0.0 or gap < best:
            best, wa, wb, wc = gap, 0.0, 1.0 - t, t
    return best, wa, wb, wc


@kernel_part(inline="always")
def _nearest_on_edge(px: float, py: float, pz: float, dx: float, dy: float, dz: float) -> tuple[float, float]:
    """Squared distance from the origin to the segment from p to p + d, and the nearest point's position along it."""
    square = dx * dx + dy * dy + dz * dz
    t = 0.0
    if square > 0.0:
        t = min(max(-(px * dx + py * dy + pz * dz) / square, 0.0), 1.0)
    qx, qy, qz = px + t * dx, py + t * dy, pz + t * dz
    return qx * qx + qy * qy + qz * qz, t


_TRIANGLES_PER_LEAF = 4
_STACK = 64  # a walk holds one node per level of the tree, and one more
# A ray along an edge or through a vertex must not slip between two triangles: barycentric tolerance.
_EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class SearchTree:
    """Triangles in Morton order, (T, 3, 3) float64 mm, and the boxes of the tree, (2L - 1, 6) float64 mm: low, high."""

    corners_mm: FloatArray
    boxes_mm: FloatArray

    @classmethod
    def build(cls, vertices_mm: NDArray[np.floating[Any]], faces: IntArray) -> SearchTree:
        """The tree of a mesh: vertices (V, 3), faces (F, 3). Raises ValueError: a vertex of a face is not finite."""
        points = np.asarray(vertices_mm, dtype=np.float64)
        centroids = (points[faces[:, 0]] + points[faces[:, 1]] + points[faces[:, 2]]) / 3
        if not np.isfinite(centroids).all():
            message = "a search tree needs finite vertices; drop the faces that use an unmeasured one"
            raise ValueError(message)
        corners = points[faces[np.argsort(_morton_codes(centroids), kind="stable")]]
        leaf_count = 1
        while leaf_count * _TRIANGLES_PER_LEAF < len(corners):
            leaf_count *= 2
        return cls(corners, np.asarray(_boxes(corners, leaf_count)))

    def distances_mm(self, points_mm: NDArray[np.floating[Any]]) -> FloatArray:
        """(n,) float64: exact distance from each point, (n, 3), to the nearest triangle.

        Infinite without a triangle, NaN for a point that is not finite.
        """
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        order = np.argsort(_morton_codes(points), kind="stable")  # sorted: successive points walk the same nodes
        return np.asarray(np.sqrt(_squared_distances(points, order, self.corners_mm, self.boxes_mm)))

    def first_hits(self, origin: NDArray[np.floating[Any]], directions: NDArray[np.floating[Any]]) -> FloatArray:
        """(n,) float64: distance of each ray's first hit, in units of its direction's length; infinite without a hit.

        Rays start at `origin`, (3,), and run along `directions`, (n, 3); both sides of a triangle count.
        """
        return self._ray_hits(origin, directions, first_only=True)[0]

    def crossing_counts(self, origin: NDArray[np.floating[Any]], directions: NDArray[np.floating[Any]]) -> IntArray:
        """(n,) int32: number of triangles that each ray of `first_hits` crosses; both at an edge."""
        return self._ray_hits(origin, directions, first_only=False)[1]

    def _ray_hits(
        self, origin: NDArray[np.floating[Any]], directions: NDArray[np.floating[Any]], *, first_only: bool
    ) -> tuple[FloatArray, IntArray]:
        start = np.ascontiguousarray(origin, dtype=np.float64)
        along = np.ascontiguousarray(directions, dtype=np.float64)
        found: tuple[FloatArray, IntArray] = _ray_hits(start, along, self.corners_mm, self.boxes_mm, first_only)
        return found


def _morton_codes(points: FloatArray) -> NDArray[np.uint64]:
    """(n,) uint64: 21 bits of each coordinate, interleaved; 0 for a point that is not finite."""
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    if not finite.any():
        return np.zeros(len(points), dtype=np.uint64)
    low = points[finite].min(axis=0)
    extent = max(float((points[finite].max(axis=0) - low).max()), 1e-300)
    steps = np.where(finite[:, None], (points - low) * ((2**21 - 1) / extent), 0.0).astype(np.uint64)
    return (
        _spread_bits(steps[:, 0]) << np.uint64(2)
        | _spread_bits(steps[:, 1]) << np.uint64(1)
        | _spread_bits(steps[:, 2])
    )


def _spread_bits(steps: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """21 bits with two zeros between each two of them (Anderson, "Bit twiddling hacks")."""
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):  # fmt: skip
        steps = (steps | steps << np.uint64(shift)) & np.uint64(mask)
    return steps


@kernel(in_every_scan=False)
def _boxes(corners: FloatArray, leaf_count: int) -> FloatArray:
    """(2 leaf_count - 1, 6): leaves from their triangles, then every parent from its two children."""
    boxes = np.full((2 * leaf_count - 1, 6), np.inf)
    boxes[:, 3:] = -np.inf
    for leaf in range(leaf_count):
        node = leaf_count - 1 + leaf
        for triangle in range(leaf * len(corners) // leaf_count, (leaf + 1) * len(corners) // leaf_count):
            for corner in range(3):
                for axis in range(3):
                    value = corners[triangle, corner, axis]
                    boxes[node, axis] = min(boxes[node, axis], value)
                    boxes[node, axis + 3] = max(boxes[node, axis + 3], value)
    for node in range(leaf_count - 2, -1, -1):
        for axis in range(3):
            boxes[node, axis] = min(boxes[2 * node + 1, axis], boxes[2 * node + 2, axis])
            boxes[node, axis + 3] = max(boxes[2 * node + 1, axis + 3], boxes[2 * node + 2, axis + 3])
    return boxes


@kernel_part(inline="always")
def _box_gap(x: float, y: float, z: float, boxes: FloatArray, node: int) -> float:
    """Squared distance from a point to a box, 0 inside."""
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    gap: float = dx * dx + dy * dy + dz * dz
    return gap


@kernel(in_every_scan=False)
def _squared_distances(
    points: FloatArray, order: NDArray[np.intp], corners: FloatArray, boxes: FloatArray
) -> FloatArray:
    """Nearest-first descent; skip nodes that are farther than the best triangle so far."""
    leaf_count = (len(boxes) + 1) // 2
    out = np.full(len(points), np.nan)
    stack = np.zeros(_STACK, dtype=np.int64)
    gaps = np.zeros(_STACK)
    near = 0
    for index in order:
        x, y, z = points[index]
        if not np.isfinite(x + y + z):
            continue
        best = np.inf
        if len(corners):
            # The triangle of the previous point: a close bound.
            best = nearest_on_triangle(x, y, z, corners[near], 0, 1, 2)[0]
        stack[0], gaps[0], depth = 0, _box_gap(x, y, z, boxes, 0), 1
        while depth > 0:
            depth -= 1
            if gaps[depth] >= best:
                continue
            node = stack[depth]
            if node >= leaf_count - 1:
                leaf = node - leaf_count + 1
                for triangle in range(leaf * len(corners) // leaf_count, (leaf + 1) * len(corners) // leaf_count):
                    gap = nearest_on_triangle(x, y, z, corners[triangle], 0, 1, 2)[0]
                    if gap < best:
                        best, near = gap, triangle
                continue
            first, second = 2 * node + 1, 2 * node + 2
            first_gap, second_gap = _box_gap(x, y, z, boxes, first), _box_gap(x, y, z, boxes, second)
            if first_gap < second_gap:
                first, second, first_gap, second_gap = second, first, second_gap, first_gap
            if first_gap < best:
                stack[depth], gaps[depth] = first, first_gap
                depth += 1
            if second_gap < best:
                stack[depth], gaps[depth] = second, second_gap
                depth += 1
        out[index] = best
    return out


@kernel(in_every_scan=False)
def _ray_hits(
    origin: FloatArray, directions: FloatArray, corners: FloatArray, boxes: FloatArray, first_only: bool
) -> tuple[FloatArray, IntArray]:
    """Distances to the first hit, and numbers of hits; `first_only` skips boxes behind a hit."""
    leaf_count = (len(boxes) + 1) // 2
    reach = np.full(len(directions), np.inf)
    crossings = np.zeros(len(directions), dtype=np.int32)
    stack = np.zeros(_STACK, dtype=np.int64)
    entries = np.zeros(_STACK)
    for i in range(len(directions)):
        stack[0], entries[0], depth = 0, _box_entry(origin, directions[i], boxes[0]), 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if entries[depth] == np.inf or (first_only and entries[depth] > reach[i]):
                continue
            if node >= leaf_count - 1:
                leaf = node - leaf_count + 1
                for triangle in range(leaf * len(corners) // leaf_count, (leaf + 1) * len(corners) // leaf_count):
                    t = _ray_meets_triangle(origin, directions[i], corners[triangle])
                    if t < np.inf:
                        crossings[i] += 1
                        reach[i] = min(reach[i], t)
                continue
            first, second = 2 * node + 1, 2 * node + 2
            first_entry = _box_entry(origin, directions[i], boxes[first])
            second_entry = _box_entry(origin, directions[i], boxes[second])
            if first_entry < second_entry:
                first, second, first_entry, second_entry = second, first, second_entry, first_entry
            stack[depth], entries[depth] = first, first_entry
            stack[depth + 1], entries[depth + 1] = second, second_entry
            depth += 2
    return reach, crossings


@kernel_part
def _box_entry(origin: FloatArray, direction: FloatArray, box: FloatArray) -> float:
    """Ray parameter at which the box begins; infinite if the ray misses it (slab test).

    The box is padded by some rounding errors, because it may be flat.
    """
    enter, leave = 0.0, np.inf
    for axis in range(3):
        pad = 1e-12 * (abs(box[axis]) + abs(box[axis + 3]) + abs(origin[axis]))
        low, high = box[axis] - pad - origin[axis], box[axis + 3] + pad - origin[axis]
        if direction[axis] == 0.0:
            if low > 0.0 or high < 0.0:
                return np.inf
        else:
            one, two = low / direction[axis], high / direction[axis]
            enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
    return enter if enter <= leave else np.inf


@kernel_part
def _ray_meets_triangle(origin: FloatArray, direction: FloatArray, triangle: FloatArray) -> float:
    """Ray parameter at which it meets the triangle; infinite if it does not (Möller and Trumbore 1997)."""
    ux, uy, uz = triangle[1, 0] - triangle[0, 0], triangle[1, 1] - triangle[0, 1], triangle[1, 2] - triangle[0, 2]
    vx, vy, vz = triangle[2, 0] - triangle[0, 0], triangle[2, 1] - triangle[0, 1], triangle[2, 2] - triangle[0, 2]
    sx, sy, sz = origin[0] - triangle[0, 0], origin[1] - triangle[0, 1], origin[2] - triangle[0, 2]
    dx, dy, dz = direction
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    determinant = ux * px + uy * py + uz * pz
    if determinant == 0.0:
        return np.inf
    a = (sx * px + sy * py + sz * pz) / determinant
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    b = (dx * qx + dy * qy + dz * qz) / determinant
    t = (vx * qx + vy * qy + vz * qz) / determinant
    inside = a >= -_EDGE_TOLERANCE and b >= -_EDGE_TOLERANCE and a + b <= 1.0 + _EDGE_TOLERANCE
    return t if inside and t > 0.0 else np.inf


_MESH_SAMPLES = 200_000
_VISIBLE_SAMPLES = 60_000  # enough for a share to 0.2 %; rays take most of the time
_FACES_AT_ONCE = 200_000  # some tens of megabytes
# Figures of `TruthScore` have these in their names: reports are compared by them.
_GROSS_MM = 1.0
_FALSE_MM = 0.5
_WELD_MM = 1e-3
_SLIVER_DEG = 10.0
_ONE_SIGMA_PERCENT = 68.27  # of a normal distribution within one standard deviation
_BLOCK = 4096  # faces to a row of sums, which are added up in order
_CLASSES = 4096  # of values; only one of them is sorted
_FLAT_MM2 = 1e-9
_ASIDE_MM = 0.05  # from vertices and edges


@dataclass(frozen=True, slots=True)
class TruthScore:
    """Error of a mesh against the true surface, millimetres; NaN for an empty mesh.

    rms_mm : over the mesh's area, of distances to the true surface below 1 mm.
    p50_mm, p95_mm, p99_mm : percentiles of all those distances, by area.
    gross_fraction, false_area_05mm : share of the mesh's area that is 1 mm, more than 0.5 mm from the true surface.
    complete_01mm, complete_03mm : share of the visible points that are covered to this tolerance: the mesh is that near
        to the point, and the first hit of the camera's ray to the point is that near to the surface.
    extra_layer_fraction : share of the camera's rays that cross the mesh more than once.
    nonmanifold_edges, misoriented_edges, duplicate_faces, degenerate_faces : after welding vertices at 1 µm.
    facing_camera_fraction : share of the mesh's area whose front faces a camera.
    error_over_sigma_p68 : 68.27 % of the vertices are at most this many of their own standard deviations from the
        true surface: 1 if the stated σ is right, NaN without one.
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
        """The figures under their names in reports."""
        names = {
            "false_area_05mm": "false_area_0.5mm",
            "complete_01mm": "complete_0.1mm",
            "complete_03mm": "complete_0.3mm",
            "facing_camera_fraction": "facing_camera_area",
        }
        return {names.get(name, name): value for name, value in asdict(self).items()}


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
    *other_eyes_mm: FloatArray,
) -> TruthScore:
    """The error of `mesh` against the true `surface`, all in one world frame.

    Errors are taken over points spread evenly on the mesh's area, so that extra vertices or dust cannot dilute them.

    visible_points_mm : (n, 3), points of the true surface that the camera sees and the projector lights. eye_mm : (3,),
    the camera's centre of projection; other_eyes_mm : those of further cameras, which a triangle may face instead.
    """
    vertices, faces = _weld_vertices(np.asarray(mesh.vertices_mm, dtype=np.float64), mesh.faces)
    collapsed = degenerate_faces(faces)
    faces = np.ascontiguousarray(faces[~collapsed])
    area_mm2, facing = _areas_and_facing(vertices, faces, (eye_mm, *other_eyes_mm))
    counts = topology_counts(faces)
    random = np.random.default_rng(0)

    truth = SearchTree.build(surface.vertices_mm, surface.faces)
    error_mm = truth.distances_mm(_sample_surface(vertices, faces, area_mm2, _MESH_SAMPLES, random))
    found = SearchTree.build(vertices, faces)
    near = error_mm < _GROSS_MM
    p50, p95, p99 = np.percentile(error_mm, (50, 95, 99)) if len(error_mm) else (np.nan, np.nan, np.nan)
    # Every so many of the visible points.
    visible = np.asarray(visible_points_mm[:: max(1, len(visible_points_mm) // _VISIBLE_SAMPLES)], dtype=np.float64)
    first_mm, gap_mm, layers = _ray_errors(found, truth, visible, eye_mm, random)
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


def _ray_errors(
    found: SearchTree, truth: SearchTree, points_mm: FloatArray, eye_mm: FloatArray, random: np.random.Generator
) -> tuple[FloatArray, FloatArray, IntArray]:
    """For each visible point: error of its ray's first hit, distance to the mesh, crossings of a ray close to it."""
    rays = points_mm - eye_mm
    reach = found.first_hits(eye_mm, rays)
    hit = np.isfinite(reach)
    first_mm = np.full(len(points_mm), np.inf)
    first_mm[hit] = truth.distances_mm(eye_mm + rays[hit] * reach[hit, None])
    # A ray through a vertex or along an edge crosses several triangles of one sheet: aim next to the point.
    layers = found.crossing_counts(eye_mm, rays + random.normal(0.0, _ASIDE_MM, rays.shape))
    return first_mm, found.distances_mm(points_mm), layers


def _areas_and_facing(
    vertices_mm: FloatArray, faces: IntArray, eyes_mm: Sequence[FloatArray]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(F,) float64 area of each triangle, and (F,) bool, True if its front faces one of the eyes; in bounded memory."""
    area_mm2, facing = np.zeros(len(faces)), np.zeros(len(faces), dtype=bool)
    for start in range(0, len(faces), _FACES_AT_ONCE):
        part = slice(start, start + _FACES_AT_ONCE)
        corners = vertices_mm[faces[part]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area_mm2[part] = np.linalg.norm(normals, axis=1) / 2
        middle = corners.mean(axis=1)
        for eye_mm in eyes_mm:
            facing[part] |= np.einsum("ij,ij->i", eye_mm - middle, normals) > 0
    return area_mm2, facing


def _sample_surface(
    vertices_mm: FloatArray, faces: IntArray, area_mm2: FloatArray, count: int, random: np.random.Generator
) -> FloatArray:
    """(count, 3) float64: random points, uniform over the area of the triangles; none without area.

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


def _weld_vertices(vertices_mm: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Merge vertices that round to the same micrometre into the first of them."""
    cells = np.rint(vertices_mm / _WELD_MM).astype(np.int64)
    if len(cells):
        cells -= cells.min(axis=0)
        extent = [int(most) + 1 for most in cells.max(axis=0)]
        if extent[0] * extent[1] * extent[2] < 2**63:
            # One number in the order of x, y, z: sorts faster than rows.
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
    """Weighted percentiles of values, (n,); NaN without weight. Sorts only the class that a percentile falls into."""
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
    """Weight in each of _CLASSES equal classes of values; fills `classes` with the class of each value."""
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

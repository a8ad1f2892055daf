"""Sparse grid along the surfaces of the views, in bricks of 8 x 8 x 8 voxels, and nearest triangles of its points.

A cell has the index of its lowest corner: 512 brick + 64 x + 8 y + z, with x, y, z in 0 … 7 within the brick.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import InvalidInputError, NothingToReconstructError
from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing import nearest_on_triangle, neighbours, used_vertices
from slrig.model import FloatArray, IntArray, Mesh
from slrig.multiview.matching import rotate_vectors, transform_points

BRICK = 8
CELLS = BRICK**3
_AXIS_BITS = 21  # of a key: three coordinates of a brick in 63 bits
_MAX_BRICKS = 400_000  # 2 kB per brick and dense array: about 2 GB in all
MARGIN = 0.1  # voxels around the views: their mean may pass next to each of them
BORDER_REACH = 0.5  # voxels beyond a border that belong to the view
_RIGID_TOLERANCE = 1e-6  # typed or single-precision poses are accurate to 1e-7
_SPACING_SAMPLE = 20_000  # faces of each view: enough for their median area to a per cent
_SWEEPS = 4  # two each way follow any border over the few edges within the distance limit
_SHARP_COSINE = 0.8  # 37°: noise turns normals less from vertex to vertex
_QUADRIC_DAMPING = 0.03  # of the quadric's trace: holds a vertex in place along its edge, and on noisy flat surface


class StackedViews(NamedTuple):
    """n vertices and T triangles of V views in the model's frame.

    points_mm : (n, 3) float64; normals : (n, 3) float32; sigma_mm : (n,) float32; colour : (n, 3) uint8, sRGB;
    mark : (n,) uint8. border_distance_mm : (n,) float32, along edges, from the open border of the view, up to a limit.
    faces : (T, 3) int32 into all points. open_edges : (T,) uint8, bit k is set if the edge opposite corner k is open.
    first_face, first_vertex : (V + 1,) int64: view v has the triangles first_face[v]:first_face[v + 1], and vertices
    alike.
    """

    points_mm: FloatArray
    normals: NDArray[np.float32]
    sigma_mm: NDArray[np.float32]
    colour: NDArray[np.uint8]
    mark: NDArray[np.uint8]
    border_distance_mm: NDArray[np.float32]
    faces: IntArray
    open_edges: NDArray[np.uint8]
    first_face: NDArray[np.int64]
    first_vertex: NDArray[np.int64]


def vertex_spacing_mm(views: Sequence[Mesh]) -> float:
    """Distance of the views' vertices: the side of a square with the area of two triangles, median over views."""
    sides = []
    for view in views:
        faces = view.faces[:: max(1, len(view.faces) // _SPACING_SAMPLE)]
        a, b, c = (view.vertices_mm[corner].astype(np.float64) for corner in faces.T)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        if np.isfinite(areas).any():
            sides.append(float(np.sqrt(2 * np.nanmedian(areas))))
    return float(np.median(sides)) if sides else float("nan")


def stack_views(
    views: Sequence[Mesh], poses: Sequence[FloatArray] | FloatArray, /, *, border_limit_mm: float
) -> StackedViews:
    """Transform the views to the model's frame, without triangles of vertices that lack a position, normal or σ.

    border_limit_mm : limit of `border_distance_mm`.

    Raises
    ------
    ValueError
        The number of poses is not that of the views, or a pose is not rigid.
    InvalidInputError
        A view is not a manifold (`neighbours`).
    NothingToReconstructError
        No view has a triangle.
    """
    _require_rigid(len(views), poses)
    points, normals, distances, faces, open_edges = [], [], [], [], []
    before = 0
    for number, (view, pose) in enumerate(zip(views, poses, strict=True)):
        vertices = transform_points(pose, view.vertices_mm)
        # One sum: reducing three columns is slow.
        usable = np.isfinite(vertices[:, 0] + vertices[:, 1] + vertices[:, 2] + view.normals[:, 0] + view.sigma_mm)
        used = view.faces if usable.all() else view.faces[usable[view.faces].all(axis=1)]
        try:
            across = neighbours(used, vertex_count=len(vertices))
        except ValueError as error:
            message = f"view {number} is not a manifold: {error}; use its mesh as slrig wrote it"
            raise InvalidInputError(message) from error
        a, b, c = (across < 0).astype(np.uint8).T
        border = a | b << 1 | c << 2
        distance = np.full(len(vertices), border_limit_mm, dtype=np.float32)
        _border_distances(vertices, np.ascontiguousarray(used), border, distance)
        points.append(vertices)
        normals.append(rotate_vectors(pose, view.normals).astype(np.float32))
        distances.append(distance)
        faces.append(used + np.int32(before))
        open_edges.append(border)
        before += len(vertices)
    first_face = np.cumsum([0, *map(len, faces)])
    if first_face[-1] == 0:
        message = f"expected triangles with known normals and σ, found in {len(views)} views none; scan again"
        raise NothingToReconstructError(message)
    return StackedViews(
        np.concatenate(points), np.concatenate(normals), np.concatenate([view.sigma_mm for view in views]),
        np.concatenate([view.colour for view in views]), np.concatenate([view.mark for view in views]),
        np.concatenate(distances), np.concatenate(faces), np.concatenate(open_edges),
        first_face, np.cumsum([0, *map(len, points)]),
    )  # fmt: skip


def _require_rigid(count: int, poses: Sequence[FloatArray] | FloatArray) -> None:
    if count != len(poses):
        message = f"expected one pose for each of the {count} views, found {len(poses)}"
        raise ValueError(message)
    for number, pose in enumerate(poses):
        if pose.shape != (4, 4):
            message = f"pose {number}: expected shape (4, 4), found {pose.shape}"
            raise ValueError(message)
        turn = pose[:3, :3]
        off = max(np.abs(turn @ turn.T - np.eye(3)).max(), np.abs(pose[3] - (0, 0, 0, 1)).max())
        if not (off < _RIGID_TOLERANCE and np.linalg.det(turn) > 0 and np.isfinite(pose).all()):
            message = (
                f"pose {number} is not rigid: it is {off:.2g} off a rotation and a shift; "
                "give R and t of x_model = R x_view + t as [[R, t], [0, 1]]"
            )
            raise ValueError(message)


@kernel(in_every_scan=False)
def _border_distances(points: Any, faces: Any, open_edges: Any, distance: Any) -> None:
    """Distances along edges from the open border, up to the limit that `distance` holds at first."""
    for face in range(len(faces)):
        for corner in range(3):
            if open_edges[face] >> corner & 1:
                distance[faces[face, (corner + 1) % 3]] = distance[faces[face, (corner + 2) % 3]] = 0.0
    for sweep in range(_SWEEPS):
        changed = False
        for step in range(len(faces)):
            face = len(faces) - 1 - step if sweep % 2 else step
            for corner in range(3):
                a, b = faces[face, corner], faces[face, (corner + 1) % 3]
                gap = abs(distance[a] - distance[b])
                if gap == 0.0:
                    continue
                x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
                length = np.sqrt(x * x + y * y + z * z)
                if gap > length * (1 + 1e-6):  # of single precision
                    changed = True
                    if distance[a] > distance[b]:
                        distance[a] = distance[b] + length
                    else:
                        distance[b] = distance[a] + length
        if not changed:
            break


class Grid(NamedTuple):
    """Bricks of voxels. origin_mm : (3,) float64, the corner of brick (0, 0, 0); keys : (B,) int64, sorted.

    around : (B, 27) int32, the neighbours of each brick by 9 dx + 3 dy + dz + 13, -1 for none.
    """

    origin_mm: FloatArray
    voxel_mm: float
    keys: NDArray[np.int64]
    around: IntArray


def build_grid(stack: StackedViews, voxel_mm: float) -> Grid:
    """Build the grid of all cells that the fused surface may pass through.

    Raises InvalidInputError: there are more than `_MAX_BRICKS` bricks.
    """
    used = stack.points_mm[used_vertices(stack.faces, len(stack.points_mm))]
    # One brick free on all sides, so that all neighbours have keys.
    origin = used.min(axis=0) - 2 * BRICK * voxel_mm
    span = int(((used.max(axis=0) - origin) / (BRICK * voxel_mm)).max()) + 3
    if span < 1 << _AXIS_BITS:
        empty = Grid(origin, voxel_mm, np.zeros(0, dtype=np.int64), np.zeros((0, 27), dtype=np.int32))
        keys = np.unique(np.concatenate(in_bands(_touched_bricks, len(stack.first_face) - 1, stack, empty)))
    if span >= 1 << _AXIS_BITS or len(keys) > _MAX_BRICKS:
        message = (
            f"voxels of {voxel_mm:g} mm are too small for views that reach over {np.ptp(used, axis=0).max():.0f} mm: "
            f"they take more than {_MAX_BRICKS} bricks of {BRICK}³; use larger voxels, or remove stray points"
        )
        raise InvalidInputError(message)
    steps = np.array([-1, 0, 1])
    offsets = ((steps[:, None, None] << 2 * _AXIS_BITS) + (steps[:, None] << _AXIS_BITS) + steps).ravel()
    around = np.full((len(keys), 27), -1, dtype=np.int32)
    for number, offset in enumerate(offsets):
        place = np.minimum(np.searchsorted(keys, keys + offset), len(keys) - 1)
        around[:, number] = np.where(keys[place] == keys + offset, place, -1)
    return Grid(origin, voxel_mm, keys, around)


def corners_near_surface(stack: StackedViews, grid: Grid) -> IntArray:
    """(n,) int32, sorted: indices of the corners of all cells that a triangle passes through, or nearly."""
    cells = np.zeros(CELLS * len(grid.keys), dtype=np.uint8)
    _mark_cells(stack, grid, cells)
    corners = np.zeros_like(cells)
    _mark_corners(grid.around, cells, corners)
    return np.flatnonzero(corners).astype(np.int32)


def corner_positions_mm(grid: Grid, cells: IntArray) -> FloatArray:
    """(n, 3) float64: positions of the lowest corners of cells (n,) int32."""
    key, within = grid.keys[cells // CELLS], cells % CELLS
    bricks = np.stack([key >> 2 * _AXIS_BITS, key >> _AXIS_BITS, key], axis=1) & ((1 << _AXIS_BITS) - 1)
    steps = np.stack([within >> 6, within >> 3 & 7, within & 7], axis=1)
    return np.asarray(grid.origin_mm + grid.voxel_mm * (BRICK * bricks + steps))


@kernel_part
def neighbour_cell(around: Any, brick: int, x: int, y: int, z: int) -> int:
    """Index of a cell by its coordinates from the brick's corner, -8 to 15; -1 without a brick."""
    other = around[brick, 9 * (x >> 3) + 3 * (y >> 3) + (z >> 3) + 13]
    return -1 if other < 0 else CELLS * other + 64 * (x & 7) + 8 * (y & 7) + (z & 7)


@kernel_part
def corner_index(around: Any, cell: int, corner: int) -> int:
    """Index of one of a cell's eight corners, 4 x + 2 y + z, or of the cell there; -1 without a brick."""
    x, y, z = cell >> 6 & 7, cell >> 3 & 7, cell & 7
    at: int = neighbour_cell(around, cell // CELLS, x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1))
    return at


@kernel_part
def brick_key(x: int, y: int, z: int) -> int:
    """Key of a brick by its coordinates."""
    return (x << 2 * _AXIS_BITS) + (y << _AXIS_BITS) + z


@kernel_part
def find_brick(keys: Any, x: int, y: int, z: int, cached_keys: Any, cached: Any) -> int:
    """Number of a brick by its coordinates, -1 for none.

    cached_keys, cached : (64,) int64, the last answers, -1 at first: neighbouring triangles need the same bricks.
    """
    key = brick_key(x, y, z)
    slot = (x & 3) << 4 | (y & 3) << 2 | z & 3
    if cached_keys[slot] != key:
        place = np.searchsorted(keys, key)
        cached_keys[slot] = key
        cached[slot] = place if place < len(keys) and keys[place] == key else -1
    found: int = cached[slot]
    return found


@kernel_part
def new_cache() -> Any:
    """The cache of `find_brick`."""
    return np.full(64, -1, dtype=np.int64), np.full(64, -1, dtype=np.int64)


@kernel_part(inline="always")
def cell_range(a: float, b: float, c: float, origin: float, per_mm: float, margin: float) -> tuple[int, int]:
    """First and last cell, along an axis, within `margin` voxels of three coordinates.

    Coordinates less the origin are positive: the grid begins beyond the margins of all triangles.
    """
    return int((min(a, b, c) - origin) * per_mm - margin), int((max(a, b, c) - origin) * per_mm + margin)


@kernel(in_every_scan=False)
def _touched_bricks(first: int, last: int, stack: Any, grid: Any) -> Any:
    """Keys of the bricks with a corner of a cell in the boxes of these views' triangles, wider at borders."""
    points, faces, origin, per_mm = stack.points_mm, stack.faces, grid.origin_mm, 1.0 / grid.voxel_mm
    low, high = np.full(3, -1, np.int64), np.full(3, -1, np.int64)
    found, count = np.zeros(1024, dtype=np.int64), 0
    for face in range(stack.first_face[first], stack.first_face[last]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        beyond, same = BORDER_REACH if stack.open_edges[face] else MARGIN, True
        for axis in range(3):
            begin, end = cell_range(points[a, axis], points[b, axis], points[c, axis], origin[axis], per_mm, beyond)
            begin, end = begin >> 3, (end + 1) >> 3
            same &= low[axis] == begin and high[axis] == end
            low[axis], high[axis] = begin, end
        if same:
            continue
        if (high[0] - low[0] + 1) * (high[1] - low[1] + 1) * (high[2] - low[2] + 1) > _MAX_BRICKS:
            return np.arange(_MAX_BRICKS + 1)  # one triangle exceeds the limit
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                for z in range(low[2], high[2] + 1):
                    if count == len(found):
                        found = np.concatenate((found, np.zeros_like(found)))
                    found[count] = brick_key(x, y, z)
                    count += 1
    return np.unique(found[:count])


@kernel(in_every_scan=False)
def _mark_cells(stack: Any, grid: Any, cells: Any) -> None:
    """Mark the cells of a triangle's box that its plane passes through, or nearly."""
    points, faces, keys, open_edges = stack.points_mm, stack.faces, grid.keys, stack.open_edges
    ox, oy, oz, per_mm = grid.origin_mm[0], grid.origin_mm[1], grid.origin_mm[2], 1.0 / grid.voxel_mm
    cached_keys, cached = new_cache()
    key_before, brick = -1, -1
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        beyond = BORDER_REACH if open_edges[face] else MARGIN
        px, py, pz = points[a, 0], points[a, 1], points[a, 2]
        x_low, x_high = cell_range(px, points[b, 0], points[c, 0], ox, per_mm, beyond)
        y_low, y_high = cell_range(py, points[b, 1], points[c, 1], oy, per_mm, beyond)
        z_low, z_high = cell_range(pz, points[b, 2], points[c, 2], oz, per_mm, beyond)
        ux, uy, uz = points[b, 0] - px, points[b, 1] - py, points[b, 2] - pz
        vx, vy, vz = points[c, 0] - px, points[c, 1] - py, points[c, 2] - pz
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        # The plane is n . x = offset for the middle of a cell, x its lowest corner in voxels.
        # A triangle without area marks its whole box.
        offset = (nx * (px - ox) + ny * (py - oy) + nz * (pz - oz)) * per_mm - (nx + ny + nz) / 2
        reach = (0.5 + MARGIN) * (abs(nx) + abs(ny) + abs(nz))
        for x in range(x_low, x_high + 1):
            for y in range(y_low, y_high + 1):
                for z in range(z_low, z_high + 1):
                    if abs(nx * x + ny * y + nz * z - offset) <= reach:
                        key = brick_key(x >> 3, y >> 3, z >> 3)
                        if key != key_before:
                            key_before, brick = key, find_brick(keys, x >> 3, y >> 3, z >> 3, cached_keys, cached)
                        cells[CELLS * brick + 64 * (x & 7) + 8 * (y & 7) + (z & 7)] = 1


@kernel(in_every_scan=False)
def _mark_corners(around: Any, cells: Any, corners: Any) -> None:
    for cell in range(len(cells)):
        if cells[cell]:
            for corner in range(8):
                corners[corner_index(around, cell, corner)] = 1


def nearest_triangles_to_corners(stack: StackedViews, grid: Grid, points_mm: FloatArray, cells: IntArray) -> IntArray:
    """(V, n) int32: nearest triangle of each view to each corner of the grid, the first of equals; -1 for none.

    points_mm : (n, 3) float64; cells : (n,) int32, sorted indices of the corners. Searched among the triangles whose
    boxes reach the cells around the corner: exact within a voxel; further off only the sign of the distance matters.
    """
    reach = _SearchReach(box=1.0 + MARGIN, border=BORDER_REACH, limit=3**0.5 + BORDER_REACH, width=0.0)
    return _search_nearest(stack, grid, points_mm, cells, reach)


def nearest_triangles(
    stack: StackedViews, grid: Grid, points_mm: FloatArray, cells: IntArray, *, reach_mm: float
) -> IntArray:
    """(V, n) int32: nearest triangle of each view to each point, the first of equals; -1 beyond the reach.

    points_mm : (n, 3) float64; cells : (n,) int32, sorted indices of the points' cells.
    """
    voxels = reach_mm / grid.voxel_mm
    return _search_nearest(stack, grid, points_mm, cells, _SearchReach(box=voxels, border=0.0, limit=voxels, width=1.0))


class _SearchReach(NamedTuple):
    """In voxels. box : margin of a triangle's box, in which points are compared; border : additional margin at an open
    edge. limit : of the distance. width : 0 if each point is its cell's lowest corner, 1 if it is anywhere inside.
    """

    box: float
    border: float
    limit: float
    width: float


def _search_nearest(
    stack: StackedViews, grid: Grid, points: FloatArray, cells: IntArray, reach: _SearchReach
) -> IntArray:
    # One more entry than cells, so that the points of a row of cells end before the next entry.
    first_point = np.zeros(CELLS * len(grid.keys) + 1, dtype=np.int32)
    np.cumsum(np.bincount(cells, minlength=len(first_point) - 1), out=first_point[1:])
    views = len(stack.first_face) - 1
    nearest = np.full((views, len(points)), -1, dtype=np.int32)
    in_bands(_nearest_faces, views, stack, grid, points, first_point, reach, nearest)
    return nearest


@kernel(in_every_scan=False)
def _nearest_faces(
    first: int, last: int, stack: Any, grid: Any, points: Any, first_point: Any, reach: Any,
    nearest: Any,
) -> None:  # fmt: skip
    corners, faces, origin, keys, voxel = stack.points_mm, stack.faces, grid.origin_mm, grid.keys, grid.voxel_mm
    open_edges, gaps, visited = stack.open_edges, np.zeros(len(points)), np.zeros(len(corners), np.bool_)
    ox, oy, oz, per_mm, skip = origin[0], origin[1], origin[2], 1.0 / voxel, 1 if reach.width == 0.0 else 0
    cached_keys, cached = new_cache()
    for view in range(first, last):
        gaps[:] = reach.limit * voxel
        begin, end = stack.first_face[view], stack.first_face[view + 1]
        # Vertices come first, as triangles without extent: their distances exclude most triangles.
        for corner in range(4):
            for face in range(begin, end):
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                if corner < 3:
                    a = b = c = faces[face, corner]
                    if visited[a]:
                        continue
                    visited[a] = True
                margin = reach.box + (reach.border if open_edges[face] else 0.0)
                x_low, x_high = cell_range(corners[a, 0], corners[b, 0], corners[c, 0], ox, per_mm, margin)
                y_low, y_high = cell_range(corners[a, 1], corners[b, 1], corners[c, 1], oy, per_mm, margin)
                z_low, z_high = cell_range(corners[a, 2], corners[b, 2], corners[c, 2], oz, per_mm, margin)
                # The lowest corner of the first cell is outside the box; another point of that cell may be inside.
                x_low, y_low, z_low = x_low + skip, y_low + skip, z_low + skip
                ax, ay, az = corners[a, 0], corners[a, 1], corners[a, 2]
                ux, uy, uz = corners[b, 0] - ax, corners[b, 1] - ay, corners[b, 2] - az
                vx, vy, vz = corners[c, 0] - ax, corners[c, 1] - ay, corners[c, 2] - az
                nx, ny, nz = _unit(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
                # Outwards across the edges: from a to b, from c to a, and from b to c, which does not pass through a.
                sx, sy, sz = _unit(uy * nz - uz * ny, uz * nx - ux * nz, ux * ny - uy * nx)
                tx, ty, tz = _unit(ny * vz - nz * vy, nz * vx - nx * vz, nx * vy - ny * vx)
                wx, wy, wz = vx - ux, vy - uy, vz - uz
                wx, wy, wz = _unit(wy * nz - wz * ny, wz * nx - wx * nz, wx * ny - wy * nx)
                third = wx * ux + wy * uy + wz * uz
                for bx in range(x_low >> 3, (x_high >> 3) + 1):
                    for by in range(y_low >> 3, (y_high >> 3) + 1):
                        for bz in range(z_low >> 3, (z_high >> 3) + 1):
                            brick = find_brick(keys, bx, by, bz, cached_keys, cached)
                            if brick < 0:
                                continue
                            z_begin, z_end = max(z_low - 8 * bz, 0), min(z_high - 8 * bz, 7)
                            for x in range(max(x_low - 8 * bx, 0), min(x_high - 8 * bx, 7) + 1):
                                for y in range(max(y_low - 8 * by, 0), min(y_high - 8 * by, 7) + 1):
                                    row = CELLS * brick + 64 * x + 8 * y
                                    for at in range(first_point[row + z_begin], first_point[row + z_end + 1]):
                                        gap = gaps[at]
                                        px, py, pz = points[at, 0], points[at, 1], points[at, 2]
                                        dx, dy, dz = px - ax, py - ay, pz - az
                                        if corner < 3:
                                            gap2 = dx * dx + dy * dy + dz * dz
                                        else:
                                            height = nx * dx + ny * dy + nz * dz
                                            aside = max(sx * dx + sy * dy + sz * dz, tx * dx + ty * dy + tz * dz)
                                            aside = max(aside, wx * dx + wy * dy + wz * dz - third, 0.0)
                                            gap2 = height * height + aside * aside  # lower limit
                                        if gap2 < gap * gap:
                                            if corner == 3:
                                                gap2 = nearest_on_triangle(px, py, pz, corners, a, b, c)[0]
                                            if gap2 < gap * gap:
                                                gaps[at] = np.sqrt(gap2)
                                                nearest[view, at] = face


@kernel_part(inline="always")
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit vector, zero without length."""
    scale = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-300)
    return x * scale, y * scale, z * scale


def sharpen_edges(points_mm: FloatArray, normals: FloatArray, quads: IntArray, /, *, max_step_mm: float) -> FloatArray:
    """(m, 3) float64: the points, with those at sharp edges moved to the intersection of the tangent planes.

    Minimises the squared distances to the planes of the vertices that share a quadrangle (Garland and Heckbert 1997,
    "Surface simplification using quadric error metrics"; as in dual contouring, Ju et al. 2002).

    points_mm, normals : (m, 3) float64, normals unit or NaN; quads : (q, 4) int32. max_step_mm : limit of the motion.
    """
    sharp = np.zeros(len(points_mm), dtype=np.bool_)
    _mark_sharp(quads, normals, sharp)
    number = np.where(sharp, np.cumsum(sharp) - 1, -1)
    count = int(np.count_nonzero(sharp))
    quadrics, sides = np.zeros((count, 3, 3)), np.zeros((count, 3, 1))
    _add_planes(quads, points_mm, normals, number, quadrics, sides)
    # A sharp vertex has two neighbours or more, so that no trace is 0.
    damped = quadrics + _QUADRIC_DAMPING * np.trace(quadrics, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    step = np.linalg.solve(damped, sides)[:, :, 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    sharpened = points_mm.copy()
    sharpened[sharp] += step * np.minimum(1.0, max_step_mm / np.maximum(length, 1e-12))
    return sharpened


@kernel(in_every_scan=False)
def _mark_sharp(quads: Any, normals: Any, sharp: Any) -> None:
    for quad in range(len(quads)):
        for i in range(3):
            for j in range(i + 1, 4):
                a, b = quads[quad, i], quads[quad, j]
                cosine = normals[a, 0] * normals[b, 0] + normals[a, 1] * normals[b, 1] + normals[a, 2] * normals[b, 2]
                if cosine < _SHARP_COSINE:
                    sharp[a] = sharp[b] = True


@kernel(in_every_scan=False)
def _add_planes(quads: Any, points: Any, normals: Any, number: Any, quadrics: Any, sides: Any) -> None:
    """Sums of n nᵀ and of n (n . (p - x)), for each numbered vertex, over the other vertices of its quadrangles."""
    for quad in range(len(quads)):
        for i in range(4):
            vertex = quads[quad, i]
            row = number[vertex]
            if row < 0:
                continue
            for j in range(4):
                other = quads[quad, j]
                height = 0.0
                for axis in range(3):
                    height += normals[other, axis] * (points[other, axis] - points[vertex, axis])
                if j == i or np.isnan(height):
                    continue
                for axis in range(3):
                    sides[row, axis, 0] += height * normals[other, axis]
                    for second in range(3):
                        quadrics[row, axis, second] += normals[other, axis] * normals[other, second]

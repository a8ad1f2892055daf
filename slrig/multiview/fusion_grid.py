"""Sparse grid around the views: bricks of 8 x 8 x 8 voxels along the surfaces, and distances at their corners.

A cell is named by its lowest corner. Flat index: 512 brick + 64 x + 8 y + z, x, y, z in 0 … 7 within the brick.
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
from slrig.multiview.matching import moved, turned

_SHARP = 0.8  # cosine of 37°: noise turns normals less from vertex to vertex
# Of the quadric's trace: holds a vertex in place along the edge, and where noise makes an edge of a surface. Of a box
# at 0.2 mm the error is 6.8 µm rms with it, 7.2 with 0.1, and 10.1 with edges cut off.
_STAY = 0.03


def sharpened(points_mm: FloatArray, normals: FloatArray, quads: IntArray, /, *, furthest_mm: float) -> FloatArray:
    """(m, 3) float64: the points, those at sharp edges moved to where the tangent planes about them meet.

    It is the least sum of squared distances to the planes of the vertices that share a quadrangle with it (Garland and
    Heckbert 1997, "Surface simplification using quadric error metrics"; as in dual contouring, Ju et al. 2002).

    points_mm, normals : (m, 3) float64, normals unit or NaN; quads : (q, 4) int32. furthest_mm : no vertex goes
    further.
    """
    sharp = np.zeros(len(points_mm), dtype=np.bool_)
    _mark_sharp(quads, normals, sharp)
    number = np.where(sharp, np.cumsum(sharp) - 1, -1)
    count = int(np.count_nonzero(sharp))
    quadrics, sides = np.zeros((count, 3, 3)), np.zeros((count, 3, 1))
    _add_planes(quads, points_mm, normals, number, quadrics, sides)
    # A sharp vertex has two neighbours at least, so that no trace is 0.
    held = quadrics + _STAY * np.trace(quadrics, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    step = np.linalg.solve(held, sides)[:, :, 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    moved = points_mm.copy()
    moved[sharp] += step * np.minimum(1.0, furthest_mm / np.maximum(length, 1e-12))
    return moved


@kernel(in_every_scan=False)
def _mark_sharp(quads: Any, normals: Any, sharp: Any) -> None:
    for quad in range(len(quads)):
        for i in range(3):
            for j in range(i + 1, 4):
                a, b = quads[quad, i], quads[quad, j]
                cosine = normals[a, 0] * normals[b, 0] + normals[a, 1] * normals[b, 1] + normals[a, 2] * normals[b, 2]
                if cosine < _SHARP:
                    sharp[a] = sharp[b] = True


@kernel(in_every_scan=False)
def _add_planes(quads: Any, points: Any, normals: Any, number: Any, quadrics: Any, sides: Any) -> None:
    """Of each numbered vertex, the sum of n nᵀ and of n (n . (p - x)) over the others of its quadrangles."""
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


_RIGID = 1e-6  # a product of many poses in double precision keeps to 1e-12; what was typed or in float32 to 1e-7
_SAMPLED_FACES = 20_000  # of each view: their median area is known to a per cent
_SWEEPS = 4  # two each way follow any border over the few edges that an inset is wide


class Sheets(NamedTuple):
    """n vertices and T triangles of V views, the model's frame, millimetres.

    points_mm : (n, 3) float64; normals : (n, 3) float32; sigma_mm : (n,) float32; colour : (n, 3) uint8, sRGB;
    mark : (n,) uint8. inset_mm : (n,) float32, how far along edges the open border of the view is, cut at a limit.
    faces : (T, 3) int32 into all points. open_edges : (T,) uint8, bit k is set where no triangle lies across the edge
    opposite corner k. first_face, first_vertex : (V + 1,) int64, view v has the triangles
    first_face[v]:first_face[v + 1], and vertices alike.
    """

    points_mm: FloatArray
    normals: NDArray[np.float32]
    sigma_mm: NDArray[np.float32]
    colour: NDArray[np.uint8]
    mark: NDArray[np.uint8]
    inset_mm: NDArray[np.float32]
    faces: IntArray
    open_edges: NDArray[np.uint8]
    first_face: NDArray[np.int64]
    first_vertex: NDArray[np.int64]


def sampling_mm(views: Sequence[Mesh]) -> float:
    """How far apart the views' vertices lie: the side of a square with the area of two triangles, median over views."""
    sides = []
    for view in views:
        a, b, c = (view.vertices_mm[corner].astype(np.float64) for corner in _sampled(view.faces).T)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        if np.isfinite(areas).any():
            sides.append(float(np.sqrt(2 * np.nanmedian(areas))))
    return float(np.median(sides)) if sides else float("nan")


def sheets(views: Sequence[Mesh], poses: Sequence[FloatArray] | FloatArray, /, *, inset_mm: float) -> Sheets:
    """Take the views into the model's frame. Triangles with a vertex that has no place, normal or σ are left out.

    inset_mm : the insets are cut here.

    Raises
    ------
    ValueError
        The poses are not one for each view and rigid.
    InvalidInputError
        A view is no manifold (`neighbours`).
    NothingToReconstructError
        No view has a triangle.
    """
    _require_rigid(len(views), poses)
    points, normals, insets, faces, open_edges = [], [], [], [], []
    before = 0
    for number, (view, pose) in enumerate(zip(views, poses, strict=True)):
        placed = moved(pose, view.vertices_mm)
        # One sum each: an axis of three is slow.
        sound = np.isfinite(placed[:, 0] + placed[:, 1] + placed[:, 2] + view.normals[:, 0] + view.sigma_mm)
        kept = view.faces if sound.all() else view.faces[sound[view.faces].all(axis=1)]
        try:
            across = neighbours(kept, vertex_count=len(placed))
        except ValueError as error:
            message = f"view {number} is no manifold: {error}; take its mesh as slrig wrote it"
            raise InvalidInputError(message) from error
        a, b, c = (across < 0).astype(np.uint8).T
        border = a | b << 1 | c << 2
        inset = np.full(len(placed), inset_mm, dtype=np.float32)
        _insets(placed, np.ascontiguousarray(kept), border, inset)
        points.append(placed)
        normals.append(turned(pose, view.normals).astype(np.float32))
        insets.append(inset)
        faces.append(kept + np.int32(before))
        open_edges.append(border)
        before += len(placed)
    first_face = np.cumsum([0, *map(len, faces)])
    if first_face[-1] == 0:
        message = f"asked to fuse {len(views)} views, and none has a triangle with known normals and σ; scan again"
        raise NothingToReconstructError(message)
    return Sheets(
        np.concatenate(points), np.concatenate(normals), np.concatenate([view.sigma_mm for view in views]),
        np.concatenate([view.colour for view in views]), np.concatenate([view.mark for view in views]),
        np.concatenate(insets), np.concatenate(faces), np.concatenate(open_edges),
        first_face, np.cumsum([0, *map(len, points)]),
    )  # fmt: skip


def _sampled(faces: IntArray) -> IntArray:
    return faces[:: max(1, len(faces) // _SAMPLED_FACES)]


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
        if not (off < _RIGID and np.linalg.det(turn) > 0 and np.isfinite(pose).all()):
            message = (
                f"pose {number} is not rigid: it is {off:.2g} off a rotation and a shift; "
                "give R and t of x_model = R x_view + t as [[R, t], [0, 1]]"
            )
            raise ValueError(message)


@kernel(in_every_scan=False)
def _insets(points: Any, faces: Any, open_edges: Any, inset: Any) -> None:
    """Distances along edges from the open border, from 0 there up to what `inset` holds already."""
    for face in range(len(faces)):
        for corner in range(3):
            if open_edges[face] >> corner & 1:
                inset[faces[face, (corner + 1) % 3]] = inset[faces[face, (corner + 2) % 3]] = 0.0
    for sweep in range(_SWEEPS):
        changed = False
        for step in range(len(faces)):
            face = len(faces) - 1 - step if sweep % 2 else step
            for corner in range(3):
                a, b = faces[face, corner], faces[face, (corner + 1) % 3]
                gap = abs(inset[a] - inset[b])
                if gap == 0.0:
                    continue
                x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
                length = np.sqrt(x * x + y * y + z * z)
                if gap > length * (1 + 1e-6):  # of single precision
                    changed = True
                    if inset[a] > inset[b]:
                        inset[a] = inset[b] + length
                    else:
                        inset[b] = inset[a] + length
        if not changed:
            break


BRICK = 8
CELLS = BRICK**3
_AXIS_BITS = 21  # of a key: three coordinates of a brick in 63 bits
_MOST_BRICKS = 400_000  # 2 kB a brick and dense array: about 2 GB with all that fusion holds
MARGIN = 0.1  # voxels: the views' mean may pass a little beside each of them
SEEN_BEYOND = 0.5  # voxels: what lies so near beside a border cannot be told from seen


class Grid(NamedTuple):
    """origin_mm : (3,) float64, the corner of brick (0, 0, 0). keys : (B,) int64, rising, of the bricks that are there.

    around : (B, 27) int32, the bricks about each by 9 dx + 3 dy + dz + 13, -1 where there is none.
    """

    origin_mm: FloatArray
    voxel_mm: float
    keys: NDArray[np.int64]
    around: IntArray


def grid_about(sheets: Sheets, voxel_mm: float) -> Grid:
    """The bricks that hold a corner of a cell in which the fused surface may lie.

    Raises
    ------
    InvalidInputError
        There are more than memory is meant for.
    """
    used = sheets.points_mm[used_vertices(sheets.faces, len(sheets.points_mm))]
    # A brick's width free on all sides, so that every brick has neighbours with keys.
    origin = used.min(axis=0) - 2 * BRICK * voxel_mm
    span = int(((used.max(axis=0) - origin) / (BRICK * voxel_mm)).max()) + 3
    empty = np.zeros((0, 27), dtype=np.int32)
    if span < 1 << _AXIS_BITS:
        bare = Grid(origin, voxel_mm, np.zeros(0, dtype=np.int64), empty)
        keys = np.unique(np.concatenate(in_bands(_touched_bricks, len(sheets.first_face) - 1, sheets, bare)))
    if span >= 1 << _AXIS_BITS or len(keys) > _MOST_BRICKS:
        message = (
            f"voxels of {voxel_mm:g} mm are too small for views that reach over {np.ptp(used, axis=0).max():.0f} mm: "
            f"they take more than {_MOST_BRICKS} bricks of {BRICK}³; ask for larger ones, or cut stray points away"
        )
        raise InvalidInputError(message)
    steps = np.array([-1, 0, 1])
    offsets = ((steps[:, None, None] << 2 * _AXIS_BITS) + (steps[:, None] << _AXIS_BITS) + steps).ravel()
    around = np.full((len(keys), 27), -1, dtype=np.int32)
    for number, offset in enumerate(offsets):
        place = np.minimum(np.searchsorted(keys, keys + offset), len(keys) - 1)
        around[:, number] = np.where(keys[place] == keys + offset, place, -1)
    return Grid(origin, voxel_mm, keys, around)


def wanted_corners(sheets: Sheets, grid: Grid) -> IntArray:
    """(n,) int32, rising: flat indices of the corners of all cells that a triangle passes through, or nearly."""
    cells = np.zeros(CELLS * len(grid.keys), dtype=np.uint8)
    _mark_cells(sheets, grid, cells)
    wanted = np.zeros_like(cells)
    _mark_corners(grid.around, cells, wanted)
    return np.flatnonzero(wanted).astype(np.int32)


def corners_mm(grid: Grid, cells: IntArray) -> FloatArray:
    """(n, 3) float64: where the lowest corners of cells lie; cells (n,) int32, flat."""
    key, within = grid.keys[cells // CELLS], cells % CELLS
    bricks = np.stack([key >> 2 * _AXIS_BITS, key >> _AXIS_BITS, key], axis=1) & ((1 << _AXIS_BITS) - 1)
    steps = np.stack([within >> 6, within >> 3 & 7, within & 7], axis=1)
    return np.asarray(grid.origin_mm + grid.voxel_mm * (BRICK * bricks + steps))


@kernel_part
def cell_beside(around: Any, brick: int, x: int, y: int, z: int) -> int:
    """Flat index of a cell by its place from the brick's corner, -8 to 15 each way; -1 where no brick is."""
    other = around[brick, 9 * (x >> 3) + 3 * (y >> 3) + (z >> 3) + 13]
    return -1 if other < 0 else CELLS * other + 64 * (x & 7) + 8 * (y & 7) + (z & 7)


@kernel_part
def corner_of(around: Any, cell: int, corner: int) -> int:
    """Flat index of one of a cell's eight corners, 4 x + 2 y + z, or of the cell there; -1 where no brick is."""
    x, y, z = cell >> 6 & 7, cell >> 3 & 7, cell & 7
    at: int = cell_beside(around, cell // CELLS, x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1))
    return at


@kernel_part
def brick_key(x: int, y: int, z: int) -> int:
    """Key of a brick by its coordinates."""
    return (x << 2 * _AXIS_BITS) + (y << _AXIS_BITS) + z


@kernel_part
def brick_at(keys: Any, x: int, y: int, z: int, cached_keys: Any, cached: Any) -> int:
    """Number of a brick by its coordinates, -1 where there is none; triangles beside one another ask for the same ones.

    cached_keys, cached : (64,) int64, what was asked for last, -1 at first.
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
    """The two arrays that `brick_at` remembers in."""
    return np.full(64, -1, dtype=np.int64), np.full(64, -1, dtype=np.int64)


@kernel_part(inline="always")
def cells_about(a: float, b: float, c: float, origin: float, per_mm: float, about: float) -> tuple[int, int]:
    """The first and the last cell, along an axis, of those that three coordinates and `about` voxels beside them touch.

    Coordinates less the origin's are positive: the grid begins beyond all triangles' reach.
    """
    return int((min(a, b, c) - origin) * per_mm - about), int((max(a, b, c) - origin) * per_mm + about)


@kernel(in_every_scan=False)
def _touched_bricks(first: int, last: int, sheets: Any, grid: Any) -> Any:
    """Keys of the bricks with a corner of a cell in the boxes of these views' triangles, which are wider at borders."""
    points, faces, origin, per_mm = sheets.points_mm, sheets.faces, grid.origin_mm, 1.0 / grid.voxel_mm
    low, high = np.full(3, -1, np.int64), np.full(3, -1, np.int64)
    found, count = np.zeros(1024, dtype=np.int64), 0
    for face in range(sheets.first_face[first], sheets.first_face[last]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        beyond, same = SEEN_BEYOND if sheets.open_edges[face] else MARGIN, True
        for axis in range(3):
            begin, end = cells_about(points[a, axis], points[b, axis], points[c, axis], origin[axis], per_mm, beyond)
            begin, end = begin >> 3, (end + 1) >> 3
            same &= low[axis] == begin and high[axis] == end
            low[axis], high[axis] = begin, end
        if same:
            continue
        if (high[0] - low[0] + 1) * (high[1] - low[1] + 1) * (high[2] - low[2] + 1) > _MOST_BRICKS:
            return np.arange(_MOST_BRICKS + 1)  # one triangle alone takes more than are meant
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                for z in range(low[2], high[2] + 1):
                    if count == len(found):
                        found = np.concatenate((found, np.zeros_like(found)))
                    found[count] = brick_key(x, y, z)
                    count += 1
    return np.unique(found[:count])


@kernel(in_every_scan=False)
def _mark_cells(sheets: Any, grid: Any, cells: Any) -> None:
    """Mark the cells of a triangle's box that its plane passes through, or nearly."""
    points, faces, keys, open_edges = sheets.points_mm, sheets.faces, grid.keys, sheets.open_edges
    ox, oy, oz, per_mm = grid.origin_mm[0], grid.origin_mm[1], grid.origin_mm[2], 1.0 / grid.voxel_mm
    cached_keys, cached = new_cache()
    key_before, brick = -1, -1
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        beyond = SEEN_BEYOND if open_edges[face] else MARGIN
        px, py, pz = points[a, 0], points[a, 1], points[a, 2]
        x_low, x_high = cells_about(px, points[b, 0], points[c, 0], ox, per_mm, beyond)
        y_low, y_high = cells_about(py, points[b, 1], points[c, 1], oy, per_mm, beyond)
        z_low, z_high = cells_about(pz, points[b, 2], points[c, 2], oz, per_mm, beyond)
        ux, uy, uz = points[b, 0] - px, points[b, 1] - py, points[b, 2] - pz
        vx, vy, vz = points[c, 0] - px, points[c, 1] - py, points[c, 2] - pz
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        # The plane is n . x = offset, x the lowest corner of a cell in voxels, whose middle is meant.
        # A triangle without an area marks its whole box.
        offset = (nx * (px - ox) + ny * (py - oy) + nz * (pz - oz)) * per_mm - (nx + ny + nz) / 2
        reach = (0.5 + MARGIN) * (abs(nx) + abs(ny) + abs(nz))
        for x in range(x_low, x_high + 1):
            for y in range(y_low, y_high + 1):
                for z in range(z_low, z_high + 1):
                    if abs(nx * x + ny * y + nz * z - offset) <= reach:
                        key = brick_key(x >> 3, y >> 3, z >> 3)
                        if key != key_before:
                            key_before, brick = key, brick_at(keys, x >> 3, y >> 3, z >> 3, cached_keys, cached)
                        cells[CELLS * brick + 64 * (x & 7) + 8 * (y & 7) + (z & 7)] = 1


@kernel(in_every_scan=False)
def _mark_corners(around: Any, cells: Any, wanted: Any) -> None:
    for cell in range(len(cells)):
        if cells[cell]:
            for corner in range(8):
                wanted[corner_of(around, cell, corner)] = 1


def nearest_to_corners(sheets: Sheets, grid: Grid, points_mm: FloatArray, cells: IntArray) -> IntArray:
    """(V, n) int32: the triangle of each view that is nearest to each corner of the grid, the first of equals; else -1.

    points_mm : (n, 3) float64; cells : (n,) int32, rising, flat indices of the corners.
    Of the triangles that pass through the cells about the corner, or whose box does: so it is exact within a voxel.
    Further off a corner only has to be on the right side of the surface.
    """
    reach = _Reach(box=1.0 + MARGIN, border=SEEN_BEYOND, furthest=3**0.5 + SEEN_BEYOND, width=0.0)
    return _nearest(sheets, grid, points_mm, cells, reach)


def nearest_within(sheets: Sheets, grid: Grid, points_mm: FloatArray, cells: IntArray, *, reach_mm: float) -> IntArray:
    """(V, n) int32: the triangle of each view that is nearest to each point, the first of equals; -1 beyond reach.

    points_mm : (n, 3) float64; cells : (n,) int32, rising, the flat cell that each point lies in.
    """
    voxels = reach_mm / grid.voxel_mm
    return _nearest(sheets, grid, points_mm, cells, _Reach(box=voxels, border=0.0, furthest=voxels, width=1.0))


class _Reach(NamedTuple):
    """In voxels. box : a triangle asks the points in its box with so much about it; border : and this much more, if it
    has an open edge. furthest : distances from there on are none. width : 0 where each point is its cell's lowest
    corner, 1 where it is anywhere inside.
    """

    box: float
    border: float
    furthest: float
    width: float


def _nearest(sheets: Sheets, grid: Grid, points: FloatArray, cells: IntArray, reach: _Reach) -> IntArray:
    # Of each cell, and one more: points of a row of cells are those from its first to before the next row's first.
    first_point = np.zeros(CELLS * len(grid.keys) + 1, dtype=np.int32)
    np.cumsum(np.bincount(cells, minlength=len(first_point) - 1), out=first_point[1:])
    views = len(sheets.first_face) - 1
    nearest = np.full((views, len(points)), -1, dtype=np.int32)
    in_bands(_nearest_faces, views, sheets, grid, points, first_point, reach, nearest)
    return nearest


@kernel(in_every_scan=False)
def _nearest_faces(
    first: int, last: int, sheets: Any, grid: Any, points: Any, first_point: Any, reach: Any,
    nearest: Any,
) -> None:  # fmt: skip
    corners, faces, origin, keys, voxel = sheets.points_mm, sheets.faces, grid.origin_mm, grid.keys, grid.voxel_mm
    open_edges, gaps, asked = sheets.open_edges, np.zeros(len(points)), np.zeros(len(corners), np.bool_)
    ox, oy, oz, per_mm, beside = origin[0], origin[1], origin[2], 1.0 / voxel, 1 if reach.width == 0.0 else 0
    cached_keys, cached = new_cache()
    for view in range(first, last):
        gaps[:] = reach.furthest * voxel
        begin, end = sheets.first_face[view], sheets.first_face[view + 1]
        # Vertices come first, as triangles without an extent: few triangles are then nearer than what is known.
        for corner in range(4):
            for face in range(begin, end):
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                if corner < 3:
                    a = b = c = faces[face, corner]
                    if asked[a]:
                        continue
                    asked[a] = True
                about = reach.box + (reach.border if open_edges[face] else 0.0)
                x_low, x_high = cells_about(corners[a, 0], corners[b, 0], corners[c, 0], ox, per_mm, about)
                y_low, y_high = cells_about(corners[a, 1], corners[b, 1], corners[c, 1], oy, per_mm, about)
                z_low, z_high = cells_about(corners[a, 2], corners[b, 2], corners[c, 2], oz, per_mm, about)
                # The corner of a cell that is cut is outside the box; another point of that cell may be inside.
                x_low, y_low, z_low = x_low + beside, y_low + beside, z_low + beside
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
                            brick = brick_at(keys, bx, by, bz, cached_keys, cached)
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
                                            gap2 = height * height + aside * aside  # at least
                                        if gap2 < gap * gap:
                                            if corner == 3:
                                                gap2 = nearest_on_triangle(px, py, pz, corners, a, b, c)[0]
                                            if gap2 < gap * gap:
                                                gaps[at] = np.sqrt(gap2)
                                                nearest[view, at] = face


@kernel_part(inline="always")
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Zero if it has no length."""
    scale = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-300)
    return x * scale, y * scale, z * scale

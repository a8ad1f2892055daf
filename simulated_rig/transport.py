"""Ray-traced light paths projector -> surface -> camera: the projector position and strength of each sample's light.

Each state of the world is traced once; each pattern is then a table look-up (`simulated_rig.light`). Light from one
surface to another is traced by `simulated_rig.bounces`.

Prints are averaged exactly over each sample. A sample represents a cell of its pixel; the cell's rays meet the sheet in
a small quadrilateral, whose dark part follows from clipping it at the lines of the print. Edges are therefore
independent of the sample positions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from simulated_rig.optics import LensArray, distort, field_radius, lens_array, undistort, world_directions
from simulated_rig.scene import BoardPrint, SceneSurface
from slrig.errors import ConfigError
from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, IntArray, Pinhole

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    EMBREE = True
except ImportError:  # no wheel for this processor
    EMBREE = False


_REACH = 0.9
"""Fraction of a cell's side: more than half its diagonal, with a margin for the lens distortion. Cells farther from
every edge need no clipping."""
_MAX_CORNERS = 12
SHADOW_BIAS_MM = 0.05
"""A surface shades a point only if it is nearer to the projector by more than this, so that facets do not shade the
curved surface that they approximate."""
LUMA = (0.114, 0.587, 0.299)
"""Weights of blue, green and red light in grey (Rec. 601)."""
BLOCK_RAYS = 120_000


class RayCaster(Protocol):
    """Casts rays at a surface."""

    def first_hit(self, origin_mm: FloatArray, directions: FloatArray) -> IntArray:
        """Return (n,) int32: index of the first triangle along each ray, -1 if none.

        origin_mm : (3,) or (n, 3) float64; directions : (n, 3) float64, unit.
        """
        ...


class EmbreeCaster:
    """Embree, in single precision relative to the centre of the scene.

    It only identifies the triangle; the caller computes the point in double precision, so rounding does not move
    surfaces.
    """

    def __init__(self, vertices_mm: FloatArray, faces: IntArray) -> None:
        self._middle = (vertices_mm.min(axis=0) + vertices_mm.max(axis=0)) / 2
        self._scene = EmbreeScene()
        # embreex reads the buffers in memory order: by rows.
        vertices = np.ascontiguousarray(vertices_mm - self._middle, np.float32)
        TriangleMesh(scene=self._scene, vertices=vertices, indices=np.ascontiguousarray(faces, np.int32))

    def first_hit(self, origin_mm: FloatArray, directions: FloatArray) -> IntArray:
        """See `RayCaster`. Runs without the interpreter's lock."""
        origins = np.broadcast_to((origin_mm - self._middle).astype(np.float32), directions.shape)
        found: NDArray[np.int32] = self._scene.run(
            np.ascontiguousarray(origins), np.ascontiguousarray(directions, np.float32)
        )
        return found


class TreeCaster:
    """The R-tree caster of trimesh: a hundred times slower, available everywhere."""

    def __init__(self, vertices_mm: FloatArray, faces: IntArray) -> None:
        mesh = trimesh.Trimesh(vertices_mm, faces, process=False)
        self._mesh = trimesh.ray.ray_triangle.RayMeshIntersector(mesh)

    def first_hit(self, origin_mm: FloatArray, directions: FloatArray) -> IntArray:
        """See `RayCaster`."""
        origins = np.broadcast_to(origin_mm, directions.shape)
        return np.asarray(self._mesh.intersects_first(origins, directions), np.int32)


def build_caster(vertices_mm: FloatArray, faces: IntArray) -> RayCaster:
    """Return the fastest available caster. Raises ConfigError if there is none."""
    if EMBREE:
        return EmbreeCaster(vertices_mm, faces)
    try:
        return TreeCaster(vertices_mm, faces)
    except ImportError as error:
        message = "the simulated rig needs a ray caster: found neither embreex nor rtree; install one of them with pip"
        raise ConfigError(message) from error


def print_reflectance(
    points: FloatArray,
    normals: FloatArray,
    triangle: IntArray,
    u: FloatArray,
    v: FloatArray,
    camera: Pinhole,
    surface: SceneSurface,
    *,
    footprint_px: float,
) -> FloatArray:
    """Factor of the prints on the albedo, (n,) float64, where a camera's rays through u, v hit the surface; 1
    elsewhere.

    Each point of a print is moved, in place, to the centroid of the light that its cell reflects, so that a partly dark
    cell counts at its light part. footprint_px : side of a sample's cell; 0 evaluates the print at the point.
    """
    out = np.ones(len(u))
    for part, board_print in surface.prints.items():
        _fill_reflectance(
            out,
            points,
            normals,
            triangle,
            u,
            v,
            surface.part,
            part,
            surface.to_object[part],
            camera.centre_mm,
            lens_array(camera),
            camera.rotation,
            footprint_px,
            *_kernel_arguments(board_print),
        )
    return out


def _kernel_arguments(
    board_print: BoardPrint,
) -> tuple[FloatArray, FloatArray, NDArray[np.uint8], FloatArray, float, float, float]:
    return (
        board_print.across_mm,
        board_print.down_mm,
        board_print.dark,
        board_print.centres_mm,
        board_print.radius_mm,
        board_print.dark_share,
        board_print.curvature_per_mm,
    )


@kernel_part
def _arc_length(x: float, curvature: float) -> float:
    """Length along the sheet z = c x² from 0 to x."""
    if curvature == 0.0:
        return x
    steep = 2.0 * curvature * x
    return float(x * np.sqrt(1.0 + steep * steep) / 2.0 + np.arcsinh(steep) / (4.0 * curvature))


@kernel_part
def _clip_polygon(polygon: FloatArray, count: int, a: float, b: float, limit: float, out: FloatArray) -> int:
    """Clip a convex polygon to a x + b y <= limit (Sutherland and Hodgman 1974). Return its number of corners."""
    size = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here = a * polygon[i, 0] + b * polygon[i, 1] - limit
        there = a * polygon[j, 0] + b * polygon[j, 1] - limit
        if here <= 0.0:
            out[size, 0], out[size, 1] = polygon[i, 0], polygon[i, 1]
            size += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            share = here / (here - there)
            out[size, 0] = polygon[i, 0] + share * (polygon[j, 0] - polygon[i, 0])
            out[size, 1] = polygon[i, 1] + share * (polygon[j, 1] - polygon[i, 1])
            size += 1
    return size


@kernel_part
def _moments(polygon: FloatArray, count: int) -> tuple[float, float, float]:
    """Signed area of a polygon and its first moments in x and y."""
    area, mx, my = 0.0, 0.0, 0.0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        cross = polygon[i, 0] * polygon[j, 1] - polygon[j, 0] * polygon[i, 1]
        area += cross
        mx += cross * (polygon[i, 0] + polygon[j, 0])
        my += cross * (polygon[i, 1] + polygon[j, 1])
    return area / 2.0, mx / 6.0, my / 6.0


@kernel_part
def _dark_in_rectangles(
    cell: FloatArray,
    x0: float,
    y0: float,
    across: FloatArray,
    down: FloatArray,
    dark: NDArray[np.uint8],
    first: FloatArray,
    second: FloatArray,
) -> tuple[float, float, float]:
    """Dark area of a cell, its corners relative to (x0, y0), and the first moments of that area."""
    area, mx, my = 0.0, 0.0, 0.0
    left, right = cell[:, 0].min() + x0, cell[:, 0].max() + x0
    top, bottom = cell[:, 1].min() + y0, cell[:, 1].max() + y0
    i0 = max(np.searchsorted(down, top, "right") - 1, 0)
    j0 = max(np.searchsorted(across, left, "right") - 1, 0)
    for i in range(i0, len(down) - 1):
        if down[i] >= bottom:
            break
        for j in range(j0, len(across) - 1):
            if across[j] >= right:
                break
            if dark[i, j] == 0:
                continue
            count = _clip_polygon(cell, 4, -1.0, 0.0, -(across[j] - x0), first)
            count = _clip_polygon(first, count, 1.0, 0.0, across[j + 1] - x0, second)
            count = _clip_polygon(second, count, 0.0, -1.0, -(down[i] - y0), first)
            count = _clip_polygon(first, count, 0.0, 1.0, down[i + 1] - y0, second)
            a, x, y = _moments(second, count)
            area, mx, my = area + a, mx + x, my + y
    return area, mx, my


@kernel_part
def _nearest_disc(x: float, y: float, centres: FloatArray) -> tuple[int, float]:
    best, least = 0, np.inf
    for k in range(len(centres)):
        square = (centres[k, 0] - x) ** 2 + (centres[k, 1] - y) ** 2
        if square < least:
            best, least = k, square
    return best, np.sqrt(least)


@kernel_part
def _print_at_point(
    x: float,
    y: float,
    reach: float,
    across: FloatArray,
    down: FloatArray,
    dark: NDArray[np.uint8],
    centres: FloatArray,
    radius: float,
) -> tuple[bool, bool]:
    """Return if the print is dark at a point, and if it is uniform within `reach` of it."""
    if len(centres) > 0:
        _best, distance = _nearest_disc(x, y, centres)
        return distance < radius, abs(distance - radius) > reach
    j, i = np.searchsorted(across, x, "right") - 1, np.searchsorted(down, y, "right") - 1
    if i < 0 or j < 0 or i >= len(down) - 1 or j >= len(across) - 1:
        outside = x < across[0] - reach or x > across[-1] + reach or y < down[0] - reach or y > down[-1] + reach
        return False, outside
    same = x - across[j] > reach and across[j + 1] - x > reach and y - down[i] > reach and down[i + 1] - y > reach
    return dark[i, j] == 1, same


@kernel(in_every_scan=False)
def _fill_reflectance(
    out: FloatArray,
    points: FloatArray,
    normals: FloatArray,
    triangle: IntArray,
    u: FloatArray,
    v: FloatArray,
    part: IntArray,
    own: int,
    frame: FloatArray,
    eye: FloatArray,
    lens: LensArray,
    rotation: FloatArray,
    footprint: float,
    across: FloatArray,
    down: FloatArray,
    dark: NDArray[np.uint8],
    centres: FloatArray,
    radius: float,
    dark_share: float,
    curvature: float,
) -> None:
    """Fill `out` at the hits of part `own`, and move their points. See `print_reflectance`."""
    cell = np.zeros((4, 2))
    first, second = np.zeros((_MAX_CORNERS, 2)), np.zeros((_MAX_CORNERS, 2))
    ray = np.zeros(3)
    narrow = min(lens[0], lens[1])
    for k in range(len(u)):
        if triangle[k] < 0 or part[triangle[k]] != own or not np.isfinite(points[k, 0]):
            continue
        p, n = points[k], normals[k]
        x = frame[0, 0] * p[0] + frame[0, 1] * p[1] + frame[0, 2] * p[2] + frame[0, 3]
        y = frame[1, 0] * p[0] + frame[1, 1] * p[1] + frame[1, 2] * p[2] + frame[1, 3]
        s = _arc_length(x, curvature)
        d0, d1, d2 = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
        distance = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        # Distance to the sheet's plane; divided by the distance along the ray it is the cosine of incidence.
        height = -(n[0] * d0 + n[1] * d1 + n[2] * d2)
        reach = _REACH * footprint * distance / narrow * distance / max(height, 1e-9)
        inked, same = _print_at_point(s, y, reach, across, down, dark, centres, radius)
        if same or footprint == 0.0:
            if inked:
                out[k] = dark_share
            continue
        # The cell's four corners on the tangent plane of the sheet, in sheet coordinates relative to this point.
        cu = (np.floor((u[k] + 0.5) / footprint) + 0.5) * footprint - 0.5
        cv = (np.floor((v[k] + 0.5) / footprint) + 0.5) * footprint - 0.5
        for corner in range(4):
            du = -0.5 if corner == 0 or corner == 3 else 0.5
            dv = -0.5 if corner < 2 else 0.5
            a, b = undistort((cu + du * footprint - lens[2]) / lens[0], (cv + dv * footprint - lens[3]) / lens[1], lens)
            for axis in range(3):
                ray[axis] = rotation[0, axis] * a + rotation[1, axis] * b + rotation[2, axis]
            t = -height / (n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2])
            q0, q1, q2 = eye[0] + t * ray[0], eye[1] + t * ray[1], eye[2] + t * ray[2]
            qx = frame[0, 0] * q0 + frame[0, 1] * q1 + frame[0, 2] * q2 + frame[0, 3]
            qy = frame[1, 0] * q0 + frame[1, 1] * q1 + frame[1, 2] * q2 + frame[1, 3]
            cell[corner, 0], cell[corner, 1] = _arc_length(qx, curvature) - s, qy - y
        area, mx, my = _moments(cell, 4)
        if len(centres) > 0:
            # Near its rim a large disc is approximated by a half-plane.
            best, off = _nearest_disc(s, y, centres)
            a, b = (s - centres[best, 0]) / off, (y - centres[best, 1]) / off
            count = _clip_polygon(cell, 4, a, b, radius - off, first)
            inked_area, ix, iy = _moments(first, count)
        else:
            inked_area, ix, iy = _dark_in_rectangles(cell, s, y, across, down, dark, first, second)
        lost = (1.0 - dark_share) * inked_area / area
        out[k] = 1.0 - lost
        # From the cell's centre to the centroid of its reflected light, in the sheet's plane.
        move_x = (mx - (1.0 - dark_share) * ix) / (area * out[k]) - mx / area
        move_y = (my - (1.0 - dark_share) * iy) / (area * out[k]) - my / area
        rise, slope = 0.0, 0.0
        for axis in range(3):
            rise -= n[axis] * (move_x * frame[0, axis] + move_y * frame[1, axis])
            slope += n[axis] * frame[2, axis]
        for axis in range(3):
            points[k, axis] += move_x * frame[0, axis] + move_y * frame[1, axis] + rise / slope * frame[2, axis]


@kernel_part
def _hash01(x: int, y: int, z: int) -> float:
    """Pseudo-random number in 0..1 of a lattice point, always the same for the same point."""
    # Masked to 32 bits after each product: the same result under numba and in plain Python.
    h = ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    return float(h ^ (h >> 16)) / 4294967295.0


@kernel_part
def texture_value(kind: int, x: float, y: float, z: float) -> float:
    """Darkness 0..1 of a texture at (x, y, z), in grains. 0 uniform, 1 checker, 2 smooth value noise, two octaves."""
    if kind == 1:
        return float((int(np.floor(x)) + int(np.floor(y))) % 2)
    if kind != 2:
        return 0.0
    total = 0.0
    for octave in range(2):
        scale = 1.0 + octave
        xs, ys, zs = x * scale, y * scale, z * scale
        i, j, k = int(np.floor(xs)), int(np.floor(ys)), int(np.floor(zs))
        fx, fy, fz = xs - i, ys - j, zs - k
        # Smoothstep, so that the shading has no creases at the lattice.
        fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
        value = 0.0
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            share = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
            value += share * _hash01(i + a, j + b, k + c)
        total += value * (2.0 / 3.0 if octave == 0 else 1.0 / 3.0)
    return total


@dataclass(frozen=True, slots=True)
class Hits:
    """Surface points hit by n rays of one camera.

    points_mm, normals : (n, 3) float64, world, NaN for a miss; the normals are unit and face the camera. triangle :
    (n,) int32, -1 for a miss. is_hit, is_lit : (n,) bool, is_lit by the projector's image.
    column_px, row_px : (n,) float64, projector image position of the point (may be outside the image), NaN in shadow.
    weight : (n,) float32, light sent to the camera per unit of projector light; albedo : (n,) float32.
    hue : (n, 3) float32, factor on both for blue, green and red light relative to white light.
    """

    points_mm: FloatArray
    normals: FloatArray
    triangle: IntArray
    is_hit: NDArray[np.bool_]
    is_lit: NDArray[np.bool_]
    column_px: FloatArray
    row_px: FloatArray
    weight: NDArray[np.float32]
    albedo: NDArray[np.float32]
    hue: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class LightPaths:
    """Light paths of every sub-pixel sample of one camera, S per pixel.

    column_px, row_px, weight : (H, W, S) float32, weight 0 where the sample is not lit.
    albedo : (H, W) float32, mean over the pixel's samples, 0 for misses.
    hue : (H, W, S, 3) float32 as in `Hits`; None if nothing is coloured.
    """

    column_px: NDArray[np.float32]
    row_px: NDArray[np.float32]
    weight: NDArray[np.float32]
    albedo: NDArray[np.float32]
    hue: NDArray[np.float32] | None = None

    def for_channel(self, channel: int) -> LightPaths:
        """Return the paths of blue, green or red light alone: 0, 1, 2."""
        if self.hue is None:
            return self
        hue = self.hue[..., channel]
        # An approximation: samples of one pixel have nearly the same albedo, and only ambient light uses the mean.
        return replace(self, weight=self.weight * hue, albedo=self.albedo * hue.mean(axis=2), hue=None)


def trace_rays(
    u: FloatArray,
    v: FloatArray,
    camera: Pinhole,
    projector: Pinhole,
    surface: SceneSurface,
    rays: RayCaster,
    *,
    working_distance_mm: float,
    footprint_px: float = 0.0,
) -> Hits:
    """Trace the camera's rays through pixel positions u, v ((n,) float64) to the surface and on to the projector.

    The weight is the Lambert and Phong light times (working distance / distance to the projector)²: 1 for a white
    diffuser at the working distance that faces the projector. footprint_px : side of the square of the image that each
    ray represents, over which prints are averaged; 0 evaluates prints at the point.
    """
    directions = world_directions(u, v, lens_array(camera), camera.rotation)
    triangle, points, normals = find_points(camera.centre_mm[None], directions, surface, rays)
    pigments = print_reflectance(points, normals, triangle, u, v, camera, surface, footprint_px=footprint_px)
    return light_points(
        points,
        normals,
        directions,
        triangle,
        pigments,
        projector,
        surface,
        rays,
        working_distance_mm=working_distance_mm,
    )


def find_points(
    origins_mm: FloatArray,
    directions: FloatArray,
    surface: SceneSurface,
    rays: RayCaster,
    *,
    starts_mm: FloatArray | None = None,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the first triangle, point and normal along each ray, as in `Hits`: (n,), (n, 3) and (n, 3).

    origins_mm : (n, 3) float64, or (1, 3) for all rays; starts_mm : the same, where the search for the triangle starts
    if the origins are on a surface.
    """
    triangle = rays.first_hit(origins_mm if starts_mm is None else starts_mm, directions)
    points, normals = _hit_points(
        origins_mm,
        directions,
        triangle,
        surface.vertices_mm,
        surface.faces,
        surface.corner_normals,
        surface.part,
        surface.sphere_mm,
    )
    return triangle, points, normals


def light_points(
    points: FloatArray,
    normals: FloatArray,
    directions: FloatArray,
    triangle: IntArray,
    pigments: FloatArray,
    projector: Pinhole,
    surface: SceneSurface,
    rays: RayCaster,
    *,
    working_distance_mm: float,
) -> Hits:
    """Light points that rays of these directions met, see `trace_rays`. pigments : (n,) float64, factor of prints."""
    lamp = projector.centre_mm
    is_hit = np.isfinite(points[:, 0])
    to_point = points - lamp
    distance = np.linalg.norm(to_point, axis=1)
    # Rays that missed are cast along x, and ignored.
    towards = np.where(is_hit[:, None], to_point / np.where(distance > 0, distance, 1.0)[:, None], (1.0, 0.0, 0.0))
    blocker = rays.first_hit(lamp, towards)
    column, row = np.full(len(points), np.nan), np.full(len(points), np.nan)
    weight, albedo = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    hue = np.ones((len(points), 3), np.float32)
    _light_points(
        points,
        normals,
        directions,
        triangle,
        blocker,
        towards,
        distance,
        surface.vertices_mm,
        surface.faces,
        surface.part,
        surface.to_object,
        surface.material,
        surface.colours,
        pigments,
        lamp,
        lens_array(projector),
        projector.rotation,
        projector.translation_mm,
        field_radius(projector),
        working_distance_mm,
        column,
        row,
        weight,
        albedo,
        hue,
    )
    width, height = projector.size.width_px, projector.size.height_px
    inside = (column >= -0.5) & (column <= width - 0.5) & (row >= -0.5) & (row <= height - 0.5)
    return Hits(points, normals, triangle, is_hit, inside & (weight > 0), column, row, weight, albedo, hue)


def trace_paths(
    camera: Pinhole,
    projector: Pinhole,
    surface: SceneSurface,
    rays: RayCaster,
    *,
    samples_per_axis: int,
    jitter: bool,
    seed: int,
    working_distance_mm: float,
    workers: int,
    report_progress: Callable[[float], None] = lambda _: None,
) -> LightPaths:
    """Trace samples_per_axis² samples per pixel, at the centres of equal cells or, jittered, anywhere in each cell.

    `report_progress` receives the fraction done after each block.
    """
    rows, columns = camera.size.shape
    count = samples_per_axis**2
    out = LightPaths(
        column_px=np.zeros((rows, columns, count), np.float32),
        row_px=np.zeros((rows, columns, count), np.float32),
        weight=np.zeros((rows, columns, count), np.float32),
        albedo=np.zeros((rows, columns), np.float32),
        hue=np.ones((rows, columns, count, 3), np.float32) if (surface.colours != 1).any() else None,
    )
    block_rows = max(BLOCK_RAYS // (columns * count), 1)

    def fill(first: int) -> None:
        last = min(first + block_rows, rows)
        u, v = sample_positions(
            first, last, columns, samples_per_axis, np.random.default_rng((seed, first)) if jitter else None
        )
        hits = trace_rays(
            u,
            v,
            camera,
            projector,
            surface,
            rays,
            working_distance_mm=working_distance_mm,
            footprint_px=1 / samples_per_axis,
        )
        shape = (last - first, columns, count)
        known = np.isfinite(hits.column_px)
        out.column_px[first:last] = np.where(known, hits.column_px, 0.0).reshape(shape)
        out.row_px[first:last] = np.where(known, hits.row_px, 0.0).reshape(shape)
        out.weight[first:last] = np.where(known, hits.weight, 0.0).reshape(shape)
        out.albedo[first:last] = hits.albedo.reshape(shape).mean(axis=2)
        if out.hue is not None:
            out.hue[first:last] = hits.hue.reshape(*shape, 3)

    starts = range(0, rows, block_rows)
    with ThreadPoolExecutor(workers, thread_name_prefix="trace") as pool:
        # Each block writes its own rows; iterating over the results raises the error of a failed block here.
        for done, _ in enumerate(pool.map(fill, starts), start=1):
            report_progress(done / len(starts))
    return out


def pixel_centres(camera: Pinhole) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
    """Yield blocks of whole rows: (rows, u, v) with the pixel centres, row by row."""
    rows, columns = camera.size.shape
    block_rows = max(BLOCK_RAYS // columns, 1)
    for first in range(0, rows, block_rows):
        last = min(first + block_rows, rows)
        u, v = sample_positions(first, last, columns, 1, None)
        yield slice(first, last), u, v


def sample_positions(
    first: int, last: int, columns: int, per_axis: int, jitter: np.random.Generator | None
) -> tuple[FloatArray, FloatArray]:
    """Return u, v of the samples of some rows of pixels, (n,) float64: all samples of a pixel follow each other."""
    shape = (last - first, columns, per_axis, per_axis)
    row, column, cell_row, cell_column = np.meshgrid(
        np.arange(first, last, dtype=np.float64),
        np.arange(columns, dtype=np.float64),
        np.arange(per_axis, dtype=np.float64),
        np.arange(per_axis, dtype=np.float64),
        indexing="ij",
    )
    across: FloatArray | float = 0.5 if jitter is None else jitter.random(shape)
    down: FloatArray | float = 0.5 if jitter is None else jitter.random(shape)
    u = column + (cell_column + across) / per_axis - 0.5
    v = row + (cell_row + down) / per_axis - 0.5
    return u.ravel(), v.ravel()


@kernel_part
def _plane_distance(
    origin: FloatArray, direction: FloatArray, face: IntArray, vertices: FloatArray
) -> tuple[float, float, float, float]:
    """Distance along a ray to a triangle's plane, and the plane's normal (not unit). NaN if they are parallel."""
    a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
    e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    f0, f1, f2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
    along = n0 * direction[0] + n1 * direction[1] + n2 * direction[2]
    if along == 0.0:
        return np.nan, n0, n1, n2
    height = n0 * (a[0] - origin[0]) + n1 * (a[1] - origin[1]) + n2 * (a[2] - origin[2])
    return height / along, n0, n1, n2


@kernel(in_every_scan=False)
def _hit_points(
    origins: FloatArray,
    directions: FloatArray,
    triangle: IntArray,
    vertices: FloatArray,
    faces: IntArray,
    corner_normals: NDArray[np.float32],
    part: IntArray,
    spheres: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return (points, normals), both (n, 3) float64, NaN for misses; normals are unit and face the origin.

    origins : (n, 3), or (1, 3) for all rays. The point is the intersection with the triangle's plane, or with the exact
    ball that the triangle approximates.
    """
    count = len(triangle)
    points, normals = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    for i in range(count):
        if triangle[i] < 0:
            continue
        origin, direction, face = origins[min(i, len(origins) - 1)], directions[i], faces[triangle[i]]
        ball = spheres[part[triangle[i]]]
        n = np.zeros(3)
        p = np.zeros(3)
        if ball[3] > 0.0:
            o0, o1, o2 = origin[0] - ball[0], origin[1] - ball[1], origin[2] - ball[2]
            along = o0 * direction[0] + o1 * direction[1] + o2 * direction[2]
            # Distance² from the centre to the ray, without the cancellation of |o|² - along².
            c0 = o0 - along * direction[0]
            c1 = o1 - along * direction[1]
            c2 = o2 - along * direction[2]
            half_chord = np.sqrt(max(ball[3] * ball[3] - (c0 * c0 + c1 * c1 + c2 * c2), 0.0))
            t = -along - half_chord
            if t <= 0.0:
                t = -along + half_chord
            for axis in range(3):
                p[axis] = origin[axis] + t * direction[axis]
                n[axis] = (p[axis] - ball[axis]) / ball[3]
        else:
            t, n0, n1, n2 = _plane_distance(origin, direction, face, vertices)
            if not t > 0.0:
                continue
            for axis in range(3):
                p[axis] = origin[axis] + t * direction[axis]
            # Barycentric weights: areas of the sub-triangles, measured along the plane's normal.
            area2 = n0 * n0 + n1 * n1 + n2 * n2
            for corner in range(3):
                b, c = vertices[face[(corner + 1) % 3]], vertices[face[(corner + 2) % 3]]
                g0, g1, g2 = b[0] - p[0], b[1] - p[1], b[2] - p[2]
                h0, h1, h2 = c[0] - p[0], c[1] - p[1], c[2] - p[2]
                share = (n0 * (g1 * h2 - g2 * h1) + n1 * (g2 * h0 - g0 * h2) + n2 * (g0 * h1 - g1 * h0)) / area2
                for axis in range(3):
                    n[axis] += share * corner_normals[triangle[i], corner, axis]
            length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            if length == 0.0:
                n[0], n[1], n[2], length = n0, n1, n2, np.sqrt(area2)
            for axis in range(3):
                n[axis] /= length
        facing = n[0] * direction[0] + n[1] * direction[1] + n[2] * direction[2]
        sign = -1.0 if facing > 0.0 else 1.0
        for axis in range(3):
            points[i, axis] = p[axis]
            normals[i, axis] = sign * n[axis]
    return points, normals


@kernel(in_every_scan=False)
def _light_points(
    points: FloatArray,
    normals: FloatArray,
    view: FloatArray,
    triangle: IntArray,
    blocker: IntArray,
    towards: FloatArray,
    distance: FloatArray,
    vertices: FloatArray,
    faces: IntArray,
    part: IntArray,
    to_object: FloatArray,
    material: FloatArray,
    colours: FloatArray,
    pigments: FloatArray,
    lamp: FloatArray,
    lens: LensArray,
    rotation: FloatArray,
    translation: FloatArray,
    field: float,
    working_distance: float,
    column: FloatArray,
    row: FloatArray,
    weight: NDArray[np.float32],
    albedo: NDArray[np.float32],
    hue: NDArray[np.float32],
) -> None:
    """Fill column, row, weight, albedo and hue (see `Hits`) for points hit by camera rays `view`."""
    for i in range(len(triangle)):
        if not np.isfinite(points[i, 0]):
            continue
        p, n, light, eye = points[i], normals[i], towards[i], view[i]
        owner = part[triangle[i]]
        m, f = material[owner], to_object[owner]
        darkness = 0.0
        if m[1] > 0.0:
            grain = m[3]
            x = (f[0, 0] * p[0] + f[0, 1] * p[1] + f[0, 2] * p[2] + f[0, 3]) / grain
            y = (f[1, 0] * p[0] + f[1, 1] * p[1] + f[1, 2] * p[2] + f[1, 3]) / grain
            z = (f[2, 0] * p[0] + f[2, 1] * p[1] + f[2, 2] * p[2] + f[2, 3]) / grain
            darkness = texture_value(int(m[1]), x, y, z)
        light_tint, dark_tint = colours[owner, 0], colours[owner, 1]
        # Written so that white gives exactly 1.
        luma = 1.0
        for channel in range(3):
            hue[i, channel] = light_tint[channel] + darkness * (dark_tint[channel] - light_tint[channel])
            luma += LUMA[channel] * (hue[i, channel] - 1.0)
        for channel in range(3):
            hue[i, channel] = hue[i, channel] / luma if luma > 0.0 else 0.0
        albedo[i] = m[0] * (1.0 - m[2] * darkness) * pigments[i] * luma
        cosine = -(n[0] * light[0] + n[1] * light[1] + n[2] * light[2])
        if cosine <= 0.0:
            continue
        if blocker[i] >= 0 and blocker[i] != triangle[i]:
            reach, _n0, _n1, _n2 = _plane_distance(lamp, light, faces[blocker[i]], vertices)
            if reach < distance[i] - SHADOW_BIAS_MM:
                continue
        q0 = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        q1 = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        q2 = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        if q2 <= 0.0:
            continue
        x, y = q0 / q2, q1 / q2
        if x * x + y * y > field * field:
            continue
        xd, yd = distort(x, y, lens)
        column[i] = lens[0] * xd + lens[2]
        row[i] = lens[1] * yd + lens[3]
        strength = albedo[i] * cosine
        if m[4] > 0.0:
            # Mirror direction of the light about the normal, against the direction back to the camera.
            mirrored = 0.0
            for axis in range(3):
                mirrored -= (light[axis] + 2.0 * cosine * n[axis]) * eye[axis]
            if mirrored > 0.0:
                strength += m[4] * mirrored ** m[5]
        weight[i] = strength * (working_distance / distance[i]) ** 2

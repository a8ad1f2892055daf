"""Light that reaches a camera by way of two surfaces: mirrored once, or scattered once between diffuse surfaces.

Mirrored light. A sample of the camera has two kinds of paths in addition to its direct one: camera, mirror, lit
surface; and camera, surface, flat mirror, projector, by which the mirror image of the projector lights the surface.
Curved mirrors are traced in the first way only. Rough mirrors spread the light over the projector's image: to first
order, a tilt of the mirror displaces the path there, and slopes of a Gaussian distribution blur the pattern.

Scattered light. The projector's image is divided into pixels, each of which is a small lamp where it meets a surface.
At a point p the light of all of them is Σ ρ E F, with the albedo ρ, the light E and the form factor F from p of the
patch that the pixel lights: cos cos / (π r²) dA from afar, and Lambert's sum over the edges of the patch nearby. Far
pixels count in blocks of up to 16 × 16, which a point sees as a whole or not at all. Patterns vary along one axis, so
light is kept by columns and by rows.

Light that is scattered twice, or scattered and mirrored, is left out. Light by way of two surfaces has no colour of its
own and no defocus.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from simulated_rig import transport
from simulated_rig.light import NODES_PER_PX, Float32Array, LightTable
from simulated_rig.optics import image_positions, lens_array, vignetting, world_directions
from simulated_rig.scene import SceneSurface
from simulated_rig.transport import SHADOW_BIAS_MM, Hits, RayCaster
from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, IntArray, Pinhole

_OFFSET_MM = 1e-3  # of a ray's start from its surface
_MAX_PLANES = 16  # of mirrors
_FLAT = 1e-4  # of the direction of normals
_SPREADS_PX = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # of patterns by rough mirrors
_SPREAD_MARGIN_PX = 96

_LEVELS = 5  # blocks of 1, 2, 4, 8 and 16 pixels
_COARSE_LEVEL = 3  # blocks of this level and above are kept in bins of 8 pixels
_BIN_PX = 1 << _COARSE_LEVEL
_NEAR = 4.0  # radii of a block: nearer than that it is divided
_COPLANAR = 1e-6  # cosine: a patch in the plane of the point itself gives it no light, nor rounding errors
_NODE_STEP_PX = 2  # of the camera's image, between points with a sum of their own
_SAME_NORMAL = 0.95
_CHUNK = 1024
_VISIBLE_CELL_PX = 8
_TESTED_NODES = 200
_FEW = 1e-3  # share of pairs with something between them: less is rounding at edges


@dataclass(frozen=True, slots=True)
class MirrorPaths:
    """n paths by way of a mirror.

    pixel : (n,) int32, camera pixel, row by row. column_px, row_px, weight : (n,) float32 as in `transport.Hits`, but
    for the whole pixel. column_level, row_level : (n,) float32, spread by roughness, as a position in _SPREADS_PX.
    """

    pixel: NDArray[np.int32]
    column_px: Float32Array
    row_px: Float32Array
    weight: Float32Array
    column_level: Float32Array
    row_level: Float32Array

    def add_to(self, image: Float32Array, table: LightTable) -> None:
        """Add the light of a pattern to (H, W) float32."""
        rough = bool(self.column_level.any() or self.row_level.any())
        columns, rows = (_spread_tables(each, rough=rough) for each in (table.columns, table.rows))
        margin = np.float32(table.margin_px + (_SPREAD_MARGIN_PX if rough else 0))
        _add_mirrored(
            self.pixel,
            self.column_px,
            self.row_px,
            self.weight,
            self.column_level,
            self.row_level,
            columns,
            rows,
            margin,
            image.reshape(-1),
        )


@dataclass(frozen=True, slots=True)
class AxisLight:
    """Light at N points from each projector column (or row) of n, all their pixels white.

    coarse : (N, m) float32, from bins of _BIN_PX columns, m of them; fine : (N, n) sparse, from near columns.
    """

    coarse: Float32Array
    fine: sparse.csr_array

    def of_profile(self, profile: Float32Array) -> Float32Array:
        """(N,) float32: light of a pattern that varies along this axis, (n,) float32."""
        count = self.coarse.shape[1]
        whole = np.pad(profile, (0, count * _BIN_PX - len(profile)), mode="edge").reshape(count, _BIN_PX)
        return np.asarray(self.coarse @ whole.mean(axis=1) + self.fine @ profile, np.float32)


@dataclass(frozen=True, slots=True)
class Interreflection:
    """Scattered light at N points, and those that represent each camera pixel.

    node : (H, W, 4) int32; share : (H, W, 4) float32, 0 where the pixel has none.
    """

    columns: AxisLight
    rows: AxisLight
    node: NDArray[np.int32]
    share: Float32Array

    def irradiance(self, table: LightTable) -> Float32Array:
        """(H, W) float32: light on the surface, of a pattern; 1 is the projector's white at the working distance."""
        column, row = (
            _pixel_means(profile, table.margin_px, axis.fine.shape[1])
            for profile, axis in ((table.columns, self.columns), (table.rows, self.rows))
        )
        whole = self.columns.of_profile(np.ones_like(column))
        # Exact if the pattern varies along one axis only.
        light = self.columns.of_profile(column) * self.rows.of_profile(row)
        light = np.divide(light, whole, out=np.zeros_like(light), where=whole > 0)
        return np.asarray((light[self.node] * self.share).sum(axis=2), np.float32)


@dataclass(frozen=True, slots=True)
class Bounces:
    """All light of one camera that comes by way of two surfaces; None for a kind that the scene does not have."""

    mirrored: MirrorPaths | None
    scattered: Interreflection | None

    def image(self, table: LightTable, albedo: Float32Array) -> Float32Array:
        """Light of a pattern on each pixel, (H, W) float32, before the lens's blur; albedo : (H, W) float32."""
        image = np.zeros(albedo.shape, np.float32)
        if table.peak == 0:
            return image
        if self.scattered is not None:
            image += albedo * self.scattered.irradiance(table)
        if self.mirrored is not None:
            self.mirrored.add_to(image, table)
        return image


def trace_bounces(
    camera: Pinhole,
    projector: Pinhole,
    surface: SceneSurface,
    rays: RayCaster,
    *,
    samples_per_axis: int,
    jitter: bool,
    seed: int,
    working_distance_mm: float,
    fall_off: tuple[float, float] = (0.0, 0.0),
    workers: int,
) -> Bounces | None:
    """Trace the light that comes by way of two surfaces; None if the scene has neither mirrors nor interreflection.

    Samples are those of `transport.trace_paths`.
    """
    has_mirrors = bool((surface.material[:, 6] > 0).any())
    if not has_mirrors and not surface.interreflection:
        return None
    mirrored = scattered = None
    if has_mirrors:
        scene = _MirrorScene(camera, projector, surface, rays, working_distance_mm, fall_off)
        mirrored = _trace_mirrors(scene, samples_per_axis, seed if jitter else None, workers)
    if surface.interreflection:
        senders = _Senders(projector, surface, rays, working_distance_mm, fall_off)
        scattered = _trace_scattered(camera, projector, surface, rays, senders, workers)
    return Bounces(mirrored, scattered)


# Mirrors.


@dataclass(frozen=True, slots=True)
class _Plane:
    """Flat mirror. point_mm, normal : (3,); is_part : (F,) bool, its triangles."""

    point_mm: FloatArray
    normal: FloatArray
    is_part: NDArray[np.bool_]
    share: float
    roughness: float

    def height_mm(self, points: FloatArray) -> FloatArray:
        return np.asarray((points - self.point_mm) @ self.normal, np.float64)


def mirror_planes(surface: SceneSurface) -> list[_Plane]:
    """Return the flat mirrors of a scene, at most the _MAX_PLANES of the largest area."""
    corners = surface.vertices_mm[surface.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    normal = cross / np.maximum(2 * area, 1e-300)[:, None]
    is_flat = (np.einsum("fcx,fx->fc", surface.corner_normals, normal) > 1 - _FLAT**2).all(axis=1)
    candidates = np.flatnonzero(is_flat & (surface.material[surface.part, 6] > 0) & (area > 0))
    planes: list[tuple[float, _Plane]] = []
    while len(candidates) and len(planes) < 4 * _MAX_PLANES:
        first = candidates[np.argmax(area[candidates])]
        along = np.abs((corners[candidates] - corners[first, 0]) @ normal[first]).max(axis=1)
        alike = normal[candidates] @ normal[first] > 1 - _FLAT**2
        own = candidates[alike & (along < _OFFSET_MM) & (surface.part[candidates] == surface.part[first])]
        is_part = np.zeros(len(surface.faces), bool)
        is_part[own] = True
        share, roughness = surface.material[surface.part[first], 6:8]
        plane = _Plane(corners[own].mean(axis=(0, 1)), normal[first], is_part, float(share), float(roughness))
        planes.append((float(area[own].sum()), plane))
        candidates = candidates[~is_part[candidates]]
    planes.sort(key=lambda each: -each[0])
    return [plane for _, plane in planes[:_MAX_PLANES]]


@dataclass(frozen=True, slots=True)
class _MirrorScene:
    camera: Pinhole
    projector: Pinhole
    surface: SceneSurface
    rays: RayCaster
    working_distance_mm: float
    fall_off: tuple[float, float]

    def in_image(self, positions_px: FloatArray, spread_px: FloatArray) -> NDArray[np.bool_]:
        """(n,) bool: positions whose light comes, at least in part, from the projector's image."""
        size, around = self.projector.size, 0.5 + 3 * spread_px
        last = np.array([size.width_px - 1, size.height_px - 1])
        return np.asarray(((positions_px >= -around) & (positions_px <= last + around)).all(axis=1))


_Found = tuple[NDArray[np.intp], FloatArray, FloatArray, FloatArray]
"""Index of the sample, (n,); (column, row), (n, 2); spread of both, (n, 2); weight, (n,)."""


def _trace_mirrors(scene: _MirrorScene, per_axis: int, seed: int | None, workers: int) -> MirrorPaths:
    camera, surface = scene.camera, scene.surface
    rows, columns = camera.size.shape
    count = per_axis**2
    block_rows = max(transport.BLOCK_RAYS // (columns * count), 1)
    planes = mirror_planes(surface)

    def trace(first: int) -> list[tuple[NDArray[np.int32], FloatArray, FloatArray, FloatArray]]:
        last = min(first + block_rows, rows)
        rng = None if seed is None else np.random.default_rng((seed, first))
        u, v = transport.sample_positions(first, last, columns, per_axis, rng)
        hits = transport.trace_rays(
            u, v, camera, scene.projector, surface, scene.rays,
            working_distance_mm=scene.working_distance_mm, footprint_px=1 / per_axis,
        )  # fmt: skip
        found = [_mirrored_surfaces(scene, hits), *(_lit_by_mirror(scene, hits, plane) for plane in planes)]
        out = []
        for index, position, spread, weight in found:
            light = weight * vignetting(position[:, 0], position[:, 1], scene.projector, scene.fall_off) / count
            out.append(((index // count + first * columns).astype(np.int32), position, spread, light))
        return out

    with ThreadPoolExecutor(workers, thread_name_prefix="trace") as pool:
        parts = [each for found in pool.map(trace, range(0, rows, block_rows)) for each in found]
    pixel, position, spread, weight = (np.concatenate(each) for each in zip(*parts, strict=True))
    level = np.where(spread < 1, spread, 1 + np.log2(np.maximum(spread, 1))).clip(max=len(_SPREADS_PX) - 1)
    column, row = np.ascontiguousarray(position.T, np.float32)
    column_level, row_level = np.ascontiguousarray(level.T, np.float32)
    return MirrorPaths(pixel, column, row, weight.astype(np.float32), column_level, row_level)


def _tangents(normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors across each normal, (n, 3) each."""
    axis = np.where(np.abs(normals[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


def _reflect(directions: FloatArray, normals: FloatArray) -> FloatArray:
    return np.asarray(directions - 2 * (directions * normals).sum(axis=1, keepdims=True) * normals)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _spread_px(normals: FloatArray, roughness: FloatArray, tilted: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """(n, 2): standard deviation of (column, row), from the positions that `tilted` gives for tilted normals."""
    spread = np.zeros((len(normals), 2))
    if roughness.any():
        # A tilt much smaller than the roughness, so that the displaced paths meet the same surface.
        small, position = 1e-3, tilted(normals)
        for tangent in _tangents(normals):
            moved = tilted(_unit(normals + small * tangent)) - position
            spread += np.nan_to_num((moved / small * roughness[:, None]) ** 2, nan=1e6)
    return np.sqrt(spread)


def _mirrored_surfaces(scene: _MirrorScene, hits: Hits) -> _Found:
    """Paths camera, mirror, lit surface."""
    surface = scene.surface
    own = surface.part[np.maximum(hits.triangle, 0)]
    share = np.where(hits.is_hit, surface.material[own, 6], 0.0)
    index = np.flatnonzero(share > 0)
    points, normals = hits.points_mm[index], hits.normals[index]
    towards = _unit(points - scene.camera.centre_mm)
    directions = _reflect(towards, normals)
    triangle, mirrored, mirrored_normals = transport.find_points(
        points, directions, surface, scene.rays, starts_mm=points + _OFFSET_MM * normals
    )
    none = np.zeros(len(index))
    pigments = transport.print_reflectance(
        mirrored, mirrored_normals, triangle, none, none, scene.camera, surface, footprint_px=0.0
    )
    lit = transport.light_points(
        mirrored, mirrored_normals, directions, triangle, pigments, scene.projector, surface, scene.rays,
        working_distance_mm=scene.working_distance_mm,
    )  # fmt: skip
    kept = np.flatnonzero((lit.weight > 0) & np.isfinite(lit.column_px))
    index, position = index[kept], np.column_stack([lit.column_px, lit.row_px])[kept]

    def tilted(changed: FloatArray) -> FloatArray:
        moved = _reflect(towards[kept], changed)
        height = ((mirrored[kept] - points[kept]) * mirrored_normals[kept]).sum(axis=1)
        at = points[kept] + moved * (height / (moved * mirrored_normals[kept]).sum(axis=1))[:, None]
        return image_positions(at, scene.projector)

    spread = _spread_px(normals[kept], surface.material[own[index], 7], tilted)
    inside = scene.in_image(position, spread)
    weight = np.asarray(share[index] * lit.weight[kept], np.float64)
    return index[inside], position[inside], spread[inside], weight[inside]


def _lit_by_mirror(scene: _MirrorScene, hits: Hits, plane: _Plane) -> _Found:
    """Paths camera, surface, flat mirror, projector."""
    lamp, projector = scene.projector.centre_mm, scene.projector
    lamp_height = float(plane.height_mm(lamp[None])[0])
    side = np.sign(lamp_height)
    with np.errstate(invalid="ignore"):
        in_front = hits.is_hit & (hits.albedo > 0) & (side * plane.height_mm(hits.points_mm) > SHADOW_BIAS_MM)
    index = np.flatnonzero(in_front)
    points, normals = hits.points_mm[index], hits.normals[index]

    def crossing(lamps: FloatArray) -> FloatArray:
        """Points at which rays from the points to mirror images of the lamp, (n, 3) or (3,), cross the mirror."""
        height, depth = plane.height_mm(points), plane.height_mm(lamps)
        return np.asarray(points + (lamps - points) * (height / (height - depth))[:, None])

    image = lamp - 2 * lamp_height * plane.normal
    to_image = image - points
    distance = np.linalg.norm(to_image, axis=1)
    to_image /= distance[:, None]
    cosine = (normals * to_image).sum(axis=1)
    met = crossing(image)
    position = image_positions(met, projector)

    def tilted(changed: FloatArray) -> FloatArray:
        return image_positions(crossing(met + _reflect(lamp - met, changed)), projector)

    facing = np.broadcast_to(side * plane.normal, points.shape)
    spread = _spread_px(facing, np.full(len(points), plane.roughness), tilted)
    inside = (cosine > 0) & scene.in_image(position, spread)
    inside &= ((met - lamp) @ projector.rotation[2]) > 0
    kept = np.flatnonzero(inside)

    def meets(origins: FloatArray, directions: FloatArray) -> NDArray[np.bool_]:
        triangle = scene.rays.first_hit(origins, directions)
        return (triangle >= 0) & plane.is_part[np.maximum(triangle, 0)]

    kept = kept[meets(points[kept] + _OFFSET_MM * normals[kept], to_image[kept])]
    kept = kept[meets(lamp[None], _unit(met[kept] - lamp))]
    weight = hits.albedo[index[kept]] * cosine[kept] * plane.share
    weight *= (scene.working_distance_mm / distance[kept]) ** 2
    return index[kept], position[kept], spread[kept], weight


def _spread_tables(profile: Float32Array, *, rough: bool) -> Float32Array:
    """(levels, n) float32: a table of light, blurred by each of _SPREADS_PX; its margin grows by _SPREAD_MARGIN_PX."""
    if not rough:
        return profile[None]
    padded = np.pad(profile, _SPREAD_MARGIN_PX * NODES_PER_PX)
    size = 1 << int(len(padded) - 1).bit_length()
    cycles_per_px = np.fft.rfftfreq(size, 1 / NODES_PER_PX)
    response = np.exp(-2 * (np.pi * np.array(_SPREADS_PX)[:, None] * cycles_per_px) ** 2)
    blurred = np.fft.irfft(np.fft.rfft(padded, size) * response, size, axis=1)[:, : len(padded)]
    blurred[0] = padded
    return np.ascontiguousarray(np.maximum(blurred, 0), np.float32)


@kernel_part
def _look_up(tables: Float32Array, level: np.float32, position: np.float32, margin: np.float32) -> np.float32:
    at = (position + margin) * np.float32(NODES_PER_PX)
    if not (at >= 0) or at >= tables.shape[1] - 1:
        return np.float32(0)
    node = int(at)
    part = at - np.float32(node)
    lower = min(int(level), len(tables) - 1)
    light = tables[lower, node] + part * (tables[lower, node + 1] - tables[lower, node])
    share = level - np.float32(lower)
    if share > 0 and lower + 1 < len(tables):
        softer = tables[lower + 1, node] + part * (tables[lower + 1, node + 1] - tables[lower + 1, node])
        light += share * (softer - light)
    return np.float32(light)


@kernel(in_every_scan=False)
def _add_mirrored(
    pixel: NDArray[np.int32],
    column: Float32Array,
    row: Float32Array,
    weight: Float32Array,
    column_level: Float32Array,
    row_level: Float32Array,
    columns: Float32Array,
    rows: Float32Array,
    margin: np.float32,
    out: Float32Array,
) -> None:
    """Add the light of each path to its pixel; columns, rows : (levels, n)."""
    for i in range(len(pixel)):
        light = _look_up(columns, column_level[i], column[i], margin)
        if light > 0:
            out[pixel[i]] += weight[i] * light * _look_up(rows, row_level[i], row[i], margin)


# Interreflection.


class _Senders:
    """Points of the scene lit by the pixels of the projector, as small lamps, and blocks of them.

    Entries of all levels follow each other, level 0 first; level l has (height[l], width[l]) blocks from offset[l] on.
    position : (n, 3) float64, mean by power; facing : (n, 3), mean of the normals; power : (n,), ρ Φ / π, with the
    light Φ that the block receives; reach : (n,), radius about the position. corners : (Hp + 1, Wp + 1, 3), directions
    of the pixels' corners.
    """

    def __init__(
        self,
        projector: Pinhole,
        surface: SceneSurface,
        rays: RayCaster,
        working_distance_mm: float,
        fall_off: tuple[float, float],
    ) -> None:
        rows, columns = projector.size.shape
        lens = lens_array(projector)
        v, u = (each.ravel() - 0.5 for each in np.mgrid[: rows + 1, : columns + 1].astype(np.float64))
        self.lamp = projector.centre_mm
        self.corners = world_directions(u, v, lens, projector.rotation).reshape(rows + 1, columns + 1, 3)
        across, down = self.corners[1:, 1:] - self.corners[:-1, :-1], self.corners[1:, :-1] - self.corners[:-1, 1:]
        solid_angle = np.linalg.norm(np.cross(across, down), axis=2) / 2
        points, normals = np.zeros((rows, columns, 3)), np.zeros((rows, columns, 3))
        power, reach = np.zeros((rows, columns)), np.zeros((rows, columns))
        for block, u, v in transport.pixel_centres(projector):
            hits = transport.trace_rays(
                u, v, projector, projector, surface, rays, working_distance_mm=working_distance_mm, footprint_px=1.0
            )
            shape = power[block].shape
            share = hits.albedo * vignetting(u, v, projector, fall_off) / np.pi
            power[block] = np.where(hits.is_hit, share, 0.0).reshape(shape) * working_distance_mm**2
            points[block] = np.nan_to_num(hits.points_mm).reshape(*shape, 3)
            normals[block] = np.nan_to_num(hits.normals).reshape(*shape, 3)
        power *= solid_angle
        away = points - self.lamp
        distance = np.linalg.norm(away, axis=2)
        cosine = np.abs((away * normals).sum(axis=2)) / np.maximum(distance, 1e-9)
        reach = 0.71 * distance * np.sqrt(solid_angle) / np.maximum(cosine, 0.05)
        whole = 1 << (_LEVELS - 1)
        pad = ((0, -rows % whole), (0, -columns % whole))
        level = (
            np.pad(points, (*pad, (0, 0))),
            np.pad(normals, (*pad, (0, 0))),
            np.pad(power, pad),
            np.pad(reach, pad),
        )
        levels = [level]
        for _ in range(_LEVELS - 1):
            level = _merge(*level)
            levels.append(level)
        self.shapes = np.array([each[2].shape for each in levels])
        self.offset = np.concatenate([[0], np.cumsum(self.shapes.prod(axis=1))])
        self.position, self.facing = (np.concatenate([each[k].reshape(-1, 3) for each in levels]) for k in (0, 1))
        self.power, self.reach = (np.concatenate([each[k].ravel() for each in levels]) for k in (2, 3))
        self.representative = self._representatives(level[0])

    def _representatives(self, means: FloatArray) -> IntArray:
        """Return (blocks,): of each largest block, the index of the lit pixel next to its mean position; -1 if none."""
        high, wide, _ = means.shape
        whole = 1 << (_LEVELS - 1)
        power = self.power[: self.offset[1]].reshape(high, whole, wide, whole).swapaxes(1, 2).reshape(high * wide, -1)
        points = self.position[: self.offset[1]].reshape(high, whole, wide, whole, 3).swapaxes(1, 2)
        apart = np.linalg.norm(points.reshape(high * wide, -1, 3) - means.reshape(-1, 1, 3), axis=2)
        inside = np.argmin(np.where(power > 0, apart, np.inf), axis=1)
        block = np.arange(high * wide)
        row, column = block // wide * whole + inside // whole, block % wide * whole + inside % whole
        return np.where(power.max(axis=1) > 0, row * wide * whole + column, -1).astype(np.int32)


def _merge(
    points: FloatArray, normals: FloatArray, power: FloatArray, reach: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Merge blocks of 2 × 2 into one each."""

    def four(image: FloatArray) -> FloatArray:
        high, wide = image.shape[:2]
        split = image.reshape(high // 2, 2, wide // 2, 2, *image.shape[2:]).swapaxes(1, 2)
        return split.reshape(high // 2, wide // 2, 4, *image.shape[2:])

    weight = four(power)
    total = weight.sum(axis=2)
    share = (weight / np.maximum(total, 1e-300)[:, :, None])[..., None]
    position, facing = (four(points) * share).sum(axis=2), (four(normals) * share).sum(axis=2)
    farthest = np.where(weight > 0, np.linalg.norm(four(points) - position[:, :, None], axis=3) + four(reach), 0.0)
    return position, facing, total, farthest.max(axis=2)


def _trace_scattered(
    camera: Pinhole,
    projector: Pinhole,
    surface: SceneSurface,
    rays: RayCaster,
    senders: _Senders,
    workers: int,
) -> Interreflection:
    nodes, node, share = _receivers(camera, surface, rays)
    points, normals, pixel, part = nodes
    visible, group = _visible_blocks(points, normals, pixel, part, camera, surface, rays, senders)
    rows, columns = projector.size.shape
    high, wide = (int(each) for each in senders.shapes[0])

    def gather(first: int) -> tuple[Float32Array, Float32Array, sparse.csr_array, sparse.csr_array]:
        own = slice(first, first + _CHUNK)
        count = len(points[own])
        coarse = [np.zeros((count, extent // _BIN_PX), np.float32) for extent in (wide, high)]
        fine = [np.zeros((count, extent), np.float32) for extent in (wide, high)]
        _gather(
            points[own], normals[own], senders.position, senders.facing, senders.power, senders.reach,
            senders.offset, senders.shapes, senders.corners, senders.lamp, visible, group[own], *coarse, *fine,
        )  # fmt: skip
        return coarse[0], coarse[1], sparse.csr_array(fine[0][:, :columns]), sparse.csr_array(fine[1][:, :rows])

    with ThreadPoolExecutor(workers, thread_name_prefix="gather") as pool:
        parts = list(pool.map(gather, range(0, len(points), _CHUNK)))
    coarse_columns, coarse_rows, fine_columns, fine_rows = zip(*parts, strict=True)
    return Interreflection(
        AxisLight(np.concatenate(coarse_columns), sparse.csr_array(sparse.vstack(fine_columns))),
        AxisLight(np.concatenate(coarse_rows), sparse.csr_array(sparse.vstack(fine_rows))),
        node,
        share,
    )


def _receivers(
    camera: Pinhole, surface: SceneSurface, rays: RayCaster
) -> tuple[tuple[FloatArray, FloatArray, NDArray[np.intp], IntArray], NDArray[np.int32], Float32Array]:
    """Return the points whose light is summed, and those that represent each pixel.

    First ((N, 3) points, (N, 3) normals, (N,) pixel, (N,) part), then node and share as in `Interreflection`. A pixel
    is interpolated between the points of a coarse grid if all are on the same smooth surface, and else has its own.
    """
    shape = rows, columns = camera.size.shape
    points, normals = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    part = np.full(shape, -1, np.int32)
    for block, u, v in transport.pixel_centres(camera):
        directions = world_directions(u, v, lens_array(camera), camera.rotation)
        triangle, at, facing = transport.find_points(camera.centre_mm[None], directions, surface, rays)
        is_hit = np.isfinite(at[:, 0])
        part[block] = np.where(is_hit, surface.part[np.maximum(triangle, 0)], -1).reshape(part[block].shape)
        points[block], normals[block] = (np.nan_to_num(each).reshape(points[block].shape) for each in (at, facing))
    (upper, lower, down), (left, right, across) = (_grid(extent) for extent in shape)
    corner_share = np.stack(
        [
            np.outer(1 - down, 1 - across),
            np.outer(1 - down, across),
            np.outer(down, 1 - across),
            np.outer(down, across),
        ],
        axis=2,
    ).astype(np.float32)
    corner = np.stack(
        [np.add.outer(r * columns, c) for r in (upper, lower) for c in (left, right)], axis=2
    )  # (H, W, 4), pixel
    apart = points.reshape(-1, 3)[corner] - points[:, :, None]
    height = np.abs((apart * normals[:, :, None]).sum(axis=3))
    alike = part.reshape(-1)[corner] == part[:, :, None]
    alike &= (normals.reshape(-1, 3)[corner] * normals[:, :, None]).sum(axis=3) > _SAME_NORMAL
    alike &= height < 0.3 * np.linalg.norm(apart, axis=3) + 0.01
    is_hit = part >= 0
    interpolated = is_hit & (alike | (corner_share == 0)).all(axis=2)
    needed = np.zeros(rows * columns, bool)
    needed[corner[interpolated][corner_share[interpolated] > 0]] = True
    needed |= (is_hit & ~interpolated).ravel()
    pixel = np.flatnonzero(needed)
    number = np.cumsum(needed) - 1
    own = np.arange(rows * columns).reshape(shape)
    single = np.array([1, 0, 0, 0], np.float32)
    share = np.where(interpolated[:, :, None], corner_share, single * is_hit[:, :, None])
    which = np.where(share > 0, np.where(interpolated[:, :, None], corner, own[:, :, None]), -1)
    node = np.where(which >= 0, number[np.maximum(which, 0)], 0).astype(np.int32)
    nodes = points.reshape(-1, 3)[pixel], normals.reshape(-1, 3)[pixel], pixel, part.ravel()[pixel]
    return nodes, node, share.astype(np.float32)


def _grid(extent: int) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Of each pixel along an axis: the grid's pixel at or before it, the next one, and the fraction between them."""
    at = np.arange(extent)
    before = at // _NODE_STEP_PX * _NODE_STEP_PX
    after = np.minimum(before + _NODE_STEP_PX, extent - 1)
    return before, after, (at - before) / np.maximum(after - before, 1)


def _visible_blocks(
    points: FloatArray,
    normals: FloatArray,
    pixel: NDArray[np.intp],
    part: IntArray,
    camera: Pinhole,
    surface: SceneSurface,
    rays: RayCaster,
    senders: _Senders,
) -> tuple[NDArray[np.bool_], IntArray]:
    """Return which of the largest blocks points see, (groups, blocks) bool, and the group of each point, (N,) int32.

    Points of one part within a small cell of the image see the same blocks. Where nothing is between any, there is one
    group that sees all.
    """
    blocks = np.flatnonzero(senders.representative >= 0)
    everything = np.ones((1, len(senders.representative)), bool)
    lamps = senders.representative[blocks]

    def sees(own: IntArray) -> Iterator[NDArray[np.bool_]]:
        for k in own:
            to = senders.position[lamps] - points[k]
            distance = np.linalg.norm(to, axis=1)
            faces = (to @ normals[k] > 0) & ((to * senders.facing[lamps]).sum(axis=1) < 0)
            clear = np.ones(len(lamps), bool)
            own_start = points[k] + _OFFSET_MM * normals[k]
            facing = np.flatnonzero(faces)
            if len(facing):
                directions = np.ascontiguousarray(to[facing] / distance[facing, None])
                _, met, _ = transport.find_points(own_start[None], directions, surface, rays)
                reach = np.linalg.norm(met - own_start, axis=1)
                clear[facing] = ~(reach < distance[facing] - max(SHADOW_BIAS_MM, 0.001 * float(distance.max())))
            yield clear

    if len(points) == 0 or len(blocks) == 0:
        return everything, np.zeros(len(points), np.int32)
    tested = np.linspace(0, len(points) - 1, min(_TESTED_NODES, len(points))).astype(np.int32)
    if np.mean([~clear for clear in sees(tested)]) < _FEW:
        return everything, np.zeros(len(points), np.int32)
    rows, columns = pixel // camera.size.width_px, pixel % camera.size.width_px
    cells = np.stack([rows // _VISIBLE_CELL_PX, columns // _VISIBLE_CELL_PX, part], axis=1)
    _, first, group = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    visible = np.ones((len(first), everything.shape[1]), bool)
    for number, clear in enumerate(sees(first.astype(np.int32))):
        visible[number, blocks] = clear
    return visible, group.ravel().astype(np.int32)


def _pixel_means(profile: Float32Array, margin_px: int, count: int) -> Float32Array:
    """(count,) float32: mean light of each projector pixel, from a table of light."""
    edges = (np.arange(count + 1) + margin_px - 0.5) * NODES_PER_PX
    total = np.concatenate([[0.0], np.cumsum((profile[1:] + profile[:-1]) / 2, dtype=np.float64)])
    at = np.interp(edges, np.arange(len(profile)), total)
    return np.asarray(np.diff(at) / NODES_PER_PX, np.float32)


@kernel_part
def _patch_form_factor(
    p: FloatArray, n: FloatArray, centre: FloatArray, facing: FloatArray, lamp: FloatArray, corners: FloatArray,
    i: int, j: int, patch: FloatArray, clipped: FloatArray,
) -> float:  # fmt: skip
    """∫ cos cos / r² dA from p to the patch that a projector pixel lights on the plane at `centre`, over its area.

    By Lambert's formula for a polygon, clipped at the horizon of p. -1 if the pixel's corners do not meet the plane.
    """
    height = 0.0
    for axis in range(3):
        height += (centre[axis] - lamp[axis]) * facing[axis]
    for corner in range(4):
        di, dj = corner // 2, (1 if corner == 1 or corner == 2 else 0)
        along = 0.0
        for axis in range(3):
            along += corners[i + di, j + dj, axis] * facing[axis]
        if along * height <= 0.0 or abs(along) < 0.02:
            return -1.0
        for axis in range(3):
            patch[corner, axis] = lamp[axis] + height / along * corners[i + di, j + dj, axis]
    a0, a1, a2 = 0.0, 0.0, 0.0
    for corner in range(2):
        e, f = patch[corner + 1], patch[corner + 2]
        x0, x1, x2 = e[0] - patch[0, 0], e[1] - patch[0, 1], e[2] - patch[0, 2]
        y0, y1, y2 = f[0] - patch[0, 0], f[1] - patch[0, 1], f[2] - patch[0, 2]
        a0 += (x1 * y2 - x2 * y1) / 2.0
        a1 += (x2 * y0 - x0 * y2) / 2.0
        a2 += (x0 * y1 - x1 * y0) / 2.0
    area = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
    count = 0
    for corner in range(4):
        after = (corner + 1) % 4
        here, there = 0.0, 0.0
        for axis in range(3):
            here += (patch[corner, axis] - p[axis]) * n[axis]
            there += (patch[after, axis] - p[axis]) * n[axis]
        if here >= 0.0:
            for axis in range(3):
                clipped[count, axis] = patch[corner, axis] - p[axis]
            count += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            share = here / (here - there)
            for axis in range(3):
                clipped[count, axis] = (
                    patch[corner, axis] + share * (patch[after, axis] - patch[corner, axis]) - p[axis]
                )
            count += 1
    if count < 3 or area == 0.0:
        return 0.0
    total = 0.0
    for corner in range(count):
        e, f = clipped[corner], clipped[(corner + 1) % count]
        x0, x1, x2 = e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]
        cross = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        if cross > 0.0:
            dot = e[0] * f[0] + e[1] * f[1] + e[2] * f[2]
            total += np.arctan2(cross, dot) * (x0 * n[0] + x1 * n[1] + x2 * n[2]) / cross
    return float(abs(total) / 2.0 / area)


@kernel(in_every_scan=False)
def _gather(
    points: FloatArray,
    normals: FloatArray,
    position: FloatArray,
    facing: FloatArray,
    power: FloatArray,
    reach: FloatArray,
    offset: NDArray[np.int64],
    shapes: NDArray[np.int64],
    corners: FloatArray,
    lamp: FloatArray,
    visible: NDArray[np.bool_],
    group: IntArray,
    coarse_columns: Float32Array,
    coarse_rows: Float32Array,
    fine_columns: Float32Array,
    fine_rows: Float32Array,
) -> None:
    """Fill the light at each point, by projector columns and rows. See `_Senders` and `AxisLight`."""
    top = len(shapes) - 1
    stack = np.zeros((4 * len(shapes) + 4, 3), np.int64)
    patch, clipped = np.zeros((4, 3)), np.zeros((8, 3))
    for k in range(len(points)):
        p, n = points[k], normals[k]
        for block in range(shapes[top, 0] * shapes[top, 1]):
            if not visible[group[k], block]:
                continue
            stack[0, 0], stack[0, 1], stack[0, 2] = top, block // shapes[top, 1], block % shapes[top, 1]
            size = 1
            while size > 0:
                size -= 1
                level, i, j = stack[size, 0], stack[size, 1], stack[size, 2]
                at = offset[level] + i * shapes[level, 1] + j
                if power[at] == 0.0:
                    continue
                square, above, before = 0.0, 0.0, 0.0
                for axis in range(3):
                    d = position[at, axis] - p[axis]
                    square += d * d
                    above += d * n[axis]
                    before -= d * facing[at, axis]
                if above < -reach[at]:
                    continue
                is_near = square < (_NEAR * reach[at]) ** 2
                if is_near and level > 0:
                    for child in range(4):
                        stack[size, 0] = level - 1
                        stack[size, 1], stack[size, 2] = 2 * i + child // 2, 2 * j + child % 2
                        size += 1
                    continue
                if before <= _COPLANAR * np.sqrt(square):
                    continue
                light = -1.0
                if is_near:
                    light = _patch_form_factor(p, n, position[at], facing[at], lamp, corners, i, j, patch, clipped)
                if light < 0.0:
                    light = max(above, 0.0) * before / (square * square)
                light *= power[at]
                if light <= 0.0:
                    continue
                if level < _COARSE_LEVEL:
                    side = 1 << level
                    for each in range(side):
                        fine_columns[k, j * side + each] += light / side
                        fine_rows[k, i * side + each] += light / side
                else:
                    side = 1 << (level - _COARSE_LEVEL)
                    for each in range(side):
                        coarse_columns[k, j * side + each] += light / side
                        coarse_rows[k, i * side + each] += light / side

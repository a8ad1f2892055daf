"""Fusion of several views with known poses into one coloured mesh of their mean surface.

The signed distances of the views are averaged on a sparse grid (after Curless and Levoy 1996, "A volumetric method for
building complex models from range images", with exact distances to triangles, weighted by σ). The zero surface of the
mean is extracted, and each vertex is moved along its normal onto the mean surface: the grid determines the topology of
the mesh and not its position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import InvalidInputError, NothingToReconstructError
from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing import (
    component_sizes,
    nearest_on_triangle,
    optimise_edges,
    smooth_boundary,
    used_vertices,
    vertex_normals,
)
from slrig.model import AlbedoMark, FloatArray, IntArray, Mesh, linear_to_srgb, require_array, srgb_to_linear
from slrig.multiview.fusion_grid import (
    BORDER_REACH,
    CELLS,
    Grid,
    StackedViews,
    build_grid,
    corner_positions_mm,
    corners_near_surface,
    nearest_triangles,
    nearest_triangles_to_corners,
    sharpen_edges,
    stack_views,
    vertex_spacing_mm,
)
from slrig.multiview.fusion_mesh import SurfaceNet, extract_net
from slrig.multiview.matching import rotate_vectors, transform_points

AGREEING_SIGMAS = 4.0  # exceeded by noise once in 16 000
_SAME_SIDE = 0.5  # cosine: noise turns a triangle by about 10°, and faces of a box are 90° apart
_MIN_SHARE = 0.01  # of a view's weight, at its border and beyond
_MAX_DIFFERENCES = 200_000
_MIN_DIFFERENCES = 100
_ONE_SIGMA = 68.27  # per cent of a normal distribution
_COLOUR_SAMPLE = 50_000  # points: a twentieth of them is enough for a median to a per cent
_MIN_SHARED = 100  # points that two views have to share to compare their colours
_MIN_LIGHT = 0.01  # of white: below, an sRGB step is more than a tenth of the light

NO_STRIPE = -1  # the stripe of a vertex that several views have found
MIN_CORRELATED_MM = 0.001
"""Least error that neighbouring points share: the position of the projected line is known no better."""
SHARED_MM = 0.002  # error that a good calibration leaves in all views of a rig alike, which no comparison of them shows
_CORNER_REACH = 1.5  # voxels beyond a border: corners of the cells at the views' surface
_COMPARE_REACH = 0.5  # voxels: distance from the surface within which two views are compared
_VERTEX_REACH = 0.5  # voxels: a cell's vertex is nearer to the mean surface
_VOXEL_SPACINGS = 1.25  # voxel over the distance of the views' vertices: hardly less accurate than 1, and much faster
_MIN_VOXEL_SPACINGS = 0.2  # time and memory grow with the inverse square
_MAX_SHARPENING = 0.75  # voxels from a cell's vertex to a sharp edge through the cell
_BORDER_WIDTH = 4.0  # voxels over which a view's weight rises from its border, where it is less accurate
_MAX_EDGE = 3.0  # voxels: vertices of neighbouring cells are at most 2√2 apart
_QUAD_TRIANGLES = np.array([[[0, 1, 3], [1, 2, 3]], [[0, 1, 2], [0, 2, 3]]])
"""Corners of a quadrangle's two triangles, along its second diagonal and along its first."""
_OUTWARD, _FOLDED = 1, 2  # orientation of a triangle
_MIN_TRIANGLES = 20  # of a component: fewer are dust; of a false layer: fewer are folds
_GAP, _VALUE, _WEIGHT, _NOISE, _NX, _NY, _NZ, _B0, _B1, _B2, _BEYOND, _FACE, _VIEW = range(13)
_COLUMNS = 13
_UNMARKED, _UNKNOWN = int(AlbedoMark.NONE), int(AlbedoMark.UNKNOWN)
_LIGHT = srgb_to_linear(np.arange(256, dtype=np.uint8)) / srgb_to_linear(np.array(255, np.uint8))


class PoseErrors(NamedTuple):
    """Uncertainty of the poses of V views.

    covariance : (6 V, 6 V) float64, view by view, of a small rotation (rad) about `middle_mm`, (3,) float64, and a
    shift (mm) of it, in the model's frame.
    """

    covariance: FloatArray
    middle_mm: FloatArray

    @classmethod
    def from_registration(cls, covariance: FloatArray, middle_mm: FloatArray) -> PoseErrors:
        """Errors of views of which the first is fixed. covariance : (6 (V - 1), 6 (V - 1)) float64, of the others."""
        return cls(np.pad(covariance, ((6, 0), (6, 0))), middle_mm)


class FusionSettings(NamedTuple):
    """Error model and borders of the views.

    Standard deviations: correlated_mm, of the error that neighbouring points of one view share, that of its pose
    included; own_mm, the same without the poses; shared_mm, of the error that all views share. border_reach_mm :
    distance beyond a border within which a view counts; full_weight_mm : distance from its border at which it has its
    full weight.
    """

    correlated_mm: float
    own_mm: float
    shared_mm: float
    border_reach_mm: float
    full_weight_mm: float
    poses: PoseErrors


class MeanSurface(NamedTuple):
    """The mean surface at n points.

    value_mm : (n,) float64, the mean signed distance, NaN without a view; normals : (n, 3) float64, unit; sigma_mm :
    (n,) float64; views : (n,) int32, number of views averaged. light : (n, 3) float64, linear, of white, averaged by
    weight; mark : (n,) uint8. The light is that of unmarked vertices if there are any, else of those with a colour; the
    mark is that of the heaviest of them.
    """

    value_mm: FloatArray
    normals: FloatArray
    sigma_mm: FloatArray
    views: IntArray
    light: FloatArray
    mark: NDArray[np.uint8]


def estimate_correlated_error(
    settings: FusionSettings, stack: StackedViews, points_mm: FloatArray, nearest: IntArray, *, within_mm: float
) -> FusionSettings:
    """Estimate `correlated_mm` and `own_mm` from differences of views that the vertices' σ does not explain.

    points_mm : (n, 3) float64; nearest : (V, n) int32, nearest triangle in each view, -1 for none. within_mm : points
    further from a view are ignored. The values in `settings` are lower limits.
    """
    step = max(1, points_mm.shape[0] // _MAX_DIFFERENCES)
    sample = np.arange(0, len(points_mm), step)
    found = in_bands(_view_differences, len(sample), stack, points_mm, nearest, sample, settings, within_mm)
    differences, noise, by_poses = (np.concatenate(each) for each in zip(*found, strict=True))
    if len(differences) < _MIN_DIFFERENCES:
        return settings
    excess = float(np.percentile(np.abs(differences), _ONE_SIGMA)) ** 2 - float(np.median(noise))
    own = excess - float(np.median(by_poses))
    return settings._replace(
        correlated_mm=max(settings.correlated_mm, float(np.sqrt(max(excess, 0.0) / 2))),
        own_mm=max(settings.own_mm, float(np.sqrt(max(own, 0.0) / 2))),
    )


def average_views(
    stack: StackedViews, points_mm: FloatArray, nearest: IntArray, settings: FusionSettings, *, values_only: bool
) -> MeanSurface:
    """Average the views at points; arrays as in `estimate_correlated_error`. values_only : leave other arrays empty."""
    count = len(points_mm)
    others = 0 if values_only else count
    means = MeanSurface(
        np.full(count, np.nan), np.full((others, 3), np.nan), np.full(others, np.nan), np.zeros(others, np.int32),
        np.zeros((others, 3)), np.full(others, AlbedoMark.UNKNOWN, np.uint8),
    )  # fmt: skip
    in_bands(_average, count, stack, points_mm, nearest, settings, means)
    return means


@kernel_part(borrows=True)
def _evaluate_view(stack: Any, face: int, x: float, y: float, z: float, settings: Any, rows: Any, row: int) -> bool:
    """Write the distance of a view's nearest triangle and its attributes into a row. True if the view counts there."""
    points, normals, distances, sigmas = stack.points_mm, stack.normals, stack.border_distance_mm, stack.sigma_mm
    a, b, c = stack.faces[face, 0], stack.faces[face, 1], stack.faces[face, 2]
    gap2, wa, wb, wc = nearest_on_triangle(x, y, z, points, a, b, c)
    dx = x - (wa * points[a, 0] + wb * points[b, 0] + wc * points[c, 0])
    dy = y - (wa * points[a, 1] + wb * points[b, 1] + wc * points[c, 1])
    dz = z - (wa * points[a, 2] + wb * points[b, 2] + wc * points[c, 2])
    nx = wa * normals[a, 0] + wb * normals[b, 0] + wc * normals[c, 0]
    ny = wa * normals[a, 1] + wb * normals[b, 1] + wc * normals[c, 1]
    nz = wa * normals[a, 2] + wb * normals[b, 2] + wc * normals[c, 2]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if not length > 0.0:
        return False
    nx, ny, nz = nx / length, ny / length, nz / length
    along = nx * dx + ny * dy + nz * dz
    inset = wa * distances[a] + wb * distances[b] + wc * distances[c]
    # On an open edge or at the end of one.
    open_edges = stack.open_edges[face]
    at_border = inset == 0.0 and (wa == 0.0) + (wb == 0.0) + (wc == 0.0) == 2
    at_border |= (wa == 0.0 and open_edges & 1) or (wb == 0.0 and open_edges & 2) or (wc == 0.0 and open_edges & 4)
    beyond = np.sqrt(max(gap2 - along * along, 0.0)) if at_border else 0.0
    if beyond > settings.border_reach_mm:
        return False
    sa, sb, sc = wa * sigmas[a], wb * sigmas[b], wc * sigmas[c]
    share = max(min(inset / settings.full_weight_mm, 1.0), _MIN_SHARE)
    rows[row, _GAP] = gap2
    rows[row, _VALUE] = along if at_border else np.copysign(np.sqrt(gap2), along)
    rows[row, _WEIGHT] = share / ((sa + sb + sc) ** 2 + settings.correlated_mm**2)
    rows[row, _NOISE] = sa * sa + sb * sb + sc * sc
    rows[row, _NX], rows[row, _NY], rows[row, _NZ] = nx, ny, nz
    rows[row, _B0], rows[row, _B1], rows[row, _B2] = wa, wb, wc
    rows[row, _BEYOND], rows[row, _FACE] = beyond, face
    return True


@kernel_part(borrows=True)
def _motion_gradient(poses: Any, x: float, y: float, z: float, nx: float, ny: float, nz: float) -> Any:
    """Gradient of the displacement along a normal at a point, by a pose's rotation and shift."""
    x, y, z = x - poses.middle_mm[0], y - poses.middle_mm[1], z - poses.middle_mm[2]
    return y * nz - z * ny, z * nx - x * nz, x * ny - y * nx, nx, ny, nz


@kernel_part(borrows=True)
def _pose_covariance(poses: Any, j: int, k: int, lever: Any) -> float:
    """gᵀ C_jk g, mm²: covariance of two views' displacements of a point along its normal. lever : g."""
    total, begin, covariance = 0.0, 6 * k, poses.covariance
    d, e, f, u, v, w = lever
    for a in range(6):
        row = 6 * j + a
        total += lever[a] * (
            d * covariance[row, begin] + e * covariance[row, begin + 1] + f * covariance[row, begin + 2]
            + u * covariance[row, begin + 3] + v * covariance[row, begin + 4] + w * covariance[row, begin + 5]
        )  # fmt: skip
    return total


@kernel_part(borrows=True)
def _select_views(stack: Any, points: Any, nearest: Any, at: int, settings: Any, rows: Any, order: Any) -> int:
    """Number of views that agree at a point; the first entries of `order` are their rows, sorted by value."""
    count, near = 0, 0
    for view in range(len(nearest)):
        face = nearest[view, at]
        if face >= 0 and _evaluate_view(
            stack, face, points[at, 0], points[at, 1], points[at, 2], settings, rows, count
        ):
            rows[count, _VIEW] = view
            if rows[count, _GAP] < rows[near, _GAP]:
                near = count
            count += 1
    order[0] = 0
    if count < 2:
        return count
    facing, total = 0, 0.0
    for row in range(count):
        cosine = rows[near, _NX] * rows[row, _NX] + rows[near, _NY] * rows[row, _NY] + rows[near, _NZ] * rows[row, _NZ]
        if cosine > _SAME_SIDE:
            place = facing
            while place > 0 and rows[order[place - 1], _VALUE] > rows[row, _VALUE]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = row
            facing += 1
            total += rows[row, _WEIGHT]
    middle, below = 0, rows[order[0], _WEIGHT]
    while below < total / 2 and middle < facing - 1:
        middle += 1
        below += rows[order[middle], _WEIGHT]
    median = order[middle]
    value, noise = rows[median, _VALUE], rows[median, _NOISE] + 2 * settings.correlated_mm**2
    agreeing = 0
    for place in range(facing):
        row = order[place]
        if (rows[row, _VALUE] - value) ** 2 <= AGREEING_SIGMAS**2 * (rows[row, _NOISE] + noise):
            order[agreeing] = row
            agreeing += 1
    return agreeing


@kernel(in_every_scan=False)
def _average(first: int, last: int, stack: Any, points: Any, nearest: Any, settings: Any, means: Any) -> None:
    rows, order = np.zeros((len(nearest), _COLUMNS)), np.zeros(len(nearest), np.int64)
    for at in range(first, last):
        count = _select_views(stack, points, nearest, at, settings, rows, order)
        if count == 0:
            continue
        weight, value, variance, nx, ny, nz, inside = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        for place in range(count):
            row = order[place]
            w = rows[row, _WEIGHT]
            weight += w
            value += w * rows[row, _VALUE]
            variance += w * w * (rows[row, _NOISE] + settings.own_mm**2)
            nx, ny, nz = nx + w * rows[row, _NX], ny + w * rows[row, _NY], nz + w * rows[row, _NZ]
            inside += rows[row, _BEYOND] == 0.0
        means.value_mm[at] = value / weight
        if len(means.views):
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx / length, ny / length, nz / length
            means.normals[at, 0], means.normals[at, 1], means.normals[at, 2] = nx, ny, nz
            lever = _motion_gradient(settings.poses, points[at, 0], points[at, 1], points[at, 2], nx, ny, nz)
            for one in range(count):
                j, w = int(rows[order[one], _VIEW]), rows[order[one], _WEIGHT]
                variance += w * w * _pose_covariance(settings.poses, j, j, lever)
                for other in range(one):
                    k, v = int(rows[order[other], _VIEW]), rows[order[other], _WEIGHT]
                    variance += 2 * w * v * _pose_covariance(settings.poses, j, k, lever)
            means.sigma_mm[at] = np.sqrt(variance / (weight * weight) + settings.shared_mm**2)
            means.views[at] = max(inside, 1)
            _blend_colour(stack, rows, order, count, means.light[at], means.mark, at)


@kernel_part(borrows=True)
def _blend_colour(stack: Any, rows: Any, order: Any, count: int, light: Any, mark: Any, at: int) -> None:
    """Average the light of unmarked vertices by weight; if all are marked, of those with a colour, else of all.

    The mark is that of the heaviest of them.
    """
    total, heaviest, heaviest_mark = 0.0, -1.0, 0
    for allowed in range(3):
        for place in range(count):
            row = order[place]
            for corner in range(3):
                vertex = stack.faces[int(rows[row, _FACE]), corner]
                w = rows[row, _WEIGHT] * rows[row, _B0 + corner]
                vertex_mark = stack.mark[vertex]
                if (allowed == 0 and vertex_mark != _UNMARKED) or (allowed == 1 and vertex_mark == _UNKNOWN):
                    continue
                total += w
                if w > heaviest:
                    heaviest, heaviest_mark = w, vertex_mark
                for channel in range(3):
                    light[channel] += w * _LIGHT[stack.colour[vertex, channel]]
        if total > 0.0:
            break
    mark[at] = heaviest_mark
    for channel in range(3):
        light[channel] /= total


@kernel(in_every_scan=False)
def _view_differences(
    first: int, last: int, stack: Any, points: Any, nearest: Any, sample: Any, settings: Any, within: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences of two views' distances at points away from borders, and the variances of these differences by the
    vertices' σ and by the poses.
    """
    rows = np.zeros((2, _COLUMNS))
    differences, noise, by_poses = np.zeros(last - first), np.zeros(last - first), np.zeros(last - first)
    count = 0
    for place in range(first, last):
        at, known = sample[place], 0
        for step in range(len(nearest)):
            # Start with another view each time, so that all pairs are compared.
            view = (place + step) % len(nearest)
            face = nearest[view, at]
            if face < 0 or not _evaluate_view(
                stack, face, points[at, 0], points[at, 1], points[at, 2], settings, rows, known
            ):
                continue
            rows[known, _VIEW] = view
            if rows[known, _BEYOND] == 0.0 and rows[known, _GAP] < within * within:
                known += 1
            if known == 2:
                break
        if known == 2:
            cosine = rows[0, _NX] * rows[1, _NX] + rows[0, _NY] * rows[1, _NY] + rows[0, _NZ] * rows[1, _NZ]
            if cosine > _SAME_SIDE:
                differences[count] = rows[0, _VALUE] - rows[1, _VALUE]
                noise[count] = rows[0, _NOISE] + rows[1, _NOISE]
                j, k = int(rows[0, _VIEW]), int(rows[1, _VIEW])
                x, y, z = points[at, 0], points[at, 1], points[at, 2]
                lever = _motion_gradient(settings.poses, x, y, z, rows[0, _NX], rows[0, _NY], rows[0, _NZ])
                apart = _pose_covariance(settings.poses, j, j, lever) + _pose_covariance(settings.poses, k, k, lever)
                by_poses[count] = apart - 2 * _pose_covariance(settings.poses, j, k, lever)
                count += 1
    return differences[:count], noise[:count], by_poses[:count]


def equalise_colours(stack: StackedViews, nearest: IntArray) -> FloatArray:
    """Scale the colours of the views to a common brightness in place, and return the gains, (V,), at most 1.

    nearest : (V, n) int32, nearest triangle of each view to points of the surface, -1 for none. Views that share too
    few unmarked points with others keep their brightness.
    """
    faces = nearest[:, :: nearest.shape[1] // _COLOUR_SAMPLE + 1]
    vertex = stack.faces[:, 0][faces]
    light = srgb_to_linear(stack.colour).max(axis=1)[vertex] / srgb_to_linear(np.array([255], np.uint8))
    usable = (faces >= 0) & (stack.mark[vertex] == AlbedoMark.NONE) & (light > _MIN_LIGHT)
    logs = np.log(np.where(usable, light, 1.0))
    count = len(faces)
    rows, sides = [np.zeros((1, count))], [0.0]
    for i in range(count):
        for j in range(i):
            both = usable[i] & usable[j]
            shared = np.count_nonzero(both)
            if shared >= _MIN_SHARED:
                weight = np.sqrt(shared)
                rows.append(weight * (np.eye(count)[i : i + 1] - np.eye(count)[j : j + 1]))
                sides.append(-weight * float(np.median(logs[i, both] - logs[j, both])))
    # The solution of least norm leaves unconnected views alone.
    found = np.linalg.lstsq(np.concatenate(rows), np.array(sides), rcond=None)[0]
    gains = np.exp(found - found.max())
    levels = np.arange(256, dtype=np.uint8)
    for view, gain in enumerate(gains):
        colour = stack.colour[stack.first_vertex[view] : stack.first_vertex[view + 1]]
        colour[:] = linear_to_srgb(gain * srgb_to_linear(levels) / srgb_to_linear(levels[-1:]))[colour]
    return np.asarray(gains)


def concatenate_views(views: Sequence[Mesh], poses: Sequence[FloatArray] | FloatArray) -> Mesh:
    """Concatenate the views at their poses (4, 4) without merging their surfaces."""
    first = np.cumsum([0, *(len(view.vertices_mm) for view in views)])[:-1]
    posed = list(zip(views, poses, strict=True))
    return Mesh(
        vertices_mm=np.concatenate(
            [transform_points(pose, view.vertices_mm).astype(np.float32) for view, pose in posed]
        ),
        faces=np.concatenate([view.faces + np.int32(begin) for view, begin in zip(views, first, strict=True)]),
        normals=np.concatenate([rotate_vectors(pose, view.normals).astype(np.float32) for view, pose in posed]),
        colour=np.concatenate([view.colour for view in views]),
        mark=np.concatenate([view.mark for view in views]),
        sigma_mm=np.concatenate([view.sigma_mm for view in views]),
        stripe=np.concatenate([view.stripe for view in views]),
    )


@dataclass(frozen=True, slots=True)
class FusedModel:
    """A mesh in the model's frame, with stripe -1, and the views that support it.

    views : (V,) int32, number of views averaged at each vertex. voxel_mm : of the grid. correlated_mm : see
    `FusionSettings`.
    """

    mesh: Mesh
    views: IntArray
    voxel_mm: float
    correlated_mm: float

    def __post_init__(self) -> None:
        require_array(self.views, "FusedModel.views", (len(self.mesh.vertices_mm),), "i")


def fuse_views(
    views: Sequence[Mesh],
    poses: Sequence[FloatArray] | FloatArray,
    /,
    *,
    voxel_mm: float | None = None,
    shared_mm: float = SHARED_MM,
    pose_errors: PoseErrors | None = None,
) -> FusedModel:
    """Fuse views into a mesh of their mean surface, where at least one has measured it.

    views : each in a frame of its own. poses : (4, 4) float64 each, X_model = R X_view + t. voxel_mm : side of the
    grid's cells, about the length of the mesh's edges; None is 1.25 times the distance of the views' vertices.
    shared_mm : standard deviation of the error that all views share, which no comparison of them shows. pose_errors :
    uncertainty of the poses, part of the mesh's σ; None for exact poses.

    Raises
    ------
    ValueError
        A pose is not rigid.
    InvalidInputError
        A view is not a manifold, or the voxels are too small for the views or for the memory.
    NothingToReconstructError
        No view has a triangle, or the voxels are larger than the object.
    """
    spacing = vertex_spacing_mm(views)
    voxel = _VOXEL_SPACINGS * spacing if voxel_mm is None else voxel_mm
    least_mm = _MIN_VOXEL_SPACINGS * spacing
    if voxel_mm is not None and not least_mm <= voxel_mm < np.inf:
        message = (
            f"voxel_mm: expected at least {least_mm:.2g}, as the views' vertices are {spacing:.2g} mm apart, found "
            f"{voxel_mm:g}; smaller voxels add no detail"
        )
        raise InvalidInputError(message)
    border = _BORDER_WIDTH * voxel
    stack = stack_views(views, poses, border_limit_mm=border)
    grid = build_grid(stack, voxel)
    if pose_errors is None:
        pose_errors = PoseErrors(np.zeros((6 * len(views), 6 * len(views))), np.zeros(3))
    least = MIN_CORRELATED_MM
    settings = FusionSettings(least, least, shared_mm, _CORNER_REACH * voxel, border, pose_errors)
    settings, rough = _coarse_surface(stack, grid, settings)
    settings = settings._replace(border_reach_mm=BORDER_REACH * voxel)
    reach = _VERTEX_REACH * voxel + AGREEING_SIGMAS * float(np.nanmedian(stack.sigma_mm))
    nearest = nearest_triangles(stack, grid, rough.points_mm, rough.cells, reach_mm=reach)
    equalise_colours(stack, nearest)
    means = average_views(stack, rough.points_mm, nearest, settings, values_only=False)
    del stack, grid, nearest  # as large as all views
    points = rough.points_mm - means.value_mm[:, None] * means.normals
    faces = _triangulate(points, rough.quads, means)
    points = sharpen_edges(points, means.normals, rough.quads, max_step_mm=_MAX_SHARPENING * voxel)
    faces = _clean_mesh(points, faces, voxel)
    if not len(faces):
        message = f"expected a surface, found none with voxels of {voxel:g} mm; use voxels smaller than the object"
        raise NothingToReconstructError(message)
    used = used_vertices(faces, len(points))
    numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
    mesh = Mesh(
        points[used].astype(np.float32), numbers[faces], vertex_normals(points, faces)[used],
        linear_to_srgb(means.light[used]), means.mark[used],
        means.sigma_mm[used].astype(np.float32), np.full(int(used.sum()), NO_STRIPE, dtype=np.int32),
    )  # fmt: skip
    return FusedModel(mesh, means.views[used], voxel, settings.correlated_mm)


def _coarse_surface(stack: StackedViews, grid: Grid, settings: FusionSettings) -> tuple[FusionSettings, SurfaceNet]:
    """The settings with the correlated error estimated, and the surface at the grid's resolution."""
    cells = corners_near_surface(stack, grid)
    corners = corner_positions_mm(grid, cells)
    nearest = nearest_triangles_to_corners(stack, grid, corners, cells)
    within_mm = _COMPARE_REACH * grid.voxel_mm
    settings = estimate_correlated_error(settings, stack, corners, nearest, within_mm=within_mm)
    values = np.full(CELLS * len(grid.keys), np.nan, dtype=np.float32)
    values[cells] = average_views(stack, corners, nearest, settings, values_only=True).value_mm
    return settings, extract_net(grid, values)


def _triangulate(points: FloatArray, quads: IntArray, means: MeanSurface) -> IntArray:
    """(F, 3) int32: two triangles of each quadrangle, along its shorter diagonal, without false ones.

    False triangles are beyond the views, or pass through a jump of the views' distance field and face inwards.
    """
    faces, facing = np.zeros((2 * len(quads), 3), dtype=np.int32), np.zeros(2 * len(quads), dtype=np.uint8)
    in_bands(_split_quads, len(quads), quads, points, means.normals, faces, facing)
    # A few triangles folded over at a sharp edge are not a false layer.
    folded = facing == _FOLDED
    return np.ascontiguousarray(
        faces[(facing == _OUTWARD) | folded & (component_sizes(faces, folded) < _MIN_TRIANGLES)]
    )


@kernel(in_every_scan=False)
def _split_quads(first: int, last: int, quads: Any, points: Any, normals: Any, faces: Any, facing: Any) -> None:
    """Both triangles of each quadrangle and their orientation by the normals of their corners; 0 with a NaN."""
    for quad in range(first, last):
        one, other = 0.0, 0.0
        for axis in range(3):
            one += (points[quads[quad, 0], axis] - points[quads[quad, 2], axis]) ** 2
            other += (points[quads[quad, 1], axis] - points[quads[quad, 3], axis]) ** 2
        for half in range(2):
            face = 2 * quad + half
            for corner in range(3):
                faces[face, corner] = quads[quad, _QUAD_TRIANGLES[int(one <= other), half, corner]]
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
            vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            measured, outward = True, False
            for corner in range(3):
                normal = faces[face, corner]
                along = nx * normals[normal, 0] + ny * normals[normal, 1] + nz * normals[normal, 2]
                measured &= not np.isnan(along)
                outward |= along > 0.0
            facing[face] = 0 if not measured else _OUTWARD if outward else _FOLDED


def _clean_mesh(points: FloatArray, faces: IntArray, voxel_mm: float) -> IntArray:
    """Flip edges to follow the surface, smooth the border, and remove small components."""
    points = np.nan_to_num(points)
    best = optimise_edges(points, faces)
    allowed: NDArray[np.float64] = np.full(len(points), _MAX_EDGE * voxel_mm)
    smooth = smooth_boundary(points, best.faces, allowed, adjacency=best.adjacency)
    faces = optimise_edges(points, smooth.faces, among=smooth.added, adjacency=smooth.adjacency).faces
    sizes = component_sizes(faces, np.ones(len(faces), dtype=np.bool_))
    return np.ascontiguousarray(faces[sizes >= _MIN_TRIANGLES])

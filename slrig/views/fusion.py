"""Fusion of several views with known poses into one mesh of their mean surface, with its colours.

The views' signed distances are averaged on a sparse grid (after Curless and Levoy 1996, "A volumetric method for
building complex models from range images", with exact distances to triangles and σ as weight), the surface where the
mean is zero is netted, and each vertex moved onto the mean surface along its normal: the grid decides how the mesh
hangs together, and not where it lies.
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
from slrig.views.fusion_grid import (
    SEEN_BEYOND,
    Grid,
    Sheets,
    corners_mm,
    grid_about,
    nearest_to_corners,
    nearest_within,
    sampling_mm,
    sharpened,
    sheets,
    wanted_corners,
)
from slrig.views.fusion_mesh import Net, net
from slrig.views.matching import moved, turned

AGREEING_SIGMAS = 4.0  # one honest difference in 16 000 is beyond
_SAME_SIDE = 0.5  # cosine: noise turns a triangle by some 10°, and faces of a box are 90° apart
_LEAST_SHARE = 0.01  # at a view's border, and beyond
_SAMPLED = 200_000  # points whose differences are looked at
_FEWEST_DIFFERENCES = 100
_ONE_SIGMA = 68.27  # per cent of a normal distribution
_GAP, _VALUE, _WEIGHT, _NOISE, _NX, _NY, _NZ, _B0, _B1, _B2, _BEYOND, _FACE, _VIEW = range(13)
_COLUMNS = 13
_CLEAN, _UNKNOWN = int(AlbedoMark.NONE), int(AlbedoMark.UNKNOWN)
_LIGHT = srgb_to_linear(np.arange(256, dtype=np.uint8)) / srgb_to_linear(np.array(255, np.uint8))


class PoseErrors(NamedTuple):
    """How well the poses of V views are known.

    covariance : (6 V, 6 V) float64, C above, view by view of a small turn (rad) about `middle_mm` and a shift (mm) of
    it, in the model's frame. middle_mm : (3,) float64, m above.
    """

    covariance: FloatArray
    middle_mm: FloatArray


def exact_poses(views: int) -> PoseErrors:
    """Of poses without an error."""
    return PoseErrors(np.zeros((6 * views, 6 * views)), np.zeros(3))


def registered_poses(covariance: FloatArray, middle_mm: FloatArray) -> PoseErrors:
    """Of views of which the first stands still. covariance : (6 (V - 1), 6 (V - 1)) float64, of the others."""
    return PoseErrors(np.pad(covariance, ((6, 0), (6, 0))), middle_mm)


class Rule(NamedTuple):
    """correlated_mm : c above; own_mm : d; shared_mm : f. beyond_mm : how far beyond a border a view still counts;
    inset_mm : how far from its border a view has its full weight.
    """

    correlated_mm: float
    own_mm: float
    shared_mm: float
    beyond_mm: float
    inset_mm: float
    poses: PoseErrors


class Means(NamedTuple):
    """At n points. value_mm : (n,) float64, the mean signed distance, NaN where no view counts.

    normals : (n, 3) float64, unit; sigma_mm : (n,) float64; views : (n,) int32, how many counted.
    light : (n, 3) float64, linear, of white, by the views' weights; mark : (n,) uint8. Vertices with a mark are left
    out of the light where there is one without, and those without a colour where there is another; the mark is that
    of the heaviest that is left.
    """

    value_mm: FloatArray
    normals: FloatArray
    sigma_mm: FloatArray
    views: IntArray
    light: FloatArray
    mark: NDArray[np.uint8]


def with_correlated(rule: Rule, sheets: Sheets, points_mm: FloatArray, nearest: IntArray, *, within_mm: float) -> Rule:
    """The rule with c and d as two views' differences tell them: the part that their vertices' noise does not explain,
    shared between them, and what is left of it without the poses.

    points_mm : (n, 3) float64; nearest : (V, n) int32, the views' nearest triangles, -1 for none. within_mm : points
    further from a view tell nothing of it. The least that is said is what the rule has.
    """
    step = max(1, points_mm.shape[0] // _SAMPLED)
    places = np.arange(0, len(points_mm), step)
    found = in_bands(_differences, len(places), sheets, points_mm, nearest, places, rule, within_mm)
    differences, noise, by_poses = (np.concatenate(each) for each in zip(*found, strict=True))
    if len(differences) < _FEWEST_DIFFERENCES:
        return rule
    excess = float(np.percentile(np.abs(differences), _ONE_SIGMA)) ** 2 - float(np.median(noise))
    own = excess - float(np.median(by_poses))
    return rule._replace(
        correlated_mm=max(rule.correlated_mm, float(np.sqrt(max(excess, 0.0) / 2))),
        own_mm=max(rule.own_mm, float(np.sqrt(max(own, 0.0) / 2))),
    )


def mean_values(sheets: Sheets, points_mm: FloatArray, nearest: IntArray, rule: Rule, *, values_only: bool) -> Means:
    """The mean surface as seen from points; arrays as above. values_only : the other arrays are left empty."""
    count = len(points_mm)
    others = 0 if values_only else count
    means = Means(
        np.full(count, np.nan), np.full((others, 3), np.nan), np.full(others, np.nan), np.zeros(others, np.int32),
        np.zeros((others, 3)), np.full(others, AlbedoMark.UNKNOWN, np.uint8),
    )  # fmt: skip
    in_bands(_means, count, sheets, points_mm, nearest, rule, means)
    return means


@kernel_part(borrows=True)
def _view_at(sheets: Any, face: int, x: float, y: float, z: float, rule: Any, rows: Any, row: int) -> bool:
    """What a view's nearest triangle says of a point, into a row; whether it counts there."""
    points, normals, insets, sigmas = sheets.points_mm, sheets.normals, sheets.inset_mm, sheets.sigma_mm
    a, b, c = sheets.faces[face, 0], sheets.faces[face, 1], sheets.faces[face, 2]
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
    inset = wa * insets[a] + wb * insets[b] + wc * insets[c]
    # On an open edge, or in a vertex at the end of one.
    open_edges = sheets.open_edges[face]
    at_border = inset == 0.0 and (wa == 0.0) + (wb == 0.0) + (wc == 0.0) == 2
    at_border |= (wa == 0.0 and open_edges & 1) or (wb == 0.0 and open_edges & 2) or (wc == 0.0 and open_edges & 4)
    beyond = np.sqrt(max(gap2 - along * along, 0.0)) if at_border else 0.0
    if beyond > rule.beyond_mm:
        return False
    sa, sb, sc = wa * sigmas[a], wb * sigmas[b], wc * sigmas[c]
    share = max(min(inset / rule.inset_mm, 1.0), _LEAST_SHARE)
    rows[row, _GAP] = gap2
    rows[row, _VALUE] = along if at_border else np.copysign(np.sqrt(gap2), along)
    rows[row, _WEIGHT] = share / ((sa + sb + sc) ** 2 + rule.correlated_mm**2)
    rows[row, _NOISE] = sa * sa + sb * sb + sc * sc
    rows[row, _NX], rows[row, _NY], rows[row, _NZ] = nx, ny, nz
    rows[row, _B0], rows[row, _B1], rows[row, _B2] = wa, wb, wc
    rows[row, _BEYOND], rows[row, _FACE] = beyond, face
    return True


@kernel_part(borrows=True)
def _lever(poses: Any, x: float, y: float, z: float, nx: float, ny: float, nz: float) -> Any:
    """What g is at a point, along a normal."""
    x, y, z = x - poses.middle_mm[0], y - poses.middle_mm[1], z - poses.middle_mm[2]
    return y * nz - z * ny, z * nx - x * nz, x * ny - y * nx, nx, ny, nz


@kernel_part(borrows=True)
def _pose_covariance(poses: Any, j: int, k: int, lever: Any) -> float:
    """gᵀ C_jk g : of where two views' poses put the surface at a point, along its normal, mm²."""
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
def _counting(sheets: Any, points: Any, nearest: Any, at: int, rule: Any, rows: Any, order: Any) -> int:
    """How many views count at a point; `order` begins with their rows, by their values."""
    count, near = 0, 0
    for view in range(len(nearest)):
        face = nearest[view, at]
        if face >= 0 and _view_at(sheets, face, points[at, 0], points[at, 1], points[at, 2], rule, rows, count):
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
    value, noise = rows[median, _VALUE], rows[median, _NOISE] + 2 * rule.correlated_mm**2
    agreeing = 0
    for place in range(facing):
        row = order[place]
        if (rows[row, _VALUE] - value) ** 2 <= AGREEING_SIGMAS**2 * (rows[row, _NOISE] + noise):
            order[agreeing] = row
            agreeing += 1
    return agreeing


@kernel(in_every_scan=False)
def _means(first: int, last: int, sheets: Any, points: Any, nearest: Any, rule: Any, means: Any) -> None:
    rows, order = np.zeros((len(nearest), _COLUMNS)), np.zeros(len(nearest), np.int64)
    for at in range(first, last):
        count = _counting(sheets, points, nearest, at, rule, rows, order)
        if count == 0:
            continue
        weight, value, variance, nx, ny, nz, inside = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        for place in range(count):
            row = order[place]
            w = rows[row, _WEIGHT]
            weight += w
            value += w * rows[row, _VALUE]
            variance += w * w * (rows[row, _NOISE] + rule.own_mm**2)
            nx, ny, nz = nx + w * rows[row, _NX], ny + w * rows[row, _NY], nz + w * rows[row, _NZ]
            inside += rows[row, _BEYOND] == 0.0
        means.value_mm[at] = value / weight
        if len(means.views):
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx / length, ny / length, nz / length
            means.normals[at, 0], means.normals[at, 1], means.normals[at, 2] = nx, ny, nz
            lever = _lever(rule.poses, points[at, 0], points[at, 1], points[at, 2], nx, ny, nz)
            for one in range(count):
                j, w = int(rows[order[one], _VIEW]), rows[order[one], _WEIGHT]
                variance += w * w * _pose_covariance(rule.poses, j, j, lever)
                for other in range(one):
                    k, v = int(rows[order[other], _VIEW]), rows[order[other], _WEIGHT]
                    variance += 2 * w * v * _pose_covariance(rule.poses, j, k, lever)
            means.sigma_mm[at] = np.sqrt(variance / (weight * weight) + rule.shared_mm**2)
            means.views[at] = max(inside, 1)
            _blend(sheets, rows, order, count, means.light[at], means.mark, at)


@kernel_part(borrows=True)
def _blend(sheets: Any, rows: Any, order: Any, count: int, light: Any, mark: Any, at: int) -> None:
    """Light by weight, of the vertices without a mark; where all have one, of those with a colour, else of all.

    The mark is that of the heaviest that counts.
    """
    total, heaviest, worst = 0.0, -1.0, 0
    for allowed in range(3):
        for place in range(count):
            row = order[place]
            for corner in range(3):
                vertex = sheets.faces[int(rows[row, _FACE]), corner]
                w = rows[row, _WEIGHT] * rows[row, _B0 + corner]
                because = sheets.mark[vertex]
                if (allowed == 0 and because != _CLEAN) or (allowed == 1 and because == _UNKNOWN):
                    continue
                total += w
                if w > heaviest:
                    heaviest, worst = w, because
                for channel in range(3):
                    light[channel] += w * _LIGHT[sheets.colour[vertex, channel]]
        if total > 0.0:
            break
    mark[at] = worst
    for channel in range(3):
        light[channel] /= total


@kernel(in_every_scan=False)
def _differences(
    first: int, last: int, sheets: Any, points: Any, nearest: Any, places: Any, rule: Any, within: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences of two views' values at points that neither has a border near, and their variances: of the noise, and
    by the poses.
    """
    rows = np.zeros((2, _COLUMNS))
    differences, noise, by_poses = np.zeros(last - first), np.zeros(last - first), np.zeros(last - first)
    count = 0
    for place in range(first, last):
        at, known = places[place], 0
        for step in range(len(nearest)):
            # Another view begins each time, so that all pairs have their turn.
            view = (place + step) % len(nearest)
            face = nearest[view, at]
            if face < 0 or not _view_at(sheets, face, points[at, 0], points[at, 1], points[at, 2], rule, rows, known):
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
                lever = _lever(rule.poses, x, y, z, rows[0, _NX], rows[0, _NY], rows[0, _NZ])
                apart = _pose_covariance(rule.poses, j, j, lever) + _pose_covariance(rule.poses, k, k, lever)
                by_poses[count] = apart - 2 * _pose_covariance(rule.poses, j, k, lever)
                count += 1
    return differences[:count], noise[:count], by_poses[:count]


_SAMPLED_VERTICES = 50_000  # places: of a twentieth of them a median is known to a per cent
_FEWEST_SHARED = 100  # places of two views: fewer tell nothing
_DARKEST = 0.01  # of white: an sRGB step is then a tenth of the light


def to_one_scale(sheets: Sheets, nearest: IntArray) -> FloatArray:
    """Bring the colours of the views to one scale, where they are, and return the gains, (V,), at most 1.

    nearest : (V, n) int32, the views' nearest triangles to points of the surface, -1 for none. A view that shares too
    little without a mark keeps its own.
    """
    places = nearest[:, :: nearest.shape[1] // _SAMPLED_VERTICES + 1]
    vertex = sheets.faces[:, 0][places]
    light = srgb_to_linear(sheets.colour).max(axis=1)[vertex] / srgb_to_linear(np.array([255], np.uint8))
    sound = (places >= 0) & (sheets.mark[vertex] == AlbedoMark.NONE) & (light > _DARKEST)
    logs = np.log(np.where(sound, light, 1.0))
    count = len(places)
    rows, sides = [np.zeros((1, count))], [0.0]
    for i in range(count):
        for j in range(i):
            both = sound[i] & sound[j]
            shared = np.count_nonzero(both)
            if shared >= _FEWEST_SHARED:
                weight = np.sqrt(shared)
                rows.append(weight * (np.eye(count)[i : i + 1] - np.eye(count)[j : j + 1]))
                sides.append(-weight * float(np.median(logs[i, both] - logs[j, both])))
    # The shortest of all solutions: views that nothing joins have no gain.
    found = np.linalg.lstsq(np.concatenate(rows), np.array(sides), rcond=None)[0]
    gains = np.exp(found - found.max())
    levels = np.arange(256, dtype=np.uint8)
    for view, gain in enumerate(gains):
        mine = sheets.colour[sheets.first_vertex[view] : sheets.first_vertex[view + 1]]
        mine[:] = linear_to_srgb(gain * srgb_to_linear(levels) / srgb_to_linear(levels[-1:]))[mine]
    return np.asarray(gains)


def put_together(views: Sequence[Mesh], poses: Sequence[FloatArray] | FloatArray) -> Mesh:
    """All views where their poses (4, 4) take them, one after another: nothing is merged, and surfaces lie double."""
    first = np.cumsum([0, *(len(view.vertices_mm) for view in views)])[:-1]
    return Mesh(
        vertices_mm=np.concatenate(
            [moved(pose, view.vertices_mm).astype(np.float32) for view, pose in zip(views, poses, strict=True)]
        ),
        faces=np.concatenate([view.faces + np.int32(begin) for view, begin in zip(views, first, strict=True)]),
        normals=np.concatenate(
            [turned(pose, view.normals).astype(np.float32) for view, pose in zip(views, poses, strict=True)]
        ),
        colour=np.concatenate([view.colour for view in views]),
        mark=np.concatenate([view.mark for view in views]),
        sigma_mm=np.concatenate([view.sigma_mm for view in views]),
        stripe=np.concatenate([view.stripe for view in views]),
    )


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
        require_array(self.views, "FusedModel.views", (len(self.mesh.vertices_mm),), "i")


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
        linear_to_srgb(means.light[used]), means.mark[used],
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

"""The mean surface of several views: signed distances to their nearest points, weighted by 1/σ², where they agree.

At a point x each view has a nearest point q on its triangles, with normal n (of its corners, by their weights). The
distance is |x - q|, positive where n . (x - q) is. Beyond the view's open border, up to a limit, it is n . (x - q): the
tangent plane goes on, with little weight. Of these views count, first, those that face as the nearest one does: the
far side of a thin wall is another surface, and must not cancel the near one. Second, of those, the ones that agree
with their weighted median within k σ of the difference: where views contradict each other the heavier side is right,
everywhere alike, instead of the one that happens to be nearer, which would add a third surface in between.

σ² = Σ w² (s² + d²) / (Σ w)² + p² + f², w = share / (σ² + c²) : s² is the noise of a point between three vertices,
Σ b² σ² with their weights b. c is the error that neighbouring points of one view have in common, poses included: it is
found from what is left of the views' differences when their noise is taken away. d is c without the poses' part of it.
p² = Σ w_j w_k gᵀ C_jk g / (Σ w)² is what the poses' own covariance C makes of the mean: views beside each other err
alike, which their differences do not show; g = ((x - m) × n, n). f is what all views have in common.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.meshing import nearest_on_triangle
from slrig.model import AlbedoMark, FloatArray, IntArray
from slrig.model.srgb import light_of
from slrig.views.fusion_sheets import Sheets

AGREEING_SIGMAS = 4.0  # one honest difference in 16 000 is beyond
_SAME_SIDE = 0.5  # cosine: noise turns a triangle by some 10°, and faces of a box are 90° apart
_LEAST_SHARE = 0.01  # at a view's border, and beyond
_SAMPLED = 200_000  # points whose differences are looked at
_FEWEST_DIFFERENCES = 100
_ONE_SIGMA = 68.27  # per cent of a normal distribution
_GAP, _VALUE, _WEIGHT, _NOISE, _NX, _NY, _NZ, _B0, _B1, _B2, _BEYOND, _FACE, _VIEW = range(13)
_COLUMNS = 13
_CLEAN, _UNKNOWN = int(AlbedoMark.NONE), int(AlbedoMark.UNKNOWN)
_LIGHT = light_of(np.arange(256, dtype=np.uint8)) / light_of(np.array(255, np.uint8))


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

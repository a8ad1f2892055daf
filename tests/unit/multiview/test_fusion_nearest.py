"""The nearest triangles about a sparse grid, and the mean of distances to them, against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing.quality import SearchTree
from slrig.model import FloatArray
from slrig.multiview.fusion import AGREEING_SIGMAS, FusionSettings, PoseErrors, average_views
from slrig.multiview.fusion_grid import (
    StackedViews,
    build_grid,
    corner_positions_mm,
    corners_near_surface,
    nearest_triangles,
    nearest_triangles_to_corners,
    stack_views,
)
from tests.unit.multiview.known_views import around, plate_on_box, views_of

# Only models of several views need these kernels.
pytestmark = pytest.mark.slow
VOXEL_MM = 1.1
VIEWS = 4
_ROOT = np.random.default_rng(3).normal(size=(6 * VIEWS, 6 * VIEWS)) * np.tile([1e-4] * 3 + [1e-3] * 3, VIEWS)[:, None]
POSES = PoseErrors(_ROOT @ _ROOT.T, np.array([1.0, -2.0, 0.5]))
RULE = FusionSettings(
    correlated_mm=0.01, own_mm=0.006, shared_mm=0.002, border_reach_mm=0.6, full_weight_mm=4.0, poses=POSES
)


@pytest.fixture(scope="module")
def stack() -> StackedViews:
    views = views_of(plate_on_box(), around(VIEWS), 0.9)
    return stack_views(
        [view.mesh for view in views], [view.pose for view in views], border_limit_mm=RULE.full_weight_mm
    )


def plain_nearest(point: FloatArray, triangle: FloatArray) -> tuple[float, FloatArray]:
    """Distance to a triangle and the weights of its corners there: the best of its plane, its sides and its corners."""
    found = [(float(np.linalg.norm(point - triangle[k])), np.eye(3)[k]) for k in range(3)]
    for free in ((0, 1, 2), (0, 1), (1, 2), (0, 2)):
        basis = (triangle[list(free[1:])] - triangle[free[0]]).T
        part = np.linalg.lstsq(basis, point - triangle[free[0]], rcond=None)[0]
        weights = np.zeros(3)
        weights[list(free)] = [1 - part.sum(), *part]
        if (weights >= 0).all():
            found.append((float(np.linalg.norm(point - weights @ triangle)), weights))
    return min(found, key=lambda each: each[0])


def plain_value(stack: StackedViews, point: FloatArray, nearest: list[int]) -> tuple[float, float, int]:
    """Mean value, σ and number of views."""
    rows = []
    for view, face in ((view, face) for view, face in enumerate(nearest) if face >= 0):
        corners = stack.faces[face]
        gap, weights = plain_nearest(point, stack.points_mm[corners])
        normal = weights @ stack.normals[corners].astype(float)
        normal /= np.linalg.norm(normal)
        offset = point - weights @ stack.points_mm[corners]
        inset = weights @ stack.border_distance_mm[corners].astype(float)
        zero = weights == 0
        border = any(zero[k] and stack.open_edges[face] >> k & 1 for k in range(3)) or (zero.sum() == 2 and inset == 0)
        along = float(normal @ offset)
        beyond = np.sqrt(max(gap**2 - along**2, 0)) if border else 0.0
        if beyond <= RULE.border_reach_mm:
            sigma = weights * stack.sigma_mm[corners]
            share = max(min(inset / RULE.full_weight_mm, 1), 0.01)
            w = share / (sigma.sum() ** 2 + RULE.correlated_mm**2)
            value = along if border else np.copysign(gap, along)
            rows.append((value, gap, w, (sigma**2).sum(), normal, beyond, view))
    if not rows:
        return np.nan, np.nan, 0
    first = min(rows, key=lambda row: row[1])
    rows = sorted((row for row in rows if row[4] @ first[4] > 0.5), key=lambda row: row[0])
    sums = np.cumsum([row[2] for row in rows])
    middle = rows[int(np.searchsorted(sums, sums[-1] / 2))]
    common = 2 * RULE.correlated_mm**2
    rows = [row for row in rows if abs(row[0] - middle[0]) <= AGREEING_SIGMAS * np.sqrt(row[3] + middle[3] + common)]
    w = np.array([row[2] for row in rows])
    variance = (w**2 * [row[3] + RULE.own_mm**2 for row in rows]).sum() / w.sum() ** 2 + RULE.shared_mm**2
    mean = np.sum([each * row[4] for each, row in zip(w, rows, strict=True)], axis=0)
    mean /= np.linalg.norm(mean)
    moves = np.zeros(6 * VIEWS)  # gradient of the mean's displacement along its normal
    for each, row in zip(w / w.sum(), rows, strict=True):
        moves[6 * row[6] : 6 * row[6] + 6] = each * np.append(np.cross(point - POSES.middle_mm, mean), mean)
    variance += moves @ POSES.covariance @ moves
    value = float((w * [row[0] for row in rows]).sum() / w.sum())
    return value, float(np.sqrt(variance)), max(1, sum(row[5] == 0 for row in rows))


def distances(stack: StackedViews, view: int, points: FloatArray) -> FloatArray:
    faces = stack.faces[stack.first_face[view] : stack.first_face[view + 1]]
    return SearchTree.build(stack.points_mm, faces).distances_mm(points)


def stated_distances(stack: StackedViews, points: FloatArray, nearest: np.ndarray) -> FloatArray:
    """Distance to the stated nearest triangle, infinite for none."""
    return np.array(
        [
            plain_nearest(point, stack.points_mm[stack.faces[face]])[0] if face >= 0 else np.inf
            for point, face in zip(points, nearest, strict=True)
        ]
    )


def test_nearest_triangles_equal_those_of_the_search_tree(stack: StackedViews) -> None:
    grid = build_grid(stack, VOXEL_MM)
    cells = corners_near_surface(stack, grid)
    corners = corner_positions_mm(grid, cells)
    nearest = nearest_triangles_to_corners(stack, grid, corners, cells)
    random = np.random.default_rng(0)
    inside = corners + VOXEL_MM * random.uniform(0, 1, corners.shape)
    within = nearest_triangles(stack, grid, inside, cells, reach_mm=VOXEL_MM)
    some = random.choice(len(cells), 400, replace=False)
    for view in range(len(nearest)):
        true = distances(stack, view, corners[some])
        near = true < 0.86 * VOXEL_MM
        assert near.sum() > 50
        got = stated_distances(stack, corners[some], nearest[view, some])
        assert got[near] == pytest.approx(true[near], abs=1e-9)
        # Further off it is any of those around, and never nearer than the nearest.
        assert (got[~near] >= true[~near] - 1e-9).all()
        true, got = distances(stack, view, inside[some]), stated_distances(stack, inside[some], within[view, some])
        assert got == pytest.approx(np.where(true < VOXEL_MM, true, np.inf), abs=1e-9)


def test_every_cell_that_a_triangle_passes_through_has_all_corners(stack: StackedViews) -> None:
    grid = build_grid(stack, VOXEL_MM)
    cells = corners_near_surface(stack, grid)
    nearest = nearest_triangles_to_corners(stack, grid, corner_positions_mm(grid, cells), cells)
    random = np.random.default_rng(1)
    weights = random.dirichlet(np.ones(3), len(stack.faces))
    steps = np.floor(
        (np.einsum("fk,fkd->fd", weights, stack.points_mm[stack.faces]) - grid.origin_mm) / VOXEL_MM
    ) + np.argwhere(np.ones((2, 2, 2))).reshape(8, 1, 3)
    place = {
        tuple(step): at
        for at, step in enumerate(
            np.rint((corner_positions_mm(grid, cells) - grid.origin_mm) / VOXEL_MM).astype(int).tolist()
        )
    }
    for view in range(len(nearest)):
        for face in range(stack.first_face[view], stack.first_face[view + 1]):
            assert all(nearest[view, place[tuple(steps[corner, face].astype(int))]] >= 0 for corner in range(8))


def test_the_mean_equals_that_by_plain_numpy(stack: StackedViews) -> None:
    grid = build_grid(stack, VOXEL_MM)
    cells = corners_near_surface(stack, grid)
    corners = corner_positions_mm(grid, cells)
    nearest = nearest_triangles_to_corners(stack, grid, corners, cells)
    means = average_views(stack, corners, nearest, RULE, values_only=False)
    some = np.random.default_rng(2).choice(len(cells), 500, replace=False)
    expected = [plain_value(stack, corners[at], nearest[:, at].tolist()) for at in some]
    value, sigma, views = (np.array(each) for each in zip(*expected, strict=True))
    assert 5 < np.isnan(value).sum() < 400
    assert (views > 1).sum() > 50
    np.testing.assert_allclose(means.value_mm[some], value, atol=1e-9)
    np.testing.assert_allclose(means.sigma_mm[some], sigma, atol=1e-9)
    assert means.views[some].tolist() == views.tolist()

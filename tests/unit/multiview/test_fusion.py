"""Views of surfaces that are known, fused: error, what is open and closed, σ, colour, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.errors import InvalidInputError, NothingToReconstructError
from slrig.meshing.quality import SearchTree
from slrig.meshing.topology import topology_counts
from slrig.model import AlbedoMark, FloatArray, Mesh
from slrig.model.surface import linear_to_srgb, srgb_to_linear
from slrig.multiview.fusion import (
    _FOLDED,
    _OUTWARD,
    FusedModel,
    FusionSettings,
    PoseErrors,
    _split_quads,
    average_views,
    fuse_views,
)
from slrig.multiview.fusion_grid import stack_views
from tests.unit.meshing.plain import grid_faces, mesh_of
from tests.unit.multiview.known_views import Noise, View, around, star, views_of

# Only models of several views need these kernels.
pytestmark = pytest.mark.slow

QUIET = Noise(sigma_mm=0.001, slow_mm=0.0)


def model_of(views: list[View], *, voxel_mm: float | None = None) -> FusedModel:
    return fuse_views([view.mesh for view in views], [view.pose for view in views], voxel_mm=voxel_mm)


def sheet(
    height_mm: float,
    *,
    half_mm: float = 4.0,
    down: bool = False,
    colour: int = 100,
    mark: int = 0,
    sigma_mm: float = 0.01,
) -> Mesh:
    """A square at z = height, seen from above or below."""
    side = np.arange(-half_mm, half_mm + 0.01, 0.4)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    faces = grid_faces(len(side), len(side))
    return mesh_of(
        np.stack((x, y, np.full_like(x, height_mm)), 1), faces[:, ::-1].copy() if down else faces,
        normals=np.array([0, 0, -1.0 if down else 1.0]), colour=colour, mark=mark, sigma_mm=sigma_mm,
    )  # fmt: skip


def test_the_mesh_is_open_where_no_view_has_a_surface() -> None:
    model = model_of(views_of(star(subdivisions=5), around(8)[:1], 0.3, QUIET))
    counts = topology_counts(model.mesh.faces)
    assert counts.boundary_edges > 100
    assert (counts.nonmanifold_edges, counts.components) == (0, 1)
    seen = views_of(star(subdivisions=5), around(8)[:1], 0.3, QUIET)[0]
    tree_of_view = SearchTree.build(seen.mesh.vertices_mm @ seen.pose[:3, :3].T + seen.pose[:3, 3], seen.mesh.faces)
    # At most half a voxel beyond the view's border, and its noise.
    assert tree_of_view.distances_mm(model.mesh.vertices_mm).max() < 0.8 * model.voxel_mm


def test_two_views_that_agree_outweigh_one_that_contradicts_them() -> None:
    pose = np.eye(4)
    model = fuse_views([sheet(0.0), sheet(0.15, half_mm=1.6), sheet(0.002)], [pose] * 3, voxel_mm=0.5)
    inside = np.abs(model.mesh.vertices_mm[:, :2]).max(axis=1) < 1.5
    # The mean of the two that agree; the third, 10 σ away, does not count and adds no surface.
    assert inside.sum() > 20
    assert model.mesh.vertices_mm[inside, 2] == pytest.approx(0.001, abs=1e-4)
    assert topology_counts(model.mesh.faces).components == 1
    assert (model.views[inside] == 2).all()
    # Two of equal σ: 10 µm between three corners, once or twice; the error that all views share does not shrink.
    fewer = fuse_views([sheet(0.0)], [pose], voxel_mm=0.5, shared_mm=0.02)
    assert model.mesh.sigma_mm[inside].mean() == pytest.approx(0.0075 / np.sqrt(2), rel=0.2)
    assert 0.02 < fewer.mesh.sigma_mm.min() < 0.022


def test_the_two_sides_of_a_wall_do_not_cancel() -> None:
    model = fuse_views([sheet(0.0), sheet(-0.6, down=True)], [np.eye(4)] * 2, voxel_mm=0.5)
    heights = model.mesh.vertices_mm[np.abs(model.mesh.vertices_mm[:, :2]).max(axis=1) < 3, 2]
    assert np.unique(np.round(heights, 3)).tolist() == pytest.approx([-0.6, 0.0], abs=1e-3)
    assert (model.mesh.normals[:, 2] * np.where(model.mesh.vertices_mm[:, 2] > -0.3, 1, -1) > 0.9).all()


def test_colours_are_mixed_as_light_and_marked_ones_only_if_there_are_no_others() -> None:
    pose = np.eye(4)
    light = srgb_to_linear(np.array([50, 200], np.uint8)).astype(float)
    views = [sheet(0, colour=50), sheet(0, colour=200, sigma_mm=0.02)]
    for view in views:  # most of the surface is equal in both: they have one scale
        view.colour[np.abs(view.vertices_mm[:, 0]) > 1.9] = 100
    mixed = fuse_views(views, [pose] * 2, voxel_mm=0.5)
    inner = np.abs(mixed.mesh.vertices_mm[:, :2]).max(axis=1) < 1.2
    assert inner.sum() > 10
    weights = 1 / (np.array([0.01, 0.02]) ** 2 + mixed.correlated_mm**2)
    got = srgb_to_linear(mixed.mesh.colour[inner]).mean()
    assert got == pytest.approx((weights * light).sum() / weights.sum(), rel=0.03)
    marked = fuse_views([sheet(0, colour=50), sheet(0, colour=255, mark=1, sigma_mm=0.002)], [pose] * 2, voxel_mm=0.5)
    inner = np.abs(marked.mesh.vertices_mm[:, :2]).max(axis=1) < 3
    assert (marked.mesh.colour[inner] == 50).all()
    assert not marked.mesh.mark[inner].any()
    assert (fuse_views([sheet(0, mark=2)], [pose], voxel_mm=0.5).mesh.mark == 2).all()
    # A vertex without a normal has a placeholder colour: that of a clipped one is better.
    bad = fuse_views([sheet(0, colour=60, mark=AlbedoMark.SATURATED), sheet(0, colour=128, mark=AlbedoMark.UNKNOWN)],
                [pose] * 2, voxel_mm=0.5).mesh  # fmt: skip
    inner = np.abs(bad.vertices_mm[:, :2]).max(axis=1) < 3
    assert (bad.colour[inner] == 60).all()
    assert (bad.mark[inner] == AlbedoMark.SATURATED).all()


def test_a_painted_ball_has_one_scale_its_own_colours_and_no_seams() -> None:
    def paint(points: FloatArray) -> FloatArray:
        """Linear light, of white: red and blue change slowly from side to side."""
        red, blue = (0.4 + 0.3 * np.sin(points[:, axis] / 6 + axis) for axis in (0, 2))
        return np.stack([red, 0.5 * (red + blue), blue], axis=1)

    random, views = np.random.default_rng(4), []
    scales = random.uniform(0.5, 1.0, 8)  # each scan has its own
    for view, scale in zip(views_of(star(), around(8), 0.2), scales, strict=True):
        placed = view.mesh.vertices_mm @ view.pose[:3, :3].T + view.pose[:3, 3]
        colour, mark = linear_to_srgb(scale * paint(placed)), np.zeros(len(placed), np.uint8)
        # A lobe that each camera clips elsewhere, and a band that all clip.
        lobe = random.uniform(size=3) - 0.5
        clipped = placed @ (lobe / np.linalg.norm(lobe)) > 7
        mark[clipped | (np.abs(placed[:, 1] - 3) < 0.8)] = AlbedoMark.SATURATED
        colour[mark > 0] = 255
        views.append(view._replace(mesh=replace(view.mesh, colour=colour, mark=mark)))
    mesh = model_of(views).mesh
    clean = mesh.mark == AlbedoMark.NONE
    band = np.abs(mesh.vertices_mm[:, 1] - 3)
    # A steep edge may reach into the band from outside.
    assert (mesh.mark[band < 0.5] == AlbedoMark.SATURATED).mean() > 0.95
    assert clean[band > 1.2].mean() > 0.97  # the rest is in one view only, and clipped
    true = paint(mesh.vertices_mm.astype(float))[clean]
    off = srgb_to_linear(mesh.colour[clean]) / 65535 / true
    assert np.median(off) == pytest.approx(scales.min(), rel=0.02)
    # No step at the ends of views: all vertices have the colour, not most of them.
    assert np.quantile(np.abs(off / np.median(off) - 1), (0.5, 0.99)) == pytest.approx((0, 0), abs=0.03)


def test_views_that_cannot_be_fused_are_refused() -> None:
    view, pose = sheet(0.0), np.eye(4)
    with pytest.raises(ValueError, match="one pose for each of the 1 views, found 2"):
        fuse_views([view], [pose, pose])
    with pytest.raises(ValueError, match="pose 0 is not rigid"):
        fuse_views([view], [np.diag([1.1, 1, 1, 1])])
    with pytest.raises(InvalidInputError, match=r"voxel_mm: expected at least 0.08, .* 0.4 mm apart, found -1"):
        fuse_views([view], [pose], voxel_mm=-1.0)
    stray = view.vertices_mm.copy()
    stray[0, 0] = 1e6
    with pytest.raises(InvalidInputError, match=r"voxels of 0.1 mm are too small for views that reach over 1000004 mm"):
        fuse_views([replace(view, vertices_mm=stray)], [pose], voxel_mm=0.1)
    crossed = replace(view, faces=np.concatenate((view.faces, view.faces[:1])))
    with pytest.raises(InvalidInputError, match="view 0 is not a manifold"):
        fuse_views([crossed], [pose])
    with pytest.raises(NothingToReconstructError, match="found in 1 views none"):
        fuse_views([replace(view, sigma_mm=np.full_like(view.sigma_mm, np.nan))], [pose])


def test_the_variance_by_poses_equals_that_of_all_pairs_by_matrices() -> None:
    random = np.random.default_rng(4)
    views = [sheet(0.001 * k) for k in range(4)]
    root, middle = random.normal(size=(24, 24)) * 1e-3, np.array([1.0, -2.0, 0.5])
    stack = stack_views(views, [np.eye(4)] * 4, border_limit_mm=0.5)
    points = np.array([[0.1, 0.2, 0.0], [1.3, -0.7, 0.01], [-2.1, 1.9, -0.01]])
    nearest = np.array(
        [
            [
                first + np.argmin(((view.vertices_mm[view.faces].mean(axis=1) - point) ** 2).sum(axis=1))
                for point in points
            ]
            for first, view in zip(stack.first_face[:-1], views, strict=True)
        ],
        dtype=np.int32,
    )

    def variance(covariance: FloatArray) -> FloatArray:
        rule = FusionSettings(0.001, 0.001, 0.0, 1.0, 0.5, PoseErrors(covariance, middle))
        return np.asarray(average_views(stack, points, nearest, rule, values_only=False).sigma_mm ** 2)

    normal = np.array([0.0, 0.0, 1.0])
    g = np.hstack([np.cross(points - middle, normal), np.tile(normal, (3, 1))])
    # All four views count alike.
    levers = np.tile(g, (1, 4)) / 4
    expected = np.einsum("ni,ij,nj->n", levers, root @ root.T, levers)
    np.testing.assert_allclose(variance(root @ root.T) - variance(np.zeros((24, 24))), expected, rtol=1e-9)


def test_split_quadrangles_equal_those_by_arrays() -> None:
    random = np.random.default_rng(5)
    points, normals = random.normal(size=(2, 60, 3))
    points[7], normals[11] = np.nan, np.nan
    quads = np.stack([random.permutation(60)[:4] for _ in range(500)]).astype(np.int32)
    faces, facing = np.zeros((1000, 3), np.int32), np.full(1000, 9, np.uint8)
    _split_quads(0, 500, quads, points, normals, faces, facing)

    a, b, c, d = quads.T
    across = ((points[a] - points[c]) ** 2).sum(axis=1) <= ((points[b] - points[d]) ** 2).sum(axis=1)
    halves = np.where(across[:, None, None], quads[:, [[0, 1, 2], [0, 2, 3]]], quads[:, [[0, 1, 3], [1, 2, 3]]])
    np.testing.assert_array_equal(faces, halves.reshape(-1, 3))
    a, b, c = faces.T
    along = np.stack(
        [(np.cross(points[b] - points[a], points[c] - points[a]) * normals[each]).sum(axis=1) for each in (a, b, c)]
    )
    unseen = np.isnan(along).any(axis=0)
    expected = np.where(unseen, 0, np.where((along > 0).any(axis=0), _OUTWARD, _FOLDED))
    np.testing.assert_array_equal(facing, expected)
    assert set(expected) == {0, _OUTWARD, _FOLDED}

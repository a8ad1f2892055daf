"""The z-buffer against every triangle tried at every pixel in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numba import config
from numpy.typing import NDArray

from slrig.meshing import rasteriser
from slrig.meshing.rasteriser import covered_pixels, depth_ranges, rasterise, rasterise_normals
from slrig.model import FloatArray, IntArray, Size
from tests.unit.meshing.plain import grid_faces

SIZE = Size(50, 40)


def plain_weights(corners: FloatArray, size: Size) -> FloatArray:
    """(3, H, W): barycentric coordinates of every pixel centre in a triangle, (3, 3) column, row, depth."""
    rows, columns = np.mgrid[: size.height_px, : size.width_px].astype(np.float64)
    system = np.vstack((corners[:, :2].T, np.ones(3)))
    return np.asarray(np.einsum("ij,jrc->irc", np.linalg.inv(system), np.stack((columns, rows, np.ones(size.shape)))))


def plain_view(placed: NDArray[np.float32], faces: IntArray, size: Size) -> tuple[FloatArray, IntArray]:
    """Nearest depth and which triangle at each pixel centre, one triangle after the other over the whole picture."""
    nearest, which = np.full(size.shape, np.inf), np.full(size.shape, -1, dtype=np.int32)
    for number, face in enumerate(faces):
        corners = placed[face].astype(np.float64)
        weights = plain_weights(corners, size)
        z = 1 / np.einsum("irc,i->rc", weights, 1 / corners[:, 2])
        nearer = (weights >= 0).all(axis=0) & (z < nearest)
        nearest[nearer], which[nearer] = z[nearer], number
    return np.where(np.isfinite(nearest), nearest, np.nan), which


def placed_at(pixels: FloatArray, depth: FloatArray) -> NDArray[np.float32]:
    return np.column_stack((pixels, depth)).astype(np.float32)


def random_triangles(count: int = 20, seed: int = 4) -> tuple[NDArray[np.float32], IntArray, NDArray[np.float32]]:
    """Placed vertices, faces and normals of triangles that pass through one another."""
    random = np.random.default_rng(seed)
    placed = placed_at(random.uniform(-10, 60, (3 * count, 2)), random.uniform(100, 300, 3 * count))
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    return placed, faces, random.normal(size=(3 * count, 3)).astype(np.float32)


def share_out(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    """Rasterise the smallest meshes in bands, on so many threads."""
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
    monkeypatch.setattr(rasteriser, "_MIN_FACES", 1)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_view_is_that_of_trying_every_triangle_at_every_pixel(
    monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    share_out(monkeypatch, threads)
    placed, faces, _ = random_triangles()
    view = rasterise(placed, faces, SIZE)
    depth, which = plain_view(placed, faces, SIZE)
    assert 0.2 < (which >= 0).mean() < 1
    assert view.depth_mm == pytest.approx(depth, nan_ok=True)
    assert np.array_equal(view.face, which)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_pixel_is_covered_if_any_triangle_is_seen_there(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    share_out(monkeypatch, threads)
    placed, faces, _ = random_triangles()
    placed[faces[3, 0], 2] = -1.0
    covered = covered_pixels(placed, faces, SIZE)
    assert 0.2 < covered.mean() < 1
    assert np.array_equal(covered, rasterise(placed, faces, SIZE).face >= 0)


def test_normals_are_those_of_the_triangle_that_is_seen_on_the_side_that_is_seen() -> None:
    placed, faces, normals = random_triangles()
    depth, which = plain_view(placed, faces, SIZE)
    expected, front = np.zeros((*SIZE.shape, 3)), np.zeros(SIZE.shape, dtype=bool)
    for number, face in enumerate(faces):
        here = which == number
        corners = placed[face].astype(np.float64)
        # Over space a value is linear over the picture when it is divided by depth.
        weights = plain_weights(corners, SIZE) / corners[:, 2, None, None] * depth
        along, across = corners[1, :2] - corners[0, :2], corners[2, :2] - corners[0, :2]
        front[here] = along[0] * across[1] - along[1] * across[0] < 0
        expected[here] = np.einsum("irc,ik->rck", weights, normals[face].astype(np.float64))[here]
    expected[~front] *= -1
    length = np.linalg.norm(expected, axis=2, keepdims=True)
    view = rasterise(placed, faces, SIZE)
    found, found_front = rasterise_normals(view, placed, normals, faces)
    assert 0.2 < front[which >= 0].mean() < 0.8
    assert np.array_equal(found_front, front)
    assert found == pytest.approx(expected / np.where(length > 0, length, 1), abs=1e-5)


@pytest.mark.parametrize("threads", [1, 2])
def test_of_equally_near_triangles_the_first_is_seen(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    share_out(monkeypatch, threads)
    placed, faces, _ = random_triangles()
    once = rasterise(placed, faces, SIZE)
    # The same triangles again and again: some copies in the band of the first, some in others.
    again = rasterise(placed, np.tile(faces, (5, 1)), SIZE)
    assert np.array_equal(again.face, once.face)


def test_a_sheet_of_small_triangles_has_no_holes() -> None:
    side = np.linspace(-0.5, 30.5, 32)  # its edges pass between pixel centres; then through them
    for shift in (0.0, 0.5):
        x, y = (axis.ravel() + shift for axis in np.meshgrid(side, side))
        faces = grid_faces(32, 32)
        view = rasterise(placed_at(np.stack((x, y), 1), np.full(len(x), 300.0)), faces, Size(34, 34))
        seen = np.zeros((34, 34), dtype=bool)
        seen[: 31 + round(2 * shift), : 31 + round(2 * shift)] = True
        assert np.array_equal(view.face >= 0, seen)


def test_a_triangle_with_a_vertex_behind_the_camera_or_unmeasured_is_left_out() -> None:
    pixels = np.array([[1, 1], [8, 1], [1, 8], [np.nan, 8], [np.nan, np.nan]], dtype=np.float64)
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 4, 1], [4, 0, 1], [0, 1, 4]], dtype=np.int32)
    depth = np.array([1.0, 1.0, -1.0, np.nan, 1.0])
    view = rasterise(placed_at(pixels, depth), faces, Size(10, 10))
    assert np.isnan(view.depth_mm).all()
    assert (view.face == -1).all()


def test_no_triangles_are_no_view() -> None:
    placed, faces = np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32)
    view = rasterise(placed, faces, Size(4, 3))
    assert np.isnan(view.depth_mm).all()
    assert not rasterise_normals(view, placed, placed, faces)[0].any()


@pytest.mark.parametrize("threads", [1, 2])
def test_the_range_of_depths_is_that_of_all_triangles_at_a_pixel(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    share_out(monkeypatch, threads)
    placed, faces, _ = random_triangles()
    nearest, furthest = np.full(SIZE.shape, np.inf), np.full(SIZE.shape, -np.inf)
    for face in faces:
        weights = plain_weights(placed[face].astype(np.float64), SIZE)
        inside, depth = (weights >= 0).all(axis=0), np.einsum("irc,i->rc", weights, placed[face, 2])
        nearest[inside] = np.minimum(nearest, depth)[inside]
        furthest[inside] = np.maximum(furthest, depth)[inside]
    found = depth_ranges(placed.astype(np.float64), faces, SIZE)
    np.testing.assert_allclose(found, (nearest, furthest), rtol=1e-9)
    empty, _ = depth_ranges(np.zeros((0, 3)), faces[:0], SIZE)
    assert np.isinf(empty).all()

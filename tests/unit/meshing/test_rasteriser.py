"""The z-buffer against every triangle tried at every pixel in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.meshing.rasteriser import rasterised
from slrig.model import FloatArray, IntArray, Size


def plain_depth(pixels: FloatArray, depth: FloatArray, faces: IntArray, size: Size) -> FloatArray:
    """Nearest depth at each pixel centre, one triangle after the other over the whole picture."""
    rows, columns = np.mgrid[: size.height_px, : size.width_px].astype(np.float64)
    nearest = np.full(size.shape, np.inf)
    for face in faces:
        system = np.vstack((pixels[face].T, np.ones(3)))
        weights = np.einsum("ij,jrc->irc", np.linalg.inv(system), np.stack((columns, rows, np.ones(size.shape))))
        z = 1 / np.einsum("irc,i->rc", weights, 1 / depth[face])
        nearest = np.where((weights >= 0).all(axis=0), np.minimum(nearest, z), nearest)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def test_depth_is_that_of_trying_every_triangle_at_every_pixel() -> None:
    random = np.random.default_rng(4)
    pixels = random.uniform(-10, 60, (60, 2))
    depth = random.uniform(100, 300, 60)
    faces = np.arange(60, dtype=np.int32).reshape(-1, 3)
    size = Size(50, 40)
    view = rasterised(pixels, depth, random.normal(size=(60, 3)), faces, size)
    expected = plain_depth(pixels, depth, faces, size)
    assert 0.2 < np.isfinite(expected).mean() < 1
    assert view.depth_mm == pytest.approx(expected, nan_ok=True)
    seen = np.isfinite(view.depth_mm)
    assert np.linalg.norm(view.normals[seen], axis=1) == pytest.approx(np.ones(seen.sum()))
    assert not view.normals[~seen].any()


def test_interpolation_is_linear_in_space_not_in_the_picture() -> None:
    # A plane z = 200 + 2 x seen by an ideal camera with f = 100 px: 1/z is linear in the column.
    corners = np.array([[-40, -30, 120], [40, -30, 280], [-40, 30, 120], [40, 30, 280]], dtype=np.float64)
    pixels = 100 * corners[:, :2] / corners[:, 2:] + (32, 24)
    faces = np.array([[0, 2, 1], [1, 2, 3]], dtype=np.int32)
    view = rasterised(pixels, corners[:, 2], np.zeros((4, 3)), faces, Size(64, 48))
    columns = np.arange(64)
    expected = 200 / (1 - 2 * (columns - 32) / 100)
    row = view.depth_mm[24]
    seen = np.isfinite(row)
    assert seen.sum() > 30
    assert row[seen] == pytest.approx(expected[seen])


def test_front_is_counter_clockwise_in_the_picture() -> None:
    pixels = np.array([[1, 1], [1, 8], [8, 1]], dtype=np.float64)  # down, then right: counter-clockwise to the eye
    for face, front in (((0, 1, 2), True), ((0, 2, 1), False)):
        view = rasterised(pixels, np.ones(3), np.zeros((3, 3)), np.array([face], dtype=np.int32), Size(10, 10))
        assert view.front[2, 2] == front


def test_a_triangle_with_a_vertex_behind_the_camera_or_unmeasured_is_left_out() -> None:
    pixels = np.array([[1, 1], [8, 1], [1, 8], [np.nan, 8]], dtype=np.float64)
    faces = np.array([[0, 1, 2], [0, 1, 3]], dtype=np.int32)
    depth = np.array([1.0, 1.0, -1.0, np.nan])
    assert np.isnan(rasterised(pixels, depth, np.zeros((4, 3)), faces, Size(10, 10)).depth_mm).all()

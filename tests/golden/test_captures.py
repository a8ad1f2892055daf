"""Frames of real cameras: a skull against its published point cloud, boards against a smooth fit to their plane."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slrig.bundle import read_capture
from slrig.model import Axis, FloatArray, Refusal
from slrig.patterns.positions import cell_count, index_of_word
from slrig.reconstruction.decoding import DecodingLimits, decode
from slrig.reconstruction.frames import axis_frames
from slrig.reconstruction.noise import estimate_noise
from tests.golden.test_bundles import reconstructed

pytestmark = pytest.mark.shared

CORNERS = (7, 9)


@pytest.mark.slow
def test_the_skull_covers_its_reference_points(shared: Path, tmp_path: Path) -> None:
    folder = shared / "captures" / "skull"
    report = reconstructed(folder, tmp_path / "out")
    assert report["method"] == "Gray-only"
    reference: FloatArray = np.load(folder / "reference_points_mm.npy").astype(np.float64)
    points = np.asarray(trimesh.load(tmp_path / "out" / "points.ply", process=False).vertices)
    vertices = np.asarray(trimesh.load(tmp_path / "out" / "mesh.ply", process=False).vertices)
    to_points = _distances(reference, points)
    to_vertices = _distances(reference, vertices)
    assert (to_points < 1.0).mean() >= 0.95
    assert (to_vertices < 1.0).mean() >= 0.95
    assert np.median(to_points) <= 0.25
    assert np.percentile(to_points, 95) <= 0.8
    # The authors cut their points out. Vertices far from them are of the table and the wall, or there are too many.
    far = vertices[_distances(vertices, reference) > 10.0]
    for _ in range(2):
        far = _off_plane(far, within_mm=1.5)
    assert len(far) <= 0.003 * len(vertices)


def _off_plane(points: FloatArray, *, within_mm: float) -> FloatArray:
    """The points that do not lie on the plane that most of them lie on."""
    rng = np.random.default_rng(0)
    off = np.ones(len(points), dtype=bool)
    for _ in range(500):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        apart = np.abs((points - a) @ normal) > within_mm * np.linalg.norm(normal)
        if apart.sum() < off.sum():
            off = apart
    return points[off]


@pytest.mark.parametrize("pose", [0, *(pytest.param(pose, marks=pytest.mark.slow) for pose in (1, 2, 3))])
@pytest.mark.parametrize("axis", list(Axis))
def test_a_board_decodes_on_both_axes(shared: Path, pose: int, axis: Axis) -> None:
    capture = read_capture(shared / "captures" / "boards" / f"pose_{pose}")
    frames = axis_frames(capture, "cam0", axis)
    code = decode(
        frames,
        estimate_noise(frames),
        index_of_word(frames.gray),
        cell_count(frames.gray, capture.projector),
        DecodingLimits(),
    )
    lit = frames.contrast > 20
    decoded = lit & (code.refusal == Refusal.NONE)
    assert decoded.sum() >= 0.55 * lit.sum()
    rows, columns = np.nonzero(decoded & _board(frames.white))
    assert len(rows) > 100_000
    off = np.abs(_residual(columns, rows, code.centre()[rows, columns], frames.white.shape))
    assert (off > 2).mean() < 0.001


def _distances(points: FloatArray, others: FloatArray) -> FloatArray:
    """(n,) float64: from each point to the nearest of the others."""
    return np.asarray(cKDTree(others).query(points)[0], dtype=np.float64)


def _board(white: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) bool: the chessboard's squares, one row of outer squares included."""
    image = np.clip(white, 0, 255).astype(np.uint8)
    found, corners = cv2.findChessboardCornersSB(
        image, CORNERS, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    assert found
    grid = np.stack(np.meshgrid(np.arange(CORNERS[0]), np.arange(CORNERS[1])), axis=-1).reshape(-1, 2)
    to_image, _ = cv2.findHomography(grid.astype(np.float32), corners.reshape(-1, 2))
    right, bottom = CORNERS[0] - 0.1, CORNERS[1] - 0.1
    outline = np.array([[[-0.9, -0.9], [right, -0.9], [right, bottom], [-0.9, bottom]]], dtype=np.float32)
    mask = np.zeros(image.shape, dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(cv2.perspectiveTransform(outline, to_image)[0]).astype(np.int32)], 1)
    return mask > 0


def _residual(
    columns: NDArray[np.intp],
    rows: NDArray[np.intp],
    code: FloatArray,
    shape: tuple[int, ...],
) -> FloatArray:
    """Codes less a polynomial of degree 5 in the image, fitted to those near it."""
    x, y = columns / shape[1] * 2 - 1, rows / shape[0] * 2 - 1
    terms = np.stack([x**i * y**j for i in range(6) for j in range(6 - i)], axis=1)
    near = np.ones(len(code), dtype=bool)
    residual = code
    for _ in range(6):
        weights = np.linalg.lstsq(terms[near], code[near], rcond=None)[0]
        residual = code - terms @ weights
        near = np.abs(residual) < 2
    return np.asarray(residual)

"""Prints in the picture: averaged over what each sample sees, and so placed exactly, whatever the samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from simulated_rig.options import SimulatedCameraOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import PrintedBoard, Scene, SceneSurface, build_surface, rotation_matrix
from simulated_rig.transport import Hits, build_caster, trace_rays
from slrig.model import FloatArray, Pinhole, Size
from tests.core import parametrize_core
from tests.unit.reconstruction.builders import opencv_pixels, opencv_rays
from tests.unit.simulated_rig.building import corners_in_world_mm
from tests.unit.simulated_rig.test_boards import dark_at

POSITION = (6.0, -4.0, 12.0)
ROTATION = (24.0, -19.0, 11.0)
EYE = SimulatedCameraOptions.model_validate({
    "name": "eye", "size_px": [640, 512], "focal_px": [950.0, 951.0], "principal_px": [321.8, 252.9],
    "distortion": [-0.11, 0.15, -0.0003, 0.0005, 0.0], "position_mm": [-60.0, -10.0, -420.0],
    "target_mm": [0.0, 0.0, 0.0],
}).pinhole()  # fmt: skip
LAMP = SimulatedCameraOptions.model_validate({
    "name": "lamp", "size_px": [320, 200], "focal_px": [260.0, 260.0], "position_mm": [60.0, 0.0, -430.0],
    "target_mm": [0.0, 0.0, 0.0],
}).pinhole()  # fmt: skip
KINDS: dict[str, dict[str, Any]] = {
    "chessboard": {"columns": 8, "rows": 6, "square_mm": 20.0},
    "charuco": {"columns": 7, "rows": 5, "square_mm": 24.0, "marker_mm": 18.0, "dictionary": "DICT_4X4_50"},
    "circles": {"columns": 4, "rows": 9, "square_mm": 15.0, "circle_mm": 14.0},
}


def board(kind: str, **options: Any) -> PrintedBoard:
    placed = {"position_mm": POSITION, "rotation_deg": ROTATION}
    return PrintedBoard.model_validate({"shape": "board", "kind": kind, **KINDS[kind], **placed, **options})


def surface(each: PrintedBoard) -> SceneSurface:
    return build_surface(Scene.model_validate({"object": [each.model_dump()]}), Path())


def picture(each: PrintedBoard, *, camera: Pinhole = EYE, samples_per_axis: int = 2) -> NDArray[np.float32]:
    """The board under even light, without noise."""
    stage = SceneState(surface(each), LAMP, working_distance_mm=430.0)
    view = CameraView(
        camera, stage, blur_px=0.6, ambient=1.0, samples_per_axis=samples_per_axis, jitter=False, seed=1, workers=1
    )
    return view.image([])


def window(left_px: int, top_px: int, size: Size) -> Pinhole:
    """A part of EYE's image."""
    moved = EYE.matrix - np.array([(0, 0, left_px), (0, 0, top_px), (0, 0, 0)])
    return replace(EYE, size=size, matrix=moved)


def grey(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(np.clip(image * 280, 0, 255)), np.uint8)


def on_board(u: FloatArray, v: FloatArray) -> FloatArray:
    """(n, 2): where rays through pixels meet the plane of a board in POSITION, in its frame, by OpenCV's lens."""
    rays = opencv_rays(EYE, np.column_stack([u, v]))
    turn = rotation_matrix(ROTATION)
    eye, rays = turn.T @ (EYE.centre_mm - POSITION), rays @ turn
    return np.asarray((eye - rays * (eye[2] / rays[:, 2])[:, None])[:, :2], np.float64)


def traced(each: PrintedBoard, u: FloatArray, v: FloatArray, footprint_px: float) -> Hits:
    world = surface(each)
    rays = build_caster(world.vertices_mm, world.faces)
    return trace_rays(u, v, EYE, LAMP, world, rays, working_distance_mm=430.0, footprint_px=footprint_px)


@parametrize_core("kind", ["charuco", "chessboard", "circles"])
def test_a_cell_has_the_mean_albedo_of_what_it_sees(kind: str) -> None:
    each, side, fine = board(kind), 0.5, 80
    rng = np.random.default_rng(5)
    u, v = (rng.integers(least, most, 8000).astype(np.float64) + 0.25 for least, most in ((200, 440), (150, 350)))
    hits = traced(each, u, v, side)
    offsets = (np.arange(fine) + 0.5) / fine * side - side / 2
    du, dv = (grid.ravel() for grid in np.meshgrid(offsets, offsets))
    # Only cells that an edge crosses tell anything; a few hundred of them.
    mixed = np.flatnonzero((hits.albedo > 0.06) & (hits.albedo < 0.84))[:100]
    assert len(mixed) > 90
    turn = rotation_matrix(ROTATION)
    worst, farthest = 0.0, 0.0
    for k in mixed:
        at = on_board(u[k] + du, v[k] + dv)
        albedo = np.where(dark_at(each.print_layout(), at), each.albedo_dark, each.albedo_light)
        worst = max(worst, abs(float(albedo.mean()) - float(hits.albedo[k])))
        middle = (at * albedo[:, None]).sum(axis=0) / albedo.sum()
        found = (hits.points_mm[k] - POSITION) @ turn
        farthest = max(farthest, float(np.abs(found[:2] - middle).max()))
        assert abs(found[2]) < 1e-9
    # 80 x 80 points place an edge along them within 1/160 of the cell: 0.005 of the step of 0.8.
    assert worst < 0.006
    # The cell is 0.25 mm wide; across it, a disc's rim bends by 0.001 mm, and counts as straight.
    assert farthest < 0.003


def test_without_a_footprint_the_print_is_taken_at_the_point() -> None:
    each = board("charuco")
    rng = np.random.default_rng(6)
    u, v = rng.uniform(200, 440, 4000), rng.uniform(150, 350, 4000)
    hits = traced(each, u, v, 0.0)
    at = on_board(u, v)
    expected = np.where(dark_at(each.print_layout(), at), each.albedo_dark, each.albedo_light)
    assert (np.abs(hits.albedo - expected) < 1e-6).mean() > 0.999
    np.testing.assert_allclose((hits.points_mm - POSITION) @ rotation_matrix(ROTATION)[:, :2], at, atol=1e-6)


@pytest.mark.slow
def test_two_samples_a_side_place_edges_as_eight_do() -> None:
    part = window(250, 180, Size(140, 120))
    coarse, fine = (
        picture(board("chessboard"), camera=part, samples_per_axis=count).astype(np.float64) for count in (2, 8)
    )
    down, along = (np.gradient(fine, axis=axis) for axis in (0, 1))
    steep = np.hypot(along, down)
    edges = steep > 0.5 * np.percentile(steep, 99)
    # Along the normal of an edge, a shift moves the picture by the gradient.
    apart = (coarse - fine)[edges]
    for slope in (along[edges], down[edges]):
        shift = apart * slope / steep[edges] ** 2
        assert abs(float(shift.mean())) < 0.0005
        assert float(np.sqrt((shift**2).mean())) < 0.02


@pytest.mark.slow
def test_discs_have_their_area_and_centroid() -> None:
    each = board("circles")
    light, shown = (picture(one) for one in (board("circles", albedo_dark=0.8499), each))
    dark = (1 - shown.astype(np.float64) / np.maximum(light, 1e-6)) / (1 - each.albedo_dark / each.albedo_light)
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = 7.0 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    for corner in each.corners_mm:
        outline = opencv_pixels(EYE, (corner + ring) @ rotation_matrix(ROTATION).T + POSITION)
        after = np.roll(outline, -1, axis=0)
        cross = outline[:, 0] * after[:, 1] - after[:, 0] * outline[:, 1]
        area = cross.sum() / 2
        centroid = ((outline + after) * cross[:, None]).sum(axis=0) / (6 * area)
        least, most = np.floor(outline.min(axis=0) - 3).astype(int), np.ceil(outline.max(axis=0) + 4).astype(int)
        window = dark[least[1] : most[1], least[0] : most[0]]
        y, x = np.mgrid[least[1] : most[1], least[0] : most[0]]
        found = np.array([(window * x).sum(), (window * y).sum()]) / window.sum()
        assert window.sum() == pytest.approx(area, rel=0.002)
        np.testing.assert_allclose(found, centroid, atol=0.003)


@pytest.mark.slow
@pytest.mark.parametrize("bow_mm", [0.0, 2.5])
def test_opencv_finds_a_chessboard_where_it_stands(bow_mm: float) -> None:
    each = board("chessboard", bow_mm=bow_mm)
    image = grey(picture(each))
    expected = opencv_pixels(EYE, corners_in_world_mm(each, POSITION, ROTATION))
    found = _refined(image, _chessboard(image, each), half_px=8)
    np.testing.assert_allclose(found.mean(axis=0), expected.mean(axis=0), atol=0.005)
    assert float(np.sqrt(((found - expected) ** 2).mean())) < 0.02
    if bow_mm:
        flat = opencv_pixels(EYE, corners_in_world_mm(board("chessboard"), POSITION, ROTATION))
        assert float(np.sqrt(((found - flat) ** 2).mean())) > 0.5


@pytest.mark.slow
def test_opencv_finds_a_charuco_board_where_it_stands_and_no_mirrored_one() -> None:
    each = board("charuco")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((8, 6), 24.0, 18.0, dictionary))
    image = grey(picture(each))
    corners, ids, _, markers = detector.detectBoard(image)
    assert len(markers) == 24
    assert ids.ravel().tolist() == list(range(35))
    expected = opencv_pixels(EYE, corners_in_world_mm(each, POSITION, ROTATION))
    error = _refined(image, corners.reshape(-1, 2), half_px=4) - expected
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=0.005)
    assert float(np.sqrt((error**2).mean())) < 0.03
    _, _, _, mirrored = detector.detectBoard(grey(picture(board("charuco", mirrored=True))))
    assert mirrored is None or len(mirrored) < 6


def _chessboard(image: NDArray[np.uint8], each: PrintedBoard) -> FloatArray:
    found, corners = cv2.findChessboardCornersSB(image, (each.columns, each.rows))
    assert found
    return np.asarray(corners.reshape(-1, 2), np.float64)


def _refined(image: NDArray[np.uint8], corners: FloatArray, *, half_px: int) -> FloatArray:
    # Without the Gaussian OpenCV's own interpolation errs by 0.02 px at edges as sharp as these.
    smooth = cv2.GaussianBlur(image, (0, 0), 1.5)
    start = corners.reshape(-1, 1, 2).astype(np.float32)
    found = cv2.cornerSubPix(smooth, start, (half_px, half_px), (-1, -1), (3, 100, 1e-6))
    return np.asarray(found.reshape(-1, 2), np.float64)

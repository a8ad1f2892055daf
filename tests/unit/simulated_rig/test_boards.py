"""Boards as designed and as printed: the layout against OpenCV's own drawings, corners, defects, refusals."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from simulated_rig.scene import BoardPrint, PrintedBoard, arc_length_mm, x_at_arc_length_mm
from slrig.calibration.board import Board as Designed
from slrig.calibration.board import BoardKind
from slrig.model import FloatArray
from tests.unit.simulated_rig.building import corners_in_world_mm

SIZES: dict[str, dict[str, Any]] = {
    "chessboard": {"columns": 5, "rows": 4, "square_mm": 9.0},
    "charuco": {"columns": 5, "rows": 4, "square_mm": 9.0, "marker_mm": 7.0},
    "circles": {"columns": 4, "rows": 7, "square_mm": 8.0},
}


def board(kind: str = "chessboard", **options: Any) -> PrintedBoard:
    return PrintedBoard.model_validate({"shape": "board", "kind": kind, **SIZES[kind], **options})


def dark_at(shown: BoardPrint, points_mm: FloatArray) -> NDArray[np.bool_]:
    """Whether the print is dark at points (n, 2) that lie on no line of it."""
    if len(shown.centres_mm):
        apart = np.linalg.norm(points_mm[:, None] - shown.centres_mm, axis=2)
        return np.asarray(apart.min(axis=1) < shown.radius_mm)
    j = np.searchsorted(shown.across_mm, points_mm[:, 0]) - 1
    i = np.searchsorted(shown.down_mm, points_mm[:, 1]) - 1
    inside = (i >= 0) & (j >= 0) & (i < len(shown.down_mm) - 1) & (j < len(shown.across_mm) - 1)
    dark = shown.dark[np.clip(i, 0, shown.dark.shape[0] - 1), np.clip(j, 0, shown.dark.shape[1] - 1)] == 1
    return np.asarray(inside & dark)


def on_print(each: PrintedBoard, columns: int, rows: int, *, per_mm: int) -> FloatArray:
    """(n, 2): centres of the pixels of a drawing of so many squares, in the board's frame."""
    y, x = np.mgrid[: rows * 9 * per_mm, : columns * 9 * per_mm]
    at = (np.column_stack([x.ravel(), y.ravel()]) + 0.5) / per_mm - each.square_mm
    return np.asarray(at - each.middle_mm, np.float64)


def test_a_charuco_board_is_the_one_that_opencv_draws() -> None:
    each, per_mm = board("charuco"), 4
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    drawn = cv2.aruco.CharucoBoard((6, 5), 9.0, 7.0, dictionary).generateImage((6 * 9 * per_mm, 5 * 9 * per_mm))
    found = dark_at(each.print_layout(), on_print(each, 6, 5, per_mm=per_mm)).reshape(drawn.shape)
    np.testing.assert_array_equal(found, drawn < 128)


def test_a_chessboard_begins_with_a_dark_square() -> None:
    each = board()
    shown, s = each.print_layout(), each.square_mm
    corner = each.corners_mm[0, :2]
    around = corner + np.array([(-s, -s), (s, -s), (-s, s), (s, s)]) / 2
    assert dark_at(shown, around).tolist() == [True, False, False, True]
    # The margin is light, and all around there are as many squares as corners and one more.
    assert not dark_at(shown, corner - 1.5 * np.array([[s, s]])).any()
    assert shown.dark.shape == (each.rows + 1, each.columns + 1)


@pytest.mark.parametrize("kind", list(BoardKind))
def test_corners_lie_where_the_calibration_expects_them(kind: BoardKind) -> None:
    each = board(kind)
    sizes = SIZES[kind]
    designed = Designed(kind, sizes["columns"], sizes["rows"], sizes["square_mm"], sizes.get("marker_mm"))
    np.testing.assert_allclose(each.corners_mm + np.array([*each.middle_mm, 0.0]), designed.points_mm, atol=1e-12)
    if kind is not BoardKind.CIRCLES:
        np.testing.assert_allclose(each.print_mm + each.middle_mm, designed.print_mm, atol=1e-12)


def test_circles_are_dark_discs_about_their_centres() -> None:
    each = board("circles", circle_mm=6.0)
    shown = each.print_layout()
    np.testing.assert_allclose(shown.centres_mm, each.corners_mm[:, :2])
    assert dark_at(shown, shown.centres_mm + np.array([2.9, 0.0])).all()
    assert not dark_at(shown, shown.centres_mm + np.array([3.1, 0.0])).any()


@pytest.mark.parametrize("kind", ["chessboard", "charuco", "circles"])
def test_a_mirrored_print_is_the_print_seen_from_behind(kind: str) -> None:
    plain, mirrored = board(kind), board(kind, mirrored=True)
    points = np.random.default_rng(3).uniform(-40, 40, (5000, 2))
    np.testing.assert_array_equal(
        dark_at(mirrored.print_layout(), points), dark_at(plain.print_layout(), points * [-1.0, 1.0])
    )
    np.testing.assert_allclose(mirrored.corners_mm, plain.corners_mm * [-1.0, 1.0, 1.0])


def test_a_printer_that_scales_moves_corners_and_print_alike() -> None:
    plain, scaled = board(), board(scale=(1.05, 0.98))
    points = np.random.default_rng(4).uniform(-30, 30, (5000, 2))
    np.testing.assert_array_equal(
        dark_at(scaled.print_layout(), points * [1.05, 0.98]), dark_at(plain.print_layout(), points)
    )
    np.testing.assert_allclose(scaled.corners_mm, plain.corners_mm * [1.05, 0.98, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize("bow_mm", [2.0, -3.0])
def test_a_bent_board_keeps_its_length_along_the_bend(bow_mm: float) -> None:
    each = board(bow_mm=bow_mm)
    half = each.paper_mm[1, 0]
    ends = each.on_sheet_mm(np.array([(-half, 0.0), (0.0, 0.0), (half, 0.0)]))
    # The middle lies nearer to the devices (smaller z) than the ends by the bow.
    np.testing.assert_allclose(ends[[0, 2], 2] - ends[1, 2], bow_mm, atol=1e-9)
    fine = each.on_sheet_mm(np.column_stack([np.linspace(-half, half, 20001), np.zeros(20001)]))
    assert np.linalg.norm(np.diff(fine, axis=0), axis=1).sum() == pytest.approx(2 * half, rel=1e-8)
    x = np.linspace(-half, half, 7)
    np.testing.assert_allclose(x_at_arc_length_mm(arc_length_mm(x, 0.004), 0.004), x, atol=1e-10)
    (part,) = each.parts(None)  # type: ignore[arg-type]  # a board reads no file
    vertices = part.vertices_mm
    np.testing.assert_allclose(vertices[:, 2], each.curvature_per_mm * vertices[:, 0] ** 2, atol=1e-12)
    sag = each.curvature_per_mm * np.diff(vertices[: len(vertices) // 2, 0]).max() ** 2 / 4
    assert abs(sag) < 0.0002


def test_corners_in_the_world_turn_about_the_middle() -> None:
    each = board()
    placed = corners_in_world_mm(each, (1.0, 2.0, 3.0), (0.0, 0.0, 90.0))
    np.testing.assert_allclose(placed.mean(axis=0), [1.0, 2.0, 3.0], atol=1e-12)
    along = placed[1] - placed[0]
    np.testing.assert_allclose(along, [0.0, each.square_mm, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        ("charuco", {"marker_mm": 9.0}, "below square_mm"),
        ("charuco", {"dictionary": "DICT_9X9"}, "unknown dictionary"),
        ("charuco", {"dictionary": "DICT_5X5_50", "columns": 12, "rows": 9}, "needs 65 markers"),
        ("chessboard", {"marker_mm": 5.0}, "applies to ChArUco"),
        ("chessboard", {"albedo_dark": 0.9}, "below albedo_light"),
        ("chessboard", {"bow_mm": 30.0}, "bow_mm must be at most"),
        ("chessboard", {"albedo": 0.5}, "albedo"),
    ],
)
def test_boards_that_cannot_be_are_refused(kind: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        board(kind, **options)

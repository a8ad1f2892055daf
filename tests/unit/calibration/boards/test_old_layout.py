"""ChArUco boards as OpenCV before 4.6 printed them: with an even number of rows of squares, a light one comes first."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.boards.detection import (
    blur_sigma_px,
    find_board,
    light_squares,
    placed_again,
    square_interior,
)
from slrig.errors import PoseRefusedError
from tests.unit.calibration.boards.painted import Eye, Print, as_8_bit, board_points, looking, painted

BOARD = Board(BoardKind.CHARUCO, 7, 5, 14.0)
ODD = Board(BoardKind.CHARUCO, 7, 4, 14.0)
OLD = Print(light_first=True)


def eye(board: Board, shift_mm: tuple[float, float] = (0.0, 0.0), roll_deg: float = 12.0) -> Eye:
    return looking(board, distance_mm=205.0, tilt_deg=(20.0, -25.0), roll_deg=roll_deg, shift_mm=shift_mm)


def shot(board: Board, seen_by: Eye, look: Print) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return as_8_bit(painted(board, seen_by, look=look, samples=4, noise=0.01, seed=1))


@pytest.mark.parametrize("roll_deg", [12.0, 190.0])
def test_the_board_is_found_without_a_word(roll_deg: float) -> None:
    seen_by = eye(BOARD, roll_deg=roll_deg)
    view = find_board(shot(BOARD, seen_by, OLD), BOARD, full_scale=255)
    assert view.light_first
    assert len(view.corner) == BOARD.corner_count
    off = view.points_px - seen_by.seen(board_points(BOARD)[view.corner])
    assert np.sqrt((off**2).mean()) < 0.02
    assert np.sqrt(((off / view.sigma_px[:, None]) ** 2).mean()) < 1.35


def test_a_part_of_it_is_enough() -> None:
    seen_by = eye(BOARD, (45.0, 20.0))
    view = find_board(shot(BOARD, seen_by, OLD), BOARD, full_scale=255)
    assert view.light_first
    assert 8 <= len(view.corner) < BOARD.corner_count
    assert np.abs(view.points_px - seen_by.seen(board_points(BOARD)[view.corner])).max() < 0.06


def test_todays_layout_is_told_from_it() -> None:
    assert not find_board(shot(BOARD, eye(BOARD), Print()), BOARD, full_scale=255).light_first


def test_with_an_odd_number_of_rows_there_is_one_layout() -> None:
    assert not find_board(shot(ODD, eye(ODD), Print()), ODD, full_scale=255).light_first


@pytest.mark.parametrize("light_first", [False, True])
def test_markers_that_stand_so_in_both_layouts_are_too_little(light_first: bool) -> None:
    """All markers but those of one row are covered: a step of one square aside they are the other layout's."""
    straight = looking(BOARD, distance_mm=205.0)
    image = shot(BOARD, straight, Print(light_first=light_first))
    row = straight.seen(np.array([[0.0, 1.3 * 14, 0.0], [0.0, 2.7 * 14, 0.0]]))[:, 1].astype(int)
    image[: row[0] - 7], image[row[1] + 7 :] = 90, 90
    with pytest.raises(PoseRefusedError, match="too little of the charuco"):
        find_board(image, BOARD, full_scale=255)


def test_it_is_opencvs_own_print() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    printed = cv2.aruco.CharucoBoard((8, 6), 14.0, 10.5, dictionary)
    printed.setLegacyPattern(True)
    image = printed.generateImage((8 * 60, 6 * 60), marginSize=0)
    view = find_board(cv2.copyMakeBorder(image, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255), BOARD, full_scale=255)
    assert view.light_first
    expected = 40 + (board_points(BOARD)[view.corner, :2] / 14.0 + 1) * 60 - 0.5
    assert np.abs(view.points_px - expected).max() < 0.05


def test_what_is_paper_and_how_sharp_it_is_follow_its_own_layout() -> None:
    seen_by = eye(BOARD)
    plain = painted(BOARD, seen_by, blur_px=0.0, samples=4, look=OLD)
    image = shot(BOARD, seen_by, OLD)
    view = find_board(image, BOARD, full_scale=255)
    light = light_squares(view, BOARD, (512, 640))
    inner = square_interior(view, BOARD, (512, 640), margin_px=1.5)
    assert np.allclose(plain[inner & light], OLD.white)
    assert np.allclose(plain[inner & ~light], OLD.dark)
    assert blur_sigma_px(image, view, BOARD, full_scale=255) == pytest.approx(np.hypot(0.7, 12**-0.5), rel=0.12)
    again = placed_again(image, view, BOARD, full_scale=255)
    assert again.light_first
    assert len(again.corner) == BOARD.corner_count

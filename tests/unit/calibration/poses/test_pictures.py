"""Pictures of a calibration: what is drawn lies where it should."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.calibration.poses.coverage import coverage
from slrig.calibration.poses.pictures import coverage_picture, pose_picture
from slrig.model import Size
from tests.unit.calibration.posed_boards import CHESSBOARD, Shooting, held, two_cameras_and_projector

SIZE = Size(1280, 1024)


@pytest.fixture
def shooting() -> Shooting:
    return Shooting(CHESSBOARD, two_cameras_and_projector())


def _cell(picture: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], row: int, column: int) -> list[int]:
    """The colour of a cell: the most frequent one in it."""
    height, width = 512 / 6, 640 / 6
    part = picture[round(row * height) + 3 : round((row + 1) * height) - 3]
    part = part[:, round(column * width) + 3 : round((column + 1) * width) - 3]
    colours, counts = np.unique(part.reshape(-1, 3), axis=0, return_counts=True)
    return [int(each) for each in colours[counts.argmax()]]


def test_a_coverage_picture_fills_covered_cells_and_shows_where_to_go(shooting: Shooting) -> None:
    poses = [
        shooting.shot("pose_00", held(CHESSBOARD, middle_mm=(-60.0, -50.0, 700.0))),
        shooting.shot("pose_01", held(CHESSBOARD, tilt=(20.0, 0.0), middle_mm=(-60.0, -50.0, 700.0))),
    ]
    found = coverage(poses, CHESSBOARD, shooting.sizes).devices["left"]
    points = [pose.views["left"].points_px for pose in poses]
    plain = coverage_picture(found, points, SIZE)
    assert plain.shape == (512, 640, 3)
    assert plain.dtype == np.uint8
    for row in range(6):
        for column in range(6):
            red, green, _ = _cell(plain, row, column)
            assert (green - red > 10) == bool(found.cells[row, column]), (row, column)
    outline = np.array([[900.0, 700.0], [1200.0, 700.0], [1200.0, 900.0], [900.0, 900.0]])
    guided = coverage_picture(found, points, SIZE, outline_px=outline)
    changed = np.argwhere((guided != plain).any(axis=2))
    # Half as large as the image: the frame and its marked corner lie at half the coordinates.
    assert changed[:, 1].min() == pytest.approx(450, abs=8)
    assert changed[:, 1].max() == pytest.approx(600, abs=8)
    assert changed[:, 0].min() == pytest.approx(350, abs=8)
    assert changed[:, 0].max() == pytest.approx(450, abs=8)


@pytest.mark.parametrize("colour", [False, True])
def test_a_pose_picture_marks_the_corners_on_the_stretched_frame(shooting: Shooting, colour: bool) -> None:
    view = shooting.shot("pose_00", held(CHESSBOARD)).views["left"]
    frame = np.full(SIZE.shape, 400, dtype=np.uint16)  # of a 12-bit camera, dark
    frame[500, 600] = 4000
    image = np.repeat(frame[:, :, None], 3, axis=2) if colour else frame
    bare = pose_picture(image, None, CHESSBOARD)
    assert bare.shape == (512, 640, 3)
    assert int(np.median(bare)) == 235
    marked = pose_picture(image, view, CHESSBOARD)
    changed = np.argwhere((marked != bare).any(axis=2))[:, ::-1]
    for point in view.points_px / 2:
        assert np.abs(changed - point).max(axis=1).min() < 5
    assert changed[:, 0].min() > view.points_px[:, 0].min() / 2 - 12

"""Pictures of a calibration: what is drawn lies where it should."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.calibration.poses.coverage import coverage
from slrig.calibration.poses.pictures import coverage_picture, pose_picture, residual_picture
from slrig.calibration.solution import DeviceResiduals
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


def _residuals() -> DeviceResiduals:
    rms = np.full((6, 6), 0.1)
    rms[5, 5] = 0.4
    rms[0, 0] = np.nan
    mean = np.zeros((6, 6, 2))
    mean[2, 3] = (0.2, 0.0)
    mean[0, 0] = np.nan
    return DeviceResiduals(0.15, 0.1, 0.16, 900, 0, {}, rms, mean, np.full((6, 6), 25, dtype=np.int32))


def test_a_residual_picture_darkens_with_rms_and_draws_the_mean_as_an_arrow() -> None:
    picture = residual_picture(_residuals(), SIZE)
    assert picture.shape == (540, 640, 3)
    worst, usual, none = _cell(picture, 5, 5), _cell(picture, 1, 1), _cell(picture, 0, 0)
    assert worst[1] < usual[1] - 80
    assert none[0] == pytest.approx(none[2], abs=8)  # grey: nothing was seen there
    # The arrow of the cell at row 2, column 3, points to the right: dark along its middle, half a cell long.
    middle = picture[round(2.5 * 512 / 6), round(3 * 640 / 6) + 2 : round(4 * 640 / 6) - 2]
    dark = np.flatnonzero(middle.sum(axis=1) < 250)
    assert 30 <= dark.max() - dark.min() <= 60


def test_residuals_that_are_all_nothing_still_make_a_picture() -> None:
    nothing = DeviceResiduals(
        0.0,
        0.0,
        float("nan"),
        0,
        0,
        {},
        np.full((6, 6), np.nan),
        np.full((6, 6, 2), np.nan),
        np.zeros((6, 6), np.int32),
    )
    assert residual_picture(nothing, SIZE).shape == (540, 640, 3)


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

"""Line shift against truths small enough to write down."""

from __future__ import annotations

import numpy as np
import pytest

from slrig.errors import PatternError
from slrig.model import Axis, LineShift, Size
from slrig.patterns.line_shift import is_whole, line_count, line_position_px, line_profile


def test_rows_are_lit_for_the_row_axis() -> None:
    profile = line_profile(LineShift(Axis.ROW, 1, 4), Size(3, 6))
    assert profile.shape == (6, 1)
    assert (profile[:, 0] // 255).tolist() == [0, 1, 0, 0, 0, 1]


def test_a_wide_line_at_the_border_is_cut() -> None:
    pattern = LineShift(Axis.COLUMN, 7, 8, line_width_px=2)
    lit = np.flatnonzero(line_profile(pattern, Size(16, 1))[0])
    # The line at 7 and 8 is whole; those at −1 and 0 and at 15 and 16 are cut.
    assert lit.tolist() == [0, 7, 8, 15]
    assert is_whole([-1, 0, 1], pattern, 16).tolist() == [False, True, False]
    assert line_count(pattern, 16) == 1
    assert line_count(pattern, 17) == 2


def test_positions_are_the_mean_of_the_lit_positions() -> None:
    pattern = LineShift(Axis.COLUMN, 3, 10, line_width_px=4)
    lit = np.flatnonzero(line_profile(pattern, Size(30, 1))[0])
    assert lit.reshape(3, 4).mean(axis=1).tolist() == line_position_px([0, 1, 2], pattern).tolist()


def test_a_frame_without_a_whole_line_has_none() -> None:
    assert line_count(LineShift(Axis.COLUMN, 7, 8, line_width_px=4), 8) == 0


def test_a_projector_shorter_than_a_period_is_refused() -> None:
    with pytest.raises(PatternError, match=r"has 6 columns.*period is 8 px"):
        line_profile(LineShift(Axis.COLUMN, 0, 8), Size(6, 100))

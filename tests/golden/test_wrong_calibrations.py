"""A few cases of the campaign of wrong calibrations and sequences of `tests/bench/wrong_calibrations.py`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.wrong_calibrations import SCENES, right_case, wrong_case

pytestmark = pytest.mark.slow
CASES = 10


def test_a_surface_that_is_off_says_so(tmp_path: Path) -> None:
    """Of one scene."""
    right = right_case(3, 1, tmp_path / "right")
    wrong = [wrong_case(3, SCENES * k, tmp_path / str(k)) for k in range(CASES)]

    assert "contradict" not in right.said
    assert not right.is_off
    assert [str(each) for each in wrong if each.is_silent] == []
    # Mistakes that do not matter are not what this is about.
    assert sum(each.said != "" for each in wrong) > len(wrong) / 2

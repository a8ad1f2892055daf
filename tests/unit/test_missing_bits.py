"""Recordings that lack a fine bit: what the rest of the code is, and what is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slrig.model import Axis, Black, CameraFormat, Capture, Gray, LineShift, Pattern, Shot, Size, White
from slrig.model.missing_bits import MOST_BITS, without_missing_bits
from slrig.patterns.gray import gray_bits, gray_profile
from slrig.patterns.sequence import scan_patterns

PROJECTOR = Size(64, 48)


def recorded(*lacking: tuple[str, int], lines: bool = False, rows: bool = False) -> Capture:
    """Two cameras' frames of a scan; of each bit of the columns that is named a camera has none. Each frame tells its
    pattern and its camera.
    """
    patterns = scan_patterns(
        PROJECTOR, line_shift=lines, period_px=8, line_width_px=1, gray_cell_px=2, gray_offset_px=1, rows=rows
    )
    cameras = {name: CameraFormat(Size(3, 2), 8) for name in ("left", "right")}
    shots = [
        Shot(index, name, np.full((2, 3), index + 100 * (name == "right"), np.uint8), 0.02, 0.1 * index)
        for index, pattern in enumerate(patterns)
        for name in cameras
        if not (isinstance(pattern, Gray) and pattern.axis is Axis.COLUMN and (name, pattern.bit) in lacking)
    ]
    return Capture(PROJECTOR, patterns, cameras, tuple(shots))


def seen(capture: Capture) -> dict[tuple[str, int], Pattern]:
    """By camera and what the frame tells of itself: the pattern that it is said to show."""
    return {(shot.camera, int(shot.image[0, 0]) % 100): capture.patterns[shot.pattern] for shot in capture.shots}


@given(extent_px=st.integers(16, 400), cell_px=st.integers(1, 4), offset_px=st.integers(0, 9), cut=st.integers(1, 3))
def test_what_is_left_shows_the_same_light(extent_px: int, cell_px: int, offset_px: int, cut: int) -> None:
    bits = gray_bits(extent_px, cell_px, offset_px)
    if bits - cut < 1:
        return
    size = Size(extent_px, 4)
    for bit in range(bits - cut):
        before = Gray(Axis.COLUMN, bit, bits, cell_px, offset_px)
        after = Gray(Axis.COLUMN, bit, bits - cut, cell_px << cut, offset_px)
        np.testing.assert_array_equal(gray_profile(after, size), gray_profile(before, size))


@pytest.mark.parametrize("lacking", [(("left", 5),), (("left", 5), ("right", 5)), (("right", 4),)])
def test_finer_bits_go_with_the_missing_one_in_every_camera(lacking: tuple[tuple[str, int], ...]) -> None:
    whole, capture = recorded(), recorded(*lacking)
    kept = lacking[0][1]
    cut, (told,) = without_missing_bits(capture)
    assert f"bit {kept + 1} of the 6 of the column code" in told
    assert f"cells of {2 << 6 - kept} px instead of 2" in told
    expected = {}
    for key, pattern in seen(whole).items():
        if isinstance(pattern, Gray):
            if pattern.bit >= kept:
                continue
            pattern = Gray(Axis.COLUMN, pattern.bit, kept, 2 << (6 - kept), 1, pattern.inverted)
        expected[key] = pattern
    assert seen(cut) == expected
    assert {p.bit for p in cut.patterns if isinstance(p, Gray)} == set(range(kept))
    other = recorded(("left", 5), rows=True)
    rows = [p for p in other.patterns if isinstance(p, Gray) and p.axis is Axis.ROW]
    cut_of_both, (_,) = without_missing_bits(other)
    assert [p for p in cut_of_both.patterns if isinstance(p, Gray) and p.axis is Axis.ROW] == rows
    assert [s.time_s for s in cut.shots] == sorted(s.time_s or 0.0 for s in cut.shots)


@pytest.mark.parametrize(
    "capture",
    [
        recorded(),
        recorded(lines=True, rows=True),
        # Cells of four pixels number lines that are eight apart, and wider ones do not.
        recorded(("left", 4), lines=True),
        recorded(("left", 5 - MOST_BITS)),
        recorded(("left", 0)),
        Capture(PROJECTOR, (White(), Black(), LineShift(Axis.COLUMN, 0, 8, 1)), {}, ()),
    ],
    ids=["whole", "both axes", "lines", "too coarse", "nothing left", "no code"],
)
def test_all_else_is_left_as_it_is(capture: Capture) -> None:
    assert without_missing_bits(capture) == (capture, ())

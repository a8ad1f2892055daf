"""Defects of the rendered rig that a doctor has to find: flicker, a mirrored picture, another display, a refresh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from simulated_rig.device import SimulatedHead
from simulated_rig.light import LampFlicker
from slrig.devices import CameraSettings
from slrig.model import Axis, Black, FloatArray, LineShift, PatternSequence, Pixels, Size, White
from tests.unit.simulated_rig.building import frames_of, small_head, white_black_lines

PROJECTOR = Size(80, 60)


def taken(head: SimulatedHead, index: int, sequence: PatternSequence, *, exposure_s: float = 0.01) -> FloatArray:
    """(H, W) float64: a frame of one pattern."""
    head.cameras["eye"].configure(CameraSettings(exposure_s))
    return frames_of(head, index, sequence=sequence)[0].image.astype(np.float64)


def half(axis: Axis) -> PatternSequence:
    """White, black, and a pattern whose first half is lit: the left one, or the upper one."""
    size = PROJECTOR.along(axis)
    lit = np.where(np.arange(size) < size // 2, 255, 0).astype(np.uint8)
    profile: Pixels = lit[None] if axis is Axis.COLUMN else lit[:, None]
    full, none = np.full((1, 1), 255, np.uint8), np.zeros((1, 1), np.uint8)
    return PatternSequence(PROJECTOR, (White(), Black(), LineShift(axis, 0, 8)), (full, none, profile))


def test_flicker_averages_out_over_whole_periods() -> None:
    flicker = LampFlicker(100.0, 0.5)
    assert flicker.mean(3_000_000, 13_000_000) == pytest.approx(1.0)
    # A quarter of a period from the start of the sine, by its integral.
    assert flicker.mean(0, 2_500_000) == pytest.approx(1 + 0.5 * 2 / np.pi)
    assert flicker.mean(2_500_000, 2_500_000) == pytest.approx(1.5)


def test_the_room_and_the_projector_flicker_each_by_themselves(tmp_path: Path) -> None:
    sequence = white_black_lines(PROJECTOR)
    room = small_head(tmp_path, ambient=0.5, ambient_flicker_hz=100.0, ambient_flicker_depth=0.8)
    lamp = small_head(tmp_path, ambient=0.5, projector={"flicker_hz": 180.0, "flicker_depth": 0.8})
    for head, swings_in_black in ((room, True), (lamp, False)):
        levels = {
            index: np.array([taken(head, index, sequence, exposure_s=0.001).mean() for _ in range(12)])
            for index in (0, 1)
        }
        assert bool(np.ptp(levels[1]) > 2) is swings_in_black
        assert np.ptp(levels[0]) > 2
        steady = np.array([taken(head, 0, sequence, exposure_s=1 / 20).mean() for _ in range(6)])
        assert np.ptp(steady) < 1


def test_rows_of_a_rolling_shutter_see_flicker_at_their_own_times(tmp_path: Path) -> None:
    # 48 rows, each 0.2 ms later: one period of 100 Hz from top to bottom.
    head = small_head(
        tmp_path, camera={"line_time_s": 0.0002}, ambient=0.8, ambient_flicker_hz=100.0, ambient_flicker_depth=0.9
    )
    dark = taken(head, 1, white_black_lines(PROJECTOR), exposure_s=0.001)
    rows = dark.mean(axis=1)
    spectrum = np.abs(np.fft.rfft(rows - rows.mean()))
    assert int(np.argmax(spectrum)) == 1
    assert np.ptp(rows) > 0.5 * rows.mean()


@pytest.mark.parametrize(
    ("picture", "exchanged"),
    [
        ("upright", set()),
        ("mirrored", {Axis.COLUMN}),
        ("upside_down", {Axis.ROW}),
        ("rotated", {Axis.COLUMN, Axis.ROW}),
    ],
)
def test_a_picture_is_mirrored_or_turned_as_configured(tmp_path: Path, picture: str, exchanged: set[Axis]) -> None:
    head = small_head(tmp_path, faults={"picture": picture})
    for axis in Axis:
        image = taken(head, 2, half(axis))
        first, last = np.array_split(image, 2, axis=1 if axis is Axis.COLUMN else 0)
        assert bool(first.mean() < last.mean()) is (axis in exchanged)


def test_another_display_leaves_a_desktop_on_the_scene(tmp_path: Path) -> None:
    sequence = white_black_lines(PROJECTOR)
    head = small_head(tmp_path, faults={"other_display": True})
    white, black = (taken(head, index, sequence) for index in (0, 1))
    assert black.mean() > 20
    assert np.abs(white - black).mean() < 3
    assert np.ptp(np.median(black, axis=0)) > 20
    assert not head.projector.is_lit
    glowing = small_head(tmp_path, faults={"other_display": True, "other_display_glow": 0.1})
    white, black = (taken(glowing, index, sequence) for index in (0, 1))
    difference = white - black
    assert difference.mean() == pytest.approx(0.1 * 0.8 * 255 * 0.5, rel=0.1)
    assert np.std(difference) < 4


def test_light_comes_at_refreshes(tmp_path: Path) -> None:
    head = small_head(tmp_path, projector={"refresh_hz": 50.0})
    sequence = white_black_lines(PROJECTOR)
    head.projector.load(sequence)
    for index in range(5):
        shown = head.projector.show(index)
        assert shown.t_visible_ns % 20_000_000 == 0
        assert head.clock.now_ns() >= shown.t_visible_ns

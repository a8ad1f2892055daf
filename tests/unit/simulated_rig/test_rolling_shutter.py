"""A rendered camera's rolling shutter: when each row is exposed, and to what light."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulated_rig.device import SimulatedHead
from slrig.devices import Camera, Trigger
from slrig.errors import ConfigError
from slrig.model import FloatArray, Frame, Size
from tests.unit.simulated_rig.building import small_head, taken, white_black_lines

EXPOSURE_NS = 10_000_000
LINE_NS = 300_000
ROWS = 48
SKEW_NS = (ROWS - 1) * LINE_NS
WHITE, BLACK = 0, 1


def armed(folder: Path, trigger: Trigger = Trigger.SOFTWARE, **camera: Any) -> tuple[SimulatedHead, Camera]:
    options = {"line_time_s": LINE_NS / 1e9, "read_noise_e": 0.0, "full_well_e": 1e9, "bit_depth": 16, **camera}
    head = small_head(folder, camera=options, projector={"visible_error_s": 0.0}, ambient=0.05)
    head.projector.load(white_black_lines(Size(80, 60)))
    seen = head.cameras["eye"]
    seen.arm(10, trigger)
    return head, seen


def lit(image: np.ndarray[Any, Any]) -> FloatArray:
    """(H,) float64: brightness of each row in its middle, which the projector lights."""
    return np.asarray(image[:, 24:40].mean(axis=1, dtype=np.float64))


def test_the_times_of_a_frame_cover_every_row(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path)
    frame = taken(head, WHITE)
    assert frame.t_end_ns - frame.t_start_ns == EXPOSURE_NS + SKEW_NS
    assert frame.shutter_skew_s == pytest.approx(SKEW_NS / 1e9)
    assert frame.exposure_s == 0.01
    assert head.clock.now_ns() >= frame.t_end_ns


def test_each_row_gathers_the_light_of_its_own_exposure(tmp_path: Path) -> None:
    head, camera = armed(tmp_path)
    black, white = lit(taken(head, BLACK).image), lit(taken(head, WHITE).image)
    head.projector.show(BLACK)
    camera.trigger()
    shown = head.projector.show(WHITE)
    frame = camera.read(0, 1.0)
    # The light came 20 ms after show was called, 19.8 ms after the first row's start: that row saw only black.
    share = (lit(frame.image) - black) / (white - black)
    start_ns = frame.t_start_ns + np.arange(ROWS) * LINE_NS
    expected = np.clip((start_ns + EXPOSURE_NS - shown.t_visible_ns) / EXPOSURE_NS, 0, 1)
    assert expected[0] == 0
    assert 0 < expected[-1] < 1
    np.testing.assert_allclose(share, expected, atol=2e-3)


def test_a_change_during_the_read_out_leaves_the_upper_rows_alone(tmp_path: Path) -> None:
    head, camera = armed(tmp_path, trigger_latency_s=0.0, exposure_s=0.012)
    white = lit(taken(head, WHITE).image)
    camera.trigger()
    head.projector.blank()
    frame = camera.read(0, 1.0)
    assert lit(frame.image).max() < 0.2 * white.min()
    head.projector.show(WHITE)
    camera.trigger()
    shown = head.projector.show(BLACK)
    late = camera.read(0, 1.0)
    gone_ns = shown.t_visible_ns - late.t_start_ns
    untouched = np.arange(ROWS) * LINE_NS + 12_000_000 <= gone_ns
    assert 0 < untouched.sum() < ROWS
    np.testing.assert_allclose(lit(late.image)[untouched], white[untouched], rtol=1e-3)
    assert (lit(late.image)[~untouched][1:] < 0.999 * white[~untouched][1:]).all()


def test_steady_light_looks_as_it_does_to_a_global_shutter(tmp_path: Path) -> None:
    rolling = taken(armed(tmp_path)[0], WHITE)
    still = taken(armed(tmp_path, line_time_s=0.0)[0], WHITE)
    np.testing.assert_array_equal(rolling.image, still.image)
    assert still.shutter_skew_s == 0.0


def test_free_running_frames_leave_time_for_every_row(tmp_path: Path) -> None:
    _, camera = armed(tmp_path, Trigger.FREE, readout_s=0.001)
    first, second = camera.read(0, 1.0), camera.read(0, 1.0)
    assert second.t_start_ns - first.t_start_ns == EXPOSURE_NS + SKEW_NS + 1_000_000
    assert second.sequence_number == first.sequence_number + 1


def test_only_frames_whose_first_row_came_late_enough_are_given(tmp_path: Path) -> None:
    head, camera = armed(tmp_path, Trigger.FREE)
    for index in (WHITE, BLACK, WHITE):
        reference = lit(steady_free(head, camera, index).image)
        again = lit(steady_free(head, camera, index).image)
        np.testing.assert_allclose(again, reference, rtol=0.01, atol=30)


def steady_free(head: SimulatedHead, camera: Camera, index: int) -> Frame:
    shown = head.projector.show(index)
    frame = camera.read(shown.t_visible_ns, 1.0)
    assert frame.t_start_ns >= shown.t_visible_ns
    return frame


def test_a_line_time_below_zero_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="line_time_s"):
        small_head(tmp_path, camera={"line_time_s": -1e-6})

"""The rendered rig: brightness, noise, time and faults on demand. Its contract: `tests/contract/test_contract.py`."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulated_rig.device import SimulatedHead, SimulatedProjector
from slrig.devices import Camera, CameraSettings, Trigger
from slrig.errors import (
    DeviceGoneError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import Axis, Frame, PatternSequence, Size, White
from tests.unit.simulated_rig.building import head_options, small_head, taken, white_black_lines

SIZE = Size(80, 60)


def armed(folder: Path, trigger: Trigger = Trigger.SOFTWARE, **options: Any) -> tuple[SimulatedHead, Camera]:
    """A head with white, black and lines loaded, and its camera armed."""
    head = small_head(folder, **options)
    head.projector.load(white_black_lines(SIZE))
    camera = head.cameras["eye"]
    camera.arm(10, trigger)
    return head, camera


@pytest.mark.parametrize(("bit_depth", "full"), [(8, 255), (10, 1023), (12, 4095)])
def test_brightness_follows_exposure_up_to_saturation(tmp_path: Path, bit_depth: int, full: int) -> None:
    head = small_head(tmp_path, camera={"bit_depth": bit_depth})
    head.projector.load(white_black_lines(SIZE))
    camera = head.cameras["eye"]
    means = []
    for exposure_s in (0.004, 0.008, 0.2):
        assert camera.configure(CameraSettings(exposure_s)).exposure_s == exposure_s
        camera.arm(1, Trigger.SOFTWARE)
        means.append(float(taken(head, 0).image[20:28, 28:36].mean()))
        camera.disarm()
    assert means[1] == pytest.approx(2 * means[0], rel=0.02)
    # A plate of albedo 0.8 at the working distance; 0.02 s would saturate a white one.
    assert means[1] == pytest.approx(0.8 * 0.4 * full, rel=0.03)
    assert means[2] == full


def test_noise_repeats_with_the_seed_and_differs_between_frames(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path)
    first, second = taken(head, 0), taken(head, 0)
    again = taken(armed(tmp_path)[0], 0)
    other = taken(armed(tmp_path, seed=2)[0], 0)
    np.testing.assert_array_equal(first.image, again.image)
    assert (first.image != second.image).mean() > 0.3
    assert (first.image != other.image).mean() > 0.3
    assert abs(float(first.image.mean()) - float(second.image.mean())) < 0.2


def test_two_cameras_expose_at_the_same_time_with_noise_of_their_own(tmp_path: Path) -> None:
    eye = head_options()["camera"][0]
    head = small_head(tmp_path, cameras=[eye, eye | {"name": "twin"}])
    head.projector.load(white_black_lines(SIZE))
    for camera in head.cameras.values():
        camera.arm(1, Trigger.SOFTWARE)
    shown = head.projector.show(0)
    for camera in head.cameras.values():
        camera.trigger()
    one, two = (camera.read(shown.t_visible_ns, 1.0) for camera in head.cameras.values())
    assert (one.t_start_ns, one.t_end_ns) == (two.t_start_ns, two.t_end_ns)
    assert (one.image != two.image).mean() > 0.3


def test_sequences_that_cannot_be_shown_are_refused(tmp_path: Path) -> None:
    projector = small_head(tmp_path, projector={"max_patterns": 3}).projector
    with pytest.raises(UnsupportedByDeviceError, match="holds 3"):
        projector.load(white_black_lines(SIZE))
    picture = PatternSequence(SIZE, (White(),), (np.eye(60, 80, dtype=np.uint8),))
    with pytest.raises(UnsupportedByDeviceError, match="both axes"):
        projector.load(picture)


def test_the_projector_is_dark_unless_it_shows(tmp_path: Path) -> None:
    projector = small_head(tmp_path).projector
    assert not projector.is_lit
    projector.load(white_black_lines(SIZE))
    assert not projector.is_lit
    for ending in (projector.blank, projector.stop, lambda: projector.load(white_black_lines(SIZE)), projector.close):
        projector.show(0)
        assert (projector.is_lit, projector.shown_pattern) == (True, 0)
        ending()
        assert (projector.is_lit, projector.shown_pattern) == (False, None)


def test_a_black_pattern_is_not_lit(tmp_path: Path) -> None:
    projector = small_head(tmp_path).projector
    projector.load(white_black_lines(SIZE))
    projector.show(1)
    assert (projector.is_lit, projector.shown_pattern) == (False, 1)
    with pytest.raises(UnsupportedByDeviceError, match="0 to 9"):
        projector.show(10)


def test_a_frame_in_flight_when_the_pattern_changes_sees_both(tmp_path: Path) -> None:
    head, camera = armed(tmp_path, projector={"latency_s": 0.005, "visible_error_s": 0.0})
    full = taken(head, 0).image.mean(dtype=np.float64)
    dark = taken(head, 1).image.mean(dtype=np.float64)
    camera.trigger()
    shown = head.projector.show(0)
    frame = camera.read(0, 1.0)
    assert frame.t_start_ns < shown.t_visible_ns < frame.t_end_ns
    lit = (frame.t_end_ns - shown.t_visible_ns) / 10_000_000
    assert frame.image.mean(dtype=np.float64) == pytest.approx(dark + lit * (full - dark), abs=0.3)


def test_waiting_for_no_frame_takes_the_timeout_of_virtual_time(tmp_path: Path) -> None:
    head, camera = armed(tmp_path)
    before = head.clock.now_ns()
    with pytest.raises(FrameTimeoutError, match="trigger again"):
        camera.read(0, 3600.0)
    assert head.clock.now_ns() - before == 3600 * 10**9


def test_a_free_running_camera_left_alone_keeps_only_its_last_buffers(tmp_path: Path) -> None:
    head, camera = armed(tmp_path, Trigger.FREE, camera={"period_s": 0.1, "buffers": 3})
    began = head.clock.now_ns()
    head.clock.wait_until(began + 2_050_000_000, threading.Event())
    old = camera.read(0, 1.0)
    # 2.05 s hold 21 starts, the last of them (at 2.0 s) finished: frames 18, 19 and 20 are kept.
    assert old.sequence_number == 18
    assert old.dropped_count == 18
    assert old.t_start_ns == began + 1_800_000_000
    assert [camera.read(0, 1.0).sequence_number for _ in range(4)] == [19, 20, 21, 22]


def test_real_time_frames_carry_the_monotonic_clock(tmp_path: Path) -> None:
    quick = {"exposure_s": 0.001, "readout_s": 0.0005, "saturation_s": 0.002}
    head, _camera = armed(tmp_path, realtime=True, camera=quick, projector={"latency_s": 0.001})
    before = head.clock.now_ns()
    frame = taken(head, 0)
    assert before < frame.t_start_ns < frame.t_end_ns <= head.clock.now_ns()
    assert frame.image.mean() > 20


def test_a_dropped_frame_is_missed_counted_and_leaves_a_gap(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path, faults={"drop_frames": [1]})
    assert taken(head, 0).dropped_count == 0
    with pytest.raises(FrameTimeoutError, match="1 lost"):
        taken(head, 1)
    again = taken(head, 1)
    assert (again.sequence_number, again.dropped_count) == (2, 1)


def test_frames_drop_with_the_configured_probability(tmp_path: Path) -> None:
    _, camera = armed(tmp_path, Trigger.FREE, faults={"drop_probability": 0.3})
    for _ in range(140):
        last = camera.read(0, 10.0)
    assert last.dropped_count == last.sequence_number + 1 - 140
    assert last.dropped_count / (last.sequence_number + 1) == pytest.approx(0.3, abs=0.1)


def test_a_late_frame_times_out_and_comes_with_the_next_read(tmp_path: Path) -> None:
    head, camera = armed(tmp_path, faults={"late_frames": [0], "late_s": 0.7})
    shown = head.projector.show(0)
    camera.trigger()
    with pytest.raises(FrameTimeoutError):
        camera.read(shown.t_visible_ns, 0.5)
    late = camera.read(shown.t_visible_ns, 0.5)
    assert late.sequence_number == 0
    assert late.image.mean() > 20


def test_a_stale_frame_has_the_old_image_under_new_times(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path, faults={"stale_frames": [1]})
    white, stale, line = (taken(head, index) for index in (0, 2, 2))
    np.testing.assert_array_equal(stale.image, white.image)
    assert stale.t_start_ns > white.t_end_ns
    assert stale.sequence_number == 1
    assert line.image.mean() < 0.8 * white.image.mean()


def test_a_corrupt_frame_has_garbled_rows_and_sound_ones(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path, faults={"corrupt_frames": [1]})
    sound, corrupt = taken(head, 1), taken(head, 1)
    assert corrupt.image[16:32].std() > 50
    assert corrupt.image[:16].std() < 3
    assert corrupt.image[32:].std() < 3
    assert sound.image.std() < 3


@pytest.mark.parametrize("trigger", [Trigger.SOFTWARE, Trigger.FREE])
def test_an_unplugged_camera_is_gone_from_that_frame_on(tmp_path: Path, trigger: Trigger) -> None:
    _, camera = armed(tmp_path, trigger, faults={"unplug_camera_at_frame": 2})

    def frame() -> Frame:
        if trigger is Trigger.SOFTWARE:
            camera.trigger()
        return camera.read(0, 1.0)

    assert [frame().sequence_number for _ in range(2)] == [0, 1]
    for _ in range(2):
        with pytest.raises(DeviceGoneError, match="gone"):
            frame()
    with pytest.raises(DeviceGoneError):
        camera.configure(CameraSettings(0.01))
    with pytest.raises(DeviceGoneError):
        camera.arm(1, trigger)
    camera.disarm()
    camera.close()
    camera.close()


def test_an_unplugged_projector_is_dark_and_gone(tmp_path: Path) -> None:
    projector = small_head(tmp_path, faults={"unplug_projector_at_show": 1}).projector
    projector.load(white_black_lines(SIZE))
    projector.show(0)
    for _ in range(2):
        with pytest.raises(DeviceGoneError, match="gone"):
            projector.show(0)
    assert not projector.is_lit
    with pytest.raises(DeviceGoneError):
        projector.blank()
    projector.close()
    projector.close()


def test_faults_befall_only_the_cameras_they_name(tmp_path: Path) -> None:
    eye = head_options()["camera"][0]
    faults = {"unplug_camera_at_frame": 0, "cameras": ["twin"]}
    head = small_head(tmp_path, cameras=[eye, eye | {"name": "twin"}], faults=faults)
    for camera in head.cameras.values():
        camera.arm(1, Trigger.FREE)
    assert head.cameras["eye"].read(0, 1.0).sequence_number == 0
    with pytest.raises(DeviceGoneError, match="'twin'"):
        head.cameras["twin"].read(0, 1.0)


def test_a_lamp_that_is_off_lights_nothing(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path, faults={"lamp_off": True})
    assert taken(head, 0).image.mean() < 1
    assert not head.projector.is_lit


def test_light_later_than_reported_gives_the_pattern_before(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path, faults={"light_delay_s": 0.5})
    frame = taken(head, 0)
    assert frame.image.mean() < 3
    assert head.projector.shown_pattern == 0
    assert not head.projector.is_lit


def test_the_light_comes_within_the_stated_error(tmp_path: Path) -> None:
    projector = small_head(tmp_path, projector={"visible_error_s": 0.004, "latency_s": 0.01}).projector
    assert isinstance(projector, SimulatedProjector)
    projector.load(white_black_lines(SIZE))
    offsets = []
    for index in [0, 1] * 10:
        shown = projector.show(index)
        changed = projector.lamp._changes[-1][0]
        offsets.append(changed - shown.t_visible_ns)
        assert shown.t_err_ns == 4_000_000
    assert np.abs(offsets).max() <= 4_000_000
    assert np.std(offsets) > 1_000_000


def test_row_patterns_are_shown_along_rows(tmp_path: Path) -> None:
    head, _camera = armed(tmp_path)
    profile = np.where(np.arange(60) < 30, 255, 0).astype(np.uint8)[:, None]
    head.projector.load(PatternSequence(SIZE, (White(),), (profile,)))
    image = taken(head, 0).image.astype(np.float64)
    assert SIZE.along(Axis.ROW) == 60
    assert image[:18].mean() > 40
    assert image[30:].mean() < 2


def test_exposure_that_creeps_gives_each_frame_more_light_than_the_one_before(tmp_path: Path) -> None:
    head, camera = armed(tmp_path, camera={"exposure_drift": 0.02, "bit_depth": 12})
    first, *others = [float(taken(head, 0).image[20:28, 28:36].mean()) for _ in range(6)]
    assert others[-1] / first == pytest.approx(1.02**5, rel=0.01)
    camera.disarm()
    camera.arm(10, Trigger.SOFTWARE)
    assert float(taken(head, 0).image[20:28, 28:36].mean()) == pytest.approx(first, rel=0.01)


def test_automatic_exposure_steps_at_its_frames(tmp_path: Path) -> None:
    faults = {"exposure_step_frames": [2, 4], "exposure_step": 0.8}
    head, _camera = armed(tmp_path, camera={"bit_depth": 12}, faults=faults)
    means = [float(taken(head, 0).image[20:28, 28:36].mean()) for _ in range(5)]
    np.testing.assert_allclose(np.array(means) / means[0], [1, 1, 0.8, 0.8, 0.64], rtol=0.01)

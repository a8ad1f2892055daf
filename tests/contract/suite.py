"""The contract of cameras and projectors, as checks that hold for every driver.

A check takes a bench: a way to open the instrument afresh, and a sequence that it can show. It knows no driver.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest

from slrig.capture.evidence import Evidence
from slrig.capture.sequencer import capture
from slrig.devices import Camera, CameraSettings, Head, Projector, Rig, Trigger
from slrig.errors import (
    DeviceStateError,
    FrameTimeoutError,
    ScanCancelledError,
    UnsupportedByDeviceError,
)
from slrig.model import Frame, PatternSequence, Size
from slrig.patterns.sequence import encode

SHORT_S = 0.05
LONG_S = 5.0


@dataclass(frozen=True)
class Bench:
    """A driver under test. `open_head` opens the instrument afresh; `sequence` begins with white, then black."""

    open_head: Callable[[], Head]
    sequence: PatternSequence

    @contextmanager
    def head(self) -> Iterator[Head]:
        head = self.open_head()
        try:
            yield head
        finally:
            close(head)

    @contextmanager
    def loaded(self) -> Iterator[tuple[Head, Projector, Camera]]:
        """The head with its sequence loaded and its first camera configured and armed for software triggers."""
        with self.head() as head:
            camera = next(iter(head.cameras.values()))
            camera.configure(usual(camera))
            head.projector.load(self.sequence)
            camera.arm(len(self.sequence), Trigger.SOFTWARE)
            yield head, head.projector, camera


def close(head: Head) -> None:
    head.projector.close()
    for camera in head.cameras.values():
        camera.close()


def usual(camera: Camera) -> CameraSettings:
    low_s, high_s = camera.info.exposure_range_s
    least, most = camera.info.gain_range
    return CameraSettings(min(max(1 / 60, low_s), high_s), min(max(1.0, least), most))


def rig_of(head: Head) -> Rig:
    settings = {name: usual(camera) for name, camera in head.cameras.items()}
    return Rig("bench", head.cameras, head.projector, settings, head.calibration, head)


def expose(projector: Projector, camera: Camera, index: int) -> Frame:
    shown = projector.show(index)
    camera.trigger()
    return camera.read(shown.t_visible_ns + shown.t_err_ns, LONG_S)


def brightness_now(camera: Camera) -> float:
    """Mean of a frame that is triggered now, whatever is shown."""
    camera.trigger()
    return float(np.mean(camera.read(0, LONG_S).image))


# ---- what is declared


def check_protocols(bench: Bench) -> None:
    with bench.head() as head:
        assert isinstance(head, Head)
        assert isinstance(head.projector, Projector)
        assert head.cameras
        for name, camera in head.cameras.items():
            assert isinstance(camera, Camera)
            assert camera.info.name == name


def check_info_is_readable_in_every_state(bench: Bench) -> None:
    with bench.loaded() as (head, projector, camera):
        before = (projector.info, camera.info)
        low_s, high_s = camera.info.exposure_range_s
        assert 0 < low_s <= high_s
        assert camera.info.gain_range[0] <= camera.info.gain_range[1]
        assert camera.info.triggers
        projector.show(0)
        assert (projector.info, camera.info) == before
        close(head)
        assert (projector.info, camera.info) == before


def check_calibration_and_truth_fit_the_devices(bench: Bench) -> None:
    with bench.head() as head:
        calibration = head.calibration
        if calibration is not None:
            assert {n: p.size for n, p in calibration.cameras.items()} == {
                n: c.info.format.size for n, c in head.cameras.items()
            }
            assert calibration.projector is None or calibration.projector.size == head.projector.info.size
        truth = head.truth()
        if truth is not None:
            assert {n: t.depth_mm.shape for n, t in truth.cameras.items()} == {
                n: c.info.format.size.shape for n, c in head.cameras.items()
            }


# ---- frames


def check_frames_are_as_declared(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        form = camera.info.format
        asked = usual(camera)
        numbers: list[int] = []
        ends: list[int] = []
        for index in range(len(bench.sequence)):
            frame = expose(projector, camera, index)
            assert frame.camera == camera.info.name
            assert frame.image.shape == form.size.shape
            assert frame.image.dtype == (np.uint8 if form.bit_depth <= 8 else np.uint16)
            assert frame.image.max() <= form.full_scale
            assert frame.exposure_s == pytest.approx(asked.exposure_s, rel=0.01)
            assert (frame.t_end_ns - frame.t_start_ns) / 1e9 == pytest.approx(frame.exposure_s, rel=0.01)
            assert frame.t_err_ns >= 0
            assert not ends or frame.t_start_ns >= ends[-1]
            numbers.append(frame.sequence_number)
            ends.append(frame.t_end_ns)
        assert all(np.diff(numbers) > 0)


def check_a_frame_lies_wholly_in_its_pattern(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        white, black = expose(projector, camera, 0), expose(projector, camera, 1)
        again = expose(projector, camera, 0)
        lit = float(np.mean(white.image))
        assert lit > float(np.mean(black.image)) + 1
        assert float(np.mean(again.image)) == pytest.approx(lit, rel=0.05)


def check_read_passes_over_stale_frames(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        projector.show(0)
        camera.trigger()
        shown = projector.show(1)
        camera.trigger()
        after_ns = shown.t_visible_ns + shown.t_err_ns
        frame = camera.read(after_ns, LONG_S)
        assert frame.t_start_ns >= after_ns
        white = expose(projector, camera, 0)
        assert float(np.mean(frame.image)) < float(np.mean(white.image)) - 1


def check_stale_frames_never_come_back(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        shown = projector.show(0)
        camera.trigger()
        with pytest.raises(FrameTimeoutError):
            camera.read(shown.t_visible_ns + 10**12, SHORT_S)
        with pytest.raises(FrameTimeoutError):
            camera.read(0, SHORT_S)
        assert expose(projector, camera, 0).image.size


def check_read_without_trigger_times_out_in_time(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        projector.show(0)
        begun = time.monotonic()
        with pytest.raises(FrameTimeoutError):
            camera.read(0, SHORT_S)
        assert time.monotonic() - begun < SHORT_S + 2


def check_a_free_running_camera_needs_no_trigger(bench: Bench) -> None:
    with bench.head() as head:
        camera = next(iter(head.cameras.values()))
        camera.configure(usual(camera))
        head.projector.load(bench.sequence)
        if Trigger.FREE not in camera.info.triggers:
            with pytest.raises(UnsupportedByDeviceError):
                camera.arm(1, Trigger.FREE)
            return
        camera.arm(2, Trigger.FREE)
        with pytest.raises(DeviceStateError):
            camera.trigger()
        frames = []
        for index in (0, 1):
            shown = head.projector.show(index)
            after_ns = shown.t_visible_ns + shown.t_err_ns
            frames.append(camera.read(after_ns, LONG_S))
            assert frames[-1].t_start_ns >= after_ns
        assert frames[1].sequence_number > frames[0].sequence_number
        assert float(np.mean(frames[0].image)) > float(np.mean(frames[1].image)) + 1


# ---- settings and states


def check_settings_are_read_back(bench: Bench) -> None:
    with bench.head() as head:
        for camera in head.cameras.values():
            for exposure_s in camera.info.exposure_range_s:
                asked = CameraSettings(exposure_s, usual(camera).gain)
                applied = camera.configure(asked)
                assert applied.exposure_s == pytest.approx(exposure_s, rel=0.01)
                assert applied.gain == pytest.approx(asked.gain, rel=0.01)


def check_settings_out_of_range_are_refused(bench: Bench) -> None:
    with bench.head() as head:
        for camera in head.cameras.values():
            fine = usual(camera)
            low_s, high_s = camera.info.exposure_range_s
            for exposure_s, gain in (
                (low_s / 2, fine.gain),
                (high_s * 2, fine.gain),
                (fine.exposure_s, camera.info.gain_range[1] * 2),
            ):
                with pytest.raises(UnsupportedByDeviceError):
                    camera.configure(CameraSettings(exposure_s, gain))
            assert camera.configure(fine).exposure_s == pytest.approx(fine.exposure_s, rel=0.01)


def check_an_armed_camera_refuses_to_be_set_or_armed(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        with pytest.raises(DeviceStateError):
            camera.configure(usual(camera))
        with pytest.raises(DeviceStateError):
            camera.arm(1, Trigger.SOFTWARE)
        assert expose(projector, camera, 0).image.size


def check_triggers_that_are_not_declared_are_refused(bench: Bench) -> None:
    with bench.head() as head:
        for camera in head.cameras.values():
            for trigger in set(Trigger) - camera.info.triggers:
                with pytest.raises(UnsupportedByDeviceError):
                    camera.arm(1, trigger)
            with pytest.raises(UnsupportedByDeviceError):
                camera.arm(0, next(iter(camera.info.triggers)))


def check_trigger_and_read_need_an_armed_camera(bench: Bench) -> None:
    with bench.head() as head:
        camera = next(iter(head.cameras.values()))
        with pytest.raises(DeviceStateError):
            camera.trigger()
        with pytest.raises(DeviceStateError):
            camera.read(0, SHORT_S)
    with bench.loaded() as (_, projector, camera):
        projector.show(0)
        camera.trigger()
        camera.disarm()
        with pytest.raises(DeviceStateError):
            camera.trigger()
        with pytest.raises(DeviceStateError):
            camera.read(0, SHORT_S)


def check_arming_again_starts_afresh(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        projector.show(0)
        camera.trigger()
        camera.disarm()
        camera.arm(1, Trigger.SOFTWARE)
        with pytest.raises(FrameTimeoutError):
            camera.read(0, SHORT_S)
        assert expose(projector, camera, 0).dropped_count == 0


def check_show_needs_a_loaded_sequence(bench: Bench) -> None:
    with bench.head() as head:
        with pytest.raises(DeviceStateError):
            head.projector.show(0)
        head.projector.load(bench.sequence)
        for index in (-1, len(bench.sequence)):
            with pytest.raises(UnsupportedByDeviceError):
                head.projector.show(index)
        first, second = head.projector.show(0), head.projector.show(1)
        assert (first.index, second.index) == (0, 1)
        assert first.t_visible_ns < second.t_visible_ns
        assert first.t_err_ns >= 0


def check_a_sequence_of_another_size_is_refused(bench: Bench) -> None:
    with bench.head() as head:
        size = head.projector.info.size
        other = Size(size.width_px + 8, size.height_px)
        with pytest.raises(UnsupportedByDeviceError, match=str(size)):
            head.projector.load(encode(bench.sequence.patterns[:2], other))
        with pytest.raises(DeviceStateError):
            head.projector.show(0)


def check_a_projector_plays_only_if_it_says_so(bench: Bench) -> None:
    with bench.head() as head:
        head.projector.load(bench.sequence)
        if head.projector.info.plays:
            head.projector.play(0.01, 0.02)
        else:
            with pytest.raises(UnsupportedByDeviceError):
                head.projector.play(0.01, 0.02)
        head.projector.stop()


# ---- ways out


def check_the_way_out_may_be_taken_twice(bench: Bench) -> None:
    with bench.loaded() as (head, projector, camera):
        projector.show(0)
        camera.trigger()
        for _ in range(2):
            camera.disarm()
            projector.stop()
            projector.blank()
        for _ in range(2):
            close(head)
        camera.disarm()
        projector.stop()
        projector.blank()


def check_nothing_works_after_close(bench: Bench) -> None:
    with bench.loaded() as (head, projector, camera):
        close(head)
        for call in (
            lambda: camera.configure(usual(camera)),
            lambda: camera.arm(1, Trigger.SOFTWARE),
            camera.trigger,
            lambda: camera.read(0, SHORT_S),
            lambda: projector.load(bench.sequence),
            lambda: projector.show(0),
            lambda: projector.play(0.01, 0.02),
        ):
            with pytest.raises(DeviceStateError):
                call()


def check_the_projector_is_dark_unless_it_shows(bench: Bench) -> None:
    with bench.loaded() as (_, projector, camera):
        dark = [brightness_now(camera)]
        lit = float(np.mean(expose(projector, camera, 0).image))
        projector.blank()
        dark.append(brightness_now(camera))
        projector.show(0)
        projector.stop()
        dark.append(brightness_now(camera))
        projector.show(0)
        projector.load(bench.sequence)
        dark.append(brightness_now(camera))
        black = float(np.mean(expose(projector, camera, 1).image))
        assert max(dark) < black + 0.1 * (lit - black)


def check_every_end_of_a_capture_is_dark_and_leaves_the_rig_usable(bench: Bench) -> None:
    with bench.head() as head:
        rig = rig_of(head)
        camera = next(iter(head.cameras.values()))

        def assert_dark() -> None:
            camera.arm(2, Trigger.SOFTWARE)
            left_behind = brightness_now(camera)
            lit = float(np.mean(expose(head.projector, camera, 0).image))
            black = float(np.mean(expose(head.projector, camera, 1).image))
            camera.disarm()
            head.projector.blank()
            assert left_behind < black + 0.1 * (lit - black)

        frames = capture(rig, bench.sequence)
        next(frames)
        del frames
        assert_dark()
        asked = iter([False] * 5 + [True])
        with pytest.raises(ScanCancelledError):
            list(capture(rig, bench.sequence, cancelled=lambda: next(asked)))
        assert_dark()
        list(capture(rig, bench.sequence))
        assert_dark()


def check_a_whole_sequence_is_proven(bench: Bench) -> None:
    with bench.head() as head:
        formats = {name: camera.info.format for name, camera in head.cameras.items()}
        evidence = Evidence(bench.sequence.patterns, formats)
        shots = list(capture(rig_of(head), bench.sequence, evidence=evidence))
        assert [(shot.pattern, shot.camera) for shot in shots] == [
            (index, name) for index in range(len(bench.sequence)) for name in head.cameras
        ]
        times_s = [shot.time_s or 0.0 for shot in shots]
        assert times_s[0] == 0
        assert all(np.diff(times_s[:: len(head.cameras)]) > 0)
        assert evidence.summary().verified == len(bench.sequence)


CHECKS: dict[str, Callable[[Bench], None]] = {
    name.removeprefix("check_"): check for name, check in list(globals().items()) if name.startswith("check_")
}

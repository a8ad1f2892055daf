"""A recorded bundle as a rig: which frame is delivered when, and what is said when there is none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from drivers.replay import open_head
from slrig.bundle import write_bundle
from slrig.devices import CameraSettings, Head, Trigger
from slrig.errors import BundleError, ConfigError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Axis, Black, CameraFormat, Capture, Gray, Pattern, Shot, Size, White
from slrig.patterns.sequence import encode

PROJECTOR = Size(16, 8)
CAMERA = Size(6, 4)
BIT = Gray(Axis.COLUMN, 0, 4)


def shot(
    pattern: int, value: int, *, camera: str = "eye", exposure_s: float | None = 0.02, time_s: float | None = None
) -> Shot:
    return Shot(pattern, camera, np.full(CAMERA.shape, value, np.uint8), exposure_s, time_s)


def head_of(
    folder: Path,
    shots: Sequence[Shot],
    patterns: Sequence[Pattern] = (White(), Black(), BIT),
    cameras: Sequence[str] = ("eye",),
) -> Head:
    formats = {name: CameraFormat(CAMERA, 8) for name in cameras}
    write_bundle(folder / "rec", Capture(PROJECTOR, tuple(patterns), formats, tuple(shots)))
    return open_head({"bundle": "rec"}, folder)


def values(head: Head, patterns: Sequence[Pattern], *, exposure_s: float = 0.02) -> list[int]:
    """Play a sequence; return the value of each frame."""
    camera = head.cameras["eye"]
    camera.configure(CameraSettings(exposure_s))
    head.projector.load(encode(patterns, PROJECTOR))
    camera.arm(len(patterns), Trigger.SOFTWARE)
    seen = []
    for index in range(len(patterns)):
        shown = head.projector.show(index)
        camera.trigger()
        seen.append(int(camera.read(shown.t_visible_ns, 1.0).image[0, 0]))
    camera.disarm()
    return seen


BASIC = [shot(0, 200), shot(1, 10), shot(2, 90)]


def test_frames_follow_the_pattern_that_is_shown_and_not_the_order_of_the_recording(tmp_path: Path) -> None:
    assert values(head_of(tmp_path, BASIC), [BIT, Black(), White()]) == [90, 10, 200]


def test_a_pattern_that_was_recorded_once_looks_the_same_every_time(tmp_path: Path) -> None:
    head = head_of(tmp_path, BASIC)
    assert values(head, [White(), Black(), BIT, White(), Black()]) == [200, 10, 90, 200, 10]
    assert values(head, [White()]) == [200]


def test_the_second_showing_gives_the_second_recording(tmp_path: Path) -> None:
    head = head_of(tmp_path, [*BASIC, shot(3, 190), shot(4, 12)], [White(), Black(), BIT, White(), Black()])
    assert values(head, [White(), Black(), BIT, White(), Black()]) == [200, 10, 90, 190, 12]


def test_the_exposure_chooses_among_a_bracket(tmp_path: Path) -> None:
    head = head_of(tmp_path, [*BASIC, shot(2, 180, exposure_s=0.04)])
    assert head.cameras["eye"].info.exposure_range_s == (0.02, 0.04)
    assert values(head, [BIT]) == [90]
    assert values(head, [BIT], exposure_s=0.0401) == [180]
    # White was recorded at one exposure only; there is no other to give.
    assert values(head, [White()], exposure_s=0.04) == [200]


def test_an_exposure_that_was_not_recorded_is_refused_with_those_that_were(tmp_path: Path) -> None:
    head = head_of(tmp_path, [*BASIC, shot(2, 180, exposure_s=0.04)])
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure of 0.03 s.*0.02 s, 0.04 s"):
        head.cameras["eye"].configure(CameraSettings(0.03))
    with pytest.raises(UnsupportedByDeviceError, match="gain 2"):
        head.cameras["eye"].configure(CameraSettings(0.02, gain=2))


def test_a_recording_without_exposures_takes_any(tmp_path: Path) -> None:
    head = head_of(tmp_path, [shot(0, 200, exposure_s=None)])
    assert head.cameras["eye"].configure(CameraSettings(0.123)).exposure_s == 0.123


def test_recorded_times_are_kept(tmp_path: Path) -> None:
    head = head_of(tmp_path, [shot(0, 200, time_s=0.0), shot(1, 10, time_s=0.5), shot(2, 90, time_s=1.25)])
    camera = head.cameras["eye"]
    head.projector.load(encode([White(), Black(), BIT], PROJECTOR))
    camera.arm(3, Trigger.SOFTWARE)
    starts = []
    for index in range(3):
        after_ns = head.projector.show(index).t_visible_ns
        camera.trigger()
        starts.append(camera.read(after_ns, 1.0).t_start_ns)
    assert np.diff(starts) / 1e9 == pytest.approx([0.5, 0.75], abs=1e-4)


def test_time_goes_on_when_the_recording_is_played_in_another_order(tmp_path: Path) -> None:
    head = head_of(tmp_path, [shot(0, 200, time_s=0.0), shot(1, 10, time_s=0.5), shot(2, 90, time_s=1.25)])
    assert values(head, [BIT, White(), Black()]) == [90, 200, 10]


def test_two_cameras_are_exposed_together(tmp_path: Path) -> None:
    shots = [shot(0, 200, time_s=0.1), shot(0, 150, camera="other", time_s=0.1)]
    head = head_of(tmp_path, shots, cameras=["eye", "other"])
    head.projector.load(encode([White()], PROJECTOR))
    for camera in head.cameras.values():
        camera.arm(1, Trigger.SOFTWARE)
    after_ns = head.projector.show(0).t_visible_ns
    for camera in head.cameras.values():
        camera.trigger()
    frames = [camera.read(after_ns, 1.0) for camera in head.cameras.values()]
    assert [int(frame.image[0, 0]) for frame in frames] == [200, 150]
    assert frames[0].t_start_ns == frames[1].t_start_ns


def test_a_pattern_that_was_not_recorded_is_named_with_those_that_were(tmp_path: Path) -> None:
    head = head_of(tmp_path, BASIC)
    with pytest.raises(
        UnsupportedByDeviceError,
        match=r"no frame of bit 1 of a column Gray code of 4 bits.*has white; black; a column Gray",
    ):
        head.projector.load(encode([White(), Gray(Axis.COLUMN, 1, 4)], PROJECTOR))


def test_a_pattern_that_one_camera_lacks_names_the_camera(tmp_path: Path) -> None:
    head = head_of(tmp_path, [*BASIC, shot(0, 100, camera="other")], cameras=["eye", "other"])
    with pytest.raises(UnsupportedByDeviceError, match="from camera other"):
        head.projector.load(encode([White(), Black()], PROJECTOR))


def test_darkness_looks_as_it_was_recorded_and_is_not_made_up(tmp_path: Path) -> None:
    head = head_of(tmp_path, BASIC)
    camera = head.cameras["eye"]
    camera.arm(1, Trigger.SOFTWARE)
    camera.trigger()
    assert camera.read(0, 1.0).image[0, 0] == 10
    (tmp_path / "lit").mkdir()
    lit_only = head_of(tmp_path / "lit", [shot(0, 200)], [White()]).cameras["eye"]
    lit_only.arm(1, Trigger.SOFTWARE)
    with pytest.raises(DeviceStateError, match="no black frame"):
        lit_only.trigger()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "bundle: missing"),
        ({"bundle": 3}, "bundle: .*string"),
        ({"bundle": "rec", "folder": "x", "speed": 2}, r"(?s)folder: unknown key.*speed: unknown key"),
        ({"bundle": "nowhere"}, "nowhere is no scan bundle"),
    ],
)
def test_options_are_checked(tmp_path: Path, options: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        open_head(options, tmp_path)


def test_a_damaged_bundle_is_told(tmp_path: Path) -> None:
    head_of(tmp_path, BASIC)
    frame = next((tmp_path / "rec" / "frames").rglob("*.png"))
    frame.write_bytes(frame.read_bytes()[:40])
    with pytest.raises(BundleError, match=frame.name):
        open_head({"bundle": "rec"}, tmp_path)


def test_a_recording_knows_no_truth_and_no_calibration_unless_it_has_one(tmp_path: Path) -> None:
    head = head_of(tmp_path, BASIC)
    assert head.truth() is None
    assert head.calibration is None

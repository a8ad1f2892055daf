"""A recorded bundle as a rig: which frame is delivered when, and what is said when there is none."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from drivers.replay import ReplayClock, ReplayHead, open_head
from slrig.bundle import read_bundle, write_bundle
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, DisplayedPattern, Rig, ScannerHead, Trigger
from slrig.errors import ConfigError, DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import (
    Axis,
    Black,
    CameraFormat,
    Capture,
    Frame,
    Gray,
    LineShift,
    Pattern,
    SequenceName,
    Shot,
    Size,
    White,
)
from slrig.patterns.sequence import encode
from slrig.scan.plan import PatternPlan, pattern_sequence

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
) -> ScannerHead:
    formats = {name: CameraFormat(CAMERA, 8) for name in cameras}
    write_bundle(folder / "rec", Capture(PROJECTOR, tuple(patterns), formats, tuple(shots)))
    return open_head({"bundle": "rec"}, folder)


class RealTime:
    """A clock to pace a replay by, ns, that moves when it is waited for."""

    now_ns = 5_000_000_000
    waits = 0

    def read_ns(self) -> int:
        return self.now_ns

    def wait(self, seconds: float) -> None:
        self.waits += 1
        self.now_ns += round(seconds * 1e9)


def paced_head(folder: Path, shots: Sequence[Shot], speed: float, real: RealTime) -> ScannerHead:
    head_of(folder, shots)
    return ReplayHead(read_bundle(folder / "rec"), ReplayClock(speed, real_ns=real.read_ns, wait=real.wait))


def frames(
    head: ScannerHead, patterns: Sequence[Pattern], *, exposure_s: float = 0.02
) -> Iterator[tuple[DisplayedPattern, Frame]]:
    """Play a sequence; give each pattern's light and frame."""
    camera = head.cameras["eye"]
    camera.configure(CameraSettings(exposure_s))
    head.projector.load(encode(patterns, PROJECTOR))
    camera.arm(len(patterns), Trigger.SOFTWARE)
    for index in range(len(patterns)):
        shown = head.projector.show(index)
        camera.trigger()
        yield shown, camera.read(shown.t_visible_ns, 1.0)
    camera.disarm()


def values(head: ScannerHead, patterns: Sequence[Pattern], *, exposure_s: float = 0.02) -> list[int]:
    return [int(frame.image[0, 0]) for _, frame in frames(head, patterns, exposure_s=exposure_s)]


BASIC = [shot(0, 200), shot(1, 10), shot(2, 90)]
TIMED = [shot(0, 200, time_s=0.0), shot(1, 10, time_s=0.123456789), shot(2, 90, time_s=1.25)]


FIVE: list[Pattern] = [White(), Black(), BIT, White(), Black()]


@pytest.mark.parametrize(
    ("recorded", "patterns", "shown", "expected"),
    [
        # By the pattern, not in the order of the recording, whose times go on all the same.
        (BASIC, FIVE[:3], [BIT, Black(), White()], [90, 10, 200]),
        (TIMED, FIVE[:3], [BIT, White(), Black()], [90, 200, 10]),
        # What was recorded once looks the same every time; the second showing gives the second recording.
        (BASIC, FIVE[:3], FIVE, [200, 10, 90, 200, 10]),
        ([*BASIC, shot(3, 190), shot(4, 12)], FIVE, FIVE, [200, 10, 90, 190, 12]),
    ],
)
def test_showing_a_pattern_gives_its_frame(
    tmp_path: Path, recorded: list[Shot], patterns: list[Pattern], shown: list[Pattern], expected: list[int]
) -> None:
    head = head_of(tmp_path, recorded, patterns)
    assert values(head, shown) == expected
    assert values(head, shown[:1]) == expected[:1]


def test_the_exposure_chooses_among_a_bracket_and_a_frame_says_its_own(tmp_path: Path) -> None:
    head = head_of(tmp_path, [*BASIC, shot(2, 180, exposure_s=0.04)])
    camera = head.cameras["eye"]
    assert camera.info.exposure_range_s == (0.02, 0.04)
    assert values(head, [BIT]) == [90]
    assert values(head, [BIT], exposure_s=0.0401) == [180]
    # White was recorded at one exposure only: there is no other to give, and none is made up.
    [(_, frame)] = frames(head, [White()], exposure_s=0.04)
    assert (int(frame.image[0, 0]), frame.exposure_s) == (200, 0.02)
    assert frame.t_end_ns - frame.t_start_ns == 20_000_000
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure of 0.03 s.*0.02 s, 0.04 s"):
        camera.configure(CameraSettings(0.03))
    with pytest.raises(UnsupportedByDeviceError, match="gain 2"):
        camera.configure(CameraSettings(0.02, gain=2))
    # One that does not tell its exposure takes any.
    (tmp_path / "any").mkdir()
    head = head_of(tmp_path / "any", [shot(0, 200, exposure_s=None)])
    assert head.cameras["eye"].configure(CameraSettings(0.123)).exposure_s == 0.123


@pytest.mark.parametrize(
    ("more", "cameras", "asked", "words"),
    [
        (
            [],
            ["eye"],
            [White(), Gray(Axis.COLUMN, 1, 4)],
            r"no frame of bit 1 of a column Gray code of 4 bits.*has white; black; a column Gray",
        ),
        ([shot(0, 100, camera="other")], ["eye", "other"], [White(), Black()], "from camera other"),
    ],
)
def test_a_pattern_that_was_not_recorded_is_named_with_those_that_were(
    tmp_path: Path, more: list[Shot], cameras: list[str], asked: list[Pattern], words: str
) -> None:
    head = head_of(tmp_path, [*BASIC, *more], cameras=cameras)
    with pytest.raises(UnsupportedByDeviceError, match=words):
        head.projector.load(encode(asked, PROJECTOR))


def test_what_was_recorded_is_played_unless_a_plan_asks_for_patterns_of_its_own(tmp_path: Path) -> None:
    bits = [Gray(Axis.COLUMN, bit, 4) for bit in range(4)]
    patterns: list[Pattern] = [White(), Black(), *bits, LineShift(Axis.ROW, 0, 8, 1), White()]
    shots = [shot(index, 10 * index) for index in (0, 1, 2, 3, 4, 5, 7)]
    recorded = head_of(tmp_path, shots, patterns).projector.info.recorded
    assert recorded == tuple(each for each in patterns if not isinstance(each, LineShift))
    assert pattern_sequence(PatternPlan(), PROJECTOR, recorded=recorded).patterns == recorded
    asked = pattern_sequence(PatternPlan(line_shift=False), PROJECTOR, recorded=recorded)
    assert asked.patterns == pattern_sequence(PatternPlan(line_shift=False), PROJECTOR).patterns


def test_sinusoids_are_found_again_by_their_periods(tmp_path: Path) -> None:
    asked = pattern_sequence(PatternPlan(sequence=SequenceName.PHASE, sine_period_px=7), PROJECTOR)
    recording = [shot(index, 10 * index) for index in range(len(asked))]
    head = head_of(tmp_path, recording, asked.patterns)
    assert values(head, asked.patterns) == [10 * index for index in range(14)]
    assert head.projector.info.recorded == asked.patterns
    others = pattern_sequence(PatternPlan(sequence=SequenceName.PHASE), PROJECTOR)
    with pytest.raises(UnsupportedByDeviceError, match="black; column sinusoids in 4 steps, period 7 px"):
        head.projector.load(others)


def test_a_recording_that_lacks_a_fine_bit_is_one_of_fewer_bits(tmp_path: Path) -> None:
    patterns: list[Pattern] = [White(), Black(), *(Gray(Axis.COLUMN, bit, 4) for bit in range(4))]
    head = head_of(tmp_path, [shot(index, 10 * index) for index in range(5)], patterns)
    assert head.projector.info.recorded[2:] == tuple(Gray(Axis.COLUMN, bit, 3, 2) for bit in range(3))
    assert values(head, [Gray(Axis.COLUMN, 1, 3, 2)]) == [30]


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
        ({"bundle": "rec", "folder": "x", "sped": 2}, r"(?s)folder: unknown key.*sped: unknown key; .*'speed'"),
        ({"bundle": "rec", "speed": 0.01}, r"speed: expected 0, or 0.05 to 1000 times .*found 0.01"),
        ({"bundle": "rec", "speed": -1}, "speed: expected 0, or"),
        ({"bundle": "nowhere"}, "nowhere is not a scan bundle"),
    ],
)
def test_options_are_checked(tmp_path: Path, options: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        open_head(options, tmp_path)


def scanned(head: ScannerHead, patterns: Sequence[Pattern], *, exposure_s: float = 0.02) -> list[Shot]:
    settings = {name: CameraSettings(exposure_s) for name in head.cameras}
    rig = Rig("recording", head.cameras, head.projector, settings)
    return list(capture(rig, encode(patterns, PROJECTOR)))


@pytest.mark.parametrize("speed", [0.0, 0.5, 1.0, 3.0])
def test_every_scan_has_the_times_of_the_recording_at_any_speed(tmp_path: Path, speed: float) -> None:
    real = RealTime()
    head = paced_head(tmp_path, TIMED, speed, real)
    for _ in range(2):
        begun_ns = real.now_ns
        assert [s.time_s for s in scanned(head, [White(), Black(), BIT])] == [0.0, 0.123456789, 1.25]
        took_s = (real.now_ns - begun_ns) / 1e9
        assert took_s == pytest.approx(1.27 / speed if speed else 0.0, abs=0.01)


@pytest.mark.parametrize("lead_s", [0.0, 0.25])
def test_two_cameras_keep_their_times(tmp_path: Path, lead_s: float) -> None:
    shots = [shot(0, 200, time_s=0.0), shot(0, 150, camera="other", time_s=-lead_s)]
    scan = scanned(head_of(tmp_path, shots, [White()], ["eye", "other"]), [White()])
    assert [(s.camera, s.time_s, s.image[0, 0]) for s in scan] == [("eye", 0.0, 200), ("other", -lead_s, 150)]


def test_at_speed_one_the_times_are_those_of_the_monotonic_clock(tmp_path: Path) -> None:
    real = RealTime()
    head = paced_head(tmp_path, TIMED, 1.0, real)
    real.now_ns += 7_000_000_000
    for shown, frame in frames(head, [White(), Black(), BIT]):
        assert frame.t_end_ns == pytest.approx(real.now_ns, abs=2_000_000)
        assert frame.t_end_ns - shown.t_visible_ns == pytest.approx(20_000_000, abs=2_000_000)


def test_a_scan_that_is_slower_than_the_recording_is_not_held_up_and_keeps_its_times(tmp_path: Path) -> None:
    real = RealTime()
    head = paced_head(tmp_path, TIMED, 2.0, real)
    rig = Rig("recording", head.cameras, head.projector, {"eye": CameraSettings(0.02)})
    times_s, waits = [], []
    for each in capture(rig, encode([White(), Black(), BIT], PROJECTOR)):
        times_s.append(each.time_s)
        waits.append(real.waits)
        real.now_ns += 10_000_000_000
    assert times_s == [0.0, 0.123456789, 1.25]
    assert waits[-1] == waits[0], "after its first frame it is late"


@pytest.mark.parametrize("per_pattern", [False, True], ids=["one sequence per exposure", "exposures per pattern"])
def test_a_bracket_keeps_its_times(tmp_path: Path, per_pattern: bool) -> None:
    steps = list(enumerate((0.01, 0.03)))
    order = [(index, *step) for step in steps for index in range(len(FIVE))]
    if per_pattern:
        order.sort()
    bracket = [
        shot(index, 10 * index + step, exposure_s=exposure_s, time_s=0.2 * number)
        for number, (index, step, exposure_s) in enumerate(order)
    ]
    head = head_of(tmp_path, bracket, FIVE)
    camera = head.cameras["eye"]
    for _ in range(1 if per_pattern else 2):
        frames = []
        for number, (index, _step, exposure_s) in enumerate(order):
            if number == 0 or not (index or per_pattern):
                head.projector.load(encode(FIVE, PROJECTOR))
            camera.configure(CameraSettings(exposure_s))
            camera.arm(1, Trigger.SOFTWARE)
            after_ns = head.projector.show(index).t_visible_ns
            camera.trigger()
            frames.append(camera.read(after_ns, 1.0))
            camera.disarm()
        seen = [(int(frame.image[0, 0]), frame.exposure_s) for frame in frames]
        assert seen == [(int(s.image[0, 0]), s.exposure_s) for s in bracket]
        starts_ns = [frame.t_start_ns - frames[0].t_start_ns for frame in frames]
        assert starts_ns == [round((s.time_s or 0) * 1e9) for s in bracket]


def test_a_paced_read_waits_for_the_end_of_the_exposure_and_no_longer_than_it_may(tmp_path: Path) -> None:
    real = RealTime()
    head = paced_head(tmp_path, [shot(0, 200, exposure_s=4.0)], 0.5, real)
    camera = head.cameras["eye"]
    camera.configure(CameraSettings(4.0))
    head.projector.load(encode([White()], PROJECTOR))
    camera.arm(2, Trigger.SOFTWARE)
    after_ns = head.projector.show(0).t_visible_ns
    camera.trigger()
    begun_ns = real.now_ns
    with pytest.raises(FrameTimeoutError, match="within 3"):
        camera.read(after_ns, 3.0)
    assert (real.now_ns - begun_ns) / 1e9 == pytest.approx(3.0)
    assert camera.read(after_ns, 6.0).t_start_ns >= after_ns
    assert (real.now_ns - begun_ns) / 1e9 == pytest.approx(8.0)


def test_closing_ends_a_wait_that_another_thread_is_in(tmp_path: Path) -> None:
    # The last frame is an hour later; nobody may have to sit through that to be let go.
    head = head_of(tmp_path, [shot(0, 200, time_s=0.0), shot(1, 10, time_s=3600.0)])
    head = open_head({"bundle": "rec", "speed": 1}, tmp_path)
    head.projector.load(encode([White(), Black()], PROJECTOR))
    head.projector.show(0)
    waiting = threading.Thread(target=head.projector.show, args=(1,), daemon=True)
    waiting.start()
    head.cameras["eye"].close()
    waiting.join(10)
    assert not waiting.is_alive()

"""What a capture leaves on disk and tells the reconstruction: when all goes well, when frames are shot again, and when
they fail for good.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from slrig.bundle import BundleWriter, read_bundle
from slrig.bundle.sidecars import RefusedFrame, TurntableAngle, read_notes, read_refused, read_turntable_angle
from slrig.capture.exposure import check_exposures
from slrig.capture.verifier import EvidenceSummary, check_capture
from slrig.devices import AppliedSettings, Camera, CameraSettings, Projector, Synchronisation, Trigger
from slrig.errors import (
    BundleError,
    DeviceGoneError,
    FrameTimeoutError,
    ScanCancelledError,
    ScanEvidenceError,
    SlrigError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.jobs.job import Abandon, FrameFeed
from slrig.jobs.listener import Listener
from slrig.model import Axis, Black, Calibration, CameraFormat, Shot, Size, White
from slrig.model.capture import CaptureHeader
from slrig.scan.acquisition import Recorder, capture_frames, exposed
from slrig.scan.plan import PatternPlan, PresetUse, ScanPlan
from slrig.scan.report import capture_notes, capture_report
from tests.contract.benches import simulated
from tests.contract.suite import rig_of
from tests.core import parametrize_core
from tests.samples import sample_calibration
from tests.unit.capture.fake_rig import CameraFaults, FakeRig, FakeTurntable, fake_rig
from tests.unit.doctor.test_doctor import OtherCamera, small_rig
from tests.unit.scan.fakes import WAIT_S

SHORT = PatternPlan(line_shift=False, gray_cell_px=32)
"""Few patterns, for what no pattern matters for."""


def faulty(**faults: object) -> FakeRig:
    return fake_rig(cameras=["right"], faults={"right": CameraFaults(**faults)})  # type: ignore[arg-type]


def calibrated(fake: FakeRig) -> FakeRig:
    return replace(fake, rig=replace(fake.rig, calibration=sample_calibration()))


class Sink:
    """Hears what a reconstruction would."""

    def __init__(self) -> None:
        self.header: CaptureHeader | None = None
        self.calibration: Calibration | None = None
        self.shots: list[Shot] = []
        self.evidence: EvidenceSummary | None = None

    def begin(self, header: CaptureHeader, calibration: Calibration | None) -> None:
        self.header, self.calibration = header, calibration

    def take(self, shot: Shot) -> None:
        self.shots.append(shot)

    def end(self, evidence: EvidenceSummary) -> None:
        self.evidence = evidence


def captured(
    fake: FakeRig,
    folder: Path,
    sink: Sink | FrameFeed | None = None,
    *,
    plan: ScanPlan | None = None,
    cancelled: Callable[[], bool] = lambda: False,
) -> list[tuple[float, str]]:
    told: list[tuple[float, str]] = []
    try:
        capture_frames(
            fake.rig,
            plan or ScanPlan(),
            folder,
            Listener(report=lambda _stage, fraction, detail: told.append((fraction, detail)), cancelled=cancelled),
            frames=sink,
        ).finish()
    finally:
        assert fake.at_rest
        assert told == sorted(told, key=lambda each: each[0])
    return told


def test_a_sound_capture_is_a_bundle_and_each_frame_is_shown_to_the_reconstruction(tmp_path: Path) -> None:
    sink = Sink()
    fake = calibrated(fake_rig())
    told = captured(fake, tmp_path / "bundle", sink)
    (tmp_path / "bundle" / "calibration.json").unlink()  # of other devices
    capture = read_bundle(tmp_path / "bundle").capture
    assert len(capture.shots) == len(sink.shots) == 32
    assert (sink.header, sink.calibration) == (CaptureHeader.from_capture(capture), fake.rig.calibration)
    for shot, again in zip(sink.shots, capture.shots, strict=True):
        assert (shot.pattern, shot.camera, shot.exposure_s) == (again.pattern, again.camera, again.exposure_s)
        np.testing.assert_array_equal(shot.image, again.image)
    assert sink.evidence == check_capture(capture)
    assert told[-1] == (1.0, "frame 32 of 32")


def test_a_rig_whose_latency_was_never_measured_says_so(tmp_path: Path) -> None:
    with small_rig(tmp_path) as rig:
        free = replace(rig, cameras={"eye": OtherCamera(rig.cameras["eye"], triggers=frozenset({Trigger.FREE}))})
        known = replace(free, synchronisation=Synchronisation(0.0, 0.001))
        for name, each in (("unmeasured", free), ("measured", known), ("triggered", rig)):
            plan = ScanPlan(PatternPlan(line_shift=False, gray_cell_px=16))
            capture_frames(each, plan, tmp_path / name).finish()
    [note] = read_notes(tmp_path / "unmeasured")
    assert "cameras that run by themselves (eye)" in note
    assert "Run slrig latency" in note
    assert read_notes(tmp_path / "measured") == ()
    assert not (tmp_path / "triggered" / "notes.json").exists()


@parametrize_core("measured", [None, Synchronisation(0.0, 0.001)])
def test_frames_that_light_is_too_late_for_ask_to_measure_it(tmp_path: Path, measured: Synchronisation | None) -> None:
    plan = ScanPlan(PatternPlan(line_shift=False, gray_cell_px=16))
    with small_rig(tmp_path, faults={"light_delay_s": 0.15}) as rig:
        free = {"eye": OtherCamera(rig.cameras["eye"], triggers=frozenset({Trigger.FREE}))}
        late = replace(rig, cameras=free, synchronisation=measured)
        with pytest.raises(ScanEvidenceError) as raised:
            capture_frames(late, plan, tmp_path / "bundle")
    assert ("never measured on this rig" in str(raised.value)) is (measured is None)


def test_the_turntable_turns_before_the_first_frame_and_the_bundle_says_where_to(tmp_path: Path) -> None:
    fake, table = fake_rig(cameras=["left"]), FakeTurntable()
    on_stage = replace(fake, rig=replace(fake.rig, positioner=table))
    told = captured(on_stage, tmp_path / "table", plan=ScanPlan(SHORT, turn_deg=135.0))
    assert (told[0], table.turned_deg) == ((0.0, "to 135°"), [135.0])
    assert read_turntable_angle(tmp_path / "table") == TurntableAngle(angle_deg=135.0, turned_by="table")
    # A hand has turned: the table stays where it is.
    captured(on_stage, tmp_path / "hand", plan=ScanPlan(SHORT, turn_deg=90.0, turned_by="hand"))
    assert table.turned_deg == [135.0]
    assert read_turntable_angle(tmp_path / "hand") == TurntableAngle(angle_deg=90.0, turned_by="hand")
    captured(on_stage, tmp_path / "none", plan=ScanPlan(SHORT))
    assert read_turntable_angle(tmp_path / "none") is None


def test_no_frame_is_shot_where_nothing_turns(tmp_path: Path) -> None:
    fake, table = fake_rig(), FakeTurntable(error=DeviceGoneError("the turntable is gone"))
    for rig, error, words in (
        (fake.rig, UnsupportedByDeviceError, "stand at 45°, and this rig has no turntable. Turn it by hand"),
        (replace(fake.rig, positioner=table), DeviceGoneError, "the turntable is gone"),
    ):
        with pytest.raises(error, match=words):
            captured(replace(fake, rig=rig), tmp_path / "bundle", plan=ScanPlan(turn_deg=45.0))
    assert not (tmp_path / "bundle").exists()
    assert not any(call.startswith("show") for call in fake.rig.projector.world.calls)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("turntable.json", '{"angle_deg": NaN, "turned_by": "hand"}', read_turntable_angle),
        ("turntable.json", '{"angle_deg": 1}', read_turntable_angle),
        ("turntable.json", "[]", read_turntable_angle),
        ("notes.json", '{"light": "late"}', read_notes),
    ],
)
def test_an_angle_or_notes_that_are_none_are_refused(
    name: str, text: str, read: Callable[[Path], object], tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(BundleError, match=name):
        read(tmp_path)


def test_a_frame_that_was_shot_again_is_right_in_the_bundle_and_the_report_says_so(tmp_path: Path) -> None:
    sink = Sink()
    told = captured(faulty(stale=frozenset({5}), garbled=frozenset({14})), tmp_path / "bundle", sink)
    capture = read_bundle(tmp_path / "bundle").capture
    assert [shot.pattern for shot in capture.shots] == list(range(COUNT))
    refused = read_refused(tmp_path / "bundle")
    assert {each.pattern for each in refused} == {5, 11, 13}
    summary = check_capture(capture, refused)
    assert (summary.verified, summary.faults, summary.shot_again) == (COUNT, (), 3)
    assert sink.evidence is not None
    assert sink.evidence.causes == summary.causes
    assert str(sink.evidence) == str(summary) == "16/16 patterns verified, 3 frames shot again"
    assert told[-1] == (1.0, "frame 16 of 16, 3 shot again")
    report = capture_report(CaptureHeader.from_capture(capture), Axis.COLUMN, summary)
    assert report["identity"] == str(summary)
    evidence = report["evidence"]
    assert isinstance(evidence, dict)
    assert (evidence["patterns_verified"], evidence["shot_again"]) == ("16/16", 3)
    assert any(
        cause.startswith("camera 'right', pattern 13 (column lines, shift 5 of 8): ")
        for cause in evidence["shot_again_because"]
    )


@pytest.mark.slow
@parametrize_core(
    ("faults", "whole"),
    # A bit is judged as it comes, before anything else sees it; a line frame beside its inverse, which has come before.
    [({"garbled": frozenset({13})}, False), ({"garbled": frozenset({5})}, True)],
    ids=["is replaced", "is not replaced"],
)
def test_a_reconstruction_that_was_fed_a_frame_that_is_replaced_reads_the_bundle(
    tmp_path: Path, faults: dict[str, object], whole: bool
) -> None:
    sent: list[object] = []

    def send(message: object) -> bool:
        sent.append(message)
        return True

    feed = FrameFeed(send)
    captured(calibrated(faulty(**faults)), tmp_path / "b", feed)
    assert feed.settled(WAIT_S)
    assert feed.whole is whole
    assert isinstance(sent[-1], Abandon) is not whole


@parametrize_core(
    ("faults", "kind", "partner"),
    [
        # A line frame is doubted beside its inverse.
        ({"garbled": frozenset(range(13, 1000))}, ScanEvidenceError, {11}),
        ({"drop": frozenset(range(13, 1000))}, FrameTimeoutError, set()),
    ],
)
def test_frames_that_fail_for_good_are_kept(
    tmp_path: Path, faults: dict[str, object], kind: type[SlrigError], partner: set[int]
) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(kind, match=r"failed 3 times.*The frames are kept: see bundle.json .*, refused/ for the others"):
        captured(faulty(**faults), folder)
    capture = read_bundle(folder).capture
    assert {shot.pattern for shot in capture.shots if shot.camera == "right"} == set(range(13)) - partner
    # As far as they go, they are right.
    assert check_capture(capture).faults == ()
    told = json.loads((folder / "refused" / "refused.json").read_text())
    assert "failed 3 times" in told["ended"]
    worst = [each for each in told["frames"] if each["pattern"] == 13]
    assert [each["attempt"] for each in worst] == [1, 2, 3]
    assert all((folder / each["file"]).is_file() for each in told["frames"] if "file" in each)
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_a_lamp_that_is_off_leaves_what_the_cameras_saw(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(ScanEvidenceError, match="is the lamp off"):
        captured(fake_rig(cameras=["left"], projector={"lamp_off": True}), folder)
    refused = json.loads((folder / "refused" / "refused.json").read_text())["frames"]
    assert len(refused) >= 3
    assert np.mean([(folder / each["file"]).is_file() for each in refused]) == 1


def test_a_device_that_is_gone_and_a_cancel_after_a_refusal_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError):
        captured(faulty(unplug_at=9), tmp_path / "bundle")
    assert list(tmp_path.iterdir()) == []
    fake = faulty(stale=frozenset({5}))
    with pytest.raises(ScanCancelledError):
        captured(fake, tmp_path / "bundle", cancelled=lambda: fake.world.calls.count("show 5") == 2)
    assert list(tmp_path.iterdir()) == []


@parametrize_core(
    ("exposing", "one_s", "bracket_s", "bent"),
    [
        ({}, 0.016, (), 1),
        # Two of them become one.
        ({"exposures_s": (0.0075, 0.0085, 0.02)}, None, (0.008, 0.02), 2),
        # Of 1/60 s, and 0.12 of it is less than one period.
        ({"exposure_factors": (1.8, 0.12)}, None, (0.004, 0.032), 2),
    ],
)
def test_exposures_are_whole_refresh_periods_of_the_projector_and_the_scan_says_so(
    tmp_path: Path, exposing: dict[str, Any], one_s: float | None, bracket_s: tuple[float, ...], bent: int
) -> None:
    with simulated(tmp_path).head() as head:
        rig, name = rig_of(head), next(iter(head.cameras))
        rig = replace(
            rig,
            cameras={name: head.cameras[name]},
            settings={name: CameraSettings(1 / 60)},
            projector=cast("Projector", Refreshing(rig.projector, 0.004)),
        )
        used, found_s, told = exposed(rig, ScanPlan(**exposing))
    assert found_s == pytest.approx(bracket_s)
    assert len(told) == bent
    if one_s is not None:
        assert used.settings[name].exposure_s == pytest.approx(one_s)
        words = "exposes for 0.016 s instead of 0.0166667 s: whole periods of the projector (0.004 s)"
        assert told == [f"camera '{name}' {words}"]


def test_factors_are_of_each_camera_alone_and_of_their_mean_in_a_bracket(tmp_path: Path) -> None:
    with simulated(tmp_path).head() as head:
        rig, (name, camera) = rig_of(head), next(iter(head.cameras.items()))
        two = replace(
            rig,
            cameras={name: camera, "other": camera},
            settings={name: CameraSettings(0.01), "other": CameraSettings(0.04)},
        )
        longest_s = camera.info.exposure_range_s[1]
        scaled, none, told = exposed(two, ScanPlan(exposure_factors=(2.0,), preset=PresetUse("dark", 1, "abc")))
        assert {each: settings.exposure_s for each, settings in scaled.settings.items()} == {name: 0.02, "other": 0.08}
        assert (none, told) == ((), ["the scan was asked for by preset 'dark' (version 1, abc)"])
        _, bracket_s, _ = exposed(two, ScanPlan(exposure_factors=(4.0, 0.5)))
        assert bracket_s == pytest.approx((0.01, 0.08))
        _, bracket_s, told = exposed(two, ScanPlan(exposure_factors=(1.0, 900.0)))
        assert bracket_s == pytest.approx((0.02, longest_s))
        assert told == [f"every camera exposes for {longest_s:.6g} s instead of 18 s: what it can do"]


def test_whole_periods_of_the_projector_are_those_that_the_camera_can_do(tmp_path: Path) -> None:
    with simulated(tmp_path).head() as head:
        rig, (name, camera) = rig_of(head), next(iter(head.cameras.items()))
        longest_s = camera.info.exposure_range_s[1]
        period_s = longest_s / 1.9
        slow = replace(rig, projector=cast("Projector", Refreshing(rig.projector, period_s)))
        scaled, _, told = exposed(slow, ScanPlan(exposure_factors=(900.0,)))
        # The nearest number of periods to the longest exposure is two, and the camera cannot do that.
        assert scaled.settings[name].exposure_s == period_s
        assert len(told) == 2 * len(rig.cameras)
        _, bracket_s, _ = exposed(slow, ScanPlan(exposures_s=(0.6 * longest_s, longest_s)))
        assert bracket_s == (period_s,)
        # A webcam that takes exposures by powers of two.
        stepped = {name: cast("Camera", Stepped(camera, 0.0156))}
        own = replace(rig, cameras=stepped, settings={name: CameraSettings(0.0156)})
        scaled, _, told = exposed(
            replace(own, projector=cast("Projector", Refreshing(rig.projector, 1 / 120))), ScanPlan()
        )
        assert scaled.settings[name].exposure_s == 0.0156
        assert f"not whole periods of the projector (0.00833333 s): camera '{name}' takes 0.0156 s" in told[0]


class Stepped:
    """A camera that takes one exposure for every other."""

    def __init__(self, camera: Camera, taken_s: float) -> None:
        self.info, self._taken_s = camera.info, taken_s

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        return AppliedSettings(self._taken_s, settings.gain)


class Refreshing:
    """The information of a projector with another refresh period."""

    def __init__(self, projector: Projector, refresh_s: float) -> None:
        self.info = replace(projector.info, refresh_s=refresh_s)


# A bundle is written beside the capture: in order, whole or not at all, and never holding more than it may

FORMATS = {"cam0": CameraFormat(Size(64, 48), 8)}
SHOTS = tuple(Shot(index, "cam0", np.full((48, 64), 10 * index, np.uint8)) for index in range(2))


class Slow(BundleWriter):
    """Writes when it is let; tells when it has begun."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, Size(64, 40), (White(), Black()), FORMATS)
        self.gate = threading.Event()
        self.begun = threading.Event()
        self.error: Exception | None = None
        self.written_by: set[str] = set()

    def add(self, shot: Shot) -> None:
        self.begun.set()
        assert self.gate.wait(WAIT_S)
        self.written_by.add(threading.current_thread().name)
        if self.error is not None:
            raise self.error
        super().add(shot)


def test_frames_are_written_in_order_by_a_thread_of_its_own(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    with writer, Recorder(writer) as recorder:
        for shot in SHOTS:
            recorder.add(shot)
        recorder.add(RefusedFrame(0, "cam0", 1, "it was stale", delivered=True))
        recorder.add(SHOTS[0])
        # All of this while the disk did nothing.
        writer.gate.set()
    assert writer.written_by == {"slrig-recorder"}
    shots = read_bundle(tmp_path / "bundle").capture.shots
    assert [(shot.pattern, int(shot.image[0, 0])) for shot in shots] == [(0, 0), (1, 10)]


def test_a_disk_that_is_too_slow_holds_the_capture_up(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    third_waits = threading.Event()
    done = threading.Event()

    def capture() -> None:
        with writer, Recorder(writer, most_bytes=2 * SHOTS[0].image.nbytes) as recorder:
            recorder.add(SHOTS[0])
            assert writer.begun.wait(WAIT_S)
            recorder.add(SHOTS[1])
            third_waits.set()
            recorder.add(SHOTS[1])
        done.set()

    thread = threading.Thread(target=capture, daemon=True)
    thread.start()
    assert third_waits.wait(WAIT_S)
    assert not done.is_set()
    writer.gate.set()
    assert done.wait(WAIT_S)
    thread.join()
    assert len(read_bundle(tmp_path / "bundle").capture.shots) == 3


def test_a_frame_larger_than_the_queue_is_written_all_the_same(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    writer.gate.set()
    with writer, Recorder(writer, most_bytes=1) as recorder:
        for shot in SHOTS:
            recorder.add(shot)
    assert len(read_bundle(tmp_path / "bundle").capture.shots) == 2


@pytest.mark.parametrize(
    ("refusal", "shots", "words"),
    [
        (StorageError("the disk is full"), SHOTS[:1], "the disk is full"),
        # It ends a capture that goes on.
        (StorageError("the disk is full"), repeat(SHOTS[0]), "the disk is full"),
        (None, [Shot(7, "cam0", SHOTS[0].image)], "pattern 7"),
    ],
    ids=["at the end", "in the middle", "no frame of the bundle"],
)
def test_what_cannot_be_written_is_told_and_leaves_nothing(
    tmp_path: Path, refusal: Exception | None, shots: Iterable[Shot], words: str
) -> None:
    writer = Slow(tmp_path / "bundle")
    writer.error = refusal
    writer.gate.set()

    def capture() -> None:
        with writer, Recorder(writer, most_bytes=1) as recorder:
            for shot in shots:
                recorder.add(shot)
            recorder.finish()

    with pytest.raises(SlrigError, match=words):
        capture()
    assert list(tmp_path.iterdir()) == []


def test_a_capture_that_fails_writes_no_more_and_leaves_nothing(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")

    def capture() -> None:
        with writer, Recorder(writer) as recorder:
            for shot in SHOTS:
                recorder.add(shot)
            assert writer.begun.wait(WAIT_S)
            threading.Timer(0, writer.gate.set).start()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        capture()
    assert list(tmp_path.iterdir()) == []
    assert not any(thread.name == "slrig-recorder" for thread in threading.enumerate())


# ---- A bracket as it is captured: one sequence per exposure, each judged by itself, and what is left out is said


COUNT = 16
BRACKET = (0.005, 0.01)


def bracketed(
    fake: FakeRig,
    folder: Path,
    exposures_s: tuple[float, ...] = BRACKET,
    *,
    sink: Sink | FrameFeed | None = None,
    cancelled: Callable[[], bool] = lambda: False,
) -> list[tuple[float, str]]:
    return captured(fake, folder, sink, plan=ScanPlan(exposures_s=exposures_s), cancelled=cancelled)


def exposed_rig(cameras: Mapping[str, float] | None = None, *, trigger: Trigger = Trigger.SOFTWARE) -> FakeRig:
    cameras = cameras or {"right": 0.6}
    projector = {"plays": trigger is Trigger.HARDWARE}
    return fake_rig(cameras=cameras, projector=projector, triggers=dict.fromkeys(cameras, frozenset({trigger})))


def frames_of(folder: Path) -> set[tuple[float | None, int, str]]:
    capture = read_bundle(folder).capture
    frames = [(shot.exposure_s, shot.pattern, shot.camera) for shot in capture.shots]
    assert len(frames) == len(set(frames))
    return set(frames)


def every(exposures: Mapping[str, Sequence[float]]) -> set[tuple[float | None, int, str]]:
    return {(time, index, name) for name, times in exposures.items() for time in times for index in range(COUNT)}


@pytest.mark.parametrize(
    "trigger",
    [Trigger.HARDWARE, *(pytest.param(each, marks=pytest.mark.slow) for each in (Trigger.SOFTWARE, Trigger.FREE))],
)
def test_the_sequence_is_played_once_for_each_exposure_from_short_to_long(tmp_path: Path, trigger: Trigger) -> None:
    sink, rig = Sink(), exposed_rig(trigger=trigger)
    told = bracketed(rig, tmp_path / "bundle", (0.01, 0.005), sink=sink)
    capture = read_bundle(tmp_path / "bundle").capture
    assert frames_of(tmp_path / "bundle") == every({"right": BRACKET})
    assert [shot.exposure_s for shot in capture.shots if shot.camera == "right"] == sorted(BRACKET * COUNT)
    assert rig.cameras["right"].exposures_s == list(BRACKET)
    # One scan, one beginning of time: the second sequence comes after the first.
    times_s = [shot.time_s for shot in capture.shots if shot.camera == "right"]
    assert times_s[0] == 0.0
    assert all(a is not None and b is not None and a < b for a, b in pairwise(times_s))
    assert (
        CaptureHeader.from_capture(capture)
        == sink.header
        == CaptureHeader.from_capture(replace(capture, shots=tuple(sink.shots)))
    )
    assert sink.evidence == check_exposures(capture)
    assert str(sink.evidence) == f"{COUNT}/{COUNT} patterns verified"
    assert told[-1] == (1.0, f"frame {2 * COUNT} of {2 * COUNT}")


@pytest.mark.slow
def test_a_frame_that_fails_is_shot_again_at_its_own_exposure(tmp_path: Path) -> None:
    sink, rig = Sink(), exposed_rig()
    rig.cameras["right"].faults.garbled = frozenset({COUNT + 13})
    bracketed(rig, tmp_path / "bundle", sink=sink)
    assert frames_of(tmp_path / "bundle") == every({"right": BRACKET})
    refused = read_refused(tmp_path / "bundle")
    # Beside its inverse.
    assert {(each.pattern, each.camera) for each in refused} == {(11, "right"), (13, "right")}
    assert all(each.cause.startswith("at 0.01 s, ") for each in refused)
    recorded = read_bundle(tmp_path / "bundle")
    assert sink.evidence == check_exposures(recorded.capture, refused)
    assert str(sink.evidence) == f"{COUNT}/{COUNT} patterns verified, 2 frames shot again"


@pytest.mark.slow
def test_an_exposure_that_is_too_long_or_too_short_is_left_out_and_the_report_says_so(tmp_path: Path) -> None:
    rig, sink = exposed_rig(), Sink()
    told = bracketed(rig, tmp_path / "bundle", (0.0001, 0.005, 0.01, 0.08, 0.16), sink=sink)
    used = (0.005, 0.01)
    assert frames_of(tmp_path / "bundle") == every({"right": used})
    # What is too long by far is not tried any longer.
    assert 0.16 not in rig.cameras["right"].exposures_s
    assert told[-1][0] < 1.0
    capture, refused = read_bundle(tmp_path / "bundle").capture, read_refused(tmp_path / "bundle")
    summary = check_exposures(capture, refused)
    assert summary == sink.evidence
    report = capture_report(CaptureHeader.from_capture(capture), Axis.COLUMN, summary)
    notes = capture_notes(CaptureHeader.from_capture(capture), Axis.COLUMN, summary)
    assert len(notes) == 2
    for note, words in zip(sorted(notes), ("0.0001 s is too dark", "0.08 s is too bright"), strict=True):
        assert note.startswith(f"an exposure was left out: {words} for camera 'right': ")
    assert summary.verified == summary.patterns == COUNT
    evidence = report["evidence"]
    assert isinstance(evidence, dict)
    assert not any("left out" in cause for cause in evidence["shot_again_because"])


@pytest.mark.slow
def test_an_exposure_that_one_camera_cannot_use_is_the_others_all_the_same(tmp_path: Path) -> None:
    rig = exposed_rig({"left": 0.6, "right": 4.0})
    rig.cameras["right"].scene.noise_dn = 0.2
    bracketed(rig, tmp_path / "bundle", (0.002, 0.01, 0.016))
    assert frames_of(tmp_path / "bundle") == every({"left": (0.002, 0.01, 0.016), "right": (0.002,)})
    summary = check_exposures(read_bundle(tmp_path / "bundle").capture, read_refused(tmp_path / "bundle"))
    assert (summary.verified, summary.faults) == (COUNT, ())
    assert summary.shot_again > 0


@pytest.mark.slow
def test_a_reconstruction_that_was_fed_an_exposure_that_is_left_out_reads_the_bundle(tmp_path: Path) -> None:
    feeds = [FrameFeed(lambda _message: True) for _ in range(2)]
    for feed, exposures_s in zip(feeds, (BRACKET, (0.005, 0.08)), strict=True):
        bracketed(calibrated(exposed_rig()), tmp_path / f"{exposures_s[-1]}", exposures_s, sink=feed)
        assert feed.settled(WAIT_S)
    assert [feed.whole for feed in feeds] == [True, False]


def ended(rig: FakeRig, folder: Path, exposures_s: tuple[float, ...] = BRACKET) -> str:
    with pytest.raises(ScanEvidenceError) as caught:
        bracketed(rig, folder, exposures_s)
    assert "The frames are kept" in str(caught.value)
    assert json.loads((folder / "refused" / "refused.json").read_text())["ended"] in str(caught.value)
    return str(caught.value)


def test_a_lamp_that_goes_off_is_not_taken_for_a_short_exposure(tmp_path: Path) -> None:
    rig = exposed_rig()
    rig.projector.dark_from_show = COUNT
    told = ended(rig, tmp_path / "bundle")
    assert told.startswith("at an exposure of 0.01 s, camera ")
    assert "is the lamp off" in told
    # What the first exposure has shown is kept.
    assert every({"right": (0.005,)}) <= frames_of(tmp_path / "bundle")


@pytest.mark.slow
def test_a_bracket_of_which_nothing_is_of_use_ends_the_scan(tmp_path: Path) -> None:
    assert "no exposure of the bracket is of use to camera 'right': 0.0002 s is too dark" in ended(
        exposed_rig(), tmp_path / "dark", (0.0001, 0.0002)
    )
    told = ended(exposed_rig(), tmp_path / "bright", (0.08, 0.2))
    assert "no exposure of the bracket is of use to camera 'right': 0.08 s is too bright" in told


@pytest.mark.slow
def test_frames_that_are_wrong_at_one_exposure_for_good_end_the_scan(tmp_path: Path) -> None:
    rig = exposed_rig()
    rig.cameras["right"].faults.garbled = frozenset(range(COUNT + 13, 1000))
    told = ended(rig, tmp_path / "bundle")
    assert told.startswith("at an exposure of 0.01 s, camera 'right', pattern 11 ")
    assert "failed 3 times" in told


@pytest.mark.slow
def test_what_moves_between_two_exposures_ends_the_scan(tmp_path: Path) -> None:
    rig = exposed_rig()
    rig.cameras["right"].pushed_at = 2
    told = ended(rig, tmp_path / "bundle")
    assert "camera 'right', pattern" in told
    assert "looks different at 0.01 s and at 0.005 s" in told


def test_a_cancel_at_the_second_exposure_leaves_nothing(tmp_path: Path) -> None:
    rig = exposed_rig()
    with pytest.raises(ScanCancelledError):
        bracketed(rig, tmp_path / "bundle", cancelled=lambda: rig.projector.shows > COUNT + 10)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_recorded_capture_of_two_cameras_with_one_exposure_each_is_no_bracket(tmp_path: Path) -> None:
    captured(exposed_rig({"left": 0.6, "right": 0.5}), tmp_path / "bundle")
    capture = read_bundle(tmp_path / "bundle").capture
    shots = tuple(replace(shot, exposure_s=0.03) if shot.camera == "right" else shot for shot in capture.shots)
    apart = replace(capture, shots=shots)
    assert check_exposures(apart) == check_exposures(capture)

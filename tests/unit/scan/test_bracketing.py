"""A bracket as it is captured: one sequence per exposure, each judged by itself, and what is left out is said."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import pytest

from slrig.bundle import read_bundle
from slrig.bundle.refused import read_refused
from slrig.capture.exposure import check_exposures
from slrig.devices import AppliedSettings, CameraSettings, Rig, Shown, Trigger
from slrig.errors import ScanCancelledError, ScanEvidenceError, SlrigError
from slrig.jobs.frame_feed import FrameFeed
from slrig.model import Axis, Capture, Frame
from slrig.model.header import CaptureHeader
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ScanPlan
from slrig.scan.report import capture_notes, capture_report
from tests.samples import sample_calibration
from tests.unit.capture.fake_rig import FakeCamera, FakeProjector, Scene, World, WorldClock
from tests.unit.scan.fakes import WAIT_S
from tests.unit.scan.test_acquisition import Sink

USUAL_S = 0.01
COUNT = 22
BRACKET = (0.005, 0.01)


@dataclass
class ExposedCamera(FakeCamera):
    """A camera whose frames are the brighter, the longer they are exposed. `white` : of 10 ms, over full scale."""

    white: float = 0.6
    exposures_s: list[float] = field(default_factory=list)
    pushed_at: int | None = None

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        self.exposures_s.append(settings.exposure_s)
        times = settings.exposure_s / USUAL_S
        self.scene.white, self.scene.ambient = self.white * times, 0.02 * times
        if len(self.exposures_s) == self.pushed_at:
            self.scene.column_px = self.scene.column_px + 2 * self.scene.columns_per_px
        return super().configure(settings)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        frame = super().read(after_ns, timeout_s)
        exposure_s = self.exposures_s[-1]
        end_ns = frame.t_start_ns + round(exposure_s * 1e9)
        self.world.now_ns = max(self.world.now_ns, end_ns)
        return replace(frame, exposure_s=exposure_s, t_end_ns=end_ns)


@dataclass
class DyingLamp(FakeProjector):
    """Its lamp goes off at a showing."""

    dies_at: int = 10**9

    def show(self, index: int) -> Shown:
        self.lamp_off = self.lamp_off or self.shows >= self.dies_at
        return super().show(index)


@dataclass
class Fake:
    """The fakes together."""

    world: World
    projector: DyingLamp
    cameras: dict[str, ExposedCamera]
    rig: Rig

    @property
    def at_rest(self) -> bool:
        return not self.projector.lit and all(camera.armed is None for camera in self.cameras.values())


def fake(
    whites: Mapping[str, float] | None = None,
    *,
    trigger: Trigger = Trigger.SOFTWARE,
    dies_at: int = 10**9,
    pushed_at: int | None = None,
) -> Fake:
    world = World()
    projector = DyingLamp(world, plays=trigger is Trigger.HARDWARE, dies_at=dies_at)
    cameras = {
        name: ExposedCamera(
            name, world, Scene(noise_dn=0.8, seed=index, first_column_px=4.0 + 3 * index), frozenset({trigger}),
            white=white, pushed_at=pushed_at,
        )
        for index, (name, white) in enumerate((whites or {"right": 0.6}).items())
    }  # fmt: skip
    settings = {name: CameraSettings(USUAL_S) for name in cameras}
    return Fake(world, projector, cameras, Rig("fake", cameras, projector, settings, clock=WorldClock(world)))


def captured(
    rig: Fake,
    folder: Path,
    exposures_s: Sequence[float] = BRACKET,
    *,
    sink: Sink | FrameFeed | None = None,
    cancelled: Callable[[], bool] = lambda: False,
) -> list[tuple[float, str]]:
    told: list[tuple[float, str]] = []
    try:
        capture_frames(
            rig.rig,
            ScanPlan(exposures_s=tuple(exposures_s)),
            folder,
            progress=lambda _stage, fraction, detail: told.append((fraction, detail)),
            cancelled=cancelled,
            frames=sink,
        ).finish()
    finally:
        assert rig.at_rest
        fractions = [fraction for fraction, _ in told]
        assert fractions == sorted(fractions)
    return told


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
    sink, rig = Sink(), fake(trigger=trigger)
    told = captured(rig, tmp_path / "bundle", (0.01, 0.005), sink=sink)
    capture = read_bundle(tmp_path / "bundle").capture
    assert frames_of(tmp_path / "bundle") == every({"right": BRACKET})
    assert [shot.exposure_s for shot in capture.shots if shot.camera == "right"] == sorted(BRACKET * COUNT)
    assert rig.cameras["right"].exposures_s == list(BRACKET)
    # One scan, one beginning of time: the second sequence comes after the first.
    times_s = [shot.time_s for shot in capture.shots if shot.camera == "right"]
    assert times_s[0] == 0.0
    assert all(a is not None and b is not None and a < b for a, b in pairwise(times_s))
    assert CaptureHeader.of(capture) == sink.header == CaptureHeader.of(replace(capture, shots=tuple(sink.shots)))
    assert sink.evidence == check_exposures(capture)
    assert str(sink.evidence) == f"{COUNT}/{COUNT} patterns verified"
    assert told[-1] == (1.0, f"frame {2 * COUNT} of {2 * COUNT}")


def test_a_frame_that_fails_is_shot_again_at_its_own_exposure(tmp_path: Path) -> None:
    sink, rig = Sink(), fake()
    rig.cameras["right"].faults.garbled = frozenset({COUNT + 17})
    captured(rig, tmp_path / "bundle", sink=sink)
    assert frames_of(tmp_path / "bundle") == every({"right": BRACKET})
    (refused,) = read_refused(tmp_path / "bundle")
    assert (refused.pattern, refused.camera) == (17, "right")
    assert refused.cause.startswith("at 0.01 s, ")
    recorded = read_bundle(tmp_path / "bundle")
    assert sink.evidence == check_exposures(recorded.capture, [refused])
    assert str(sink.evidence) == f"{COUNT}/{COUNT} patterns verified, 1 frame shot again"


def test_an_exposure_that_is_too_long_or_too_short_is_left_out_and_the_report_says_so(tmp_path: Path) -> None:
    rig, sink = fake(), Sink()
    told = captured(rig, tmp_path / "bundle", (0.0001, 0.005, 0.01, 0.08, 0.16), sink=sink)
    used = (0.005, 0.01)
    assert frames_of(tmp_path / "bundle") == every({"right": used})
    # What is too long by far is not tried any longer.
    assert 0.16 not in rig.cameras["right"].exposures_s
    assert told[-1][0] < 1.0
    capture, refused = read_bundle(tmp_path / "bundle").capture, read_refused(tmp_path / "bundle")
    summary = check_exposures(capture, refused)
    assert summary == sink.evidence
    report = capture_report(CaptureHeader.of(capture), Axis.COLUMN, summary)
    notes = capture_notes(CaptureHeader.of(capture), Axis.COLUMN, summary)
    assert len(notes) == 2
    for note, words in zip(sorted(notes), ("0.0001 s is too dark", "0.08 s is too bright"), strict=True):
        assert note.startswith(f"an exposure was left out: {words} for camera 'right': ")
    assert summary.verified == summary.patterns == COUNT
    evidence = report["evidence"]
    assert isinstance(evidence, dict)
    assert not any("left out" in cause for cause in evidence["shot_again_because"])


@pytest.mark.slow
def test_an_exposure_that_one_camera_cannot_use_is_the_others_all_the_same(tmp_path: Path) -> None:
    rig = fake({"left": 0.6, "right": 4.0})
    rig.cameras["right"].scene.noise_dn = 0.2
    captured(rig, tmp_path / "bundle", (0.002, 0.01, 0.016))
    assert frames_of(tmp_path / "bundle") == every({"left": (0.002, 0.01, 0.016), "right": (0.002,)})
    summary = check_exposures(read_bundle(tmp_path / "bundle").capture, read_refused(tmp_path / "bundle"))
    assert (summary.verified, summary.faults) == (COUNT, ())
    assert summary.shot_again > 0


@pytest.mark.slow
def test_a_reconstruction_that_was_fed_an_exposure_that_is_left_out_reads_the_bundle(tmp_path: Path) -> None:
    feeds = [FrameFeed(lambda _message: True) for _ in range(2)]
    for feed, exposures_s in zip(feeds, (BRACKET, (0.005, 0.08)), strict=True):
        rig = fake()
        rig.rig = replace(rig.rig, calibration=sample_calibration())
        captured(rig, tmp_path / f"{exposures_s[-1]}", exposures_s, sink=feed)
        assert feed.settled(WAIT_S)
    assert [feed.whole for feed in feeds] == [True, False]


def ended(rig: Fake, folder: Path, exposures_s: Sequence[float] = BRACKET) -> str:
    with pytest.raises(ScanEvidenceError) as caught:
        captured(rig, folder, exposures_s)
    assert "The frames are kept" in str(caught.value)
    assert json.loads((folder / "refused" / "refused.json").read_text())["ended"] in str(caught.value)
    return str(caught.value)


def test_a_lamp_that_goes_off_is_not_taken_for_a_short_exposure(tmp_path: Path) -> None:
    told = ended(fake(dies_at=COUNT), tmp_path / "bundle")
    assert told.startswith("at an exposure of 0.01 s, camera ")
    assert "is the lamp off" in told
    # What the first exposure has shown is kept.
    assert every({"right": (0.005,)}) <= frames_of(tmp_path / "bundle")


def test_a_bracket_of_which_nothing_is_of_use_ends_the_scan(tmp_path: Path) -> None:
    assert "no exposure of the bracket is of use to camera 'right': 0.0002 s is too dark" in ended(
        fake(), tmp_path / "dark", (0.0001, 0.0002)
    )
    told = ended(fake(), tmp_path / "bright", (0.08, 0.2))
    assert "no exposure of the bracket is of use to camera 'right': 0.08 s is too bright" in told


def test_frames_that_are_wrong_at_one_exposure_for_good_end_the_scan(tmp_path: Path) -> None:
    rig = fake()
    rig.cameras["right"].faults.garbled = frozenset(range(COUNT + 17, 1000))
    told = ended(rig, tmp_path / "bundle")
    assert told.startswith("at an exposure of 0.01 s, camera 'right', pattern 17 ")
    assert "failed 3 times" in told


@pytest.mark.slow
def test_what_moves_between_two_exposures_ends_the_scan(tmp_path: Path) -> None:
    told = ended(fake(pushed_at=2), tmp_path / "bundle")
    assert "camera 'right', pattern" in told
    assert "looks otherwise at 0.01 s than at 0.005 s" in told


def test_a_cancel_at_the_second_exposure_leaves_nothing(tmp_path: Path) -> None:
    asked = 0

    def cancelled() -> bool:
        nonlocal asked
        asked += 1
        return asked > 40

    with pytest.raises(ScanCancelledError):
        captured(fake(), tmp_path / "bundle", cancelled=cancelled)
    assert list(tmp_path.iterdir()) == []


def test_a_camera_that_sets_another_exposure_than_asked_is_refused(tmp_path: Path) -> None:
    rig = fake()
    rig.cameras["right"].faults.readback = 1.2
    with pytest.raises(SlrigError, match=r"asked for exposure 0\.005 s, it uses 0\.006 s"):
        captured(rig, tmp_path / "bundle")


@pytest.mark.slow
def test_a_recorded_capture_of_two_cameras_with_one_exposure_each_is_no_bracket(tmp_path: Path) -> None:
    rig = fake({"left": 0.6, "right": 0.5})
    capture_frames(rig.rig, ScanPlan(), tmp_path / "bundle", progress=lambda *_: None, cancelled=lambda: False).finish()
    capture = read_bundle(tmp_path / "bundle").capture
    apart = Capture(
        capture.projector,
        capture.patterns,
        capture.cameras,
        tuple(replace(shot, exposure_s=0.03) if shot.camera == "right" else shot for shot in capture.shots),
    )
    assert check_exposures(apart) == check_exposures(capture)

"""What a capture leaves on disk and tells the reconstruction: when all goes well, when frames are shot again, and when
they fail for good.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from slrig.bundle import read_bundle
from slrig.bundle.notes import read_notes
from slrig.bundle.refused import read_refused
from slrig.bundle.stage import StageAngle, read_stage
from slrig.capture.evidence import EvidenceSummary, check_capture
from slrig.devices import CameraSettings, Projector, Synchronisation, Trigger
from slrig.errors import (
    BundleError,
    DeviceGoneError,
    FrameTimeoutError,
    ScanCancelledError,
    ScanEvidenceError,
    SlrigError,
    UnsupportedByDeviceError,
)
from slrig.jobs.frame_feed import Abandon, FrameFeed
from slrig.model import Calibration, Shot
from slrig.model.header import CaptureHeader
from slrig.scan.acquisition import capture_frames, exposed
from slrig.scan.plan import PresetUse, ScanPlan
from slrig.scan.report import capture_report
from slrig.scan.stream import ScanStream
from tests.contract.benches import PROJECTOR, simulated
from tests.contract.suite import rig_of
from tests.samples import sample_calibration
from tests.unit.capture.fake_rig import CameraFaults, FakeRig, FakeTurntable, fake_rig
from tests.unit.doctor.test_doctor import OtherCamera, small_rig
from tests.unit.scan.fakes import WAIT_S


def faulty(**faults: object) -> FakeRig:
    return fake_rig(faults={"right": CameraFaults(**faults)})  # type: ignore[arg-type]


class Sink:
    """Hears what a reconstruction would."""

    def __init__(self) -> None:
        self.header: CaptureHeader | None = None
        self.shots: list[Shot] = []
        self.evidence: EvidenceSummary | None = None

    def begin(self, header: CaptureHeader, _calibration: Calibration | None) -> None:
        self.header = header

    def take(self, shot: Shot) -> None:
        self.shots.append(shot)

    def end(self, evidence: EvidenceSummary) -> None:
        self.evidence = evidence


def captured(
    fake: FakeRig, folder: Path, sink: Sink | FrameFeed | None = None, *, plan: ScanPlan | None = None
) -> list[tuple[float, str]]:
    told: list[tuple[float, str]] = []
    capture_frames(
        fake.rig,
        plan or ScanPlan(),
        folder,
        progress=lambda _stage, fraction, detail: told.append((fraction, detail)),
        cancelled=lambda: False,
        frames=sink,
    ).finish()
    assert fake.at_rest
    return told


def test_a_sound_capture_is_a_bundle(tmp_path: Path) -> None:
    sink = Sink()
    told = captured(fake_rig(), tmp_path / "bundle", sink)
    capture = read_bundle(tmp_path / "bundle").capture
    assert len(capture.shots) == len(sink.shots) == 44
    assert sink.evidence == check_capture(capture)
    assert told[-1] == (1.0, "frame 44 of 44")


def test_a_rig_whose_latency_was_never_measured_says_so(tmp_path: Path) -> None:
    with small_rig(tmp_path) as rig:
        free = replace(rig, cameras={"eye": OtherCamera(rig.cameras["eye"], frozenset({Trigger.FREE}))})
        known = replace(free, synchronisation=Synchronisation(0.0, 0.001))
        for name, each in (("unmeasured", free), ("measured", known), ("triggered", rig)):
            capture_frames(
                each, ScanPlan(), tmp_path / name, progress=lambda *_: None, cancelled=lambda: False
            ).finish()
    [note] = read_notes(tmp_path / "unmeasured")
    assert "cameras that run by themselves (eye)" in note
    assert "Run slrig latency" in note
    assert read_notes(tmp_path / "measured") == ()
    assert not (tmp_path / "triggered" / "notes.json").exists()


def test_the_turntable_turns_before_the_first_frame_and_the_bundle_says_where_to(tmp_path: Path) -> None:
    fake, table = fake_rig(), FakeTurntable()
    on_stage = replace(fake, rig=replace(fake.rig, positioner=table))
    told = captured(on_stage, tmp_path / "table", plan=ScanPlan(turn_deg=135.0))
    assert (told[0], table.turned_deg) == ((0.0, "to 135°"), [135.0])
    assert read_stage(tmp_path / "table") == StageAngle(angle_deg=135.0, turned_by="table")
    # A hand has turned: the table stays where it is.
    captured(on_stage, tmp_path / "hand", plan=ScanPlan(turn_deg=90.0, turned_by="hand"))
    assert table.turned_deg == [135.0]
    assert read_stage(tmp_path / "hand") == StageAngle(angle_deg=90.0, turned_by="hand")
    captured(on_stage, tmp_path / "none")
    assert read_stage(tmp_path / "none") is None


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


@pytest.mark.parametrize("text", ['{"angle_deg": NaN, "turned_by": "hand"}', '{"angle_deg": 1}', "[]"])
def test_an_angle_that_is_none_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "stage.json").write_text(text)
    with pytest.raises(BundleError, match=r"stage\.json"):
        read_stage(tmp_path)


def test_notes_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text('{"light": "late"}')
    with pytest.raises(BundleError, match="expected a JSON list of strings"):
        read_notes(tmp_path)


def test_a_frame_that_was_shot_again_is_right_in_the_bundle_and_kept_beside_it(tmp_path: Path) -> None:
    sink = Sink()
    told = captured(faulty(stale=frozenset({5}), garbled=frozenset({17})), tmp_path / "bundle", sink)
    capture = read_bundle(tmp_path / "bundle").capture
    assert [(shot.pattern, shot.camera) for shot in capture.shots] == [
        (index, name) for index in range(22) for name in ("left", "right")
    ]
    refused = read_refused(tmp_path / "bundle")
    assert {(each.pattern, each.camera) for each in refused} >= {(4, "right"), (5, "right")}
    summary = check_capture(capture, refused)
    assert (summary.verified, summary.faults, summary.shot_again) == (22, (), len(refused))
    assert sink.evidence is not None
    assert sink.evidence.causes == summary.causes
    assert str(sink.evidence) == str(summary) == f"22/22 patterns verified, {len(refused)} frames shot again"
    assert told[-1] == (1.0, f"frame 44 of 44, {len(refused)} shot again")
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)


def test_the_report_says_what_was_verified_and_what_was_shot_again(tmp_path: Path) -> None:
    captured(faulty(garbled=frozenset({17})), tmp_path / "bundle")
    bundle = read_bundle(tmp_path / "bundle")
    stream = ScanStream(
        CaptureHeader.of(bundle.capture), replace(sample_calibration(), projector=None), entered=lambda *_: None
    )
    report = capture_report(
        CaptureHeader.of(bundle.capture), stream.axis, check_capture(bundle.capture, read_refused(bundle.folder))
    )
    assert report["identity"] == "22/22 patterns verified, 1 frame shot again"
    evidence = report["evidence"]
    assert isinstance(evidence, dict)
    assert (evidence["patterns_verified"], evidence["shot_again"]) == ("22/22", 1)
    (cause,) = evidence["shot_again_because"]
    assert cause.startswith("camera 'right', pattern 17 (column lines, shift 5 of 8): ")


def test_a_reconstruction_that_was_fed_a_frame_that_is_replaced_reads_the_bundle(tmp_path: Path) -> None:
    sent: list[object] = []

    def send(message: object) -> bool:
        sent.append(message)
        return True

    feed = FrameFeed(send)
    fake = faulty(stale=frozenset({5}))
    captured(replace(fake, rig=replace(fake.rig, calibration=sample_calibration())), tmp_path / "b", feed)
    assert feed.settled(WAIT_S)
    assert not feed.whole
    assert isinstance(sent[-1], Abandon)


def test_a_reconstruction_that_was_fed_no_frame_that_is_replaced_goes_on(tmp_path: Path) -> None:
    feed = FrameFeed(lambda _message: True)
    # A line frame is judged as it comes, before anybody sees it.
    fake = faulty(garbled=frozenset({17}))
    captured(replace(fake, rig=replace(fake.rig, calibration=sample_calibration())), tmp_path / "b", feed)
    assert feed.settled(WAIT_S)
    assert feed.whole


@pytest.mark.parametrize(
    ("faults", "kind"),
    [
        ({"garbled": frozenset(range(17, 1000))}, ScanEvidenceError),
        ({"drop": frozenset(range(17, 1000))}, FrameTimeoutError),
    ],
)
def test_frames_that_fail_for_good_are_kept(tmp_path: Path, faults: dict[str, object], kind: type[SlrigError]) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(kind, match=r"failed 3 times.*The frames are kept: see bundle.json .*, refused/ for the others"):
        captured(faulty(**faults), folder)
    capture = read_bundle(folder).capture
    assert {shot.pattern for shot in capture.shots if shot.camera == "right"} == set(range(17))
    # As far as they go, they are right.
    assert check_capture(capture).faults == ()
    told = json.loads((folder / "refused" / "refused.json").read_text())
    assert "failed 3 times" in told["ended"]
    worst = [each for each in told["frames"] if each["pattern"] == 17]
    assert [each["attempt"] for each in worst] == [1, 2, 3]
    assert all((folder / each["file"]).is_file() for each in told["frames"] if "file" in each)
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_a_lamp_that_is_off_leaves_what_the_cameras_saw(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(ScanEvidenceError, match="is the lamp off"):
        captured(fake_rig(projector={"lamp_off": True}), folder)
    refused = json.loads((folder / "refused" / "refused.json").read_text())["frames"]
    assert len(refused) >= 6
    assert np.mean([(folder / each["file"]).is_file() for each in refused]) == 1


def test_a_device_that_is_gone_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError):
        captured(faulty(unplug_at=9), tmp_path / "bundle")
    assert list(tmp_path.iterdir()) == []


def test_a_cancel_after_a_refusal_leaves_nothing(tmp_path: Path) -> None:
    count = 0

    def cancelled() -> bool:
        nonlocal count
        count += 1
        return count > 30

    with pytest.raises(ScanCancelledError):
        capture_frames(
            faulty(stale=frozenset({5})).rig,
            ScanPlan(),
            tmp_path / "bundle",
            progress=lambda *_: None,
            cancelled=cancelled,
        ).finish()
    assert list(tmp_path.iterdir()) == []


def steady(folder: Path, **exposing: tuple[float, ...]) -> tuple[set[float | None], list[str]]:
    """The exposures of a scan on a rendered display of 250 Hz, and what it told."""
    display = {
        "size_px": [PROJECTOR.width_px, PROJECTOR.height_px],
        "focal_px": [440.0, 440.0],
        "position_mm": [90.0, 0.0, -500.0],
        "target_mm": [0.0, 0.0, 0.0],
        "blur_px": 0.4,
        "refresh_hz": 250.0,
    }
    told: list[str] = []
    with simulated(folder, projector=display).head() as head:
        capture_frames(
            rig_of(head),
            ScanPlan(**exposing),  # type: ignore[arg-type]
            folder / "bundle",
            progress=lambda _stage, _fraction, detail: told.append(detail),
            cancelled=lambda: False,
        ).finish()
    shots = read_bundle(folder / "bundle").capture.shots
    return {None if shot.exposure_s is None else round(shot.exposure_s, 9) for shot in shots}, told


def test_exposures_are_whole_refresh_periods_of_the_projector_and_it_says_so(tmp_path: Path) -> None:
    exposures_s, told = steady(tmp_path)
    assert exposures_s == {0.016}
    words = "camera 'left' exposes for 0.016 s instead of 0.0166667 s: whole periods of the projector (0.004 s)"
    assert words in told


def test_exposures_of_a_bracket_that_become_one_are_played_once(tmp_path: Path) -> None:
    exposures_s, told = steady(tmp_path, exposures_s=(0.0075, 0.0085, 0.02))
    assert exposures_s == {0.008, 0.02}
    assert sum("instead of" in words for words in told) == 2


def test_factors_are_of_the_rigs_own_exposure_as_far_as_the_projector_lets(tmp_path: Path) -> None:
    exposures_s, told = steady(tmp_path, exposure_factors=(1.8, 0.12))
    # Of 1/60 s, in whole periods of 4 ms.
    assert exposures_s == {0.004, 0.032}
    assert sum("instead of" in words for words in told) == 2


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


class Refreshing:
    """The information of a projector with another refresh period."""

    def __init__(self, projector: Projector, refresh_s: float) -> None:
        self.info = replace(projector.info, refresh_s=refresh_s)

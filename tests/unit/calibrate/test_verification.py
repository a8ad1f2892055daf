"""A verification in line with the scans: shot, judged with those before it, put on record, or refused in words."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID
from xml.etree import ElementTree

import numpy as np
import pytest

from slrig.bundle import write_calibration
from slrig.calibrate.store import ReadPose
from slrig.calibrate.verification import (
    HealthStore,
    RigHealth,
    VerificationJob,
    VerificationRecord,
    health_stamp,
    health_svg,
    require_healthy,
    verify_bundle,
)
from slrig.calibration.board import Board, BoardKind, PoseObservation, ViewQuality
from slrig.calibration.health import Health, HealthState, Verification, judge_health
from slrig.devices import Rig
from slrig.errors import CalibrationStateError, PoseRefusedError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.jobs.resume import resume
from slrig.jobs.store import JobStore
from slrig.model import Calibration
from tests.unit.calibrate.health_bench import a_verification, hours
from tests.unit.calibration.health.drifting import bench
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.jobs.tame_manager import TameManager
from tests.unit.scan.bench import PIPELINE
from tests.unit.scan.fakes import WAIT_S, TameProjector, TameRecording

BOARD = Board(BoardKind.CHESSBOARD, 11, 8, 12.0)
CALIBRATION = bench().calibration


def capture(rig: Rig, _plan: object, folder: Path, _listener: object, /) -> TameRecording:
    """Writes a bundle that has only its calibration."""
    folder.mkdir()
    if rig.calibration is not None:
        write_calibration(folder / "calibration.json", rig.calibration)
    return TameRecording()


def read(folder: Path, _board: Board, name: str) -> ReadPose:
    assert (folder / "calibration.json").exists()
    return ReadPose(PoseObservation(name, {}), {"left": ViewQuality(0.02, 0.0, 0.5, 0.7, 1.0)})


def moving(_folder: Path, _board: Board, name: str) -> ReadPose:
    return ReadPose(PoseObservation(name, {}), {"left": ViewQuality(0.9, 0.0, 0.5, 0.7, 1.0)})


@pytest.fixture(autouse=True)
def tame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shoots and reads nothing, and finds what `a_verification` says."""
    monkeypatch.setattr("slrig.calibrate.verification.capture_frames", capture)
    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", read)
    monkeypatch.setattr("slrig.calibration.health.verification.verify_by_board", lambda *_: a_verification())


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[DataFolder]:
    found = DataFolder(tmp_path / "data")
    yield found
    found.release()


@pytest.fixture
def store(folder: DataFolder) -> Iterator[HealthStore]:
    found = HealthStore(Database(folder.database))
    yield found
    found.database.close()


class Verifying:
    """Verifications on a rig that is no rig; without a calibration it is not open yet."""

    def __init__(
        self, folder: DataFolder, store: HealthStore, calibration: Calibration | None = CALIBRATION, **options: Any
    ) -> None:
        rig = Rig("bench", {}, TameProjector(), {}, calibration)
        jobs, worker = JobStore(store.database), TameCompute(PIPELINE)
        self.manager = TameManager(jobs, folder, rig, worker, opened=calibration is not None)
        self.health = RigHealth(self.manager.rig, store, folder, **options)
        self.manager.groups[JobKind.VERIFICATION] = self.health

    def done(self) -> JobRecord:
        """A verification from beginning to end."""
        return self.manager.wait(self.manager.submit(VerificationJob(BOARD), wait=True)[0].id, WAIT_S)


def test_a_verification_is_shot_judged_and_put_on_record(folder: DataFolder, store: HealthStore) -> None:
    verifying = Verifying(folder, store, clock=lambda: hours(1))
    assert verifying.health.health()[0].state is HealthState.UNKNOWN
    job = verifying.done()
    assert job.state is JobState.SUCCEEDED
    latest = store.latest()
    assert latest is not None
    assert job.summary == json.loads(json.dumps(latest.document()))
    assert (latest.at, latest.calibration) == (hours(1), "0123456789ab")
    told = [(event.kind, event.data["state"]) for event in verifying.manager.store.events(job.id, after=0)]
    assert told == [
        ("state", "queued"), ("state", "capturing"), ("captured", "capturing"), ("state", "computing"),
        ("state", "succeeded"),
    ]  # fmt: skip
    health, found, calibration = verifying.health.health()
    assert health.state is HealthState.GOOD
    assert found == latest
    assert calibration is CALIBRATION
    assert list(folder.incoming.iterdir()) == []
    # Both outlive the service.
    again = HealthStore(Database(folder.database))
    assert Verifying(folder, again).manager.store.get(job.id) == job
    kept = again.latest()
    assert kept is not None
    assert kept.document() == latest.document()
    assert kept.found.document() == a_verification().document()
    again.database.close()


def test_rig_without_a_calibration_fails_with_a_remedy(folder: DataFolder, store: HealthStore) -> None:
    verifying = Verifying(folder, store, None)
    job = verifying.done()
    assert job.state is JobState.FAILED
    assert job.fault is not None
    assert job.fault.code == "calibration-state"
    assert "Calibrate it" in job.fault.message
    assert verifying.health.health()[0].state is HealthState.UNKNOWN


def test_a_board_that_moved_is_refused_and_leaves_nothing(
    folder: DataFolder, store: HealthStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", moving)
    job = Verifying(folder, store).done()
    assert job.state is JobState.FAILED
    assert job.fault is not None
    assert "camera 'left': the board moved by 0.90 px while it was shot" in job.fault.message
    assert store.latest() is None
    assert list(folder.incoming.iterdir()) == []


def test_after_a_kill_one_that_waited_is_shot_and_one_under_way_is_interrupted(
    folder: DataFolder, store: HealthStore
) -> None:
    before = Verifying(folder, store).manager
    before.lazy = True
    waiting, shot = (before.submit(VerificationJob(BOARD), wait=True)[0].id for _ in range(2))
    before.store.advance(shot, JobState.CAPTURING)
    after = Verifying(folder, store).manager
    resume(after)
    assert after.wait(waiting, WAIT_S).state is JobState.SUCCEEDED
    cut_off = after.store.get(shot)
    assert cut_off.state is JobState.INTERRUPTED
    assert cut_off.fault is not None
    assert cut_off.fault.code == "scan-interrupted"


def test_a_recorded_pose_is_judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture(Rig("bench", {}, TameProjector(), {}, CALIBRATION), None, tmp_path / "pose", None)
    assert verify_bundle(tmp_path / "pose", BOARD, CALIBRATION).document() == a_verification().document()
    monkeypatch.setattr("slrig.calibrate.pose_reading.read_pose", moving)
    with pytest.raises(PoseRefusedError, match="put it on a stand"):
        verify_bundle(tmp_path / "pose", BOARD, CALIBRATION)


def test_a_stale_rig_refuses_scans_if_its_file_says_so() -> None:
    stale = Health(HealthState.STALE, ("the projector turned by 0.05°",), "check its mount, and calibrate again")
    require_healthy(stale, refuse_when_stale=False)
    require_healthy(Health(HealthState.WATCH, ("it warms up",)), refuse_when_stale=True)
    require_healthy(Health(HealthState.UNKNOWN, ()), refuse_when_stale=True)
    with pytest.raises(CalibrationStateError, match=r"the projector turned by 0.05°\. What to do: check its mount"):
        require_healthy(stale, refuse_when_stale=True)


def test_a_scan_is_stamped_with_the_health_of_its_time(store: HealthStore) -> None:
    record = store.add(a_verification(), calibration=CALIBRATION.solve_id, at=hours(2))
    stamp = health_stamp(record.health, record, calibration="one", error_mm=0.04)
    assert (stamp["calibration"], stamp["expected_error_mm"]) == ("one", 0.04)
    assert stamp["state"] == "good"
    assert stamp["verification"] == str(record.id)
    assert stamp["verified_at"] == "2026-11-20T10:00:00+00:00"
    assert health_stamp(Health(HealthState.UNKNOWN, ()), None)["verified_at"] is None


def test_the_last_look_at_the_board_tells_the_error_when_scans_came_after_it(store: HealthStore) -> None:
    board = a_verification(3.0)
    store.add(board, calibration="one", at=hours(1))
    store.add(replace(board, kind="scan", expected_mm=None, stated_mm=None), calibration="one", at=hours(2))
    store.add(a_verification(), calibration="two", at=hours(3))
    found = store.last_by_board("one")
    assert found is not None
    assert found.expected_mm == 0.03
    assert store.last_by_board("none") is None


def test_history_is_newest_first_limited_and_since(store: HealthStore) -> None:
    for hour in range(6):
        store.add(a_verification(), calibration="one" if hour < 4 else "two", at=hours(hour))
    assert [record.at for record in store.history(limit=2)] == [hours(5), hours(4)]
    assert [record.at for record in store.history(since=hours(3))] == [hours(5), hours(4), hours(3)]
    assert [record.at for record in store.since_calibration("one")] == [hours(hour) for hour in range(4)]


def test_a_look_is_judged_with_those_before_it_since_the_calibration(store: HealthStore) -> None:
    for hour in range(3):
        store.add(a_verification(), calibration="one", at=hours(hour))
    # One look that is bad by a little is no alarm; the same one after a calibration without others is.
    assert store.add(a_verification(1.8, evidence=10), calibration="one", at=hours(4)).health.state is HealthState.GOOD
    assert store.add(a_verification(1.8, evidence=10), calibration="one", at=hours(5)).health.state is HealthState.WATCH
    assert store.health_of("one").state is HealthState.WATCH
    assert store.health_of("two").state is HealthState.UNKNOWN
    assert store.add(a_verification(1.8, evidence=10), calibration="two", at=hours(6)).health.state is HealthState.WATCH
    knocked = store.add(a_verification(12, evidence=4000), calibration="one", at=hours(7)).health
    assert knocked.state is HealthState.STALE
    assert "camera 'left' turned by 0.050" in " ".join(knocked.reasons)


parsed = ElementTree.fromstring
_SVG = "{http://www.w3.org/2000/svg}"


def warm_up() -> list[VerificationRecord]:
    """A rig that warms up, is calibrated again, and is then knocked."""
    rng = np.random.default_rng(0)
    records: list[VerificationRecord] = []
    verifications: list[Verification] = []
    for number in range(60):
        if number in (0, 36):
            verifications = []
        share = 1 - np.exp(-number / 12)
        scatter = rng.normal(0, 0.04)
        if number < 36:
            found = a_verification(1 + 2.4 * share + scatter, mean_px=0.14 * share + scatter / 9, evidence=30 * share)
        else:
            found = (
                a_verification(1 + scatter, mean_px=scatter / 9)
                if number < 54
                else a_verification(4.4, mean_px=0.42, evidence=900)
            )
        verifications.append(found)
        name = "one" if number < 36 else "two"
        records.append(
            VerificationRecord(number, UUID(int=number), hours(number / 4), name, found, judge_health(verifications))
        )
    return records


def test_every_verification_is_a_dot_in_the_colour_of_its_state() -> None:
    records = warm_up()
    picture = parsed(health_svg(records))
    dots = [dot for dot in picture.iter(f"{_SVG}circle") if dot.find(f"{_SVG}title") is not None]
    assert len(dots) == 60
    for dot, record in zip(dots, records, strict=True):
        told = dot.find(f"{_SVG}title")
        assert told is not None
        assert f": {record.health.state}." in (told.text or "")
    # The worse the error, the higher the dot.
    heights = [float(dot.get("cy", "nan")) for dot in dots]
    assert heights[30] < heights[0] - 20
    assert len({dot.get("fill") for dot in dots}) == 3


def test_thresholds_and_the_recalibration_are_named() -> None:
    texts = [text.text for text in parsed(health_svg(warm_up())).iter(f"{_SVG}text")]
    for words in ("as calibrated", "watch, 1.4 x", "stale, 3 x", "watch (mean)", "stale (mean)"):
        assert words in texts
    assert texts.count("calibrated") == 1
    assert health_svg(warm_up()).count('stroke-dasharray="2 3"') == 1, "a line where it was calibrated again"
    assert "left - projector" in texts
    odd = VerificationRecord(1, UUID(int=1), hours(0), "<b>", warm_up()[0].found, judge_health([]))
    assert "<b>" not in health_svg([odd, warm_up()[0]])
    assert len(list(parsed(health_svg(warm_up()[:1])).iter(f"{_SVG}circle"))) >= 1
    assert "Nothing was verified yet" in health_svg([])


def test_a_calibration_that_states_no_error_has_no_axis_of_it() -> None:
    record = warm_up()[0]
    silent = replace(record, found=replace(record.found, expected_mm=0.0, stated_mm=None))
    assert "No verification shows a change" in health_svg([silent])
    assert "Change since calibration" not in health_svg([silent])
    assert "No verification shows a change" not in health_svg([silent, record])

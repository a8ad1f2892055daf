"""Acceptance tests on a service's rig: held for each position, kept in between, cancelled, refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest

from slrig.accept import job as acceptance
from slrig.accept.evaluation import Reading
from slrig.accept.job import AcceptanceTests, PositionJob
from slrig.accept.plan import AcceptancePlan, AcceptanceRequest, usual_limits
from slrig.accept.store import AcceptanceState, record_from_json, record_json
from slrig.calibration.artefacts import Decision
from slrig.devices import Rig
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    CalibrationStateError,
    DeviceBusyError,
    InvalidInputError,
    JobNotFoundError,
    NothingToReconstructError,
    RigBusyError,
    ScanStateError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.failure import interruption_error, job_failure
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.job import Outcome
from slrig.jobs.records import JobRecord, JobState
from slrig.jobs.resume import resume
from slrig.jobs.store import JobStore
from slrig.model import Calibration
from tests.unit.accept.test_plan import VOLUME
from tests.unit.accept.test_running import RIG, SHORT, take_scans_from
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.jobs.tame_manager import PowerCut, TameManager
from tests.unit.scan.bench import PIPELINE, wait_for
from tests.unit.scan.fakes import TamePositioner, TameProjector

PLAN = replace(SHORT, rendered=False)


class Desk(AcceptanceTests):
    """Tests whose measurements are over when they return."""

    manager: TameManager

    def measure(self, test_id: UUID, **asked: Any) -> JobRecord:
        job = super().measure(test_id, **asked)
        wait_for(self.manager.store, test_id, lambda: self.get(test_id).state is not AcceptanceState.MEASURING)
        return job


Desks = Callable[..., Desk]


@pytest.fixture
def desks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Desks]:
    """Makes the tests of a service, and those of one after it over the same folder and rig."""
    folder = DataFolder(tmp_path)
    store = JobStore(Database(folder.database))
    positioner = TamePositioner(tuple(step.name for step in PLAN.steps))
    rig = Rig("tame", {}, TameProjector(), {}, RIG, positioner=positioner)
    take_scans_from(monkeypatch, PLAN)

    def make(*, tolerance_mm: float | None = None) -> Desk:
        manager = TameManager(store, folder, rig, TameCompute(PIPELINE))
        desk = Desk(manager, tolerance_mm=tolerance_mm)
        desk.manager = manager
        desk.settle()
        resume(manager)
        return desk

    yield make
    store.database.close()


@pytest.fixture
def desk(desks: Desks) -> Desk:
    return desks()


def moves(desk: Desk) -> list[int]:
    """Where the artefacts were moved to."""
    positioner = desk.manager.bare.positioner
    assert isinstance(positioner, TamePositioner)
    return positioner.moves


def failure_code(desk: Desk, test_id: UUID) -> str | None:
    fault = desk.get(test_id).fault
    return None if fault is None else fault.code


def the_plan(_: Calibration, _wanted_mm: float | None) -> AcceptancePlan:
    return PLAN


def test_limits_follow_the_rig_file_unless_asked_for(desks: Desks) -> None:
    desk = desks(tolerance_mm=0.04)
    least, greatest = (tuple(corner) for corner in VOLUME.tolist())
    asked = AcceptanceRequest(volume_mm=(least, greatest))
    assert desk.open(asked.plan).plan.limits == usual_limits(VOLUME, 0.04)
    assert desk.open(asked.model_copy(update={"tolerance_mm": 0.01}).plan).plan.limits == usual_limits(VOLUME, 0.01)
    assert desks().open(asked.plan).plan.limits == usual_limits(VOLUME)


def test_by_hand_one_position_is_measured_at_a_time_with_its_repeats(desk: Desk) -> None:
    test = desk.open(the_plan)
    done = []
    while (record := desk.get(test.id)).state is AcceptanceState.OPEN:
        following = record.next_take
        assert following is not None
        assert following[1] == 0
        done.append(following[0].name)
        desk.measure(test.id, wait=False, scripted=False)
    assert done == ["sphere-1", "sphere-2", "bar-1", "plane-1"]
    assert moves(desk) == []
    assert desk.get(test.id).decision is Decision.PASSES
    assert desk.get(test.id).state is AcceptanceState.FINISHED
    assert desk.file(test.id, "report.html").is_file()
    assert set(desk.manager.holders) == {f"acceptance test {test.id}"}
    with pytest.raises(ScanStateError, match="is finished"):
        desk.measure(test.id, wait=False, scripted=False)


@pytest.mark.slow
def test_a_position_that_went_wrong_may_be_measured_again(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    test = desk.open(the_plan)

    def lost(*_: object, **__: object) -> None:
        message = "nothing there"
        raise NothingToReconstructError(message)

    with monkeypatch.context() as patched:
        patched.setattr(acceptance, "reading", lost)
        desk.measure(test.id, wait=False, scripted=False)
    record = desk.get(test.id)
    assert record.state is AcceptanceState.OPEN
    assert record.fault is not None
    assert record.fault.code == NothingToReconstructError.code
    assert record.readings == ()
    desk.measure(test.id, wait=False, scripted=False)
    assert desk.get(test.id).fault is None
    assert len(desk.get(test.id).readings) == PLAN.repeats


def test_a_cancelled_test_is_over(desk: Desk) -> None:
    waiting, running = desk.open(the_plan), desk.open(the_plan)
    assert desk.cancel(waiting.id).state is AcceptanceState.CANCELLED
    desk.manager.cancelled = lambda: True
    desk.measure(running.id, wait=False, scripted=True)
    assert desk.get(running.id).state is AcceptanceState.CANCELLED
    with pytest.raises(ScanStateError, match="is cancelled"):
        desk.measure(running.id, wait=False, scripted=True)
    with pytest.raises(ArtefactNotReadyError, match="is cancelled"):
        desk.file(running.id, "report.json")


def test_script_that_is_cancelled_while_a_position_is_measured_ends_with_it(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = desk.open(the_plan)
    evaluated = acceptance.evaluated

    def cancelled_meanwhile(*given: Any) -> Reading:
        desk.cancel(test.id)
        return evaluated(*given)

    monkeypatch.setattr(acceptance, "evaluated", cancelled_meanwhile)
    desk.measure(test.id, wait=False, scripted=True)
    assert desk.get(test.id).state is AcceptanceState.CANCELLED
    assert [(each.step, each.take) for each in desk.get(test.id).readings] == [("sphere-1", 0), ("sphere-1", 1)]
    assert moves(desk) == [0]


def test_next_position_is_put_on_record_once(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    test = desk.open(the_plan)
    evaluated = acceptance.evaluated

    def killed_afterwards(*given: Any) -> Reading:
        desk.manager.lazy = True
        return evaluated(*given)

    monkeypatch.setattr(acceptance, "evaluated", killed_afterwards)
    AcceptanceTests.measure(desk, test.id, wait=False, scripted=True)
    store = desk.manager.store
    wait_for(store, test.id, lambda: [job.state for job in store.of(test.id)] == [JobState.SUCCEEDED, JobState.QUEUED])
    first = store.of(test.id)[0]
    # As at the next start, where the end of the first was not on record.
    desk.ended(PositionJob.from_record(first), first.id, Outcome())
    assert [job.plan["step"] for job in store.of(test.id)] == ["sphere-1", "sphere-2"]


def test_what_cannot_be_tested_is_refused(desk: Desk) -> None:
    with pytest.raises(JobNotFoundError, match="No acceptance test"):
        desk.get(uuid4())
    exact = desk.open(lambda *_: replace(PLAN, rendered=True))
    desk.measure(exact.id, wait=False, scripted=True)
    assert failure_code(desk, exact.id) == InvalidInputError.code
    desk.manager.bare.positioner.poses = ("sphere-1",)  # type: ignore[union-attr, misc]
    test = desk.open(the_plan)
    desk.manager.busy = "1"
    with pytest.raises(RigBusyError):
        desk.measure(test.id, wait=False, scripted=False)
    assert desk.get(test.id).state is AcceptanceState.OPEN
    desk.manager.busy = None
    desk.measure(test.id, wait=False, scripted=True)
    assert failure_code(desk, test.id) == UnsupportedByDeviceError.code
    facts = desk.manager.rig.facts
    assert facts is not None
    desk.manager.rig.facts = replace(facts, calibration=None)
    with pytest.raises(CalibrationError, match="has no calibration"):
        desk.open(the_plan)
    desk.manager.rig.facts = None
    with pytest.raises(DeviceBusyError, match="being opened"):
        desk.open(the_plan)


@pytest.mark.slow
def test_a_finished_test_and_its_report_outlive_the_service(desks: Desks, tmp_path: Path) -> None:
    before = desks()
    waiting, test = before.open(the_plan), before.open(the_plan)
    before.measure(waiting.id, wait=False, scripted=False)
    before.measure(test.id, wait=False, scripted=True)
    # A script measures all that are left, one after the other.
    assert len(before.manager.holders) == 5
    assert moves(before) == [0, 1, 2, 3]
    after = desks()
    for each in (waiting.id, test.id):
        assert record_json(after.get(each)) == record_json(before.get(each))
    assert [each.id for each in after.latest()] == [test.id, waiting.id]
    assert after.get(test.id).decision is Decision.PASSES
    assert after.file(test.id, "report.html").is_file()
    # It was cut off between its report and its record.
    kept, finished = tmp_path / "acceptance" / str(test.id) / "test.json", before.get(test.id)
    kept.write_bytes(record_json(replace(finished, state=AcceptanceState.OPEN, decision=None)))
    assert record_json(desks().get(test.id)) == record_json(finished)
    # One that waits for its next position goes on.
    assert after.get(waiting.id).state is AcceptanceState.OPEN
    after.measure(waiting.id, wait=False, scripted=True)
    assert after.get(waiting.id).state is AcceptanceState.FINISHED
    third = after.open(the_plan)
    assert third.number == 3
    after.delete(test.id)
    assert [each.id for each in desks().latest()] == [third.id, waiting.id]


@pytest.mark.parametrize("ending", [pytest.param(PowerCut(), marks=pytest.mark.slow), interruption_error()], ids=repr)
def test_test_that_was_cut_off_is_interrupted_and_goes_on(desks: Desks, ending: BaseException) -> None:
    before = desks()
    test = before.open(the_plan)
    asked = []

    def cancelled() -> bool:
        asked.append(1)
        if len(asked) == 2:
            raise ending
        return False

    before.manager.cancelled = cancelled
    with suppress(PowerCut):
        before.measure(test.id, wait=False, scripted=True)
    stray = before._store.folder(test.id) / ".sphere-1-2"
    stray.mkdir(exist_ok=True)
    after = desks()
    assert after.get(test.id).state is AcceptanceState.INTERRUPTED
    assert after.get(test.id).fault == job_failure(interruption_error())
    assert not stray.exists()
    with pytest.raises(ArtefactNotReadyError, match="is interrupted"):
        after.file(test.id, "report.json")
    assert desks().get(test.id).state is AcceptanceState.INTERRUPTED
    moves(after).clear()
    after.measure(test.id, wait=False, scripted=True)
    # Between repeats nothing may be moved: the first position is measured from its first capture on.
    assert moves(after) == [0, 1, 2, 3]
    assert after.get(test.id).state is AcceptanceState.FINISHED
    assert [each.take for each in after.get(test.id).readings if each.step == "sphere-1"] == [0, 1]


def test_what_cannot_be_read_is_put_aside(desks: Desks, tmp_path: Path) -> None:
    test = desks().open(the_plan)
    kept = tmp_path / "acceptance" / str(test.id) / "test.json"
    text = kept.read_text()
    with pytest.raises(StorageError, match="not an acceptance test as this version"):
        record_from_json(text.replace("slrig-acceptance-test", "letter").encode(), "x")
    kept.write_text(text[:-30])
    assert desks().latest() == ()
    assert (tmp_path / ".orphans" / f"acceptance-{test.id}" / "test.json").is_file()


def test_links_among_the_tests_are_not_followed(desks: Desks, tmp_path: Path) -> None:
    test = desks().open(the_plan)
    root, elsewhere = tmp_path / "acceptance", tmp_path / "elsewhere"
    (root / str(test.id)).rename(elsewhere)
    (root / str(test.id)).symlink_to(elsewhere)
    (root / "nowhere").symlink_to(tmp_path / "absent")
    assert desks().latest() == ()
    (root / str(test.id)).unlink()
    (root / str(test.id)).mkdir()
    (root / str(test.id) / "test.json").symlink_to(elsewhere / "test.json")
    assert desks().latest() == ()
    assert (tmp_path / ".orphans" / f"acceptance-{test.id}" / "test.json").is_symlink()
    assert (elsewhere / "test.json").is_file()


def test_positions_of_one_test_are_measured_with_one_calibration(desk: Desk) -> None:
    test = desk.open(the_plan)
    desk.measure(test.id, wait=False, scripted=False)
    camera = RIG.cameras["left"]
    other = replace(camera, translation_mm=camera.translation_mm + 1)
    desk.manager.bare = replace(desk.manager.bare, calibration=Calibration({"left": other}, RIG.projector))
    desk.manager.rig.release()
    desk.measure(test.id, wait=False, scripted=False)
    assert failure_code(desk, test.id) == CalibrationStateError.code
    assert len(desk.get(test.id).readings) == PLAN.repeats
    assert desk.cancel(test.id).state is AcceptanceState.CANCELLED


def test_a_test_under_way_is_not_deleted(desk: Desk) -> None:
    test = desk.open(the_plan)
    refused: list[str] = []

    def cancelled() -> bool:
        with pytest.raises(ScanStateError, match="Cancel it, then delete it"):
            desk.delete(test.id)
        refused.append("refused")
        return True

    desk.manager.cancelled = cancelled
    desk.measure(test.id, wait=False, scripted=True)
    assert refused
    desk.delete(test.id)
    with pytest.raises(JobNotFoundError):
        desk.get(test.id)

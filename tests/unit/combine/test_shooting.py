"""Views of a model: shot by a table and by hand, failed and shot again, and gone on with after whatever ended the
service.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest

from slrig.combine.plan import GivenPoses, ModelPlan, ShootPlan, StatedAxis, TurntablePoses, plan_from_json, plan_json
from slrig.combine.shooting import ViewShooting
from slrig.devices import Rig
from slrig.errors import (
    ConfigError,
    DeviceGoneError,
    RigBusyError,
    ScanCancelledError,
    ScanEvidenceError,
    ScanStateError,
    StorageError,
    UnsupportedByDeviceError,
    ViewsFailedError,
)
from slrig.failure import failure_of
from slrig.jobs.job import Holder, Job
from slrig.jobs.records import JobProgress, JobRecord, JobState, utc_now
from slrig.jobs.rig_jobs import Recorded
from slrig.rig.session import RigSession
from slrig.scan.plan import ScanPlan
from slrig.scan.records import plan_from_json as scan_plan_from_json
from slrig.scan.records import plan_json as scan_plan_json
from tests.unit.capture.fake_rig import FakeTurntable
from tests.unit.combine.model_bench import ModelBench, kept_scan, until_told
from tests.unit.scan.fakes import WAIT_S

AXIS = StatedAxis((4.0, 45.0, 12.0), (0.0, -1.0, 0.0))
STILL = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def shoot_plan(views: int = 4, *, by_hand: bool = False, exposure_s: float | None = None) -> ModelPlan:
    return ModelPlan((), TurntablePoses(AXIS), shoot=ShootPlan(views, ScanPlan(exposure_s=exposure_s), by_hand))


class ShootingBench(ModelBench):
    """A bench whose rig has a turntable. shot : angle and cause of each capture, in order; faults : what the next
    captures at an angle raise.
    """

    def __init__(self, root: Path, *, table: bool = True, start: bool = True, **options: Any) -> None:
        self.table = FakeTurntable() if table else None
        self.shot: list[float | None] = []
        self.faults: dict[float, list[Exception]] = {}
        super().__init__(root, start=False, **options)
        self.shooting = ViewShooting(self.desk, self.runner, self.store)
        self.store.after_end = self.shooting.view_ended
        if start:
            known = threading.Event()
            self.runner.queue.add([_look(known)])
            # As a service does it.
            self.runner.take_up([scan.id for scan in self.store.unfinished()])
            self.desk.take_up()
            self.shooting.take_up()
            self.runner.start()
            assert known.wait(WAIT_S)

    def open_rig(self) -> Rig:
        return replace(super().open_rig(), positioner=self.table)

    def capture(self, rig: Rig, plan: ScanPlan, folder: Path, /, **how: Any) -> Recorded:
        self.shot.append(plan.turn_deg)
        if faults := self.faults.get(plan.turn_deg or 0.0):
            raise faults.pop(0)
        return super().capture(rig, plan, folder, **how)

    def views(self, model_id: UUID) -> list[tuple[float | None, JobState]]:
        """Angle and state of each scan of a model, from the first to the last."""
        scans = self.store.of(model_id).get(model_id, [])
        return [(scan_plan_from_json(scan.plan).turn_deg, scan.state) for scan in scans]

    def until_told(self, model_id: UUID, words: str) -> JobRecord:
        """The model once its progress says this."""
        return until_told(self.models, model_id, words)


def _look(known: threading.Event) -> Job:
    """Opens the rig, so that it is known what it can do."""

    def work(held: RigSession, _: Job) -> None:
        held.open()

    return Job(uuid4(), Holder("look", "look", None), utc_now(), work, lambda _: known.set())


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ShootingBench]:
    found = ShootingBench(tmp_path)
    yield found
    found.close()


def started(bench: ShootingBench, plan: ModelPlan | None = None, *, wait: bool = False) -> UUID:
    return bench.shooting.shoot(plan or shoot_plan(), label="cup", wait=wait).id


def test_all_views_are_shot_around_the_table_and_the_model_is_made_of_them(bench: ShootingBench) -> None:
    model_id = started(bench, shoot_plan(exposure_s=0.02))
    made = bench.over(model_id)
    assert (made.state, made.label, bench.shot) == (JobState.SUCCEEDED, "cup", [0.0, 90.0, 180.0, 270.0])
    scans = bench.runner.series(model_id)
    assert {each.label for each in scans} == {"cup"}
    assert {scan_plan_from_json(each.plan).exposure_s for each in scans} == {0.02}
    used = plan_from_json(made.plan)
    assert used.scans == tuple(each.id for each in scans)
    assert used.poses == TurntablePoses(AXIS, (0.0, 90.0, 180.0, 270.0))
    told = [event.data for event in bench.models.events(model_id, after=0)]
    assert [each["state"] for each in told if "time" in each] == ["queued", "capturing", "computing", "succeeded"]
    details = [each["detail"] for each in told if each.get("stage") == "view"]
    # A view that is computed is told while the next is shot, which may have ended, too, on a busy machine.
    assert details == sorted(details)
    assert details[0] == "view 1 of 4"
    assert set(details) <= {f"view {number} of 4" for number in (1, 2, 3, 4)}
    fractions = [each["fraction"] for each in told if "fraction" in each]
    assert fractions == sorted(fractions)
    assert made.summary is not None
    assert "notes" not in made.summary


def test_a_last_view_that_ends_before_it_is_told_is_no_first_one(
    bench: ShootingBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    model_id = started(bench)
    shoot = plan_from_json(bench.over(model_id).plan).shoot
    assert shoot is not None
    told: list[JobProgress] = []
    monkeypatch.setattr(bench.desk.jobs, "progress", lambda _, progress: told.append(progress))
    bench.shooting._tell(model_id, shoot)
    assert [each.detail for each in told] == ["view 4 of 4"]


def test_a_view_that_fails_is_told_and_a_devices_fault_is_tried_twice_more(bench: ShootingBench) -> None:
    gone = DeviceGoneError("left was unplugged")
    bench.faults = {90.0: [ScanEvidenceError("white is not brighter than black")], 180.0: [gone], 270.0: [gone] * 9}
    poses = GivenPoses(tuple(((1.0, 0.0, 0.0, float(view)), *STILL[1:]) for view in range(4)))
    made = bench.over(started(bench, replace(shoot_plan(), poses=poses)))
    assert made.state is JobState.SUCCEEDED
    assert [bench.shot.count(angle) for angle in (0.0, 90.0, 180.0, 270.0)] == [1, 1, 2, 3]
    assert made.summary is not None
    assert made.summary["notes"] == [
        "view 2 of 4, at 90°, is not in it: white is not brighter than black",
        "view 4 of 4, at 270°, is not in it: left was unplugged",
    ]
    used = plan_from_json(made.plan)
    assert isinstance(used.poses, GivenPoses)
    assert [matrix[0][3] for matrix in used.poses.matrices] == [0.0, 2.0]


def test_of_fewer_than_two_views_there_is_no_model_and_the_scans_stay(bench: ShootingBench) -> None:
    bench.faults = {angle: [ScanEvidenceError("too dark")] for angle in (90.0, 180.0, 270.0)}
    model_id = started(bench)
    failed = bench.over(model_id)
    assert (failed.state, failed.fault and failed.fault.code) == (JobState.FAILED, ViewsFailedError.code)
    assert failed.fault is not None
    assert (
        "1 of 4 views succeeded, and a model takes two: view 2 of 4, at 90°, is not in it: too" in failed.fault.message
    )
    states = [state for _, state in bench.views(model_id)]
    assert states == [JobState.SUCCEEDED, *[JobState.FAILED] * 3]


def test_a_cancelled_model_takes_its_waiting_views_with_it(bench: ShootingBench) -> None:
    bench.gate.clear()
    model_id = started(bench)
    assert bench.began.wait(WAIT_S)
    with pytest.raises(ScanStateError, match="is not shot by hand"):
        bench.shooting.combine(model_id)
    with pytest.raises(ScanStateError, match="is not shot by hand"):
        bench.shooting.shoot_view(model_id, again=True, wait=True)
    with (
        pytest.raises(ScanStateError, match=f"needed by model {model_id}"),
        bench.desk.unused(bench.runner.series(model_id)[3].id),
    ):
        pass
    assert bench.shooting.cancel(model_id).state is JobState.CANCELLED
    ended = [bench.until(scan.id).state for scan in bench.runner.series(model_id)]
    assert (ended, bench.shot) == ([JobState.CANCELLED] * 4, [0.0])
    assert bench.shooting.cancel(model_id).state is JobState.CANCELLED
    assert bench.models.unfinished() == []


def test_what_cannot_be_shot_is_refused_and_nothing_is_on_record(tmp_path: Path) -> None:
    bench = ShootingBench(tmp_path, table=False)
    with pytest.raises(UnsupportedByDeviceError, match=r"this rig has no turntable\. Turn it by hand"):
        started(bench)
    with pytest.raises(ConfigError, match="axis: expected that of the stage"):
        started(bench, replace(shoot_plan(), poses=TurntablePoses()))
    bench.held()
    with pytest.raises(RigBusyError):
        started(bench, shoot_plan(by_hand=True))
    assert bench.models.states() == {}
    for wrong in (1, 73):
        with pytest.raises(ConfigError, match=f"views: expected 2 to 72, found {wrong}"):
            ShootPlan(wrong)
    bench.close()


def test_by_hand_it_may_end_early_with_what_there_is(tmp_path: Path) -> None:
    bench = ShootingBench(tmp_path, table=False)
    model_id = started(bench, shoot_plan(4, by_hand=True))
    bench.until_told(model_id, "view 2 of 4")
    bench.shooting.shoot_view(model_id, again=False, wait=False)
    bench.until_told(model_id, "turn the object by 90° for view 3 of 4")
    bench.shooting.combine(model_id)
    made = bench.over(model_id)
    assert made.state is JobState.SUCCEEDED
    assert made.summary is not None
    assert made.summary["notes"] == [f"view {n} of 4, at {90 * n - 90}°, is not in it: it was not shot" for n in (3, 4)]
    bench.close()


def test_by_hand_each_view_waits_for_a_person_and_the_last_may_be_shot_again(tmp_path: Path) -> None:
    bench = ShootingBench(tmp_path, table=False)
    model_id = started(bench, shoot_plan(3, by_hand=True))
    waiting = bench.until_told(model_id, "turn the object by 120° for view 2 of 3")
    assert (waiting.state, waiting.progress.stage, bench.shot) == (JobState.CAPTURING, "turn", [0.0])
    with pytest.raises(ScanStateError, match="has 1 good views of 3; it takes two"):
        bench.shooting.combine(model_id)
    bench.faults = {120.0: [ScanEvidenceError("It moved.")]}
    bench.shooting.shoot_view(model_id, again=False, wait=False)
    bench.until_told(model_id, "view 2 failed, and may be shot again: It moved. Or turn the object by 120° for view 3")
    bench.gate.clear()
    bench.shooting.shoot_view(model_id, again=True, wait=False)
    with pytest.raises(ScanStateError, match=r"View 2 of model .* is being shot"):
        bench.shooting.shoot_view(model_id, again=False, wait=False)
    bench.gate.set()
    bench.until_told(model_id, "turn the object by 120° for view 3 of 3")
    bench.shooting.shoot_view(model_id, again=True, wait=False)
    bench.until_told(model_id, "turn the object by 120° for view 3 of 3")
    bench.shooting.shoot_view(model_id, again=False, wait=False)
    made = bench.over(model_id)
    assert (made.state, bench.shot) == (JobState.SUCCEEDED, [0.0, 120.0, 120.0, 120.0, 240.0])
    # The newest that succeeded counts.
    scans = bench.runner.series(model_id)
    assert plan_from_json(made.plan).scans == (scans[0].id, scans[3].id, scans[4].id)
    with pytest.raises(ScanStateError, match=f"Model {model_id} is succeeded"):
        bench.shooting.shoot_view(model_id, again=True, wait=False)
    bench.close()


def killed(root: Path, leave: Callable[[ShootingBench, UUID], None], *, by_hand: bool = False) -> UUID:
    """A model on record as a kill of the service leaves it."""
    bench = ShootingBench(root, start=False)
    bench.store.after_end = lambda _: None
    plan = shoot_plan(by_hand=by_hand)
    model_id = bench.models.create(plan_json(plan), rig="bench", label="cup").id
    leave(bench, model_id)
    bench.close()
    return model_id


def view(bench: ShootingBench, model_id: UUID, number: int, state: JobState, *, count: str | None = None) -> UUID:
    """A view on record that came as far as that. count : of the turntable's angle."""
    plan = ShootPlan(4).view(number, model_id, utc_now())
    document = scan_plan_json(plan)
    if state is JobState.SUCCEEDED:
        scan_id = kept_scan(bench.store, bench.folder)
        bench.store.delete(scan_id)
        summary = {} if count is None else {"stage": {"count": count}}
        bench.store.restore(
            scan_id, document, summary, rig="bench", label="cup", created_at=utc_now(), started_at=utc_now(),
            parent=model_id,
        )  # fmt: skip
        return scan_id
    [record] = bench.store.create_series([document], rig="bench", label="cup", parent=model_id)
    if state is not JobState.QUEUED:
        bench.store.advance(record.id, state)
    return record.id


def left(*states: JobState, count: str | None = None) -> Callable[[ShootingBench, UUID], None]:
    """Leaves views that came so far, and a model that was capturing. count : of the angle of those that succeeded."""

    def leave(bench: ShootingBench, model_id: UUID) -> None:
        for number, state in enumerate(states, start=1):
            view(bench, model_id, number, state, count=count)
        if states:
            bench.models.advance(model_id, JobState.CAPTURING)

    return leave


DONE, CAPTURING, QUEUED = JobState.SUCCEEDED, JobState.CAPTURING, JobState.QUEUED
all_shot, between_views = left(DONE, DONE, DONE, DONE), left(DONE, QUEUED, QUEUED, QUEUED)


def named(bench: ShootingBench, model_id: UUID) -> None:
    all_shot(bench, model_id)
    plan = plan_from_json(bench.models.get(model_id).plan)
    scans = tuple(scan.id for scan in bench.store.of(model_id)[model_id])
    bench.models.replan(
        model_id, plan_json(bench.desk.settled(replace(plan, scans=scans, poses=GivenPoses((STILL,) * 4))))
    )


def combining(bench: ShootingBench, model_id: UUID) -> None:
    named(bench, model_id)
    bench.models.advance(model_id, JobState.COMPUTING)


@pytest.mark.parametrize(
    ("leave", "shot"),
    [
        (left(), [0.0, 90.0, 180.0, 270.0]),
        (between_views, [90.0, 180.0, 270.0]),
        (left(DONE, CAPTURING, QUEUED, QUEUED), [180.0, 270.0, 90.0]),
        # The table lost its place.
        (left(DONE, DONE, QUEUED, QUEUED, count="before"), [180.0, 270.0, 0.0, 90.0]),
        (all_shot, []),
        (named, []),
        (combining, []),
    ],
    ids=["nothing", "between views", "within a view", "another place", "all shot", "named", "combining"],
)
def test_after_a_kill_exactly_the_missing_views_are_shot(
    tmp_path: Path, leave: Callable[[ShootingBench, UUID], None], shot: list[float]
) -> None:
    model_id = killed(tmp_path, leave)
    bench = ShootingBench(tmp_path)
    made = bench.over(model_id)
    assert (made.state, bench.shot) == (JobState.SUCCEEDED, shot)
    assert len(plan_from_json(made.plan).scans) == 4
    assert len(bench.tame.asked) == 1
    assert made.summary is not None
    assert "notes" not in made.summary
    bench.close()


@pytest.mark.parametrize(("first_was_shot", "shot"), [(True, []), (False, [0.0])])
def test_after_a_kill_a_model_by_hand_waits_where_it_was(
    tmp_path: Path, first_was_shot: bool, shot: list[float]
) -> None:
    def leave(bench: ShootingBench, model_id: UUID) -> None:
        if first_was_shot:
            view(bench, model_id, 1, JobState.SUCCEEDED)
            bench.models.advance(model_id, JobState.CAPTURING)

    model_id = killed(tmp_path, leave, by_hand=True)
    bench = ShootingBench(tmp_path, table=False)
    waiting = bench.until_told(model_id, "turn the object by 90° for view 2 of 4")
    assert (waiting.state, bench.shot) == (JobState.CAPTURING, shot)
    bench.shooting.cancel(model_id)
    cancelled = ScanCancelledError("The model was cancelled while its views were shot. They stay.")
    assert bench.over(model_id).fault == failure_of(cancelled)
    bench.close()


def test_a_cancellation_that_was_cut_off_is_completed_at_the_next_start(tmp_path: Path) -> None:
    def cancelled(bench: ShootingBench, model_id: UUID) -> None:
        between_views(bench, model_id)
        bench.models.finish(model_id, JobState.CANCELLED)

    model_id = killed(tmp_path, cancelled)
    bench = ShootingBench(tmp_path)
    ended = [bench.until(scan.id).state for scan in bench.runner.series(model_id)]
    assert ended == [JobState.SUCCEEDED, *[JobState.CANCELLED] * 3]
    bench.close()


def test_a_disk_that_refuses_the_scans_fails_their_model(bench: ShootingBench, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        message = "the disk is full"
        raise StorageError(message)

    monkeypatch.setattr(bench.store, "create_series", refused)
    with pytest.raises(StorageError, match="full"):
        started(bench)
    assert list(bench.models.states().values()) == [JobState.FAILED]

"""Models as jobs: what is refused, what is made, views that a table or a person turns, and what a kill leaves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest

from slrig.devices import Rig
from slrig.errors import (
    ConfigError,
    DeviceGoneError,
    JobNotFoundError,
    QueueFullError,
    RigBusyError,
    ScanCancelledError,
    ScanEvidenceError,
    ScanStateError,
    SlrigError,
    StorageError,
    UnsupportedByDeviceError,
    ViewsFailedError,
)
from slrig.failure import interruption_error, job_failure
from slrig.jobs.data_folder import FILES
from slrig.jobs.job import Recording
from slrig.jobs.listener import Listener
from slrig.jobs.records import RECORD, JobKind, JobProgress, JobRecord, JobState, utc_now, write_record
from slrig.jobs.resume import resume
from slrig.jobs.retention import CLOCK, JobArchive, Limits, Retention, SteadyClock
from slrig.jobs.store import Audit
from slrig.model import MeasuredAxis, PlaneKind, RotationAxis, TurntablePlane
from slrig.model_jobs.job import MODELS, ViewShooting
from slrig.model_jobs.plan import (
    MEDIA_TYPES,
    MODEL,
    GivenPoses,
    ModelPlan,
    ShootPlan,
    StatedAxis,
    TurntablePoses,
    UnknownPoses,
    plan_from_json,
    plan_json,
)
from slrig.rig.session import ActiveCalibration, RigFacts
from slrig.scan.job import plan_from_json as scan_plan_from_json
from slrig.scan.job import plan_json as scan_plan_json
from slrig.scan.job import series
from slrig.scan.plan import ScanPlan
from tests.core import parametrize_core
from tests.unit.capture.fake_rig import FakeTurntable
from tests.unit.model_jobs.model_bench import ModelBench, kept_scan, model_files, until_told
from tests.unit.scan.fakes import WAIT_S, TameProjector, tame_calibration

AXIS = StatedAxis((4.0, 45.0, 12.0), (0.0, -1.0, 0.0))
STILL = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ModelBench]:
    found = ModelBench(tmp_path)
    yield found
    found.close()


def test_a_model_is_made_of_scans_on_a_stage_and_lies_in_its_place(bench: ModelBench) -> None:
    scans = bench.kept_scans(0.0, 40.0, 80.0)
    made = bench.models.combine(ModelPlan(scans, TurntablePoses(AXIS), voxel_mm=0.4), label="cup")
    done = bench.over(made.id)
    assert (done.state, done.label, done.rig) == (JobState.SUCCEEDED, "cup", "bench")
    # What it is made with is on record, whatever becomes of reports and turntable.
    used = ModelPlan(scans, TurntablePoses(AXIS, (0.0, 40.0, 80.0)), voxel_mm=0.4)
    assert plan_from_json(done.plan) == used
    ((meshes, poses, start_error_mm, voxel_mm),) = bench.tame.asked
    assert list(meshes) == [str(scan) for scan in scans]
    assert [mesh.read_bytes() for mesh in meshes.values()] == [b"ply"] * 3
    assert (poses, start_error_mm, voxel_mm) == (used.poses, 3.0, 0.4)
    assert {file.name for file in bench.models.place(made.id).iterdir()} == {*MEDIA_TYPES, RECORD, FILES}
    assert done.summary == {
        "views": 3, "pairs": 2, "free": 0, "pose_sigma_mm": 0.004, "vertices": 9, "triangles": 12, "voxel_mm": 0.5,
        "sigma_mm": 0.01,
    }  # fmt: skip
    told = [event.data for event in bench.store.events(made.id, after=0)]
    assert [each["state"] for each in told if "time" in each] == ["queued", "computing", "succeeded"]
    assert "registering" in [each.get("stage") for each in told]
    assert list(bench.folder.incoming.iterdir()) == []


def test_the_axis_is_the_stages_own_unless_it_is_said(tmp_path: Path) -> None:
    bench = ModelBench(tmp_path, axis=MeasuredAxis(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0]), np.eye(6)))
    scans = bench.kept_scans(None, None)
    for axis, expected in ((None, StatedAxis((1.0, 2.0, 3.0), (0.0, 0.0, 1.0))), (AXIS, AXIS)):
        plan = ModelPlan(scans, TurntablePoses(axis, (10.0, 55.0)))
        assert bench.models.settled(plan).poses == TurntablePoses(expected, (10.0, 55.0), of_turntable=axis is None)
    bench.close()


def test_where_no_axis_was_measured_the_rigs_own_counts_in_the_frame_of_its_own_calibration(tmp_path: Path) -> None:
    bench = ModelBench(tmp_path, start=False)
    own = RotationAxis(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0]))
    bench.manager.rig.facts = RigFacts({}, TameProjector().info, tame_calibration(), turntable=True, axis=own)
    plan = ModelPlan(bench.kept_scans(0.0, 40.0))
    assert bench.models.settled(plan).poses == TurntablePoses(
        StatedAxis((1.0, 2.0, 3.0), (0.0, 0.0, 1.0)), (0.0, 40.0), of_turntable=True
    )
    bench.manager.rig.active = ActiveCalibration("spring", tame_calibration())
    with pytest.raises(ConfigError, match="axis: expected that of the turntable"):
        bench.models.settled(plan)
    bench.close()


@pytest.mark.slow
def test_views_are_cut_by_the_stages_planes_and_the_axis_found_is_noted(tmp_path: Path) -> None:
    covariance = np.diag([1e-4, 1e-4, 0.0, 1e-8, 1e-8, 0.0])
    bench = ModelBench(tmp_path, axis=MeasuredAxis(np.zeros(3), np.array([0.0, 0.0, 1.0]), covariance))
    plate = TurntablePlane(PlaneKind.PLATE, np.zeros(3), np.array([0.0, 0.0, -1.0]), 0.03, 80.0, 1.2)
    bench.turntable.put_planes([plate])
    bench.tame.axis = {
        "point_mm": [0.02, 0.0, 5.0], "direction": [0.0, 0.0, 1.0], "covariance": covariance.tolist(),
    }  # fmt: skip
    for cut in (True, False):
        scans = bench.kept_scans(0.0, 40.0)
        made = bench.over(bench.models.combine(ModelPlan(scans, TurntablePoses(), cut=cut)).id)
        assert [each.kind for each in bench.tame.planes] == [PlaneKind.PLATE] * cut
        assert bench.turntable.record().history[-1].of == str(made.id)
    # The same scans once more add nothing, nor does an axis that a person has stated.
    for known, poses in ((scans, TurntablePoses()), (bench.kept_scans(0.0, 40.0), TurntablePoses(AXIS))):
        bench.over(bench.models.combine(ModelPlan(known, poses)).id)
        assert bench.turntable.record().history[-1].of == str(made.id)
    axis = bench.turntable.axis()
    assert axis is not None
    assert 0.01 < axis.point_mm[0] < 0.02
    bench.close()


def test_what_cannot_be_made_is_refused_before_it_is_on_record(bench: ModelBench) -> None:
    first, second = bench.kept_scans(0.0, None)
    failed = bench.store.create(scan_plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None).id
    bench.store.finish(failed, JobState.FAILED, fault=job_failure(StorageError("full")))
    both = (first, second)
    refused: list[tuple[Callable[[], ModelPlan], type[SlrigError], str]] = [
        (lambda: ModelPlan((first,)), ConfigError, "expected two or more, found 1"),
        (lambda: ModelPlan((first, second, first)), ConfigError, f"found {first} twice"),
        (lambda: ModelPlan(both, TurntablePoses(AXIS, (0.0,))), ConfigError, "angles_deg: expected one for each of 2"),
        (lambda: ModelPlan(both, GivenPoses((STILL,))), ConfigError, "poses: expected one for each of 2 scans"),
        (lambda: ModelPlan(both, voxel_mm=0.0), ConfigError, "voxel_mm: expected a finite length above 0"),
        (lambda: ModelPlan(both, TurntablePoses(StatedAxis((0, 0, 0), (0, 0, 0)))), ConfigError, "with a length"),
        (lambda: ModelPlan((first, uuid4())), JobNotFoundError, "No scan"),
        (lambda: ModelPlan((first, failed)), ScanStateError, f"Scan {failed} is failed"),
        (lambda: ModelPlan(both, TurntablePoses(AXIS)), ConfigError, f"found none in {second}"),
        (lambda: ModelPlan(both), ConfigError, "axis: expected that of the turntable"),
    ]
    for plan, error, words in refused:
        with pytest.raises(error, match=words):
            bench.models.combine(plan())
    bench.free_bytes = 8
    with pytest.raises(StorageError, match="are free"):
        bench.models.combine(ModelPlan(both, GivenPoses((STILL, STILL))))
    bench.free_bytes = 10**9
    (bench.folder.scan(second) / "mesh.ply").unlink()
    with pytest.raises(StorageError, match=f"Leave scan {second} out"):
        bench.models.combine(ModelPlan(both, GivenPoses((STILL, STILL))))
    assert bench.store.states(JobKind.MODEL) == {}


def kept(bench: ModelBench, archive: JobArchive) -> Retention:
    """A retention that keeps one."""
    clock = SteadyClock(bench.folder.root / CLOCK)
    return Retention(bench.folder.root, [(archive, Limits(count=1))], Audit(bench.store.database), clock)


def test_scans_that_a_model_needs_stay_until_it_is_over(bench: ModelBench) -> None:
    scans = bench.kept_scans(0.0, 40.0)
    retention = kept(bench, JobArchive(bench.manager, JobKind.SCAN, bench.folder.scans, bench.models.unused))
    bench.tame.gate.clear()
    plan = ModelPlan(scans, TurntablePoses(AXIS))
    models = [bench.models.combine(plan) for _ in range(2)]
    with pytest.raises(QueueFullError, match="2 of 2 places for models"):
        bench.models.combine(plan)
    with pytest.raises(ScanStateError, match=f"needed by model {models[0].id}"):
        bench.delete_scan(scans[0])
    with pytest.raises(ScanStateError, match="Cancel it first"):
        bench.manager.delete(models[0].id)
    assert retention.apply() == []
    for model in models:
        bench.manager.cancel(model.id)
        assert bench.over(model.id).state is JobState.CANCELLED
    assert retention.apply() == [scans[0]]
    assert list(bench.folder.incoming.iterdir()) == []


@pytest.mark.slow
def test_models_beyond_the_limit_go_with_their_files(bench: ModelBench) -> None:
    plan = ModelPlan(bench.kept_scans(0.0, 40.0), TurntablePoses(AXIS))
    made = [bench.over(bench.models.combine(plan).id).id for _ in range(3)]
    bench.store.pin(made[0], JobKind.MODEL, pinned=True)
    retention = kept(bench, JobArchive(bench.manager, JobKind.MODEL, bench.folder.root / MODELS))
    assert retention.apply() == [made[1]]
    assert {each.name for each in bench.models.place(made[0]).parent.iterdir()} == {str(made[0]), str(made[2])}


def cut_off(bench: ModelBench, *, attempts: int, files: bool = False) -> UUID:
    """A model that was being made for the so-manieth time when the service was killed."""
    scans = bench.kept_scans(0.0, 40.0)
    plan = ModelPlan(scans, TurntablePoses(AXIS, (0.0, 40.0)))
    model_id = bench.store.create(plan_json(plan), kind=JobKind.MODEL, rig="bench", label=None).id
    for _ in range(attempts):
        bench.store.advance(model_id, JobState.COMPUTING)
        bench.store.begin_attempt(model_id)
    staged = bench.folder.stage(model_id)
    (staged / MODEL).write_bytes(b"half")
    if files:
        (staged / MODEL).unlink()
        model_files(staged, [str(scan) for scan in scans])
        write_record(staged, replace(bench.store.get(model_id), state=JobState.SUCCEEDED, summary={"views": 2}))
        bench.folder.put(model_id, bench.models.place(model_id))
    return model_id


@pytest.mark.slow
def test_what_was_cut_off_is_made_again_and_no_file_is_lost(tmp_path: Path) -> None:
    killed = ModelBench(tmp_path, start=False)
    queued, once, thrice = (cut_off(killed, attempts=attempts) for attempts in (0, 1, 3))
    placed = cut_off(killed, attempts=1, files=True)
    gone, deleted = (cut_off(killed, attempts=1, files=True) for _ in range(2))
    for model_id in (gone, deleted):
        killed.store.finish(model_id, JobState.SUCCEEDED)
    (killed.models.place(gone) / MODEL).unlink()
    killed.folder.withdraw(killed.models.place(deleted), deleted)
    (killed.models.place(gone).parent / "stranger").mkdir()
    killed.close()
    bench = ModelBench(tmp_path)
    assert bench.over(queued).state is bench.over(once).state is JobState.SUCCEEDED
    assert len(bench.tame.asked) == 2
    ended = bench.over(thrice)
    assert (ended.state, ended.fault) == (JobState.INTERRUPTED, job_failure(interruption_error()))
    recovered = bench.over(placed)
    assert recovered.state is JobState.SUCCEEDED
    assert recovered.summary is not None
    lost = bench.over(gone)
    assert lost.state is JobState.FAILED
    assert lost.fault is not None
    assert f"{MODEL} is gone" in lost.fault.message
    assert deleted not in bench.store.states(JobKind.MODEL)
    assert {each.name for each in bench.models.place(gone).parent.iterdir()} == {
        str(each) for each in (queued, once, placed, gone)
    }
    assert [each.name for each in bench.folder.orphans.iterdir()] == ["models-stranger"]
    assert list(bench.folder.incoming.iterdir()) == []
    bench.close()


def test_a_plan_is_the_same_after_it_was_on_record() -> None:
    scans = (uuid4(), uuid4())
    for poses in (TurntablePoses(), TurntablePoses(AXIS, (0.0, 30.0)), GivenPoses((STILL, STILL)), UnknownPoses()):
        plan = ModelPlan(scans, poses, start_error_mm=1.0)
        assert plan_from_json(plan_json(plan)) == plan
        assert plan_from_json(plan_json(replace(plan, voxel_mm=0.3))).voxel_mm == 0.3


def shoot_plan(views: int = 4, *, manual: bool = False, exposure_s: float | None = None) -> ModelPlan:
    return ModelPlan((), TurntablePoses(AXIS), shoot=ShootPlan(views, ScanPlan(exposure_s=exposure_s), manual))


class ShootingBench(ModelBench):
    """A bench whose rig has a turntable. shot : angle and cause of each capture, in order; faults : what the next
    captures at an angle raise.
    """

    def __init__(self, root: Path, *, table: bool = True, start: bool = True, **options: Any) -> None:
        self.table = FakeTurntable() if table else None
        self.shot: list[float | None] = []
        self.faults: dict[float, list[Exception]] = {}
        super().__init__(root, start=False, **options)
        self.shooting = ViewShooting(self.models, self.manager)
        if start:
            # As a service does it, but for the rig, whose turntable is known at once.
            self.manager.rig.open()
            resume(self.manager)
            self.store.after_end = self.shooting.view_ended
            self.shooting.take_up()
            self.manager.start()

    def open_rig(self) -> Rig:
        return replace(super().open_rig(), positioner=self.table)

    def capture(self, rig: Rig, plan: ScanPlan, folder: Path, listener: Listener, /, **how: Any) -> Recording:
        self.shot.append(plan.turn_deg)
        if faults := self.faults.get(plan.turn_deg or 0.0):
            raise faults.pop(0)
        return super().capture(rig, plan, folder, listener, **how)

    def views(self, model_id: UUID) -> list[tuple[float | None, JobState]]:
        """Angle and state of each scan of a model, from the first to the last."""
        scans = self.store.of(model_id)
        return [(scan_plan_from_json(scan.plan).turn_deg, scan.state) for scan in scans]

    def until_told(self, model_id: UUID, words: str) -> JobRecord:
        """The model once its progress says this."""
        return until_told(self.store, model_id, words)


@pytest.fixture
def shooting(tmp_path: Path) -> Iterator[ShootingBench]:
    found = ShootingBench(tmp_path)
    yield found
    found.close()


def started(bench: ShootingBench, plan: ModelPlan | None = None, *, wait: bool = False) -> UUID:
    return bench.shooting.shoot(plan or shoot_plan(), label="cup", wait=wait).id


def test_all_views_are_shot_around_the_table_and_the_model_is_made_of_them(shooting: ShootingBench) -> None:
    model_id = started(shooting, shoot_plan(exposure_s=0.02))
    made = shooting.over(model_id)
    assert (made.state, made.label, shooting.shot) == (JobState.SUCCEEDED, "cup", [0.0, 90.0, 180.0, 270.0])
    scans = series(shooting.store, model_id)
    assert {each.label for each in scans} == {"cup"}
    assert {scan_plan_from_json(each.plan).exposure_s for each in scans} == {0.02}
    used = plan_from_json(made.plan)
    assert used.scans == tuple(each.id for each in scans)
    assert used.poses == TurntablePoses(AXIS, (0.0, 90.0, 180.0, 270.0))
    told = [event.data for event in shooting.store.events(model_id, after=0)]
    assert [each["state"] for each in told if "time" in each] == ["queued", "capturing", "computing", "succeeded"]
    details = [each["detail"] for each in told if each.get("stage") == "view"]
    # Progress of a view that is computed comes while the next is shot; that may have ended, too, on a busy machine.
    assert details == sorted(details)
    assert details[0] == "view 1 of 4"
    assert set(details) <= {f"view {number} of 4" for number in (1, 2, 3, 4)}
    fractions = [each["fraction"] for each in told if "fraction" in each]
    assert fractions == sorted(fractions)
    assert made.summary is not None
    assert "notes" not in made.summary


@pytest.mark.slow
def test_last_view_that_ends_before_its_progress_is_recorded_is_no_first_one(
    shooting: ShootingBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    model_id = started(shooting)
    shoot = plan_from_json(shooting.over(model_id).plan).shoot
    assert shoot is not None
    told: list[JobProgress] = []
    monkeypatch.setattr(shooting.store, "progress", lambda _, progress: told.append(progress))
    shooting.shooting._record_progress(model_id, shoot)
    assert [each.detail for each in told] == ["view 4 of 4"]


@pytest.mark.slow
def test_failed_view_is_noted_and_a_device_fault_is_tried_twice_more(shooting: ShootingBench) -> None:
    gone = DeviceGoneError("left was unplugged")
    shooting.faults = {90.0: [ScanEvidenceError("white is not brighter than black")], 180.0: [gone], 270.0: [gone] * 9}
    poses = GivenPoses(tuple(((1.0, 0.0, 0.0, float(view)), *STILL[1:]) for view in range(4)))
    made = shooting.over(started(shooting, replace(shoot_plan(), poses=poses)))
    assert made.state is JobState.SUCCEEDED
    assert [shooting.shot.count(angle) for angle in (0.0, 90.0, 180.0, 270.0)] == [1, 1, 2, 3]
    assert made.summary is not None
    assert made.summary["notes"] == [
        "view 2 of 4, at 90°, is not in it: white is not brighter than black",
        "view 4 of 4, at 270°, is not in it: left was unplugged",
    ]
    used = plan_from_json(made.plan)
    assert isinstance(used.poses, GivenPoses)
    assert [matrix[0][3] for matrix in used.poses.matrices] == [0.0, 2.0]


@pytest.mark.slow
def test_of_fewer_than_two_views_there_is_no_model_and_the_scans_stay(shooting: ShootingBench) -> None:
    shooting.faults = {angle: [ScanEvidenceError("too dark")] for angle in (90.0, 180.0, 270.0)}
    model_id = started(shooting)
    failed = shooting.over(model_id)
    assert (failed.state, failed.fault and failed.fault.code) == (JobState.FAILED, ViewsFailedError.code)
    assert failed.fault is not None
    assert (
        "1 of 4 views succeeded, and a model takes two: view 2 of 4, at 90°, is not in it: too" in failed.fault.message
    )
    states = [state for _, state in shooting.views(model_id)]
    assert states == [JobState.SUCCEEDED, *[JobState.FAILED] * 3]


def test_a_cancelled_model_takes_its_waiting_views_with_it(shooting: ShootingBench) -> None:
    shooting.gate.clear()
    model_id = started(shooting)
    assert shooting.began.wait(WAIT_S)
    with pytest.raises(ScanStateError, match="is not shot manually"):
        shooting.shooting.combine(model_id)
    with pytest.raises(ScanStateError, match="is not shot manually"):
        shooting.shooting.shoot_view(model_id, again=True, wait=True)
    with (
        pytest.raises(ScanStateError, match=f"needed by model {model_id}"),
        shooting.models.unused(series(shooting.store, model_id)[3].id),
    ):
        pass
    assert shooting.shooting.cancel(model_id).state is JobState.CANCELLED
    ended = [shooting.until(scan.id).state for scan in series(shooting.store, model_id)]
    assert (ended, shooting.shot) == ([JobState.CANCELLED] * 4, [0.0])
    assert shooting.shooting.cancel(model_id).state is JobState.CANCELLED
    assert shooting.store.unfinished(JobKind.MODEL) == []


def test_what_cannot_be_shot_is_refused_and_nothing_is_on_record(tmp_path: Path) -> None:
    bench = ShootingBench(tmp_path, table=False)
    with pytest.raises(UnsupportedByDeviceError, match=r"this rig has no turntable\. Turn it by hand"):
        started(bench)
    with pytest.raises(ConfigError, match="axis: expected that of the turntable"):
        started(bench, replace(shoot_plan(), poses=TurntablePoses()))
    bench.held()
    with pytest.raises(RigBusyError):
        started(bench, shoot_plan(manual=True))
    assert bench.store.states(JobKind.MODEL) == {}
    for wrong in (1, 73):
        with pytest.raises(ConfigError, match=f"views: expected 2 to 72, found {wrong}"):
            ShootPlan(wrong)
    bench.close()


@pytest.mark.slow
def test_by_hand_it_may_end_early_with_what_there_is(tmp_path: Path) -> None:
    bench = ShootingBench(tmp_path, table=False)
    model_id = started(bench, shoot_plan(4, manual=True))
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
    model_id = started(bench, shoot_plan(3, manual=True))
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
    scans = series(bench.store, model_id)
    assert plan_from_json(made.plan).scans == (scans[0].id, scans[3].id, scans[4].id)
    with pytest.raises(ScanStateError, match=f"Model {model_id} is succeeded"):
        bench.shooting.shoot_view(model_id, again=True, wait=False)
    bench.close()


def killed(root: Path, leave: Callable[[ShootingBench, UUID], None], *, manual: bool = False) -> UUID:
    """A model on record as a kill of the service leaves it."""
    bench = ShootingBench(root, start=False)
    bench.store.after_end = lambda _: None
    plan = shoot_plan(manual=manual)
    model_id = bench.store.create(plan_json(plan), kind=JobKind.MODEL, rig="bench", label="cup").id
    leave(bench, model_id)
    bench.close()
    return model_id


def view(bench: ShootingBench, model_id: UUID, number: int, state: JobState, *, count: str | None = None) -> UUID:
    """A view on record that came as far as that. count : of the turntable's angle."""
    plan = ShootPlan(4).view(number, model_id, utc_now())
    document = scan_plan_json(plan)
    if state is JobState.SUCCEEDED:
        scan_id = kept_scan(bench.store, bench.folder)
        kept = bench.store.get(scan_id)
        bench.store.delete(scan_id)
        summary = {} if count is None else {"turntable": {"count": count}}
        bench.store.restore(replace(kept, plan=document, summary=summary, label="cup", parent=model_id))
        return scan_id
    record = bench.store.create(document, kind=JobKind.SCAN, rig="bench", label="cup", parent=model_id)
    if state is not JobState.QUEUED:
        bench.store.advance(record.id, state)
    return record.id


def left(*states: JobState, count: str | None = None) -> Callable[[ShootingBench, UUID], None]:
    """Leaves views that came so far, and a model that was capturing. count : of the angle of those that succeeded."""

    def leave(bench: ShootingBench, model_id: UUID) -> None:
        for number, state in enumerate(states, start=1):
            view(bench, model_id, number, state, count=count)
        if states:
            bench.store.advance(model_id, JobState.CAPTURING)

    return leave


DONE, CAPTURING, QUEUED = JobState.SUCCEEDED, JobState.CAPTURING, JobState.QUEUED
all_shot, between_views = left(DONE, DONE, DONE, DONE), left(DONE, QUEUED, QUEUED, QUEUED)


def named(bench: ShootingBench, model_id: UUID) -> None:
    all_shot(bench, model_id)
    plan = plan_from_json(bench.store.get(model_id).plan)
    scans = tuple(scan.id for scan in bench.store.of(model_id))
    bench.store.replan(
        model_id, plan_json(bench.models.settled(replace(plan, scans=scans, poses=GivenPoses((STILL,) * 4))))
    )


def combining(bench: ShootingBench, model_id: UUID) -> None:
    named(bench, model_id)
    bench.store.advance(model_id, JobState.COMPUTING)


@parametrize_core(
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
    core=[2, 4],
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


@parametrize_core(("first_was_shot", "shot"), [(True, []), (False, [0.0])])
def test_after_a_kill_a_model_by_hand_waits_where_it_was(
    tmp_path: Path, first_was_shot: bool, shot: list[float]
) -> None:
    def leave(bench: ShootingBench, model_id: UUID) -> None:
        if first_was_shot:
            view(bench, model_id, 1, JobState.SUCCEEDED)
            bench.store.advance(model_id, JobState.CAPTURING)

    model_id = killed(tmp_path, leave, manual=True)
    bench = ShootingBench(tmp_path, table=False)
    waiting = bench.until_told(model_id, "turn the object by 90° for view 2 of 4")
    assert (waiting.state, bench.shot) == (JobState.CAPTURING, shot)
    bench.shooting.cancel(model_id)
    cancelled = ScanCancelledError("The model was cancelled while its views were shot. They stay.")
    assert bench.over(model_id).fault == job_failure(cancelled)
    bench.close()


@pytest.mark.slow
def test_a_cancellation_that_was_cut_off_is_completed_at_the_next_start(tmp_path: Path) -> None:
    def cancelled(bench: ShootingBench, model_id: UUID) -> None:
        between_views(bench, model_id)
        bench.store.finish(model_id, JobState.CANCELLED)

    model_id = killed(tmp_path, cancelled)
    bench = ShootingBench(tmp_path)
    ended = [bench.until(scan.id).state for scan in series(bench.store, model_id)]
    assert ended == [JobState.SUCCEEDED, *[JobState.CANCELLED] * 3]
    bench.close()


def test_a_disk_that_refuses_the_scans_fails_their_model(
    shooting: ShootingBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = shooting.store.create_all

    def refused(*given: Any, kind: JobKind, **how: Any) -> Any:
        if kind is JobKind.MODEL:
            return real(*given, kind=kind, **how)
        message = "the disk is full"
        raise StorageError(message)

    monkeypatch.setattr(shooting.store, "create_all", refused)
    with pytest.raises(StorageError, match="full"):
        started(shooting)
    assert list(shooting.store.states(JobKind.MODEL).values()) == [JobState.FAILED]

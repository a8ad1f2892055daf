"""Models as jobs: what is refused before anything is on record, what is made, and what a kill of the service leaves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from uuid import UUID, uuid4

import numpy as np
import pytest

from slrig.combine.offered import MEDIA_TYPES, MODEL
from slrig.combine.plan import (
    GivenPoses,
    ModelPlan,
    StatedAxis,
    TurntablePoses,
    UnknownPoses,
    plan_from_json,
    plan_json,
)
from slrig.errors import (
    ConfigError,
    JobNotFoundError,
    QueueFullError,
    ScanStateError,
    SlrigError,
    StorageError,
)
from slrig.failure import failure_of, interruption
from slrig.jobs.records import JobState
from slrig.model import MeasuredAxis, PlaneKind, StagePlane
from slrig.scan.plan import ScanPlan
from slrig.scan.records import plan_json as scan_plan_json
from slrig.scan.retention import ScanLimits, ScanRetention
from tests.unit.combine.model_bench import ModelBench, model_files

AXIS = StatedAxis((4.0, 45.0, 12.0), (0.0, -1.0, 0.0))
STILL = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ModelBench]:
    found = ModelBench(tmp_path)
    yield found
    found.close()


def test_a_model_is_made_of_scans_on_a_stage_and_lies_in_its_place(bench: ModelBench) -> None:
    scans = bench.kept_scans(0.0, 40.0, 80.0)
    made = bench.desk.combine(ModelPlan(scans, TurntablePoses(AXIS), voxel_mm=0.4), label="cup")
    done = bench.over(made.id)
    assert (done.state, done.label, done.rig) == (JobState.SUCCEEDED, "cup", "bench")
    # What it is made with is on record, whatever becomes of reports and stage.
    used = ModelPlan(scans, TurntablePoses(AXIS, (0.0, 40.0, 80.0)), voxel_mm=0.4)
    assert plan_from_json(done.plan) == used
    ((meshes, poses, start_error_mm, voxel_mm),) = bench.tame.asked
    assert list(meshes) == [str(scan) for scan in scans]
    assert [mesh.read_bytes() for mesh in meshes.values()] == [b"ply"] * 3
    assert (poses, start_error_mm, voxel_mm) == (used.poses, 3.0, 0.4)
    assert {file.name for file in bench.desk.store.place(made.id).iterdir()} == set(MEDIA_TYPES)
    assert done.summary == {
        "views": 3, "pairs": 2, "free": 0, "pose_sigma_mm": 0.004, "vertices": 9, "triangles": 12, "voxel_mm": 0.5,
        "sigma_mm": 0.01,
    }  # fmt: skip
    told = [event.data for event in bench.models.events(made.id, after=0)]
    assert [each["state"] for each in told if "time" in each] == ["queued", "computing", "succeeded"]
    assert "registering" in [each.get("stage") for each in told]
    assert list(bench.folder.incoming.iterdir()) == []


def test_the_axis_is_the_stages_own_unless_it_is_said(tmp_path: Path) -> None:
    bench = ModelBench(tmp_path, axis=MeasuredAxis(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0]), np.eye(6)))
    scans = bench.kept_scans(None, None)
    for axis, expected in ((None, StatedAxis((1.0, 2.0, 3.0), (0.0, 0.0, 1.0))), (AXIS, AXIS)):
        plan = ModelPlan(scans, TurntablePoses(axis, (10.0, 55.0)))
        assert bench.desk.settled(plan).poses == TurntablePoses(expected, (10.0, 55.0), of_stage=axis is None)
    bench.close()


def test_views_are_cut_by_the_stages_planes_and_the_axis_found_is_noted(tmp_path: Path) -> None:
    covariance = np.diag([1e-4, 1e-4, 0.0, 1e-8, 1e-8, 0.0])
    bench = ModelBench(tmp_path, axis=MeasuredAxis(np.zeros(3), np.array([0.0, 0.0, 1.0]), covariance))
    plate = StagePlane(PlaneKind.PLATE, np.zeros(3), np.array([0.0, 0.0, -1.0]), 0.03, 80.0, 1.2)
    bench.stage.put_planes([plate])
    bench.tame.axis = {
        "point_mm": [0.02, 0.0, 5.0], "direction": [0.0, 0.0, 1.0], "covariance": covariance.tolist(),
    }  # fmt: skip
    for cut in (True, False):
        scans = bench.kept_scans(0.0, 40.0)
        made = bench.over(bench.desk.combine(ModelPlan(scans, TurntablePoses(), cut=cut)).id)
        assert [each.kind for each in bench.tame.planes] == [PlaneKind.PLATE] * cut
        assert bench.stage.record().history[-1].of == str(made.id)
    # The same scans once more tell nothing new, nor does an axis that somebody has said.
    for known, poses in ((scans, TurntablePoses()), (bench.kept_scans(0.0, 40.0), TurntablePoses(AXIS))):
        bench.over(bench.desk.combine(ModelPlan(known, poses)).id)
        assert bench.stage.record().history[-1].of == str(made.id)
    axis = bench.stage.axis()
    assert axis is not None
    assert 0.01 < axis.point_mm[0] < 0.02
    bench.close()


def test_what_cannot_be_made_is_refused_before_it_is_on_record(bench: ModelBench) -> None:
    first, second = bench.kept_scans(0.0, None)
    failed = bench.store.create(scan_plan_json(ScanPlan()), rig="bench", label=None).id
    bench.store.finish(failed, JobState.FAILED, fault=failure_of(StorageError("full")))
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
        (lambda: ModelPlan(both), ConfigError, "axis: expected that of the stage"),
    ]
    for plan, error, words in refused:
        with pytest.raises(error, match=words):
            bench.desk.combine(plan())
    bench.free_bytes = 8
    with pytest.raises(StorageError, match="are free"):
        bench.desk.combine(ModelPlan(both, GivenPoses((STILL, STILL))))
    bench.free_bytes = 10**9
    (bench.folder.scan(second) / "mesh.ply").unlink()
    with pytest.raises(StorageError, match=f"Leave scan {second} out"):
        bench.desk.combine(ModelPlan(both, GivenPoses((STILL, STILL))))
    assert bench.models.states() == {}


def test_scans_that_a_model_needs_stay_until_it_is_over(bench: ModelBench) -> None:
    scans = bench.kept_scans(0.0, 40.0)
    retention = ScanRetention(bench.store, bench.folder, ScanLimits(count=1), bench.runner.delete)
    bench.tame.gate.clear()
    plan = ModelPlan(scans, TurntablePoses(AXIS))
    models = [bench.desk.combine(plan) for _ in range(2)]
    with pytest.raises(QueueFullError, match="2 models are made"):
        bench.desk.combine(plan)
    with pytest.raises(ScanStateError, match=f"needed by model {models[0].id}"):
        bench.runner.delete(scans[0])
    with pytest.raises(ScanStateError, match="Cancel it first"):
        bench.desk.delete(models[0].id)
    assert retention.apply() == []
    for model in models:
        bench.desk.cancel(model.id)
        assert bench.over(model.id).state is JobState.CANCELLED
    assert retention.apply() == [scans[0]]
    assert list(bench.folder.incoming.iterdir()) == []


def test_the_newest_models_are_kept(tmp_path: Path) -> None:
    bench = ModelBench(tmp_path, keep=2)
    plan = ModelPlan(bench.kept_scans(0.0, 40.0), TurntablePoses(AXIS))
    made = [bench.over(bench.desk.combine(plan).id).id for _ in range(4)]
    # The one that is asked for makes room when it is over.
    assert sorted(bench.models.states()) == sorted(made[1:])
    bench.desk.delete(made[2])
    kept = {each.name for each in bench.desk.store.place(made[0]).parent.iterdir()}
    assert kept == {str(made[1]), str(made[3])}
    bench.close()


def cut_off(bench: ModelBench, *, attempts: int, files: bool = False) -> UUID:
    """A model that was being made for the so-manieth time when the service was killed."""
    scans = bench.kept_scans(0.0, 40.0)
    plan = ModelPlan(scans, TurntablePoses(AXIS, (0.0, 40.0)))
    model_id = bench.models.create(plan_json(plan), rig="bench", label=None).id
    for _ in range(attempts):
        bench.models.advance(model_id, JobState.COMPUTING)
    staged = bench.folder.stage(model_id)
    (staged / MODEL).write_bytes(b"half")
    if files:
        model_files(bench.desk.store.stage(model_id), [str(scan) for scan in scans])
        bench.desk.store.commit(model_id)
    return model_id


def test_what_was_cut_off_is_made_once_more_and_no_file_is_lost(tmp_path: Path) -> None:
    killed = ModelBench(tmp_path, start=False)
    queued, once, twice = (cut_off(killed, attempts=attempts) for attempts in range(3))
    placed = cut_off(killed, attempts=1, files=True)
    gone, deleted = (cut_off(killed, attempts=1, files=True) for _ in range(2))
    for model_id in (gone, deleted):
        killed.models.finish(model_id, JobState.SUCCEEDED)
    (killed.desk.store.place(gone) / MODEL).unlink()
    killed.desk.store.withdraw(deleted)
    (killed.desk.store.place(gone).parent / "stranger").mkdir()
    killed.close()
    bench = ModelBench(tmp_path)
    assert bench.over(queued).state is bench.over(once).state is JobState.SUCCEEDED
    assert len(bench.tame.asked) == 2
    ended = bench.over(twice)
    assert (ended.state, ended.fault) == (JobState.INTERRUPTED, failure_of(interruption()))
    recovered = bench.over(placed)
    assert recovered.state is JobState.SUCCEEDED
    assert recovered.summary is not None
    lost = bench.over(gone)
    assert lost.state is JobState.FAILED
    assert lost.fault is not None
    assert f"{MODEL} of this model is gone" in lost.fault.message
    assert deleted not in bench.models.states()
    assert {each.name for each in bench.desk.store.place(gone).parent.iterdir()} == {
        str(each) for each in (queued, once, placed, gone)
    }
    assert [each.name for each in bench.folder.orphans.iterdir()] == ["model-stranger"]
    assert list(bench.folder.incoming.iterdir()) == []
    bench.close()


def test_a_plan_is_the_same_after_it_was_on_record() -> None:
    scans = (uuid4(), uuid4())
    for poses in (TurntablePoses(), TurntablePoses(AXIS, (0.0, 30.0)), GivenPoses((STILL, STILL)), UnknownPoses()):
        plan = ModelPlan(scans, poses, start_error_mm=1.0)
        assert plan_from_json(plan_json(plan)) == plan
        assert plan_from_json(plan_json(replace(plan, voxel_mm=0.3))).voxel_mm == 0.3

"""Models as jobs: made of scans on record, in the worker, while the rig does other work."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Protocol
from uuid import UUID

import structlog

from slrig.combine.offered import missing_files
from slrig.combine.plan import (
    MarkerPoses,
    ModelPlan,
    StartingPoses,
    StatedAxis,
    TurntablePoses,
    plan_from_json,
    plan_json,
    turntable_angle,
)
from slrig.combine.store import ModelStore, found_axis, summary
from slrig.combine.turntable import TurntableStore
from slrig.errors import ConfigError, JobNotFoundError, QueueFullError, ScanStateError, StorageError
from slrig.failure import job_failure
from slrig.jobs.data_folder import BUNDLE, DataFolder
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import JobRecord, JobState
from slrig.jobs.rig_jobs import Outcome, Parts, RigJobs
from slrig.jobs.store import JobStore
from slrig.model import TurntablePlane
from slrig.scan.artefacts import MESH
from slrig.scan.plan import ProgressCallback

_FILES_OF_MESHES = 3
"""A model's files over the meshes of its scans: placed.ply is as large as all of them, model.ply and model.glb less."""

SHOOTING_SHARE = 0.8
"""The part of its progress that is shooting, of a model that is shot: a view takes seconds to a minute, the model half
a minute."""

_log = structlog.get_logger(__name__)


class CombineInto(Protocol):
    """`slrig.combine.combining.combine_into`."""

    def __call__(
        self,
        meshes: Mapping[str, Path],
        folder: Path,
        poses: StartingPoses,
        /,
        *,
        start_error_mm: float,
        voxel_mm: float | None,
        planes: Sequence[TurntablePlane],
        notes: Sequence[str],
        progress: ProgressCallback,
        cancelled: Callable[[], bool],
    ) -> None:
        """Write the files of a model."""
        ...


class ModelDesk:
    """Has models made, and keeps the newest. Any thread may call.

    scans : those on record. combine : see `CombineInto`. turntable : knows its axis and planes, and learns
    of each model's axis. keep : so many models are kept. spare_bytes : left free on the disk.
    """

    def __init__(
        self,
        folder: DataFolder,
        queue: JobQueue,
        jobs: JobStore,
        *,
        scans: JobStore,
        combine: CombineInto,
        turntable: TurntableStore,
        keep: int,
        spare_bytes: int = 0,
    ) -> None:
        self.jobs = jobs
        self.store = ModelStore(folder)
        self._folder = folder
        self._queue = queue
        self._scans = scans
        self._combine = combine
        self._turntable = turntable
        self._keep = keep
        self._spare_bytes = spare_bytes
        self._work = RigJobs(jobs, queue, folder)
        # Held while scans are looked up and named by a job, and while one is deleted.
        self._naming = threading.Lock()

    def take_up(self) -> None:
        """Bring records and files together again after whatever ended the last run of the service.

        - A model that waited is made; so is one that was being made, once more, unless its files are in place.
        - One whose views are still shot is left to `slrig.combine.shooting.ViewShooting`.
        - A deletion that was cut off is completed.
        - A model that succeeded and lacks a file is recorded as failed.
        - Files without a record are put aside in `.orphans`.
        """
        for record in self.jobs.unfinished():
            place = self.store.place(record.id)
            if plan_from_json(record.plan).being_shot:
                continue
            if record.state is JobState.CAPTURING:
                self._start(record)
            elif missing_files(place):
                self._work.take_up(record, self._parts(record), holder=_holder(record.id), resumes=True)
            else:
                self.jobs.finish(record.id, JobState.SUCCEEDED, summary=summary(place))
        states = self.jobs.states()
        for name in self.store.withdrawn():
            for model_id in [each for each in states if str(each) == name]:
                self.jobs.delete(model_id)
                del states[model_id]
            self.store.discard(name)
        for model_id, state in states.items():
            if state is JobState.SUCCEEDED and (missing := missing_files(self.store.place(model_id))):
                message = (
                    f"{' and '.join(missing)} of this model is gone from {self.store.place(model_id)}. Make it again."
                )
                self.jobs.lose_files(model_id, job_failure(StorageError(message)))
                _log.warning("left by the last run", model=str(model_id), found="without files")
        for name in self.store.put_aside(set(states)):
            _log.warning("left by the last run", model=name, found="put aside")
        self._remove_old()

    def combine(self, plan: ModelPlan, *, label: str | None = None, key: str | None = None) -> JobRecord:
        """Have a model made. Returns at once. key : the idempotency key of the request, reserved.

        Raises
        ------
        JobNotFoundError
            A scan is not on record.
        ScanStateError
            A scan did not succeed, or not yet.
        ConfigError
            The poses are to be a turntable's, and the axis or an angle is not known; or of markers, and a scan's frames
            are gone.
        QueueFullError
            As many models wait as may.
        StorageError
            There is too little room, or the disk refused.
        """
        with self._naming:
            used = self.settled(plan)
            # Those that are shot have their own line, and may wait for a hand.
            waiting = [each for each in self.jobs.unfinished() if not plan_from_json(each.plan).being_shot]
            if len(waiting) >= self._queue.backlog_length:
                message = (
                    f"{self._queue.backlog_length} models are made or wait for that, as many as may. Try again later."
                )
                raise QueueFullError(message)
            self._require_space(used)
            record = self.jobs.create(plan_json(used), rig=self._queue.rig.name, label=label, key=key)
        self._work.take_up(record, self._parts(record), holder=_holder(record.id))
        self._remove_old()
        return self.jobs.get(record.id)

    def begin(self, record: JobRecord, plan: ModelPlan) -> None:
        """Have a model on record made, now that its views were shot: `plan` names them. Raises as `combine`."""
        with self._naming:
            used = self.settled(plan)
            self._require_space(used)
            record = self.jobs.replan(record.id, plan_json(used))
        self._start(record)
        self._remove_old()

    def with_axis(self, plan: ModelPlan) -> ModelPlan:
        """The plan with the turntable's axis in it, where it leaves that to the turntable. Raises ConfigError."""
        poses = plan.poses
        if not isinstance(poses, TurntablePoses) or poses.axis is not None:
            return plan
        axis = self._turntable.axis()
        if axis is None:
            message = (
                "axis: expected that of the turntable, and none is known here; say axis, with point_mm and direction "
                "in the scans' frame, or give the poses"
            )
            raise ConfigError(message)
        stated = StatedAxis.of(axis.point_mm, axis.direction)
        return replace(plan, poses=replace(poses, axis=stated, of_turntable=True))

    def settled(self, plan: ModelPlan) -> ModelPlan:
        """The plan with the turntable's axis and angles in it, where it leaves them to the turntable. Raises as
        `combine`.
        """
        for scan in plan.scans:
            found = self._scans.get(scan)
            if found.state is not JobState.SUCCEEDED:
                message = (
                    f"Scan {scan} is {found.state}. A model takes scans that succeeded: wait for it, or leave it out."
                )
                raise ScanStateError(message)
        poses = self.with_axis(plan).poses
        if isinstance(poses, MarkerPoses):
            without = [str(each) for each in plan.scans if not (self._folder.scan(each) / BUNDLE).is_dir()]
            if without:
                message = (
                    "poses: expected the frames of each scan, in which markers are looked for, found none of "
                    f"{', '.join(without)}; leave those out, or give the poses in another way"
                )
                raise ConfigError(message)
        if not isinstance(poses, TurntablePoses):
            return plan
        if poses.angles_deg is None:
            told = {scan: self._angle_told(scan) for scan in plan.scans}
            untold = [str(scan) for scan, turntable in told.items() if turntable is None]
            if untold:
                message = (
                    "angles_deg: expected the turntable's angle in the report of each scan, found none in "
                    f"{', '.join(untold)}; say angles_deg, one for each scan in their order, or give the poses"
                )
                raise ConfigError(message)
            turntables = [turntable for turntable in told.values() if turntable is not None]
            if len({count for _, count in turntables}) > 1:
                message = (
                    "angles_deg: expected angles with one zero, and the turntable lost its place between these scans; "
                    'say angles_deg as they are, "poses": "unknown", or shoot them again'
                )
                raise ConfigError(message)
            poses = replace(poses, angles_deg=tuple(angle_deg for angle_deg, _ in turntables))
        return replace(plan, poses=poses)

    def cancel(self, model_id: UUID) -> JobRecord:
        """Ask a model to end early. Returns at once; one that is over stays so. Raises JobNotFoundError."""
        self._work.cancel(model_id)
        return self.jobs.get(model_id)

    def delete(self, model_id: UUID) -> None:
        """Remove a model that is over: its record, its events, its files.

        Raises
        ------
        JobNotFoundError
            There is no such model.
        ScanStateError
            It is not over.
        """
        self._work.endings.settle()
        record = self.jobs.get(model_id)
        if not record.state.final:
            message = (
                f"Model {model_id} is {record.state}. Cancel it first (POST /model/{model_id}/cancel), then delete it."
            )
            raise ScanStateError(message)
        self.store.withdraw(model_id)
        self.jobs.delete(model_id)
        self.store.discard(model_id)
        _log.info("model deleted", model=str(model_id))

    @contextmanager
    def unused(self, scan_id: UUID) -> Iterator[None]:
        """A scan that no model needs, which none comes to need within the block.

        Raises
        ------
        ScanStateError
            A model that waits or is being made needs it, or it is a view of one that is being shot.
        """
        with self._naming:
            for record in self.jobs.unfinished():
                if str(scan_id) in record.plan["scans"] or self._scans.get(scan_id).parent == record.id:
                    message = (
                        f"Scan {scan_id} is needed by model {record.id}, which is {record.state}. Wait for it, or "
                        f"cancel it first (POST /model/{record.id}/cancel), then delete the scan."
                    )
                    raise ScanStateError(message)
            yield

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent."""
        self._work.close()

    def _parts(self, record: JobRecord) -> Parts:
        share = 0.0 if record.plan.get("shoot") is None else SHOOTING_SHARE
        return Parts(lambda job, progress: self._make(record, job, progress), capture_share=share)

    def _start(self, record: JobRecord) -> None:
        self._queue.add([self._work.job(record.id, self._parts(record), _holder(record.id))])

    def _require_space(self, plan: ModelPlan) -> None:
        mesh_bytes = sum(self._mesh(scan).stat().st_size for scan in plan.scans)
        self._folder.require_space(_FILES_OF_MESHES * mesh_bytes + self._spare_bytes)

    def _make(self, record: JobRecord, job: Job, progress: ProgressRecorder) -> Outcome:
        plan = plan_from_json(record.plan)
        staged = self.store.stage(record.id)
        self._combine(
            {str(scan): self._mesh(scan) for scan in plan.scans},
            staged,
            plan.poses,
            start_error_mm=plan.start_error_mm,
            voxel_mm=plan.voxel_mm,
            planes=self._turntable.planes() if plan.cut else (),
            notes=plan.notes,
            progress=progress,
            cancelled=job.stop.is_set,
        )
        missing = missing_files(staged)
        if missing:
            message = (
                f"The model was made, and {' and '.join(missing)} is not on the disk. Check the disk; make it again."
            )
            raise StorageError(message)
        found = summary(staged)
        axis = found_axis(staged) if self._updates_turntable(plan) else None
        self.store.commit(record.id)
        if axis is not None:
            try:
                self._turntable.note(axis, of=str(record.id))
            except Exception:  # noqa: BLE001 - the model is there, and is no worse for that
                _log.exception("the axis of a model could not be noted", model=str(record.id))
        return Outcome(found)

    def _updates_turntable(self, plan: ModelPlan) -> bool:
        """Whether the axis of a model is news of the turntable: it was made by the turntable's own, of scans that no
        earlier model was made of.
        """
        if not (isinstance(plan.poses, TurntablePoses) and plan.poses.of_turntable):
            return False
        known = {scan for each in self.jobs.finished() if each.summary is not None for scan in each.plan["scans"]}
        return known.isdisjoint(map(str, plan.scans))

    def _mesh(self, scan_id: UUID) -> Path:
        mesh = self._folder.scan(scan_id) / MESH
        if not self._folder.owns(mesh):
            message = f"{mesh} is gone, or a link. Leave scan {scan_id} out, or bring its files back."
            raise StorageError(message)
        return mesh

    def _angle_told(self, scan_id: UUID) -> tuple[float, str | None] | None:
        """Where the turntable stood, deg, and what that counts from, as a scan's report says; None where it does
        not.
        """
        try:
            return turntable_angle(self._folder.read(self._folder.scan(scan_id) / "report.json"))
        except FileNotFoundError:
            return None

    def _remove_old(self) -> None:
        """Remove the oldest models beyond those that are kept, and say so in the log."""
        for record in self.jobs.finished()[self._keep :]:
            try:
                self.delete(record.id)
            except JobNotFoundError:
                # Deleted by somebody meanwhile.
                continue
            except StorageError as error:
                _log.warning("an old model could not be removed", model=str(record.id), cause=str(error))


def _holder(model_id: UUID) -> Holder:
    words = f"model {model_id}"
    return Holder(words, words, f"/model/{model_id}")

"""Models as jobs: made of scans on record, in the worker, while the rig does other work."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self
from uuid import UUID

import structlog

from slrig.combine.offered import MEDIA_TYPES
from slrig.combine.plan import (
    MarkerPoses,
    ModelPlan,
    StatedAxis,
    TurntablePoses,
    plan_from_json,
    plan_json,
    turntable_angle,
)
from slrig.combine.report import found_axis, summary
from slrig.combine.turntable import TurntableStore
from slrig.errors import ConfigError, JobNotFoundError, QueueFullError, ScanStateError, StorageError
from slrig.jobs.data_folder import BUNDLE, SCANS, DataFolder
from slrig.jobs.job import Job, JobRun, Outcome
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.model import MeasuredAxis, TurntablePlane
from slrig.scan.artefacts import MESH

_FILES_OF_MESHES = 3
"""A model's files over the meshes of its scans: placed.ply is as large as all of them, model.ply and model.glb less."""

SHOOTING_SHARE = 0.8
"""The part of its progress that is shooting, of a model that is shot: a view takes seconds to a minute, the model half
a minute."""

MODELS, TURNTABLE = "models", "turntable"

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class ModelJob(Job):
    """One model. While its views are being shot it is not ready."""

    kind: ClassVar[JobKind] = JobKind.MODEL
    uses_rig: ClassVar[bool] = False
    promises: ClassVar[tuple[str, ...]] = tuple(MEDIA_TYPES)
    noun: ClassVar[str] = "model"

    plan: ModelPlan

    @property
    def capture_share(self) -> float:
        """See `Job`."""
        return 0.0 if self.plan.shoot is None else SHOOTING_SHARE

    @property
    def ready(self) -> bool:
        """See `Job`."""
        return not self.plan.being_shot

    def document(self) -> dict[str, Any]:
        """See `Job`."""
        return plan_json(self.plan)

    @classmethod
    def from_record(cls, record: JobRecord) -> Self:
        """See `Job`."""
        return cls(plan_from_json(record.plan))

    def compute(self, run: JobRun) -> Outcome:
        """Make the model of the meshes of its scans, before the planes of the turntable if they cut."""
        from slrig.combine import combining

        if run.place is None:
            raise ValueError(run)
        data, plan = run.place.parent.parent, self.plan
        meshes = {str(scan): data / SCANS / str(scan) / MESH for scan in plan.scans}
        for scan, mesh in meshes.items():
            if not mesh.exists() or mesh.resolve() != (data / SCANS).resolve() / scan / MESH:
                raise _mesh_gone(mesh, scan)
        combining.combine_into(
            meshes,
            run.folder,
            plan.poses,
            start_error_mm=plan.start_error_mm,
            voxel_mm=plan.voxel_mm,
            planes=TurntableStore(data / TURNTABLE).planes() if plan.cut else (),
            notes=plan.notes,
            progress=run.report,
            cancelled=run.cancelled,
        )
        return Outcome(summary(run.folder))

    def place(self, data: DataFolder, job_id: UUID) -> Path:
        """See `Job`."""
        return data.root / MODELS / str(job_id)

    @classmethod
    def places(cls, data: DataFolder) -> Iterable[Path]:
        """See `Job`."""
        return sorted(data.root.glob(f"{MODELS}/*"))


def _mesh_gone(mesh: Path, scan: str) -> StorageError:
    return StorageError(f"{mesh} is gone, or a link. Leave scan {scan} out, or bring its files back.")


def turntable_planes(mesh: Path, axis: MeasuredAxis | None) -> tuple[TurntablePlane, ...]:
    """The planes in a mesh.ply of the empty turntable, found in the worker."""
    from slrig.combine.turntable_planes import planes_in

    return planes_in(mesh, axis)


class Models:
    """Has models made, and keeps the newest: the `Group` of models. Any thread may call.

    turntable : knows its axis and planes, and learns of each model's axis. keep : so many models are kept.
    spare_bytes : left free on the disk.
    """

    def __init__(self, manager: JobManager, *, turntable: TurntableStore, keep: int, spare_bytes: int = 0) -> None:
        self.jobs = manager.store
        self._manager = manager
        self._data = manager.data
        self._turntable = turntable
        self._keep = keep
        self._spare_bytes = spare_bytes
        # Held while scans are looked up and named by a job, and while one is deleted.
        self._naming = threading.Lock()
        (self._data.root / MODELS).mkdir(exist_ok=True)
        manager.groups[JobKind.MODEL] = self

    def place(self, model_id: UUID) -> Path:
        """Where the files of a model lie."""
        return self._data.root / MODELS / str(model_id)

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
            unfinished = self.jobs.unfinished(JobKind.MODEL)
            waiting = [each for each in unfinished if not plan_from_json(each.plan).being_shot]
            most = self._manager.backlog_length
            if len(waiting) >= most:
                message = f"{most} models are made or wait for that, as many as may. Try again later."
                raise QueueFullError(message)
            self._require_space(used)
            record = self._manager.submit(ModelJob(used), label=label, key=key)[0]
        self.remove_old()
        return self.jobs.get(record.id)

    def begin(self, record: JobRecord, plan: ModelPlan) -> None:
        """Have a model on record made, now that its views were shot: `plan` names them. Raises as `combine`."""
        with self._naming:
            used = self.settled(plan)
            self._require_space(used)
            record = self.jobs.replan(record.id, plan_json(used))
        self._manager.begin(ModelJob(used), record)
        self.remove_old()

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
            found = self.jobs.get(scan, JobKind.SCAN)
            if found.state is not JobState.SUCCEEDED:
                message = (
                    f"Scan {scan} is {found.state}. A model takes scans that succeeded: wait for it, or leave it out."
                )
                raise ScanStateError(message)
        poses = self.with_axis(plan).poses
        if isinstance(poses, MarkerPoses):
            without = [str(each) for each in plan.scans if not (self._data.scan(each) / BUNDLE).is_dir()]
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

    @contextmanager
    def unused(self, scan_id: UUID) -> Iterator[None]:
        """A scan that no model needs, which none comes to need within the block.

        Raises
        ------
        ScanStateError
            A model that waits or is being made needs it, or it is a view of one that is being shot.
        """
        with self._naming:
            for record in self.jobs.unfinished(JobKind.MODEL):
                if str(scan_id) in record.plan["scans"] or self.jobs.get(scan_id).parent == record.id:
                    message = (
                        f"Scan {scan_id} is needed by model {record.id}, which is {record.state}. Wait for it, or "
                        f"cancel it first (POST /model/{record.id}/cancel), then delete the scan."
                    )
                    raise ScanStateError(message)
            yield

    def captured(self, job: Job, job_id: UUID) -> None:
        """See `Group`."""

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:
        """See `Group`: the turntable learns the axis of a model that was made by its own, of scans that no earlier
        model was made of.
        """
        if outcome is None or not isinstance(job, ModelJob):
            return outcome or Outcome()
        poses, scans = job.plan.poses, set(map(str, job.plan.scans))
        if isinstance(poses, TurntablePoses) and poses.of_turntable:
            known = {
                scan
                for each in self.jobs.finished(JobKind.MODEL)
                if each.summary is not None
                for scan in each.plan["scans"]
            }
            try:
                axis = found_axis(self.place(job_id)) if known.isdisjoint(scans) else None
                if axis is not None:
                    self._turntable.note(axis, of=str(job_id))
            except Exception:  # noqa: BLE001 - the model is there, and is no worse for that
                _log.exception("the axis of a model could not be noted", model=str(job_id))
        return outcome

    def remove_old(self) -> None:
        """Remove the oldest models beyond those that are kept, and say so in the log."""
        for record in self.jobs.finished(JobKind.MODEL)[self._keep :]:
            try:
                self._manager.delete(record.id)
            except JobNotFoundError:
                # Deleted by somebody meanwhile.
                continue
            except StorageError as error:
                _log.warning("an old model could not be removed", model=str(record.id), cause=str(error))

    def _require_space(self, plan: ModelPlan) -> None:
        mesh_bytes = sum(self._mesh(scan).stat().st_size for scan in plan.scans)
        self._data.require_space(_FILES_OF_MESHES * mesh_bytes + self._spare_bytes)

    def _mesh(self, scan_id: UUID) -> Path:
        mesh = self._data.scan(scan_id) / MESH
        if not self._data.owns(mesh):
            raise _mesh_gone(mesh, str(scan_id))
        return mesh

    def _angle_told(self, scan_id: UUID) -> tuple[float, str | None] | None:
        """Where the turntable stood, deg, and what that counts from, as a scan's report says; None where it does
        not.
        """
        try:
            return turntable_angle(self._data.read(self._data.scan(scan_id) / "report.json"))
        except FileNotFoundError:
            return None

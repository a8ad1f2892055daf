"""Models as jobs: made in the worker of scans on record, or of views that are shot one after the other."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self
from uuid import UUID, uuid4

import numpy as np
import structlog

from slrig.bundle import stored_json
from slrig.errors import (
    ConfigError,
    DeviceError,
    DriverBrokenError,
    JobNotFoundError,
    ScanCancelledError,
    ScanStateError,
    SlrigError,
    StorageError,
    UnsupportedByDeviceError,
    ViewsFailedError,
)
from slrig.failure import errors_by_code, job_failure
from slrig.jobs.data_folder import BUNDLE, SCANS, DataFolder, require_whole
from slrig.jobs.job import Job, JobRun, Outcome
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState, acting_as, require_share, utc_now
from slrig.model import MeasuredAxis, TurntablePlane
from slrig.model_jobs.plan import (
    MEDIA_TYPES,
    REPORT,
    GivenPoses,
    MarkerPoses,
    ModelPlan,
    ShootPlan,
    StatedAxis,
    TurntablePoses,
    UnknownPoses,
    plan_from_json,
    plan_json,
    turntable_angle,
)
from slrig.model_jobs.turntable import TurntableStore
from slrig.scan.artefacts import MESH
from slrig.scan.job import ScanJob
from slrig.scan.job import plan_from_json as scan_plan_from_json


def summary(model: Path) -> dict[str, Any]:
    """A model's entry in a list, of the report in its folder. sigma_mm : of its vertices, the middle one.

    pose_sigma_mm : of the view that is known least. free : views that may move without a residual. notes : if there are
    any. Raises StorageError.
    """
    with _report(model) as report:
        return {
            "views": len(report["views"]),
            "pairs": len(report["pairs"]),
            "free": len({each["view"] for each in report["free"]}),
            "pose_sigma_mm": max(view["sigma_mm"] for view in report["views"]),
            **({"notes": report["notes"]} if report.get("notes") else {}),
            **{name: report["model"][name] for name in ("vertices", "triangles", "voxel_mm", "sigma_mm")},
        }


def found_axis(model: Path) -> MeasuredAxis | None:
    """The axis that a stage was found to turn about; None without a stage, or where motions were left as the start had
    them, and the axis with them. Raises StorageError.
    """
    with _report(model) as report:
        axis = report.get("axis")
        if axis is None or report["free"]:
            return None
        return MeasuredAxis(*(np.array(axis[name]) for name in ("point_mm", "direction", "covariance")))


@contextmanager
def _report(model: Path) -> Iterator[dict[str, Any]]:
    """A model's report. Raises StorageError: it cannot be read, or lacks a key that is read within the block."""
    try:
        yield stored_json((model / REPORT).read_bytes())
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{model / REPORT} cannot be read ({error}). Make the model again."
        raise StorageError(message) from error


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
    def from_plan(cls, record: JobRecord) -> Self:
        """See `Job`."""
        return cls(plan_from_json(record.plan))

    def compute(self, run: JobRun) -> Outcome:
        """Make the model of the meshes of its scans, before the planes of the turntable if they cut."""
        from slrig.model_jobs import combining

        if run.place is None:
            raise ValueError(run)
        data, plan = run.place.parent.parent, self.plan
        meshes = {str(scan): data / SCANS / str(scan) / MESH for scan in plan.scans}
        for scan, mesh in meshes.items():
            if not mesh.exists() or mesh.resolve() != (data / SCANS).resolve() / scan / MESH:
                raise _mesh_gone(mesh, scan)
            require_whole(mesh.parent, MESH, remedy=f"POST /scan/{scan}/reconstruct makes it again.")
        combining.combine_into(
            meshes,
            run.folder,
            plan.poses,
            run,
            start_error_mm=plan.start_error_mm,
            voxel_mm=plan.voxel_mm,
            planes=TurntableStore(data / TURNTABLE).planes() if plan.cut else (),
            notes=plan.notes,
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
    from slrig.model_jobs.combining import planes_in

    return planes_in(mesh, axis)


class Models:
    """Has models made: the `Group` of models. Any thread may call.

    turntable : knows its axis and planes, and learns of each model's axis; without an axis, the rig's own counts.
    spare_bytes : left free on the disk.
    """

    def __init__(self, manager: JobManager, *, turntable: TurntableStore, spare_bytes: int = 0) -> None:
        self.jobs = manager.store
        self._manager = manager
        self._data = manager.data
        self._turntable = turntable
        self._spare_bytes = spare_bytes
        # Held while scans are read and named by a job, and while one is deleted.
        self._naming = threading.Lock()
        (self._data.root / MODELS).mkdir(exist_ok=True)
        manager.groups[JobKind.MODEL] = self

    def place(self, model_id: UUID) -> Path:
        """Folder of a model's files."""
        return self._data.root / MODELS / str(model_id)

    def combine(self, plan: ModelPlan, *, label: str | None = None, key: str | None = None) -> JobRecord:
        """Make a model. Returns at once. key : the idempotency key of the request, reserved.

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
            # Those that are shot have their own line, and may wait for a person.
            unfinished = self.jobs.unfinished(JobKind.MODEL)
            waiting = [each for each in unfinished if not plan_from_json(each.plan).being_shot]
            most = self._manager.backlog_length
            require_share("for models", most, [each.requested_by for each in waiting])
            self._require_space(used)
            record = self._manager.submit(ModelJob(used), label=label, key=key)[0]
        return self.jobs.get(record.id)

    def begin(self, record: JobRecord, plan: ModelPlan) -> None:
        """Make a model on record, now that its views were shot: `plan` names them. Raises as `combine`."""
        with self._naming:
            used = self.settled(plan)
            self._require_space(used)
            record = self.jobs.replan(record.id, plan_json(used))
        self._manager.begin(ModelJob(used), record)

    def with_axis(self, plan: ModelPlan) -> ModelPlan:
        """The plan with the turntable's axis in it, where it leaves that to the turntable. Raises ConfigError."""
        poses = plan.poses
        if not isinstance(poses, TurntablePoses) or poses.axis is not None:
            return plan
        axis = self._turntable.axis() or self._manager.rig.axis
        if axis is None:
            message = (
                "axis: expected that of the turntable, and none is known here. Measure it with a board on the "
                'turntable (POST /rig/turntable/shoot), or leave it out of the matter: "poses": "unknown" or "markers"'
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
                    "poses: expected the frames of each scan, to find markers in, found none of "
                    f"{', '.join(without)}; leave those out, or give the poses in another way"
                )
                raise ConfigError(message)
        if not isinstance(poses, TurntablePoses):
            return plan
        if poses.angles_deg is None:
            recorded = {scan: self._recorded_angle(scan) for scan in plan.scans}
            without = [str(scan) for scan, turntable in recorded.items() if turntable is None]
            if without:
                message = (
                    "angles_deg: expected the turntable's angle in the report of each scan, found none in "
                    f"{', '.join(without)}; give angles_deg, one for each scan in their order, or give the poses"
                )
                raise ConfigError(message)
            turntables = [turntable for turntable in recorded.values() if turntable is not None]
            if len({count for _, count in turntables}) > 1:
                message = (
                    "angles_deg: expected angles with one zero, and the turntable lost its place between these scans; "
                    'give angles_deg as they are, "poses": "unknown", or shoot them again'
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
                if str(scan_id) in record.plan.get("scans", ()) or self.jobs.get(scan_id).parent == record.id:
                    message = (
                        f"Scan {scan_id} is needed by model {record.id}, which is {record.state}. Wait for it, or "
                        f"cancel it first (POST /model/{record.id}/cancel)."
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
            except Exception:  # noqa: BLE001 - the model is there, and is complete without it
                _log.exception("the axis of a model could not be noted", model=str(job_id))
        return outcome

    def _require_space(self, plan: ModelPlan) -> None:
        mesh_bytes = sum(self._mesh(scan).stat().st_size for scan in plan.scans)
        self._data.require_space(_FILES_OF_MESHES * mesh_bytes + self._spare_bytes)

    def _mesh(self, scan_id: UUID) -> Path:
        mesh = self._data.scan(scan_id) / MESH
        if not self._data.owns(mesh):
            raise _mesh_gone(mesh, str(scan_id))
        return mesh

    def _recorded_angle(self, scan_id: UUID) -> tuple[float, str | None] | None:
        """Angle of the turntable, deg, and the id of its zero, by a scan's report; None where it has none."""
        try:
            return turntable_angle(self._data.read(self._data.scan(scan_id) / "report.json"))
        except FileNotFoundError:
            return None


MOST_AGAIN = 2
"""Most automatic repeats of a view: a device that fails three times will fail again."""

VIEW, TURN = "view", "turn"
"""Stages of a model's progress: a view is shot, or the object is to be turned manually."""


@dataclass(frozen=True, slots=True)
class View:
    """One view of a model. number : from 1; scans : all that were shot of it, from the first to the last."""

    number: int
    scans: tuple[JobRecord, ...]

    @property
    def good(self) -> JobRecord | None:
        """The newest of its scans that succeeded."""
        return next((scan for scan in reversed(self.scans) if scan.state is JobState.SUCCEEDED), None)

    @property
    def ended(self) -> bool:
        """Whether it was shot, and nothing of it is under way."""
        return bool(self.scans) and all(scan.state.final for scan in self.scans)

    @property
    def why(self) -> str:
        """Why its last scan did not succeed."""
        if not self.scans:
            return "it was not shot"
        last = self.scans[-1]
        return str(last.state) if last.fault is None else last.fault.message

    @property
    def count(self) -> str | None:
        """Id of the zero of the turntable's angle of its good scan; None without one, as where a person turns."""
        found = None if self.good is None else (self.good.summary or {}).get("turntable", {}).get("count")
        return None if found is None else str(found)

    @property
    def again(self) -> bool:
        """Whether it is repeated automatically: a device failed, or the service was ended."""
        failed = 0
        for scan in reversed(self.scans):
            if not _may_pass(scan):
                break
            failed += 1
        return self.ended and 0 < failed <= MOST_AGAIN


def views_of(shoot: ShootPlan, scans: Sequence[JobRecord]) -> tuple[View, ...]:
    """The views of a model by the scans that name it as their parent, from old to new."""
    by_number: dict[int, list[JobRecord]] = {number: [] for number in range(1, shoot.views + 1)}
    for scan in scans:
        if (place := scan_plan_from_json(scan.plan).series) is not None:
            by_number[place.number].append(scan)
    return tuple(View(number, tuple(shot)) for number, shot in by_number.items())


class ViewShooting:
    """Shoots models. Any thread may call; `view_ended` has to be called with each scan that is over."""

    def __init__(self, models: Models, manager: JobManager) -> None:
        self._models = models
        self._manager = manager
        self._jobs = manager.store
        # Held while the next step is decided; the end of a scan may be reported within.
        self._deciding = threading.RLock()

    def take_up(self) -> None:
        """Go on with the models that an earlier run of the service was shooting; once its scans are taken up."""
        for record in self._jobs.unfinished(JobKind.MODEL):
            if plan_from_json(record.plan).being_shot:
                self._watch(record.id)
                try:
                    self._go_on(record.id)
                except Exception:  # noqa: BLE001 - the others, and the service, go on all the same
                    _log.exception("a model could not be gone on with", model=str(record.id))
        # A cancellation that was cut off is completed.
        models = self._jobs.states(JobKind.MODEL)
        for scan in self._jobs.unfinished(JobKind.SCAN):
            if scan.parent is not None and models.get(scan.parent) is JobState.CANCELLED:
                self._manager.cancel(scan.id)

    def shoot(self, plan: ModelPlan, *, label: str | None, wait: bool, key: str | None = None) -> JobRecord:
        """Shoot the views of a model, and make the model of them. Returns at once.

        Where a person turns only the first view is shot; `shoot_view` shoots each of the others. wait : wait in line
        while the rig is held. key : the idempotency key of the request, reserved.

        Raises
        ------
        UnsupportedByDeviceError
            The rig has no turntable, and the plan is not `manual`; or it cannot do the requested scans.
        ConfigError
            The poses are to be a turntable's, and its axis is not known.
        PatternError, CalibrationError, StorageError, RigBusyError, QueueFullError, DeviceError
            As a scan.
        """
        shoot = _shoot_plan(plan)
        plan = self._models.with_axis(plan)
        model_id, numbers = uuid4(), range(1, 2 if shoot.manual else shoot.views + 1)

        def begun() -> None:
            self._manager.record(ModelJob(plan), label=label, key=key, job_id=model_id)

        views = [ScanJob(shoot.view(number, model_id, utc_now())) for number in numbers]
        self._require_space(views)
        with self._deciding:
            try:
                self._manager.submit(*views, label=label, wait=wait, first=begun)
            except StorageError as error:
                # Its scans could not be put on record: it is not to wait for them.
                with suppress(JobNotFoundError, StorageError):
                    self._jobs.finish(model_id, JobState.FAILED, fault=job_failure(error))
                raise
            self._record_progress(model_id, shoot)
        self._watch(model_id)
        return self._jobs.get(model_id, JobKind.MODEL)

    def shoot_view(self, model_id: UUID, *, again: bool, wait: bool, key: str | None = None) -> JobRecord:
        """Shoot the next view of a model of a manually turned object; or the last one again, which replaces it. Returns
        the model at once.

        Raises
        ------
        JobNotFoundError
            There is no such model.
        ScanStateError
            It does not wait for a person, or has no further view.
        PatternError, CalibrationError, StorageError, RigBusyError, QueueFullError, DeviceError
            As a scan.
        """
        with self._deciding:
            record, shoot, views = self._waiting(model_id)
            begun = [view.number for view in views if view.scans]
            number = begun[-1] if again else len(begun) + 1
            if number > shoot.views:
                message = (
                    f"All {shoot.views} views of model {model_id} were shot. Make the model of them "
                    f'(POST /model/{model_id}/combine), or shoot the last one once more ("again": true).'
                )
                raise ScanStateError(message)
            plan = shoot.view(number, model_id, utc_now())
            self._manager.submit(ScanJob(plan), label=record.label, wait=wait, key=key)
            self._record_progress(model_id, shoot)
            return self._jobs.get(model_id, JobKind.MODEL)

    def combine(self, model_id: UUID) -> JobRecord:
        """Make a model of the present views. Returns it at once.

        Raises
        ------
        JobNotFoundError
            There is no such model.
        ScanStateError
            It does not wait for a person, or fewer than two of its views are good.
        """
        with self._deciding:
            record, shoot, views = self._waiting(model_id)
            good = sum(view.good is not None for view in views)
            if good < 2:
                message = f"Model {model_id} has {good} good views of {shoot.views}; it takes two. Shoot another first."
                raise ScanStateError(message)
            self._combine(record, shoot, views)
            return self._jobs.get(model_id, JobKind.MODEL)

    def cancel(self, model_id: UUID) -> JobRecord:
        """Request the early end of a model and of its scans that are not over. Returns at once; one that is over stays
        so. Raises JobNotFoundError.
        """
        with self._deciding:
            record = self._jobs.get(model_id, JobKind.MODEL)
            if not plan_from_json(record.plan).being_shot:
                return self._manager.cancel(model_id)
            fault = job_failure(ScanCancelledError("The model was cancelled while its views were shot. They stay."))
            self._jobs.finish(model_id, JobState.CANCELLED, fault=fault)
            # Also of one that was cancelled before, and not wholly. The last first: no other one begins meanwhile.
            for scan in reversed(self._jobs.of(model_id)):
                if not scan.state.final:
                    self._manager.cancel(scan.id)
            return self._jobs.get(model_id, JobKind.MODEL)

    def view_ended(self, scan: JobRecord) -> None:
        """Go on with the model that a scan is a view of, if it is one. Raises nothing; see `JobStore.after_end`."""
        if scan.parent is None or scan_plan_from_json(scan.plan).turn_deg is None:
            return
        try:
            self._go_on(scan.parent)
        except Exception:  # noqa: BLE001 - the scan is over, and the next start goes on from the records
            _log.exception("a model could not be gone on with", model=str(scan.parent))

    def _go_on(self, model_id: UUID) -> None:
        """Take the next step: shoot a missing view, prompt the person, or make the model."""
        with self._deciding:
            try:
                record = self._jobs.get(model_id, JobKind.MODEL)
            except JobNotFoundError:
                # Of a series of scans, or of a model that was deleted.
                return
            plan = plan_from_json(record.plan)
            if record.state.final or not plan.being_shot or self._manager.ending:
                return
            shoot = _shoot_plan(plan)
            views = self._views(model_id, shoot)
            if shoot.manual:
                # The object is turned as for the last view that was begun; the first one needs no turn.
                begun = [view for view in views if view.scans] or [views[0]]
                missing = [view for view in begun[-1:] if view.again or not view.scans]
            else:
                missing = [view for view in views if view.again or not view.scans]
            if not missing and all(view.ended for view in views):
                missing = [view for view in _of_another_zero(plan, views) if len(view.scans) <= MOST_AGAIN]
            if missing:
                _log.info("views are put in line", model=str(model_id), views=[view.number for view in missing])
                jobs = [ScanJob(shoot.view(view.number, model_id, utc_now())) for view in missing]
                with acting_as(record.requested_by):
                    self._manager.add(*jobs, label=record.label)
            elif shoot.manual and not (views[-1].ended and views[-1].good is views[-1].scans[-1]):
                pass  # A person turns, or decides what becomes of a last view that failed.
            elif all(view.ended or shoot.manual for view in views):
                self._combine(record, shoot, views)
                return
            self._record_progress(model_id, shoot)

    def _combine(self, record: JobRecord, shoot: ShootPlan, views: Sequence[View]) -> None:
        """Make the model of its good views, or end it with a message."""
        plan = plan_from_json(record.plan)
        lost = {view.number for view in _of_another_zero(plan, views)}
        good = {view.number: view.good.id for view in views if view.good is not None and view.number not in lost}
        left_out = tuple(
            f"view {view.number} of {shoot.views}, at {shoot.angle_deg(view.number):g}°, is not in it: "
            + ("the turntable lost its place after it" if view.number in lost else view.why)
            for view in views
            if view.number not in good
        )
        poses = plan.poses
        if isinstance(poses, GivenPoses):
            poses = replace(poses, matrices=tuple(poses.matrices[number - 1] for number in good))
        elif isinstance(poses, TurntablePoses):
            poses = replace(poses, angles_deg=tuple(shoot.angle_deg(number) for number in good))
        try:
            if len(good) < 2:
                message = (
                    f"{len(good)} of {shoot.views} views succeeded, and a model takes two: {'; '.join(left_out)}. "
                    f"The scans stay: GET /scan/series/{record.id}. Put right what failed, and shoot again."
                )
                raise ViewsFailedError(message)
            self._models.begin(record, replace(plan, scans=tuple(good.values()), poses=poses, notes=left_out))
        except SlrigError as error:
            _log.warning("a model failed", model=str(record.id), cause=str(error))
            self._jobs.finish(record.id, JobState.FAILED, fault=job_failure(error))

    def _require_space(self, views: Sequence[ScanJob]) -> None:
        """Raise StorageError unless there is room for all views."""
        self._manager.require_space(sum(view.check(self._manager.rig) for view in views))

    def _waiting(self, model_id: UUID) -> tuple[JobRecord, ShootPlan, tuple[View, ...]]:
        """A model that waits for a person. Raises JobNotFoundError, ScanStateError."""
        record = self._jobs.get(model_id, JobKind.MODEL)
        plan = plan_from_json(record.plan)
        if record.state.final or not plan.being_shot or plan.shoot is None or not plan.shoot.manual:
            how = "is not shot manually" if plan.shoot is None or not plan.shoot.manual else f"is {record.state}"
            message = f'Model {model_id} {how}. Begin one: POST /model/shoot with "manual": true.'
            raise ScanStateError(message)
        views = self._views(model_id, plan.shoot)
        for view in views:
            if view.scans and (not view.ended or view.again):
                message = (
                    f"View {view.number} of model {model_id} is being shot. Wait for its end, then turn the object."
                )
                raise ScanStateError(message)
        return record, plan.shoot, views

    def _views(self, model_id: UUID, shoot: ShootPlan) -> tuple[View, ...]:
        return views_of(shoot, self._jobs.of(model_id))

    def _record_progress(self, model_id: UUID, shoot: ShootPlan) -> None:
        """Record its progress, and for a person the next step."""
        views = self._views(model_id, shoot)
        done = sum(view.good is not None for view in views)
        under_way = next((view for view in views if view.scans and not view.ended), None)
        # Where none is under way the last has just ended, and the model comes next.
        stage, detail = VIEW, f"view {(under_way or views[-1]).number} of {shoot.views}"
        if under_way is None and shoot.manual:
            stage, last = TURN, ([view for view in views if view.scans] or [views[0]])[-1]
            detail = (
                f"turn the object by {shoot.step_deg:g}° for view {last.number + 1} of {shoot.views}"
                if last.number < shoot.views
                else "all views were shot: shoot the last one again, or have the model made"
            )
            if last.good is None:
                detail = f"view {last.number} failed, and may be shot again: {last.why} Or {detail}"
        try:
            self._jobs.progress(model_id, JobProgress(stage, SHOOTING_SHARE * done / shoot.views, detail))
        except StorageError as error:
            _log.warning("the progress of a model could not be recorded", model=str(model_id), cause=str(error))

    def _watch(self, model_id: UUID) -> None:
        """Record a queued model as capturing once the first of its views is begun."""

        def check() -> None:
            # During a decision the next event will do: the thread of this one may hold a lock.
            if not self._deciding.acquire(blocking=False):
                return
            try:
                check_states()
            except StorageError as error:
                _log.warning("the first view of a model could not be recorded", model=str(model_id), cause=str(error))
            finally:
                self._deciding.release()

        def check_states() -> None:
            begun = any(scan.state is not JobState.QUEUED for scan in self._jobs.of(model_id))
            if begun and watching:
                watching.pop()()
                if self._jobs.states(JobKind.MODEL).get(model_id) is JobState.QUEUED:
                    self._jobs.advance(model_id, JobState.CAPTURING)

        watching: list[Callable[[], None]] = []
        watching.append(self._jobs.watch(model_id, check))
        check()


def _shoot_plan(plan: ModelPlan) -> ShootPlan:
    if plan.shoot is None:
        message = "shoot: expected what is shot, found none; POST /model makes a model of scans that there are"
        raise ScanStateError(message)
    return plan.shoot


def _of_another_zero(plan: ModelPlan, views: Sequence[View]) -> list[View]:
    """Good views with angles from another zero than those of the newest one: the turntable, or the service in the
    middle of a turn, was restarted in between. None where no angle is used.
    """
    good = [view for view in views if view.good is not None]
    if isinstance(plan.poses, UnknownPoses | MarkerPoses) or not good:
        return []
    newest = max(good, key=lambda view: 0 if view.good is None else view.good.number)
    return [view for view in good if view.count != newest.count]


def _may_pass(scan: JobRecord) -> bool:
    """Whether a scan failed by a passing cause: a device's fault, or the end of the service."""
    if scan.state is JobState.INTERRUPTED:
        return True
    error = SlrigError if scan.fault is None else errors_by_code().get(scan.fault.code, SlrigError)
    cannot = issubclass(error, UnsupportedByDeviceError | DriverBrokenError)
    return scan.state is JobState.FAILED and issubclass(error, DeviceError) and not cannot

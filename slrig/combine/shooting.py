"""The views of a model, shot as scans of their own: all at once by the rig's turntable, or one by one by hand.

A model on record says what is shot, its scans name it as their parent, and nothing else is kept: whatever ends the
service, the next start goes on from the records.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from uuid import UUID, uuid4

import structlog

from slrig.combine.job import SHOOTING_SHARE, ModelJob, Models
from slrig.combine.plan import (
    GivenPoses,
    MarkerPoses,
    ModelPlan,
    ShootPlan,
    TurntablePoses,
    UnknownPoses,
    plan_from_json,
)
from slrig.errors import (
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
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState, acting_as, utc_now
from slrig.scan.job import ScanJob
from slrig.scan.records import plan_from_json as scan_plan_from_json

MOST_AGAIN = 2
"""How often a view is shot again by itself: what a device does three times it will do once more."""

VIEW, TURN = "view", "turn"
"""Stages of a model's progress: a view is shot, or the object is to be turned by hand."""

_log = structlog.get_logger(__name__)


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
        """What the turntable's angle of its good scan counts from; None where that is not kept, as by hand."""
        found = None if self.good is None else (self.good.summary or {}).get("turntable", {}).get("count")
        return None if found is None else str(found)

    @property
    def again(self) -> bool:
        """Whether it is to be shot again by itself: a device failed, or the service was ended."""
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
        # Held while it is decided what comes next; the end of a scan may be told within.
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
        """Have the views of a model shot, and the model made of them. Returns at once.

        By hand only the first view is shot, as the object stands; `shoot_view` shoots each of the others. wait : stand
        in line while the rig is held. key : the idempotency key of the request, reserved.

        Raises
        ------
        UnsupportedByDeviceError
            The rig has no turntable, and nobody turns the object by hand; or it cannot do what the scans ask for.
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
            self._tell(model_id, shoot)
        self._watch(model_id)
        return self._jobs.get(model_id, JobKind.MODEL)

    def shoot_view(self, model_id: UUID, *, again: bool, wait: bool, key: str | None = None) -> JobRecord:
        """Have the next view of a model shot, whose object was turned by hand; or the last one once more, in place of
        what there is of it. Returns the model at once.

        Raises
        ------
        JobNotFoundError
            There is no such model.
        ScanStateError
            It waits for no hand, or has no further view.
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
            self._tell(model_id, shoot)
            return self._jobs.get(model_id, JobKind.MODEL)

    def combine(self, model_id: UUID) -> JobRecord:
        """Have a model made of the views that there are. Returns it at once.

        Raises
        ------
        JobNotFoundError
            There is no such model.
        ScanStateError
            It waits for no hand, or fewer than two of its views are good.
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
        """Ask a model to end early, and with it those of its scans that are not over. Returns at once; one that is over
        stays so. Raises JobNotFoundError.
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
        """Do what comes next, whatever was done before: shoot what is missing, tell a person, or make the model."""
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
                # The object stands as for the last that was begun; the first one needs no hand.
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
            self._tell(model_id, shoot)

    def _combine(self, record: JobRecord, shoot: ShootPlan, views: Sequence[View]) -> None:
        """Have the model made of its good views, or end it in words."""
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
        """A model that waits for a hand. Raises JobNotFoundError, ScanStateError."""
        record = self._jobs.get(model_id, JobKind.MODEL)
        plan = plan_from_json(record.plan)
        if record.state.final or not plan.being_shot or plan.shoot is None or not plan.shoot.manual:
            how = "is not shot by hand" if plan.shoot is None or not plan.shoot.manual else f"is {record.state}"
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

    def _tell(self, model_id: UUID, shoot: ShootPlan) -> None:
        """Put on record how far it is, and for a person what to do."""
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
            _log.warning("how far a model is could not be recorded", model=str(model_id), cause=str(error))

    def _watch(self, model_id: UUID) -> None:
        """Have a model that is queued be on record as capturing once the first of its views is begun."""

        def look() -> None:
            # The next event will do where this one comes in the middle of a decision: whoever tells it may hold a lock.
            if not self._deciding.acquire(blocking=False):
                return
            try:
                look_at_states()
            except StorageError as error:
                _log.warning("that a model is shot could not be recorded", model=str(model_id), cause=str(error))
            finally:
                self._deciding.release()

        def look_at_states() -> None:
            begun = any(scan.state is not JobState.QUEUED for scan in self._jobs.of(model_id))
            if begun and watching:
                watching.pop()()
                if self._jobs.states(JobKind.MODEL).get(model_id) is JobState.QUEUED:
                    self._jobs.advance(model_id, JobState.CAPTURING)

        watching: list[Callable[[], None]] = []
        watching.append(self._jobs.watch(model_id, look))
        look()


def _shoot_plan(plan: ModelPlan) -> ShootPlan:
    if plan.shoot is None:
        message = "shoot: expected what is shot, found none; POST /model makes a model of scans that there are"
        raise ScanStateError(message)
    return plan.shoot


def _of_another_zero(plan: ModelPlan, views: Sequence[View]) -> list[View]:
    """Good views whose angles count from another zero than those of the newest one: the turntable, or the service in
    the middle of a turn, was restarted in between. None where no angle is used.
    """
    good = [view for view in views if view.good is not None]
    if isinstance(plan.poses, UnknownPoses | MarkerPoses) or not good:
        return []
    newest = max(good, key=lambda view: 0 if view.good is None else view.good.number)
    return [view for view in good if view.count != newest.count]


def _may_pass(scan: JobRecord) -> bool:
    """Whether a scan failed by what may be over the next time: a device's fault, or the end of the service."""
    if scan.state is JobState.INTERRUPTED:
        return True
    error = SlrigError if scan.fault is None else errors_by_code().get(scan.fault.code, SlrigError)
    cannot = issubclass(error, UnsupportedByDeviceError | DriverBrokenError)
    return scan.state is JobState.FAILED and issubclass(error, DeviceError) and not cannot

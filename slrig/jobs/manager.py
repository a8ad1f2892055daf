"""Runs jobs: one at a time with the rig, others compute meanwhile; each job is on record with one end.

A job leaves the rig after its capture the rig to the next one. Previews are taken in between.
"""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, TypeVar
from uuid import UUID, uuid4

import structlog

from slrig.errors import (
    ArtefactNotReadyError,
    DeviceError,
    InvalidInputError,
    JobNotFoundError,
    RigBusyError,
    ScanCancelledError,
    ScanInterruptedError,
    ScanStateError,
    SlrigError,
    StorageError,
    WorkerLostError,
)
from slrig.failure import UNEXPECTED, JobFailure, LastingThread, as_error, interruption_error, job_failure
from slrig.jobs.data_folder import BUNDLE, DataFolder, read_entries, require_files
from slrig.jobs.job import FrameFeed, Group, Job, JobRun, Outcome, ProgressRecorder, Recording, due_s
from slrig.jobs.listener import Listener
from slrig.jobs.records import (
    Holder,
    JobKind,
    JobRecord,
    JobState,
    acting_as,
    holder_of,
    read_record,
    require_share,
    utc_now,
    write_record,
)
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Compute, job_task
from slrig.live.room import LiveOptions, LiveRoom, LiveStatus
from slrig.rig.preview import Light, Previews, Watch
from slrig.rig.session import ActiveCalibration, RigFacts, RigSession, driver_errors
from slrig.rig.watchdog import Call, Watchdog

RETRY_S = 2.0
"""Seconds until an end of a job that the disk refused to record is recorded again: clients may wait for it."""

MAX_ATTEMPTS = 3
"""So often the worker begins a job, where the worker or the service ends before the job."""

_POLL_S = 0.1
"""Interval at which a drain checks whether it is over, or aborted."""

_log = structlog.get_logger(__name__)

_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class RigStatus:
    """The rig's state as last known, its holder and since when, how many jobs wait, and which compute.

    active : the calibration that takes the place of the rig's own; misfit : why it cannot be used. holder, and those of
    computing : `Holder.name`. opening : what the rig's driver said last while it is opened. reconstruction :
    `Compute.condition`; preparing : whether that is on its way to ready. ending : whether the service ends.
    """

    rig: str
    facts: RigFacts | None
    active: ActiveCalibration | None
    misfit: str | None
    fault: str | None
    holder: str | None
    since: datetime | None
    waiting: int
    queue_length: int
    computing: tuple[str, ...]
    backlog_length: int
    opening: str
    reconstruction: str
    preparing: bool
    ending: bool


@dataclass(slots=True, eq=False)
class _Work:
    """A job that waits or is under way. Only its first end counts.

    by : who requested it. captured : its frames are taken, and it is to compute. resumable : whether the next start
    goes on with it. stop : set when it is to end early. error : by which it ended, once `ended`. outcome : what it
    found. worked : nothing of it is under way any more. dismissed : its group knows that it came to nothing.
    """

    id: UUID
    job: Job
    holder: Holder
    since: datetime
    due_s: float = -math.inf
    by: str | None = None
    captured: bool = False
    resumable: bool = True
    stop: threading.Event = field(default_factory=threading.Event)
    feed: FrameFeed | None = None
    recording: Recording | None = None
    outcome: Outcome = field(default_factory=Outcome)
    error: Exception | None = None
    ended: bool = False
    worked: bool = False
    dismissed: bool = False
    settling: threading.Lock = field(default_factory=threading.Lock)
    settled: bool = False


@dataclass(frozen=True, slots=True)
class _NoJob(Job):
    """Represents a use of the rig for some seconds that is not on record."""

    kind: ClassVar[JobKind] = JobKind.SCAN
    computes: ClassVar[bool] = False


@dataclass(slots=True, eq=False)
class _Loan(_Work):
    """The rig lent to a caller, who waits until `over`."""

    use: Callable[[RigSession, Listener], Any] = lambda _rig, _listener: None
    result: Any = None
    over: threading.Event = field(default_factory=threading.Event)


@dataclass(frozen=True, slots=True, eq=False)
class _End:
    """The final state of a job that is not on record yet."""

    id: UUID
    state: JobState
    outcome: Outcome


class JobManager:
    """Runs the jobs of one rig in the order in which they came. Any thread may call.

    While `backlog_length` jobs compute, none begins that will; of an earlier run of the service there may be more.
    kinds : the classes of the jobs that may be on record. groups : what jobs of a kind belong to. spare_bytes : left
    free on the disk. give_up : called on the rig's thread when the first opening shows that the rig file is wrong.
    """

    def __init__(
        self,
        store: JobStore,
        data: DataFolder,
        rig: RigSession,
        worker: Compute,
        *kinds: type[Job],
        queue_length: int = 8,
        backlog_length: int = 16,
        spare_bytes: int = 0,
        give_up: Callable[[InvalidInputError], None] = lambda _: None,
    ) -> None:
        self.store = store
        self.data = data
        self.rig = rig
        self.worker = worker
        self.queue_length = queue_length
        self.backlog_length = backlog_length
        self.kinds: Mapping[JobKind, type[Job]] = {kind.kind: kind for kind in kinds}
        self.groups: dict[JobKind, Group] = {}
        self._spare_bytes = spare_bytes
        self._give_up = give_up
        self._changed = threading.Condition()
        # Replaced, never changed: previews read it without the lock.
        self._waiting: tuple[_Work, ...] = ()
        self._active: _Work | None = None
        self._computing: list[_Work] = []
        self._ends: list[_End] = []
        self._again: threading.Timer | None = None
        self.live = LiveRoom(self._wake)
        self._previews = Previews(self._wake)
        self._ending = self._closed = False
        self._closing = threading.Lock()
        self._turns: dict[UUID | None, threading.Lock] = defaultdict(threading.Lock)
        self._owner = LastingThread(self._own_rig, "slrig-rig")
        self._watchdog = Watchdog(rig.calls, self._give_up_on)

    # Requests

    def start(self, *, prepare: bool = True) -> None:
        """Open the rig, on its own thread. prepare : have the worker load its kernels at once, not when one is used."""
        # With the lock held, so that a job that the owner captures meanwhile is computed once.
        with self._changed:
            self._owner.start()
            for work in self._computing:
                self._begin_computing(work)
        self._watchdog.start()
        if prepare:
            self.worker.start()

    def submit(
        self,
        *jobs: Job,
        label: str | None = None,
        wait: bool = False,
        key: str | None = None,
        holder: Holder | None = None,
        first: Callable[[], object] = lambda: None,
    ) -> list[JobRecord]:
        """Put jobs of one kind on record, all or none, and line them up in their order. Returns at once.

        wait : the first may wait behind other jobs. key : the idempotency key of the request, reserved. holder : whom
        a refusal names meanwhile; None the job. first : called once a place in the line is certain, before anything is
        on record.

        Raises
        ------
        SlrigError
            As `Job.check` raises.
        StorageError
            There is too little room, or the disk refused.
        RigBusyError
            The rig is held, and `wait` is False.
        QueueFullError
            As many wait as may.
        ScanInterruptedError
            The service ends.
        DeviceError
            A driver hangs.
        """
        self.require_space(max(job.check(self.rig) for job in jobs))
        with self._changed:
            if jobs[0].uses_rig:
                self._require_place(wait=wait)
            first()
            records = self.record(*jobs, label=label, key=key)
            works = [self._work(job, record, holder) for job, record in zip(jobs, records, strict=True)]
            self._line_up(works)
        if jobs[0].uses_rig:
            self._previews.interrupt()
        return records

    def lend(self, holder: Holder, use: Callable[[RigSession, Listener], _Result]) -> _Result:
        """Use the rig on its thread for some seconds, now or not at all, and return the result.

        use : is given the rig, to be opened, and who says whether it is to end early. Nothing is on record. Raises what
        that raises, and RigBusyError and DeviceError as `submit`.
        """
        loan = _Loan(uuid4(), _NoJob(), holder, utc_now(), resumable=False, use=use)
        with self._changed:
            self._require_place(wait=False)
            self._line_up([loan])
        self._previews.interrupt()
        loan.over.wait()
        if loan.error is not None:
            raise loan.error
        result: _Result = loan.result
        return result

    def require_space(self, needed_bytes: int) -> None:
        """Raise StorageError unless there is room for so much, and for what is left free."""
        self.data.require_space(needed_bytes + self._spare_bytes)

    def record(
        self, *jobs: Job, label: str | None = None, key: str | None = None, job_id: UUID | None = None
    ) -> list[JobRecord]:
        """Put jobs of one kind on record, as waiting."""
        plans = [job.document() for job in jobs]
        kind, rig, group = jobs[0].kind, self.rig.name, jobs[0].parent
        return self.store.create_all(plans, kind=kind, rig=rig, label=label, parent=group, key=key, job_id=job_id)

    def add(self, *jobs: Job, label: str | None = None, holder: Holder | None = None) -> list[JobRecord]:
        """Put jobs on record and line them up, however many wait: no client could be refused."""
        with self._changed:
            records = self.record(*jobs, label=label)
            self._line_up([self._work(job, record, holder) for job, record in zip(jobs, records, strict=True)])
        return records

    def begin(self, job: Job, record: JobRecord, *, captured: bool = False, holder: Holder | None = None) -> None:
        """Line up a job that is on record, however many wait. captured : its frames are there."""
        with self._changed:
            self._line_up([self._work(job, record, holder, captured=captured)])

    def compute_again(self, job_id: UUID, instead: Job | None = None) -> JobRecord:
        """Compute a finished job again from its bundle; the result then replaces its files. instead : computed in place
        of the job on record.

        Raises JobNotFoundError; ScanStateError where it is not over, or of a kind that is not computed from its bundle
        alone; ArtefactNotReadyError without a bundle; DamagedError where that is damaged; StorageError.
        """
        record = self.store.get(job_id)
        job = instead or self.kinds[record.kind].from_record(record)
        place = job.place(self.data, job_id)
        if not record.state.final or not job.movable or place is None:
            message = f"{record.kind.capitalize()} {job_id} is {record.state}, and cannot be computed again."
            raise ScanStateError(message)
        if not self.data.owns(place / BUNDLE):
            message = f"{record.kind.capitalize()} {job_id} has no bundle: its frames are gone. Start another one."
            raise ArtefactNotReadyError(message)
        bundle = [name for name in read_entries(place) if name.startswith(f"{BUNDLE}/")]
        self.data.require_whole(place, *bundle)
        self.require_space(sum(path.stat().st_size for path in place.iterdir() if path.is_file()))
        self.data.stage_bundle(job_id, place)
        with self._changed:
            if self._ending:
                raise interruption_error()
            self.store.replan(job_id, record.plan if instead is None else instead.document())
            self.store.advance(job_id, JobState.COMPUTING)
        self.begin(job, record, captured=True)
        return self.store.get(job_id)

    def cancel(self, job_id: UUID) -> JobRecord:
        """Request a job's early end, and return it at once; one that is over stays so. Raises JobNotFoundError."""
        with self._changed:
            queued = next((work for work in self._waiting if work.id == job_id), None)
            if queued is not None:
                self._waiting = tuple(each for each in self._waiting if each is not queued)
                message = f"This {queued.job.noun} was cancelled while it waited for the rig."
                self._end(queued, ScanCancelledError(message))
            under_way = [work for work in self._under_way() if work.id == job_id]
            for work in under_way:
                work.stop.set()
        if queued is not None:
            self._settle(queued)
        elif not under_way:
            self.settle()
            if all(end.id != job_id for end in self._ends):
                # No thread works on it, and its end is unknown.
                fault = job_failure(ScanInterruptedError("Nothing works on this any more. Start it again."))
                self.store.finish(job_id, JobState.INTERRUPTED, fault=fault)
        return self.store.get(job_id)

    def wait(self, job_id: UUID, timeout_s: float | None = None) -> JobRecord:
        """Return a job once it is over and its end on record, or after so long as it is then."""
        over = threading.Event()

        def check() -> None:
            with suppress(JobNotFoundError):
                if not self.store.get(job_id).state.final:
                    return
            over.set()

        unwatch = self.store.watch(job_id, check)
        try:
            check()
            over.wait(timeout_s)
        finally:
            unwatch()
        return self.store.get(job_id)

    def delete(
        self, job_id: UUID, unused: AbstractContextManager[object] | None = None, trash: Path | None = None
    ) -> None:
        """Remove a job that is over, or move its files to `trash`. Raises JobNotFoundError, ScanStateError.

        unused : entered meanwhile; it raises where something else needs the job.
        """
        # Before `unused`: listeners to an end may take the locks that it holds.
        self.settle()
        record = self.store.get(job_id)
        if not record.state.final:
            how = f"POST {holder_of(record).path}/cancel"
            message = f"{record.kind.capitalize()} {job_id} is {record.state}. Cancel it first ({how}), then delete it."
            raise ScanStateError(message)
        place = self.kinds[record.kind].place_of(record, self.data)
        with unused or nullcontext():
            self.data.discard(job_id)
            if place is not None:
                self.data.withdraw(place, job_id)
            self.store.delete(job_id)
        self.data.discard(job_id, trash)
        _log.info("job deleted", kind=str(record.kind), job=str(job_id))

    def watch(self, camera: str, light: Light, exposure_s: float | None = None) -> Watch:
        """Preview of a camera; pictures come while the rig is idle, and wait while it is held. exposure_s : see
        `Previews.watch`.

        Raises
        ------
        CameraNotFoundError
            The rig has no camera of that name.
        DeviceError
            The rig is not open, or not yet.
        """
        self._require_serving()
        self.rig.require_camera(camera)
        return self._previews.watch(camera, light, exposure_s)

    def go_live(self, options: LiveOptions) -> LiveStatus:
        """Begin live depth, which the rig plays while it is idle. Raises as `watch` and `LiveRoom.start` do."""
        self._require_serving()
        facts = self.rig.require_camera(options.camera)
        self.rig.refuse_misfit()
        return self.live.start(options, facts.cameras[options.camera], facts.projector, self.rig.calibration)

    def status(self) -> RigStatus:
        """Return who holds the rig, and how it is. Touches no device."""
        rig = self.rig
        with self._changed:
            holder = None if self._active is None else self._active.holder.name
            since = None if self._active is None else self._active.since
            computing, waiting = tuple(work.holder.name for work in self._computing), len(self._due())
        active = rig.active
        misfit = None if active is None else rig.misfit(active)
        return RigStatus(
            rig=rig.name,
            facts=rig.facts,
            active=active,
            misfit=None if misfit is None else str(misfit),
            fault=None if rig.fault is None else rig.fault.message,
            holder=holder,
            since=since,
            waiting=waiting,
            queue_length=self.queue_length,
            computing=computing,
            backlog_length=self.backlog_length,
            opening=rig.calls.doing,
            reconstruction=self.worker.condition,
            preparing=self.worker.loading,
            ending=self._ending,
        )

    @property
    def ending(self) -> bool:
        """Whether the service ends."""
        return self._ending

    def drain(self, timeout_s: float, hurry: threading.Event) -> None:
        """Begin no further job, and wait until those under way are over, for so long, or until `hurry`.

        Waiting jobs stay on record: the next start of the service goes on with them. Call `close` afterwards.
        """
        give_up = time.monotonic() + timeout_s
        with self._changed:
            self._ending = True
            while self._under_way() and not hurry.is_set() and time.monotonic() < give_up:
                self._changed.wait(_POLL_S)

    def close(self, *, timeout_s: float = 3.0) -> None:
        """End what is under way, darken and close the rig, and record what was cut off. Idempotent.

        A driver that does not return in `timeout_s` is left behind: the projector is made dark from another thread, as
        far as the driver allows, and its job is recorded all the same.
        """
        with self._closing:
            if self._closed:
                return
            self._closed = True
            self._stop()
            # A computing job waits for it.
            self.worker.close()
            self._join(timeout_s)
            with self._changed:
                if self._again is not None:
                    self._again.cancel()
            self.settle()

    # The line

    def _work(self, job: Job, record: JobRecord, holder: Holder | None, *, captured: bool = False) -> _Work:
        by = record.requested_by
        return _Work(record.id, job, holder or holder_of(record), record.created_at, due_s(job), by, captured)

    def _line_up(self, works: Iterable[_Work]) -> None:
        """Put jobs where they wait for the rig, or compute; with the lock held."""
        for work in works:
            if work.job.uses_rig and not work.captured:
                self._waiting += (work,)
            else:
                self._computing.append(work)
                if self._owner.is_alive():
                    self._begin_computing(work)
        self._changed.notify_all()

    def _require_place(self, *, wait: bool) -> None:
        """Raise unless a job that needs the rig may wait in line; with the lock held."""
        self._require_serving()
        waiting = self._due()
        ahead = self._active or (waiting[0] if waiting else None)
        if ahead is not None and not wait:
            raise _busy(ahead)
        if ahead is not None:
            require_share("in the line for the rig", self.queue_length, [work.by for work in waiting])

    def _require_serving(self) -> None:
        call = self.rig.calls.stuck
        if call is not None:
            raise DeviceError(call.hangs())
        if self._ending:
            raise interruption_error()

    def _under_way(self) -> list[_Work]:
        """The jobs that have the rig or compute; with the lock held."""
        return [*([] if self._active is None else [self._active]), *self._computing]

    def _due(self) -> list[_Work]:
        """The jobs that wait for nothing but the rig, in their order."""
        now_s = time.monotonic()
        return [work for work in self._waiting if work.due_s <= now_s]

    def _until_due_s(self) -> float | None:
        """Seconds until the next job becomes due; None where none waits for its time."""
        now_s = time.monotonic()
        return min((work.due_s - now_s for work in self._waiting if work.due_s > now_s), default=None)

    def _wanted(self) -> bool:
        """Whether the service ends, or a job waits that may begin: in their order, while few enough compute."""
        full, waiting = len(self._computing) >= self.backlog_length, self._due()
        return self._ending or bool(waiting and not (full and waiting[0].job.computes))

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    # The rig's thread

    def _own_rig(self) -> None:
        """Body of the rig's thread. Nothing that a job or a driver raises ends it before the service ends."""
        error = self.rig.try_open()
        if isinstance(error, InvalidInputError):
            self._give_up(error)
        else:
            self._log_unopened(error)
        while True:
            try:
                work = self._next()
                if work is None:
                    break
                self._run(work)
            except BaseException:  # noqa: BLE001 - see above
                _log.exception("the end of work with the rig went wrong")
                # Not at once again, where that is what fails.
                time.sleep(_POLL_S)
        self.rig.darken()
        self.rig.release()

    def _next(self) -> _Work | None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted() or self._is_watched(), self._until_due_s())
                if self._ending:
                    return None
                if self._wanted():
                    self._active = self._due()[0]
                    self._waiting = tuple(each for each in self._waiting if each is not self._active)
                    return self._active
                watched = self._is_watched()
            if watched:
                self._show()

    def _is_watched(self) -> bool:
        return self.live.wanted or self._previews.wanted

    def _run(self, work: _Work) -> None:
        """Run the first part of a job, and pass it on or end it."""
        # An error that ends the thread is not a success.
        error: Exception | None = RuntimeError("the thread that owns the rig was ended")
        goes_on = False
        try:
            try:
                with structlog.contextvars.bound_contextvars(job=str(work.id)):
                    self._capture(work)
                error = None
            except BaseException as raised:  # noqa: BLE001 - the owner thread goes on after any failure of one job
                error = interruption_error() if self._ending else as_error(raised)
            finally:
                self.rig.darken()
            goes_on = error is None and self._frees_rig(work)
            if not goes_on:
                self._clear_up(work, error or work.error)
        finally:
            if not goes_on:
                # The rig is free before anyone can read that the work is over: a client may start its next one at once.
                with self._changed:
                    self._active = None
                    self._end(work, error)
                    self._changed.notify_all()
                self._settle(work)
        if not self._ending:
            self._log_unopened(self.rig.recover())

    def _capture(self, work: _Work) -> None:
        job, rig = work.job, self.rig
        if isinstance(work, _Loan):
            try:
                with driver_errors(rig.name):
                    work.result = work.use(rig, Listener(cancelled=work.stop.is_set))
            except Exception as error:
                rig.doubt(error)
                raise
            return
        self.settle()
        work.resumable = False
        work.since = self.store.advance(work.id, JobState.CAPTURING)
        self.data.stage(work.id)
        try:
            with driver_errors(rig.name):
                rig.find_lost()
                rig.open()
                # Before, the rig may not have been open, or may have had another calibration.
                self.require_space(job.check(rig))
                if job.feeds:
                    work.feed = self.worker.feed(job.region)
                made = job.capture(rig, self._run_of(work, self._progress(work, 0.0, job.capture_share)))
            if not isinstance(made, Outcome):
                work.recording = made
        except Exception as error:
            rig.doubt(error)
            raise
        if work.stop.is_set():
            message = "It was cancelled when all of its frames had come."
            raise ScanCancelledError(message)
        if isinstance(made, Outcome):
            work.outcome = self._kept(work, made)

    def _frees_rig(self, work: _Work) -> bool:
        """Free the rig of a job once its second part is begun. One that was given up while its driver hung is over,
        although the driver has returned.
        """
        with self._changed:
            if not work.job.computes or work.ended:
                return False
            self._active = None
            self._computing.append(work)
            self._changed.notify_all()
        self._begin_computing(work)
        return True

    def _show(self) -> None:
        """Play live depth, or else take previews, until a job needs the rig."""
        try:
            rig = self.rig.open()
            with driver_errors(self.rig.name):
                self.live.run(rig, self.rig.calibration, stop=self._wanted)
                self._previews.run(rig, stop=lambda: self._wanted() or self.live.wanted)
        except BaseException as raised:  # noqa: BLE001 - the owner thread goes on after any failure of a preview
            error = as_error(raised)
            self.rig.release(error)
            self._log_unopened(error)
            fault = job_failure(error)
            self._send_away(error if isinstance(error, SlrigError) else DeviceError(fault.message))
            self._log_unopened(self.rig.recover())

    def _send_away(self, error: SlrigError) -> None:
        self.live.fail(error)
        self._previews.fail(error)

    def _log_unopened(self, error: Exception | None) -> None:
        if isinstance(error, SlrigError):
            _log.warning("the rig cannot be opened; the next scan tries again", rig=self.rig.name, cause=str(error))
        elif error is not None:
            _log.error("the rig's driver failed with an error of its own", rig=self.rig.name, exc_info=error)

    # Computing

    def _begin_computing(self, work: _Work) -> None:
        # A daemon, so that it never holds up the end of the service.
        threading.Thread(target=self._compute, args=(work,), name="slrig-compute", daemon=True).start()

    def _compute(self, work: _Work) -> None:
        """The second part of a job, on a thread of its own."""
        error: Exception | None = RuntimeError("the thread that computes was ended")
        try:
            try:
                with structlog.contextvars.bound_contextvars(job=str(work.id)):
                    work.outcome = self._computed(work)
                error = None
            except BaseException as raised:  # noqa: BLE001 - it is the end of the job
                error = interruption_error() if self._ending else as_error(raised)
            self._clear_up(work, error)
        except Exception:  # noqa: BLE001 - as on the owner thread
            _log.exception("the end of work that computes went wrong", work=work.holder.label)
        finally:
            with self._changed:
                self._computing.remove(work)
                self._end(work, error)
                self._changed.notify_all()
            self._settle(work)

    def _computed(self, work: _Work) -> Outcome:
        job, data = work.job, self.data
        progress = self._progress(work, job.capture_share, 1.0)
        recording, work.recording = work.recording, None
        if not job.uses_rig:
            data.discard(work.id)
            data.stage(work.id)
        elif not work.captured:
            progress.captured()
            self._follow(work)
        if recording is not None:
            recording.finish()
        if data.recording(work.id).is_dir():
            data.keep_recording(work.id)
        work.resumable = self._on_record_as_computing(work)
        with self._turns[job.parent] if job.one_at_a_time else nullcontext():
            return self._computed_in_turn(work)

    def _computed_in_turn(self, work: _Work) -> Outcome:
        tries = 1
        while True:
            try:
                return self._computed_once(work)
            except WorkerLostError as error:
                # What ends the worker may be the job itself: it goes behind the others, and not for ever.
                if self._ending or not work.resumable or tries == MAX_ATTEMPTS:
                    raise
                tries += 1
                _log.warning("the worker was lost, and the job is computed once more", cause=str(error))

    def _computed_once(self, work: _Work) -> Outcome:
        job, data = work.job, self.data
        data.clear_results(work.id)
        run = self._run_of(work, self._progress(work, job.capture_share, 1.0, attempt=True))
        run.check()
        outcome: Outcome = self.worker.run(job_task(job, run), run, feed=work.feed)
        made = run.result if run.result.is_dir() else run.folder
        if outcome.fault is None:
            require_files(made, job.promises, job.noun)
        return self._kept(work, outcome)

    def _kept(self, work: _Work, outcome: Outcome) -> Outcome:
        """Bring a job's files to their place, and have its group know."""
        place = work.job.place(self.data, work.id)
        if place is not None:
            record = self.store.get(work.id)
            state = JobState.SUCCEEDED if outcome.fault is None else JobState.FAILED
            record = replace(record, state=state, summary=outcome.summary, fault=outcome.fault)
            write_record(self.data.staging(work.id), replace(record, has_files_json=True))
            self.data.put(work.id, place)
        group = self.groups.get(work.job.kind)
        if group is None:
            return outcome
        with acting_as(work.by):
            return group.ended(work.job, work.id, outcome)

    def _run_of(self, work: _Work, progress: ProgressRecorder) -> JobRun:
        feed = work.feed

        def found(summary: Mapping[str, Any]) -> None:
            work.outcome = Outcome(summary)

        return JobRun(
            work.id,
            self.data.staging(work.id),
            work.job.place(self.data, work.id),
            report=progress,
            cancelled=work.stop.is_set,
            file_ready=progress.file_made,
            frames=feed,
            evidence=None if feed is None else feed.evidence,
            found=found,
        )

    def _progress(self, work: _Work, begin: float, end: float, *, attempt: bool = False) -> ProgressRecorder:
        hidden = self.data.hidden(work.id)
        return ProgressRecorder(self.store, work.id, hidden=hidden, span=(begin, end), attempt=attempt)

    def _follow(self, work: _Work) -> None:
        """Line up the jobs that follow one with all frames taken."""
        group = self.groups.get(work.job.kind)
        if group is not None:
            with _unharmed(work), acting_as(work.by):
                group.captured(work.job, work.id)

    def _on_record_as_computing(self, work: _Work) -> bool:
        """Record that all frames are there, so that a restart computes with them; return whether that worked."""
        try:
            self.store.advance(work.id, JobState.COMPUTING)
        except StorageError as error:
            _log.warning("that a job computes could not be recorded", job=str(work.id), cause=str(error))
            return False
        return True

    # Ends

    def _clear_up(self, work: _Work, error: Exception | None) -> None:
        """Do what remains when nothing of a job is under way any more."""
        work.worked = True
        if isinstance(work, _Loan) or (error is not None and _goes_on(work, error)):
            return
        if error is not None:
            self._dismiss(work)
            with _unharmed(work):
                if work.recording is not None:
                    work.recording.discard()
                elif work.job.keeps_bundle and not isinstance(error, ScanCancelledError):
                    # So that the cause can be found.
                    self.keep_bundle(work.job, work.id)
        self.data.discard(work.id)

    def keep_bundle(self, job: Job, job_id: UUID) -> None:
        """Keep the frames of a job that came to nothing, and no other file of it."""
        place = job.place(self.data, job_id)
        if place is not None:
            self.data.keep_bundle(job_id, place)

    def _dismiss(self, work: _Work) -> None:
        """Inform the group of a job, once, that it came to nothing, and get the worker ready for the next."""
        if work.dismissed:
            return
        work.dismissed = True
        with _unharmed(work):
            if work.feed is not None:
                work.feed.abandon()
                self.worker.start()
            group = self.groups.get(work.job.kind)
            if group is not None:
                group.ended(work.job, work.id, None)

    def _end(self, work: _Work, error: Exception | None) -> None:
        """Take note how a job ended, with the lock held under which the rig is given and taken."""
        if work.ended:
            return
        work.error, work.ended = error, True
        if isinstance(work, _Loan):
            return
        if error is None:
            fault = work.outcome.fault
            state = JobState.SUCCEEDED if fault is None else JobState.FAILED
            self._ends.append(_End(work.id, state, work.outcome))
        elif isinstance(error, ScanCancelledError) and (kept := self._committed(work)) is not None:
            # It was computed once more, and its files are as before.
            self._ends.append(_End(work.id, kept.state, Outcome(kept.summary, kept.fault)))
        elif _goes_on(work, error):
            _log.info("a job is left to the next start of the service", job=str(work.id))
        else:
            end = _end_by(error, work.id, hidden=self.data.hidden(work.id))
            if end.state is JobState.FAILED and not work.worked and work.stop.is_set():
                # It was to end, and its driver hangs.
                end = replace(end, state=JobState.CANCELLED)
            end = replace(end, outcome=replace(end.outcome, summary=work.outcome.summary))
            self._ends.append(end)

    def _committed(self, work: _Work) -> JobRecord | None:
        """The record that lies with the files of a job that was over before; None where there is none."""
        place = work.job.place(self.data, work.id)
        kept = None if place is None else read_record(place)
        return kept if kept is not None and kept.id == work.id else None

    def _settle(self, work: _Work) -> None:
        """Record how a job ended, if that is known. The rig is free; on any thread."""
        with work.settling:
            if not work.ended or work.settled:
                return
            work.settled = True
        if isinstance(work, _Loan):
            work.over.set()
            return
        if work.error is not None and not _goes_on(work, work.error):
            self._dismiss(work)
        self.settle()

    def settle(self) -> None:
        """Record the ends that are not on record yet. Ends that the disk refuses are tried again later."""
        with self._changed:
            ends = list(self._ends)
        for end in ends:
            try:
                made = self.store.finish(end.id, end.state, fault=end.outcome.fault, summary=end.outcome.summary)
            except JobNotFoundError:
                made = False
            except StorageError as error:
                _log.error("the end of a job could not be recorded", job=str(end.id), cause=str(error))
                self._try_again()
                continue
            except Exception:  # noqa: BLE001 - the end is not lost, whichever error refuses it
                _log.exception("the end of a job could not be recorded as it is", job=str(end.id), state=str(end.state))
                plainly = self._ended_plainly(end)
                if plainly is None:
                    continue
                made = plainly
            with self._changed:
                self._ends = [each for each in self._ends if each is not end]
            if made:
                _log.info("job finished", job=str(end.id), state=str(end.state))

    def _ended_plainly(self, end: _End) -> bool | None:
        """Record an end without its findings and cause, which cannot be recorded; None where that is refused, too."""
        state = JobState.FAILED if end.state is JobState.SUCCEEDED else end.state
        message = "What this job found cannot be put on record; the service's log has the details. Start it again."
        try:
            return self.store.finish(end.id, state, fault=JobFailure(UNEXPECTED, message))
        except JobNotFoundError:
            return False
        except Exception:  # noqa: BLE001 - it is tried again
            self._try_again()
            return None

    def _try_again(self) -> None:
        def retry() -> None:
            with self._changed:
                self._again = None
                closed = self._closed
            if not closed:
                self.settle()

        with self._changed:
            if self._again is None and not self._closed:
                self._again = threading.Timer(RETRY_S, retry)
                self._again.daemon = True
                self._again.start()

    def _give_up_on(self, call: Call) -> None:
        """End, on the watchdog's thread, what waits for a call that hangs."""
        _log.error("a driver hangs", rig=self.rig.name, device=call.device, step=call.step)
        error = DeviceError(self.rig.give_up(call).message)
        self.rig.darken_from_outside()
        self._cut_off(error, lambda: [work for work in (self._active,) if work is not None])
        self._send_away(error)

    def _cut_off(self, error: SlrigError, works: Callable[[], list[_Work]]) -> None:
        with self._changed:
            cut_off = works()
            for work in cut_off:
                self._end(work, error)
        for work in cut_off:
            self._settle(work)

    def _stop(self) -> None:
        """Take nothing in any more, and have what is under way end early."""
        with self._changed:
            self._ending = True
            cut_off, self._waiting = self._waiting, ()
            for work in self._under_way():
                work.stop.set()
            for work in cut_off:
                self._end(work, interruption_error())
            self._changed.notify_all()
        self._watchdog.stop()
        self._send_away(interruption_error())
        for work in cut_off:
            self._settle(work)

    def _join(self, timeout_s: float) -> None:
        """Wait for the owner thread, which darkens and closes the rig, and for what computes; an owner that hangs is
        left behind, and the projector darkened from here, as far as its driver allows.
        """
        give_up = time.monotonic() + timeout_s
        if self._owner.is_alive():
            self._owner.join(timeout_s)
        if self._owner.is_alive():
            _log.error("the rig's driver does not return; the service ends without it", rig=self.rig.name)
            self.rig.darken_from_outside()
        with self._changed:
            self._changed.wait_for(lambda: not self._computing, max(give_up - time.monotonic(), 0.0))
        self._cut_off(interruption_error(), self._under_way)


def _goes_on(work: _Work, error: Exception) -> bool:
    """Whether the next start of the service goes on with a job that has ended so."""
    return work.resumable and isinstance(error, ScanInterruptedError)


def _end_by(error: Exception, job_id: UUID, *, hidden: str) -> _End:
    """The end of a job by an error, which is logged unless a person caused it.

    hidden : left out of its message. The staging folder is gone when that is read.
    """
    fault = job_failure(error)
    fault = replace(fault, message=fault.message.replace(hidden, ""))
    state = JobState.FAILED
    if isinstance(error, ScanCancelledError):
        state = JobState.CANCELLED
    elif isinstance(error, ScanInterruptedError):
        state = JobState.INTERRUPTED
    elif fault.code == UNEXPECTED:
        _log.error("a job failed", job=str(job_id), exc_info=error)
    else:
        _log.warning("a job failed", job=str(job_id), code=fault.code, cause=fault.message)
    return _End(job_id, state, Outcome(fault=fault))


@contextmanager
def _unharmed(work: _Work) -> Iterator[None]:
    """Log an error of the block: it does not change how the job ends."""
    try:
        yield
    except Exception:  # noqa: BLE001 - see above
        _log.exception("what goes with a job went wrong", job=str(work.id))


def _busy(work: _Work) -> RigBusyError:
    """The error that names who holds the rig."""
    since, holder = work.since.isoformat(timespec="seconds"), work.holder
    cancel = "" if holder.path is None else f"cancel it with POST {holder.path}/cancel, "
    message = (
        f'The rig is held by {holder.label} since {since}. Wait for it, {cancel}or send "if_busy": "queue" to wait '
        "in line."
    )
    return RigBusyError(message, holder=holder.name, since=since)

"""The parts of one running service, which routers use; idempotent requests; and how long requests take."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, TypeVar
from urllib.parse import urlencode
from uuid import UUID

import structlog
from fastapi import Depends, Header, Query, Request, Response
from prometheus_client import CollectorRegistry, Histogram
from pydantic import BaseModel
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig.accept.job import AcceptanceTests
from slrig.api.schemas import ScanRequest, scan_plan
from slrig.api.shares import Makings, Shares
from slrig.calibrate.job import CalibrationArchive, Calibrations
from slrig.calibrate.verification import RigHealth, require_healthy
from slrig.catalogue.store import Copier, catalogue_of, rig_row
from slrig.config import RigConfig, ServiceSettings
from slrig.discovery import DeviceSearch
from slrig.doctor import EXAMINATIONS, Examinations
from slrig.failure import LastingThread
from slrig.jobs.manager import JobManager
from slrig.jobs.records import (
    RIG_JOBS,
    JobEvent,
    JobKind,
    JobProgress,
    JobRecord,
    JobState,
    actor_key,
    stages_of,
    utc_now,
)
from slrig.jobs.resume import resume
from slrig.jobs.retention import CLOCK, JobArchive, Limits, Retention, SteadyClock
from slrig.jobs.store import Audit, AuditEntry, JobStore, RequestKeys
from slrig.model_jobs.job import MODELS, TURNTABLE, Models, ViewShooting
from slrig.model_jobs.turntable import TurntableStore
from slrig.plugins import OBSERVERS, load, plugin_errors
from slrig.scan.job import ScanJob
from slrig.scan.plan import Presets
from slrig.schedule.notices import NoticedHealth, Receivers, notice_run
from slrig.schedule.scheduler import ScanTask, Scheduler, Tasks
from slrig.schedule.store import ScheduledRun, ScheduleStore

_ANSWER_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
"""From a kept-alive request on loopback, a millisecond, to the time at which the records give up on a locked file."""

_JOB_S = (1.0, 2.5, 5.0, 10.0, 20.0, 40.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
"""From a verification of a few frames to a bracketed scan of large cameras that waits in line behind others."""

_STAGE_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
"""From writing a small picture to the optimisation of a large mesh, or a wait in line."""

_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE"})
_OTHER = "other"


class Durations:
    """Measurements of this process since its start. Any thread may call."""

    def __init__(self) -> None:
        # Of its own: several services in one process, as in tests, do not meet in it.
        self.registry = CollectorRegistry()
        self._answers = Histogram(
            "slrig_http_response_start_seconds",
            "From a request to the head of its answer, by method, path as documented, and class of status. `other`: no "
            "documented method or path, or refused before the path was checked.",
            ("method", "path", "status"), buckets=_ANSWER_S, registry=self.registry,
        )  # fmt: skip
        self._jobs = Histogram(
            "slrig_job_duration_seconds",
            "From the request of a job to its end, by kind and final state.",
            ("kind", "state"), buckets=_JOB_S, registry=self.registry,
        )  # fmt: skip
        self._stages = Histogram(
            "slrig_job_stage_duration_seconds",
            "What each stage of a job took: its states, and the stages of its computation.",
            ("kind", "stage"), buckets=_STAGE_S, registry=self.registry,
        )  # fmt: skip

    def answered(self, method: str, path: str | None, status: int, seconds: float) -> None:
        """Take note of an answer. path : of the route, None where there is none."""
        labels = (method if method in _METHODS else _OTHER, path or _OTHER, f"{status // 100}xx")
        self._answers.labels(*labels).observe(seconds)

    def ended(self, record: JobRecord, events: Sequence[JobEvent]) -> None:
        """Take note of a job's end."""
        if record.finished_at is not None:
            seconds = (record.finished_at - record.created_at).total_seconds()
            self._jobs.labels(record.kind, record.state).observe(seconds)
        for stage in stages_of(record, events):
            self._stages.labels(record.kind, stage.name).observe(stage.seconds)


class Latency:
    """Middleware that measures until the answer begins: a stream does not count as an hour of waiting."""

    def __init__(self, app: ASGIApp, *, durations: Durations) -> None:
        self._app = app
        self._durations = durations

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun_s = time.perf_counter()
        started = False

        def note(status: int) -> None:
            path = getattr(scope.get("route"), "path_format", None)
            self._durations.answered(scope["method"], path, status, time.perf_counter() - begun_s)

        async def measured(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                note(message["status"])
            await send(message)

        try:
            await self._app(scope, receive, measured)
        except Exception:
            # Outer middleware makes a 500 of it.
            if not started:
                note(500)
            raise


_log = structlog.get_logger(__name__)

_MOST_ON_RECORD = 1000
"""Verifications, and examinations of each kind, that stay on record. What verifications found is kept longer."""

MOST_REQUESTS = 256
"""That wait for their answers, of everybody together. Of one key eight are answered at once: more of them would keep
the interpreter from the others' for longer, and end no sooner.
"""

MOST_MAKINGS = 8
"""Files that are made on request, or wait for that; of one key one after the other. Each takes a second, and some
hundred megabytes.
"""

_SCHEDULE_END_S = 1.0
"""Time for a scheduled run to end by itself before the runner ends it."""


class Service:
    """One service: its settings, its jobs and their groups, and the schedule.

    Until `start` nothing works. followed : see `slrig.api.events.event_stream`. rig : its rig file.

    Raises
    ------
    StorageError
        The disk refused. What was given is still the caller's to close.
    ConfigError
        A plug-in cannot be loaded, or what it needs is not installed. Or a receiver of notices
        cannot be opened: see `Receivers`. Or the catalogue has no address, or no login.
    ExtraMissingError
        The catalogue's driver is not installed.
    """

    def __init__(self, settings: ServiceSettings, rig: RigConfig, manager: JobManager) -> None:
        self.settings = settings
        self.manager = manager
        self.store, self.folder, self.worker = manager.store, manager.data, manager.worker
        self.hurry = threading.Event()
        self.devices = DeviceSearch()
        close = "Close one, or request single answers instead, as GET /scan/ID."
        self.streams = Shares("streams of events, pictures and bundles", settings.max_event_streams, close)
        self.followed: dict[UUID, Any] = {}
        self.requests = Shares(
            "places for requests", MOST_REQUESTS, "Wait for answers before you request more.", retry_s=1, at_once=8
        )
        again, makings = "Try again.", "places for what is made on request"
        self.makings = Makings(Shares(makings, MOST_MAKINGS, again, status=503))
        self.clouds = Makings(Shares(f"{makings} by the worker", MOST_MAKINGS, again, status=503))
        # There are three, each made once for all: none is refused.
        self.probes = Makings(Shares("probes", 6, again, status=503, at_once=3))
        self._lasting: frozenset[str] = frozenset()
        database, outbox = self.store.database, self.store.outbox
        self.receivers = Receivers(settings, outbox, self.folder.root)
        newest = self.store.page(JobKind.SCAN, before=None, limit=1)
        clock = SteadyClock(self.folder.root / CLOCK, first=newest[0].created_at if newest else None)
        outbox.clock = clock.now
        self.keys = RequestKeys(database, clock=clock.now, life_s=settings.idempotency_keep_s)
        self.keys.release_all()
        self.audit = Audit(database)
        self.calibrations = Calibrations(manager)
        self.health = RigHealth(manager.rig, NoticedHealth(database, outbox), self.folder)
        manager.groups.update(dict.fromkeys((JobKind.SCAN, JobKind.VERIFICATION), self.health))
        manager.groups.update(dict.fromkeys(EXAMINATIONS, Examinations(self.folder.root)))
        self.acceptance = AcceptanceTests(manager)
        self.use(rig)
        self.turntable = TurntableStore(self.folder.root / TURNTABLE)
        spare_bytes = settings.min_free_bytes
        manager.groups[JobKind.AXIS] = self.turntable
        self.models = Models(manager, turntable=self.turntable, spare_bytes=spare_bytes)
        self.shooting = ViewShooting(self.models, manager)
        self.durations = Durations()
        self.observers: list[Any] = []
        for name, observe in load(OBSERVERS).items():
            with plugin_errors(OBSERVERS, name):
                self.observers.append(observe())
        self.observers = [each for each in self.observers if each is not None]
        self.calibrations.settle()
        self.acceptance.settle()
        resume(manager)
        self.shooting.take_up()
        self.store.after_end = self._ended
        self.copier = self._copier()
        self._senders = (self.receivers, *(() if self.copier is None else (self.copier,)))
        self.retention = Retention(
            self.folder.root,
            [
                (
                    JobArchive(manager, JobKind.SCAN, self.folder.scans, self.models.unused),
                    Limits(settings.keep_scans, settings.keep_scans_days, settings.keep_scans_bytes),
                ),
                (JobArchive(manager, JobKind.MODEL, self.folder.root / MODELS), Limits(settings.keep_models)),
                (
                    CalibrationArchive(
                        self.calibrations,
                        self.folder.scans,
                        named=lambda: {test.calibration for test in self.acceptance.latest()},
                    ),
                    Limits(settings.keep_calibrations),
                ),
            ],
            self.audit,
            clock,
        )
        self.schedules = ScheduleStore(database, notice=partial(notice_run, outbox))
        scans = ScanTask(manager, self._usual_scan, self._require_healthy)
        self.tasks = Tasks(
            manager, self.calibrations, self.acceptance, scans, tidy=partial(self.retention.check, "calibration")
        )
        # The folder's lock keeps every other process out.
        self.scheduler = Scheduler(self.schedules, self.tasks, alone=True)

    def use(self, rig: RigConfig) -> None:
        """Use a rig file for work begun from now on: usual options of scans, presets, tolerance."""
        self.rig = rig
        self.scan_defaults, self.refuse_when_stale = rig.scan, rig.refuse_when_stale
        self.presets = Presets(self.folder.root / "presets", rig.presets)
        self.calibrations.tolerance_mm = self.acceptance.tolerance_mm = rig.tolerance_mm

    def delete_scan(self, scan_id: UUID) -> None:
        """Remove a finished scan: its record, its events, its files. Raises JobNotFoundError; ScanStateError: it is not
        finished, or something that is under way uses it.
        """
        self.store.get(scan_id, JobKind.SCAN)
        self.manager.delete(scan_id, self.models.unused(scan_id))

    def rename(self, job_id: UUID, kind: JobKind, label: str | None) -> JobRecord:
        """Give a job another label, on record and next to its files. Raises JobNotFoundError, StorageError."""
        place = self.manager.kinds[kind].place_of(self.store.get(job_id, kind), self.folder)
        keep = partial(self.folder.relabel, job_id, place, label)
        with self.folder.naming:
            return self.store.rename(job_id, kind, label=label, keep=keep)

    def _usual_scan(self, preset: str | None) -> ScanJob:
        found = None if preset is None else self.presets.get(preset)
        return ScanJob(scan_plan(ScanRequest(preset=preset), self.scan_defaults, found))

    def _require_healthy(self) -> None:
        require_healthy(self.health.health()[0], refuse_when_stale=self.refuse_when_stale)

    def _copier(self) -> Copier | None:
        """The copier to the catalogue, if the settings name one. Raises ConfigError, ExtraMissingError."""
        catalogue, copies = catalogue_of(self.settings), self.store.outbox.copies
        if catalogue is None or copies is None:
            return None
        rig = partial(rig_row, self.manager, self.health, data=self.folder.root.resolve(), started_at=utc_now())
        return Copier(catalogue, copies, rig)

    def _ended(self, record: JobRecord) -> None:
        """Measure a job that is over, make room, and go on with the model that a scan is a view of."""
        if record.kind is JobKind.SCAN:
            self.shooting.view_ended(record)
        self.retention.check(record.kind)
        try:
            if record.kind is JobKind.VERIFICATION or record.kind in RIG_JOBS:
                self.store.prune(record.kind, _MOST_ON_RECORD)
            events = self.store.events(record.id, after=0)
            self.durations.ended(record, events)
        except Exception:  # noqa: BLE001 - the job is over, and on record, also without its figures
            _log.exception("how long a job took could not be noted", job=str(record.id))
            return
        for observer in self.observers:
            with _logged(observer):
                observer.ended(record, events)

    def start(self) -> None:
        """Open the rig, run schedules, send what waits, and remove what is old."""
        for sender in self._senders:
            sender.start()
        self.manager.start()
        self.scheduler.start()
        self.retention.start()
        self._lasting = _lasting_threads()

    def ended_threads(self) -> list[str]:
        """Names of threads that have ended, and should last as long as the service."""
        running = _lasting_threads()
        # One of a webhook that was set meanwhile is new.
        self._lasting |= running
        return [] if self.manager.ending else sorted(self._lasting - running)

    def drain(self) -> None:
        """Begin nothing new, and wait for the end of the job with the rig, as long as the settings allow, or until
        `hurry`.
        """
        self.manager.drain(self.settings.drain_s, self.hurry)

    def end_work(self) -> None:
        """Stop scanning and calibrating, and record what was cut off. Idempotent."""
        self.retention.close()
        self.scheduler.stop()
        self.tasks.end()
        self.scheduler.close(timeout_s=min(_SCHEDULE_END_S, self.settings.shutdown_s))
        self.manager.close(timeout_s=self.settings.shutdown_s)
        # A run that held a deaf driver has its answer now.
        self.scheduler.close(timeout_s=_SCHEDULE_END_S)
        self.store.end()

    def close(self) -> None:
        """Stop scanning, then release records and data folder. Idempotent."""
        self.end_work()
        for sender in self._senders:
            sender.close()
        for observer in self.observers:
            with _logged(observer):
                observer.close()
        self.store.database.close()
        self.folder.release()


@contextmanager
def _logged(observer: object) -> Iterator[None]:
    """Log every error of an observer within the block: it is foreign code, and only observes."""
    try:
        yield
    except BaseException:  # noqa: BLE001 - see above
        _log.exception("an observer failed", observer=type(observer).__name__)


def _lasting_threads() -> frozenset[str]:
    """Names of the threads of this process that last as long as a service, as far as they live."""
    return frozenset(each.name for each in threading.enumerate() if isinstance(each, LastingThread))


async def _of_request(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


async def turn(request: Request) -> AsyncIterator[None]:
    """Make a request wait for its turn among those of its key, except one that needs no key or cancels work."""
    if request.state.caller is None or request.url.path.endswith("/cancel"):
        yield
        return
    async with request.app.state.service.requests.turn():
        yield


def _whole(service: Annotated[Service, Depends(_of_request)]) -> Service:
    service.folder.require_present()
    return service


Serving = Annotated[Service, Depends(_whole)]
"""A handler's parameter: the service that it serves. Without its data folder it serves nothing: 503."""

Probed = Annotated[Service, Depends(_of_request)]
"""The service even without its data folder, for routes that report that."""

Cursor = Annotated[int | None, Query(ge=1, le=2**53, description="`next` of the page before")]
PageLength = Annotated[int, Query(ge=1, le=200)]
Shown = TypeVar("Shown", JobRecord, ScheduledRun, AuditEntry)


def paged(
    found: Callable[[int], Sequence[Shown]],
    limit: int,
    path: str,
    service: Service,
    response: Response,
    query: Mapping[str, Any] | None = None,
) -> tuple[Sequence[Shown], str | None]:
    """The records of a page, and the path of the page after it, which the header `Link` names, too.

    found : gives so many records, from new to old. limit : the most that is requested; the settings may allow less.
    query : other parameters of the request, which the next page keeps.
    """
    limit = min(limit, service.settings.page_limit)
    records = found(limit + 1)
    if len(records) <= limit:
        return records, None
    following = (
        f"{path}?{urlencode({'cursor': records[limit - 1].number, 'limit': limit, **(query or {})}, doseq=True)}"
    )
    response.headers["Link"] = f'<{following}>; rel="next"'
    return records[:limit], following


IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        description="makes a repeat of this request return what the first one made instead of making another; kept "
        "for a day, or as long as the service's settings say",
    ),
]


def once(
    keys: RequestKeys,
    key: str | None,
    path: str,
    request: BaseModel,
    start: Callable[[str | None], UUID],
) -> UUID:
    """The id of the result of a request, or of an earlier one with this key.

    path : where the request was sent; the same key may be sent elsewhere. start : makes it, and ties it to the key that
    it is given; what it raises leaves the key free.

    Raises
    ------
    IdempotencyError
        The key was sent with another request, or its first request is still being answered.
    """
    if key is None:
        return start(None)
    mine = own_key(key, path)
    earlier = keys.reserve(mine, fingerprint(request))
    if earlier is not None:
        return earlier
    try:
        return start(mine)
    finally:
        # Does nothing when the key has what it made; a refused request may be tried again with the same key.
        keys.release(mine)


def started_once(
    keys: RequestKeys,
    store: JobStore,
    key: str | None,
    path: str,
    request: BaseModel,
    start: Callable[[str | None], UUID],
) -> JobRecord:
    """The job that a request makes, or made before with this key, as it was when it was made. See `once`."""
    return replace(
        store.get(once(keys, key, path, request, start)),
        state=JobState.QUEUED,
        started_at=None,
        finished_at=None,
        progress=JobProgress("waiting", 0.0, ""),
        fault=None,
        summary=None,
    )


def own_key(key: str, path: str) -> str:
    """An idempotency key as it is on record: that of the requests to one path with one API key."""
    return " ".join(filter(None, (actor_key()[:16], path, key)))


def fingerprint(request: BaseModel) -> str:
    """Distinguishes two requests with one idempotency key: equal for equal requests, in any notation."""
    return hashlib.sha256(request.model_dump_json().encode()).hexdigest()

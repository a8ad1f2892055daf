"""What the routers work with: the parts of one running service."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, TypeVar
from uuid import UUID

import structlog
from fastapi import Depends, Query, Request, Response

from slrig.accept.job import AcceptanceTests
from slrig.api.latency import Durations
from slrig.bundle import Preset, ScanDefaults
from slrig.calibrate.calibrating import Calibrations
from slrig.calibrate.retention import Retention
from slrig.calibrate.verification import RigHealth
from slrig.catalogue.copying import Copier
from slrig.catalogue.standing import standing
from slrig.catalogue.store import catalogue_of
from slrig.combine.job import TURNTABLE, Models
from slrig.combine.shooting import ViewShooting
from slrig.combine.turntable import TurntableStore
from slrig.config import ServiceSettings
from slrig.jobs.audit import Audit, AuditEntry
from slrig.jobs.examinations import EXAMINATIONS, Examinations
from slrig.jobs.keys import RequestKeys
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobKind, JobRecord, utc_now
from slrig.jobs.resume import resume
from slrig.plugins import OBSERVERS, load
from slrig.scan.presets import Presets
from slrig.scan.retention import ScanLimits, ScanRetention
from slrig.schedule.notices import NoticedHealth, tell_run
from slrig.schedule.receivers import senders_of
from slrig.schedule.records import ScheduledRun
from slrig.schedule.scheduler import Scheduler
from slrig.schedule.store import ScheduleStore
from slrig.schedule.tasks import Tasks

_log = structlog.get_logger(__name__)

_MOST_ON_RECORD = 1000
"""Verifications, and examinations of each kind, that stay on record. What verifications found is kept longer."""

_SCHEDULE_END_S = 1.0
"""How long a scheduled run may take to end by itself before the runner ends it."""


class Service:
    """One service: its settings, its jobs, what these belong to, and the schedule.

    Until `start` nothing works. refuse_when_stale : whether the rig file has scans refused then. tolerance_mm :
    what it wants of a point's error. presets : the rig file's.

    Raises
    ------
    StorageError
        The disk refused. What was given is still the caller's to close.
    ConfigError
        A plug-in cannot be loaded, or what it needs is not installed. Or a receiver of notices
        cannot be told: see `senders_of`. Or the catalogue has no address, or no login.
    ExtraMissingError
        The catalogue's driver is not installed.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        scan_defaults: ScanDefaults,
        manager: JobManager,
        *,
        refuse_when_stale: bool = False,
        tolerance_mm: float | None = None,
        presets: Mapping[str, Preset] | None = None,
    ) -> None:
        self.settings = settings
        self.scan_defaults = scan_defaults
        self.manager = manager
        self.store, self.folder, self.worker = manager.store, manager.data, manager.worker
        self.presets = Presets(self.folder.root / "presets", presets or {})
        self.refuse_when_stale = refuse_when_stale
        self.hurry = threading.Event()
        database, outbox = self.store.database, self.store.outbox
        self.senders = senders_of(settings, outbox)
        self.keys = RequestKeys(database, life_s=settings.idempotency_keep_s)
        self.keys.release_all()
        self.audit = Audit(database)
        self.calibrations = Calibrations(manager, tolerance_mm=tolerance_mm)
        self.health = RigHealth(manager.rig, NoticedHealth(database, outbox), self.folder)
        manager.groups.update(dict.fromkeys((JobKind.SCAN, JobKind.VERIFICATION), self.health))
        manager.groups.update(dict.fromkeys(EXAMINATIONS, Examinations(self.folder.root)))
        self.acceptance = AcceptanceTests(manager, tolerance_mm=tolerance_mm)
        self.turntable = TurntableStore(self.folder.root / TURNTABLE)
        spare_bytes = settings.min_free_bytes
        self.models = Models(manager, turntable=self.turntable, keep=settings.keep_models, spare_bytes=spare_bytes)
        self.shooting = ViewShooting(self.models, manager)
        self.durations = Durations()
        self.observers = [each for observe in load(OBSERVERS).values() if (each := observe()) is not None]
        self.calibrations.settle()
        self.acceptance.settle()
        resume(manager)
        self.shooting.take_up()
        self.models.remove_old()
        self.store.after_end = self._ended
        self.retention = Retention(
            self.calibrations,
            self.folder,
            keep=settings.keep_calibrations,
            named=lambda: {test.calibration for test in self.acceptance.latest()},
        )
        self.copier = self._copier()
        self._tellers = (*self.senders, *(() if self.copier is None else (self.copier,)))
        limits = ScanLimits(settings.keep_scans, settings.keep_scans_days, settings.keep_scans_bytes)
        self.scan_retention = ScanRetention(self.store, self.folder, limits, self.delete_scan)
        self.schedules = ScheduleStore(database, notice=partial(tell_run, outbox))
        self.tasks = Tasks(manager, self.calibrations, self.acceptance, tidy=self.retention)
        # The folder's lock keeps every other process out.
        self.scheduler = Scheduler(self.schedules, self.tasks, alone=True)

    def delete_scan(self, scan_id: UUID) -> None:
        """Remove a finished scan: its record, its events, its files. Raises JobNotFoundError; ScanStateError: it is not
        finished, or something that is under way uses it.
        """
        self.store.get(scan_id, JobKind.SCAN)
        self.manager.delete(scan_id, self.models.unused(scan_id))

    def _copier(self) -> Copier | None:
        """What tells the catalogue of this rig, if the settings name one. Raises ConfigError, ExtraMissingError."""
        catalogue, copies = catalogue_of(self.settings), self.store.outbox.copies
        if catalogue is None or copies is None:
            return None
        told = partial(standing, self.manager, self.health, data=self.folder.root.resolve(), started_at=utc_now())
        return Copier(catalogue, copies, told)

    def _ended(self, record: JobRecord) -> None:
        """Measure a job that is over, make room, and go on with the model that a scan is a view of."""
        if record.kind is JobKind.SCAN:
            self.shooting.view_ended(record)
            self.scan_retention.look()
        try:
            if record.kind is JobKind.VERIFICATION or record.kind in EXAMINATIONS:
                self.store.prune(record.kind, _MOST_ON_RECORD)
            events = self.store.events(record.id, after=0)
            self.durations.ended(record, events)
            for observer in self.observers:
                observer.ended(record, events)
        except Exception:  # noqa: BLE001 - the job is over, and on record, whatever becomes of its figures
            _log.exception("how long a job took could not be noted", job=str(record.id))

    def start(self) -> None:
        """Open the rig, look at the clock, send what waits, and remove what is old."""
        for sender in self._tellers:
            sender.start()
        self.manager.start()
        self.scheduler.start()
        # It reads the report of every scan, and nobody waits for it.
        self.scan_retention.start()
        threading.Thread(target=self.retention, name="slrig-retention", daemon=True).start()

    def drain(self) -> None:
        """Begin nothing new, and let what has the rig come to its end, as long as the settings allow, or until
        `hurry`.
        """
        self.manager.drain(self.settings.drain_s, self.hurry)

    def end_work(self) -> None:
        """Stop scanning and calibrating, and record what was cut off. Idempotent."""
        self.scan_retention.close()
        self.scheduler.stop()
        self.tasks.end()
        self.scheduler.close(timeout_s=min(_SCHEDULE_END_S, self.settings.shutdown_s))
        self.manager.close(timeout_s=self.settings.shutdown_s)
        # A run that held a deaf driver has its answer now.
        self.scheduler.close(timeout_s=_SCHEDULE_END_S)
        self.store.end()

    def close(self) -> None:
        """Stop scanning, then let records and data folder go. Idempotent."""
        self.end_work()
        for sender in self._tellers:
            sender.close()
        for observer in self.observers:
            observer.close()
        self.store.database.close()
        self.folder.release()


async def _of_request(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


def _whole(service: Annotated[Service, Depends(_of_request)]) -> Service:
    service.folder.require_present()
    return service


Serving = Annotated[Service, Depends(_whole)]
"""A handler's parameter: the service that it serves. Without its data folder it serves nothing: 503."""

Probed = Annotated[Service, Depends(_of_request)]
"""The service whatever has become of its data folder, for what tells about that."""

Cursor = Annotated[int | None, Query(ge=1, le=2**53, description="`next` of the page before")]
PageLength = Annotated[int, Query(ge=1, le=200)]
Shown = TypeVar("Shown", JobRecord, ScheduledRun, AuditEntry)


def paged(
    found: Callable[[int], Sequence[Shown]], limit: int, path: str, service: Service, response: Response
) -> tuple[Sequence[Shown], str | None]:
    """The records of a page, and the path of the page after it, which the header `Link` names, too.

    found : gives so many records, from new to old. limit : the most that is asked for; the settings may allow less.
    """
    limit = min(limit, service.settings.page_limit)
    records = found(limit + 1)
    if len(records) <= limit:
        return records, None
    following = f"{path}?cursor={records[limit - 1].number}&limit={limit}"
    response.headers["Link"] = f'<{following}>; rel="next"'
    return records[:limit], following

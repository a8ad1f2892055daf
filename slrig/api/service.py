"""What the routers work with: the parts of one running service."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from slrig.accept.desk import AcceptanceDesk
from slrig.calibrate.calibrating import Calibrations
from slrig.calibrate.retention import Retention
from slrig.calibrate.tools import CalibrationTools
from slrig.calibrate.tools import calibration_tools as usual_calibration_tools
from slrig.config import ScanDefaults, ServiceSettings
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.keys import RequestKeys
from slrig.jobs.records import JobKind
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Worker
from slrig.scan.retention import ScanLimits, ScanRetention
from slrig.scan.runner import Runner
from slrig.schedule.notices import NoticedHealth, Notices
from slrig.schedule.scheduler import Scheduler
from slrig.schedule.store import ScheduleStore
from slrig.schedule.tasks import Tasks
from slrig.verify.job import VerificationDesk
from slrig.verify.verification import verification_tools

_SCHEDULE_END_S = 1.0
"""How long a scheduled run may take to end by itself before the runner ends it."""


@dataclass(frozen=True, slots=True)
class Service:
    """One service: its settings, its data, the one that scans, those that calibrate, verify and test, and the schedule.

    refuse_when_stale : whether the rig file has scans refused then.
    """

    settings: ServiceSettings
    scan_defaults: ScanDefaults
    folder: DataFolder
    store: JobStore
    keys: RequestKeys
    runner: Runner
    calibrations: Calibrations
    verifications: VerificationDesk
    acceptance: AcceptanceDesk
    schedules: ScheduleStore
    tasks: Tasks
    scheduler: Scheduler
    notices: Notices
    retention: Retention
    scan_retention: ScanRetention
    refuse_when_stale: bool = False

    def start(self) -> None:
        """Open the rig, look at the clock, and remove what is old."""
        self.runner.start()
        self.scheduler.start()
        # It reads the report of every scan, and nobody waits for it.
        self.scan_retention.start()
        threading.Thread(target=self.retention, name="slrig-retention", daemon=True).start()

    def end_work(self) -> None:
        """Stop scanning and calibrating, and record what was cut off. Idempotent."""
        self.scan_retention.close()
        self.scheduler.close(timeout_s=min(_SCHEDULE_END_S, self.settings.shutdown_s))
        self.runner.close(timeout_s=self.settings.shutdown_s)
        # A run that held a deaf driver has its answer now.
        self.scheduler.close(timeout_s=_SCHEDULE_END_S)
        for desk in (self.verifications, self.calibrations, self.acceptance):
            desk.close()

    def close(self) -> None:
        """Stop scanning, then let records and data folder go. Idempotent."""
        self.end_work()
        self.notices.close()
        self.store.database.close()
        self.folder.release()


def assembled_service(
    settings: ServiceSettings,
    scan_defaults: ScanDefaults,
    folder: DataFolder,
    store: JobStore,
    runner: Runner,
    worker: Worker,
    *,
    rig_name: str,
    calibration_tools: CalibrationTools | None = None,
    refuse_when_stale: bool = False,
) -> Service:
    """A service of what scans, and of the rest made to go with it. Nothing is started but what sends notices.

    worker : the runner's, which computes for all of them.

    Raises
    ------
    StorageError
        The disk refused. What was given is still the caller's to close.
    """
    spare_bytes = settings.min_free_bytes
    keys = RequestKeys(store.database, life_s=settings.idempotency_keep_s)
    keys.release_all()
    calibrations = Calibrations(
        folder,
        runner,
        JobStore(store.database, JobKind.POSE, JobKind.SOLVE),
        rig_name=rig_name,
        tools=calibration_tools or usual_calibration_tools(worker),
        spare_bytes=spare_bytes,
    )
    schedules = ScheduleStore(store.database)
    notices = Notices(settings.webhook_url, rig=rig_name)
    health = NoticedHealth(store.database, notices)
    verifications = VerificationDesk(
        folder,
        runner,
        health,
        JobStore(store.database, JobKind.VERIFICATION),
        tools=verification_tools(worker),
        spare_bytes=spare_bytes,
    )
    runner.watch_health(verifications)
    acceptance = AcceptanceDesk(
        folder,
        runner,
        JobStore(store.database, JobKind.POSITION),
        evaluate=worker.task("slrig.accept.running:evaluated", "evaluation of the position"),
        report=worker.task("slrig.accept.report:write_reports", "report of the acceptance test"),
    )
    for desk in (verifications, calibrations, acceptance):
        desk.take_up()
    retention = Retention(
        calibrations,
        folder,
        keep=settings.keep_calibrations,
        named=lambda: {test.calibration for test in acceptance.latest()},
    )
    limits = ScanLimits(settings.keep_scans, settings.keep_scans_days, settings.keep_scans_bytes)
    scan_retention = ScanRetention(store, folder, limits, runner.delete)
    runner.after_each(scan_retention.look)
    tasks = Tasks(runner, calibrations, verifications, acceptance, tidy=retention)
    # The folder's lock keeps every other process out.
    scheduler = Scheduler(schedules, tasks, alone=True, notice=notices.run)
    return Service(
        settings=settings,
        scan_defaults=scan_defaults,
        folder=folder,
        store=store,
        keys=keys,
        runner=runner,
        calibrations=calibrations,
        verifications=verifications,
        acceptance=acceptance,
        schedules=schedules,
        tasks=tasks,
        scheduler=scheduler,
        notices=notices,
        retention=retention,
        scan_retention=scan_retention,
        refuse_when_stale=refuse_when_stale,
    )


def _of_request(request: Request) -> Service:
    service = request.app.state.service
    if not isinstance(service, Service):
        raise TypeError(type(service))
    return service


Serving = Annotated[Service, Depends(_of_request)]
"""A handler's parameter: the service that it serves."""

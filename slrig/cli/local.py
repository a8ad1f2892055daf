"""A rig in this process: the manager of jobs that a service has, with a data folder for as long as a command lasts."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import UUID

from slrig.config import RigConfig
from slrig.discovery import open_rig
from slrig.failure import error_of
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.job import Job
from slrig.jobs.listener import Listener
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Worker
from slrig.model import Calibration
from slrig.rig.session import ActiveCalibration, RigSession
from slrig.scan.job import PIPELINE

_CHECK_S = 0.5
"""Interval at which a command checks the progress of the kernels."""


@contextmanager
def local_manager(config: RigConfig, *kinds: type[Job]) -> Iterator[JobManager]:
    """A manager of the rig of a file. At the end of the block, however it comes, what is under way ends early and the
    rig is closed. Raises StorageError.
    """
    with TemporaryDirectory(prefix="slrig-") as root:
        data = DataFolder(Path(root))
        database = Database(data.database)
        rig = RigSession(config.name, lambda: open_rig(config))
        manager = JobManager(JobStore(database), data, rig, Worker(PIPELINE), *kinds)
        # The command prints how a job ended.
        log = logging.getLogger(JobManager.__module__)
        level = log.level
        log.setLevel(logging.ERROR)
        try:
            manager.start(prepare=False)
            yield manager
        finally:
            manager.close()
            log.setLevel(level)
            database.close()
            data.release()


def run_job(config: RigConfig, job: Job, listener: Listener, calibration: Calibration | None = None) -> JobRecord:
    """Do one job with the rig of a file, and return it when it is over. calibration : used in place of the rig's own.

    Raises the error by which it ended, unless it left something on record: see its `fault` then. CalibrationError: the
    calibration is for other devices.
    """
    with local_manager(config, type(job)) as manager:
        if calibration is not None:
            manager.rig.use_calibration(ActiveCalibration("of the command", calibration))
        record = followed(manager, manager.submit(job, wait=True)[0].id, listener)
    if record.fault is not None and record.summary is None:
        raise error_of(record.fault)
    return record


def followed(manager: JobManager, job_id: UUID, listener: Listener) -> JobRecord:
    """Follow a job of a manager to its end, and return it."""
    news = threading.Event()
    unwatch = manager.store.watch(job_id, news.set)
    try:
        while not (record := manager.store.get(job_id)).state.final:
            at = record.progress
            preparing = record.state is JobState.COMPUTING and manager.worker.loading
            if preparing:
                listener.report("preparing", at.fraction, manager.worker.condition)
            else:
                listener.report(at.stage, at.fraction, at.detail)
            # Loading of the worker causes no event.
            news.wait(_CHECK_S if preparing else None)
            news.clear()
    finally:
        unwatch()
    return record

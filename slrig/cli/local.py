"""A rig in this process: the manager of jobs that a service has, with a data folder for as long as a command lasts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from slrig.config import RigConfig
from slrig.discovery import open_rig
from slrig.failure import error_of
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.job import Job
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobRecord
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Worker
from slrig.rig.session import RigSession
from slrig.scan.job import PIPELINE


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
        try:
            manager.start(prepare=False)
            yield manager
        finally:
            manager.close()
            database.close()
            data.release()


def run_job(config: RigConfig, job: Job, progress: Callable[[str, float, str], None]) -> JobRecord:
    """Do one job with the rig of a file, and return it when it is over.

    Raises the error by which it ended, unless it left something on record: see its `fault` then.
    """
    with local_manager(config, type(job)) as manager:
        job_id = manager.submit(job, wait=True)[0].id
        news = threading.Event()
        unwatch = manager.store.watch(job_id, news.set)
        try:
            while not (record := manager.store.get(job_id)).state.final:
                at = record.progress
                progress(at.stage, at.fraction, at.detail)
                news.wait()
                news.clear()
        finally:
            unwatch()
    if record.fault is not None and record.summary is None:
        raise error_of(record.fault)
    return record

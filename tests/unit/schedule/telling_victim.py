"""A process whose jobs end one after the other, and which tells of each, until somebody kills it."""

from __future__ import annotations

from multiprocessing.connection import Connection
from pathlib import Path
from typing import get_args

from slrig.config import NoticeKind
from slrig.jobs.database import Database
from slrig.jobs.outbox import Outbox
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.store import JobStore
from slrig.schedule.webhook import Webhook


def outbox_of(folder: Path) -> Outbox:
    """The outbox of a data folder."""
    return Outbox(Database(folder / "slrig.sqlite"), rig="bench", wanted={"webhook": get_args(NoticeKind)})


def end_jobs(folder: Path, url: str, ready: Connection) -> None:
    """End jobs for ever, as fast as the disk takes them."""
    outbox = outbox_of(folder)
    jobs = JobStore(outbox.database, JobKind.SCAN, outbox=outbox)
    Webhook(outbox, url, None).start()
    for job in jobs.unfinished():
        jobs.finish(job.id, JobState.INTERRUPTED)
    ready.send(None)
    while True:
        jobs.finish(jobs.create({}, rig="bench", label=None).id, JobState.SUCCEEDED)

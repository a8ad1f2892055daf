"""A manager of jobs over a tame bench."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from uuid import UUID

from slrig.api.server import KINDS
from slrig.errors import InvalidInputError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Compute
from slrig.rig.session import RigSession
from slrig.scan.job import ScanJob
from slrig.scan.plan import ScanPlan
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan.fakes import WAIT_S, TameBench

PIPELINE = "tests.unit.scan.fake_pipeline"


class Bench(TameBench):
    """A manager of jobs over a tame bench. worker : what computes, for one that needs no process."""

    def __init__(self, tmp_path: Path, *, worker: Compute | None = None) -> None:
        super().__init__()
        self.free_bytes = 10**9
        self.given_up: list[InvalidInputError] = []
        self.folder = DataFolder(tmp_path / "data", free=lambda _: self.free_bytes)
        self.store = JobStore(Database(self.folder.database))
        self.worker = TameCompute(PIPELINE) if worker is None else worker
        self.patched = ExitStack()
        self.patched.enter_context(self.captures())
        self.manager = JobManager(
            self.store,
            self.folder,
            RigSession("bench", self.open_rig),
            self.worker,
            *KINDS,
            queue_length=1,
            backlog_length=2,
            give_up=self.given_up.append,
        )

    def scan(self, plan: ScanPlan = ScanPlan(), *, wait: bool = False) -> JobRecord:  # noqa: B008 - frozen
        return self.manager.submit(ScanJob(plan), wait=wait)[0]

    def held(self) -> JobRecord:
        """A scan that has begun to capture and goes on until `gate` is set."""
        self.began.clear()
        self.gate.clear()
        scan = self.scan()
        assert self.began.wait(WAIT_S)
        return scan

    def until(self, job_id: UUID, state: JobState | None = None) -> JobRecord:
        """The job once it has reached `state`, or any final state."""
        states = {state} if state is not None else {state for state in JobState if state.final}
        wait_for(self.store, job_id, lambda: self.store.get(job_id).state in states)
        return self.store.get(job_id)

    def until_event(self, scan_id: UUID, kind: str) -> None:
        """Wait until an event of this kind happened to a scan."""
        wait_for(self.store, scan_id, lambda: any(each.kind == kind for each in self.store.events(scan_id, after=0)))

    def close(self) -> None:
        self.gate.set()
        self.manager.close()
        self.patched.close()
        self.store.database.close()
        self.folder.release()


def wait_for(jobs: JobStore, job_id: UUID, reached: Callable[[], bool]) -> None:
    """Wait until `reached` says so of a job."""
    found = threading.Event()

    def look() -> None:
        if reached():
            found.set()

    unwatch = jobs.watch(job_id, look)
    look()
    assert found.wait(WAIT_S)
    unwatch()


def failure_code(record: JobRecord) -> str | None:
    return None if record.fault is None else record.fault.code

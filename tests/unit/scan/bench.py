"""A runner over a tame bench."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from uuid import UUID

from slrig.errors import InvalidInputError
from slrig.jobs.compute import Compute
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.rig.session import RigSession
from slrig.scan.plan import ScanPlan
from slrig.scan.runner import Runner
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan.fakes import WAIT_S, TameBench

PIPELINE = "tests.unit.scan.fake_pipeline"


class Bench(TameBench):
    """A runner over a tame bench. worker : what computes, for one that needs no process."""

    def __init__(self, tmp_path: Path, *, worker: Compute | None = None) -> None:
        super().__init__()
        self.free_bytes = 10**9
        self.given_up: list[InvalidInputError] = []
        self.folder = DataFolder(tmp_path / "data", free=lambda _: self.free_bytes)
        self.store = JobStore(Database(self.folder.database), JobKind.SCAN)
        self.worker = TameCompute(PIPELINE) if worker is None else worker
        self.runner = Runner(
            self.store,
            self.folder,
            RigSession("bench", self.open_rig),
            self.worker,
            capture=self.capture,
            queue_length=1,
            backlog_length=2,
            give_up=self.given_up.append,
        )

    def scan(self, *, wait: bool = False) -> JobRecord:
        return self.runner.submit(ScanPlan(), label=None, wait=wait)

    def held(self) -> JobRecord:
        """A scan that has begun to capture and goes on until `gate` is set."""
        self.began.clear()
        self.gate.clear()
        scan = self.scan()
        assert self.began.wait(WAIT_S)
        return scan

    def until(self, job_id: UUID, state: JobState | None = None, *, jobs: JobStore | None = None) -> JobRecord:
        """The job once it has reached `state`, or any final state. jobs : of its kind, for the scans."""
        states = {state} if state is not None else {state for state in JobState if state.final}
        store = self.store if jobs is None else jobs
        wait_for(store, job_id, lambda: store.get(job_id).state in states)
        return store.get(job_id)

    def until_event(self, scan_id: UUID, kind: str) -> None:
        """Wait until an event of this kind happened to a scan."""
        wait_for(self.store, scan_id, lambda: any(each.kind == kind for each in self.store.events(scan_id, after=0)))

    def close(self) -> None:
        self.gate.set()
        self.runner.close()
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

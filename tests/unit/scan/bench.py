"""A runner over a tame bench."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from uuid import UUID

from slrig.errors import InvalidInputError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Worker
from slrig.rig.session import RigSession
from slrig.scan.plan import ScanPlan
from slrig.scan.runner import Runner
from tests.unit.scan.fakes import WAIT_S, TameBench

PIPELINE = "tests.unit.scan.fake_pipeline"


class Bench(TameBench):
    """A runner over a tame bench."""

    def __init__(self, tmp_path: Path) -> None:
        super().__init__()
        self.free_bytes = 10**9
        self.given_up: list[InvalidInputError] = []
        self.folder = DataFolder(tmp_path / "data", free=lambda _: self.free_bytes)
        self.store = JobStore(Database(self.folder.database), JobKind.SCAN)
        self.worker = Worker(PIPELINE)
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

    def until(self, scan_id: UUID, state: JobState | None = None) -> JobRecord:
        """The scan once it has reached `state`, or any final state."""
        states = {state} if state is not None else {state for state in JobState if state.final}
        self._wait(scan_id, lambda: self.store.get(scan_id).state in states)
        return self.store.get(scan_id)

    def until_event(self, scan_id: UUID, kind: str) -> None:
        """Wait until an event of this kind happened to a scan."""
        self._wait(scan_id, lambda: any(event.kind == kind for event in self.store.events(scan_id, after=0)))

    def _wait(self, scan_id: UUID, reached: Callable[[], bool]) -> None:
        found = threading.Event()

        def look() -> None:
            if reached():
                found.set()

        unwatch = self.store.watch(scan_id, look)
        look()
        assert found.wait(WAIT_S)
        unwatch()

    def close(self) -> None:
        self.gate.set()
        self.runner.close()
        self.store.database.close()
        self.folder.release()


def failure_code(record: JobRecord) -> str | None:
    return None if record.fault is None else record.fault.code

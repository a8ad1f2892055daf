"""Jobs of two parts: one end each, whatever happens in either, and what the next start of the service makes of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast
from uuid import UUID

import pytest

from slrig.devices import Rig
from slrig.errors import (
    DeviceGoneError,
    PoseRefusedError,
    QueueFullError,
    ScanCancelledError,
    ScanInterruptedError,
    StorageError,
    WorkerLostError,
)
from slrig.failure import JobFailure, interruption
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.job import Holder
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.jobs.rig_jobs import Outcome, Parts, RigJobs
from slrig.jobs.store import JobStore
from tests.unit.scan.fakes import WAIT_S

HOLDER = Holder("tame", "tame work", "/tame")
RIG = cast("Rig", None)
REFUSED = JobFailure(PoseRefusedError.code, "hold it still")


class TameQueue:
    """Does work on the caller's own thread; `full` refuses it, `ending` tells at once that the service ends."""

    def __init__(self) -> None:
        self.full = self.ending = False

    def submit_work(
        self,
        work: Callable[[Rig, Callable[[], bool]], None],
        *,
        ended: Callable[[Exception | None], None],
        begun: Callable[[], object],
        **_: Any,
    ) -> None:
        if self.full:
            message = "As many wait as may."
            raise QueueFullError(message)
        begun()
        error: Exception | None = interruption() if self.ending else None
        if error is None:
            try:
                work(RIG, lambda: False)
            except Exception as found:  # noqa: BLE001 - as the real one
                error = found
        ended(error)

    def cancel_work(self, work_id: UUID) -> None:
        """Nothing is under way between two calls."""


@dataclass
class Job:
    """What a job does, as a test says: raises in either part, or comes to `outcome`."""

    capture_error: Exception | None = None
    compute_error: Exception | None = None
    outcome: Outcome = Outcome({"found": 1})  # noqa: RUF009 - frozen
    done: list[str] = field(default_factory=list)

    @property
    def parts(self) -> Parts:
        return Parts(
            capture=lambda *_: self._does("capture", self.capture_error),
            captured=lambda: self.done.append("captured"),
            compute=self._compute,
            ended=lambda state, _: self.done.append(str(state)),
        )

    def _compute(self, _: object) -> Outcome:
        self._does("compute", self.compute_error)
        return self.outcome

    def _does(self, name: str, error: Exception | None) -> None:
        self.done.append(name)
        if error is not None:
            raise error


class JobBench:
    """Jobs over a tame queue."""

    def __init__(self, root: Path) -> None:
        self.folder = DataFolder(root / "data")
        self.store = JobStore(Database(self.folder.database), JobKind.VERIFICATION)
        self.queue = TameQueue()
        self.jobs = RigJobs(self.store, self.queue, self.folder)

    def recorded(self) -> JobRecord:
        return self.store.create({}, rig="bench", label=None)

    def done(self, job: Job) -> JobRecord:
        record = self.recorded()
        self.jobs.submit(record.id, job.parts, holder=HOLDER, wait=False)
        return self.over(record.id)

    def over(self, job_id: UUID) -> JobRecord:
        over = threading.Event()

        def look() -> None:
            if self.store.get(job_id).state.final:
                over.set()

        unwatch = self.store.watch(job_id, look)
        look()
        assert over.wait(WAIT_S)
        unwatch()
        return self.store.get(job_id)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[JobBench]:
    bench = JobBench(tmp_path)
    yield bench
    bench.jobs.close()
    bench.store.database.close()
    bench.folder.release()


def test_both_parts_are_done_in_turn_and_the_job_has_its_summary(bench: JobBench) -> None:
    job = Job()
    record = bench.done(job)
    assert (record.state, record.summary, record.fault) == (JobState.SUCCEEDED, {"found": 1}, None)
    assert job.done == ["capture", "captured", "compute", "succeeded"]
    states = [event.data["state"] for event in bench.store.events(record.id, after=0)]
    assert states == ["queued", "capturing", "computing", "succeeded"]
    assert list(bench.folder.incoming.iterdir()) == []


@pytest.mark.parametrize(
    ("job", "state", "code"),
    [
        (Job(capture_error=DeviceGoneError("gone")), JobState.FAILED, "device-gone"),
        (Job(capture_error=ScanCancelledError("asked to")), JobState.CANCELLED, "scan-cancelled"),
        (Job(capture_error=interruption()), JobState.INTERRUPTED, "scan-interrupted"),
        (Job(compute_error=WorkerLostError("killed")), JobState.FAILED, "worker-lost"),
        (Job(compute_error=ZeroDivisionError("secret")), JobState.FAILED, "unexpected"),
        (Job(outcome=Outcome({"found": 0}, REFUSED)), JobState.FAILED, "pose-refused"),
    ],
)
def test_whatever_happens_the_job_has_one_end_with_its_cause(
    bench: JobBench, job: Job, state: JobState, code: str
) -> None:
    record = bench.done(job)
    assert (record.state, None if record.fault is None else record.fault.code) == (state, code)
    assert job.done[-1] == str(state)
    assert list(bench.folder.incoming.iterdir()) == []


def test_refused_job_is_on_no_record(bench: JobBench) -> None:
    bench.queue.full = True
    recorded: list[object] = []
    with pytest.raises(QueueFullError):
        bench.jobs.submit(
            UUID(int=1), Job().parts, holder=HOLDER, wait=True, record=lambda: recorded.append(bench.recorded())
        )
    assert recorded == []


def test_end_of_the_service_leaves_what_waits_or_computes_to_the_next_start(bench: JobBench) -> None:
    bench.queue.ending = True
    waiting, computing = bench.recorded(), bench.recorded()
    bench.jobs.submit(waiting.id, Job().parts, holder=HOLDER, wait=True)
    assert bench.store.get(waiting.id).state is JobState.QUEUED
    raised = threading.Event()

    def cut_off(*_: object) -> Outcome:
        raised.set()
        raise ScanInterruptedError

    bench.jobs.compute(computing.id, Parts(compute=cut_off))
    assert raised.wait(WAIT_S)
    bench.queue.ending = False
    again, resumed = Job(), Job()
    bench.jobs.take_up(bench.store.get(waiting.id), again.parts, holder=HOLDER)
    assert bench.over(waiting.id).state is JobState.SUCCEEDED
    assert "capture" in again.done
    bench.jobs.take_up(bench.store.get(computing.id), resumed.parts, holder=HOLDER, resumes=True)
    assert bench.over(computing.id).state is JobState.SUCCEEDED
    assert "capture" not in resumed.done


def test_what_has_ended_the_service_twice_is_not_begun_a_third_time(bench: JobBench) -> None:
    record, job = bench.recorded(), Job()
    for _ in range(2):
        bench.store.advance(record.id, JobState.COMPUTING)
    bench.jobs.take_up(bench.store.get(record.id), job.parts, holder=HOLDER, resumes=True)
    assert (bench.over(record.id).state, job.done) == (JobState.INTERRUPTED, ["interrupted"])


def test_an_end_that_goes_wrong_does_not_keep_the_job_from_its_own(bench: JobBench) -> None:
    def wrong(*_: object) -> None:
        message = "The disk is full."
        raise StorageError(message)

    record = bench.recorded()
    bench.jobs.submit(record.id, Parts(compute=lambda _: Outcome(None), ended=wrong), holder=HOLDER, wait=False)
    assert bench.over(record.id).state is JobState.SUCCEEDED

"""Jobs of two parts: one end each, whatever happens in either, and what the next start of the service makes of them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from uuid import UUID

import pytest

from slrig.devices import Rig
from slrig.errors import (
    DeviceError,
    DeviceGoneError,
    PoseRefusedError,
    QueueFullError,
    ScanCancelledError,
    StorageError,
    WorkerLostError,
)
from slrig.failure import JobFailure, interruption
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.jobs.rig_jobs import Outcome, Parts, Recorded, RigJobs
from slrig.jobs.store import JobStore
from slrig.rig.session import RigSession
from tests.unit.jobs.tame_queue import TameQueue
from tests.unit.scan.fakes import WAIT_S, TameProjector, TameRecording

HOLDER = Holder("tame", "tame work", "/tame")
REFUSED = JobFailure(PoseRefusedError.code, "hold it still")


@dataclass
class Work:
    """What a job does, as a test says: raises in either part, or comes to `outcome`. done : what it did."""

    capture_error: Exception | None = None
    recording_error: Exception | None = None
    compute_error: Exception | None = None
    outcome: Outcome = Outcome({"found": 1})  # noqa: RUF009 - frozen
    done: list[str] = field(default_factory=list)
    recording: TameRecording = field(default_factory=TameRecording)

    def parts(self, folder: DataFolder, job_id: UUID) -> Parts:

        def capture(held: RigSession, _job: Job, progress: ProgressRecorder) -> Recorded:
            held.open().projector.show(0)
            progress("capture", 0.5, "")
            self._does("capture", self.capture_error)
            folder.recording(job_id).mkdir()
            self.recording.error = self.recording_error
            return self.recording

        def compute(*_: object) -> Outcome:
            self._does("compute", self.compute_error)
            assert (folder.staging(job_id) / "bundle").is_dir()
            return self.outcome

        return Parts(
            compute,
            capture,
            captured=lambda: self.done.append("captured"),
            failed=lambda error: self._does(f"failed by {type(error).__name__}", None),
            salvage=lambda each: self._does(f"salvage {each == job_id}", None),
        )

    def _does(self, name: str, error: Exception | None) -> None:
        self.done.append(name)
        if error is not None:
            raise error


class JobBench:
    """Jobs over a tame queue."""

    def __init__(self, root: Path) -> None:
        self.folder = DataFolder(root / "data")
        self.store = JobStore(Database(self.folder.database), JobKind.VERIFICATION)
        self.projector = TameProjector()
        self.queue = TameQueue(Rig("bench", {}, self.projector, {}))
        self.jobs = RigJobs(self.store, self.queue, self.folder)

    def recorded(self) -> JobRecord:
        return self.store.create({}, rig="bench", label=None)

    def submitted(self, work: Work) -> UUID:
        record = self.recorded()
        self.jobs.submit(record.id, work.parts(self.folder, record.id), holder=HOLDER, wait=False)
        return record.id

    def taken_up(self, job_id: UUID, work: Work, *, resumes: bool = False) -> None:
        parts = work.parts(self.folder, job_id)
        self.jobs.take_up(self.store.get(job_id), parts, holder=HOLDER, resumes=resumes)

    def done(self, work: Work) -> JobRecord:
        return self.over(self.submitted(work))

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


def code(record: JobRecord) -> str | None:
    return None if record.fault is None else record.fault.code


def test_both_parts_are_done_in_turn_and_the_job_has_its_summary(bench: JobBench) -> None:
    work = Work()
    record = bench.done(work)
    assert (record.state, record.summary, record.fault) == (JobState.SUCCEEDED, {"found": 1}, None)
    assert work.done == ["capture", "captured", "compute"]
    told = [(event.kind, event.data["state"]) for event in bench.store.events(record.id, after=0)]
    assert told == [
        ("state", "queued"), ("state", "capturing"), ("progress", "capturing"), ("captured", "capturing"),
        ("state", "computing"), ("state", "succeeded"),
    ]  # fmt: skip
    assert bench.projector.dark
    assert list(bench.folder.incoming.iterdir()) == []


def test_the_rig_is_free_before_the_frames_are_on_the_disk(bench: JobBench) -> None:
    work, finished = Work(), threading.Event()

    class Slow(TameRecording):
        def finish(self) -> None:
            assert finished.wait(WAIT_S)

    work.recording = Slow()
    job_id = bench.submitted(work)
    status = bench.queue.status()
    assert (status.holder, status.computing) == (None, (HOLDER,))
    assert bench.store.get(job_id).state is JobState.CAPTURING
    finished.set()
    assert bench.over(job_id).state is JobState.SUCCEEDED


@pytest.mark.parametrize(
    ("work", "state", "fault", "done"),
    [
        (Work(capture_error=DeviceGoneError("gone")), JobState.FAILED, "device-gone", "salvage True"),
        (Work(capture_error=OSError(5, "I/O")), JobState.FAILED, "device", "salvage True"),
        (Work(capture_error=ScanCancelledError("asked")), JobState.CANCELLED, "scan-cancelled", "failed by"),
        (Work(capture_error=interruption()), JobState.INTERRUPTED, "scan-interrupted", "salvage True"),
        (Work(recording_error=StorageError("full")), JobState.FAILED, "storage", "salvage True"),
        (Work(compute_error=WorkerLostError("killed")), JobState.FAILED, "worker-lost", "salvage True"),
        (Work(compute_error=ZeroDivisionError("secret")), JobState.FAILED, "unexpected", "salvage True"),
        (Work(outcome=Outcome({"found": 0}, REFUSED)), JobState.FAILED, "pose-refused", "compute"),
    ],
)
def test_whatever_happens_the_job_has_one_end_with_its_cause(
    bench: JobBench, work: Work, state: JobState, fault: str, done: str
) -> None:
    record = bench.done(work)
    assert (record.state, code(record)) == (state, fault)
    assert "secret" not in str(record.fault)
    assert work.done[-1].startswith(done)
    assert len([each for each in work.done if each.startswith("failed")]) == (fault != "pose-refused")
    assert bench.projector.dark
    assert list(bench.folder.incoming.iterdir()) == []


def test_job_that_is_cancelled_with_its_last_frame_is_cancelled(bench: JobBench) -> None:
    bench.queue.cancelled = lambda: True
    work = Work()
    assert bench.done(work).state is JobState.CANCELLED
    assert (work.done, work.recording.discarded) == (["capture", "failed by ScanCancelledError"], 1)
    assert list(bench.folder.incoming.iterdir()) == []


def test_refused_job_is_on_no_record(bench: JobBench) -> None:
    bench.queue.full = True
    recorded: list[object] = []
    with pytest.raises(QueueFullError):
        bench.jobs.submit(
            UUID(int=1), Parts(lambda *_: Outcome(None)), holder=HOLDER, wait=True,
            record=lambda: recorded.append(bench.recorded()),
        )  # fmt: skip
    assert recorded == []


def test_end_of_the_service_leaves_what_waits_or_computes_to_the_next_start(bench: JobBench) -> None:
    bench.queue.error = interruption()
    waiting = bench.submitted(Work())
    assert bench.store.get(waiting).state is JobState.QUEUED
    bench.queue.error = None
    cut_off = Work(compute_error=interruption())
    computing = bench.submitted(cut_off)
    with bench.queue._changed:
        assert bench.queue._changed.wait_for(lambda: not bench.queue._computing, WAIT_S)
    assert bench.store.get(computing).state is JobState.COMPUTING
    assert cut_off.done == ["capture", "captured", "compute"]
    again, resumed = Work(), Work()
    bench.taken_up(waiting, again)
    assert bench.over(waiting).state is JobState.SUCCEEDED
    assert "capture" in again.done
    bench.taken_up(computing, resumed, resumes=True)
    assert bench.over(computing).state is JobState.SUCCEEDED
    assert resumed.done == ["compute"]


def test_what_has_ended_the_service_twice_is_not_begun_a_third_time(bench: JobBench) -> None:
    record, work = bench.recorded(), Work()
    bench.folder.stage(record.id)
    for _ in range(2):
        bench.store.advance(record.id, JobState.COMPUTING)
    bench.taken_up(record.id, work, resumes=True)
    assert bench.over(record.id).state is JobState.INTERRUPTED
    assert work.done[0] == "failed by ScanInterruptedError"
    assert list(bench.folder.incoming.iterdir()) == []


def test_an_end_that_goes_wrong_does_not_keep_the_job_from_its_own(bench: JobBench) -> None:
    def wrong(*_: object) -> None:
        message = "The disk is full."
        raise StorageError(message)

    record = bench.recorded()
    found = Work(compute_error=WorkerLostError("killed")).parts(bench.folder, record.id)
    parts = Parts(found.compute, found.capture, captured=lambda: wrong(), failed=wrong, salvage=wrong)
    bench.jobs.submit(record.id, parts, holder=HOLDER, wait=False)
    assert code(bench.over(record.id)) == "worker-lost"


def test_job_whose_driver_hangs_is_told_at_once_and_its_files_are_its_own_until_it_returns(bench: JobBench) -> None:
    work, record = Work(), bench.recorded()
    parts = work.parts(bench.folder, record.id)

    def given_up(held: RigSession, job: Job, progress: ProgressRecorder) -> Recorded | None:
        bench.queue._cut_off(DeviceError("does not return"), bench.queue._under_way)
        assert code(bench.store.get(record.id)) == "device"
        assert work.done == ["failed by DeviceError"]
        assert bench.folder.staging(record.id).is_dir()
        return None if parts.capture is None else parts.capture(held, job, progress)

    job_parts = Parts(parts.compute, given_up, failed=parts.failed, salvage=parts.salvage)
    bench.jobs.submit(record.id, job_parts, holder=HOLDER, wait=False)
    assert work.done == ["failed by DeviceError", "capture"]
    assert work.recording.discarded == 1
    assert bench.store.get(record.id).state is JobState.FAILED
    assert list(bench.folder.incoming.iterdir()) == []


def test_job_that_nobody_works_on_is_let_go_when_asked(bench: JobBench) -> None:
    record, over = bench.recorded(), bench.done(Work())
    bench.jobs.cancel(record.id)
    assert bench.store.get(record.id).state is JobState.INTERRUPTED
    bench.jobs.cancel(over.id)
    assert bench.store.get(over.id) == over

"""Jobs of one part or two: one at a time, one end each, the rig dark afterwards; and what the next start does."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from uuid import UUID, uuid4

import pytest
from structlog.testing import capture_logs

from slrig.devices import Rig
from slrig.errors import (
    CalibrationError,
    DeviceError,
    DeviceGoneError,
    PoseRefusedError,
    QueueFullError,
    ScanCancelledError,
    ScanInterruptedError,
    StorageError,
    WorkerLostError,
)
from slrig.failure import JobFailure, interruption_error
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import JobKind, JobRecord, JobState, utc_now
from slrig.jobs.rig_jobs import Outcome, Parts, Recorded, RigJobs
from slrig.jobs.store import JobStore
from slrig.rig.session import ActiveCalibration, RigSession, driver_errors
from slrig.rig.watchdog import Watchdog
from tests.unit.calibrate.calibration_bench import tame_calibration
from tests.unit.jobs.tame_queue import TameQueue
from tests.unit.scan.bench import Bench, failure_code
from tests.unit.scan.fakes import WAIT_S, TameProjector, TameRecording

MEASURING = Holder("measuring 7", "measuring 7", "/measuring/7")


@dataclass(slots=True)
class Measuring:
    """Work that holds the rig, its light on, until `gate` is set. `told` has how it ended, each time."""

    error: Exception | None = None
    gate: threading.Event = field(default_factory=threading.Event)
    began: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)
    told: list[Exception | None] = field(default_factory=list)
    threads: list[str] = field(default_factory=list)
    rigs: list[Rig] = field(default_factory=list)

    def __call__(self, rig: Rig, cancelled: Callable[[], bool]) -> None:
        self.threads.append(threading.current_thread().name)
        self.rigs.append(rig)
        rig.projector.show(0)
        self.began.set()
        while not self.gate.wait(0.01):
            if cancelled():
                raise ScanCancelledError("measuring was cancelled")
        if self.error is not None:
            raise self.error

    def ended(self, error: Exception | None) -> None:
        self.told.append(error)
        self.over.set()


@pytest.fixture
def works() -> Iterator[Callable[..., Measuring]]:
    made: list[Measuring] = []

    def work(error: Exception | None = None) -> Measuring:
        made.append(Measuring(error))
        return made[-1]

    yield work
    for each in made:
        each.gate.set()


def submitted(bench: Bench, work: Measuring, *, wait: bool = False) -> UUID:
    job = job_of(work)
    bench.runner.queue.submit(lambda: [job], wait=wait)
    return job.id


def job_of(work: Measuring, do: Callable[[Rig, Callable[[], bool]], None] | None = None) -> Job:
    """A job that does the work, or what `do` says, with the open rig."""

    def with_rig(held: RigSession, job: Job) -> None:
        try:
            with driver_errors(held.name):
                (do or work)(held.open(), job.stop.is_set)
        except Exception as error:
            held.doubt(error)
            raise

    return Job(uuid4(), MEASURING, utc_now(), with_rig, work.ended)


def begun(bench: Bench, work: Measuring) -> UUID:
    work_id = submitted(bench, work)
    assert work.began.wait(WAIT_S)
    return work_id


def test_rig_is_lent_on_its_owner_thread_and_dark_afterwards(bench: Bench, works: Callable[..., Measuring]) -> None:
    work = works()

    def make() -> list[Job]:
        assert not work.began.is_set()
        return [job_of(work)]

    bench.runner.queue.submit(make, wait=False)
    assert work.began.wait(WAIT_S)
    _, projector = bench.opened[0]
    lit = not projector.dark
    work.gate.set()
    assert work.over.wait(WAIT_S)
    assert (lit, projector.dark, work.told, work.threads) == (True, True, [None], ["slrig-rig"])
    # When its end is told, the next may begin at once.
    assert bench.runner.status().holder is None
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    assert len(bench.opened) == 1


def test_work_and_scans_wait_in_one_line(bench: Bench, works: Callable[..., Measuring]) -> None:
    work, second = works(), works()
    begun(bench, work)
    scan = bench.scan(wait=True)
    with pytest.raises(QueueFullError):
        submitted(bench, second, wait=True)
    assert second.told == []
    work.gate.set()
    assert bench.until(scan.id).state is JobState.SUCCEEDED
    running = bench.held()
    submitted(bench, second, wait=True)
    second.gate.set()
    assert not second.began.is_set()
    bench.gate.set()
    assert second.over.wait(WAIT_S)
    assert bench.until(running.id).state is JobState.SUCCEEDED


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (DeviceGoneError("Camera 'cam0' was unplugged."), "unplugged"),
        (ZeroDivisionError("a defect"), "a defect"),
        # No fault of the disk: it comes from a driver.
        (
            OSError(5, "Input/output error"),
            r"a driver of rig 'bench' failed: \[Errno 5\] Input/output error; check cable",
        ),
    ],
)
def test_failed_work_has_the_rig_opened_again(
    bench: Bench, works: Callable[..., Measuring], error: Exception, told: str
) -> None:
    work = works(error)
    work.gate.set()
    with capture_logs():
        begun(bench, work)
        assert work.over.wait(WAIT_S)
    assert re.search(told, str(work.told[0]))
    assert isinstance(work.told[0], DeviceError if isinstance(error, OSError) else type(error))
    assert bench.opened_again.wait(WAIT_S)
    assert bench.opened[0][1].closed


def test_work_that_never_returns_is_darkened_past_and_told_once(bench: Bench, works: Callable[..., Measuring]) -> None:
    work = works()
    stubborn = threading.Event()

    def deaf(rig: Rig, _cancelled: Callable[[], bool]) -> None:
        rig.projector.show(0)
        work.began.set()
        stubborn.wait(WAIT_S)

    bench.runner.queue.submit(lambda: [job_of(work, deaf)], wait=False)
    assert work.began.wait(WAIT_S)
    bench.runner.close(timeout_s=0.01)
    assert bench.opened[0][1].dark
    assert [type(told) for told in work.told] == [ScanInterruptedError]
    stubborn.set()
    bench.runner.queue._owner.join(WAIT_S)
    # Closing again changes nothing.
    bench.runner.close(timeout_s=WAIT_S)
    assert len(work.told) == 1


def test_teller_that_fails_does_not_end_the_owner_thread(bench: Bench, works: Callable[..., Measuring]) -> None:
    work = works()
    work.gate.set()

    def fail(_error: Exception | None) -> None:
        work.over.set()
        raise ValueError("a defect of the teller")

    with capture_logs() as logs:
        job = job_of(work)
        job.ended = fail
        bench.runner.queue.submit(lambda: [job], wait=False)
        assert work.over.wait(WAIT_S)
        assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED
    assert "the end of work with the rig went wrong" in [each["event"] for each in logs]


def test_active_calibration_is_lent_with_the_rig(bench: Bench, works: Callable[..., Measuring]) -> None:
    work, second = works(), works()
    work.gate.set()
    begun(bench, work)
    assert work.over.wait(WAIT_S)
    active = ActiveCalibration("spring", tame_calibration())
    bench.runner.use_calibration(active)
    second.gate.set()
    begun(bench, second)
    assert second.over.wait(WAIT_S)
    assert work.rigs[0].calibration is None
    assert second.rigs[0].calibration is active.calibration
    assert bench.runner.status().active is active


def test_calibration_that_turns_out_to_be_for_others_leaves_the_rig_to_be_calibrated(
    tmp_path: Path, works: Callable[..., Measuring]
) -> None:
    """Activated before the rig was open, or kept over a change of its cameras."""
    bench = Bench(tmp_path)
    other = tame_calibration(projector=tame_calibration().cameras["cam0"].size)
    bench.runner.use_calibration(ActiveCalibration("spring", other))
    queued = bench.scan()
    bench.runner.start()
    record = bench.until(queued.id)
    assert record.fault is not None
    assert record.fault.code == "calibration"
    assert "calibration spring: the calibration is for other devices" in record.fault.message
    assert "POST /calibration/ID/activate" in record.fault.message
    assert bench.runner.status().misfit is not None
    with pytest.raises(CalibrationError, match="spring"):
        bench.scan()
    assert bench.given_up == []
    work = works()
    work.gate.set()
    begun(bench, work)
    assert work.over.wait(WAIT_S)
    assert (work.told, work.rigs[0].calibration) == ([None], None)
    bench.close()


def test_what_is_captured_while_the_queue_starts_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the owner thread may be done with its first job before `start` goes on."""
    computing, go_on, over = threading.Event(), threading.Event(), threading.Event()
    computed: list[Job] = []
    told: list[Exception | None] = []

    def compute(job: Job) -> None:
        computed.append(job)
        computing.set()
        go_on.wait(WAIT_S)

    def ended(error: Exception | None) -> None:
        told.append(error)
        over.set()

    def no_rig() -> Rig:
        raise DeviceGoneError("not plugged in")

    monkeypatch.setattr(Watchdog, "start", lambda _: computing.wait(WAIT_S))
    queue = JobQueue(RigSession("bench", no_rig), queue_length=1, backlog_length=1, give_up=lambda _: None)
    queue.add([Job(uuid4(), MEASURING, utc_now(), lambda _rig, _job: None, ended, compute)])
    queue.start()
    go_on.set()
    assert over.wait(WAIT_S)
    queue.end()
    queue.join(WAIT_S)
    assert (len(computed), told) == (1, [None])


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
        self.queue = TameQueue(Rig("tame", {}, self.projector, {}))
        self.jobs = RigJobs(self.store, self.queue, self.folder)

    def recorded(self) -> JobRecord:
        return self.store.create({}, rig="tame", label=None)

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
def tame(tmp_path: Path) -> Iterator[JobBench]:
    tame = JobBench(tmp_path)
    yield tame
    tame.jobs.close()
    tame.store.database.close()
    tame.folder.release()


def test_both_parts_are_done_in_turn_and_the_job_has_its_summary(tame: JobBench) -> None:
    work = Work()
    record = tame.done(work)
    assert (record.state, record.summary, record.fault) == (JobState.SUCCEEDED, {"found": 1}, None)
    assert work.done == ["capture", "captured", "compute"]
    told = [(event.kind, event.data["state"]) for event in tame.store.events(record.id, after=0)]
    assert told == [
        ("state", "queued"), ("state", "capturing"), ("progress", "capturing"), ("captured", "capturing"),
        ("state", "computing"), ("state", "succeeded"),
    ]  # fmt: skip
    assert tame.projector.dark
    assert list(tame.folder.incoming.iterdir()) == []


def test_the_rig_is_free_before_the_frames_are_on_the_disk(tame: JobBench) -> None:
    work, finished = Work(), threading.Event()

    class Slow(TameRecording):
        def finish(self) -> None:
            assert finished.wait(WAIT_S)

    work.recording = Slow()
    job_id = tame.submitted(work)
    status = tame.queue.status()
    assert (status.holder, status.computing) == (None, (HOLDER,))
    assert tame.store.get(job_id).state is JobState.CAPTURING
    finished.set()
    assert tame.over(job_id).state is JobState.SUCCEEDED


@pytest.mark.parametrize(
    ("work", "state", "fault", "done"),
    [
        (Work(capture_error=DeviceGoneError("gone")), JobState.FAILED, "device-gone", "salvage True"),
        (Work(capture_error=OSError(5, "I/O")), JobState.FAILED, "device", "salvage True"),
        (Work(capture_error=ScanCancelledError("asked")), JobState.CANCELLED, "scan-cancelled", "failed by"),
        (Work(capture_error=interruption_error()), JobState.INTERRUPTED, "scan-interrupted", "salvage True"),
        (Work(recording_error=StorageError("full")), JobState.FAILED, "storage", "salvage True"),
        (Work(compute_error=WorkerLostError("killed")), JobState.FAILED, "worker-lost", "salvage True"),
        (Work(compute_error=ZeroDivisionError("secret")), JobState.FAILED, "unexpected", "salvage True"),
        (Work(outcome=Outcome({"found": 0}, REFUSED)), JobState.FAILED, "pose-refused", "compute"),
    ],
)
def test_whatever_happens_the_job_has_one_end_with_its_cause(
    tame: JobBench, work: Work, state: JobState, fault: str, done: str
) -> None:
    record = tame.done(work)
    assert (record.state, failure_code(record)) == (state, fault)
    assert "secret" not in str(record.fault)
    assert work.done[-1].startswith(done)
    assert len([each for each in work.done if each.startswith("failed")]) == (fault != "pose-refused")
    assert tame.projector.dark
    assert list(tame.folder.incoming.iterdir()) == []


def test_job_that_is_cancelled_with_its_last_frame_is_cancelled(tame: JobBench) -> None:
    tame.queue.cancelled = lambda: True
    work = Work()
    assert tame.done(work).state is JobState.CANCELLED
    assert (work.done, work.recording.discarded) == (["capture", "failed by ScanCancelledError"], 1)
    assert list(tame.folder.incoming.iterdir()) == []


def test_refused_job_is_on_no_record(tame: JobBench) -> None:
    tame.queue.full = True
    recorded: list[object] = []
    with pytest.raises(QueueFullError):
        tame.jobs.submit(
            UUID(int=1), Parts(lambda *_: Outcome(None)), holder=HOLDER, wait=True,
            record=lambda: recorded.append(tame.recorded()),
        )  # fmt: skip
    assert recorded == []


def test_end_of_the_service_leaves_what_waits_or_computes_to_the_next_start(tame: JobBench) -> None:
    tame.queue.error = interruption_error()
    waiting = tame.submitted(Work())
    assert tame.store.get(waiting).state is JobState.QUEUED
    tame.queue.error = None
    cut_off = Work(compute_error=interruption_error())
    computing = tame.submitted(cut_off)
    with tame.queue._changed:
        assert tame.queue._changed.wait_for(lambda: not tame.queue._computing, WAIT_S)
    assert tame.store.get(computing).state is JobState.COMPUTING
    assert cut_off.done == ["capture", "captured", "compute"]
    again, resumed = Work(), Work()
    tame.taken_up(waiting, again)
    assert tame.over(waiting).state is JobState.SUCCEEDED
    assert "capture" in again.done
    tame.taken_up(computing, resumed, resumes=True)
    assert tame.over(computing).state is JobState.SUCCEEDED
    assert resumed.done == ["compute"]


def test_what_has_ended_the_service_twice_is_not_begun_a_third_time(tame: JobBench) -> None:
    record, work = tame.recorded(), Work()
    tame.folder.stage(record.id)
    for _ in range(2):
        tame.store.advance(record.id, JobState.COMPUTING)
    tame.taken_up(record.id, work, resumes=True)
    assert tame.over(record.id).state is JobState.INTERRUPTED
    assert work.done[0] == "failed by ScanInterruptedError"
    assert list(tame.folder.incoming.iterdir()) == []


def test_an_end_that_goes_wrong_does_not_keep_the_job_from_its_own(tame: JobBench) -> None:
    def wrong(*_: object) -> None:
        raise StorageError("The disk is full.")

    record = tame.recorded()
    found = Work(compute_error=WorkerLostError("killed")).parts(tame.folder, record.id)
    parts = Parts(found.compute, found.capture, captured=lambda: wrong(), failed=wrong, salvage=wrong)
    tame.jobs.submit(record.id, parts, holder=HOLDER, wait=False)
    assert failure_code(tame.over(record.id)) == "worker-lost"


def test_job_whose_driver_hangs_is_told_at_once_and_its_files_are_its_own_until_it_returns(tame: JobBench) -> None:
    work, record = Work(), tame.recorded()
    parts = work.parts(tame.folder, record.id)

    def given_up(held: RigSession, job: Job, progress: ProgressRecorder) -> Recorded | None:
        tame.queue._cut_off(DeviceError("does not return"), tame.queue._under_way)
        assert failure_code(tame.store.get(record.id)) == "device"
        assert work.done == ["failed by DeviceError"]
        assert tame.folder.staging(record.id).is_dir()
        return None if parts.capture is None else parts.capture(held, job, progress)

    job_parts = Parts(parts.compute, given_up, failed=parts.failed, salvage=parts.salvage)
    tame.jobs.submit(record.id, job_parts, holder=HOLDER, wait=False)
    assert work.done == ["failed by DeviceError", "capture"]
    assert work.recording.discarded == 1
    assert tame.store.get(record.id).state is JobState.FAILED
    assert list(tame.folder.incoming.iterdir()) == []


def test_job_that_nobody_works_on_is_let_go_when_asked(tame: JobBench) -> None:
    record, over = tame.recorded(), tame.done(Work())
    tame.jobs.cancel(record.id)
    assert tame.store.get(record.id).state is JobState.INTERRUPTED
    tame.jobs.cancel(over.id)
    assert tame.store.get(over.id) == over

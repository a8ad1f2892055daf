"""Jobs of one part or two: one at a time, one end each, the rig dark afterwards; and what the next start does."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar
from uuid import UUID

import pytest
from structlog.testing import capture_logs

from slrig.devices import Rig
from slrig.errors import (
    CalibrationError,
    DeviceError,
    DeviceGoneError,
    PoseRefusedError,
    QueueFullError,
    RigBusyError,
    ScanCancelledError,
    StorageError,
    WorkerLostError,
)
from slrig.failure import JobFailure, interruption_error
from slrig.jobs import manager as managing
from slrig.jobs.data_folder import FILES, DataFolder
from slrig.jobs.database import Database
from slrig.jobs.job import Job, JobRun, Outcome, Recording
from slrig.jobs.listener import Listener
from slrig.jobs.records import Holder, JobKind, JobRecord, JobState, holder_of
from slrig.jobs.resume import resume
from slrig.jobs.store import JobStore
from slrig.rig.session import ActiveCalibration, RigSession
from slrig.rig.watchdog import Watchdog
from tests.core import parametrize_core
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.jobs.tame_manager import TameManager
from tests.unit.scan.bench import PIPELINE, Bench, failure_code
from tests.unit.scan.fakes import WAIT_S, TameProjector, TameRecording, tame_calibration

REFUSED = JobFailure(PoseRefusedError.code, "hold it still")
LENT = Holder("measuring 7", "measuring 7", "/measuring/7")


@dataclass
class Steps:
    """What a job does, as a test says: raises in one of its parts, or comes to `outcome`. done : what it did; threads :
    where it captured; rigs : with what. While `gate` is clear it captures, and `began` is set when it does.
    """

    capture_error: BaseException | None = None
    recording_error: Exception | None = None
    compute_error: Exception | None = None
    keep_error: Exception | None = None
    workers_lost: int = 0
    outcome: Outcome = Outcome({"found": 1})  # noqa: RUF009 - frozen
    done: list[str] = field(default_factory=list)
    threads: list[str] = field(default_factory=list)
    rigs: list[Rig] = field(default_factory=list)
    recording: TameRecording = field(default_factory=TameRecording)
    before: Callable[[], object] = lambda: None
    deaf: bool = False

    def __post_init__(self) -> None:
        self.gate, self.began = threading.Event(), threading.Event()
        self.gate.set()

    def does(self, name: str, error: BaseException | None = None) -> None:
        self.done.append(name)
        if error is not None:
            raise error


STEPS: dict[str, Steps] = {}


@dataclass(frozen=True, slots=True)
class SteppedJob(Job):
    """Does the steps that a test has put under a name."""

    kind: ClassVar[JobKind] = JobKind.VERIFICATION
    keeps_bundle: ClassVar[bool] = True

    name: str

    @property
    def steps(self) -> Steps:
        return STEPS[self.name]

    def capture(self, rig: RigSession, run: JobRun) -> Recording | Outcome:
        steps, opened = self.steps, rig.open()
        steps.threads.append(threading.current_thread().name)
        steps.rigs.append(opened)
        steps.before()
        opened.projector.show(0)
        run.report("capture", 0.5, "")
        steps.began.set()
        while not steps.gate.wait(0.01):
            if run.cancelled() and not steps.deaf:
                raise ScanCancelledError("it was cancelled")
        steps.does("capture", steps.capture_error)
        run.recording.mkdir()
        steps.recording.error = steps.recording_error
        return steps.recording

    def compute(self, run: JobRun) -> Outcome:
        self.steps.does("compute", self.steps.compute_error)
        if self.steps.workers_lost:
            self.steps.workers_lost -= 1
            raise WorkerLostError("killed")
        assert run.bundle.is_dir()
        (run.folder / "found.txt").write_text("1")
        return self.steps.outcome

    def place(self, data: DataFolder, job_id: UUID) -> Path:
        return data.scan(job_id)


@dataclass(frozen=True, slots=True)
class Measuring(SteppedJob):
    """The same, over when the rig is free."""

    computes: ClassVar[bool] = False


@dataclass(frozen=True, slots=True)
class Finding(Measuring):
    """One that has its outcome when the rig is free."""

    def capture(self, rig: RigSession, run: JobRun) -> Outcome:
        del rig, run
        return self.steps.outcome

    def place(self, data: DataFolder, job_id: UUID) -> None:  # type: ignore[override] # it keeps no files
        del data, job_id


class Listening:
    """A group that notes what becomes of jobs. wrong : raised each time."""

    def __init__(self) -> None:
        self.wrong: Exception | None = None

    def captured(self, job: Job, job_id: UUID) -> None:
        del job_id
        self._noted(job, "captured")

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:
        del job_id
        self._noted(job, "came to nothing" if outcome is None else "kept")
        if outcome is not None and isinstance(job, SteppedJob) and job.steps.keep_error is not None:
            raise job.steps.keep_error
        return outcome or Outcome()

    def _noted(self, job: Job, what: str) -> None:
        assert isinstance(job, SteppedJob)
        job.steps.does(what, self.wrong)


@pytest.fixture(autouse=True)
def steps() -> Iterator[Mapping[str, Steps]]:
    yield STEPS
    for each in STEPS.values():
        each.gate.set()
    STEPS.clear()


def stepped(steps: Steps, kind: type[SteppedJob] = SteppedJob) -> SteppedJob:
    name = str(len(STEPS))
    STEPS[name] = steps
    return kind(name)


# With a rig of its own thread


def measuring(bench: Bench, work: Steps, *, wait: bool = False) -> UUID:
    return bench.manager.submit(stepped(work, Measuring), wait=wait)[0].id


def held(bench: Bench, work: Steps) -> UUID:
    work.gate.clear()
    job_id = measuring(bench, work)
    assert work.began.wait(WAIT_S)
    return job_id


def test_rig_is_used_on_its_owner_thread_and_dark_afterwards(bench: Bench) -> None:
    work = Steps()
    job_id = held(bench, work)
    _, projector = bench.opened[0]
    lit = not projector.dark
    work.gate.set()
    assert bench.until(job_id).state is JobState.SUCCEEDED
    assert (lit, projector.dark, work.threads) == (True, True, ["slrig-rig"])
    # When its end is on record, the next may begin at once.
    assert bench.manager.status().holder is None
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    assert len(bench.opened) == 1


@parametrize_core("raised", [SystemExit(3), KeyboardInterrupt(), RuntimeError("odd \udcff")], ids=repr)
def test_the_rig_goes_on_whatever_a_job_raises(bench: Bench, raised: BaseException) -> None:
    work = Steps(capture_error=raised)
    with capture_logs():
        record = bench.until(measuring(bench, work))
    assert record.state is JobState.FAILED
    assert record.fault is not None
    assert bench.manager.status().holder is None
    assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED


def test_an_end_that_cannot_be_recorded_as_it_is_is_recorded_plainly(bench: Bench) -> None:
    with capture_logs() as logs:
        record = bench.until(measured_as(bench, {"odd": "\udcff", "worse": object()}))
    assert (record.state, failure_code(record)) == (JobState.FAILED, "unexpected")
    assert "cannot be put on record" in (record.fault or REFUSED).message
    assert "could not be recorded as it is" in str(logs)


def measured_as(bench: Bench, summary: Mapping[str, Any]) -> UUID:
    """A job with a summary that JSON cannot hold."""
    return bench.manager.submit(stepped(Steps(outcome=Outcome(summary)), Finding))[0].id


def test_jobs_of_all_kinds_wait_in_one_line(bench: Bench) -> None:
    work, second = Steps(), Steps()
    held(bench, work)
    scan = bench.scan(wait=True)
    with pytest.raises(QueueFullError):
        measuring(bench, second, wait=True)
    work.gate.set()
    assert bench.until(scan.id).state is JobState.SUCCEEDED
    running = bench.held()
    waiting = measuring(bench, second, wait=True)
    assert not second.began.is_set()
    bench.gate.set()
    assert bench.until(waiting).state is JobState.SUCCEEDED
    assert bench.until(running.id).state is JobState.SUCCEEDED


@parametrize_core(
    ("error", "words"),
    [
        (DeviceGoneError("Camera 'cam0' was unplugged."), "unplugged"),
        (ZeroDivisionError("a defect"), "error it did not expect"),
        # No fault of the disk: it comes from a driver.
        (
            OSError(5, "Input/output error"),
            r"a driver of rig 'bench' failed: \[Errno 5\] Input/output error; check cable",
        ),
    ],
)
def test_failed_work_has_the_rig_opened_again(bench: Bench, error: Exception, words: str) -> None:
    with capture_logs():
        record = bench.until(measuring(bench, Steps(capture_error=error)))
    assert record.fault is not None
    assert re.search(words, record.fault.message)
    assert bench.opened_again.wait(WAIT_S)
    assert bench.opened[0][1].closed


def test_work_that_never_returns_is_darkened_past_and_ends_once(bench: Bench) -> None:
    work = Steps(deaf=True)
    job_id = held(bench, work)
    bench.manager.close(timeout_s=0.01)
    assert bench.opened[0][1].dark
    record = bench.store.get(job_id)
    assert failure_code(record) == "scan-interrupted"
    work.gate.set()
    bench.manager._owner.join(WAIT_S)
    # Closing again changes nothing.
    bench.manager.close(timeout_s=WAIT_S)
    assert bench.store.get(job_id) == record


def test_rig_is_lent_for_some_seconds_and_nothing_is_on_record(bench: Bench) -> None:
    def look(rig: RigSession, listener: Listener) -> str:
        assert not listener.cancelled()
        rig.open().projector.show(0)
        with pytest.raises(RigBusyError, match="measuring 7"):
            bench.scan()
        return threading.current_thread().name

    def fail(_rig: RigSession, _listener: Listener) -> None:
        raise DeviceGoneError("Camera 'cam0' was unplugged.")

    assert bench.manager.lend(LENT, look) == "slrig-rig"
    assert bench.opened[0][1].dark
    with pytest.raises(DeviceGoneError):
        bench.manager.lend(LENT, fail)
    assert bench.store.page(before=None, limit=9) == []
    assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED
    bench.held()
    with pytest.raises(RigBusyError):
        bench.manager.lend(LENT, look)


def test_active_calibration_comes_with_the_rig(bench: Bench) -> None:
    work, second = Steps(), Steps()
    bench.until(measuring(bench, work))
    active = ActiveCalibration("spring", tame_calibration())
    bench.manager.rig.use_calibration(active)
    bench.until(measuring(bench, second))
    assert work.rigs[0].calibration is bench.calibration
    assert second.rigs[0].calibration is active.calibration
    assert bench.manager.status().active is active


def test_calibration_that_turns_out_to_be_for_others_leaves_the_rig_to_be_calibrated(tmp_path: Path) -> None:
    """Activated before the rig was open, or kept over a change of its cameras."""
    bench = Bench(tmp_path)
    other = tame_calibration(projector=tame_calibration().cameras["cam0"].size)
    bench.manager.rig.use_calibration(ActiveCalibration("spring", other))
    queued = bench.scan()
    bench.manager.start()
    record = bench.until(queued.id)
    assert record.fault is not None
    assert record.fault.code == "calibration"
    assert "calibration spring: the calibration is for other devices" in record.fault.message
    assert "POST /calibration/ID/activate" in record.fault.message
    assert bench.manager.status().misfit is not None
    with pytest.raises(CalibrationError, match="spring"):
        bench.scan()
    assert bench.given_up == []
    work = Steps()
    assert bench.until(measuring(bench, work)).state is JobState.SUCCEEDED
    assert work.rigs[0].calibration is None
    bench.close()


def test_what_is_captured_while_the_manager_starts_is_computed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine the owner thread may be done with its first job before `start` goes on."""
    other = Bench(tmp_path)
    work, computing = Steps(), threading.Event()
    work.before = computing.set
    monkeypatch.setattr(Watchdog, "start", lambda _: computing.wait(WAIT_S))
    job_id = other.manager.submit(stepped(work))[0].id
    other.manager.start()
    assert other.until(job_id).state is JobState.SUCCEEDED
    assert work.done == ["capture", "compute"]
    other.close()


# Step by step


class JobBench:
    """A manager that captures on the caller's thread."""

    def __init__(self, root: Path) -> None:
        self.folder = DataFolder(root / "data")
        self.store = JobStore(Database(self.folder.database))
        self.projector = TameProjector()
        self.group = Listening()
        self.manager = self.started()

    def started(self) -> TameManager:
        """The manager of another run of the service."""
        rig = Rig("tame", {}, self.projector, {})
        manager = TameManager(self.store, self.folder, rig, TameCompute(PIPELINE), SteppedJob)
        manager.groups[JobKind.VERIFICATION] = self.group
        return manager

    def submitted(self, work: Steps) -> UUID:
        return self.manager.submit(stepped(work))[0].id

    def done(self, work: Steps) -> JobRecord:
        return self.manager.wait(self.submitted(work), WAIT_S)


@pytest.fixture
def tame(tmp_path: Path) -> Iterator[JobBench]:
    tame = JobBench(tmp_path)
    yield tame
    tame.manager.close()
    tame.store.database.close()
    tame.folder.release()


def test_both_parts_are_done_in_turn_and_the_job_has_its_summary(tame: JobBench) -> None:
    work = Steps()
    record = tame.done(work)
    assert (record.state, record.summary, record.fault) == (JobState.SUCCEEDED, {"found": 1}, None)
    assert work.done == ["capture", "captured", "compute", "kept"]
    events = [(event.kind, event.data["state"]) for event in tame.store.events(record.id, after=0)]
    assert events == [
        ("state", "queued"), ("state", "capturing"), ("progress", "capturing"), ("captured", "capturing"),
        ("state", "computing"), ("state", "succeeded"),
    ]  # fmt: skip
    assert tame.projector.dark
    assert list(tame.folder.incoming.iterdir()) == []
    files = {path.name for path in tame.folder.scan(record.id).iterdir()}
    assert files == {"bundle", FILES, "found.txt", "record.json"}


def test_the_rig_is_free_before_the_frames_are_on_the_disk(tame: JobBench) -> None:
    work, finished = Steps(), threading.Event()

    class Slow(TameRecording):
        def finish(self) -> None:
            assert finished.wait(WAIT_S)

    work.recording = Slow()
    job_id = tame.submitted(work)
    status, record = tame.manager.status(), tame.store.get(job_id)
    assert (status.holder, status.computing) == (None, (holder_of(record).name,))
    assert record.state is JobState.CAPTURING
    finished.set()
    assert tame.manager.wait(job_id, WAIT_S).state is JobState.SUCCEEDED


@parametrize_core(
    ("work", "state", "fault", "kept"),
    [
        (Steps(capture_error=DeviceGoneError("gone")), JobState.FAILED, "device-gone", []),
        (Steps(capture_error=OSError(5, "I/O")), JobState.FAILED, "device", []),
        (Steps(capture_error=ScanCancelledError("asked")), JobState.CANCELLED, "scan-cancelled", []),
        (Steps(capture_error=interruption_error()), JobState.INTERRUPTED, "scan-interrupted", []),
        (Steps(recording_error=StorageError("full")), JobState.FAILED, "storage", ["bundle", FILES]),
        (Steps(compute_error=WorkerLostError("killed")), JobState.FAILED, "worker-lost", ["bundle", FILES]),
        (Steps(compute_error=ZeroDivisionError("secret")), JobState.FAILED, "unexpected", ["bundle", FILES]),
        (Steps(outcome=Outcome({"found": 0}, REFUSED)), JobState.FAILED, "pose-refused", None),
    ],
    core=[0, 2, 4, 6],
)
def test_whatever_happens_the_job_has_one_end_with_its_cause(
    tame: JobBench, work: Steps, state: JobState, fault: str, kept: list[str] | None
) -> None:
    with capture_logs():
        record = tame.done(work)
    assert (record.state, failure_code(record)) == (state, fault)
    assert "secret" not in str(record.fault)
    assert work.done.count("came to nothing") == (fault != "pose-refused")
    assert tame.projector.dark
    assert list(tame.folder.incoming.iterdir()) == []
    place = tame.folder.scan(record.id)
    files = sorted(path.name for path in place.iterdir()) if place.exists() else []
    assert files == (["bundle", FILES, "found.txt", "record.json"] if kept is None else kept)


def test_job_that_is_cancelled_with_its_last_frame_is_cancelled(tame: JobBench) -> None:
    tame.manager.cancelled = lambda: True
    work = Steps()
    assert tame.done(work).state is JobState.CANCELLED
    assert (work.done, work.recording.discarded) == (["capture", "came to nothing"], 1)
    assert list(tame.folder.incoming.iterdir()) == []


def test_refused_job_is_on_no_record(tame: JobBench) -> None:
    tame.manager.full = True
    with pytest.raises(QueueFullError):
        tame.submitted(Steps())
    assert tame.store.page(before=None, limit=9) == []


def test_end_of_the_service_leaves_what_waits_or_computes_to_the_next_start(tame: JobBench) -> None:
    tame.manager.error = interruption_error()
    waiting = tame.submitted(Steps())
    assert tame.store.get(waiting).state is JobState.QUEUED
    tame.manager.error = None
    cut_off = Steps(compute_error=interruption_error())
    computing = tame.submitted(cut_off)
    with tame.manager._changed:
        assert tame.manager._changed.wait_for(lambda: not tame.manager._computing, WAIT_S)
    assert tame.store.get(computing).state is JobState.COMPUTING
    assert cut_off.done == ["capture", "captured", "compute"]
    cut_off.compute_error = None
    cut_off.done.clear()
    tame.manager = tame.started()
    resume(tame.manager)
    for job_id in (waiting, computing):
        assert tame.manager.wait(job_id, WAIT_S).state is JobState.SUCCEEDED
    assert cut_off.done == ["compute", "kept"]
    assert STEPS["0"].done == ["capture", "captured", "compute", "kept"]


@pytest.mark.parametrize(("lost", "state"), [(2, JobState.SUCCEEDED), (3, JobState.FAILED)])
def test_a_job_whose_worker_is_lost_is_computed_three_times_at_most(tame: JobBench, lost: int, state: JobState) -> None:
    work = Steps(workers_lost=lost)
    record = tame.done(work)
    assert (record.state, work.done.count("compute")) == (state, 3)
    assert failure_code(record) == (None if lost == 2 else "worker-lost")
    assert tame.done(Steps()).state is JobState.SUCCEEDED


def cut_off(tame: JobBench, work: Steps, *, attempts: int, takes: int = 1) -> UUID:
    """A job that the service ended with, so often before the worker was over with it."""
    record = tame.manager.record(stepped(work))[0]
    (tame.folder.stage(record.id) / "bundle").mkdir()
    for _ in range(takes):
        tame.store.advance(record.id, JobState.COMPUTING)
    for _ in range(attempts):
        tame.store.begin_attempt(record.id)
    return record.id


def test_what_only_waited_for_the_worker_goes_on_before_what_may_have_ended_the_service(tame: JobBench) -> None:
    works = [Steps(), Steps(), Steps()]
    suspect, *waiting = (cut_off(tame, work, attempts=2 - 2 * bool(n), takes=3) for n, work in enumerate(works))
    with capture_logs() as logs:
        resume(tame.manager)
    lined_up = [each["job"] for each in logs if each.get("found") == "taken up again"]
    assert lined_up == [*map(str, waiting), str(suspect)]
    assert [tame.manager.wait(each, WAIT_S).state for each in (*waiting, suspect)] == [JobState.SUCCEEDED] * 3


@pytest.mark.parametrize(("attempts", "takes"), [(3, 3), (0, 10)])
def test_what_has_ended_the_service_three_times_is_not_begun_again(tame: JobBench, attempts: int, takes: int) -> None:
    work = Steps()
    ended = cut_off(tame, work, attempts=attempts, takes=takes)
    resume(tame.manager)
    record = tame.store.get(ended)
    assert record.state is JobState.INTERRUPTED
    assert work.done == ["came to nothing"]
    assert list(tame.folder.incoming.iterdir()) == []
    assert {path.name for path in tame.folder.scan(record.id).iterdir()} == {"bundle", FILES}


def test_only_the_end_was_not_on_record_of_a_job_whose_files_are_in_place(tame: JobBench) -> None:
    work = Steps(outcome=Outcome({"found": 0}, REFUSED))
    refused = tame.done(work)
    with tame.store.database.changing() as session:
        session.connection().exec_driver_sql("UPDATE job SET state = 'computing', failure_code = NULL, summary = NULL")
    work.done.clear()
    resume(tame.manager)
    again = tame.store.get(refused.id)
    assert (again.state, again.fault, again.summary) == (JobState.FAILED, REFUSED, {"found": 0})
    assert work.done == ["kept"]


def test_a_group_that_fails_does_not_change_how_a_job_came_to_nothing(tame: JobBench) -> None:
    tame.group.wrong = StorageError("The disk is full.")
    with capture_logs():
        assert failure_code(tame.done(Steps(compute_error=WorkerLostError("killed")))) == "worker-lost"
        tame.group.wrong = None
        assert failure_code(tame.done(Steps(keep_error=StorageError("full")))) == "storage"


def test_job_whose_driver_hangs_ends_at_once_and_its_files_are_its_own_until_it_returns(tame: JobBench) -> None:
    work, manager = Steps(), tame.manager

    def given_up() -> None:
        manager._cut_off(DeviceError("does not return"), manager._under_way)
        record = tame.store.page(before=None, limit=1)[0]
        assert failure_code(record) == "device"
        assert work.done == ["came to nothing"]
        assert tame.folder.staging(record.id).is_dir()

    work.before = given_up
    record = tame.store.get(tame.submitted(work))
    assert work.done == ["came to nothing", "capture"]
    assert work.recording.discarded == 1
    assert record.state is JobState.FAILED
    assert list(tame.folder.incoming.iterdir()) == []


def test_job_that_nobody_works_on_is_let_go_when_asked(tame: JobBench) -> None:
    record, over = tame.manager.record(stepped(Steps()))[0], tame.done(Steps())
    assert tame.manager.cancel(record.id).state is JobState.INTERRUPTED
    assert tame.manager.cancel(over.id) == over


def test_an_end_that_the_disk_refuses_is_recorded_later(tame: JobBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(managing, "RETRY_S", 0.01)
    real, refused = tame.store.finish, threading.Event()

    def finish(*given: Any, **options: Any) -> bool:
        if not refused.is_set():
            refused.set()
            raise StorageError("The disk is full.")
        return real(*given, **options)

    monkeypatch.setattr(tame.store, "finish", finish)
    with capture_logs():
        assert tame.done(Steps()).state is JobState.SUCCEEDED
    assert refused.is_set()


@pytest.mark.parametrize("state", [JobState.COMPUTING, JobState.SUCCEEDED])
def test_record_of_another_version_does_not_keep_the_service_from_starting(tame: JobBench, state: JobState) -> None:
    other, whole = tame.done(Steps()), tame.done(Steps())
    with tame.store.database.changing() as session:
        session.connection().exec_driver_sql(
            "UPDATE job SET state = ?, plan = '{\"unheard\": 1}' WHERE id = ?", (state, str(other.id))
        )
    with capture_logs():
        resume(tame.started())
    ended = {JobState.COMPUTING: JobState.INTERRUPTED, JobState.SUCCEEDED: JobState.SUCCEEDED}
    assert tame.store.get(other.id).state is ended[state]
    assert tame.store.get(whole.id) == whole


def test_copy_of_a_job_is_put_aside_and_the_job_stays(
    tame: JobBench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(SteppedJob, "places", classmethod(lambda _, data: (data.root / "scans").iterdir()))
    job = tame.done(Steps())
    place = tame.folder.scan(job.id)
    shutil.copytree(place, place.with_name(f"{job.id}-copy"))
    with capture_logs():
        resume(tame.started())
    assert [path.name for path in place.parent.iterdir()] == [str(job.id)]
    assert tame.store.get(job.id) == job
    assert any(f"{job.id}-copy" in path.name for path in (tmp_path / "data" / ".orphans").iterdir())


def test_deletion_holds_no_lock_while_ends_are_recorded(tame: JobBench, monkeypatch: pytest.MonkeyPatch) -> None:
    job, needed, free = tame.done(Steps()), threading.RLock(), list[bool]()

    def listen() -> None:
        free.append(needed.acquire(blocking=False))
        needed.release()

    def settle() -> None:
        listener = threading.Thread(target=listen)
        listener.start()
        listener.join()

    monkeypatch.setattr(tame.manager, "settle", settle)
    tame.manager.delete(job.id, needed)
    assert free == [True]

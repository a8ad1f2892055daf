"""Work with the rig that is no scan: one at a time, dark afterwards, told once, whatever happens."""

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
    QueueFullError,
    ScanCancelledError,
    ScanInterruptedError,
)
from slrig.jobs.job import Holder, Job
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import JobState, utc_now
from slrig.rig.session import ActiveCalibration, RigSession, driver_errors
from slrig.rig.watchdog import Watchdog
from tests.unit.calibrate.calibration_bench import tame_calibration
from tests.unit.scan.bench import Bench
from tests.unit.scan.fakes import WAIT_S

HOLDER = Holder("measuring 7", "measuring 7", "/measuring/7")


@dataclass(slots=True)
class Work:
    """Work that holds the rig, its light on, until `gate` is set. `told` has how it ended, each time it was told."""

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
                message = "measuring was cancelled"
                raise ScanCancelledError(message)
        if self.error is not None:
            raise self.error

    def ended(self, error: Exception | None) -> None:
        self.told.append(error)
        self.over.set()


@pytest.fixture
def works() -> Iterator[Callable[..., Work]]:
    made: list[Work] = []

    def work(error: Exception | None = None) -> Work:
        made.append(Work(error))
        return made[-1]

    yield work
    for each in made:
        each.gate.set()


def submitted(bench: Bench, work: Work, *, wait: bool = False) -> UUID:
    job = job_of(work)
    bench.runner.queue.submit(lambda: [job], wait=wait)
    return job.id


def job_of(work: Work, do: Callable[[Rig, Callable[[], bool]], None] | None = None) -> Job:
    """A job that does the work, or what `do` says, with the open rig."""

    def with_rig(held: RigSession, job: Job) -> None:
        try:
            with driver_errors(held.name):
                (do or work)(held.open(), job.stop.is_set)
        except Exception as error:
            held.doubt(error)
            raise

    return Job(uuid4(), HOLDER, utc_now(), with_rig, work.ended)


def held(bench: Bench, work: Work) -> UUID:
    work_id = submitted(bench, work)
    assert work.began.wait(WAIT_S)
    return work_id


def test_rig_is_lent_on_its_owner_thread_and_dark_afterwards(bench: Bench, works: Callable[..., Work]) -> None:
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


def test_work_and_scans_wait_in_one_line(bench: Bench, works: Callable[..., Work]) -> None:
    work, second = works(), works()
    held(bench, work)
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
    bench: Bench, works: Callable[..., Work], error: Exception, told: str
) -> None:
    work = works(error)
    work.gate.set()
    with capture_logs():
        held(bench, work)
        assert work.over.wait(WAIT_S)
    assert re.search(told, str(work.told[0]))
    assert isinstance(work.told[0], DeviceError if isinstance(error, OSError) else type(error))
    assert bench.opened_again.wait(WAIT_S)
    assert bench.opened[0][1].closed


def test_work_that_never_returns_is_darkened_past_and_told_once(bench: Bench, works: Callable[..., Work]) -> None:
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


def test_teller_that_fails_does_not_end_the_owner_thread(bench: Bench, works: Callable[..., Work]) -> None:
    work = works()
    work.gate.set()

    def fail(_error: Exception | None) -> None:
        work.over.set()
        message = "a defect of the teller"
        raise ValueError(message)

    with capture_logs() as logs:
        job = job_of(work)
        job.ended = fail
        bench.runner.queue.submit(lambda: [job], wait=False)
        assert work.over.wait(WAIT_S)
        assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED
    assert "the end of work with the rig went wrong" in [each["event"] for each in logs]


def test_active_calibration_is_lent_with_the_rig(bench: Bench, works: Callable[..., Work]) -> None:
    work, second = works(), works()
    work.gate.set()
    held(bench, work)
    assert work.over.wait(WAIT_S)
    active = ActiveCalibration("spring", tame_calibration())
    bench.runner.use_calibration(active)
    second.gate.set()
    held(bench, second)
    assert second.over.wait(WAIT_S)
    assert work.rigs[0].calibration is None
    assert second.rigs[0].calibration is active.calibration
    assert bench.runner.status().active is active


def test_calibration_that_turns_out_to_be_for_others_leaves_the_rig_to_be_calibrated(
    tmp_path: Path, works: Callable[..., Work]
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
    held(bench, work)
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
        message = "not plugged in"
        raise DeviceGoneError(message)

    monkeypatch.setattr(Watchdog, "start", lambda _: computing.wait(WAIT_S))
    queue = JobQueue(RigSession("bench", no_rig), queue_length=1, backlog_length=1, give_up=lambda _: None)
    queue.add([Job(uuid4(), HOLDER, utc_now(), lambda _rig, _job: None, ended, compute)])
    queue.start()
    go_on.set()
    assert over.wait(WAIT_S)
    queue.end()
    queue.join(WAIT_S)
    assert (len(computed), told) == (1, [None])

"""Reconstruction in another process: answers, progress, cancelling, death; and frames on their way to it."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from ctypes import c_double
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from structlog.testing import capture_logs

from slrig.capture.verifier import EvidenceSummary
from slrig.errors import (
    NothingToReconstructError,
    OutOfMemoryError,
    ScanCancelledError,
    ScanInterruptedError,
    WorkerBusyError,
    WorkerLostError,
)
from slrig.failure import interruption_error, job_failure
from slrig.jobs import worker as worker_module
from slrig.jobs import worker as worker_wait
from slrig.jobs.job import (
    LEAST_WAITING_BYTES,
    MOST_WAITING_BYTES,
    Abandon,
    Begin,
    FrameFeed,
    Outcome,
    most_waiting_bytes,
)
from slrig.jobs.listener import Listener
from slrig.jobs.worker import (
    LOADING,
    READY,
    WAITING,
    Done,
    Failed,
    FileMade,
    JobWait,
    Progressed,
    Task,
    UnexpectedWorkerError,
    Unloadable,
    Worker,
    _beat,
    serve,
)
from slrig.model import Shot
from slrig.scan.plan import ReconstructionPlan
from tests.unit.scan import fake_pipeline
from tests.unit.scan.bench import PIPELINE
from tests.unit.scan.fakes import CALIBRATION, EVIDENCE, OUTLINE, SHOTS, WAIT_S, reconstruction


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    worker = Worker(PIPELINE)
    worker.start()
    yield worker
    worker.close()


class Told:
    """Collects progress."""

    def __init__(self) -> None:
        self.stages: list[tuple[str, float]] = []

    def __call__(self, stage: str, fraction: float, _detail: str) -> None:
        self.stages.append((stage, fraction))


def job(tmp_path: Path, order: str) -> Task:
    bundle = tmp_path / "bundle"
    bundle.mkdir(exist_ok=True, parents=True)
    (bundle / "order").write_text(order)
    return reconstruction(tmp_path, ReconstructionPlan(keep_holes=True))


def report_in(tmp_path: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((tmp_path / "result" / "report.json").read_text())
    return report


def gone(worker: Worker) -> None:
    """Wait for the end of the worker's process, and leave its remains to the worker."""
    assert worker.process_id is not None
    os.waitid(os.P_PID, worker.process_id, os.WEXITED | os.WNOWAIT)


def killed(worker: Worker) -> None:
    assert worker.process_id is not None
    os.kill(worker.process_id, signal.SIGKILL)
    gone(worker)


def test_report_and_progress_come_back(worker: Worker, tmp_path: Path) -> None:
    told = Told()
    found = worker.run(job(tmp_path, "finish"), Listener(report=told))
    assert found == Outcome({"bundle": tmp_path.name, "seconds": 1.5, "truth": {"rms_mm": 0.01}})
    assert report_in(tmp_path)["stages"] == [1, 2]
    assert b"keep_holes=True" in (tmp_path / "result" / "points.ply").read_bytes()
    assert told.stages == [("decode", 0.1), ("done", 1.0)]


def test_error_keeps_its_class_and_message(worker: Worker, tmp_path: Path) -> None:
    with pytest.raises(NothingToReconstructError, match="No stripe was found"):
        worker.run(job(tmp_path, "fail"))


def test_defect_carries_its_traceback(worker: Worker, tmp_path: Path) -> None:
    with pytest.raises(UnexpectedWorkerError, match=r"fake_pipeline\.py[\s\S]*an index error, say"):
        worker.run(job(tmp_path, "break"))


def test_job_stops_when_asked_and_the_process_stays(worker: Worker, tmp_path: Path) -> None:
    told = Told()
    before = worker.process_id
    with pytest.raises(ScanCancelledError):
        worker.run(job(tmp_path, "hang"), Listener(report=told, cancelled=lambda: ("mesh", 0.5) in told.stages))
    assert worker.process_id == before


def test_killed_process_is_named_and_replaced(worker: Worker, tmp_path: Path) -> None:
    before = worker.process_id
    with pytest.raises(WorkerLostError, match=signal.Signals.SIGKILL.name):
        worker.run(job(tmp_path, "die"))
    assert worker.run(job(tmp_path, "finish")).summary["seconds"] == 1.5
    assert worker.process_id != before


@pytest.mark.slow
def test_process_killed_while_idle_costs_nothing_but_a_new_one(worker: Worker, tmp_path: Path) -> None:
    killed(worker)
    assert worker.run(job(tmp_path, "finish")).summary["seconds"] == 1.5


@pytest.mark.slow
def test_deaf_job_loses_its_process(worker: Worker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_wait, "CANCEL_LIMIT_S", 0.0)
    told = Told()
    before = worker.process_id
    with pytest.raises(ScanCancelledError):
        worker.run(job(tmp_path, "hang-deaf"), Listener(report=told, cancelled=lambda: ("mesh", 0.5) in told.stages))
    worker.start()
    assert worker.process_id != before


def task(name: str, *given: object) -> Task:
    return Task(getattr(fake_pipeline, name), given, what="examination")


def test_any_function_is_called_and_a_job_knows_where_it_is_computed(worker: Worker, tmp_path: Path) -> None:
    assert worker.run(task("process_id")) == worker.process_id
    worker.run(replace(job(tmp_path, "finish"), where={"where": "pool"}))
    assert report_in(tmp_path)["computed"] == {"where": "pool"}


@pytest.mark.slow
def test_an_answer_that_came_too_late_is_dropped(worker: Worker, tmp_path: Path) -> None:
    """What was told of progress refused it: the wait is over, the job is not."""

    def refuse(*_: object) -> None:
        raise KeyboardInterrupt

    left = worker.process_id
    with pytest.raises(KeyboardInterrupt):
        worker.run(job(tmp_path, "finish"), Listener(report=refuse))
    assert worker.run(task("process_id")) == worker.process_id != left
    assert worker.run(job(tmp_path / "again", "finish")).summary["seconds"] == 1.5


def test_an_answer_of_another_job_is_dropped() -> None:
    near, far = multiprocessing.Pipe()
    stops, _ = multiprocessing.Pipe(duplex=False)
    made: list[str] = []
    process = multiprocessing.get_context("spawn").Process(target=time.monotonic)
    process.start()
    listener = Listener(cancelled=bool, file_ready=made.append)
    job = JobWait(task("process_id"), 7, process, near, stops, c_double(), listener, lambda _: None)
    for answer in (
        Done(6, "of the job before"),
        Progressed(6, "mesh", 0.5, ""),
        FileMade(6, "mesh.ply"),
        FileMade(7, "points.ply"),
        Failed(8, job_failure(interruption_error()), ""),
    ):
        far.send(answer)
    far.send(Done(7, "its own"))
    assert job.answer() == Done(7, "its own")
    assert made == ["points.ply"]
    process.join()


@pytest.mark.slow
def test_a_process_that_shows_no_sign_of_life_is_replaced(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "SILENCE_SHOWN_S", 0.0)
    monkeypatch.setattr(worker_wait, "SILENCE_LIMIT_S", 1.5)
    stopped = worker.run(task("process_id"))
    os.kill(stopped, signal.SIGSTOP)
    assert "shows no sign of life" in worker.condition
    with pytest.raises(WorkerLostError, match=r"no sign of life for 2 s in the middle of the examination.*Try again"):
        worker.run(task("process_id"))
    monkeypatch.undo()
    assert worker.run(task("process_id")) != stopped


@pytest.mark.slow
def test_a_job_without_progress_is_taken_for_one_that_never_ends(
    worker: Worker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_wait, "STANDSTILL_LIMIT_S", 0.2)
    with pytest.raises(WorkerLostError, match=r"reported no progress for .* in the middle of the examination"):
        worker.run(task("wait_for", tmp_path / "never"))


def test_memory_that_cannot_be_had_costs_the_job_only(worker: Worker) -> None:
    before = worker.run(task("process_id"))
    with pytest.raises(OutOfMemoryError, match=r"Unable to allocate 64\.0 GiB"):
        worker.run(task("exhaust"))
    assert worker.run(task("process_id")) == before


def test_jobs_have_their_turn_in_the_order_in_which_they_came(worker: Worker, tmp_path: Path) -> None:
    ended: list[str] = []
    told = Told()

    def do(name: str) -> None:
        ended.append(worker.run(task("wait_for", tmp_path / name), Listener(report=told)))

    first, second = (threading.Thread(target=do, args=(name,)) for name in ("first", "second"))
    first.start()
    while not worker.jobs:
        threading.Event().wait(0.01)
    second.start()
    while (WAITING, 0.0) not in told.stages:
        threading.Event().wait(0.01)
    with pytest.raises(ScanCancelledError):
        worker.run(task("process_id"), Listener(cancelled=lambda: True))
    (tmp_path / "second").touch()
    (tmp_path / "first").touch()
    first.join(WAIT_S)
    second.join(WAIT_S)
    assert ended == ["first", "second"]


@pytest.mark.slow
def test_how_far_the_kernels_are_is_told_before_and_during_a_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fresh, gate = Worker("tests.unit.jobs.preparing_pipeline"), tmp_path / "go"
    assert fresh.condition == LOADING
    monkeypatch.setenv("PREPARING_GATE", str(gate))
    with pytest.raises(WorkerBusyError, match="not ready yet for the report"):
        fresh.run(Task(fake_pipeline.process_id, what="report"), within_s=0.0)
    before = fresh.process_id
    deadline = time.monotonic() + WAIT_S
    while fresh.condition == LOADING and time.monotonic() < deadline:
        threading.Event().wait(0.01)
    assert fresh.condition == "preparing kernels, first time only: 41 of 118"
    assert fresh.loading
    feed, told = fresh.feed(), list[str]()
    # More than the pipe holds, so that the feed waits for a process that prepares.
    fed(feed, SHOTS[0], replace(SHOTS[1], image=np.zeros((4000, 4000), dtype=np.uint8)))

    def go_on() -> bool:
        gate.touch()
        return False

    fresh.run(
        job(tmp_path, "finish"),
        Listener(report=lambda stage, _, detail: told.append(f"{stage} {detail}".strip()), cancelled=go_on), feed=feed,
    )  # fmt: skip
    assert report_in(tmp_path)["live"] == [2, 2, True]
    assert told[:2] == ["preparing kernels first time only: 42 of 118", "decode"]
    assert (fresh.condition, fresh.loading, fresh.process_id) == (READY, False, before)
    fresh.close()


@pytest.mark.slow
def test_process_that_ends_while_it_loads_is_told(tmp_path: Path) -> None:
    broken = Worker("tests.unit.jobs.preparing_pipeline")
    broken.start()
    gone(broken)
    cause = "the reconstruction cannot be loaded: its process ended"
    assert cause in broken.condition
    with pytest.raises(WorkerLostError, match=cause):
        broken.run(job(tmp_path, "finish"))
    assert cause in broken.condition
    broken.close()


@pytest.mark.parametrize(
    ("module", "cause"),
    [
        ("tests.unit.scan.no_such_module", "ModuleNotFoundError: No module named"),
        ("tests.unit.scan.fakes", "AttributeError: "),
    ],
)
def test_pipeline_that_cannot_be_loaded_is_told(monkeypatch: pytest.MonkeyPatch, module: str, cause: str) -> None:
    # Signals belong to the tests here.
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    near, far = multiprocessing.Pipe()
    stops, _ = multiprocessing.Pipe(duplex=False)
    with capture_logs(), pytest.raises(SystemExit):
        serve(far, stops, c_double(), module)
    told = near.recv()
    assert isinstance(told, Unloadable)
    assert told.cause.startswith(cause)


@pytest.mark.parametrize("gone", ["before it is ready", "while it is", "and has read nothing"])
def test_process_whose_parent_is_gone_ends_without_a_word(monkeypatch: pytest.MonkeyPatch, gone: str) -> None:
    # Signals belong to the tests here. An error in the thread would fail the test as an unhandled one.
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    near, far = multiprocessing.Pipe()
    stops, _ = multiprocessing.Pipe(duplex=False)
    if gone == "before it is ready":
        near.close()
    orphan = threading.Thread(target=serve, args=(far, stops, c_double(), PIPELINE))
    orphan.start()
    if not near.closed:
        assert near.poll(WAIT_S)
        if gone == "while it is":
            near.recv()
        # With something unread in it, the pipe is not ended but reset.
        near.close()
    orphan.join(WAIT_S)
    assert not orphan.is_alive()
    far.close()


def test_closed_worker_starts_no_process(tmp_path: Path) -> None:
    closed = Worker(PIPELINE)
    closed.close()
    with pytest.raises(ScanInterruptedError):
        closed.run(job(tmp_path, "finish"))
    assert closed.process_id is None


def test_condition_comes_back_from_a_worker_that_was_closed_while_it_loaded() -> None:
    """Its pipe is at its end for good, and whoever read on there kept everybody from the worker."""
    closed = Worker(PIPELINE)
    closed.start()
    closed.close()
    asking = threading.Thread(target=lambda: closed.condition, daemon=True)
    asking.start()
    asking.join(WAIT_S)
    assert not asking.is_alive()
    assert not closed.loading


def test_a_task_that_cannot_begin_in_time_is_refused_and_the_worker_goes_on(worker: Worker, tmp_path: Path) -> None:
    gate, began = tmp_path / "gate", threading.Event()
    before = worker.process_id

    def began_and_goes_on() -> bool:
        began.set()
        return False

    waiting = threading.Thread(
        target=worker.run, args=(task("wait_for", gate),), kwargs={"listener": Listener(cancelled=began_and_goes_on)}
    )
    waiting.start()
    assert began.wait(WAIT_S)
    with pytest.raises(WorkerBusyError, match=r"Another job is computed, and the examination has to wait.*Try again"):
        worker.run(task("process_id"), within_s=0.0)
    gate.touch()
    waiting.join(WAIT_S)
    assert worker.run(task("process_id"), within_s=WAIT_S) == worker.process_id == before
    assert worker.jobs == 0


# ---- frames that reach the process while they are taken: all of them or none count, and nothing waits for it


RAISE, HANG = 2, 3
"""What the first pixel of a frame has the fake reconstruction do."""


class Far:
    """The other end of a feed: keeps what it is sent; while `open` is clear a message is stuck on its way."""

    def __init__(self) -> None:
        self.messages: list[object] = []
        self.open = threading.Event()
        self.open.set()
        self.reached = threading.Event()
        self.arrived = threading.Semaphore(0)
        self.alive = True

    def __call__(self, message: object) -> bool:
        self.reached.set()
        assert self.open.wait(WAIT_S)
        self.messages.append(message)
        self.arrived.release()
        return self.alive

    def kinds(self) -> list[type]:
        return [type(message) for message in self.messages]


def fed(feed: FrameFeed, *shots: Shot) -> None:
    feed.begin(OUTLINE, CALIBRATION)
    for shot in shots:
        feed.take(shot)
    feed.end(EVIDENCE)


def sent(far: Far, *shots: Shot) -> FrameFeed:
    """A feed through which these frames went."""
    feed = FrameFeed(far)
    fed(feed, *shots)
    assert feed.settled(WAIT_S)
    return feed


def telling(order: int) -> Shot:
    return replace(SHOTS[0], image=np.full((48, 64), order, dtype=np.uint8))


def test_frames_are_sent_in_order() -> None:
    far = Far()
    feed = sent(far, *SHOTS)
    assert feed.whole
    assert far.kinds() == [Begin, Shot, Shot, EvidenceSummary]
    assert far.messages[1:3] == list(SHOTS)
    # After the end there is nothing left to be abandoned.
    feed.abandon()
    assert feed.whole
    assert far.kinds()[-1] is EvidenceSummary


def test_capture_is_not_held_up_by_a_reconstruction_that_falls_behind() -> None:
    far = Far()
    far.open.clear()
    feed = FrameFeed(far, most_bytes=2 * SHOTS[0].image.nbytes)
    # Were it to wait for the other end, this would never return.
    fed(feed, SHOTS[0], SHOTS[1], SHOTS[0])
    far.open.set()
    assert feed.settled(WAIT_S)
    assert not feed.whole
    assert far.kinds() in ([Begin, Abandon], [Abandon])


@pytest.mark.parametrize(("memory_gib", "share"), [(1, None), (4, 1 / 16), (64, None)])
def test_frames_that_wait_take_a_share_of_the_memory(
    memory_gib: int, share: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = 4096
    asked = {"SC_PAGE_SIZE": page, "SC_PHYS_PAGES": memory_gib * 2**30 // page}
    monkeypatch.setattr(os, "sysconf", asked.__getitem__)
    bounds = LEAST_WAITING_BYTES if memory_gib == 1 else MOST_WAITING_BYTES
    assert most_waiting_bytes() == (bounds if share is None else memory_gib * 2**30 * share)


def test_frames_that_have_been_sent_wait_no_more() -> None:
    far = Far()
    feed = FrameFeed(far, most_bytes=2 * SHOTS[0].image.nbytes)
    feed.begin(OUTLINE, CALIBRATION)
    assert far.arrived.acquire(timeout=WAIT_S)
    for index in range(5):
        feed.take(replace(SHOTS[0], pattern=index))
        # Once this one is there, the one before it is counted no more.
        assert far.arrived.acquire(timeout=WAIT_S)
    feed.end(EVIDENCE)
    assert feed.settled(WAIT_S)
    assert feed.whole


def test_a_frame_that_takes_anothers_place_costs_the_head_start_only() -> None:
    far = Far()
    # The same pattern at another exposure is a frame of its own.
    bracket = [replace(SHOTS[0], exposure_s=exposure_s) for exposure_s in (0.01, 0.02)]
    assert sent(far, *bracket, SHOTS[1]).whole
    assert not sent(far, *bracket, SHOTS[1], bracket[0]).whole
    assert far.kinds()[-1] is Abandon


def test_abandoned_frames_are_forgotten() -> None:
    far = Far()
    far.open.clear()
    feed = FrameFeed(far)
    feed.begin(OUTLINE, CALIBRATION)
    feed.take(SHOTS[0])
    assert far.reached.wait(WAIT_S)
    feed.abandon()
    feed.take(SHOTS[1])
    assert not feed.settled(0.0)
    far.open.set()
    assert feed.settled(WAIT_S)
    assert far.kinds() == [Begin, Abandon]
    assert not feed.whole


def test_nothing_more_is_sent_to_nobody() -> None:
    far = Far()
    far.alive = False
    assert not sent(far, *SHOTS).whole
    assert far.kinds() == [Begin]


def test_without_a_calibration_nothing_is_sent() -> None:
    far = Far()
    feed = FrameFeed(far)
    feed.begin(OUTLINE, None)
    feed.take(SHOTS[0])
    feed.end(EVIDENCE)
    assert feed.settled(0.0)
    assert (far.messages, feed.whole) == ([], False)


Ran = Callable[..., object]


@pytest.fixture
def run(worker: Worker, tmp_path: Path) -> Ran:
    """Run a job after a capture; return what the reconstruction says of the frames that it was sent."""

    def ran(feed: FrameFeed, cancelled: Callable[[], bool] = lambda: False) -> object:
        worker.run(job(tmp_path, "finish"), Listener(cancelled=cancelled), feed=feed)
        return report_in(tmp_path).get("live")

    return ran


def test_frames_are_there_when_the_job_comes(worker: Worker, run: Ran) -> None:
    for _ in range(2):
        feed = worker.feed()
        fed(feed, *SHOTS)
        assert run(feed) == [2, 2, True]


def test_frames_of_a_capture_that_failed_reach_no_other_scan(worker: Worker, run: Ran) -> None:
    failed = worker.feed()
    failed.begin(OUTLINE, CALIBRATION)
    failed.take(SHOTS[0])
    failed.abandon()
    assert run(failed) is None
    feed = worker.feed()
    fed(feed, *SHOTS)
    assert run(feed) == [2, 2, True]


@pytest.mark.slow
def test_process_that_is_killed_during_the_capture_costs_the_head_start_only(worker: Worker, run: Ran) -> None:
    feed = worker.feed()
    feed.begin(OUTLINE, CALIBRATION)
    feed.take(SHOTS[0])
    killed(worker)
    feed.take(SHOTS[1])
    feed.end(EVIDENCE)
    assert run(feed) is None


def test_frame_that_cannot_be_used_costs_the_head_start_only(worker: Worker, run: Ran) -> None:
    before = worker.process_id
    feed = worker.feed()
    fed(feed, telling(RAISE), SHOTS[1])
    assert run(feed) is None
    assert worker.process_id == before


@pytest.mark.slow
def test_cancel_ends_a_process_that_is_stuck_in_a_frame(
    worker: Worker, run: Ran, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_wait, "CANCEL_LIMIT_S", 0.0)
    feed = worker.feed()
    # More than the pipe holds, so that the feed is stuck as well.
    large = replace(SHOTS[1], image=np.zeros((4000, 4000), dtype=np.uint8))
    fed(feed, telling(HANG), large)
    before = worker.process_id
    with pytest.raises(ScanCancelledError):
        run(feed, cancelled=lambda: True)
    again = worker.feed()
    fed(again, *SHOTS)
    assert run(again) == [2, 2, True]
    assert worker.process_id != before


def test_a_worker_whose_service_ended_while_it_was_loaded_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    class Ended(BaseException):
        pass

    class Heart:
        def __setattr__(self, name: str, value: float) -> None:
            assert not self.__dict__.setdefault("beats", 0)
            self.__dict__["beats"] += 1

    def end(_code: int) -> None:
        raise Ended

    monkeypatch.setattr("slrig.jobs.worker.HEARTBEAT_S", 0.0)
    monkeypatch.setattr("os._exit", end)
    # Its parent is another process by then.
    monkeypatch.setattr("multiprocessing.parent_process", lambda: SimpleNamespace(pid=os.getppid() + 1))
    with pytest.raises(Ended):
        _beat(cast("c_double", Heart()))

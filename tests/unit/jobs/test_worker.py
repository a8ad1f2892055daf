"""Reconstruction in another process: answers, progress, cancellation, death."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from ctypes import c_double
from dataclasses import replace
from pathlib import Path

import pytest

from slrig.errors import (
    NothingToReconstructError,
    OutOfMemoryError,
    ScanCancelledError,
    ScanInterruptedError,
    StorageError,
    WorkerBusyError,
    WorkerLostError,
)
from slrig.failure import failure_of, interruption
from slrig.jobs import worker as worker_module
from slrig.jobs import worker_wait
from slrig.jobs.worker import LOADING, READY, WAITING, UnexpectedWorkerError, Worker, prepare_kernel_cache
from slrig.jobs.worker_process import Done, Failed, FileMade, Progressed, Task, serve
from slrig.jobs.worker_wait import JobWait
from slrig.scan.job import reconstruction
from slrig.scan.plan import ReconstructionPlan
from tests.unit.scan.fakes import WAIT_S

PIPELINE = "tests.unit.scan.fake_pipeline"


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
    (tmp_path / "result").mkdir(exist_ok=True)
    return reconstruction(PIPELINE, bundle, tmp_path / "result", ReconstructionPlan(keep_holes=True))


def never() -> bool:
    return False


def test_report_and_progress_come_back(worker: Worker, tmp_path: Path) -> None:
    told = Told()
    report = worker.run(job(tmp_path, "finish"), progress=told, cancelled=never)
    assert report["truth"] == {"rms_mm": 0.01}
    assert json.loads((tmp_path / "result" / "report.json").read_text()) == report
    assert b"keep_holes=True" in (tmp_path / "result" / "points.ply").read_bytes()
    assert told.stages == [("decode", 0.1), ("done", 1.0)]


def test_error_keeps_its_class_and_message(worker: Worker, tmp_path: Path) -> None:
    with pytest.raises(NothingToReconstructError, match="No stripe was found"):
        worker.run(job(tmp_path, "fail"), progress=Told(), cancelled=never)


def test_defect_carries_its_traceback(worker: Worker, tmp_path: Path) -> None:
    with pytest.raises(UnexpectedWorkerError, match=r"fake_pipeline\.py[\s\S]*an index error, say"):
        worker.run(job(tmp_path, "break"), progress=Told(), cancelled=never)


def test_job_stops_when_asked_and_the_process_stays(worker: Worker, tmp_path: Path) -> None:
    told = Told()
    before = worker.process_id
    with pytest.raises(ScanCancelledError):
        worker.run(job(tmp_path, "hang"), progress=told, cancelled=lambda: ("mesh", 0.5) in told.stages)
    assert worker.process_id == before


def test_killed_process_is_named_and_replaced(worker: Worker, tmp_path: Path) -> None:
    before = worker.process_id
    with pytest.raises(WorkerLostError, match=signal.Signals.SIGKILL.name):
        worker.run(job(tmp_path, "die"), progress=Told(), cancelled=never)
    assert worker.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)["seconds"] == 1.5
    assert worker.process_id != before


def test_process_killed_while_idle_costs_nothing_but_a_new_one(worker: Worker, tmp_path: Path) -> None:
    assert worker.process_id is not None
    os.kill(worker.process_id, signal.SIGKILL)
    os.waitid(os.P_PID, worker.process_id, os.WEXITED | os.WNOWAIT)
    assert worker.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)["seconds"] == 1.5


def test_deaf_job_loses_its_process(worker: Worker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_wait, "CANCEL_LIMIT_S", 0.0)
    told = Told()
    before = worker.process_id
    with pytest.raises(ScanCancelledError):
        worker.run(job(tmp_path, "hang-deaf"), progress=told, cancelled=lambda: ("mesh", 0.5) in told.stages)
    worker.start()
    assert worker.process_id != before


def task(name: str, *given: object) -> Task:
    return Task(f"{PIPELINE}:{name}", given, what="examination")


def test_any_named_task_is_done_with_what_it_takes(worker: Worker) -> None:
    assert worker.run(task("process_id")) == worker.process_id
    assert worker.run(replace(task("told_where"), where={"where": "pool"})) == {"where": "pool"}


@pytest.mark.parametrize("refused", [StorageError("The disk is full."), KeyboardInterrupt()])
def test_an_answer_that_came_too_late_is_nobodys(worker: Worker, tmp_path: Path, refused: BaseException) -> None:
    """Whoever was told of progress refused it: the wait is over, the job is not."""

    def refuse(*_: object) -> None:
        raise refused

    left = worker.process_id
    with pytest.raises(type(refused)):
        worker.run(job(tmp_path, "finish"), progress=refuse)
    assert worker.run(task("process_id")) == worker.process_id != left
    assert worker.run(job(tmp_path / "again", "finish"))["seconds"] == 1.5


def test_an_answer_of_another_job_is_dropped() -> None:
    near, far = multiprocessing.Pipe()
    stops, _ = multiprocessing.Pipe(duplex=False)
    made: list[str] = []
    process = multiprocessing.get_context("spawn").Process(target=time.monotonic)
    process.start()
    job = JobWait(task("process_id"), 7, process, near, stops, c_double(), Told(), never, made.append, lambda _: None)
    for answer in (
        Done(6, "of the job before"),
        Progressed(6, "mesh", 0.5, ""),
        FileMade(6, "mesh.ply"),
        FileMade(7, "points.ply"),
        Failed(8, failure_of(interruption()), ""),
    ):
        far.send(answer)
    far.send(Done(7, "its own"))
    assert job.answer() == Done(7, "its own")
    assert made == ["points.ply"]
    process.join()


def test_a_process_that_shows_no_sign_of_life_is_replaced(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "SILENCE_TOLD_S", 0.0)
    monkeypatch.setattr(worker_wait, "SILENCE_LIMIT_S", 1.5)
    stopped = worker.run(task("process_id"))
    os.kill(stopped, signal.SIGSTOP)
    assert "shows no sign of life" in worker.condition
    with pytest.raises(WorkerLostError, match=r"no sign of life for 2 s in the middle of the examination.*Try again"):
        worker.run(task("process_id"))
    monkeypatch.undo()
    assert worker.run(task("process_id")) != stopped


def test_a_job_without_progress_is_taken_for_one_that_never_ends(
    worker: Worker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_wait, "STANDSTILL_LIMIT_S", 0.2)
    with pytest.raises(WorkerLostError, match=r"told no progress for .* in the middle of the examination"):
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
        ended.append(worker.run(task("wait_for", tmp_path / name), progress=told))

    first, second = (threading.Thread(target=do, args=(name,)) for name in ("first", "second"))
    first.start()
    while not worker.jobs:
        pass
    second.start()
    while (WAITING, 0.0) not in told.stages:
        pass
    with pytest.raises(ScanCancelledError):
        worker.run(task("process_id"), cancelled=lambda: True)
    (tmp_path / "second").touch()
    (tmp_path / "first").touch()
    first.join(WAIT_S)
    second.join(WAIT_S)
    assert ended == ["first", "second"]


def gone(worker: Worker) -> None:
    """Wait for the end of the worker's process, and leave its remains to the worker."""
    assert worker.process_id is not None
    os.waitid(os.P_PID, worker.process_id, os.WEXITED | os.WNOWAIT)


def test_condition_is_loading_and_then_ok(tmp_path: Path) -> None:
    fresh = Worker(PIPELINE)
    assert fresh.condition == LOADING
    fresh.start()
    fresh.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)
    assert fresh.condition == READY
    fresh.close()


def test_how_far_the_kernels_are_is_told_before_and_during_a_job(tmp_path: Path) -> None:
    fresh = Worker("tests.unit.jobs.preparing_pipeline")
    gate = tmp_path / "go"
    os.environ["PREPARING_GATE"] = str(gate)
    try:
        fresh.start()
    finally:
        del os.environ["PREPARING_GATE"]
    deadline = time.monotonic() + WAIT_S
    while fresh.condition == LOADING and time.monotonic() < deadline:
        pass
    assert fresh.condition == "preparing kernels, first time only: 41 of 118"
    assert fresh.loading
    told = Told()
    gate.touch()
    fresh.run(job(tmp_path, "finish"), progress=told, cancelled=never)
    assert ("preparing kernels", 0.0) in told.stages
    assert (fresh.condition, fresh.loading) == (READY, False)
    fresh.close()


@pytest.mark.parametrize(
    ("module", "cause"),
    [
        ("tests.unit.scan.no_such_module", "ModuleNotFoundError: No module named"),
        ("tests.unit.scan.fakes", "AttributeError: "),
        ("tests.unit.jobs.dying_pipeline", "its process ended"),
    ],
)
def test_pipeline_that_cannot_be_loaded_is_told(tmp_path: Path, module: str, cause: str) -> None:
    broken = Worker(module)
    broken.start()
    gone(broken)
    assert f"the reconstruction cannot be loaded: {cause}" in broken.condition
    with pytest.raises(WorkerLostError, match=cause):
        broken.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)
    assert f"the reconstruction cannot be loaded: {cause}" in broken.condition
    broken.close()


@pytest.mark.parametrize("read", [True, False])
def test_process_whose_parent_is_gone_ends_without_a_word(monkeypatch: pytest.MonkeyPatch, read: bool) -> None:
    # Signals belong to the tests here. An error in the thread would fail the test as an unhandled one.
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    near, far = multiprocessing.Pipe()
    stops, _ = multiprocessing.Pipe(duplex=False)
    orphan = threading.Thread(target=serve, args=(far, stops, c_double(), PIPELINE))
    orphan.start()
    assert near.poll(WAIT_S)
    if read:
        near.recv()
    # With something unread in it, the pipe is not ended but reset.
    near.close()
    orphan.join(WAIT_S)
    assert not orphan.is_alive()
    far.close()


def test_process_whose_parent_was_gone_before_it_was_ready_ends_without_a_word(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    near, far = multiprocessing.Pipe()
    near.close()
    stops, _ = multiprocessing.Pipe(duplex=False)
    serve(far, stops, c_double(), PIPELINE)
    far.close()


def test_closed_worker_starts_no_process(tmp_path: Path) -> None:
    closed = Worker(PIPELINE)
    closed.close()
    with pytest.raises(ScanInterruptedError):
        closed.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)
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


def test_kernel_cache_moves_only_when_the_package_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr(os, "access", lambda *_: True)
    prepare_kernel_cache(tmp_path / "cache")
    assert "NUMBA_CACHE_DIR" not in os.environ
    monkeypatch.setattr(os, "access", lambda *_: False)
    prepare_kernel_cache(tmp_path / "cache")
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "cache")
    assert (tmp_path / "cache").is_dir()


def test_a_task_that_cannot_begin_in_time_is_refused_and_the_worker_goes_on(worker: Worker, tmp_path: Path) -> None:
    gate, began = tmp_path / "gate", threading.Event()
    before = worker.process_id

    def began_and_goes_on() -> bool:
        began.set()
        return False

    waiting = threading.Thread(
        target=worker.run, args=(task("wait_for", gate),), kwargs={"cancelled": began_and_goes_on}
    )
    waiting.start()
    assert began.wait(WAIT_S)
    with pytest.raises(WorkerBusyError, match=r"Another job is computed, and the examination has to wait.*Ask again"):
        worker.run(task("process_id"), within_s=0.0)
    gate.touch()
    waiting.join(WAIT_S)
    assert worker.run(task("process_id"), within_s=WAIT_S) == worker.process_id == before
    assert worker.jobs == 0


def test_a_process_that_is_not_ready_in_time_goes_on_with_its_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fresh, gate = Worker("tests.unit.jobs.preparing_pipeline"), tmp_path / "go"
    monkeypatch.setenv("PREPARING_GATE", str(gate))
    with pytest.raises(WorkerBusyError, match="not ready yet for the report"):
        fresh.run(Task(f"{PIPELINE}:process_id", what="report"), within_s=0.0)
    before = fresh.process_id
    gate.touch()
    assert fresh.run(Task(f"{PIPELINE}:process_id", what="report"), within_s=WAIT_S) == before
    fresh.close()

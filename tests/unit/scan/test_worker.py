"""Reconstruction in another process: answers, progress, cancellation, death."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from slrig.errors import NothingToReconstructError, ScanCancelledError
from slrig.scan import worker as worker_module
from slrig.scan.faults import WorkerLostError
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.worker import LOADING, READY, ReconstructionWorker, UnexpectedWorkerError, prepare_kernel_cache
from slrig.scan.worker_process import Job, serve
from tests.unit.scan.fakes import WAIT_S

TASK = "tests.unit.scan.fake_pipeline:reconstruct_bundle"


@pytest.fixture(scope="module")
def worker() -> Iterator[ReconstructionWorker]:
    worker = ReconstructionWorker(TASK)
    worker.start()
    yield worker
    worker.close()


class Told:
    """Collects progress."""

    def __init__(self) -> None:
        self.stages: list[tuple[str, float]] = []

    def __call__(self, stage: str, fraction: float, _detail: str) -> None:
        self.stages.append((stage, fraction))


def job(tmp_path: Path, order: str) -> Job:
    bundle = tmp_path / "bundle"
    bundle.mkdir()
    (bundle / "order").write_text(order)
    return Job(bundle, tmp_path / "result", ReconstructionPlan(keep_holes=True))


def never() -> bool:
    return False


def test_report_and_progress_come_back(worker: ReconstructionWorker, tmp_path: Path) -> None:
    told = Told()
    report = worker.run(job(tmp_path, "finish"), progress=told, cancelled=never)
    assert report["truth"] == {"rms_mm": 0.01}
    assert json.loads((tmp_path / "result" / "report.json").read_text()) == report
    assert b"keep_holes=True" in (tmp_path / "result" / "points.ply").read_bytes()
    assert told.stages == [("decode", 0.1), ("done", 1.0)]


def test_error_keeps_its_class_and_message(worker: ReconstructionWorker, tmp_path: Path) -> None:
    with pytest.raises(NothingToReconstructError, match="No stripe was found"):
        worker.run(job(tmp_path, "fail"), progress=Told(), cancelled=never)


def test_defect_carries_its_traceback(worker: ReconstructionWorker, tmp_path: Path) -> None:
    with pytest.raises(UnexpectedWorkerError, match=r"fake_pipeline\.py[\s\S]*an index error, say"):
        worker.run(job(tmp_path, "break"), progress=Told(), cancelled=never)


def test_job_stops_when_asked_and_the_process_stays(worker: ReconstructionWorker, tmp_path: Path) -> None:
    told = Told()
    before = worker.process_id
    with pytest.raises(ScanCancelledError):
        worker.run(job(tmp_path, "hang"), progress=told, cancelled=lambda: ("mesh", 0.5) in told.stages)
    assert worker.process_id == before


def test_killed_process_is_named_and_replaced(worker: ReconstructionWorker, tmp_path: Path) -> None:
    before = worker.process_id
    with pytest.raises(WorkerLostError, match=signal.Signals.SIGKILL.name):
        worker.run(job(tmp_path, "die"), progress=Told(), cancelled=never)
    (tmp_path / "bundle" / "order").write_text("finish")
    again = Job(tmp_path / "bundle", tmp_path / "result", ReconstructionPlan())
    assert worker.run(again, progress=Told(), cancelled=never)["seconds"] == 1.5
    assert worker.process_id != before


def test_process_killed_while_idle_costs_nothing_but_a_new_one(worker: ReconstructionWorker, tmp_path: Path) -> None:
    assert worker.process_id is not None
    os.kill(worker.process_id, signal.SIGKILL)
    os.waitid(os.P_PID, worker.process_id, os.WEXITED | os.WNOWAIT)
    assert worker.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)["seconds"] == 1.5


def test_deaf_job_loses_its_process(
    worker: ReconstructionWorker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_module, "CANCEL_LIMIT_S", 0.0)
    told = Told()
    before = worker.process_id
    with pytest.raises(ScanCancelledError):
        worker.run(job(tmp_path, "hang-deaf"), progress=told, cancelled=lambda: ("mesh", 0.5) in told.stages)
    worker.start()
    assert worker.process_id != before


def gone(worker: ReconstructionWorker) -> None:
    """Wait for the end of the worker's process, and leave its remains to the worker."""
    assert worker.process_id is not None
    os.waitid(os.P_PID, worker.process_id, os.WEXITED | os.WNOWAIT)


def test_condition_is_loading_and_then_ok(tmp_path: Path) -> None:
    fresh = ReconstructionWorker(TASK)
    assert fresh.condition == LOADING
    fresh.start()
    fresh.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)
    assert fresh.condition == READY
    fresh.close()


def test_how_far_the_kernels_are_is_told_before_and_during_a_job(tmp_path: Path) -> None:
    fresh = ReconstructionWorker("tests.unit.scan.preparing_pipeline:reconstruct_bundle")
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
    ("task", "cause"),
    [
        ("tests.unit.scan.no_such_module:reconstruct_bundle", "ModuleNotFoundError: No module named"),
        ("tests.unit.scan.fake_pipeline:no_such_function", "AttributeError: "),
        ("tests.unit.scan.dying_pipeline:reconstruct_bundle", "its process ended"),
    ],
)
def test_task_that_cannot_be_loaded_is_told(tmp_path: Path, task: str, cause: str) -> None:
    broken = ReconstructionWorker(task)
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
    orphan = threading.Thread(target=serve, args=(far, TASK))
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
    serve(far, TASK)
    far.close()


def test_closed_worker_starts_no_process(tmp_path: Path) -> None:
    closed = ReconstructionWorker(TASK)
    closed.close()
    with pytest.raises(ScanCancelledError):
        closed.run(job(tmp_path, "finish"), progress=Told(), cancelled=never)
    assert closed.process_id is None


def test_condition_comes_back_from_a_worker_that_was_closed_while_it_loaded() -> None:
    """Its pipe is at its end for good, and whoever read on there kept everybody from the worker."""
    closed = ReconstructionWorker(TASK)
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

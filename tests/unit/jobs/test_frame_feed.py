"""Frames that reach the reconstruction while they are taken: all of them or none count, and nobody waits for it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.capture.evidence import EvidenceSummary
from slrig.errors import ScanCancelledError
from slrig.jobs import worker_wait
from slrig.jobs.frame_feed import (
    LEAST_WAITING_BYTES,
    MOST_WAITING_BYTES,
    Abandon,
    Begin,
    FrameFeed,
    most_waiting_bytes,
)
from slrig.jobs.records import JobState
from slrig.jobs.worker import Worker
from slrig.model import Shot
from slrig.scan.job import reconstruction
from slrig.scan.plan import ReconstructionPlan
from tests.unit.scan.bench import PIPELINE, Bench
from tests.unit.scan.fakes import CALIBRATION, EVIDENCE, OUTLINE, SHOTS, WAIT_S

DIE, RAISE, HANG = 1, 2, 3


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


def telling(order: int) -> Shot:
    """A frame that makes the fake reconstruction die, raise or hang."""
    return replace(SHOTS[0], image=np.full((48, 64), order, dtype=np.uint8))


def test_frames_are_sent_in_order() -> None:
    far = Far()
    feed = FrameFeed(far)
    fed(feed, *SHOTS)
    assert feed.settled(WAIT_S)
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
    feed = FrameFeed(far)
    # The same pattern at another exposure is a frame of its own.
    bracket = [replace(SHOTS[0], exposure_s=exposure_s) for exposure_s in (0.01, 0.02)]
    fed(feed, *bracket, SHOTS[1])
    assert feed.settled(WAIT_S)
    assert feed.whole
    again = FrameFeed(far)
    fed(again, *bracket, SHOTS[1], bracket[0])
    assert again.settled(WAIT_S)
    assert not again.whole
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
    feed = FrameFeed(far)
    fed(feed, *SHOTS)
    assert feed.settled(WAIT_S)
    assert far.kinds() == [Begin]
    assert not feed.whole


def test_without_a_calibration_nothing_is_sent() -> None:
    far = Far()
    feed = FrameFeed(far)
    feed.begin(OUTLINE, None)
    feed.take(SHOTS[0])
    feed.end(EVIDENCE)
    assert feed.settled(0.0)
    assert (far.messages, feed.whole) == ([], False)


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    worker = Worker(PIPELINE)
    yield worker
    worker.close()


Ran = Callable[..., object]


@pytest.fixture
def run(worker: Worker, tmp_path: Path) -> Ran:
    """Run a job after a capture; return what the reconstruction says of the frames that it was sent."""

    def ran(feed: FrameFeed, cancelled: Callable[[], bool] = lambda: False, order: str = "finish") -> object:
        bundle = tmp_path / "bundle"
        bundle.mkdir(exist_ok=True)
        (bundle / "order").write_text(order)
        count = len(list(tmp_path.iterdir()))
        output = tmp_path / str(count) / "result"
        output.mkdir(parents=True)
        job = reconstruction(PIPELINE, bundle, output, ReconstructionPlan())
        return worker.run(job, progress=lambda *_: None, cancelled=cancelled, feed=feed).get("live")

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


def test_process_that_is_killed_during_the_capture_costs_the_head_start_only(worker: Worker, run: Ran) -> None:
    feed = worker.feed()
    feed.begin(OUTLINE, CALIBRATION)
    feed.take(SHOTS[0])
    assert worker.process_id is not None
    os.kill(worker.process_id, signal.SIGKILL)
    os.waitid(os.P_PID, worker.process_id, os.WEXITED | os.WNOWAIT)
    feed.take(SHOTS[1])
    feed.end(EVIDENCE)
    assert run(feed) is None


def test_frame_that_cannot_be_used_costs_the_head_start_only(worker: Worker, run: Ran) -> None:
    before = worker.process_id
    feed = worker.feed()
    fed(feed, telling(RAISE), SHOTS[1])
    assert run(feed) is None
    assert worker.process_id == before


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


def test_frames_that_wait_for_the_kernels_arrive_and_the_wait_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = tmp_path / "go"
    monkeypatch.setenv("PREPARING_GATE", str(gate))
    worker = Worker("tests.unit.jobs.preparing_pipeline")
    feed = worker.feed()
    # More than the pipe holds, so that the feed waits for a process that prepares.
    fed(feed, SHOTS[0], replace(SHOTS[1], image=np.zeros((4000, 4000), dtype=np.uint8)))
    told: list[str] = []

    def hear(stage: str, _fraction: float, detail: str) -> None:
        told.append(f"{stage} {detail}".strip())
        gate.touch()

    bundle = tmp_path / "bundle"
    bundle.mkdir()
    (bundle / "order").write_text("finish")
    (tmp_path / "result").mkdir()
    report = worker.run(
        reconstruction(worker.module, bundle, tmp_path / "result", ReconstructionPlan()),
        progress=hear,
        cancelled=lambda: False,
        feed=feed,
    )
    worker.close()
    assert report["live"] == [2, 2, True]
    assert told[:3] == [
        "preparing kernels first time only: 41 of 118",
        "preparing kernels first time only: 42 of 118",
        "decode",
    ]


def test_scan_hands_its_frames_on_while_it_captures(bench: Bench) -> None:
    record = bench.until(bench.scan().id)
    assert record.state is JobState.SUCCEEDED
    report = (bench.folder.scan(record.id) / "report.json").read_text()
    assert '"live": [2, 2, true]' in report


def test_scan_survives_the_death_of_the_reconstruction_during_its_capture(bench: Bench) -> None:
    scan = bench.held()
    assert bench.worker.process_id is not None
    os.kill(bench.worker.process_id, signal.SIGKILL)
    os.waitid(os.P_PID, bench.worker.process_id, os.WEXITED | os.WNOWAIT)
    bench.gate.set()
    record = bench.until(scan.id)
    assert record.state is JobState.SUCCEEDED
    assert '"live"' not in (bench.folder.scan(record.id) / "report.json").read_text()


def test_scan_after_one_that_was_cancelled_sees_its_own_frames_only(bench: Bench) -> None:
    scan = bench.held()
    bench.runner.cancel(scan.id)
    assert bench.until(scan.id).state is JobState.CANCELLED
    bench.gate.set()
    record = bench.until(bench.scan().id)
    assert '"live": [2, 2, true]' in (bench.folder.scan(record.id) / "report.json").read_text()

"""A process that keeps the schedule is killed at any instant, many times: the record stays whole."""

from __future__ import annotations

import multiprocessing
import random
import signal
import threading
from collections import Counter
from pathlib import Path

import pytest

from slrig.jobs.database import Database
from slrig.schedule.records import Cron, Order, RunState, TaskKind
from slrig.schedule.store import ScheduleStore
from tests.unit.schedule import victim

KILLS = 60


@pytest.mark.slow
def test_kill_at_sixty_random_instants_leaves_every_due_time_with_one_row(tmp_path: Path) -> None:
    store = ScheduleStore(Database(tmp_path / "slrig.sqlite"))
    cron = Cron("*/5 * * * *", "Europe/Berlin")
    begun = victim.moment()
    order = Order(cron, TaskKind.VERIFICATION, grace_s=600.0, retry_s=30.0)
    schedule = store.create(order, begun)
    chance, pause = random.Random(7), threading.Event()
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload([victim.__name__])
    for seed in range(KILLS):
        mine, theirs = processes.Pipe()
        process = processes.Process(target=victim.keep, args=(tmp_path, seed, theirs), daemon=True)
        process.start()
        assert mine.poll(30), "the process did not come up"
        pause.wait(chance.uniform(0.0, 0.6))
        assert process.is_alive(), "it must not end by itself"
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    store.interrupt_dead(victim.moment(), alone=True)
    now = victim.moment()
    store.record_due(now)
    runs = store.runs(schedule.id, limit=5000)
    # Every due time is accounted for, once.
    assert sum(run.count for run in runs) == cron.count(begun, store.get(schedule.id).next_due, most=100_000) - 1
    states = Counter(run.state for run in runs)
    assert states[RunState.RUNNING] == 0
    assert states[RunState.INTERRUPTED] > 0, "no kill fell into a run"
    # How many there is time for between two kills goes by what else the machine does.
    assert states[RunState.SUCCEEDED] > KILLS / 2
    lines = Counter((tmp_path / "diary").read_text().splitlines())
    assert set(lines.values()) == {1}, "a run began twice"
    for run in runs:
        started, ended = lines[f"begin {run.number}"], lines[f"end {run.number}"]
        if run.state is RunState.SUCCEEDED:
            assert ended == 1
        elif run.state not in {RunState.INTERRUPTED, RunState.FAILED}:
            assert started == 0, run
    store.database.close()

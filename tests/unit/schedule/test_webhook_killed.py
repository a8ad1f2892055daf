"""A process that tells of jobs is killed at any instant, many times: each end is told, in order, under one id."""

from __future__ import annotations

import multiprocessing
import random
import signal
import threading
from pathlib import Path

import pytest

from slrig.jobs.records import JobKind
from slrig.jobs.store import JobStore
from slrig.schedule.webhook import Webhook
from tests.unit.schedule import telling_victim
from tests.unit.schedule.hook import Hook

KILLS = 30


@pytest.mark.slow
def test_kill_at_thirty_random_instants_loses_no_notice_and_doubles_one_at_most(tmp_path: Path) -> None:
    hook, chance, pause = Hook(), random.Random(11), threading.Event()
    outbox = telling_victim.outbox_of(tmp_path)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload([telling_victim.__name__])
    for _ in range(KILLS):
        mine, theirs = processes.Pipe()
        process = processes.Process(target=telling_victim.end_jobs, args=(tmp_path, hook.url, theirs), daemon=True)
        process.start()
        assert mine.poll(60), "the process did not come up"
        pause.wait(chance.uniform(0.0, 0.5))
        assert process.is_alive(), "it must not end by itself"
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    webhook = Webhook(outbox, hook.url, None)
    while webhook.step() is not None:
        pass
    came = [hook.came.get() for _ in range(hook.came.qsize())]
    hook.close()
    jobs = JobStore(outbox.database, JobKind.SCAN)
    ended = [(str(job.id), str(job.state)) for job in reversed(jobs.finished())]
    assert len(jobs.unfinished()) <= 1
    assert len(ended) > KILLS, "hardly a job ended between two kills"
    once = dict.fromkeys((each["id"], each["job"]["id"], each["job"]["state"]) for each in came)
    assert [(job, state) for _, job, state in once] == ended
    # What a receiver took as the process was killed is all that it hears of twice.
    assert len(came) - len(once) <= KILLS
    outbox.database.close()

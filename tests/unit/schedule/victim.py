"""A process that keeps a schedule on a fast clock until somebody kills it."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from slrig.errors import PoseRefusedError, RigBusyError
from slrig.jobs.database import Database
from slrig.schedule.records import Run, Schedule
from slrig.schedule.scheduler import Scheduler
from slrig.schedule.store import ScheduleStore

PACE = 1200.0
"""Seconds of the schedule's clock in one second."""

EPOCH = datetime(2026, 11, 23, tzinfo=UTC)


def moment() -> datetime:
    """The fast clock: the same in every process of this machine."""
    return EPOCH + timedelta(seconds=PACE * time.monotonic())


def keep(folder: Path, seed: int, ready: Connection) -> None:
    """Look at the clock for ever. Every run writes when it begins and when it ends."""
    chance = random.Random(seed)
    diary = os.open(folder / "diary", os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def work(_schedule: Schedule, run: Run, cancelled: Callable[[], bool], /) -> Mapping[str, Any]:
        assert not cancelled()
        if chance.random() < 0.2:
            busy = "held by a scan"
            raise RigBusyError(busy, holder="scan", since="")
        os.write(diary, f"begin {run.number}\n".encode())
        until = time.monotonic() + 0.03 * chance.random()
        while time.monotonic() < until:
            os.sched_yield()
        if chance.random() < 0.1:
            unseen = "no camera sees the board"
            raise PoseRefusedError(unseen)
        os.write(diary, f"end {run.number}\n".encode())
        return {}

    scheduler = Scheduler(
        ScheduleStore(Database(folder / "slrig.sqlite")), work, clock=moment, alone=True, execute=lambda call: call()
    )
    scheduler.start()
    ready.send(None)
    while True:
        scheduler.tick()

"""A schedule on a desk: a clock that is set by hand, work that does what a test says, and a look when a test wants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from slrig.errors import RigBusyError
from slrig.jobs.database import Database
from slrig.schedule.records import Cron, Order, Run, RunState, Schedule, TaskKind
from slrig.schedule.scheduler import Scheduler
from slrig.schedule.store import ScheduleStore
from tests.samples import put_database

START = datetime(2026, 11, 23, 5, 0, tzinfo=UTC)
"""A Monday."""


class Desk:
    """One process's view of a database. `busy` : says who holds the rig, or None."""

    def __init__(self, database: Path, *, alone: bool = True, now: datetime = START) -> None:
        self.now = now
        self.busy: str | None = None
        self.fails: Exception | None = None
        self.done: list[tuple[Schedule, Run]] = []
        self.told: list[tuple[datetime, RunState]] = []
        self.during: Callable[[], None] = lambda: None
        self.store = ScheduleStore(
            Database(put_database(database)),
            notice=lambda _session, _schedule, run: self.told.append((run.due, run.state)),
        )
        self.scheduler = Scheduler(
            self.store,
            self._work,
            clock=lambda: self.now,
            alone=alone,
            execute=lambda call: call(),
        )

    def _work(self, schedule: Schedule, run: Run, cancelled: Callable[[], bool], /) -> Mapping[str, Any]:
        assert not cancelled()
        if self.busy is not None:
            raise RigBusyError(self.busy, holder=self.busy, since=START.isoformat())
        self.done.append((schedule, run))
        self.during()
        if self.fails is not None:
            raise self.fails
        return {"attempts": run.attempts}

    def daily(self, **more: Any) -> Schedule:
        """A schedule on record: 06:00 UTC, an hour of grace, tries every ten minutes."""
        order = {"cron": Cron("0 6 * * *", "UTC"), "task": TaskKind.VERIFICATION, "retry_s": 600.0, **more}
        return self.store.create(Order(**order), self.now)

    def look(self, **step: float) -> None:
        """Let time pass, then look at the clock."""
        self.now += timedelta(**step)
        self.scheduler.tick()

    def rows(self, schedule: Schedule) -> list[tuple[str, RunState, int]]:
        """Due time, state and count of each run, old to new."""
        runs = sorted(self.store.runs(schedule.id, limit=1000), key=lambda run: run.due)
        return [(run.due.strftime("%d %H:%M"), run.state, run.count) for run in runs]

    def run(self, schedule: Schedule) -> Run:
        return self.store.runs(schedule.id, limit=1)[0]

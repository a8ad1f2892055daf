"""What tests of a schedule on the real clock share: waiting, and a due time that need not be waited for."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

from tests.e2e.conftest import ServiceProcess
from tests.e2e.test_calibration_walk import Caller

LIMIT_S = 100.0
"""A minute until it is due, and what the run itself may take on a machine that does much else."""


def awaited(look: Callable[[], Any], what: str, *, limit_s: float = LIMIT_S) -> Any:
    """What `look` finds, once it finds something."""
    deadline, pause = time.monotonic() + limit_s, threading.Event()
    while time.monotonic() < deadline:
        found = look()
        if found:
            return found
        pause.wait(0.05)
    raise AssertionError(f"{what} did not happen within {limit_s:g} s")


def newest(caller: Caller, schedule: dict[str, Any], *states: str) -> dict[str, Any] | None:
    """The newest run, if it is in one of these states."""
    runs = caller.get(schedule["links"]["runs"])["runs"]
    return runs[0] if runs and runs[0]["state"] in states else None


def at_once(caller: Caller, service: ServiceProcess, schedule: dict[str, Any]) -> None:
    """Have a paused schedule of every minute be due in the minute that is, and only then.

    Its record is made to look as if it had been there before this minute began, and as if it were due in this minute of
    the year alone, whenever the next one begins; the clock is the real one.
    """
    minute = datetime.now(UTC).replace(second=0, microsecond=0)
    _rewrite(service, schedule, f"{minute:%M %H %d %m} *", minute)
    caller.post(schedule["links"]["resume"], 200)
    awaited(lambda: _is_due(caller, schedule, minute), "the run")
    caller.post(schedule["links"]["pause"], 200)
    _rewrite(service, schedule, "* * * * *", datetime.now(UTC).replace(second=0, microsecond=0) + timedelta(minutes=1))


def _is_due(caller: Caller, schedule: dict[str, Any], at: datetime) -> bool:
    runs = caller.get(schedule["links"]["runs"])["runs"]
    return any(datetime.fromisoformat(run["due"]) == at for run in runs)


def _rewrite(service: ServiceProcess, schedule: dict[str, Any], cron: str, due: datetime) -> None:
    with sqlite3.connect(service.data / "slrig.sqlite", timeout=10) as database:
        stamp = due.isoformat(timespec="milliseconds")
        changed = database.execute(
            "UPDATE schedule SET cron = ?, next_due = ? WHERE id = ?", (cron, stamp, schedule["id"])
        )
        assert changed.rowcount == 1
    database.close()

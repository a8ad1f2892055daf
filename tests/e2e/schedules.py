"""What tests of a schedule on the real clock share: waiting, and a due time that need not be waited for."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
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
    message = f"{what} did not happen within {limit_s:g} s"
    raise AssertionError(message)


def newest(caller: Caller, schedule: dict[str, Any], *states: str) -> dict[str, Any] | None:
    """The newest run, if it is in one of these states."""
    runs = caller.get(schedule["links"]["runs"])["runs"]
    return runs[0] if runs and runs[0]["state"] in states else None


def at_once(caller: Caller, service: ServiceProcess, schedule: dict[str, Any]) -> None:
    """Have a paused schedule of every minute be due in the minute that is, and only then.

    Its record is made to look as if it had been there before this minute began; the clock is the real one.
    """
    minute = datetime.now(UTC).replace(second=0, microsecond=0)
    with sqlite3.connect(service.data / "slrig.sqlite", timeout=10) as database:
        stamp = minute.isoformat(timespec="milliseconds")
        changed = database.execute("UPDATE schedule SET next_due = ? WHERE id = ?", (stamp, schedule["id"]))
        assert changed.rowcount == 1
    database.close()
    caller.post(schedule["links"]["resume"], 200)
    awaited(lambda: caller.get(schedule["links"]["runs"])["runs"], "the run")
    caller.post(schedule["links"]["pause"], 200)

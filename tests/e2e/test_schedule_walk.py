"""A schedule kept by the real service on the real clock: due, killed in the middle, and done the next minute."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import Start
from tests.e2e.test_calibration_walk import BOARD, SLOW, Caller, write_rig

LIMIT_S = 100.0
"""A minute until it is due, and what the run itself may take on a machine that does much else."""


def calibrated_rig(folder: Path) -> Path:
    """The rig with the board and a positioner, and with the calibration that it was rendered by."""
    rig = write_rig(folder, head=SLOW)
    rig.write_text(rig.read_text().replace("carries_calibration = false", "carries_calibration = true"))
    return rig


def awaited(look: Callable[[], Any], what: str) -> Any:
    """What `look` finds, once it finds something."""
    deadline, pause = time.monotonic() + LIMIT_S, threading.Event()
    while time.monotonic() < deadline:
        found = look()
        if found:
            return found
        pause.wait(0.05)
    message = f"{what} did not happen within {LIMIT_S:g} s"
    raise AssertionError(message)


def newest(caller: Caller, schedule: dict[str, Any], state: str) -> dict[str, Any] | None:
    """The newest run, if it is in that state."""
    runs = caller.get(schedule["links"]["runs"])["runs"]
    return runs[0] if runs and runs[0]["state"] == state else None


@pytest.mark.slow
def test_schedule_is_kept_through_a_kill_in_the_middle_of_a_run(start: Start, tmp_path: Path) -> None:
    rig = calibrated_rig(tmp_path / "rig")
    service = start(rig)
    with Caller(service) as caller:
        caller.ready()
        made = caller.post(
            "/schedule", 201, cron="* * * * *", task="verification", options={"board": BOARD, "position": 1}
        )
        assert len(made["upcoming"]) == 5
        name = awaited(lambda: caller.get("/rig")["holder"], "the run")
        assert name.startswith(f"schedule {made['id'][:8]}, verification due ")
        refused = caller.post("/scan", 409)
        assert refused["holder"] == name
        assert name in refused["detail"]
        assert newest(caller, made, "running")
        service.kill()
    service = start(rig)
    with Caller(service) as caller:
        (cut_off,) = caller.get(made["links"]["runs"])["runs"]
        assert (cut_off["state"], cut_off["reason"]) == ("interrupted", "the service ended in the middle of it")
        assert list((service.data / ".incoming").iterdir()) == []
        run = awaited(lambda: newest(caller, made, "succeeded"), "a whole run")
        assert run["due"] > cut_off["due"]
        assert run["result"]["state"] == "good", run["result"]
        health = caller.get("/rig/health")
        assert (health["state"], health["latest"]["id"]) == ("good", run["result"]["verification"])
        figures = caller.http.get("/metrics").text
        assert 'slrig_scheduled_runs{state="interrupted",task="verification"} 1.0' in figures
        assert 'slrig_rig_health{state="good"} 1.0' in figures
        caller.post(made["links"]["pause"], 200)
        assert caller.http.delete(made["links"]["self"]).status_code == 204
    assert service.stop() == 0

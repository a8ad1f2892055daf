"""A schedule kept by the real service on the real clock: due, killed in the middle, and done the next minute."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.conftest import SLOW, Start
from tests.e2e.schedules import at_once, awaited, newest
from tests.e2e.test_calibration_walk import BOARD, Caller, write_rig


@pytest.mark.slow
def test_a_schedule_is_kept_through_a_kill_in_the_middle_of_a_run(start: Start, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig", head=SLOW, carries="true")
    service = start(rig)
    with Caller(service) as caller:
        caller.ready()
        options = {"board": BOARD, "position": 1}
        made = caller.post("/schedule", 201, cron="* * * * *", task="verification", enabled=False, options=options)
        at_once(caller, service, made)
        assert len(caller.get(made["links"]["self"])["upcoming"]) == 5
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
        # This one comes by the clock.
        caller.post(made["links"]["resume"], 200)
        run = awaited(lambda: newest(caller, made, "succeeded"), "a whole run")
        assert run["due"] > cut_off["due"]
        assert run["result"]["state"] == "good", run["result"]
        health = caller.get("/rig/health")
        assert (health["state"], health["latest"]["id"]) == ("good", run["result"]["verification"])
        figures = caller.http.get("/metrics").text
        assert 'slrig_scheduled_runs{state="interrupted",task="verification"} 1.0' in figures
        assert 'slrig_rig_health{state="good"} 1.0' in figures
    assert service.stop() == 0

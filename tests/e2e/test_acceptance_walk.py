"""Through the real service: an acceptance test to its report, and a schedule that outlives a kill in a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from slrig.accept.job import SCENE, scripted_config
from slrig.accept.plan import AcceptanceRequest
from slrig.config import read_rig
from slrig.discovery import open_rig
from tests.e2e.conftest import SLOW, Start, write_rig
from tests.e2e.schedules import at_once, awaited, newest
from tests.e2e.test_calibration_walk import BOARD, Caller
from tests.e2e.test_calibration_walk import write_rig as write_board_rig

REPEATS = 2


def acceptance_rig(folder: Path) -> Path:
    """The small rig with the artefacts in place of its scene, and a pose for each prescribed position."""
    config = read_rig(write_rig(folder))
    with open_rig(config) as rig:
        assert rig.calibration is not None
        plan = AcceptanceRequest(repeats=REPEATS).plan(rig.calibration)
    head = scripted_config(config, plan, folder).head
    assert head is not None
    poses = "".join(
        f'[[head.pose]]\nname = "{each["name"]}"\nobject = "{each["object"]}"\n'
        f"position_mm = {each['position_mm']}\nrotation_deg = {each['rotation_deg']}\n"
        for each in head.model_dump()["pose"]
    )
    return write_rig(folder, scene=(folder / SCENE).read_text(), head=poses)


@pytest.mark.slow
def test_acceptance_over_http_to_its_report(start: Start, tmp_path: Path) -> None:
    rig = acceptance_rig(tmp_path / "rig")
    service = start(rig)
    with Caller(service) as caller:
        caller.ready()
        key = {"Idempotency-Key": "one test"}
        opened = caller.http.post("/acceptance", json={"repeats": REPEATS}, headers=key)
        assert opened.status_code == 201, opened.text
        test = opened.json()
        assert caller.http.post("/acceptance", json={"repeats": REPEATS}, headers=key).json() == test
        assert (test["captures"], test["next"]["name"]) == (23 + 3 * (REPEATS - 1), "sphere-1")
        caller.post(f"/acceptance/{test['id']}/position", 202, scripted=True)
        busy = caller.post("/scan", 409)
        assert busy["holder"] == f"acceptance test {test['id']}"

        def over() -> dict[str, Any] | None:
            found = caller.get(f"/acceptance/{test['id']}")
            return None if found["state"] == "measuring" else found

        found = awaited(over, "the end of the acceptance test")
        assert (found["state"], found["error"]) == ("finished", None)
        report = caller.get(found["files"]["report.json"])
        assert (report["complete"], report["rendered"]) == (True, True)
        assert report["decision"] == found["decision"]
        assert [each["quantity"] for each in report["quantities"]] == ["PF", "PS", "SD", "F"]
        captures = [capture for each in report["positions"] for capture in each["captures"]]
        assert len(captures) == len(found["readings"]) == found["captures"]
        # A small picture has a large error, the more as a ball's rim counts; a scale 1 % wrong would have ten times it.
        spacing = next(each for each in report["quantities"] if each["quantity"] == "SD")
        assert abs(spacing["error_mm"]) < report["volume_diagonal_mm"] / 2000
        assert caller.http.get(found["files"]["report.html"]).text.count("data:image/jpeg;base64,") == 23
    assert service.stop() == 0


@pytest.mark.slow
def test_a_schedule_is_kept_through_a_kill_in_the_middle_of_a_run(start: Start, tmp_path: Path) -> None:
    rig = write_board_rig(tmp_path / "rig", head=SLOW, carries="true")
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

"""/schedule and /metrics: added, listed, paused, resumed, removed, and refused in words."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient

from slrig.bundle.calibration_file import write_calibration
from slrig.schedule.records import RunState
from tests.unit.api.conftest import ServedBench
from tests.unit.scan.fakes import WAIT_S

BOARD = {"kind": "chessboard", "corners": [4, 3], "square_mm": 10.0}
ORDER: dict[str, Any] = {
    "cron": "30 6 * * mon-fri",
    "time_zone": "Europe/Berlin",
    "task": "verification",
    "options": {"board": BOARD},
}


@pytest.fixture(autouse=True)
def emptied(client: TestClient) -> Iterator[None]:
    yield
    for each in client.get("/schedule").json()["schedules"]:
        assert client.delete(each["links"]["self"]).status_code == 204


def added(client: TestClient, **more: Any) -> dict[str, Any]:
    response = client.post("/schedule", json={**ORDER, **more})
    assert response.status_code == 201, response.text
    made: dict[str, Any] = response.json()
    assert response.headers["location"] == f"/schedule/{made['id']}"
    return made


def opened(client: TestClient) -> None:
    """Wait until the rig is open: what it can do is known from then on."""
    deadline_s = time.monotonic() + WAIT_S
    while not client.get("/rig").json()["open"]:
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def test_schedule_is_added_shown_and_listed_with_its_next_five_times(client: TestClient) -> None:
    made = added(client, options={"board": BOARD}, label="mornings")
    times = [datetime.fromisoformat(each) for each in made["upcoming"]]
    assert len(times) == 5
    assert times == sorted(times)
    assert times[0] > datetime.now(UTC)
    assert all((each.hour, each.minute) == (6, 30) and each.weekday() < 5 for each in times)
    assert (made["grace_s"], made["retry_s"], made["catch_up"], made["enabled"]) == (3600, 60, True, True)
    assert client.get(made["links"]["self"]).json() == made
    second = added(client, label="paused", enabled=False)
    assert [each["id"] for each in client.get("/schedule").json()["schedules"]] == [made["id"], second["id"]]
    assert second["enabled"] is False
    assert client.get(made["links"]["runs"]).json() == {"runs": [], "next": None}


def test_schedule_is_paused_resumed_and_removed(client: TestClient) -> None:
    made = added(client)
    for _ in range(2):
        assert client.post(made["links"]["pause"]).json()["enabled"] is False
    for _ in range(2):
        assert client.post(made["links"]["resume"]).json()["enabled"] is True
    assert client.delete(made["links"]["self"]).status_code == 204
    for method, path in (
        ("GET", ""), ("GET", "/runs"), ("POST", "/run"), ("POST", "/pause"), ("POST", "/resume"), ("POST", "/cancel"),
        ("DELETE", ""),
    ):  # fmt: skip
        response = client.request(method, f"{made['links']['self']}{path}")
        assert (response.status_code, response.json()["type"]) == (404, "/problems/schedule-not-found"), path


def test_runs_are_listed_page_by_page(client: TestClient, served: ServedBench) -> None:
    made = added(client, enabled=False)
    schedules, (schedule,) = served.service.schedules, served.service.schedules.all()
    schedules.enable(schedule.id, enabled=True)
    later = datetime.now(UTC)
    for _ in range(3):
        # Days on which nobody was there, each later than its grace.
        later += timedelta(days=7)
        schedules.record_due(later + timedelta(hours=5))
    schedules.enable(schedule.id, enabled=False)
    whole = client.get(made["links"]["runs"]).json()["runs"]
    assert len(whole) >= 3
    first = client.get(f"{made['links']['runs']}?limit=2").json()
    assert first["runs"] == whole[:2]
    assert {each["due"][-15:] for each in whole} <= {"T06:30:00+01:00", "T06:30:00+02:00"}
    second = client.get(first["next"]).json()
    assert second["runs"] == whole[2:4]
    assert sum(each["count"] for each in whole) >= 10
    states = {each["state"] for each in whole}
    figures = client.get("/metrics").text
    for state in states:
        count = sum(each["count"] for each in whole if each["state"] == state)
        assert f'slrig_scheduled_runs{{state="{state}",task="verification"}} {count:.1f}' in figures


@pytest.mark.parametrize(
    ("request_body", "words"),
    [
        ({"cron": "30 6 * *  "}, "cron: expected five fields (minute, hour"),
        ({"cron": "61 6 * * *"}, "cron: Bad minute"),
        ({"cron": "0 0 30 2 *"}, "cron: Bad day-of-month"),
        ({"time_zone": "Europe/Atlantis"}, "time_zone: expected a name of the IANA database"),
        ({"options": {"bord": BOARD}}, "bord: unknown key; did you mean 'board'?"),
        ({"options": {"colour": 1}}, "The options of verification are: board, position, exposure_s"),
        ({"task": "calibration", "options": {}}, "board: missing"),
        ({"options": {}}, "which board is in view is not known: no calibration that was made here is in use"),
        ({"task": "calibration"}, "this rig has no positioner"),
        ({"task": "acceptance", "options": {}}, "this rig has no positioner"),
        ({"options": {"board": {**BOARD, "square_mm": -1}}}, "square_mm"),
    ],
)
def test_schedule_that_cannot_be_kept_is_refused_in_words(
    client: TestClient, request_body: dict[str, Any], words: str
) -> None:
    opened(client)
    response = client.post("/schedule", json={**ORDER, **request_body})
    assert response.status_code == 422
    assert response.json()["type"] == "/problems/schedule"
    assert words in response.json()["detail"]
    assert client.get("/schedule").json() == {"schedules": []}


@pytest.mark.parametrize(
    ("request_body", "field"),
    [
        ({"task": "dance"}, "task"),
        ({"grace_s": -1}, "grace_s"),
        ({"retry_s": 0.5}, "retry_s"),
        ({"crone": "* * * * *"}, "crone"),
        ({"enabled": "yes"}, "enabled"),
    ],
)
def test_request_that_is_malformed_is_told_by_field(
    client: TestClient, request_body: dict[str, Any], field: str
) -> None:
    response = client.post("/schedule", json={**ORDER, **request_body})
    assert response.status_code == 422
    assert [each["field"] for each in response.json()["errors"]] == [field]


def test_cancel_without_a_run_is_refused(client: TestClient) -> None:
    made = added(client)
    response = client.post(f"{made['links']['self']}/cancel")
    assert (response.status_code, response.json()["type"]) == (409, "/problems/scan-state")
    assert "no run under way" in response.json()["detail"]


def test_paused_schedule_runs_now_and_tells_what_became_of_it(client: TestClient) -> None:
    opened(client)
    made = added(client, enabled=False)
    begun = client.post(made["links"]["run"])
    assert begun.status_code == 202, begun.text
    run = begun.json()
    assert (run["state"], run["reason"], run["count"]) == ("waiting", "asked for by a person, not by the clock", 1)
    assert abs(datetime.fromisoformat(run["due"]) - datetime.now(UTC)) < timedelta(seconds=WAIT_S)
    deadline_s = time.monotonic() + WAIT_S
    while (found := client.get(made["links"]["runs"]).json()["runs"])[0]["state"] != "failed":
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    assert [each["number"] for each in found] == [run["number"]]
    assert "The rig has no calibration that could be verified" in found[0]["reason"]
    assert client.get(made["links"]["self"]).json()["enabled"] is False


def test_metrics_tell_what_the_service_is_at(client: TestClient, served: ServedBench) -> None:
    made = added(client)
    served.held(client)
    response = client.get("/metrics")
    assert response.headers["content-type"].startswith("text/plain; version=0.0.4")
    lines = response.text.splitlines()
    assert 'slrig_scans{state="capturing"} 1.0' in lines
    assert "slrig_rig_held 1.0" in lines
    assert "slrig_rig_open 1.0" in lines
    assert 'slrig_rig_health{state="unknown"} 1.0' in lines
    due = datetime.fromisoformat(made["upcoming"][0]).timestamp()
    (line,) = (each for each in lines if each.startswith("slrig_schedule_next_due_timestamp_seconds{"))
    assert made["id"] in line
    assert float(line.rsplit(" ", 1)[1]) == due
    client.post(made["links"]["pause"])
    assert "slrig_schedule_next_due_timestamp_seconds{" not in client.get("/metrics").text
    for state in RunState:
        assert f'slrig_scheduled_runs{{state="{state}",task="acceptance"}} 0.0' in lines


def test_metrics_tell_the_calibration_in_use(client: TestClient, served: ServedBench) -> None:
    assert "slrig_calibration_age_seconds" not in client.get("/metrics").text.replace("# ", "")
    calibrations = served.service.calibrations
    path = served.service.folder.root / "given.json"
    write_calibration(path, served.tame.calibration)
    imported = calibrations.submit(path.read_bytes(), ".json")
    calibrations.activate(imported.id)
    lines = client.get("/metrics").text.splitlines()
    calibrations.deactivate(imported.id)
    assert "slrig_calibration_expected_error_millimetres 0.02" in lines
    (age,) = (each for each in lines if each.startswith("slrig_calibration_age_seconds "))
    solved = datetime.fromisoformat("2026-11-21T11:00:00+00:00")
    assert float(age.split()[1]) == pytest.approx((datetime.now(UTC) - solved).total_seconds(), abs=60)


def test_metrics_need_the_key(client: TestClient) -> None:
    assert client.get("/metrics", headers={"Authorization": "Bearer another key"}).status_code == 401

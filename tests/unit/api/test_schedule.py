"""/schedule with its metrics, and `slrig schedule`, whose requests reach the same service."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import pytest
from fastapi.testclient import TestClient
from typer.testing import Result

from slrig.bundle.calibration import write_calibration
from slrig.errors import PoseRefusedError
from slrig.schedule.scheduler import Stop
from slrig.schedule.store import RunState
from tests.unit import command
from tests.unit.api.conftest import ServedBench, refusal
from tests.unit.command import refused, slrig
from tests.unit.scan.fakes import WAIT_S

BOARD = {"kind": "chessboard", "corners": [4, 3], "square_mm": 10.0}
ORDER: dict[str, Any] = {
    "cron": "30 6 * * mon-fri",
    "time_zone": "Europe/Berlin",
    "task": "verification",
    "options": {"board": BOARD},
}
NIGHTLY = ("add", "0 2 * * *", "verification", "--option", f"board={json.dumps(BOARD)}")


@pytest.fixture(autouse=True)
def emptied(client: TestClient, commands: None) -> Iterator[None]:
    """Afterwards no schedule is left."""
    del commands
    yield
    for each in kept(client):
        assert client.delete(each["links"]["self"]).status_code == 204


def kept(client: TestClient) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get("/schedule").json()["schedules"]
    return found


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
        threading.Event().wait(0.01)


def run(*arguments: str) -> Result:
    return slrig("schedule", *arguments)


def done(*arguments: str) -> str:
    return command.done("schedule", *arguments)


def test_schedule_is_added_with_its_next_five_times(client: TestClient) -> None:
    made = added(client, label="mornings")
    times = [datetime.fromisoformat(each) for each in made["upcoming"]]
    assert len(times) == 5
    assert times == sorted(times)
    assert times[0] > datetime.now(UTC)
    assert all((each.hour, each.minute) == (6, 30) and each.weekday() < 5 for each in times)
    assert (made["grace_s"], made["retry_s"], made["catch_up"], made["enabled"]) == (3600, 60, True, True)
    assert client.get(made["links"]["self"]).json() == made
    assert client.get(made["links"]["runs"]).json() == {"runs": [], "next": None}


def test_removed_schedule_is_not_found(client: TestClient) -> None:
    here = added(client)["links"]["self"]
    assert client.delete(here).status_code == 204
    for method, path in (
        ("GET", ""), ("GET", "/runs"), ("POST", "/run"), ("POST", "/pause"), ("POST", "/resume"), ("POST", "/cancel"),
        ("DELETE", ""),
    ):  # fmt: skip
        assert refusal(client, method, f"{here}{path}") == (404, "/problems/schedule-not-found"), path


def test_runs_are_listed_on_pages_and_counted(client: TestClient, served: ServedBench) -> None:
    made = added(client, enabled=False)
    schedules, (schedule,) = served.service.schedules, served.service.schedules.all()
    schedules.enable(schedule.id, enabled=True)
    later = datetime.now(UTC)
    for _ in range(3):
        # Days without a service, each later than its grace.
        later += timedelta(days=7)
        schedules.record_due(later + timedelta(hours=5))
    schedules.enable(schedule.id, enabled=False)
    whole = client.get(made["links"]["runs"]).json()["runs"]
    assert len(whole) >= 3
    first = client.get(f"{made['links']['runs']}?limit=2").json()
    assert first["runs"] == whole[:2]
    assert client.get(first["next"]).json()["runs"] == whole[2:4]
    assert {each["due"][-15:] for each in whole} <= {"T06:30:00+01:00", "T06:30:00+02:00"}
    assert sum(each["count"] for each in whole) >= 10
    figures = client.get("/metrics").text
    for state in {each["state"] for each in whole}:
        count = sum(each["count"] for each in whole if each["state"] == state)
        assert f'slrig_scheduled_runs{{state="{state}",task="verification"}} {count:.1f}' in figures
    heads, *rows = done("runs", made["id"][:8]).splitlines()
    assert heads.startswith("due (Europe/Berlin)")
    assert len(rows) >= len(whole)
    assert all(" 06:30  " in row for row in rows if row[:3] in {"Mon", "Tue", "Wed", "Thu", "Fri"})


@pytest.mark.parametrize(
    ("request_body", "words"),
    [
        ({"cron": "30 6 * *  "}, "cron: expected five fields (minute, hour"),
        ({"time_zone": "Europe/Atlantis"}, "time_zone: expected a name of the IANA database"),
        ({"options": {"bord": BOARD}}, "bord: unknown key; did you mean 'board'?"),
        ({"options": {}}, "which board is in view is not known: no calibration that was made here is in use"),
        ({"task": "calibration"}, "this rig has no positioner"),
    ],
)
def test_schedule_that_makes_no_sense_is_refused(client: TestClient, request_body: dict[str, Any], words: str) -> None:
    opened(client)
    response = client.post("/schedule", json={**ORDER, **request_body})
    assert (response.status_code, response.json()["type"]) == (422, "/problems/schedule")
    assert words in response.json()["detail"]
    assert kept(client) == []


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
def test_bad_field_of_a_schedule_is_named(client: TestClient, request_body: dict[str, Any], field: str) -> None:
    response = client.post("/schedule", json={**ORDER, **request_body})
    assert response.status_code == 422
    assert [each["field"] for each in response.json()["errors"]] == [field]


def test_paused_schedule_runs_on_request(client: TestClient, served: ServedBench) -> None:
    opened(client)
    served.error = PoseRefusedError("The board is not in view.")
    made = added(client, enabled=False)
    begun = client.post(made["links"]["run"])
    assert begun.status_code == 202, begun.text
    first = begun.json()
    assert (first["state"], first["reason"], first["count"]) == (
        "waiting", "requested by a person, not by the clock", 1
    )  # fmt: skip
    deadline_s = time.monotonic() + WAIT_S
    while (found := client.get(made["links"]["runs"]).json()["runs"])[0]["state"] != "failed":
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.01)
    assert [each["number"] for each in found] == [first["number"]]
    assert "The board is not in view." in found[0]["reason"]
    assert client.get(made["links"]["self"]).json()["enabled"] is False


def test_scan_is_made_by_the_clock(client: TestClient) -> None:
    wrong = {**ORDER, "task": "scan", "options": {"preset": "none-such"}}
    assert refusal(client, "POST", "/schedule", json=wrong) == (422, "/problems/schedule")
    links = added(client, task="scan", options={"label": "by the clock"})["links"]
    assert client.post(links["run"]).status_code == 202
    deadline_s = time.monotonic() + WAIT_S
    while (run := client.get(links["runs"]).json()["runs"][0])["state"] in {"waiting", "running"}:
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.01)
    assert run["state"] == "succeeded", run
    assert client.get(f"/scan/{run['result']['scan']}").json()["label"] == "by the clock"


def test_metrics_show_scans_schedules_and_the_calibration(client: TestClient, served: ServedBench) -> None:
    made = added(client)
    served.held(client)
    calibrations = served.service.calibrations
    path = served.service.folder.root / "given.json"
    own = served.tame.calibration
    assert own.solved is not None
    write_calibration(path, replace(own, solved=replace(own.solved, expected_error_mm=0.03)))
    imported = calibrations.submit(path.read_bytes(), ".json")
    calibrations.activate(imported.id)
    response = client.get("/metrics")
    calibrations.deactivate(imported.id)
    calibrations.delete(imported.id)
    assert response.headers["content-type"].startswith("text/plain; version=0.0.4")
    lines = response.text.splitlines()
    for line in (
        'slrig_scans{state="capturing"} 1.0', "slrig_rig_held 1.0", "slrig_rig_open 1.0",
        'slrig_rig_health{state="unknown"} 1.0', "slrig_calibration_expected_error_millimetres 0.03",
    ):  # fmt: skip
        assert line in lines
    (age,) = (each for each in lines if each.startswith("slrig_calibration_age_seconds "))
    solved = datetime.fromisoformat("2026-11-21T11:00:00+00:00")
    assert float(age.split()[1]) == pytest.approx((datetime.now(UTC) - solved).total_seconds(), abs=60)
    due = datetime.fromisoformat(made["upcoming"][0]).timestamp()
    (line,) = (each for each in lines if each.startswith("slrig_schedule_next_due_timestamp_seconds{"))
    assert made["id"] in line
    assert float(line.rsplit(" ", 1)[1]) == due
    for state in RunState:
        assert f'slrig_scheduled_runs{{state="{state}",task="acceptance"}} 0.0' in lines
    client.post(made["links"]["pause"])
    assert "slrig_schedule_next_due_timestamp_seconds{" not in client.get("/metrics").text


def test_command_adds_and_lists_schedules_in_their_time_zones(client: TestClient) -> None:
    assert done("list") == "no schedules; add one with: slrig schedule add '30 6 * * mon-fri' verification\n"
    head, *times = done("add", "30 6 * * mon", *NIGHTLY[2:], "--time-zone", "Asia/Tokyo").splitlines()
    (first,) = kept(client)
    assert head == f"{first['id']}: verification at '30 6 * * mon' in Asia/Tokyo"
    assert len(times) == 5
    assert all(line.startswith("  Mon ") and line.endswith(" 06:30 +0900") for line in times)
    more = ("--label", "nights", "--grace-s", "600", "--retry-s", "30", "--no-catch-up", "--paused", "--json")
    second = json.loads(done(*NIGHTLY, "--option", "exposure_s=0.5", *more))
    assert kept(client) == [first, second]
    assert (second["label"], second["grace_s"], second["retry_s"]) == ("nights", 600, 30)
    assert (second["catch_up"], second["enabled"]) == (False, False)
    assert second["options"]["board"]["corners"] == [4, 3]
    assert second["options"]["exposure_s"] == 0.5
    heads, running, paused = done("list").splitlines()
    assert heads.split() == ["id", "task", "when", "next", "label"]
    assert re.search(r"30 6 \* \* mon  Mon \d{4}-\d\d-\d\d 06:30  Asia/Tokyo", running)
    assert paused.split()[:2] == [second["id"][:8], "verification"]
    assert re.search(r"paused  UTC +nights$", paused)
    assert json.loads(done("list", "--json"))["schedules"] == [first, second]


def test_command_pauses_resumes_cancels_and_removes(
    client: TestClient, served: ServedBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = json.loads(done(*NIGHTLY, "--json"))
    beginning = made["id"][:8]
    assert done("runs", beginning) == "nothing was due yet\n"
    assert json.loads(done("runs", beginning, "--json"))["runs"] == []
    assert done("pause", beginning) == "paused\n"
    assert f"{made['id']}: verification at '0 2 * * *' in UTC\n" in done("resume", beginning)
    assert "has no run under way" in refused(run("cancel", beginning))
    stop = Stop()
    # As a run under way leaves it there.
    monkeypatch.setitem(served.service.tasks._stops, UUID(made["id"]), stop)
    assert done("cancel", beginning) == "the end of the run was requested\n"
    assert stop._requested
    assert kept(client) == [made]
    assert f"there are: {beginning}" in refused(run("pause", "zzz"))
    assert done("remove", beginning) == "removed\n"
    assert kept(client) == []


def test_command_shows_why_it_is_refused(client: TestClient) -> None:
    opened(client)
    for arguments, words in (
        (("add", "30 6 * * *", "verification", "--option", "colour=red"), "colour: unknown key"),
        (("add", "30 6 * * *", "verification", "--option", "colour"), "expected name=value, found 'colour'"),
        (("add", "30 6 * * *", "verification"), 'the option "board", as {"kind": "charuco", "corners": [11, 8]'),
        (("runs", "3f2a"), "'3f2a' is the beginning of no schedule's id; there are: none"),
    ):
        assert words in refused(run(*arguments)), arguments

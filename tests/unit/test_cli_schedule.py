"""`slrig schedule` against a service over a tame bench: the requests it sends are those that the service takes."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any, cast
from uuid import UUID

import httpx2
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from typer.testing import CliRunner, Result

from slrig.cli.commands import app
from slrig.cli.options import Service
from slrig.client import Client
from tests.unit.api.conftest import KEY, ServedBench
from tests.unit.calibrate_command import refused

BOARD = 'board={"kind": "chessboard", "corners": [4, 3], "square_mm": 10.0}'
OPTION = ("--option", BOARD)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    bench = ServedBench(tmp_path_factory.mktemp("data"))
    headers = {"Authorization": f"Bearer {KEY}"}
    with TestClient(bench.app, base_url="http://127.0.0.1", headers=headers) as client:
        yield client


@pytest.fixture(autouse=True)
def reached(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def forward(request: httpx2.Request) -> httpx2.Response:
        told = service.request(
            request.method, request.url.raw_path.decode(), content=request.read(), headers=dict(request.headers)
        )
        kept = {"content-type": told.headers.get("content-type", "")}
        return httpx2.Response(told.status_code, content=told.content, headers=kept)

    def client(_service: Service) -> Client:
        return Client("http://127.0.0.1:1", KEY, transport=httpx2.MockTransport(forward))

    monkeypatch.setattr(Service, "client", client)
    yield
    for each in kept(service):
        service.delete(each["links"]["self"])


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["schedule", *arguments])


def done(*arguments: str) -> str:
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def kept(service: TestClient) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = service.get("/schedule").json()["schedules"]
    return found


def test_add_shows_the_next_five_times(service: TestClient) -> None:
    told = done("add", "30 6 * * mon", "verification", "--time-zone", "Europe/Berlin", "--option", BOARD).splitlines()
    (made,) = kept(service)
    assert told[0] == f"{made['id']}: verification at '30 6 * * mon' in Europe/Berlin"
    assert len(told) == 6
    assert all(line.startswith("  Mon ") and " 06:30 +0" in line for line in told[1:])
    assert made["options"]["board"]["corners"] == [4, 3]


def test_options_reach_the_service(service: TestClient) -> None:
    more = ("--label", "nights", "--grace-s", "600", "--retry-s", "30", "--no-catch-up", "--paused", "--json")
    made = json.loads(done("add", "0 2 * * *", "verification", *OPTION, "--option", "exposure_s=0.5", *more))
    assert kept(service) == [made]
    assert (made["label"], made["grace_s"], made["retry_s"]) == ("nights", 600, 30)
    assert (made["catch_up"], made["enabled"], made["options"]["exposure_s"]) == (False, False, 0.5)


def test_list_runs_pause_resume_and_remove(service: TestClient) -> None:
    assert done("list") == "no schedules; add one with: slrig schedule add '30 6 * * mon-fri' verification\n"
    made = json.loads(done("add", "0 2 * * *", "verification", *OPTION, "--label", "nights", "--json"))
    beginning = made["id"][:8]
    heads, row = done("list").splitlines()
    assert heads.split() == ["id", "task", "when", "next", "label"]
    assert row.split()[:2] == [beginning, "verification"]
    assert row.endswith("nights")
    assert json.loads(done("list", "--json"))["schedules"] == [made]
    assert done("runs", beginning) == "nothing was due yet\n"
    assert json.loads(done("runs", beginning, "--json"))["runs"] == []
    assert done("pause", beginning) == "paused\n"
    assert "paused" in done("list").splitlines()[1]
    assert f"{made['id']}: verification at '0 2 * * *' in UTC\n" in done("resume", beginning)
    assert done("remove", beginning) == "removed\n"
    assert kept(service) == []


def test_times_are_those_of_the_schedules_own_zone(service: TestClient) -> None:
    done("add", "30 6 * * *", "verification", *OPTION, "--time-zone", "Asia/Tokyo")
    done("add", "30 6 * * *", "verification", *OPTION, "--time-zone", "America/Lima", "--paused")
    _, running, paused = done("list").splitlines()
    assert re.search(r"30 6 \* \* \*  \w{3} \d{4}-\d\d-\d\d 06:30  Asia/Tokyo", running)
    assert "paused  America/Lima" in paused
    schedules = cast("FastAPI", service.app).state.service.schedules
    schedules.record_due(datetime.now(UTC) + timedelta(days=3))
    (tokyo, _) = kept(service)
    heads, *rows = done("runs", tokyo["id"][:8]).splitlines()
    assert heads.startswith("due (Asia/Tokyo)")
    assert rows
    assert all(" 06:30  " in row for row in rows if row.startswith(("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")))


def test_verification_without_a_board_is_refused_with_what_to_do(service: TestClient) -> None:
    told = refused(run("add", "30 6 * * mon-fri", "verification"))
    assert "which board is in view is not known: no calibration that was made here is in use" in told
    assert 'the option "board", as {"kind": "charuco", "corners": [11, 8], "square_mm": 12}' in told
    assert kept(service) == []


def test_cancel_ends_the_run_and_leaves_the_schedule(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    made = json.loads(done("add", "0 2 * * *", "verification", *OPTION, "--json"))
    assert "has no run under way" in refused(run("cancel", made["id"][:8]))
    stopped = threading.Event()
    # As a run under way leaves it there.
    tasks = cast("FastAPI", service.app).state.service.tasks
    monkeypatch.setitem(tasks._stops, UUID(made["id"]), stopped)
    assert done("cancel", made["id"][:8]) == "the run was asked to end\n"
    assert stopped.is_set()
    assert kept(service) == [made]


def test_what_cannot_be_is_refused_in_words() -> None:
    for arguments, words in (
        (("add", "30 6", "verification"), "cron"),
        (("add", "99 6 * * *", "verification"), "cron: Bad minute"),
        (("add", "30 6 * * *", "dance"), "task"),
        (("add", "30 6 * * *", "verification", "--option", "colour=red"), "colour: unknown key"),
        (("add", "30 6 * * *", "verification", "--option", "colour"), "expected name=value, found 'colour'"),
        (("runs", "3f2a"), "'3f2a' is the beginning of no schedule's id; there are: none"),
    ):
        result = run(*arguments)
        assert result.exit_code != 0, arguments
        assert words in result.stderr, (arguments, result.stderr)
        assert "Traceback" not in result.stderr


def test_beginning_that_is_not_known_lists_those_that_are(service: TestClient) -> None:
    done("add", "0 2 * * *", "verification", *OPTION)
    (made,) = kept(service)
    assert f"there are: {made['id'][:8]}" in refused(run("pause", "zzz"))

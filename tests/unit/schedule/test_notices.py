"""Notices: what is sent to the webhook, and what never stands in anybody's way."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
import structlog

from slrig.config import ServiceSettings, read_settings
from slrig.errors import ConfigError
from slrig.jobs.database import Database
from slrig.schedule.notices import TOLD, NoticedHealth, Notices
from slrig.schedule.records import Cron, Order, Run, RunState, Schedule, TaskKind
from tests.unit.scan.fakes import WAIT_S
from tests.unit.verify.health_bench import a_verification, hours

DUE = datetime(2026, 11, 23, 5, 30, tzinfo=UTC)
SCHEDULE = Schedule(UUID(int=7), Order(Cron("30 6 * * *", "Europe/Berlin"), TaskKind.VERIFICATION), DUE, DUE)


class Hook:
    """A web server on this machine that keeps what is sent. While `gate` is clear it does not answer."""

    def __init__(self) -> None:
        self.status = 204
        self.gate = threading.Event()
        self.gate.set()
        self.came: queue.Queue[dict[str, Any]] = queue.Queue()
        hook = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                hook.came.put({"path": self.path, **json.loads(body)})
                hook.gate.wait(WAIT_S)
                self.send_response(hook.status)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                return

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook/secret"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self.gate.set()
        self.server.shutdown()
        self.server.server_close()


@pytest.fixture
def hook() -> Iterator[Hook]:
    made = Hook()
    yield made
    made.close()


def run(state: RunState, *, count: int = 1) -> Run:
    return Run(4, SCHEDULE.id, DUE, state, "rig busy: a scan", count, 1, DUE, None, None, None, None)


def test_runs_that_a_person_has_to_know_of_are_sent_and_no_others(hook: Hook) -> None:
    notices = Notices(hook.url, rig="bench", clock=lambda: DUE)
    for state in RunState:
        notices.run(SCHEDULE, run(state, count=3))
    sent = [hook.came.get(timeout=WAIT_S) for _ in TOLD]
    notices.close()
    assert hook.came.empty()
    assert {each["kind"] for each in sent} == {"run.missed", "run.skipped", "run.failed", "run.interrupted"}
    skipped = next(each for each in sent if each["kind"] == "run.skipped")
    assert skipped["path"] == "/hook/secret"
    assert skipped["words"] == (
        "rig 'bench': verification due 2026-11-23 06:30 +0100 was skipped, 3 times: rig busy: a scan"
    )
    assert skipped["run"] == {
        "number": 4, "due": DUE.isoformat(), "state": "skipped", "reason": "rig busy: a scan", "count": 3,
    }  # fmt: skip
    assert skipped["schedule"]["id"] == str(SCHEDULE.id)
    assert skipped["at"] == DUE.isoformat()


def test_health_is_told_when_it_changes(hook: Hook, tmp_path: Path) -> None:
    notices = Notices(hook.url, rig="bench")
    health = NoticedHealth(Database(tmp_path / "slrig.sqlite"), notices)
    for hour, look in enumerate(
        [a_verification(), a_verification(), a_verification(6.0, evidence=400.0), a_verification(6.0, evidence=400.0)]
    ):
        health.add(look, calibration="one", at=hours(hour))
    health.add(a_verification(), calibration="two", at=hours(9))
    first, second = (hook.came.get(timeout=WAIT_S) for _ in range(2))
    notices.close()
    health.database.close()
    assert hook.came.empty()
    assert (first["kind"], first["health"]["before"], first["health"]["state"]) == ("health.changed", "good", "stale")
    assert "turned by 0.050" in first["words"]
    assert (second["health"]["before"], second["health"]["state"]) == ("stale", "good")


def test_hook_that_refuses_or_is_gone_is_in_the_log_and_in_nobodys_way(hook: Hook) -> None:
    hook.status = 500
    with structlog.testing.capture_logs() as log:
        notices = Notices(hook.url, rig="bench")
        notices.run(SCHEDULE, run(RunState.FAILED))
        hook.came.get(timeout=WAIT_S)
        notices.close()
        hook.close()
        notices = Notices(hook.url, rig="bench")
        notices.run(SCHEDULE, run(RunState.FAILED))
        notices.close()
        notices.close()
    assert [(each["event"], each["host"]) for each in log] == [
        ("a notice was refused", "127.0.0.1"),
        ("a notice was not delivered", "127.0.0.1"),
    ]
    assert "secret" not in str(log)


def test_hook_that_does_not_answer_holds_nobody_up_and_fills_no_memory(hook: Hook) -> None:
    hook.gate.clear()
    with structlog.testing.capture_logs() as log:
        notices = Notices(hook.url, rig="bench", most=2)
        notices.run(SCHEDULE, run(RunState.FAILED))
        hook.came.get(timeout=WAIT_S)
        for _ in range(5):
            notices.run(SCHEDULE, run(RunState.MISSED))
        notices.close()
    assert [each["event"] for each in log] == ["a notice was dropped: too many wait"] * 3


def test_nothing_is_sent_by_default() -> None:
    assert ServiceSettings().webhook_url is None
    before = threading.active_count()
    notices = Notices(None, rig="bench")
    notices.run(SCHEDULE, run(RunState.FAILED))
    notices.close()
    assert threading.active_count() == before


@pytest.mark.parametrize("url", ["ftp://host/hook", "host/hook", "http:///hook"])
def test_address_that_is_none_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(ConfigError, match="webhook_url: expected an address that begins with http") as error:
        read_settings(webhook_url=url)
    assert url not in str(error.value)

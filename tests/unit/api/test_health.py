"""/rig/health over HTTP: the verdict, the history, the plot, and a verification from beginning to end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from fastapi.testclient import TestClient

from slrig.api import health
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.keys import RequestKeys
from slrig.jobs.records import JobKind
from slrig.jobs.store import JobStore
from slrig.verify.job import VerificationDesk
from slrig.verify.store import HealthStore
from tests.unit.api.conftest import app_of
from tests.unit.jobs.tame_queue import TameQueue
from tests.unit.verify.test_verification import TAME, queue_of

BOARD = {"kind": "chessboard", "corners": [11, 8], "square_mm": 12.0}


@pytest.fixture
def queue() -> TameQueue:
    return queue_of()


@pytest.fixture
def client(tmp_path: Path, queue: TameQueue) -> Iterator[TestClient]:
    folder = DataFolder(tmp_path / "data")
    store = HealthStore(Database(folder.database))
    desk = VerificationDesk(folder, queue, store, JobStore(store.database, JobKind.VERIFICATION), tools=TAME)
    service = SimpleNamespace(
        folder=folder, verifications=desk, keys=RequestKeys(store.database), refuse_when_stale=True,
        calibrations=SimpleNamespace(active=None),
    )  # fmt: skip
    with TestClient(app_of(health.router, service)) as found:
        yield found
    store.database.close()
    folder.release()


def test_a_verification_changes_the_health(client: TestClient) -> None:
    before = client.get("/rig/health").json()
    assert before["state"] == "unknown"
    assert before["calibration"] == "0123456789ab"
    assert before["refuses_scans_when_stale"] is True
    told = {"watch_mean_px": 0.1, "stale_mean_px": 0.3, "watch_error_ratio": 1.4, "stale_error_ratio": 3.0}
    assert before["thresholds"].items() >= told.items()
    answer = client.post("/rig/verification", json={"board": BOARD}, headers={"Idempotency-Key": "k"})
    assert answer.status_code == 202
    again = client.post("/rig/verification", json={"board": BOARD}, headers={"Idempotency-Key": "k"})
    assert again.json() == answer.json()
    place = answer.headers["Location"]
    deadline = time.monotonic() + 20
    while client.get(place).json()["state"] not in ("succeeded", "failed"):
        assert time.monotonic() < deadline
    found = client.get(place).json()
    assert found["state"] == "succeeded"
    after = client.get("/rig/health").json()
    assert after["state"] == "good"
    assert after["latest"] == found["found"]
    assert after["latest"]["pairs"][0]["map_mean_px"][0][0] == 0.01
    (kept,) = client.get("/rig/health/history").json()["verifications"]
    assert kept == found["found"]
    assert client.get("/rig/health/history", params={"since": "2100-01-01T00:00:00Z"}).json()["verifications"] == []
    plot = client.get("/rig/health.svg")
    assert plot.headers["content-type"].startswith("image/svg+xml")
    assert "Expected error of a scan" in plot.text


def test_a_busy_rig_names_its_holder(client: TestClient, queue: TameQueue) -> None:
    queue.busy = "schedule 'nightly'"
    answer = client.post("/rig/verification", json={"board": BOARD})
    assert answer.status_code == 409
    assert "schedule 'nightly'" in answer.json()["detail"]


def test_missing_board_and_unknown_verification_are_refused(client: TestClient) -> None:
    no_board = client.post("/rig/verification")
    assert no_board.status_code == 422
    assert 'send "board"' in no_board.json()["detail"]
    assert client.get("/rig/health/history", params={"since": "2026-01-01T00:00:00"}).status_code == 422
    nobody = client.get("/rig/verification/00000000-0000-0000-0000-000000000000")
    assert nobody.status_code == 404

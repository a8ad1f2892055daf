"""/acceptance over a tame rig: opened, measured, refused, fetched."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from fastapi.testclient import TestClient

from slrig.accept.asking import AcceptanceRequest
from slrig.accept.desk import AcceptanceDesk
from slrig.api import acceptance as router_module
from slrig.jobs.keys import RequestKeys
from tests.unit.accept.test_desk import PLAN, desk, desks, queue
from tests.unit.api.conftest import app_of
from tests.unit.jobs.tame_queue import TameQueue

__all__ = ["desk", "desks", "queue"]

EXACT = {
    "sphere": {"value_mm": 30, "uncertainty_mm": 0.001},
    "bar": {"value_mm": 110, "uncertainty_mm": 0.002},
    "plane_mm": [160, 110],
    "sphere_form_mm": 0.001,
    "plane_form_mm": 0.002,
}
VOLUME = [[-100, -75, -40], [100, 75, 40]]


@pytest.fixture
def client(desk: AcceptanceDesk) -> TestClient:
    keys, folder = RequestKeys(desk.jobs.database), SimpleNamespace(require_present=lambda: None)
    service = SimpleNamespace(acceptance=desk, keys=keys, folder=folder)
    return TestClient(app_of(router_module.router, service))


def test_positions_are_measured_to_the_end_and_the_report_is_fetched(
    client: TestClient, desk: AcceptanceDesk, tmp_path: Path
) -> None:
    answer = client.post("/acceptance", json={"artefacts": EXACT, "volume_mm": VOLUME, "repeats": 2})
    body = answer.json()
    assert (answer.status_code, client.get(answer.headers["location"]).json()) == (201, body)
    assert (body["captures"], body["captures_done"], body["state"]) == (26, 0, "open")
    assert body["next"]["words"] == "Put the sphere in the middle of the volume."
    assert len(body["positions"]) == 23
    test = desk.open(lambda *_: PLAN)
    path = f"/acceptance/{test.id}"
    early = client.get(f"{path}/report.json")
    assert (early.status_code, early.json()["type"]) == (409, "/problems/artefact-not-ready")
    measured = client.post(f"{path}/position").json()
    assert measured["captures_done"] == PLAN.repeats
    assert set(measured["readings"][0]["errors_mm"]) == {"PF", "PS"}
    client.post(f"{path}/position", json={"scripted": True})
    body = client.get(path).json()
    assert (body["state"], body["decision"], body["next"]) == ("finished", "passes", None)
    assert client.get(body["files"]["report.json"]).json()["decision"] == "passes"
    assert "No conformity" in client.get(body["files"]["report.html"]).text
    assert client.post(f"{path}/position").status_code == 409
    first, second = client.get("/acceptance").json()["tests"]
    assert (first["id"], first["decision"], second["decision"]) == (str(test.id), "passes", None)
    assert client.get("/acceptance?limit=1").json()["tests"] == [first]
    assert (tmp_path / "acceptance" / str(test.id) / "points").is_dir()
    assert client.delete(path).status_code == 204
    assert client.get(path).status_code == 404


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"artefacts": {**EXACT, "sphere": {"value_mm": 3, "uncertainty_mm": 0}}}, "expected a diameter of"),
        ({"artefacts": {**EXACT, "sphere": {"value_mm": 30}}}, "uncertainty_mm"),
        ({"artefacts": EXACT, "volume_mm": VOLUME[::-1]}, "least corner"),
        ({"repeats": 0}, "repeats"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_bad_request_for_a_test_is_refused(client: TestClient, body: dict[str, object], words: str) -> None:
    answer = client.post("/acceptance", json={"volume_mm": VOLUME, **body})
    assert answer.status_code == 422
    assert words in answer.text


def test_held_rig_answers_409_and_an_unknown_test_404(
    client: TestClient, desk: AcceptanceDesk, queue: TameQueue
) -> None:
    test = desk.open(lambda *_: PLAN)
    queue.busy = "1"
    answer = client.post(f"/acceptance/{test.id}/position")
    assert (answer.status_code, answer.json()["holder"]) == (409, "1")
    assert client.get("/acceptance/00000000-0000-0000-0000-000000000000").status_code == 404
    assert client.post(f"/acceptance/{test.id}/cancel").json()["state"] == "cancelled"


def test_repeated_request_opens_and_measures_nothing_new(
    client: TestClient, desk: AcceptanceDesk, queue: TameQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(AcceptanceRequest, "plan", lambda *_: PLAN)
    key = {"Idempotency-Key": "once"}
    first = client.post("/acceptance", headers=key)
    path = first.headers["location"]
    measured = client.post(f"{path}/position", headers=key)
    assert (measured.status_code, measured.json()["captures_done"]) == (202, PLAN.repeats)
    again = client.post("/acceptance", headers=key)
    assert (again.status_code, again.headers["location"], again.json()) == (201, path, first.json())
    assert client.post(f"{path}/position", headers=key).json() == client.get(path).json()
    assert (len(queue.holders), len(desk.latest())) == (1, 1)
    for where in ("/acceptance", f"{path}/position"):
        other = {"repeats": 2} if where == "/acceptance" else {"scripted": True}
        answer = client.post(where, headers=key, json=other)
        assert (answer.status_code, answer.json()["type"]) == (422, "/problems/idempotency"), where

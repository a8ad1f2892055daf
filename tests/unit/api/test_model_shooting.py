"""/model/shoot: asked for, turned by hand, ended early; and every refusal in words."""

from __future__ import annotations

from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient

from tests.unit.api.conftest import ServedBench, ended
from tests.unit.combine.model_bench import until_told

AXIS = {"point_mm": [4.0, 45.0, 12.0], "direction": [0.0, -1.0, 0.0]}
STILL = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
BY_HAND = {"by_hand": True, "axis": AXIS, "views": 3, "label": "cup", "if_busy": "queue"}


def views(client: TestClient, model: dict[str, Any]) -> list[dict[str, Any]]:
    """The scans of a model, all of them over."""
    scans = client.get(f"/scan/series/{model['id']}").json()["scans"]
    return [ended(client, each["id"]) for each in scans]


def test_a_person_turns_and_the_model_is_made_of_the_views(client: TestClient, served: ServedBench) -> None:
    request = {**BY_HAND, "scan": {"preset": "shiny", "reconstruction": {"region": {"depth_mm": [1, 900]}}}}
    key = {"Idempotency-Key": str(uuid4())}
    answer = client.post("/model/shoot", json=request, headers=key)
    assert answer.status_code == 202, answer.text
    model = answer.json()
    assert answer.headers["Location"] == f"/model/{model['id']}"
    assert client.post("/model/shoot", json=request, headers=key).json()["id"] == model["id"]
    (first,) = views(client, model)
    place = first["plan"]["series"]
    assert (place["number"], place["count"], first["label"], first["plan"]["preset"]["name"]) == (1, 3, "cup", "shiny")
    assert (first["plan"]["turn_deg"], first["plan"]["turned_by"]) == (0.0, "hand")
    assert first["plan"]["reconstruction"]["region"]["depth_mm"] == [1, 900]
    until_told(served.service.models.jobs, UUID(model["id"]), "turn the object")
    here = client.get(f"/model/{model['id']}").json()
    assert (here["state"], here["progress"]["stage"]) == ("capturing", "turn")
    assert here["progress"]["detail"] == "turn the object by 120° for view 2 of 3"
    assert here["plan"]["shoot"]["views"] == 3
    early = client.post(f"/model/{model['id']}/combine")
    assert (early.status_code, "it takes two" in early.json()["detail"]) == (409, True)
    for _ in range(2):
        # Sent twice, it is shot once.
        assert client.post(f"/model/{model['id']}/view", headers=key).status_code == 202
    assert [each["plan"]["turn_deg"] for each in views(client, model)] == [0.0, 120.0]
    assert client.post(f"/model/{model['id']}/view", json={"again": True}).status_code == 202
    assert [each["plan"]["turn_deg"] for each in views(client, model)] == [0.0, 120.0, 120.0]
    assert client.post(f"/model/{model['id']}/combine").status_code == 202
    client.get(model["links"]["events"])
    done = client.get(f"/model/{model['id']}").json()
    assert done["state"] == "succeeded", done["error"]
    assert done["summary"]["notes"] == ["view 3 of 3, at 240°, is not in it: it was not shot"]
    assert len(served.combining.asked[-1][0]) == 2
    late = client.post(f"/model/{model['id']}/view")
    assert (late.status_code, "is succeeded" in late.json()["detail"]) == (409, True)


def test_a_model_that_is_cancelled_ends_its_views(client: TestClient, served: ServedBench) -> None:
    served.began.clear()
    served.gate.clear()
    model = client.post("/model/shoot", json=BY_HAND).json()
    assert served.began.wait(20)
    busy = client.post("/model/shoot", json={**BY_HAND, "if_busy": "reject"})
    assert (busy.status_code, busy.json()["type"]) == (409, "/problems/rig-busy")
    shooting = client.post(f"/model/{model['id']}/view")
    assert "View 1 of model" in shooting.json()["detail"]
    assert client.post(model["links"]["cancel"]).json()["state"] == "cancelled"
    assert [each["state"] for each in views(client, model)] == ["cancelled"]


@pytest.mark.parametrize(
    ("status", "words", "request_body"),
    [
        (422, "has no turntable. Turn it by hand", {"axis": AXIS}),
        (422, "axis: expected that of the stage", {"by_hand": True}),
        (422, "views", {**BY_HAND, "views": 1}),
        (422, "views", {**BY_HAND, "views": 73}),
        (422, "one for each of 3 scans", {"by_hand": True, "views": 3, "poses": [STILL, STILL]}),
        (422, "leave one of them out", {"by_hand": True, "views": 2, "poses": [STILL, STILL], "axis": AXIS}),
        (422, "repeat", {**BY_HAND, "scan": {"repeat": 2}}),
        (422, "turn_deg", {**BY_HAND, "scan": {"turn_deg": 2}}),
        (422, "one of", {**BY_HAND, "scan": {"exposure_s": 0.1, "exposures_s": [0.1, 0.2]}}),
        (404, "none", {**BY_HAND, "scan": {"preset": "none"}}),
    ],
)
def test_what_cannot_be_shot_is_refused_and_not_on_record(
    client: TestClient, status: int, words: str, request_body: dict[str, Any]
) -> None:
    known = client.get("/model").json()["models"]
    refused = client.post("/model/shoot", json=request_body)
    assert (refused.status_code, words in refused.text) == (status, True), refused.text
    assert client.get("/model").json()["models"] == known
    assert client.get("/scan").json()["scans"] == []

"""/model: asked for, followed, fetched, deleted; and every refusal in words."""

from __future__ import annotations

from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient

from slrig.combine.offered import MEDIA_TYPES
from slrig.combine.plan import GivenPoses, MarkerPoses, StatedAxis, TurntablePoses, UnknownPoses
from slrig.errors import RegistrationRefusedError
from tests.unit.api.conftest import ServedBench
from tests.unit.combine.model_bench import kept_scan

AXIS = {"point_mm": [4.0, 45.0, 12.0], "direction": [0.0, -1.0, 0.0]}
STILL = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


@pytest.fixture
def scans(served: ServedBench) -> list[str]:
    service = served.service
    return [str(kept_scan(service.store, service.folder, angle_deg=angle)) for angle in (0.0, 40.0)]


def over(client: TestClient, model: dict[str, Any]) -> dict[str, Any]:
    """The model once its event stream has closed."""
    assert "event: state" in client.get(model["links"]["events"]).text
    found: dict[str, Any] = client.get(model["links"]["self"]).json()
    return found


def test_a_model_is_asked_for_once_followed_and_fetched(
    client: TestClient, served: ServedBench, scans: list[str]
) -> None:
    request = {"scans": scans, "axis": AXIS, "voxel_mm": 0.4, "label": "cup"}
    key = {"Idempotency-Key": str(uuid4())}
    answer = client.post("/model", json=request, headers=key)
    assert answer.status_code == 202, answer.text
    model = answer.json()
    assert answer.headers["Location"] == model["links"]["self"] == f"/model/{model['id']}"
    assert (model["state"], model["label"], model["links"]["files"]) == ("queued", "cup", {})
    done = over(client, model)
    assert client.post("/model", json=request, headers=key).json()["id"] == model["id"]
    assert done["state"] == "succeeded", done["error"]
    assert done["plan"]["poses"] == {"axis": AXIS, "angles_deg": [0.0, 40.0], "of_stage": False, "kind": "turntable"}
    assert served.combining.asked[-1][1:] == (
        TurntablePoses(StatedAxis((4.0, 45.0, 12.0), (0.0, -1.0, 0.0)), (0.0, 40.0)), 3.0, 0.4,
    )  # fmt: skip
    assert done["summary"]["views"] == 2
    assert set(done["links"]["files"]) == set(MEDIA_TYPES)
    for name, path in done["links"]["files"].items():
        found = client.get(path)
        assert found.content == (served.service.models.store.place(UUID(model["id"])) / name).read_bytes()
        assert found.headers["content-type"].startswith(MEDIA_TYPES[name])
        assert client.get(path, headers={"If-None-Match": found.headers["ETag"]}).status_code == 304
    second = over(client, client.post("/model", json={"scans": scans, "poses": [STILL, STILL]}).json())
    asked = served.combining.asked
    assert isinstance(asked[-1][1], GivenPoses)
    found = client.post("/model", json={"scans": scans, "poses": "unknown"}).json()
    assert over(client, found)["plan"]["poses"] == {"kind": "unknown"}
    assert isinstance(asked[2][1], UnknownPoses)
    for scan in scans:
        (served.service.folder.scan(UUID(scan)) / "bundle").mkdir()
    request = {"scans": scans, "poses": "markers", "dictionary": "DICT_4X4_50"}
    marked = over(client, client.post("/model", json=request).json())
    assert marked["plan"]["poses"] == {"kind": "markers", "dictionary": "DICT_4X4_50"}
    assert asked[3][1] == MarkerPoses("DICT_4X4_50")
    assert client.delete(marked["links"]["self"]).status_code == 204
    assert client.delete(found["links"]["self"]).status_code == 204
    page = client.get("/model", params={"limit": 1}).json()
    assert [each["id"] for each in page["models"]] == [second["id"]]
    assert [each["id"] for each in client.get(page["next"]).json()["models"]] == [model["id"]]
    assert client.delete(model["links"]["self"]).status_code == 204
    assert client.get(done["links"]["files"]["model.ply"]).status_code == 404
    assert client.delete(f"/scan/{scans[0]}").status_code == 204


def test_scans_stay_while_a_model_needs_them_and_it_can_be_cancelled(
    client: TestClient, served: ServedBench, scans: list[str]
) -> None:
    served.combining.gate.clear()
    model = client.post("/model", json={"scans": scans, "axis": AXIS}).json()
    for method, path, words in (
        ("DELETE", f"/scan/{scans[1]}", f"needed by model {model['id']}"),
        ("DELETE", f"/model/{model['id']}", "Cancel it first"),
        ("GET", f"/model/{model['id']}/model.ply", "is not ready: the model is"),
    ):
        refused = client.request(method, path)
        assert refused.status_code == 409
        assert words in refused.json()["detail"]
    assert client.post(model["links"]["cancel"]).status_code == 202
    assert over(client, model)["state"] == "cancelled"
    served.combining.gate.set()
    served.combining.error = RegistrationRefusedError("one overlaps no other")
    failed = over(client, client.post("/model", json={"scans": scans, "axis": AXIS}).json())
    assert failed["error"]["type"] == "/problems/registration-refused"
    never = client.get(f"/model/{failed['id']}/report.json")
    assert "will never be made (one overlaps no other). Make it again." in never.json()["detail"]


def test_what_cannot_be_made_is_refused_and_not_on_record(client: TestClient, scans: list[str]) -> None:
    known = {each["id"] for each in client.get("/model").json()["models"]}
    mirror = [[-1.0, 0.0, 0.0, 0.0], *STILL[1:]]
    for status, words, request in (
        (422, "scans", {"scans": scans[:1]}),
        (422, "twice", {"scans": [*scans, scans[0]], "axis": AXIS}),
        (404, "No scan", {"scans": [scans[0], str(uuid4())], "axis": AXIS}),
        (422, "axis: expected that of the stage", {"scans": scans}),
        (422, "one for each of 2", {"scans": scans, "axis": AXIS, "angles_deg": [1.0]}),
        (422, "expected a rotation", {"scans": scans, "poses": [STILL, mirror]}),
        (422, "leave one of them out", {"scans": scans, "poses": [STILL, STILL], "axis": AXIS}),
        (422, "leave one of them out", {"scans": scans, "poses": "unknown", "angles_deg": [0.0, 1.0]}),
        (422, "poses", {"scans": scans, "poses": "somewhere"}),
        (422, "expected the frames of each scan", {"scans": scans, "poses": "markers"}),
        (422, "dictionary", {"scans": scans, "poses": "unknown", "dictionary": "DICT_4X4_50"}),
    ):
        refused = client.post("/model", json=request)
        assert (refused.status_code, words in refused.text) == (status, True), (request, refused.text)
    assert {each["id"] for each in client.get("/model").json()["models"]} == known

"""/model over HTTP: made of scans or of views that are shot for it, followed, fetched, deleted, and refused."""

from __future__ import annotations

from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient

from slrig.errors import RegistrationRefusedError
from slrig.jobs.records import read_record
from slrig.model_jobs.plan import MEDIA_TYPES, GivenPoses, MarkerPoses, StatedAxis, TurntablePoses, UnknownPoses
from tests.unit.api.conftest import ServedBench, ended, refusal
from tests.unit.model_jobs.model_bench import kept_scan, until_told

AXIS = {"point_mm": [4.0, 45.0, 12.0], "direction": [0.0, -1.0, 0.0]}
STILL = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
MIRROR = [[-1.0, 0.0, 0.0, 0.0], *STILL[1:]]
BY_HAND = {"manual": True, "axis": AXIS, "views": 3, "label": "cup", "if_busy": "queue"}


@pytest.fixture
def scans(served: ServedBench) -> list[str]:
    service = served.service
    return [str(kept_scan(service.store, service.folder, angle_deg=angle)) for angle in (0.0, 40.0)]


def over(client: TestClient, model: dict[str, Any]) -> dict[str, Any]:
    assert "event: state" in client.get(model["links"]["events"]).text
    found: dict[str, Any] = client.get(model["links"]["self"]).json()
    return found


def test_model_is_made_once_followed_and_fetched(client: TestClient, served: ServedBench, scans: list[str]) -> None:
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
    assert done["plan"]["poses"] == {
        "axis": AXIS,
        "angles_deg": [0.0, 40.0],
        "of_turntable": False,
        "kind": "turntable",
    }
    assert served.combining.asked[-1][1:] == (
        TurntablePoses(StatedAxis((4.0, 45.0, 12.0), (0.0, -1.0, 0.0)), (0.0, 40.0)), 3.0, 0.4,
    )  # fmt: skip
    assert done["summary"]["views"] == 2
    assert set(done["links"]["files"]) == set(MEDIA_TYPES)
    for name, path in done["links"]["files"].items():
        found = client.get(path)
        assert found.content == (served.service.models.place(UUID(model["id"])) / name).read_bytes()
        assert found.headers["content-type"].startswith(MEDIA_TYPES[name])
        assert client.get(path, headers={"If-None-Match": found.headers["ETag"]}).status_code == 304
    for scan in scans:
        (served.service.folder.scan(UUID(scan)) / "bundle").mkdir()
    others = []
    for poses, kind in (
        ({"poses": [STILL, STILL]}, GivenPoses),
        ({"poses": "unknown"}, UnknownPoses),
        ({"poses": "markers", "dictionary": "DICT_4X4_50"}, MarkerPoses),
    ):
        others.append(over(client, client.post("/model", json={"scans": scans, **poses}).json()))
        assert isinstance(served.combining.asked[-1][1], kind)
    second, unknown, marked = others
    assert unknown["plan"]["poses"] == {"kind": "unknown"}
    assert marked["plan"]["poses"] == {"kind": "markers", "dictionary": "DICT_4X4_50"}
    assert client.delete(marked["links"]["self"]).status_code == 204
    assert client.delete(unknown["links"]["self"]).status_code == 204
    assert client.patch(model["links"]["self"], json={"label": "mug"}).json()["label"] == "mug"
    kept = read_record(served.service.models.place(UUID(model["id"])))
    assert kept is not None
    assert kept.label == "mug"
    page = client.get("/model", params={"limit": 1}).json()
    assert [each["id"] for each in page["models"]] == [second["id"]]
    assert [each["id"] for each in client.get(page["next"]).json()["models"]] == [model["id"]]
    assert client.delete(model["links"]["self"]).status_code == 204
    assert client.get(done["links"]["files"]["model.ply"]).status_code == 404
    assert client.delete(f"/scan/{scans[0]}").status_code == 204


def test_scans_stay_while_a_model_needs_them(client: TestClient, served: ServedBench, scans: list[str]) -> None:
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


def views(client: TestClient, model: dict[str, Any]) -> list[dict[str, Any]]:
    scans = client.get(f"/scan/series/{model['id']}").json()["scans"]
    return [ended(client, each["id"]) for each in scans]


def test_model_is_shot_while_a_person_turns_the_object(client: TestClient, served: ServedBench) -> None:
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
    assert (here["state"], here["progress"]["stage"], here["plan"]["shoot"]["views"]) == ("capturing", "turn", 3)
    assert client.post(f"/model/{model['id']}/combine").status_code == 409
    for _ in range(2):
        # Sent twice, it is shot once.
        assert client.post(f"/model/{model['id']}/view", headers=key).status_code == 202
    assert [each["plan"]["turn_deg"] for each in views(client, model)] == [0.0, 120.0]
    assert client.post(f"/model/{model['id']}/view", json={"again": True}).status_code == 202
    assert [each["plan"]["turn_deg"] for each in views(client, model)] == [0.0, 120.0, 120.0]
    assert client.post(f"/model/{model['id']}/combine").status_code == 202
    assert over(client, model)["state"] == "succeeded"
    assert len(served.combining.asked[-1][0]) == 2


def test_views_wait_for_a_busy_rig_only_on_request(client: TestClient, served: ServedBench) -> None:
    served.held(client)
    assert refusal(client, "POST", "/model/shoot", json={**BY_HAND, "if_busy": "reject"}) == (409, "/problems/rig-busy")


BAD_REQUESTS: list[tuple[int, str, dict[str, Any]]] = [
    (404, "No scan", {"scans": [0, str(uuid4())], "axis": AXIS}),
    (422, "scans", {"scans": [0]}),
    (422, "axis: expected that of the turntable", {"scans": [0, 1]}),
    (422, "expected a rotation", {"scans": [0, 1], "poses": [STILL, MIRROR]}),
    (422, "leave one of them out", {"scans": [0, 1], "poses": [STILL, STILL], "axis": AXIS}),
    (422, "poses", {"scans": [0, 1], "poses": "somewhere"}),
    (422, "expected the frames of each scan", {"scans": [0, 1], "poses": "markers"}),
    (422, "dictionary", {"scans": [0, 1], "poses": "unknown", "dictionary": "DICT_4X4_50"}),
    (422, "axis: expected that of the turntable", {"manual": True}),
    (422, "views", {**BY_HAND, "views": 1}),
    (422, "one for each of 3 scans", {"manual": True, "views": 3, "poses": [STILL, STILL]}),
    (422, "repeat", {**BY_HAND, "scan": {"repeat": 2}}),
    (422, "turn_deg", {**BY_HAND, "scan": {"turn_deg": 2}}),
    (422, "one of", {**BY_HAND, "scan": {"exposure_s": 0.1, "exposures_s": [0.1, 0.2]}}),
    (404, "none", {**BY_HAND, "scan": {"preset": "none"}}),
]


def test_bad_request_for_a_model_is_refused_and_not_on_record(client: TestClient, scans: list[str]) -> None:
    """`scans` of a request: numbers stand for scans on record. Without them its views are shot."""
    known = client.get("/model").json()["models"], len(client.get("/scan").json()["scans"])
    for status, words, request_body in BAD_REQUESTS:
        given = [scans[each] if isinstance(each, int) else each for each in request_body.get("scans", ())]
        path, body = ("/model", {**request_body, "scans": given}) if given else ("/model/shoot", request_body)
        refused = client.post(path, json=body)
        assert (refused.status_code, words in refused.text) == (status, True), refused.text
    assert (client.get("/model").json()["models"], len(client.get("/scan").json()["scans"])) == known

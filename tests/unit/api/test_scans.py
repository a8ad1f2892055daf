"""Scans as jobs over HTTP: started, followed, listed, cancelled, deleted; keys of requests; series; old scans."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient

from slrig.api.idempotency import fingerprint, own_key
from slrig.api.schemas import ScanRequest
from tests.unit.api.conftest import ServedBench, client_of, ended, refusal
from tests.unit.calibrate.calibration_bench import BOARD
from tests.unit.scan.fakes import WAIT_S


def events_of(text: str) -> list[dict[str, Any]]:
    found = []
    for block in text.split("\n\n"):
        lines = dict(line.split(": ", 1) for line in block.splitlines() if line and not line.startswith(":"))
        if lines:
            found.append({"id": int(lines["id"]), "kind": lines["event"], **json.loads(lines["data"])})
    return found


def test_scan_is_accepted_followed_and_fetched(client: TestClient) -> None:
    accepted = client.post("/scan", json={"label": "cup", "patterns": {"line_width_px": 2}})
    assert accepted.status_code == 202
    scan = accepted.json()
    assert accepted.headers["Location"] == scan["links"]["self"] == f"/scan/{scan['id']}"
    assert (scan["state"], scan["label"], scan["rig"]) == ("queued", "cup", "bench")
    path = scan["links"]["events"]
    stream = client.get(path)
    assert stream.headers["content-type"].startswith("text/event-stream")
    events = events_of(stream.text)
    assert [event["id"] for event in events] == list(range(1, len(events) + 1))
    assert events[-1]["state"] == "succeeded"
    assert {event["stage"] for event in events if event["kind"] == "progress"} >= {"capture", "decode"}
    # A stream that broke off goes on after the last event that the client has.
    assert events_of(client.get(path, headers={"Last-Event-ID": "3"}).text) == events[3:]
    over = client.get(path, headers={"Last-Event-ID": str(len(events))})
    assert (over.status_code, over.content) == (204, b"")
    done = client.get(scan["links"]["self"]).json()
    assert (done["state"], done["error"], done["links"]["series"]) == ("succeeded", None, None)
    assert done["summary"] == {"bundle": done["id"], "seconds": 1.5, "truth": {"rms_mm": 0.01}}
    files = done["links"]["files"]
    assert set(files) == {
        "bundle.zip", "coarse.glb", "mesh.3mf", "mesh.glb", "mesh.obj", "mesh.ply", "mesh.stl", "points.ply",
        "preview.png", "report.json", "view.glb",
    }  # fmt: skip
    for name, where in files.items():
        assert client.get(where).status_code == 200, name
    assert client.get(files["report.json"]).json()["truth"] == {"rms_mm": 0.01}


def test_stage_is_turned_by_hand_where_the_rig_has_no_turntable(client: TestClient) -> None:
    by_hand = client.post("/scan", json={"turn_deg": -45, "turned_by": "hand"}).json()
    assert (by_hand["plan"]["turn_deg"], by_hand["plan"]["turned_by"]) == (-45.0, "hand")
    assert ended(client, by_hand["id"])["state"] == "succeeded"
    refused = client.post("/scan", json={"turn_deg": 45})
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/unsupported-by-device")
    assert "this rig has no turntable. Turn it by hand, and say so" in refused.json()["detail"]
    assert client.post("/scan", json={"turned_by": "hand"}).status_code in {400, 422}


def test_repeated_request_gets_the_same_scan_and_the_same_answer(client: TestClient) -> None:
    headers = {"Idempotency-Key": "night-run"}
    first = client.post("/scan", json={"label": "a"}, headers=headers)
    ended(client, first.json()["id"])
    second = client.post("/scan", json={"label": "a"}, headers=headers)
    assert (second.status_code, second.headers["Location"]) == (202, first.headers["Location"])
    assert second.json() == first.json()
    assert refusal(client, "POST", "/scan", json={"label": "b"}, headers=headers) == (422, "/problems/idempotency")
    assert len(client.get("/scan").json()["scans"]) == 1
    client.delete(first.json()["links"]["self"])
    assert refusal(client, "POST", "/scan", json={"label": "a"}, headers=headers) == (404, "/problems/job-not-found")
    assert "404" in client.get("/openapi.json").json()["paths"]["/scan"]["post"]["responses"]


def test_key_in_flight_is_refused_for_a_moment(client: TestClient, served: ServedBench) -> None:
    served.service.keys.reserve(own_key("slow", "/scan"), fingerprint(ScanRequest()))
    refused = client.post("/scan", headers={"Idempotency-Key": "slow"})
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/key-in-flight")
    assert refused.headers["Retry-After"] == "1"
    served.service.keys.release_all()
    assert client.post("/scan", headers={"Idempotency-Key": "slow"}).status_code == 202


def test_busy_rig_names_its_holder_and_the_queue_is_short(client: TestClient, served: ServedBench) -> None:
    holder = served.held(client)
    busy = client.post("/scan", headers={"Idempotency-Key": "try-again"})
    assert (busy.status_code, busy.headers["Retry-After"]) == (409, "5")
    problem = busy.json()
    assert (problem["type"], problem["holder"]) == ("/problems/rig-busy", holder["id"])
    assert problem["since"].startswith("20")
    assert client.get("/rig").json()["holder"] == holder["id"]
    queued = client.post("/scan", json={"if_busy": "queue"})
    assert queued.status_code == 202
    full = client.post("/scan", json={"if_busy": "queue"})
    assert (full.status_code, full.json()["type"]) == (429, "/problems/queue-full")
    assert full.headers["Retry-After"] == "30"
    served.gate.set()
    assert ended(client, queued.json()["id"])["state"] == "succeeded"
    # The key of a request that was refused is free.
    assert client.post("/scan", headers={"Idempotency-Key": "try-again"}).status_code == 202


def test_series_is_one_request_and_many_scans_on_pages(client: TestClient) -> None:
    first = client.post("/scan", json={"repeat": 3, "label": "row"}).json()
    series = client.get(first["links"]["series"]).json()["scans"]
    assert series[0]["id"] == first["id"]
    scans = [ended(client, each["id"]) for each in series]
    assert [(each["state"], each["label"], each["plan"]["series"]["number"]) for each in scans] == [
        ("succeeded", "row", number) for number in (1, 2, 3)
    ]
    page = client.get("/scan", params={"limit": 2})
    assert [scan["id"] for scan in page.json()["scans"]] == [scans[2]["id"], scans[1]["id"]]
    assert page.headers["Link"] == f'<{page.json()["next"]}>; rel="next"'
    last = client.get(page.json()["next"])
    assert [scan["id"] for scan in last.json()["scans"]] == [first["id"]]
    assert last.json()["next"] is None
    assert "Link" not in last.headers
    for method, pinned in (("PUT", True), ("DELETE", False)):
        assert client.request(method, f"/scan/{first['id']}/pin").json()["pinned"] is pinned


def test_series_that_waits_for_its_time_is_cancelled_as_one(client: TestClient) -> None:
    headers = {"Idempotency-Key": "a series"}
    request = {"repeat": 3, "every_s": 3600}
    first = client.post("/scan", json=request, headers=headers).json()
    assert client.post("/scan", json=request, headers=headers).json()["id"] == first["id"]
    ended(client, first["id"])
    series = first["links"]["series"]
    assert len(client.get(series).json()["scans"]) == 3
    cancelled = client.post(f"{series}/cancel")
    assert cancelled.status_code == 202
    assert [each["state"] for each in cancelled.json()["scans"]] == ["succeeded", "cancelled", "cancelled"]
    assert client.get(f"/scan/series/{uuid4()}").status_code == 404


def test_cancel_may_be_repeated_and_delete_waits_for_the_end(client: TestClient, served: ServedBench) -> None:
    scan = served.held(client)
    here = scan["links"]["self"]
    assert refusal(client, "DELETE", here) == (409, "/problems/scan-state")
    assert client.post(scan["links"]["cancel"]).status_code == 202
    assert ended(client, scan["id"])["state"] == "cancelled"
    again = client.post(scan["links"]["cancel"])
    assert (again.status_code, again.json()["state"]) == (202, "cancelled")
    assert client.delete(here).status_code == 204
    for method, path in (
        ("GET", ""), ("GET", "/events"), ("GET", "/mesh.ply"), ("GET", "/bundle.zip"), ("POST", "/cancel"),
        ("PUT", "/pin"), ("DELETE", ""),
    ):  # fmt: skip
        assert refusal(client, method, f"{here}{path}") == (404, "/problems/job-not-found"), path


@pytest.mark.slow
def test_old_scans_and_calibrations_are_removed_but_for_pinned_ones(tmp_path: Path) -> None:
    bench = ServedBench(tmp_path, keep_scans=1, keep_calibrations=1)
    calibrations = bench.service.calibrations
    old, new = (calibrations.open(BOARD).id for _ in range(2))
    removed, gone = threading.Event(), threading.Event()
    calibrations.register.jobs.watch(old, removed.set)
    with client_of(bench) as client:
        assert removed.wait(WAIT_S)
        assert [each["id"] for each in client.get("/calibration").json()["calibrations"]] == [str(new)]
        made = []
        for number in range(3):
            made.append(client.post("/scan").json()["id"])
            assert ended(client, made[-1])["state"] == "succeeded"
            if number == 0:
                assert client.put(f"/scan/{made[0]}/pin").json()["pinned"] is True
        bench.service.store.watch(UUID(made[1]), gone.set)
        left = [each["id"] for each in client.get("/scan").json()["scans"]]
        assert made[1] not in left or gone.wait(WAIT_S)
        assert [each["id"] for each in client.get("/scan").json()["scans"]] == [made[2], made[0]]
        assert client.delete(f"/scan/{made[0]}/pin").json()["pinned"] is False

"""Scans over HTTP: started, followed, cancelled, kept; and their files, also those that are made on request."""

from __future__ import annotations

import importlib.util
import io
import json
import shutil
import threading
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from uuid import UUID, uuid4

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from slrig.api import files as clouds
from slrig.api.auth import digest
from slrig.api.files import _made_so_far, ready_files
from slrig.api.schemas import ScanRequest
from slrig.api.service import fingerprint, own_key
from slrig.bundle.calibration import write_calibration
from slrig.bundle.writing import BundleWriter
from slrig.devices import Rig
from slrig.errors import WorkerLostError
from slrig.jobs import data_folder
from slrig.jobs.data_folder import DataFolder, damaged_files, write_entries
from slrig.jobs.listener import Listener
from slrig.jobs.records import JobState, acting_as, read_record
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Task
from slrig.model import Calibration, CameraFormat, Pinhole, Shot, Size, White
from slrig.scan.acquisition import Recording, capture_frames
from slrig.scan.artefacts import ON_REQUEST
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.core import parametrize_core
from tests.ros_readers import library
from tests.unit.api.conftest import KEY, ServedBench, client_of, ended, refusal
from tests.unit.calibrate.calibration_bench import BOARD
from tests.unit.capture.fake_rig import CameraFaults, fake_rig
from tests.unit.command import done, refused, slrig
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan import fake_pipeline
from tests.unit.scan.fakes import WAIT_S, tame_calibration


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
    answers = client.get("/openapi.json").json()["paths"]["/scan/{scan_id}/events"]["get"]["responses"]
    items = [each["properties"] for each in answers["200"]["content"]["text/event-stream"]["itemSchema"]["anyOf"]]
    contents = {item["event"]["const"]: item["data"]["contentSchema"] for item in items}
    for event in events:
        content = contents[event["kind"]]
        assert set(content["required"]) <= event.keys() - {"id", "kind"} <= set(content["properties"])
    # A stream that broke off goes on after the last event that the client has.
    assert events_of(client.get(path, headers={"Last-Event-ID": "3"}).text) == events[3:]
    over = client.get(path, headers={"Last-Event-ID": str(len(events))})
    assert (over.status_code, over.content) == (204, b"")
    done = client.get(scan["links"]["self"]).json()
    assert (done["state"], done["error"], done["links"]["series"]) == ("succeeded", None, None)
    assert done["summary"] == {"bundle": done["id"], "seconds": 1.5, "truth": {"rms_mm": 0.01}}
    files = done["links"]["files"]
    assert set(files) == {
        "bundle.zip", "calibration.json", "coarse.glb", "mesh.3mf", "mesh.glb", "mesh.obj", "mesh.ply", "mesh.stl",
        "points.ply", "preview.png", "report.json", "view.glb",
    }  # fmt: skip
    for name, where in files.items():
        assert client.get(where).status_code == 200, name
    assert client.get(files["report.json"]).json()["truth"] == {"rms_mm": 0.01}


def test_stage_is_turned_by_hand_where_the_rig_has_no_turntable(client: TestClient) -> None:
    manual = client.post("/scan", json={"turn_deg": -45, "turned_by": "hand"}).json()
    assert (manual["plan"]["turn_deg"], manual["plan"]["turned_by"]) == (-45.0, "hand")
    assert ended(client, manual["id"])["state"] == "succeeded"
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
    with acting_as("environment", key=digest(KEY)):
        mine = own_key("slow", "/scan")
    served.service.keys.reserve(mine, fingerprint(ScanRequest()))
    refused = client.post("/scan", headers={"Idempotency-Key": "slow"})
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/key-in-flight")
    assert refused.headers["Retry-After"] == "1"
    served.service.keys.release_all()
    assert client.post("/scan", headers={"Idempotency-Key": "slow"}).status_code == 202


def test_a_scan_is_renamed_beside_its_files_too_and_found_by_its_name(client: TestClient, served: ServedBench) -> None:
    scan = client.post("/scan", json={"label": "cup"}).json()
    here, folder = scan["links"]["self"], served.service.folder
    ended(client, scan["id"])
    renamed = client.patch(here, json={"label": "Tasse 7"})
    assert (renamed.status_code, renamed.json()["label"]) == (200, "Tasse 7")
    kept = read_record(place_of(served, scan["id"]))
    assert kept is not None
    assert kept.label == "Tasse 7"
    client.post(f"{here}/reconstruct")
    # While it is computed once more, also what comes of that has the new name.
    client.patch(here, json={"label": "Tasse 8"})
    assert ended(client, scan["id"])["label"] == "Tasse 8"
    remade = read_record(place_of(served, scan["id"]))
    assert remade is not None
    assert (remade.label, damaged_files(folder.scan(remade.id), digests=True)) == ("Tasse 8", {})
    found = client.get("/scan", params={"name": "tasse", "state": ["succeeded", "failed"], "limit": 1})
    assert [each["id"] for each in found.json()["scans"]] == [scan["id"]]
    assert found.json()["next"] is None
    finished(client)
    paged = client.get("/scan", params={"state": "succeeded", "since": "2026-01-01T00:00:00+01:00", "limit": 1}).json()
    assert "&state=succeeded&since=2026-01-01T00%3A00%3A00%2B01%3A00" in paged["next"]
    assert [each["id"] for each in client.get(paged["next"]).json()["scans"]] == [scan["id"]]
    audited = client.get("/audit").json()["entries"]
    assert [(each["path"], each["status"]) for each in audited if each["method"] == "PATCH"] == [(here, 200)] * 2
    assert client.patch(here, json={"label": None}).json()["label"] is None
    for body in ({}, {"label": ""}, {"label": "a\nb"}, {"label": "x", "pinned": True}):
        assert client.patch(here, json=body).status_code == 422, body
    assert refusal(client, "PATCH", f"/scan/{uuid4()}", json={"label": "x"}) == (404, "/problems/job-not-found")
    assert client.get("/scan", params={"since": "2026-01-01"}).status_code == 422


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
    line = page.json()["scans"][0]
    assert (line["state"], line["triangles"], line["turn_deg"]) == ("succeeded", None, None)
    assert client.get(line["links"]["picture"]).status_code == 200
    # A list stays short: what else there is, each scan says itself.
    assert len(page.content) < 2 * 800
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
def test_old_scans_and_calibrations_are_removed_but_for_pinned_ones(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    bench = ServedBench(tmp_path, keep_scans=1, keep_calibrations=1)
    request.addfinalizer(bench.unpatch)
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


SIZE = Size(40, 30)
NAME = "points-left.npz"
NOT_READY = (409, "/problems/artefact-not-ready")
DAMAGED = (410, "/problems/damaged")


def finished(client: TestClient, **request: Any) -> dict[str, Any]:
    scan = ended(client, client.post("/scan", json=request).json()["id"])
    assert scan["state"] == "succeeded"
    return scan


def place_of(served: ServedBench, scan_id: str) -> Path:
    return served.service.folder.scan(UUID(scan_id))


@parametrize_core("name", ["mesh.ply", "bundle.zip", "preview.png", "mesh.obj"], core=[0, 3])
def test_file_is_sent_whole_in_part_or_not_again(client: TestClient, name: str) -> None:
    path = finished(client)["links"]["files"][name]
    whole, head = client.get(path), client.head(path)
    assert (head.status_code, head.content) == (200, b"")
    for header in ("etag", "content-type", "cache-control", "content-length"):
        assert head.headers.get(header) == whole.headers.get(header), header
    assert client.get(path).content == whole.content
    tag = whole.headers["ETag"]
    for known in (tag, f'"other", W/{tag}', "*"):
        again = client.get(path, headers={"If-None-Match": known})
        assert (again.status_code, again.content, again.headers["ETag"]) == (304, b"", tag)
    assert client.get(path, headers={"If-None-Match": '"other"'}).status_code == 200
    if name != "bundle.zip":
        part = client.get(path, headers={"Range": "bytes=3-5"})
        assert (part.status_code, part.content) == (206, whole.content[3:6])
        beyond = client.get(path, headers={"Range": "bytes=99999-"})
        assert (beyond.status_code, beyond.headers["content-type"]) == (416, "application/problem+json")
        assert beyond.headers["content-range"] == f"bytes */{len(whole.content)}"


@pytest.mark.parametrize("name", ["mesh.ply", pytest.param("report.json", marks=pytest.mark.slow)])
def test_a_damaged_file_is_not_sent_and_made_again_from_the_bundle(
    client: TestClient, served: ServedBench, name: str
) -> None:
    scan = finished(client)
    path, files = place_of(served, scan["id"]) / name, scan["links"]["files"]
    sound = client.get(files[name])
    changed = bytearray(path.read_bytes())
    changed[len(changed) // 2] ^= 4
    path.write_bytes(changed)
    damaged = client.get(files[name])
    assert (damaged.status_code, damaged.json()["type"]) == DAMAGED
    assert f"{name} was changed" in damaged.json()["detail"]
    shown = client.get(scan["links"]["self"]).json()
    assert (shown["state"], shown["error"]["type"]) == ("failed", "/problems/damaged")
    assert client.get(files["bundle.zip"]).status_code == 200
    again = client.post(f"/scan/{scan['id']}/reconstruct")
    assert again.status_code == 202, again.text
    remade = ended(client, scan["id"])
    assert (remade["state"], remade.get("error")) == ("succeeded", None)
    fetched = client.get(files[name], headers={"If-None-Match": sound.headers["ETag"]})
    assert fetched.status_code == 200, "the client's copy is of the earlier files"
    assert fetched.content == path.read_bytes()


def test_what_cannot_be_reconstructed_again_says_why(client: TestClient, served: ServedBench) -> None:
    served.gate.clear()
    runs = client.post("/scan").json()["id"]
    assert refusal(client, "POST", f"/scan/{runs}/reconstruct") == (409, "/problems/scan-state")
    served.gate.set()
    ended(client, runs)
    frame = next((place_of(served, runs) / "bundle" / "frames").rglob("*.*"))
    frame.write_bytes(frame.read_bytes()[:-1])
    before = sorted(place_of(served, runs).iterdir())
    assert refusal(client, "POST", f"/scan/{runs}/reconstruct") == DAMAGED
    assert refusal(client, "GET", f"/scan/{runs}/bundle.zip") == DAMAGED
    assert sorted(place_of(served, runs).iterdir()) == before
    assert refusal(client, "POST", f"/scan/{uuid4()}/reconstruct")[0] == 404


def test_a_scan_without_a_calibration_is_made_again_by_other_guesses(client: TestClient, served: ServedBench) -> None:
    scan = finished(client, reconstruction={"uncalibrated": {"throw_ratio": 1.2}})
    assert scan["unit"] == "% of baseline"
    better = {"baseline_mm": 180, "most_error": 0.01}
    again = client.post(f"/scan/{scan['id']}/reconstruct", json={"uncalibrated": better})
    assert again.status_code == 202, again.text
    remade = ended(client, scan["id"])
    kept = read_record(place_of(served, scan["id"]))
    assert kept is not None
    assert (remade["state"], kept.plan) == ("succeeded", remade["plan"])
    asked = remade["plan"]["reconstruction"]["uncalibrated"]
    assert (asked["baseline_mm"], asked["most_error"], asked["throw_ratio"], remade["unit"]) == (180, 0.01, None, "mm")
    assert [each["unit"] for each in client.get("/scan").json()["scans"]] == ["mm"]
    # By the rig's own calibration there is nothing to guess.
    scan = finished(client)
    refused = refusal(client, "POST", f"/scan/{scan['id']}/reconstruct", json={"uncalibrated": {}})
    assert refused == (422, "/problems/config")


@pytest.mark.slow
def test_files_are_saved_by_the_name_of_their_scan(client: TestClient, served: ServedBench) -> None:
    scan = finished(client)
    here = scan["links"]["self"]
    begun = f"{datetime.fromisoformat(scan['created_at']).astimezone():%Y-%m-%d-%H%M%S}"
    (place_of(served, scan["id"]) / "causes-left.png").touch()

    def saved(name: str) -> str:
        return str(client.head(f"{here}/{name}").headers["content-disposition"])

    for name in ("mesh.ply", "mesh.stl", "report.json", "causes-left.png", "thumbnail.png"):
        assert saved(name) == f'inline; filename="bench-{begun}-{name}"'
    for label, stem in (("plate 007", "plate-007"), ("../../.ssh/a:b", "ssh-a-b"), ("***", begun)):
        client.patch(here, json={"label": label})
        assert saved("mesh.stl") == f'inline; filename="bench-{stem}-mesh.stl"'
        assert saved("bundle.zip") == f'attachment; filename="bench-{stem}-bundle.zip"'
    client.patch(here, json={"label": "Größe"})
    assert saved("mesh.ply") == "inline; filename*=utf-8''bench-Gr%C3%B6%C3%9Fe-mesh.ply"
    tag = client.head(f"{here}/mesh.ply").headers["etag"]
    known = client.get(f"{here}/mesh.ply", headers={"If-None-Match": tag})
    assert (known.status_code, "Gr%C3%B6%C3%9Fe" in known.headers["content-disposition"]) == (304, True)


@pytest.mark.slow
def test_a_file_of_several_scans_comes_as_one_zip(
    client: TestClient, served: ServedBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, third = (finished(client) for _ in range(3))
    for scan, label in ((first, "cup"), (second, "cup"), (third, "plate")):
        client.patch(scan["links"]["self"], json={"label": label})
    asked: dict[str, Any] = {"scan": [each["id"] for each in (first, second, third, first)], "file": "mesh.stl"}
    with monkeypatch.context() as patched:
        patched.setattr(clouds, "REQUEST_WAIT_S", -1.0)
        later = client.get("/scan/files.zip", params=asked)
        assert (later.status_code, later.headers["Retry-After"]) == (503, "5")
    answer = client.get("/scan/files.zip", params=asked)
    assert answer.headers["content-disposition"] == 'attachment; filename="bench-3-scans-mesh.stl.zip"'
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        names = ["bench-cup-mesh.stl", f"bench-cup-{second['id'][:8]}-mesh.stl", "bench-plate-mesh.stl"]
        assert archive.namelist() == names
        assert archive.read(names[2]) == (place_of(served, third["id"]) / "mesh.stl").read_bytes()
    wrongs: list[dict[str, Any]] = [{"scan": []}, {"scan": [str(uuid4())] * 51}, {**asked, "file": "record.json"}]
    for wrong in wrongs:
        assert client.get("/scan/files.zip", params=wrong).status_code == 422
    assert refusal(client, "GET", f"/scan/files.zip?scan={first['id']}&scan={uuid4()}")[0] == 404
    (place_of(served, second["id"]) / "mesh.ply").write_bytes(b"")
    assert refusal(client, "GET", f"/scan/files.zip?scan={first['id']}&scan={second['id']}") == DAMAGED
    served.order = "fail"
    failed = ended(client, client.post("/scan").json()["id"])["id"]
    assert refusal(client, "GET", f"/scan/files.zip?scan={first['id']}&scan={failed}") == NOT_READY


@pytest.mark.slow
@pytest.mark.usefixtures("commands")
def test_scans_are_listed_renamed_fetched_and_deleted_by_command(client: TestClient, tmp_path: Path) -> None:
    assert "slrig scan --output" in done("scans", "list")
    first, second = (finished(client)["id"] for _ in range(2))
    done("scans", "rename", first[:8], "Größe 7")
    done("scans", "rename", second, "plate")
    listed = done("scans", "list", "größe", "--state", "succeeded", "--since", "2026-01-01")
    assert (first[:8] in listed, second[:8] in listed) == (True, False)
    assert [each["id"] for each in json.loads(done("scans", "list", "--limit", "1", "--json"))["scans"]] == [second]
    assert "no such scan" in done("scans", "list", "--until", "2026-01-01")
    fetched = done("scans", "fetch", "Größe 7", "plate", "--output", tmp_path, "--file", "mesh.stl")
    assert fetched.splitlines() == [str(tmp_path / f"bench-{each}-mesh.stl") for each in ("Größe-7", "plate")]
    assert (tmp_path / "bench-plate-mesh.stl").read_bytes() == client.get(f"/scan/{second}/mesh.stl").content
    assert "has no mesh.none" in refused(slrig("scans", "fetch", "plate", "--file", "mesh.none"))
    assert "No scan is called 'Grö'" in refused(slrig("scans", "delete", "plate", "Grö", "--yes"))
    client.put(f"/scan/{second}/pin")
    assert "plate" in refused(slrig("scans", "delete", "Größe 7", "plate", "--yes"))
    client.delete(f"/scan/{second}/pin")
    done("scans", "rename", "plate", "Größe 7")
    assert "2 scans are called" in refused(slrig("scans", "delete", "Größe 7", "--yes"))
    assert slrig("scans", "delete", first[:8], second[:8], typed="n\n").exit_code == 1
    assert len(client.get("/scan").json()["scans"]) == 2
    assert done("scans", "delete", first[:8], second[:8], "--yes").count("deleted Größe 7") == 2
    assert client.get("/scan").json()["scans"] == []


def test_bundle_is_a_zip_of_stored_files_without_links(client: TestClient, served: ServedBench, tmp_path: Path) -> None:
    scan = finished(client)
    place = place_of(served, scan["id"])
    (tmp_path / "secret").write_text("of another folder")
    (place / "bundle" / "frame.png").symlink_to(tmp_path / "secret")
    (place / "bundle" / "more").symlink_to(tmp_path)
    answer = client.get(scan["links"]["files"]["bundle.zip"])
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        names = archive.namelist()
        assert answer.content.count(b"PK\x03\x04") == len(names)  # no piece is sent twice
        assert {"bundle.json", "order"} <= set(names)
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        (frame,) = [name for name in names if name.startswith("frames/")][:1]
        assert archive.read(frame) == (place / "bundle" / frame).read_bytes()
    # Links in place of files that are sent alone are not followed, either: they are damage.
    for name in ("report.json", "preview.png", "mesh.obj", "mesh.ply"):
        (place / name).unlink(missing_ok=True)
        (place / name).symlink_to(tmp_path / "secret")
    files = client.get(scan["links"]["self"]).json()["links"]["files"]
    assert sorted(files) == ["bundle.zip", "mesh.glb", "points.ply"]
    for name in ("report.json", "preview.png", "mesh.obj", "mesh.stl", "view.glb", "mesh.ply"):
        assert refusal(client, "GET", f"/scan/{scan['id']}/{name}") == DAMAGED, name
    assert client.delete(scan["links"]["self"]).status_code == 204
    assert (tmp_path / "secret").read_text() == "of another folder"


@parametrize_core(("name", "kind"), [("mesh.stl", "model/stl"), ("coarse.glb", "model/gltf-binary")])
def test_other_format_of_the_mesh_is_made_once(client: TestClient, served: ServedBench, name: str, kind: str) -> None:
    scan_id = finished(client)["id"]
    place = place_of(served, scan_id)
    first = client.get(f"/scan/{scan_id}/{name}")
    assert (first.headers["Content-Type"], first.content) == (kind, (place / name).read_bytes())
    before = (place / name).stat()
    assert client.get(f"/scan/{scan_id}/{name}").content == first.content
    assert ((place / name).stat().st_ino, (place / name).stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    (place / "mesh.ply").write_bytes((place / "mesh.ply").read_bytes()[:-1])
    damaged = client.get(f"/scan/{scan_id}/mesh.obj")
    assert (damaged.status_code, "mesh.ply has" in damaged.json()["detail"]) == (410, True)


def test_pictures_go_by_camera(client: TestClient, served: ServedBench) -> None:
    scan_id = finished(client)["id"]
    for name in ("rejected-left.png", "causes-left.png"):
        (place_of(served, scan_id) / name).write_bytes(name.encode())
        assert client.get(f"/scan/{scan_id}/{name}").content == name.encode()
    assert refusal(client, "GET", f"/scan/{scan_id}/rejected-right.png") == NOT_READY
    for path in ("rejected-..%2Fmesh.png", "points-..%2Fleft.npz"):
        assert client.get(f"/scan/{scan_id}/{path}").status_code in {404, 422}, path


def test_failed_scan_names_its_cause_and_gives_its_bundle(client: TestClient, served: ServedBench) -> None:
    served.order = "fail"
    scan = ended(client, client.post("/scan").json()["id"])
    assert scan["state"] == "failed"
    assert scan["error"]["type"] == "/problems/nothing-to-reconstruct"
    assert scan["error"]["detail"] == "No stripe was found in any frame."
    assert list(scan["links"]["files"]) == ["bundle.zip"]
    assert events_of(client.get(scan["links"]["events"]).text)[-1]["error"] == scan["error"]
    for name in ("mesh.ply", "mesh.obj"):
        never = client.get(f"/scan/{scan['id']}/{name}")
        assert never.status_code == 409
        assert "No stripe was found" in never.json()["detail"]
    assert refusal(client, "GET", f"/scan/{scan['id']}/{NAME}") == NOT_READY


def test_mesh_can_be_fetched_before_the_scan_is_over(client: TestClient, served: ServedBench) -> None:
    capturing = served.held(client)["id"]
    for name in ("mesh.ply", "bundle.zip", NAME):
        early = client.get(f"/scan/{capturing}/{name}")
        assert (early.status_code, "capturing" in early.json()["detail"]) == (409, True), name
    served.gate.set()
    ended(client, capturing)
    served.order = "mesh-first"
    scan_id = client.post("/scan").json()["id"]
    await_announcement(served.service.store, UUID(scan_id))
    scan = client.get(f"/scan/{scan_id}").json()
    assert (scan["state"], list(scan["links"]["files"])) == (
        "computing",
        ["coarse.glb", "mesh.3mf", "mesh.obj", "mesh.ply", "mesh.stl", "view.glb"],
    )
    early = client.get(scan["links"]["files"]["mesh.ply"])
    assert (early.status_code, early.headers["ETag"]) == (200, f'"{scan_id}/mesh.ply"')
    # The rig is free of it, and says what it computes.
    rig = client.get("/rig").json()
    assert (rig["holder"], rig["computing"], rig["backlog_length"]) == (None, [scan_id], 16)
    # What is made of the mesh is there with it, and kept when the scan is in its place.
    converted = {name: client.get(scan["links"]["files"][name]).content for name in ON_REQUEST}
    assert [path.name for path in served.service.folder.result(UUID(scan_id)).iterdir()] == ["mesh.ply"]
    for name in ("mesh.glb", "report.json", "bundle.zip"):
        assert refusal(client, "GET", f"/scan/{scan_id}/{name}") == NOT_READY
    (served.service.folder.staging(UUID(scan_id)) / "bundle" / "go-on").touch()
    lines = client.get(f"/scan/{scan_id}/events").text.splitlines()
    names = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    assert names.index("file") < len(names) - 1
    scan = ended(client, scan_id)
    assert (scan["state"], "report.json" in scan["links"]["files"]) == ("succeeded", True)
    assert client.get(f"/scan/{scan_id}/mesh.ply").content == early.content
    assert {name: client.get(f"/scan/{scan_id}/{name}").content for name in ON_REQUEST} == converted
    assert {path.name for path in place_of(served, scan_id).iterdir()} > set(ON_REQUEST)


def await_announcement(store: JobStore, scan_id: UUID) -> None:
    announced = threading.Event()

    def look() -> None:
        if any(event.kind == "file" for event in store.events(scan_id, after=0)):
            announced.set()

    unwatch = store.watch(scan_id, look)
    look()
    assert announced.wait(WAIT_S)
    unwatch()


def test_file_stays_readable_while_its_scan_is_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, scan_id = DataFolder(tmp_path / "data"), uuid4()
    record: Any = SimpleNamespace(id=scan_id, state=JobState.COMPUTING)
    folder.stage(scan_id)
    (folder.staging(scan_id) / "bundle").mkdir()
    folder.result(scan_id).mkdir()
    (folder.result(scan_id) / "report.json").write_bytes(b"{}")
    found = []

    def look(*_: object, **__: object) -> None:
        found.append((_made_so_far(folder, record, "report.json"), set(ready_files(folder, record))))

    look()
    monkeypatch.setattr(data_folder, "sync_tree", look)
    folder.put(scan_id, folder.scan(scan_id))
    look()
    assert found == 3 * [(b"{}", {"report.json"})]
    folder.release()


class FaultyBench(ServedBench):
    """Captures on a rig in memory, whose camera spoils every line frame."""

    def __init__(self, root: Path) -> None:
        rig = fake_rig(faults={"right": CameraFaults(garbled=frozenset(range(13, 1000)))}).rig
        # The calibration of other cameras: nothing is reconstructed.
        self.rig = replace(rig, calibration=tame_calibration())
        super().__init__(root)

    def open_rig(self) -> Rig:
        return self.rig

    def capture(self, rig: Rig, _plan: ScanPlan, folder: Path, listener: Listener, /, **options: Any) -> Recording:
        return capture_frames(rig, ScanPlan(PatternPlan()), folder, listener, **options)


@pytest.mark.slow
def test_scan_whose_frames_fail_gives_them_and_leaves_the_rig_free(tmp_path: Path) -> None:
    bench = FaultyBench(tmp_path)
    with ExitStack() as patched, client_of(bench) as client:
        patched.callback(bench.unpatch)
        scan = ended(client, client.post("/scan").json()["id"])
        assert (scan["state"], scan["error"]["type"]) == ("failed", "/problems/scan-evidence")
        assert "camera 'right', pattern 11" in scan["error"]["detail"]
        assert "The frames are kept" in scan["error"]["detail"]
        assert list(scan["links"]["files"]) == ["bundle.zip"]
        fetched = client.get(scan["links"]["files"]["bundle.zip"])
        with zipfile.ZipFile(io.BytesIO(fetched.content)) as archive:
            assert archive.testzip() is None
            listed = json.loads(archive.read("refused/refused.json"))["frames"]
            frames = json.loads(archive.read("bundle.json"))["frames"]
            assert all(each["file"] in archive.namelist() for each in [*listed, *frames])
        assert client.get("/rig").json()["holder"] is None


def camera() -> Pinhole:
    """Looks at the fake pipeline's triangle from 50 mm before it, a pixel for each millimetre."""
    matrix = np.array([[50.0, 0, 12], [0, 50, 10], [0, 0, 1]])
    return Pinhole(SIZE, matrix, np.zeros(5), np.eye(3), np.array([0.0, 0, 50]))


@pytest.fixture
def scan(client: TestClient, served: ServedBench) -> str:
    """A scan of the fake pipeline, with what a real one has for its clouds."""
    scan_id: str = finished(client)["id"]
    place = place_of(served, scan_id)
    write_calibration(place / "bundle" / "calibration.json", Calibration({"left": camera()}, camera()))
    report = json.loads((place / "report.json").read_text())
    (place / "report.json").write_text(json.dumps({**report, "causes": [{"name": "none"}, {"name": "not_lit"}]}))
    refused = np.zeros(SIZE.shape, dtype=np.uint8)
    refused[:12] = 1
    (place / "causes-left.png").write_bytes(cv2.imencode(".png", refused)[1].tobytes())
    write_entries(place)
    return scan_id


@pytest.fixture
def busy(served: ServedBench, tmp_path: Path) -> Iterator[Path]:
    gate = tmp_path / "gate"
    began = threading.Event()

    def wait_for(gate: Path) -> str:
        began.set()
        return fake_pipeline.wait_for(gate)

    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(served.worker.run, Task(wait_for, (gate,), what="examination"))
        try:
            assert began.wait(WAIT_S)
            yield gate
        finally:
            gate.touch()
            assert done.result(WAIT_S) == gate.name


@pytest.mark.slow
def test_cloud_is_listed_made_on_request_and_kept(client: TestClient, served: ServedBench, scan: str) -> None:
    place = place_of(served, scan)
    path = client.get(f"/scan/{scan}").json()["links"]["files"][NAME]
    assert path == f"/scan/{scan}/{NAME}"
    assert refusal(client, "GET", f"/scan/{scan}/points-top.npz") == NOT_READY
    assert not (place / NAME).exists()
    first = client.get(path)
    assert first.status_code == 200, first.text
    assert first.content == (place / NAME).read_bytes()
    with np.load(io.BytesIO(first.content)) as cloud:
        assert (cloud["unit"], cloud["camera"]) == ("mm", "left")
        assert cloud["causes"].tolist() == ["none", "not_lit", "no_surface"]
        np.testing.assert_allclose(cloud["points_mm"][13, 15], (3, 3, 0), atol=1e-6)
        assert [cloud["cause"][at] for at in ((11, 13), (13, 15), (29, 39))] == [1, 0, 2]
    before = (place / NAME).stat()
    assert client.get(path, headers={"If-None-Match": first.headers["ETag"]}).status_code == 304
    part = client.get(path, headers={"Range": "bytes=5-9"})
    assert (part.status_code, part.content) == (206, first.content[5:10])
    assert (place / NAME).stat().st_ino == before.st_ino


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("causes-left.png", cv2.imencode(".png", np.zeros((5, 5), dtype=np.uint8))[1].tobytes()),
        ("report.json", b"{}"),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (
                ("causes-left.png", b"no picture"),
                ("report.json", b"[]"),
                ("mesh.ply", b"ply"),
                ("bundle/calibration.json", b"{}"),
            )
        ),
    ],
)
def test_source_of_a_cloud_that_was_changed_is_named(
    client: TestClient, served: ServedBench, scan: str, tmp_path: Path, name: str, content: bytes
) -> None:
    place = place_of(served, scan)
    (place / name).write_bytes(content)
    damaged = client.get(f"/scan/{scan}/{NAME}")
    assert (damaged.status_code, name in damaged.json()["detail"]) == (410, True)
    # One that was committed so is looked at by what makes the cloud.
    write_entries(place)
    refused = client.get(f"/scan/{scan}/{NAME}")
    assert refused.status_code == 422
    assert Path(name).name in refused.json()["detail"]
    assert not [each for each in place.iterdir() if NAME in each.name]
    # Without one of its sources, or with a link for it, there is no cloud.
    (place / name).rename(tmp_path / "moved")
    (place / name).symlink_to(tmp_path / "moved")
    assert NAME not in client.get(f"/scan/{scan}").json()["links"]["files"]
    assert client.get(f"/scan/{scan}/{NAME}").status_code == 409


def test_format_without_its_library_is_not_listed(
    client: TestClient, scan: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "missing_for", lambda name: "pip install" if name.endswith(("e57", "mcap")) else None)
    files = client.get(f"/scan/{scan}").json()["links"]["files"]
    assert {"points-left.pcd", "depth-left.tiff", NAME} < set(files)
    assert not {"points-left.e57", "scan.mcap"} & set(files)
    if importlib.util.find_spec("pye57") is None:
        answer = client.get(f"/scan/{scan}/points-left.e57")
        assert (answer.status_code, answer.json()["type"]) == (501, "/problems/extra-missing")
        assert "pip install 'slrig[e57]'" in answer.json()["detail"]


@pytest.mark.slow
def test_scan_is_one_bag_of_all_its_cameras(client: TestClient, served: ServedBench, scan: str, tmp_path: Path) -> None:
    library("rosbags.rosbag2")
    bundle = place_of(served, scan) / "bundle"
    (bundle / "bundle.json").unlink()
    assert "scan.mcap" not in client.get(f"/scan/{scan}").json()["links"]["files"]
    assert client.get(f"/scan/{scan}/{'scan.mcap'}").status_code == 409
    forms, moment = {"left": CameraFormat(SIZE, 8)}, datetime(2026, 3, 4, tzinfo=UTC)
    with BundleWriter(tmp_path / "bundle", SIZE, [White()], forms, captured_at=moment) as written:
        written.add(Shot(0, "left", np.zeros(SIZE.shape, dtype=np.uint8)))
    shutil.copytree(tmp_path / "bundle", bundle, dirs_exist_ok=True)
    write_entries(bundle.parent)
    files = client.get(f"/scan/{scan}").json()["links"]["files"]
    assert client.get(files["calibration.json"]).json()["cameras"]["left"]["size_px"] == [40, 30]
    fetched = client.get(files["scan.mcap"])
    assert fetched.status_code == 200, fetched.text
    assert fetched.content == (bundle.parent / "scan.mcap").read_bytes()
    with library("rosbags.highlevel").AnyReader([bundle.parent / "scan.mcap"]) as reader:
        assert {"/slrig/left/points", "/slrig/left/image_raw"} < set(reader.topics)


def test_request_waits_for_its_turn_and_not_for_ever(
    client: TestClient, scan: str, busy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "cloud_bytes", lambda *_: b"made without kernels")
    monkeypatch.setattr(clouds, "REQUEST_WAIT_S", 0.05)
    refused = client.get(f"/scan/{scan}/{NAME}")
    assert (refused.status_code, refused.json()["type"]) == (503, "/problems/worker-busy")
    assert (refused.headers["Retry-After"], NAME in refused.json()["detail"]) == ("5", True)
    monkeypatch.setattr(clouds, "REQUEST_WAIT_S", WAIT_S)
    with ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(client.get, f"/scan/{scan}/{NAME}") for _ in range(2)]
        assert not any(each.done() for each in asked)
        busy.touch()
        assert [each.result(WAIT_S).status_code for each in asked] == [200, 200]


@pytest.mark.usefixtures("busy")
def test_import_waits_for_its_turn_and_not_for_ever(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slrig.calibrate.job.REQUEST_WAIT_S", 0.05)
    sent = {"content": b"{}", "headers": {"Content-Type": "application/json"}}
    assert refusal(client, "POST", "/calibration/import", **sent) == (503, "/problems/worker-busy")
    assert client.get("/calibration").json()["calibrations"] == []


def test_scan_that_is_deleted_meanwhile_is_not_found(
    client: TestClient, served: ServedBench, scan: str, busy: Path
) -> None:
    worker = cast("TameCompute", served.worker)
    before = worker.jobs
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(client.get, f"/scan/{scan}/{NAME}")
        while worker.jobs == before:
            assert not asked.done()
            threading.Event().wait(0.01)
        assert client.delete(f"/scan/{scan}").status_code == 204
        busy.touch()
        gone = asked.result(WAIT_S)
    assert (gone.status_code, gone.json()["type"]) == (404, "/problems/job-not-found")
    assert not place_of(served, scan).exists()


def test_full_disk_leaves_nothing_behind(client: TestClient, served: ServedBench, scan: str) -> None:
    before = sorted(place_of(served, scan).iterdir())
    served.free_bytes = 10
    assert refusal(client, "GET", f"/scan/{scan}/{NAME}") == (507, "/problems/storage")
    served.free_bytes = 10**12
    assert sorted(place_of(served, scan).iterdir()) == before


def test_lost_worker_leaves_nothing_behind(
    client: TestClient, served: ServedBench, scan: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(*_: object) -> bytes:
        raise WorkerLostError("The worker's process ended. Ask again.")

    before = sorted(place_of(served, scan).iterdir())
    with monkeypatch.context() as patched:
        patched.setattr(clouds, "cloud_bytes", crash)
        lost = client.get(f"/scan/{scan}/{NAME}")
        assert (lost.status_code, lost.json()["type"]) == (500, "/problems/worker-lost")
        assert "Ask again." in lost.json()["detail"]
    assert sorted(place_of(served, scan).iterdir()) == before
    monkeypatch.setattr(clouds, "cloud_bytes", lambda *_: b"made without kernels")
    assert client.get(f"/scan/{scan}/{NAME}").status_code == 200

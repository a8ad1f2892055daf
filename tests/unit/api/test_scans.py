"""POST /scan and all that follows from it."""

from __future__ import annotations

import io
import json
import threading
import zipfile
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
import trimesh
from fastapi.testclient import TestClient

from slrig.api.idempotency import fingerprint, own_key
from slrig.api.schemas import ScanRequest
from slrig.devices import AppliedSettings, CameraSettings
from slrig.jobs.examinations import keep
from slrig.jobs.store import JobStore
from slrig.jobs.worker import Worker
from slrig.rig.settings import SettingsInUse
from slrig.scan.artefacts import ON_REQUEST
from tests.unit.api.conftest import ServedBench, ended
from tests.unit.scan.fakes import WAIT_S


def events_of(text: str) -> list[dict[str, Any]]:
    """The events of a stream: id, kind and data."""
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

    stream = client.get(scan["links"]["events"])
    assert stream.headers["content-type"].startswith("text/event-stream")
    events = events_of(stream.text)
    assert [event["id"] for event in events] == list(range(1, len(events) + 1))
    assert events[-1]["state"] == "succeeded"
    assert {event["stage"] for event in events if event["kind"] == "progress"} >= {"capture", "decode"}

    done = client.get(scan["links"]["self"]).json()
    assert done["state"] == "succeeded"
    assert done["error"] is None
    assert done["summary"] == {"bundle": done["id"], "seconds": 1.5, "truth": {"rms_mm": 0.01}}
    files = done["links"]["files"]
    assert set(files) == {
        "bundle.zip",
        "coarse.glb",
        "mesh.3mf",
        "mesh.glb",
        "mesh.obj",
        "mesh.ply",
        "mesh.stl",
        "points.ply",
        "preview.png",
        "report.json",
        "view.glb",
    }
    for name, path in files.items():
        assert client.get(path).status_code == 200, name
    assert client.get(files["report.json"]).json()["truth"] == {"rms_mm": 0.01}


@pytest.mark.parametrize("name", ["mesh.obj", "mesh.stl", "view.glb", "coarse.glb"])
def test_other_formats_of_the_mesh_are_made_when_asked_for_and_kept(
    client: TestClient, served: ServedBench, name: str
) -> None:
    scan = client.post("/scan").json()
    assert client.get(f"/scan/{scan['id']}/{name}").status_code in {200, 409}
    ended(client, scan["id"])
    place = served.service.folder.scan(UUID(scan["id"]))
    assert (place / "mesh.ply").is_file()
    first = client.get(f"/scan/{scan['id']}/{name}")
    made = place / name
    assert first.content == made.read_bytes()
    found = trimesh.load(io.BytesIO(first.content), file_type=name[-3:], process=False)
    if isinstance(found, trimesh.Scene):
        assert first.headers["Content-Type"] == "model/gltf-binary"
        (found,) = found.dump()
        found.apply_transform(np.diag([1000, -1000, -1000, 1]))
    np.testing.assert_allclose(found.triangles, [[[0, 0, 0], [10, 0, 0], [0, 10, 0]]], rtol=0, atol=1e-9)
    before = made.stat()
    part = client.get(f"/scan/{scan['id']}/{name}", headers={"Range": "bytes=5-9"})
    assert (part.status_code, part.content) == (206, first.content[5:10])
    assert client.head(f"/scan/{scan['id']}/{name}").headers["Content-Length"] == str(len(first.content))
    assert (made.stat().st_ino, made.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_a_mesh_that_was_changed_is_told_and_a_failed_scan_has_no_other_formats(
    client: TestClient, served: ServedBench
) -> None:
    scan = client.post("/scan").json()
    ended(client, scan["id"])
    ply = served.service.folder.scan(UUID(scan["id"])) / "mesh.ply"
    ply.write_bytes(ply.read_bytes()[:-1])
    refused = client.get(f"/scan/{scan['id']}/mesh.obj")
    assert refused.status_code == 422
    assert "reconstruct the bundle again" in refused.json()["detail"]
    served.order = "fail"
    failed = client.post("/scan").json()
    assert "mesh.obj" not in ended(client, failed["id"])["links"]["files"]
    assert client.get(f"/scan/{failed['id']}/mesh.obj").status_code == 409


def test_plan_is_request_over_rig_file_over_default(client: TestClient) -> None:
    request = {"patterns": {"line_width_px": 2}, "reconstruction": {"keep_holes": True, "flip_rule": "delaunay"}}
    plan = client.post("/scan", json=request).json()["plan"]
    assert plan["patterns"]["line_width_px"] == 2
    assert plan["patterns"]["line_shift_period_px"] == 6
    assert plan["patterns"]["rows"] is None
    assert plan["reconstruction"] == {
        "keep_holes": True,
        "depth_edge_ratio": 6.0,
        "max_code_gap": 1,
        "flip_rule": "delaunay",
        "smooth_boundary": True,
        "axis": None,
        "region": None,
    }
    # The rig file's exposure belongs to its cameras, not to the plan.
    assert plan["exposure_s"] is None
    assert (plan["turn_deg"], plan["turned_by"]) == (None, "table")


def test_the_angle_of_the_stage_is_told_by_hand_and_refused_where_nothing_turns(client: TestClient) -> None:
    by_hand = client.post("/scan", json={"turn_deg": -45, "turned_by": "hand"}).json()
    assert (by_hand["plan"]["turn_deg"], by_hand["plan"]["turned_by"]) == (-45.0, "hand")
    assert ended(client, by_hand["id"])["state"] == "succeeded"
    refused = client.post("/scan", json={"turn_deg": 45})
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/unsupported-by-device")
    assert "this rig has no turntable. Turn it by hand, and say so" in refused.json()["detail"]
    for body in ('{"turn_deg": NaN}', '{"turn_deg": 1e9}', '{"turned_by": "hand"}', '{"turn_deg": 1, "turned_by": 2}'):
        headers = {"Content-Type": "application/json"}
        assert client.post("/scan", content=body, headers=headers).status_code in {400, 422}, body


def test_stream_resumes_after_the_event_that_was_seen(client: TestClient) -> None:
    scan = client.post("/scan").json()
    path = scan["links"]["events"]
    everything = events_of(client.get(path).text)
    rest = events_of(client.get(path, headers={"Last-Event-ID": "3"}).text)
    assert rest == everything[3:]
    over = client.get(path, headers={"Last-Event-ID": str(everything[-1]["id"])})
    assert (over.status_code, over.content) == (204, b"")


@pytest.mark.parametrize("name", ["mesh.ply", "bundle.zip", "preview.png"])
def test_head_tells_what_a_file_is_without_the_file(client: TestClient, name: str) -> None:
    scan = ended(client, client.post("/scan").json()["id"])
    path = scan["links"]["files"][name]
    whole, head = client.get(path), client.head(path)
    assert (head.status_code, head.content) == (200, b"")
    for header in ("etag", "content-type", "cache-control", "content-length"):
        assert head.headers.get(header) == whole.headers.get(header), header
    assert client.head(f"/scan/{uuid4()}/{name}").status_code == 404


def test_key_of_a_deleted_scan_is_told_as_such(client: TestClient) -> None:
    headers = {"Idempotency-Key": "gone"}
    scan = ended(client, client.post("/scan", headers=headers).json()["id"])
    client.delete(scan["links"]["self"])
    again = client.post("/scan", headers=headers)
    assert (again.status_code, again.json()["type"]) == (404, "/problems/job-not-found")
    assert "404" in client.get("/openapi.json").json()["paths"]["/scan"]["post"]["responses"]


def test_busy_rig_names_its_holder(client: TestClient, served: ServedBench) -> None:
    holder = served.held(client)
    busy = client.post("/scan")
    assert busy.status_code == 409
    problem = busy.json()
    assert problem["type"] == "/problems/rig-busy"
    assert problem["holder"] == holder["id"]
    assert problem["since"].startswith("20")
    assert busy.headers["Retry-After"] == "5"
    assert client.get("/rig").json()["holder"] == holder["id"]


def test_queue_takes_what_it_may_and_no_more(client: TestClient, served: ServedBench) -> None:
    served.held(client)
    queued = client.post("/scan", json={"if_busy": "queue"})
    assert queued.status_code == 202
    full = client.post("/scan", json={"if_busy": "queue"})
    assert (full.status_code, full.json()["type"]) == (429, "/problems/queue-full")
    assert full.headers["Retry-After"] == "30"
    served.gate.set()
    assert ended(client, queued.json()["id"])["state"] == "succeeded"


def test_a_series_is_one_request_and_many_scans(client: TestClient) -> None:
    first = client.post("/scan", json={"repeat": 3, "label": "row"}).json()
    series = first["links"]["series"]
    scans = [ended(client, each["id"]) for each in client.get(series).json()["scans"]]
    assert [(each["state"], each["label"], each["plan"]["series"]["number"]) for each in scans] == [
        ("succeeded", "row", number) for number in (1, 2, 3)
    ]
    assert scans[0]["id"] == first["id"]
    assert ended(client, client.post("/scan").json()["id"])["links"]["series"] is None


def test_a_series_that_waits_for_its_time_is_cancelled_as_one(client: TestClient) -> None:
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


@pytest.mark.parametrize("request_", [{"every_s": 5}, {"repeat": 0}, {"repeat": 501}, {"repeat": 2, "every_s": -1}])
def test_a_series_that_is_none_is_refused(client: TestClient, request_: dict[str, float]) -> None:
    refused = client.post("/scan", json=request_)
    assert refused.status_code == 422
    assert {"repeat", "every_s"} & set(refused.text.replace('"', " ").replace(".", " ").split())


def test_cancel_may_be_repeated(client: TestClient, served: ServedBench) -> None:
    scan = served.held(client)
    assert client.post(scan["links"]["cancel"]).status_code == 202
    assert ended(client, scan["id"])["state"] == "cancelled"
    again = client.post(scan["links"]["cancel"])
    assert (again.status_code, again.json()["state"]) == (202, "cancelled")


def test_delete_waits_for_the_end_and_is_final(client: TestClient, served: ServedBench) -> None:
    scan = served.held(client)
    refused = client.delete(scan["links"]["self"])
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/scan-state")
    served.gate.set()
    ended(client, scan["id"])
    assert client.delete(scan["links"]["self"]).status_code == 204
    assert client.get(scan["links"]["self"]).status_code == 404
    assert client.delete(scan["links"]["self"]).status_code == 404


def test_repeated_request_gets_the_same_scan_and_the_same_answer(client: TestClient) -> None:
    headers = {"Idempotency-Key": "night-run"}
    first = client.post("/scan", json={"label": "a"}, headers=headers)
    ended(client, first.json()["id"])
    second = client.post("/scan", json={"label": "a"}, headers=headers)
    assert (second.status_code, second.headers["Location"]) == (202, first.headers["Location"])
    assert second.json() == first.json()
    other = client.post("/scan", json={"label": "b"}, headers=headers)
    assert (other.status_code, other.json()["type"]) == (422, "/problems/idempotency")
    assert len(client.get("/scan").json()["scans"]) == 1


def test_refused_request_leaves_its_key_free(client: TestClient, served: ServedBench) -> None:
    holder = served.held(client)
    headers = {"Idempotency-Key": "try-again"}
    assert client.post("/scan", headers=headers).status_code == 409
    served.gate.set()
    ended(client, holder["id"])
    assert client.post("/scan", headers=headers).status_code == 202


def test_key_in_flight_is_refused_for_a_moment(client: TestClient, served: ServedBench) -> None:
    served.service.keys.reserve(own_key("slow", "/scan"), fingerprint(ScanRequest()))
    refused = client.post("/scan", headers={"Idempotency-Key": "slow"})
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/key-in-flight")
    assert refused.headers["Retry-After"] == "1"
    served.service.keys.release_all()
    assert client.post("/scan", headers={"Idempotency-Key": "slow"}).status_code == 202


def test_list_is_paged_from_new_to_old(client: TestClient) -> None:
    made = []
    for _ in range(3):
        made.append(client.post("/scan").json()["id"])
        ended(client, made[-1])
    first = client.get("/scan", params={"limit": 2})
    page = first.json()
    assert [scan["id"] for scan in page["scans"]] == [made[2], made[1]]
    assert first.headers["Link"] == f'<{page["next"]}>; rel="next"'
    last = client.get(page["next"])
    assert [scan["id"] for scan in last.json()["scans"]] == [made[0]]
    assert last.json()["next"] is None
    assert "Link" not in last.headers


def test_file_is_not_ready_until_it_is(client: TestClient, served: ServedBench) -> None:
    scan = served.held(client)
    early = client.get(f"/scan/{scan['id']}/mesh.ply")
    assert (early.status_code, early.json()["type"]) == (409, "/problems/artefact-not-ready")
    assert "capturing" in early.json()["detail"]
    assert client.get(f"/scan/{scan['id']}/bundle.zip").status_code == 409


def test_mesh_can_be_fetched_while_pictures_and_figures_are_made(client: TestClient, served: ServedBench) -> None:
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
    # What is not there yet waits for the end.
    for name in ("mesh.glb", "report.json", "bundle.zip"):
        refused = client.get(f"/scan/{scan_id}/{name}")
        assert (refused.status_code, refused.json()["type"]) == (409, "/problems/artefact-not-ready")
    (served.service.folder.staging(UUID(scan_id)) / "bundle" / "go-on").touch()
    lines = client.get(f"/scan/{scan_id}/events").text.splitlines()
    names = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    assert names.index("file") < len(names) - 1
    scan = ended(client, scan_id)
    assert (scan["state"], "report.json" in scan["links"]["files"]) == ("succeeded", True)
    assert client.get(f"/scan/{scan_id}/mesh.ply").content == early.content
    assert {name: client.get(f"/scan/{scan_id}/{name}").content for name in ON_REQUEST} == converted
    assert {path.name for path in served.service.folder.scan(UUID(scan_id)).iterdir()} > set(ON_REQUEST)


def await_announcement(store: JobStore, scan_id: UUID) -> None:
    """Wait until a file of a scan was announced."""
    announced = threading.Event()

    def look() -> None:
        if any(event.kind == "file" for event in store.events(scan_id, after=0)):
            announced.set()

    unwatch = store.watch(scan_id, look)
    look()
    assert announced.wait(WAIT_S)
    unwatch()


def test_failed_scan_tells_why_and_gives_its_bundle(client: TestClient, served: ServedBench) -> None:
    served.order = "fail"
    scan = ended(client, client.post("/scan").json()["id"])
    assert scan["state"] == "failed"
    assert scan["error"]["type"] == "/problems/nothing-to-reconstruct"
    assert scan["error"]["detail"] == "No stripe was found in any frame."
    assert list(scan["links"]["files"]) == ["bundle.zip"]
    never = client.get(f"/scan/{scan['id']}/mesh.ply")
    assert never.status_code == 409
    assert "No stripe was found" in never.json()["detail"]
    last = events_of(client.get(scan["links"]["events"]).text)[-1]
    assert last["error"] == scan["error"]


def test_bundle_comes_as_a_zip_that_is_the_same_twice(client: TestClient, served: ServedBench) -> None:
    scan = ended(client, client.post("/scan").json()["id"])
    first = client.get(scan["links"]["files"]["bundle.zip"])
    assert first.headers["content-type"] == "application/zip"
    assert first.headers["content-disposition"] == f'attachment; filename="{scan["id"]}.zip"'
    assert client.get(scan["links"]["files"]["bundle.zip"]).content == first.content
    with zipfile.ZipFile(io.BytesIO(first.content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == ["bundle.json", "frames/000.png", "order"]
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        stored = served.service.folder.scans / scan["id"] / "bundle" / "frames" / "000.png"
        assert archive.read("frames/000.png") == stored.read_bytes()


@pytest.mark.parametrize("name", ["mesh.ply", "bundle.zip"])
def test_known_file_is_not_sent_again(client: TestClient, name: str) -> None:
    scan = ended(client, client.post("/scan").json()["id"])
    path = scan["links"]["files"][name]
    tag = client.get(path).headers["ETag"]
    for known in (tag, f'"other", W/{tag}', "*"):
        again = client.get(path, headers={"If-None-Match": known})
        assert (again.status_code, again.content, again.headers["ETag"]) == (304, b"", tag)
    assert client.get(path, headers={"If-None-Match": '"other"'}).status_code == 200


def test_part_of_a_file_may_be_asked_for(client: TestClient) -> None:
    scan = ended(client, client.post("/scan").json()["id"])
    path = scan["links"]["files"]["mesh.ply"]
    whole = client.get(path).content
    part = client.get(path, headers={"Range": "bytes=3-5"})
    assert (part.status_code, part.content) == (206, whole[3:6])
    beyond = client.get(path, headers={"Range": "bytes=99999-"})
    assert (beyond.status_code, beyond.headers["content-type"]) == (416, "application/problem+json")
    assert beyond.headers["content-range"] == f"bytes */{len(whole)}"


def test_picture_of_refused_pixels_goes_by_camera(client: TestClient, served: ServedBench) -> None:
    scan = ended(client, client.post("/scan").json()["id"])
    (served.service.folder.scans / scan["id"] / "rejected-left.png").write_bytes(b"png")
    assert client.get(f"/scan/{scan['id']}/rejected-left.png").content == b"png"
    assert client.get(f"/scan/{scan['id']}/rejected-right.png").status_code == 409
    (served.service.folder.scans / scan["id"] / "causes-left.png").write_bytes(b"grey")
    assert client.get(f"/scan/{scan['id']}/causes-left.png").content == b"grey"
    assert client.get(f"/scan/{scan['id']}/rejected-..%2Fmesh.png").status_code in {404, 422}


def test_unknown_scan_is_not_found_anywhere(client: TestClient) -> None:
    unknown = uuid4()
    for path in ("", "/events", "/mesh.ply", "/bundle.zip"):
        response = client.get(f"/scan/{unknown}{path}")
        assert (response.status_code, response.json()["type"]) == (404, "/problems/job-not-found"), path
    assert client.post(f"/scan/{unknown}/cancel").status_code == 404


def test_disk_without_room_is_told_before_the_scan(client: TestClient, served: ServedBench) -> None:
    ended(client, client.post("/scan").json()["id"])
    served.free_bytes = 10
    refused = client.post("/scan")
    ready = client.get("/readyz")
    served.free_bytes = 10**12
    assert (refused.status_code, refused.json()["type"]) == (507, "/problems/storage")
    assert (ready.status_code, ready.json()["type"]) == (503, "/problems/not-ready")
    assert ready.json()["checks"]["rig"] == "ok"
    assert "are free" in ready.json()["checks"]["disk"]


def test_rig_says_what_it_is_and_how_its_cameras_are_set(client: TestClient, served: ServedBench) -> None:
    ended(client, client.post("/scan").json()["id"])
    camera = client.get("/rig").json()["cameras"][0]
    assert (camera["exposure_s"], camera["gain"], camera["notes"]) == (None, None, [])
    settings = served.service.runner.queue.rig.settings
    settings[camera["name"]] = SettingsInUse(CameraSettings(0.02), AppliedSettings(0.01, 1.0))
    camera = client.get("/rig").json()["cameras"][0]
    assert (camera["exposure_s"], camera["gain"]) == (0.01, 1.0)
    assert "asked for an exposure of 20 ms, and uses 10 ms" in camera["notes"][0]
    settings.clear()
    rig = client.get("/rig").json()
    assert (rig["name"], rig["open"], rig["error"], rig["holder"]) == ("bench", True, None, None)
    assert rig["cameras"][0]["size_px"] == [64, 48]
    assert rig["projector"]["size_px"] == [64, 40]
    assert rig["scan_defaults"] == {"line_shift_period_px": 6, "exposure_s": 0.5}


def test_drivers_and_devices_are_listed(client: TestClient) -> None:
    found = client.get("/device").json()
    assert ("head", "simulated", None) in [(each["kind"], each["name"], each["fault"]) for each in found["drivers"]]


def test_last_examinations_of_the_rig_are_shown_with_what_to_run(client: TestClient, served: ServedBench) -> None:
    root = served.service.folder.root
    found = client.get("/rig/examinations").json()
    assert (found["doctor"], found["conform"]) == (None, None)
    assert found["commands"]["doctor"] == f"slrig doctor RIG.toml --data {root}"
    for rig in ("bench", "another"):
        keep(root, "doctor" if rig == "bench" else "conform", {"rig": rig, "findings": []})
    found = client.get("/rig/examinations").json()
    assert found["doctor"]["found"] == {"rig": "bench", "findings": []}
    assert found["conform"] is None


def test_probes_are_well(client: TestClient) -> None:
    ended(client, client.post("/scan").json()["id"])
    assert client.get("/livez").json()["checks"] == {"process": "ok"}
    assert client.get("/readyz").json() == {
        "checks": {"records": "ok", "disk": "ok", "rig": "ok", "reconstruction": "ok"},
        "pending": [],
    }


@pytest.mark.parametrize(
    ("condition", "pending"),
    [
        ("loading", ["reconstruction"]),
        ("preparing kernels, first time only: 41 of 118", ["reconstruction"]),
        ("the reconstruction cannot be loaded: its process ended", []),
    ],
)
def test_service_is_not_ready_before_its_reconstruction_is(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, condition: str, pending: list[str]
) -> None:
    ended(client, client.post("/scan").json()["id"])
    monkeypatch.setattr(Worker, "condition", condition)
    monkeypatch.setattr(Worker, "loading", bool(pending))
    ready = client.get("/readyz")
    assert (ready.status_code, ready.json()["checks"]["reconstruction"]) == (503, condition)
    assert ready.json()["pending"] == pending
    assert f"reconstruction: {condition}" in ready.json()["detail"]

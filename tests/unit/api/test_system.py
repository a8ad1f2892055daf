"""What a service says of itself: the rig, its probes, metrics and traces; and a data folder that is gone."""

from __future__ import annotations

import asyncio
import importlib.metadata
import json
import threading
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from starlette.types import Message, Receive, Scope, Send
from structlog.testing import capture_logs

from slrig.api import service as latency
from slrig.api.service import Durations, Latency
from slrig.capture.latency import CameraLatency, LatencyMeasurement
from slrig.conformance import CheckOutcome, CheckResult, ConformanceReport, Failure
from slrig.conformance import job as conforming
from slrig.devices import AppliedSettings, CameraSettings
from slrig.doctor import job as examining
from slrig.doctor import keep
from slrig.errors import ScanEvidenceError
from slrig.rig.watchdog import SettingsInUse
from tests.core import parametrize_core
from tests.unit.api.conftest import ServedBench, client_of, ended
from tests.unit.api.test_access import PATHS, filled
from tests.unit.command import done, refused, slrig
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan.fakes import WAIT_S

ANSWERS, JOBS, STAGES = (
    "slrig_http_response_start_seconds",
    "slrig_job_duration_seconds",
    "slrig_job_stage_duration_seconds",
)


def test_rig_says_what_it_is_and_how_its_cameras_are_set(client: TestClient, served: ServedBench) -> None:
    ended(client, client.post("/scan").json()["id"])
    rig = client.get("/rig").json()
    assert (rig["name"], rig["open"], rig["error"], rig["holder"]) == ("bench", True, None, None)
    assert rig["projector"]["size_px"] == [64, 40]
    assert rig["scan_defaults"] == {"line_shift_period_px": 6, "exposure_s": 0.5}
    (camera,) = rig["cameras"]
    assert (camera["size_px"], camera["exposure_s"], camera["gain"], camera["notes"]) == ([64, 48], None, None, [])
    settings = served.service.manager.rig.settings
    settings[camera["name"]] = SettingsInUse(CameraSettings(0.02), AppliedSettings(0.01, 1.0))
    (camera,) = client.get("/rig").json()["cameras"]
    settings.clear()
    assert (camera["exposure_s"], camera["gain"]) == (0.01, 1.0)
    assert "uses an exposure of 10 ms instead of 20 ms" in camera["notes"][0]


def test_a_webhook_is_set_by_request_and_its_address_is_not_told(client: TestClient) -> None:
    assert client.get("/notices").json() == {"receivers": []}
    assert client.put("/notices/webhook", json={"url": "ftp://host/hidden"}).status_code == 422
    assert client.post("/notices/webhook/test").status_code == 422
    put = client.put("/notices/webhook", json={"url": "http://host/hidden", "kinds": ["run.failed"]})
    (receiver,) = client.get("/notices").json()["receivers"]
    assert (receiver["host"], receiver["kinds"], receiver["fixed"]) == ("host", ["run.failed"], False)
    assert (put.status_code, "hidden" in put.text) == (200, False)
    assert client.delete("/notices/webhook").status_code == 204
    assert client.get("/notices").json() == {"receivers": []}


def test_service_tells_its_version_disk_and_damage(client: TestClient) -> None:
    found = client.get("/service").json()
    assert found["version"] == importlib.metadata.version("slrig")
    assert 0 < found["free_bytes"] < found["total_bytes"]
    assert found["damaged"] == {}


@pytest.mark.slow
def test_drivers_and_devices_are_listed(client: TestClient) -> None:
    found = client.get("/device").json()
    assert ("head", "simulated", None) in [(each["kind"], each["name"], each["fault"]) for each in found["drivers"]]


def no_light(*_: object, **__: object) -> LatencyMeasurement:
    raise ScanEvidenceError("camera 'cam0' sees no flash")


EXAMINATIONS = {"doctor": "healthy", "latency": "cameras", "conformance": "checks"}


def test_an_examination_is_a_job_whose_result_is_shown_as_the_last(
    client: TestClient, served: ServedBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    times_s = dict.fromkeys((each.name for each in fields(CameraLatency)), 0.01)
    latency = CameraLatency(**times_s)  # type: ignore[arg-type] # numbers, and none of them counts
    monkeypatch.setattr(examining, "measure_latency", lambda *_, **__: LatencyMeasurement({"cam0": latency}, 1e-4))
    report = ConformanceReport("bench", (CheckResult("one", "One", CheckOutcome.PASSED, 0.1),), 0.1)
    monkeypatch.setattr(conforming, "run_checks", lambda *_, **__: report)
    keep(served.service.folder.root, "latency", {"rig": "another"})
    assert client.get("/rig/examinations").json() == dict.fromkeys(EXAMINATIONS)
    for kind, has in EXAMINATIONS.items():
        answer = client.post(f"/rig/{kind}", headers={"Idempotency-Key": "one"})
        begun = answer.json()
        assert (answer.status_code, answer.headers["Location"]) == (202, begun["links"]["self"])
        assert client.post(f"/rig/{kind}", headers={"Idempotency-Key": "one"}).json()["id"] == begun["id"]
        assert "succeeded" in client.get(begun["links"]["events"]).text
        done = client.get(begun["links"]["self"]).json()
        assert (done["state"], done["error"], done["summary"]["rig"]) == ("succeeded", None, "bench")
        assert has in done["summary"]
        assert client.get(begun["links"]["last"]).json()[kind]["found"] == done["summary"]
    assert done["summary"]["checks"][0]["outcome"] == "passed"


@pytest.mark.slow
@pytest.mark.usefixtures("commands")
def test_without_a_rig_file_the_commands_examine_the_rig_of_the_service(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = json.loads(done("doctor", "--json"))
    assert (found["rig"], found["healthy"]) == ("bench", True)
    assert "no faults, no notes" in done("doctor")
    assert "Name the old one, too." in refused(slrig("doctor", "--output", tmp_path / "new.toml"))
    report = ConformanceReport(
        "bench", (CheckResult("one", "One", CheckOutcome.FAILED, 0.1, Failure("a", "b", "c")),), 0.1
    )
    monkeypatch.setattr(conforming, "run_checks", lambda *_, **__: report)
    shown = slrig("conform")
    assert (shown.exit_code, "0 %: 0 of 1 checks" in shown.stdout) == (1, True)
    monkeypatch.setattr(examining, "measure_latency", no_light)
    assert "camera 'cam0' sees no flash" in refused(slrig("latency"))


@parametrize_core("kind", EXAMINATIONS)
def test_an_examination_holds_the_rig_and_can_be_cancelled(client: TestClient, served: ServedBench, kind: str) -> None:
    scan = served.held(client)
    refused = client.post(f"/rig/{kind}")
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/rig-busy")
    waiting = client.post(f"/rig/{kind}", json={"if_busy": "queue"}).json()
    assert client.post(waiting["links"]["cancel"]).json()["state"] == "cancelled"
    served.gate.set()
    ended(client, scan["id"])
    missing = client.get(f"/rig/job/{scan['id']}")
    assert (missing.status_code, missing.json()["type"]) == (404, "/problems/job-not-found")


def test_probes_say_what_is_missing(client: TestClient, served: ServedBench, monkeypatch: pytest.MonkeyPatch) -> None:
    ended(client, client.post("/scan").json()["id"])
    assert client.get("/livez").json()["checks"] == {"process": "ok"}
    assert client.get("/readyz").json() == {
        "checks": {"records": "ok", "disk": "ok", "rig": "ok", "reconstruction": "ok", "threads": "ok"},
        "pending": [],
    }
    served.free_bytes = 10
    refused, ready = client.post("/scan"), client.get("/readyz")
    served.free_bytes = 10**12
    assert (refused.status_code, refused.json()["type"]) == (507, "/problems/storage")
    assert (ready.status_code, ready.json()["type"]) == (503, "/problems/not-ready")
    assert ready.json()["checks"]["rig"] == "ok"
    assert "are free" in ready.json()["checks"]["disk"]
    for condition, pending in (
        ("loading", ["reconstruction"]),
        ("preparing kernels, first time only: 41 of 118", ["reconstruction"]),
        ("the reconstruction cannot be loaded: its process ended", []),
    ):
        monkeypatch.setattr(TameCompute, "condition", condition)
        monkeypatch.setattr(TameCompute, "loading", bool(pending))
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["checks"]["reconstruction"]) == (503, condition)
        assert ready.json()["pending"] == pending
        assert f"reconstruction: {condition}" in ready.json()["detail"]


def test_an_observer_that_fails_keeps_nothing_from_the_others(client: TestClient, served: ServedBench) -> None:
    told = threading.Event()

    class Odd:
        def ended(self, *_: object) -> None:
            raise SystemExit(3)

        close = ended

    class Whole:
        def ended(self, *_: object) -> None:
            told.set()

        def close(self) -> None:
            return

    served.service.observers[:] = [Odd(), Whole()]
    with capture_logs() as logs:
        ended(client, client.post("/scan").json()["id"])
        assert told.wait(WAIT_S)
    assert [line["observer"] for line in logs if line["event"] == "an observer failed"] == ["Odd"]
    assert client.get("/readyz").status_code == 200


@pytest.mark.slow
def test_service_whose_data_folder_is_gone_says_so(tmp_path: Path) -> None:
    # It is not started: nothing but requests uses its folder.
    idle = ServedBench(tmp_path / "data")
    idle.unpatch()
    client = client_of(idle)
    root = idle.service.folder.root
    away = root.with_name("away")
    root.rename(away)
    without = {"/livez", "/device", "/problems/{name}", "/calibration/board.pdf"}
    for path, operations in PATHS.items():
        for method in operations:
            if path in without or path.startswith("/session"):
                continue
            answer = client.request(method, filled(path))
            assert answer.status_code in ({422, 503} if method in {"post", "get"} else {503}), (method, path)
            if path == "/readyz":
                assert "is gone, or empty" in answer.json()["checks"]["disk"]
            elif answer.status_code == 503:
                assert answer.json()["type"] == "/problems/data-folder-gone"
    assert client.get("/livez").status_code == 200
    away.rename(root)
    assert client.get("/scan").status_code == 200
    idle.service.close()


def counted(text: str, name: str) -> dict[tuple[str, ...], float]:
    (family,) = [each for each in text_string_to_metric_families(text) if each.name == name]
    assert family.type == "histogram"
    return {tuple(sample.labels.values()): sample.value for sample in family.samples if sample.name == f"{name}_count"}


def test_answers_and_jobs_are_counted_by_names_that_no_client_can_choose(client: TestClient) -> None:
    before = client.get("/metrics").text
    scan = client.post("/scan").json()["id"]
    ended(client, scan)
    client.head(f"/scan/{scan}/mesh.ply")
    client.get("/scan/none")
    client.get(f"/nothing/{scan}")
    client.request(scan[:8].upper(), "/scan")
    assert client.get("/metrics", headers={"Authorization": "Bearer another key"}).status_code == 401
    after = client.get("/metrics").text
    assert scan not in after
    known = counted(before, ANSWERS)
    more = {labels: count - known.get(labels, 0) for labels, count in counted(after, ANSWERS).items()}
    assert {labels: count for labels, count in more.items() if count} == {
        ("GET", "/metrics", "2xx"): 1,
        ("POST", "/scan", "2xx"): 1,
        ("GET", "/scan/{scan_id}/events", "2xx"): 1,
        ("GET", "/scan/{scan_id}", "2xx"): 1,
        ("HEAD", "/scan/{scan_id}/mesh.ply", "2xx"): 1,
        ("GET", "/scan/{scan_id}", "4xx"): 1,
        ("GET", "other", "4xx"): 2,
        ("other", "other", "4xx"): 1,
    }
    ended_before = counted(before, JOBS).get(("scan", "succeeded"), 0)
    assert counted(after, JOBS)["scan", "succeeded"] == ended_before + 1
    stages = counted(after, STAGES)
    assert {stage for kind, stage in stages if kind == "scan"} >= {"queued", "capturing", "computing"}


@pytest.mark.parametrize("fails", [False, True])
def test_answer_is_measured_until_it_begins(fails: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    durations, now_s = Durations(), 100.0
    monkeypatch.setattr(latency, "time", type("Clock", (), {"perf_counter": staticmethod(lambda: now_s)}))

    async def app(_scope: Scope, _receive: Receive, send: Send) -> None:
        nonlocal now_s
        now_s += 0.25
        if fails:
            raise ValueError("no")
        await send({"type": "http.response.start", "status": 200, "headers": []})
        now_s += 60
        await send({"type": "http.response.body", "body": b""})

    async def nothing(*_: Any) -> Message:
        return {}

    scope = {"type": "http", "method": "GET", "path": "/x", "route": None}
    served: Any = Latency(app, durations=durations)(scope, nothing, nothing)  # type: ignore[arg-type] # nobody reads it
    if fails:
        with pytest.raises(ValueError, match="no"):
            asyncio.run(served)
    else:
        asyncio.run(served)
    labels = {"method": "GET", "path": "other", "status": "5xx" if fails else "2xx"}
    assert durations.registry.get_sample_value(f"{ANSWERS}_count", labels) == 1
    assert durations.registry.get_sample_value(f"{ANSWERS}_sum", labels) == pytest.approx(0.25)

"""/metrics: how long answers, jobs and stages took, by names that nobody outside can choose."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from starlette.types import Message, Receive, Scope, Send

from slrig.api.latency import Durations, Latency
from tests.unit.api.conftest import ended


def counted(text: str, name: str) -> dict[tuple[str, ...], float]:
    """How often a histogram was told of each of its labels."""
    (family,) = [each for each in text_string_to_metric_families(text) if each.name == name]
    assert family.type == "histogram"
    return {tuple(sample.labels.values()): sample.value for sample in family.samples if sample.name == f"{name}_count"}


ANSWERS, JOBS, STAGES = (
    "slrig_http_response_start_seconds",
    "slrig_job_duration_seconds",
    "slrig_job_stage_duration_seconds",
)


def test_answers_are_counted_by_route_and_class_of_status(client: TestClient) -> None:
    before = counted(client.get("/metrics").text, ANSWERS)
    scan = client.post("/scan").json()["id"]
    ended(client, scan)
    client.head(f"/scan/{scan}/mesh.ply")
    client.get("/scan/none")
    client.get(f"/nothing/{scan}")
    client.request(scan[:8].upper(), "/scan")
    client.get("/rig", headers={"Authorization": "Bearer none"})
    after = counted(client.get("/metrics").text, ANSWERS)
    more = {labels: count - before.get(labels, 0) for labels, count in after.items()}
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
    assert scan not in client.get("/metrics").text


def test_jobs_and_their_stages_are_counted_at_their_end(client: TestClient) -> None:
    before = counted(client.get("/metrics").text, JOBS).get(("scan", "succeeded"), 0)
    ended(client, client.post("/scan").json()["id"])
    text = client.get("/metrics").text
    assert counted(text, JOBS)["scan", "succeeded"] == before + 1
    stages = counted(text, STAGES)
    assert {stage for kind, stage in stages if kind == "scan"} >= {"queued", "capturing", "computing"}


@pytest.mark.parametrize("fails", [False, True])
def test_stream_is_measured_until_it_begins_and_failure_counts(fails: bool) -> None:
    durations = Durations()

    async def app(_scope: Scope, _receive: Receive, send: Send) -> None:
        if fails:
            message = "no"
            raise ValueError(message)
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await asyncio.sleep(0.3)
        await send({"type": "http.response.body", "body": b""})

    async def nothing(*_: Any) -> Message:
        return {}

    async def ask() -> None:
        scope = {"type": "http", "method": "GET", "path": "/x", "route": None}
        await Latency(app, durations=durations)(scope, nothing, nothing)  # type: ignore[arg-type] # an answer to nobody

    if fails:
        with pytest.raises(ValueError, match="no"):
            asyncio.run(ask())
    else:
        asyncio.run(ask())
    status = "5xx" if fails else "2xx"
    labels = {"method": "GET", "path": "other", "status": status}
    assert durations.registry.get_sample_value(f"{ANSWERS}_count", labels) == 1
    waited_s = durations.registry.get_sample_value(f"{ANSWERS}_sum", labels)
    assert waited_s is not None
    assert waited_s < 0.25

"""Jobs as OpenTelemetry traces, taken by a collector on loopback."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from slrig.errors import ConfigError
from slrig.extras.telemetry import traces_by_environment
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.store import JobStore
from tests.unit.api.conftest import ServedBench, client_of, ended

pytestmark = pytest.mark.slow

WHY = "needs OpenTelemetry: pip install 'slrig[telemetry]'"
EXPORTER = "opentelemetry.exporter.otlp.proto.http.trace_exporter"


class Collector(HTTPServer):
    """Takes OTLP over HTTP on loopback."""

    def __init__(self) -> None:
        self.bodies: list[bytes] = []
        taken = self.bodies

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                assert self.path == "/v1/traces"
                taken.append(self.rfile.read(int(self.headers["Content-Length"])))
                self.send_response(200)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                """Nothing."""

        super().__init__(("127.0.0.1", 0), Handler)

    def spans(self) -> tuple[dict[str, Any], list[Any]]:
        messages = pytest.importorskip("opentelemetry.proto.collector.trace.v1.trace_service_pb2", reason=WHY)
        found, service = [], {}
        for body in self.bodies:
            for each in messages.ExportTraceServiceRequest.FromString(body).resource_spans:
                service = {pair.key: pair.value.string_value for pair in each.resource.attributes}
                found += [span for scope in each.scope_spans for span in scope.spans]
        return service, sorted(found, key=lambda span: (span.start_time_unix_nano, -span.end_time_unix_nano))


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    pytest.importorskip(EXPORTER, reason=WHY)
    server = Collector()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def attributes(span: Any) -> dict[str, str]:
    return {pair.key: pair.value.string_value for pair in span.attributes}


def test_job_is_a_trace_with_a_span_for_each_stage(collector: Collector, tmp_path: Path) -> None:
    start = now = datetime(2026, 11, 20, 6, tzinfo=UTC)
    store = JobStore(Database(tmp_path / "slrig.sqlite"), clock=lambda: now)
    traces = traces_by_environment()
    assert traces is not None
    job = store.create({}, kind=JobKind.POSE, rig="bench", label=None).id
    for seconds, state in ((2, JobState.CAPTURING), (5, JobState.COMPUTING)):
        now += timedelta(seconds=seconds)
        store.advance(job, state)
    now += timedelta(seconds=10)
    fault = JobFailure("pose-refused", "The board is not in view.")
    store.finish(job, JobState.FAILED, fault=fault, summary={"stages_s": {"find": 4.0, "judge": 5.5}})
    traces.ended(store.get(job), store.events(job, after=0))
    traces.close()
    store.database.close()
    service, spans = collector.spans()
    assert service["service.name"] == "slrig"
    names = {span.span_id: span.name for span in spans}
    assert {
        span.name: (
            names.get(span.parent_span_id),
            span.start_time_unix_nano / 1e9 - start.timestamp(),
            (span.end_time_unix_nano - span.start_time_unix_nano) / 1e9,
        )
        for span in spans
    } == {
        "pose": (None, 0, 17),
        "queued": ("pose", 0, 2),
        "capturing": ("pose", 2, 5),
        "computing": ("pose", 7, 10),
        "find": ("computing", 7, 4),
        "judge": ("computing", 11, 5.5),
    }
    assert len(spans) == 6
    assert len({span.trace_id for span in spans}) == 1
    whole = next(span for span in spans if span.name == "pose")
    told = attributes(whole)
    assert told == {
        "slrig.job.id": str(job), "slrig.job.kind": "pose", "slrig.job.state": "failed", "slrig.rig": "bench",
        "error.type": "pose-refused",
    }  # fmt: skip
    assert (whole.status.code, whole.status.message) == (2, "The board is not in view.")
    assert all(attributes(span)["slrig.job.id"] == str(job) for span in spans)


def test_service_sends_each_of_its_jobs(collector: Collector, tmp_path: Path) -> None:
    served = ServedBench(tmp_path)
    served.gate.set()
    with ExitStack() as after, client_of(served) as client:
        after.callback(served.unpatch)
        scans = [client.post("/scan").json()["id"]]
        ended(client, scans[0])
    _, spans = collector.spans()
    jobs = [span for span in spans if not span.parent_span_id]
    assert [(span.name, attributes(span)["slrig.job.id"]) for span in jobs] == [("scan", scans[0])]


@pytest.mark.parametrize(("name", "value"), [("OTEL_SDK_DISABLED", "true"), ("OTEL_TRACES_EXPORTER", "none")])
def test_nothing_is_sent_without_a_collector(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    assert traces_by_environment() is None
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:1")
    monkeypatch.setenv(name, value)
    assert traces_by_environment() is None


def test_missing_library_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, EXPORTER, None)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "http://127.0.0.1:1/v1/traces")
    with pytest.raises(ConfigError, match=r"TRACES_ENDPOINT requests traces.*pip install 'slrig\[telemetry\]'"):
        traces_by_environment()


def test_nothing_is_loaded_without_a_collector() -> None:
    code = (
        "import sys, slrig.extras.telemetry as t; t.traces_by_environment(); print('opentelemetry.sdk' in sys.modules)"
    )
    found = subprocess.run(  # noqa: S603 - our own interpreter and code
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert found.stdout.strip() == "False"

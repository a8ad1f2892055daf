"""Jobs as OpenTelemetry traces: a span for each job, and below it one for each of its stages.

Built from the record of a job when it ends. Without OpenTelemetry's own variables in the environment the library is not
loaded.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING

from slrig.errors import ConfigError
from slrig.jobs.records import JobEvent, JobRecord, JobState, stages_of

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

_ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")

_END_S = 2.0
"""Longest wait for a collector to take the last spans when the service ends."""


def traces_by_environment() -> Traces | None:
    """Return the sender of traces that OpenTelemetry's variables configure; None without a collector or if disabled.
    Raises ConfigError: the extra is not installed.
    """
    named = next((name for name in _ENDPOINTS if os.environ.get(name)), None)
    off = os.environ.get("OTEL_SDK_DISABLED", "").strip().lower() == "true"
    if named is None or off or os.environ.get("OTEL_TRACES_EXPORTER", "").strip().lower() == "none":
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        message = (
            f"{named} requests traces, and OpenTelemetry's library is not installed ({error}). Install it with: "
            f"pip install 'slrig[telemetry]', or unset {named}."
        )
        raise ConfigError(message) from error
    resource = Resource.create()
    if str(resource.attributes["service.name"]).startswith("unknown_service"):
        resource = resource.merge(Resource({"service.name": "slrig"}))
    # Not the process's own provider: FastAPI would then make a trace of every request.
    provider = TracerProvider(resource=resource, shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return Traces(provider)


class Traces:
    """Sends each ended job as a trace. Thread-safe; call `close` at the end."""

    def __init__(self, provider: TracerProvider) -> None:
        self._provider = provider
        self._tracer = provider.get_tracer("slrig")

    def ended(self, record: JobRecord, events: Sequence[JobEvent]) -> None:
        """Send a job's trace in the background."""
        from opentelemetry.context import Context
        from opentelemetry.trace import Status, StatusCode, set_span_in_context

        attributes = {
            "slrig.job.id": str(record.id),
            "slrig.job.kind": str(record.kind),
            "slrig.job.state": str(record.state),
            "slrig.rig": record.rig,
        }
        if record.parent is not None:
            attributes["slrig.job.parent"] = str(record.parent)
        # An empty context: the request or job of this thread is not its parent.
        job = self._tracer.start_span(
            str(record.kind), Context(), start_time=_nanoseconds(record.created_at), attributes=attributes
        )
        within: dict[str | None, Context] = {None: set_span_in_context(job, Context())}
        for stage in stages_of(record, events):
            span = self._tracer.start_span(
                stage.name, within[stage.inside], start_time=_nanoseconds(stage.begin), attributes=attributes
            )
            span.end(_nanoseconds(stage.end))
            within[stage.name] = set_span_in_context(span, Context())
        if record.state is JobState.FAILED:
            job.set_status(Status(StatusCode.ERROR, None if record.fault is None else record.fault.message))
            if record.fault is not None:
                job.set_attribute("error.type", record.fault.code)
        job.end(_nanoseconds(record.finished_at or record.created_at))

    def close(self) -> None:
        """Send the remaining spans; give up on a collector that does not answer. Idempotent."""
        ending = threading.Thread(target=self._provider.shutdown, name="slrig-traces", daemon=True)
        ending.start()
        ending.join(_END_S)


def _nanoseconds(moment: datetime) -> int:
    return round(moment.timestamp() * 1e6) * 1000

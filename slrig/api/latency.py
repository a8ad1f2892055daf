"""How long requests wait for their answer, and how long jobs and their stages take: histograms for /metrics."""

from __future__ import annotations

import time
from collections.abc import Sequence

from prometheus_client import CollectorRegistry, Histogram
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig.jobs.records import JobEvent, JobRecord, stages_of

_ANSWER_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
"""From what a kept-alive request takes on loopback, a millisecond, to where the records give up on a locked file."""

_JOB_S = (1.0, 2.5, 5.0, 10.0, 20.0, 40.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
"""From a verification of a few frames to a bracketed scan of large cameras that waits in line behind others."""

_STAGE_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
"""From writing a small picture to the optimisation of a large mesh, or a wait in line."""

_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE"})
_OTHER = "other"


class Durations:
    """What this process measured since its start. Any thread may call."""

    def __init__(self) -> None:
        # Of its own: several services in one process, as in tests, do not meet in it.
        self.registry = CollectorRegistry()
        self._answers = Histogram(
            "slrig_http_response_start_seconds",
            "From a request to the head of its answer, by method, path as documented, and class of status. `other`: no "
            "documented method or path, or refused before the path was looked at.",
            ("method", "path", "status"), buckets=_ANSWER_S, registry=self.registry,
        )  # fmt: skip
        self._jobs = Histogram(
            "slrig_job_duration_seconds",
            "From the request of a job to its end, by kind and final state.",
            ("kind", "state"), buckets=_JOB_S, registry=self.registry,
        )  # fmt: skip
        self._stages = Histogram(
            "slrig_job_stage_duration_seconds",
            "What each stage of a job took: its states, and the stages of its computation.",
            ("kind", "stage"), buckets=_STAGE_S, registry=self.registry,
        )  # fmt: skip

    def answered(self, method: str, path: str | None, status: int, seconds: float) -> None:
        """Take note of an answer. path : of the route, None where there is none."""
        labels = (method if method in _METHODS else _OTHER, path or _OTHER, f"{status // 100}xx")
        self._answers.labels(*labels).observe(seconds)

    def ended(self, record: JobRecord, events: Sequence[JobEvent]) -> None:
        """Take note of a job's end."""
        if record.finished_at is not None:
            seconds = (record.finished_at - record.created_at).total_seconds()
            self._jobs.labels(record.kind, record.state).observe(seconds)
        for stage in stages_of(record, events):
            self._stages.labels(record.kind, stage.name).observe(stage.seconds)


class Latency:
    """Middleware that measures until the answer begins: a stream is no hour of waiting."""

    def __init__(self, app: ASGIApp, *, durations: Durations) -> None:
        self._app = app
        self._durations = durations

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun_s = time.perf_counter()
        started = False

        def note(status: int) -> None:
            path = getattr(scope.get("route"), "path_format", None)
            self._durations.answered(scope["method"], path, status, time.perf_counter() - begun_s)

        async def measured(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                note(message["status"])
            await send(message)

        try:
            await self._app(scope, receive, measured)
        except Exception:
            # Whatever is outside of this makes a 500 of it.
            if not started:
                note(500)
            raise

"""/metrics, probes, kinds of problems, /audit, /fleet and the page's files. None of it touches a device."""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import os
import platform
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any
from zoneinfo import ZoneInfo

from fastapi import APIRouter, Response
from fastapi import Path as PathParameter
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.registry import Collector
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from slrig.api.problems import answer, explanations, problem, problems, title_of
from slrig.api.schemas import Explanation, Probe
from slrig.api.service import Cursor, PageLength, Probed, Service, Serving, paged
from slrig.calibration.health import HealthState
from slrig.catalogue.store import Fleet
from slrig.errors import StorageError
from slrig.jobs.manager import RigStatus
from slrig.jobs.records import JobKind, JobState, utc_now
from slrig.jobs.store import AuditEntry
from slrig.schedule.store import RunState, TaskKind

_FRESH_S = 1.0
"""Time for which probes and figures of the previous request are repeated: requests of them are not limited."""

router = APIRouter(tags=["system"])


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "the figures"}},
)
async def read_metrics(service: Serving) -> Response:
    """Return the service's figures in the text format of Prometheus: scans and scheduled runs by state, whether the rig
    is held, the calibration's age and expected error, the rig's health, and when each schedule is due next; and, since
    the start of this process, how long answers, jobs and their stages took.
    """
    text = await service.probes.of("metrics", partial(_figures, service), fresh_s=_FRESH_S)
    return Response(text, media_type=CONTENT_TYPE_PLAIN_0_0_4)


def _figures(service: Service) -> bytes:
    registry = CollectorRegistry()
    registry.register(_Figures(service))
    return generate_latest(registry) + generate_latest(service.durations.registry)


class _Figures(Collector):
    """Current figures of a service, by its records."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """See `prometheus_client.registry.Collector`."""
        states = Counter(self._service.store.states(JobKind.SCAN).values())
        scans = GaugeMetricFamily("slrig_scans", "Scans on record, by state.", labels=["state"])
        for state in JobState:
            scans.add_metric([state], states[state])
        yield scans
        damaged = GaugeMetricFamily("slrig_damaged_jobs", "Jobs with damaged record or files.", labels=["kind"])
        for kind, count in self._service.store.damaged().items():
            damaged.add_metric([kind], count)
        yield damaged
        status = self._service.manager.status()
        is_open = status.facts is not None and status.fault is None
        yield GaugeMetricFamily("slrig_rig_open", "1 while the rig is open and well.", float(is_open))
        is_held = status.holder is not None
        yield GaugeMetricFamily("slrig_rig_held", "1 while something holds the rig.", float(is_held))
        yield GaugeMetricFamily("slrig_rig_waiting", "How many wait for the rig.", status.waiting)
        yield from self._calibration()
        yield from self._schedule()
        yield from self._notices()
        yield from self._catalogue()

    def _calibration(self) -> Iterator[Metric]:
        health, latest, calibration = self._service.health.health()
        states = GaugeMetricFamily("slrig_rig_health", "1 for the state of the rig's health.", labels=["state"])
        for state in HealthState:
            states.add_metric([state], float(health.state is state))
        yield states
        if latest is not None:
            yield GaugeMetricFamily(
                "slrig_last_verification_timestamp_seconds", "When the rig was last verified.", latest.at.timestamp()
            )
        solved = None if calibration is None else calibration.solved
        if calibration is None or solved is None:
            return
        age_s = (utc_now() - datetime.fromisoformat(solved.solved_at)).total_seconds()
        yield GaugeMetricFamily("slrig_calibration_age_seconds", "Age of the calibration in use.", age_s)
        yield GaugeMetricFamily(
            "slrig_calibration_expected_error_millimetres",
            "Expected error of a scanned point now, with the board's size and what changed: a standard deviation.",
            self._service.health.error_mm(calibration) or 0.0,
        )

    def _notices(self) -> Iterator[Metric]:
        outbox, labels = self._service.store.outbox, ["receiver"]
        waiting = GaugeMetricFamily("slrig_notices_waiting", "Notices that are not taken yet.", labels=labels)
        ages = GaugeMetricFamily("slrig_notices_oldest_age_seconds", "How long the oldest has waited.", labels=labels)
        for receiver in outbox.news:
            count, oldest_s = outbox.waiting(receiver)
            waiting.add_metric([receiver], count)
            ages.add_metric([receiver], oldest_s)
        yield from (waiting, ages)
        yield CounterMetricFamily("slrig_notices_dropped", "Notices that were never sent.", outbox.dropped)

    def _catalogue(self) -> Iterator[Metric]:
        if self._service.copier is None:
            return
        found = self._service.copier.status()
        yield GaugeMetricFamily("slrig_catalogue_reached", "1 while it is reached.", float(found.fault is None))
        yield GaugeMetricFamily("slrig_catalogue_waiting", "Ended jobs that are not copied yet.", found.waiting)
        yield GaugeMetricFamily(
            "slrig_catalogue_oldest_age_seconds", "How long the oldest of them has waited.", found.oldest_s
        )

    def _schedule(self) -> Iterator[Metric]:
        counts = self._service.schedules.counts()
        # Rows go with their schedule: the numbers may fall.
        runs = GaugeMetricFamily(
            "slrig_scheduled_runs", "Due times on record, by what became of them.", labels=["task", "state"]
        )
        for task in TaskKind:
            for state in RunState:
                runs.add_metric([task, state], counts.get((task, state), 0))
        yield runs
        due = GaugeMetricFamily(
            "slrig_schedule_next_due_timestamp_seconds",
            "When a schedule that is not paused is due next.",
            labels=["schedule", "task"],
        )
        for schedule in self._service.schedules.all():
            if schedule.order.enabled:
                due.add_metric([str(schedule.id), schedule.order.task], schedule.next_due.timestamp())
        yield due


class ServiceBody(BaseModel):
    """The service's version, its disk, and the damage in its data folder."""

    version: str
    python: str
    free_bytes: int
    total_bytes: int
    time_zone: str = Field(description="of the service's machine: a name of the IANA database")
    checks: dict[str, str] = Field(description="what a scan needs, each ok or its fault, as GET /readyz has it")
    pending: list[str] = Field(description="which of them are not ready yet and get there by themselves")
    spare_bytes: int = Field(description="below so much free space nothing new is begun")
    damaged: dict[JobKind, int] = Field(description="jobs with a damaged record or damaged files, by kind")


@router.get("/service")
def look_at_service(service: Serving) -> ServiceBody:
    """Return the service's version, whether it could scan, the space on its disk, and how many jobs are damaged."""
    checks, pending = _checks(service)
    disk = shutil.disk_usage(service.folder.root)
    return ServiceBody(
        version=importlib.metadata.version("slrig"),
        python=platform.python_version(),
        free_bytes=disk.free,
        total_bytes=disk.total,
        time_zone=_time_zone(),
        checks=checks,
        pending=pending,
        spare_bytes=service.settings.min_free_bytes,
        damaged=dict(service.store.damaged()),
    )


@router.get("/livez", openapi_extra={"security": []})
async def livez() -> Probe:
    """Show that the process answers."""
    return Probe(checks={"process": "ok"})


@router.get("/readyz", response_model=Probe, responses=problems(503), openapi_extra={"security": []})
async def readyz(service: Probed) -> Response | Probe:
    """Show whether a scan could start and end well: records, disk, rig, reconstruction. Touches no device.

    A rig that is held is well. `pending` names what is not ready yet and gets there by itself: the rig while it is
    opened, the reconstruction until its process has loaded its kernels, which the first time takes a minute. The answer
    is valid for a second.
    """
    return await service.probes.of("ready", partial(_ready, service), fresh_s=_FRESH_S)


def _ready(service: Service) -> Response | Probe:
    checks, pending = _checks(service)
    if all(found == "ok" for found in checks.values()):
        return Probe(checks=checks)
    wrong = "; ".join(f"{name}: {found}" for name, found in checks.items() if found != "ok")
    detail = f"The service runs and cannot scan: {wrong}"
    return answer(problem(503, "not-ready", detail, checks=checks, pending=pending))


def _checks(service: Service) -> tuple[dict[str, str], list[str]]:
    """Checks of a scan's needs, and those that get ready by themselves."""
    status = service.manager.status()
    checks = {
        "records": _storage(service.store.check),
        "disk": _storage(lambda: service.folder.require_space(service.settings.min_free_bytes)),
        "rig": _rig(status),
        "reconstruction": status.reconstruction,
        "threads": _threads(service.ended_threads()),
    }
    opening = status.facts is None and status.fault is None and not status.ending
    return checks, [name for name, waits in (("rig", opening), ("reconstruction", status.preparing)) if waits]


@cache
def _time_zone() -> str:
    """The name of this machine's time zone; UTC where it has none."""
    name = os.environ.get("TZ", "").removeprefix(":") or str(Path("/etc/localtime").resolve()).partition("zoneinfo/")[2]
    try:
        return ZoneInfo(name).key
    except (KeyError, ValueError, OSError):
        return "UTC"


@router.get("/problems/{name}")
def explain_problem(name: Annotated[str, PathParameter(max_length=64)]) -> Explanation:
    """Explain a kind of problem: what `type` in an error leads to."""
    text = explanations().get(name)
    if text is None:
        detail = f"There is no problem of kind '{name}'."
        raise HTTPException(404, detail)
    return Explanation(type=f"/problems/{name}", title=title_of(name), description=text)


def _storage(check: Callable[[], None]) -> str:
    try:
        check()
    except StorageError as error:
        return str(error)
    return "ok"


def _threads(ended: Sequence[str]) -> str:
    return f"{', '.join(ended)} ended by a defect: restart the service, and report its log" if ended else "ok"


def _rig(status: RigStatus) -> str:
    if status.ending:
        return "the service is ending"
    if status.fault is not None:
        return status.fault
    if status.facts is not None:
        return "ok"
    return f"the rig is being opened: {status.opening}" if status.opening else "the rig is being opened"


class AuditPage(BaseModel):
    """Entries from new to old. `next` is the path of the next page, null on the last."""

    entries: list[AuditEntry]
    next: str | None


@router.get("/audit")
def list_audit(service: Serving, response: Response, cursor: Cursor = None, limit: PageLength = 50) -> AuditPage:
    """List who did what, from new to old: every request that writes or was refused for its key's scope, and once a
    minute that a key sends too many. Names are those of keys.
    """
    shown, following = paged(
        lambda most: service.audit.page(before=cursor, limit=most), limit, "/audit", service, response
    )
    return AuditPage(entries=list(shown), next=following)


@router.get("/fleet", responses=problems(404, 503, 507))
def look_at_fleet(service: Serving) -> Fleet:
    """List the rigs that share a catalogue with this one: how each is, its health, its last scan and its backlog.

    A catalogue that is away is not waited for: 503 says since when it was tried, and the rig scans on.
    """
    if service.copier is None:
        detail = (
            "This service shares no catalogue with others. Name one in its settings: catalogue = "
            '"postgresql://HOST:PORT/DATABASE" and catalogue_login_file, a file with USER:PASSWORD and mode 0600.'
        )
        raise HTTPException(404, detail)
    return service.copier.fleet()


FOLDER = Path(__file__).resolve().parents[1] / "page"
FILES_PATH = "/page"

_INDEX = (FOLDER / "index.html").read_text(encoding="utf-8")
_INLINE = re.compile(r"<script[^>]*>(.+?)</script>", re.DOTALL)

page_router = APIRouter(include_in_schema=False)


def policy(html: str) -> str:
    """Content policy of a page of ours: files from here, and its present inline scripts.

    An import map has to be inline: browsers take none from a file.
    """
    digests = (hashlib.sha256(script.encode()).digest() for script in _INLINE.findall(html))
    scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; script-src 'self' {scripts}; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    )


@page_router.get("/")
def show_page() -> Response:
    """Show the page of the service."""
    return Response(_INDEX, media_type="text/html", headers={"Content-Security-Policy": policy(_INDEX)})


class _Checked(StaticFiles):
    """Files that a browser keeps, and revalidates at each visit: a new service has a new page, too."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        """See `StaticFiles.file_response`."""
        response = super().file_response(*args, **options)
        response.headers["Cache-Control"] = "no-cache"
        return response


def page_files() -> ASGIApp:
    """Files of the page, compressed."""
    # Smaller ones fit one packet as they are.
    return GZipMiddleware(_Checked(directory=FOLDER), minimum_size=1400)

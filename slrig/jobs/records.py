"""Records of jobs of any kind: frozen values, and the clock that dates them."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from functools import cache
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any
from uuid import UUID

from pydantic import TypeAdapter, ValidationError

from slrig.bundle import write_file
from slrig.errors import DamagedError, QueueFullError
from slrig.failure import JobFailure

RECORD = "record.json"
"""The file next to those of a finished job that has its record."""

LABEL = "label.json"
"""The file next to the record with the job's later label: a JSON string, or null."""

Clock = Callable[[], datetime]
"""Gives the present moment with a time zone."""


def utc_now() -> datetime:
    """The present moment, UTC. For records only: durations are measured with a monotonic clock."""
    return datetime.now(UTC)


_actor: ContextVar[str | None] = ContextVar("actor", default=None)
_actor_key: ContextVar[str] = ContextVar("actor_key", default="")


@contextmanager
def acting_as(name: str | None, *, key: str = "") -> Iterator[None]:
    """Record `name` as the requester of jobs made within the block, on this thread or one that it waits for. key :
    digest of the requester's key; "" where there is none.
    """
    before, before_key = _actor.set(name), _actor_key.set(key)
    try:
        yield
    finally:
        _actor.reset(before)
        _actor_key.reset(before_key)


def actor_key() -> str:
    """Digest of the key of the current request; "" where there is none."""
    return _actor_key.get()


def actor() -> str | None:
    """Name of the current requester."""
    return _actor.get()


ANYONE = "anyone"
"""Name of every caller of a service that needs no key."""


def has_share(total: int, who: str | None, holders: Collection[str | None]) -> bool:
    """Whether a name may have one more of so many places, which `holders` have: while it has fewer than are free.

    However many n greedy names leave one place in n + 1 free for the next (Choudhury and Hahne, Dynamic queue length
    thresholds for shared-memory packet switches, 1998). Names are unique among keys that are good. Who has none is
    held to the total alone.

    >>> [has_share(4, "ann", ["ann"] * n) for n in (1, 2)], has_share(4, "bob", ["ann"] * 2)
    ([True, False], True)
    """
    own = 0 if who in {None, ANYONE} else sum(each == who for each in holders)
    return total - len(holders) > own


def require_share(what: str, total: int, holders: Collection[str | None]) -> None:
    """Raise QueueFullError unless the current requester may have one more of so many places of a line."""
    if not has_share(total, actor(), holders):
        own = sum(each == actor() for each in holders)
        message = (
            f"{len(holders)} of {total} places {what} are taken, {own} of them by you, and no one gets more than are "
            "left for all others. Try again later."
        )
        raise QueueFullError(message)


class JobKind(StrEnum):
    """The kinds of jobs."""

    SCAN = "scan"
    VERIFICATION = "verification"
    POSE = "pose"
    SOLVE = "solve"
    POSITION = "position"
    MODEL = "model"
    DOCTOR = "doctor"
    CONFORMANCE = "conformance"
    LATENCY = "latency"
    AXIS = "axis"

    @property
    def path(self) -> str:
        """Path of the service below which jobs of this kind are found by their ids. Those of a calibration or an
        acceptance test are found below that.

        >>> JobKind.SCAN.path, JobKind.DOCTOR.path
        ('/scan', '/rig/job')
        """
        return _PATHS.get(self, "/rig/job")


RIG_JOBS = (JobKind.DOCTOR, JobKind.CONFORMANCE, JobKind.LATENCY, JobKind.AXIS)
"""Kinds without a resource of their own: their jobs are found at /rig/job/ID."""

_PATHS = {JobKind.SCAN: "/scan", JobKind.MODEL: "/model", JobKind.VERIFICATION: "/rig/verification"}


class JobState(StrEnum):
    """State of a job. The last four are final: a job never leaves them."""

    QUEUED = "queued"
    CAPTURING = "capturing"
    COMPUTING = "computing"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"

    @property
    def final(self) -> bool:
        """True when nothing more will happen to the job.

        >>> JobState.CANCELLED.final, JobState.QUEUED.final
        (True, False)
        """
        return self not in {JobState.QUEUED, JobState.CAPTURING, JobState.COMPUTING}


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Progress of a job: the stage's name, the fraction 0..1 of the whole job, and a detail for people."""

    stage: str
    fraction: float
    detail: str

    def as_json(self) -> dict[str, Any]:
        """As events and answers carry it."""
        return {"stage": self.stage, "fraction": round(self.fraction, 4), "detail": self.detail}


@dataclass(frozen=True, slots=True)
class JobRecord:
    """One job. `number` rises with every job and orders lists; times are UTC. plan : the request, as JSON values.

    parent : the calibration of a pose or a solve, the acceptance test of a position. summary : the part of its result
    that a list shows; None before. pinned : no retention removes it.
    requested_by : the name of the key, or the schedule, that requested it, where that is known. has_files_json : of a
    record next to its files, whether `files.json` was written with it.
    """

    number: int
    id: UUID
    kind: JobKind
    state: JobState
    label: str | None
    rig: str
    plan: Mapping[str, Any]
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    progress: JobProgress
    fault: JobFailure | None
    summary: Mapping[str, Any] | None
    pinned: bool = False
    parent: UUID | None = None
    requested_by: str | None = None
    has_files_json: bool = False


_record_adapter = TypeAdapter(JobRecord)
_label_adapter = TypeAdapter[str | None](str | None)


def write_record(folder: Path, record: JobRecord) -> None:
    """Write the record of a finished job into its folder, for a database that was lost. Raises StorageError."""
    write_file(folder / RECORD, _record_adapter.dump_json(record, indent=1))


def read_record(folder: Path) -> JobRecord | None:
    """The record in the folder of a finished job; None where there is none that can be read."""
    try:
        record = _record_adapter.validate_json((folder / RECORD).read_bytes())
    except (OSError, ValidationError):
        return None
    try:
        return replace(record, label=_label_adapter.validate_json((folder / LABEL).read_bytes()))
    except (OSError, ValidationError):
        return record


def write_label(folder: Path, label: str | None) -> None:
    """Write the new label of a job into its folder. Raises StorageError."""
    write_file(folder / LABEL, _label_adapter.dump_json(label))


@dataclass(frozen=True, slots=True)
class Holder:
    """Holder of the rig. name : its name in an answer, the id of a scan; label : the same for a person; path : its HTTP
    path, below which `cancel` ends it; None for what is over in seconds.
    """

    name: str
    label: str
    path: str | None


def holder_of(record: JobRecord) -> Holder:
    """The holder of the rig for a job."""
    job, group = f"{record.kind} {record.id}", record.parent
    match record.kind:
        case JobKind.POSE:
            label = f"calibration {group}, pose {record.plan['number']}"
            return Holder(label, label, f"/calibration/{group}/pose/{record.plan['number']}")
        case JobKind.SOLVE:
            label = f"calibration {group}, solve {record.plan['number']}"
            return Holder(label, label, f"/calibration/{group}")
        case JobKind.POSITION:
            label = f"acceptance test {group}"
            return Holder(label, label, f"/acceptance/{group}")
        case kind:
            name = str(record.id) if kind is JobKind.SCAN else job
            return Holder(name, job, f"{kind.path}/{record.id}")


_PARENTS = {
    JobKind.SCAN: ("series", "/scan/series"),
    JobKind.POSE: ("calibration", "/calibration"),
    JobKind.SOLVE: ("calibration", "/calibration"),
    JobKind.POSITION: ("acceptance", "/acceptance"),
}
"""Name and HTTP path of the parent of a job of each kind."""


def reference(job: JobRecord) -> dict[str, Any]:
    """Description of a job in events of all kinds of jobs: `id`, `kind`, `label`, the `series`, `calibration` or
    `acceptance` that it belongs to, if it belongs to one, and `links`, by paths of the service.
    """
    named: dict[str, Any] = {"id": str(job.id), "kind": str(job.kind), "label": job.label}
    links = {"self": f"{job.kind.path}/{job.id}"}
    links["events"] = f"{links['self']}/events"
    if job.parent is not None:
        name, room = _PARENTS[job.kind]
        named[name], links[name] = str(job.parent), f"{room}/{job.parent}"
        if job.kind is not JobKind.SCAN:
            place = links[name]
            number = job.plan.get("number") if job.kind is JobKind.POSE else None
            links["self"] = place if number is None else f"{place}/pose/{number}"
            links["events"] = f"{place}/events"
    if job.kind is JobKind.POSITION:
        del links["events"]
    return {**named, "links": links}


@dataclass(frozen=True, slots=True)
class JobEvent:
    """One thing that happened to a job. `number` rises and never changes: it counts from 1 within the job, or, where
    all jobs of one parent are followed, over all events on record. job : its id.
    """

    number: int
    kind: str
    data: Mapping[str, Any]
    job: UUID


def stamp(moment: datetime) -> str:
    """A moment as it is recorded."""
    return moment.isoformat(timespec="milliseconds")


STAGES_S = "stages_s"
"""Key of a job's summary with the seconds of each stage of its computation, in their order."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A stretch of a job. inside : the name of the stretch that it is a part of, None where it is one of the job's."""

    name: str
    begin: datetime
    end: datetime
    inside: str | None = None

    @property
    def seconds(self) -> float:
        """Duration."""
        return (self.end - self.begin).total_seconds()


def stages_of(record: JobRecord, events: Sequence[JobEvent]) -> Iterator[Stage]:
    """The states that an ended job was in, and below `computing` the stages of the computation, one after the other.

    Of those only the seconds are known: a stage that was entered twice is one here, and computations while frames
    still came are dated a little late.
    """
    changes = [
        (event.data["state"], datetime.fromisoformat(event.data["time"])) for event in events if _is_state(event)
    ]
    for (state, begin), (_, end) in pairwise(changes):
        yield Stage(state, begin, end)
        if state == JobState.COMPUTING:
            for name, seconds in ((record.summary or {}).get(STAGES_S) or {}).items():
                following = begin + timedelta(seconds=seconds)
                yield Stage(name, begin, following, inside=state)
                begin = following


def _is_state(event: JobEvent) -> bool:
    return event.kind == "state" and "time" in event.data


UNREADABLE = JobFailure(
    DamagedError.code,
    "The record of this job is damaged and cannot be read. Check the disk. If the job's files are whole, the service "
    "rebuilds the record from them at its next start; if not, delete the job.",
)
"""The fault of a job with an unreadable row."""

_LIBRARIES = ("slrig", "numpy", "numba", "llvmlite", "scipy", "opencv-python-headless")
_PACKAGE = Path(__file__).resolve().parent.parent


@cache
def versions() -> Mapping[str, str]:
    """Versions by name: of slrig and the libraries that it computes with, `code`, a hash of slrig's own files, which
    differs within one version, and `machine`, the kind of processor. Where all are equal, so are the bytes of a mesh.
    """
    code = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        code.update(path.relative_to(_PACKAGE).as_posix().encode())
        code.update(path.read_bytes())
    found = {name: version(name) for name in _LIBRARIES}
    return {**found, "code": code.hexdigest()[:16], "machine": platform.machine()}


def computed(where: Mapping[str, str]) -> dict[str, object]:
    """The section `computed` of a report: `Task.where`, the machine's name, and `versions`."""
    return {**where, "host": platform.node(), "versions": dict(versions())}

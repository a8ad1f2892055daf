"""One kind of work: what a job is asked to do, what it is given while it does it, and what it found."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self
from uuid import UUID

from pydantic import TypeAdapter

from slrig.capture import EvidenceSummary
from slrig.errors import ScanCancelledError
from slrig.failure import JobFailure
from slrig.jobs.data_folder import BUNDLE, RESULT, DataFolder
from slrig.jobs.frame_feed import FrameSink
from slrig.jobs.records import JobKind, JobRecord
from slrig.model import Region
from slrig.rig.session import RigSession


class Recording(Protocol):
    """A bundle whose frames have all been taken, and may still be on their way to the disk."""

    def finish(self) -> None:
        """Bring the bundle to its place. Raises StorageError."""
        ...

    def discard(self) -> None:
        """Remove it."""
        ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a job. summary : JSON values for lists of jobs. fault : why it failed although it was computed whole,
    such as a pose that cannot be used; its files are kept. None where it succeeded.
    """

    summary: Mapping[str, Any] | None = None
    fault: JobFailure | None = None


@dataclass(frozen=True, slots=True, eq=False)
class JobRun:
    """Folder, callbacks and state of one running job: with the rig, then in the worker.

    folder : where its files are made; it is moved to `place` as a whole when the job has come to its end. place : None
    where nothing is kept. report : takes the stage, the fraction of this part that is done, and a detail for people.
    file_ready : takes the name of a file that can be fetched before the job is over. frames : takes the frames of a
    capture while they come; None where they are not computed meanwhile. live : in the worker, the scan that took them.
    evidence : what the frames proved as they were captured. where : where it is computed, for a report. pipeline : the
    module that the worker has prepared: `slrig.scan.reconstruct`. found : takes the summary as it is so far, which
    stays on record where the capture ends by an error.
    """

    id: UUID
    folder: Path
    place: Path | None
    report: Callable[[str, float, str], None]
    cancelled: Callable[[], bool]
    file_ready: Callable[[str], None] = lambda _: None
    frames: FrameSink | None = None
    live: Any = None
    evidence: EvidenceSummary | None = None
    where: Mapping[str, str] = field(default_factory=lambda: {"where": "local"})
    pipeline: Any = None
    found: Callable[[Mapping[str, Any]], None] = lambda _: None

    def check(self) -> None:
        """Raise ScanCancelledError once the job is to end early."""
        if self.cancelled():
            message = "It was cancelled."
            raise ScanCancelledError(message)

    def step(self, stage: str, fraction: float, detail: str, /) -> None:
        """Report progress, and raise ScanCancelledError once the job is to end early."""
        self.report(stage, fraction, detail)
        self.check()

    @property
    def recording(self) -> Path:
        """Where frames are recorded. It becomes `bundle` when all of them are on the disk."""
        return self.folder / "recording"

    @property
    def bundle(self) -> Path:
        """The frames, once they are on the disk."""
        return self.folder / BUNDLE

    @property
    def result(self) -> Path:
        """Where files are made that can be fetched at once: see `file_ready`. They belong next to the bundle."""
        return self.folder / RESULT


class Job:
    """One kind of work: a frozen dataclass whose fields are its plan. It is sent to the worker, and holds data alone.

    uses_rig : whether it captures. computes : whether anything is left to do when the rig is free. feeds : whether the
    worker takes frames while they are captured. keeps_bundle : whether frames are kept where it failed. one_at_a_time :
    whether those of one group are computed one after the other, each by what came of those before it. movable : whether
    another machine may compute it, from its bundle alone. promises : the files without which it has not succeeded.
    remedy : what a person can do when the worker is lost. noun : what is computed.
    """

    kind: ClassVar[JobKind]
    uses_rig: ClassVar[bool] = True
    computes: ClassVar[bool] = True
    feeds: ClassVar[bool] = False
    keeps_bundle: ClassVar[bool] = False
    one_at_a_time: ClassVar[bool] = False
    movable: ClassVar[bool] = False
    promises: ClassVar[tuple[str, ...]] = ()
    remedy: ClassVar[str] = "Try again."
    noun: ClassVar[str] = "job"

    @property
    def parent(self) -> UUID | None:
        """Id of the series, calibration, acceptance test or model that the job belongs to; None without one. It is
        the field `group`, which the plan leaves out.
        """
        group: UUID | None = getattr(self, "group", None)
        return group

    @property
    def capture_share(self) -> float:
        """The part of its progress that is capture."""
        return 1.0 if self.uses_rig else 0.0

    @property
    def ready(self) -> bool:
        """False while it cannot be begun, as a model whose views are being shot."""
        return True

    @property
    def region(self) -> Region | None:
        """Part of the scene that the worker computes while frames come; None for all."""
        return None

    @property
    def due_in_s(self) -> float:
        """Seconds before which it does not begin; others may pass it."""
        return -math.inf

    def document(self) -> dict[str, Any]:
        """Its plan as JSON values."""
        document: dict[str, Any] = _adapter(type(self)).dump_python(self, mode="json", exclude={"group"})
        return document

    @classmethod
    def from_record(cls, record: JobRecord) -> Self:
        """The job that is on record."""
        group = {} if record.parent is None else {"group": record.parent}
        job: Self = _adapter(cls).validate_python({**record.plan, **group})
        return job

    def check(self, rig: RigSession) -> int:  # noqa: ARG002 - for those that use it
        """Raise what the rig cannot do of this, as far as it is known; return the bytes that are needed on the disk."""
        return 0

    def capture(self, rig: RigSession, run: JobRun) -> Recording | Outcome | None:
        """Use the rig, on its thread; for kinds with `uses_rig`. Return the recording that is still being written to
        `run.recording`; None without one; of a kind that does not compute, what it found.
        """
        raise NotImplementedError

    def compute(self, run: JobRun) -> Outcome:
        """Do the mathematics, in the worker, in `run.folder`; for kinds with `computes`."""
        raise NotImplementedError

    def place(self, data: DataFolder, job_id: UUID) -> Path | None:  # noqa: ARG002 - for those that keep files
        """Where its files belong; None where none are kept."""
        return None

    @classmethod
    def places(cls, data: DataFolder) -> Iterable[Path]:  # noqa: ARG003
        """Where files of jobs of this kind lie."""
        return ()


class Group(Protocol):
    """Document that jobs of a kind change: a calibration, an acceptance test, a model, the health of the rig. It is
    called before others can see that a job went on, on any of its threads.
    """

    def captured(self, job: Job, job_id: UUID) -> None:
        """Take note that the rig is free of a job, which is to be computed now."""
        ...

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:
        """Take note of a job whose files are in their place; return what is to be on record of it. outcome : None where
        it came to nothing.
        """
        ...


_adapters: dict[type[Job], TypeAdapter[Any]] = {}


def _adapter(kind: type[Job]) -> TypeAdapter[Any]:
    if kind not in _adapters:
        _adapters[kind] = TypeAdapter(kind)
    return _adapters[kind]


def due_s(job: Job) -> float:
    """When a job may begin, by `time.monotonic`."""
    return time.monotonic() + job.due_in_s

"""One kind of work: its plan, its inputs while it runs, the transport of its progress and frames, and its outcome."""

from __future__ import annotations

import math
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self
from uuid import UUID

import structlog
from pydantic import TypeAdapter

from slrig.capture import EvidenceSummary
from slrig.errors import DamagedError, StorageError
from slrig.failure import JobFailure
from slrig.jobs.data_folder import BUNDLE, RESULT, DataFolder
from slrig.jobs.listener import Listener
from slrig.jobs.records import UNREADABLE, JobKind, JobProgress, JobRecord
from slrig.model import Calibration, CaptureHeader, Region, Shot
from slrig.rig.session import RigSession

if TYPE_CHECKING:
    # Not for the reconstruction process, which has no database.
    from slrig.jobs.store import JobStore

LEAST_WAITING_BYTES, MOST_WAITING_BYTES = 128 * 2**20, 512 * 2**20
"""Limits of the frames that wait for the reconstruction: a whole scan of a common camera where memory is short, else
40 frames of 12 megapixels: a line frame of those takes the reconstruction longer than the camera.
"""
_SHARE_OF_MEMORY = 1 / 16


def most_waiting_bytes() -> int:
    """The bytes of frames that may wait on this machine."""
    if "SC_PHYS_PAGES" not in getattr(os, "sysconf_names", {}):
        return LEAST_WAITING_BYTES
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min(max(int(memory * _SHARE_OF_MEMORY), LEAST_WAITING_BYTES), MOST_WAITING_BYTES)


@dataclass(frozen=True, slots=True)
class Begin:
    """Frames of this header will come, and then their evidence. region : the requested part of the scene."""

    header: CaptureHeader
    calibration: Calibration
    region: Region | None = None


@dataclass(frozen=True, slots=True)
class Abandon:
    """Forget the frames that came."""


class FrameSink(Protocol):
    """Receives the frames of a capture as they are taken."""

    def begin(self, header: CaptureHeader, calibration: Calibration | None) -> None:
        """Take note of what will come."""
        ...

    def take(self, shot: Shot) -> None:
        """Take a frame that has passed its test. Returns at once. One that comes again takes the place of the first."""
        ...

    def end(self, evidence: EvidenceSummary) -> None:
        """Take note that all frames have come."""
        ...


class FrameFeed:
    """Sends the frames of one capture to the reconstruction process, on a thread of its own.

    send : sends one message, and returns False once the receiver is gone; it may block. number : of the task that will
    use the frames. receiver : their destination, by which the task's process is known. region : the requested part of
    the scene. `evidence` is that of all frames once they have come, whether they were sent or not.
    """

    def __init__(
        self,
        send: Callable[[object], bool],
        *,
        number: int = 0,
        receiver: object = None,
        region: Region | None = None,
        most_bytes: int | None = None,
    ) -> None:
        self.number = number
        self.receiver = receiver
        self.evidence: EvidenceSummary | None = None
        self._send = send
        self._region = region
        self._most_bytes = most_waiting_bytes() if most_bytes is None else most_bytes
        self._waiting: queue.Queue[Begin | Shot | EvidenceSummary | Abandon] = queue.Queue()
        self._taken: set[tuple[int, str, float | None]] = set()
        self._given_up = threading.Event()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self, header: CaptureHeader, calibration: Calibration | None) -> None:
        """Start the thread. Without a calibration nothing can be reconstructed, and nothing is sent."""
        if calibration is None:
            self.abandon()
            return
        self._waiting.put(Begin(header, calibration, self._region))
        self._thread = threading.Thread(target=self._carry, name="slrig-feed", daemon=True)
        self._thread.start()

    def take(self, shot: Shot) -> None:
        """Queue a frame. With too many waiting, or when it takes another one's place, give up."""
        which = (shot.pattern, shot.camera, shot.exposure_s)
        again = which in self._taken
        self._taken.add(which)
        if self._given_up.is_set():
            return
        if again:
            # What was concluded from the first one cannot be taken back.
            _log.info("a frame was shot again; the reconstruction will read the bundle", pattern=shot.pattern)
            self.abandon()
        elif (self._waiting.qsize() + 1) * shot.image.nbytes > self._most_bytes:
            _log.info("the reconstruction falls behind the capture; it will read the bundle")
            self.abandon()
        else:
            self._waiting.put(shot)

    def end(self, evidence: EvidenceSummary) -> None:
        """Queue the end."""
        self.evidence = evidence
        self._waiting.put(evidence)

    def abandon(self) -> None:
        """Send no more, and discard what was sent. After the end has been sent this does nothing."""
        self._given_up.set()
        self._waiting.put(Abandon())

    def settled(self, timeout_s: float) -> bool:
        """Wait at most so long; return whether nothing more will be sent."""
        if self._thread is not None:
            self._thread.join(timeout_s)
        return self._thread is None or not self._thread.is_alive()

    @property
    def whole(self) -> bool:
        """Whether every frame was sent, and the end."""
        return self._ended.is_set()

    def _carry(self) -> None:
        while True:
            message = self._waiting.get()
            if self._given_up.is_set():
                self._waiting = queue.Queue()  # releases the frames
                self._send(Abandon())
                return
            if not self._send(message):
                self._given_up.set()
                return
            if isinstance(message, EvidenceSummary):
                self._ended.set()
                return


class FedCaptures:
    """The other end: what has taken the frames of the captures that no task has used yet, by the number of the task: of
    one that is computed next, and one that is under way.

    begin : makes what takes the frames of a capture, as `slrig.scan.stream.LiveScan`, of its header, calibration and
    region.
    """

    def __init__(self, begin: Callable[..., Any]) -> None:
        self._begin = begin
        self._captures: dict[int, Any] = {}

    def hear(self, number: int, message: object) -> None:
        """Take a message of a capture's feed. Frames that cannot be used are released: reading the bundle shows why."""
        if number not in self._captures:
            if self._captures and number < max(self._captures):
                return
            self._captures = {each: self._captures[each] for each in sorted(self._captures)[-1:]}
            self._captures[number] = None
        live = self._captures[number]
        try:
            match message:
                case Begin(header, calibration, region):
                    self._captures[number] = self._begin(header, calibration, region)
                case Shot() if live is not None:
                    live.take(message)
                case EvidenceSummary() if live is not None:
                    live.end(message)
                case Abandon():
                    self._captures[number] = None
        except Exception as error:  # noqa: BLE001 - the scan does not depend on this head start
            _log.warning("frames could not be used while they were taken", cause=repr(error))
            self._captures[number] = None

    def taken(self, number: int) -> Any:
        """The consumer of a capture's frames, None without one; it is released here."""
        return self._captures.pop(number, None)


class Recording(Protocol):
    """A bundle with all frames taken, which may still be on their way to the disk."""

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
class JobRun(Listener):
    """Folder and state of one running job, and who follows it: with the rig, then in the worker.

    folder : where its files are made; it is moved to `place` as a whole when the job has come to its end. place : None
    where nothing is kept. frames : takes the frames of a capture while they come; None where they are not computed
    meanwhile. live : in the worker, the scan that took them. evidence : what the frames proved as they were captured.
    where : where it is computed, for a report. pipeline : the module that the worker has prepared:
    `slrig.scan.reconstruct`. found : takes the summary as it is so far, which stays on record where the capture ends by
    an error.
    """

    id: UUID
    folder: Path
    place: Path | None
    frames: FrameSink | None = None
    live: Any = None
    evidence: EvidenceSummary | None = None
    where: Mapping[str, str] = field(default_factory=lambda: {"where": "local"})
    pipeline: Any = None
    found: Callable[[Mapping[str, Any]], None] = lambda _: None

    @property
    def recording(self) -> Path:
        """Folder in which frames are recorded. It becomes `bundle` when all of them are on the disk."""
        return self.folder / "recording"

    @property
    def bundle(self) -> Path:
        """The frames, once they are on the disk."""
        return self.folder / BUNDLE

    @property
    def result(self) -> Path:
        """Folder of files that can be fetched at once: see `file_ready`. They belong next to the bundle."""
        return self.folder / RESULT


class Job:
    """One kind of work: a frozen dataclass; its fields are its plan. It is sent to the worker, and holds data alone.

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
        """False while it cannot be begun, as a model before all of its views are shot."""
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
        """The job that is on record. Raises DamagedError, ValueError: its plan cannot be read."""
        if record.fault == UNREADABLE:
            raise DamagedError(UNREADABLE.message)
        return cls.from_plan(record)

    @classmethod
    def from_plan(cls, record: JobRecord) -> Self:
        """The job of a record that can be read. Raises ValueError: another version of slrig made the plan."""
        group = {} if record.parent is None else {"group": record.parent}
        job: Self = _adapter(cls).validate_python({**record.plan, **group})
        return job

    @classmethod
    def place_of(cls, record: JobRecord, data: DataFolder) -> Path | None:
        """Folder of the files of a recorded job; if its plan cannot be read, the folder named by its id."""
        try:
            return cls.from_record(record).place(data, record.id)
        except (DamagedError, ValueError):
            return next((place for place in cls.places(data) if place.name == str(record.id)), None)

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
        """Folder of its files; None where none are kept."""
        return None

    @classmethod
    def places(cls, data: DataFolder) -> Iterable[Path]:  # noqa: ARG003
        """Folders of the files of jobs of this kind."""
        return ()


class Group(Protocol):
    """Document that jobs of a kind change: a calibration, an acceptance test, a model, the health of the rig. It is
    called before others can see that a job went on, on any of its threads.
    """

    def captured(self, job: Job, job_id: UUID) -> None:
        """Take note that the rig is free of a job, which is to be computed now."""
        ...

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:
        """Note a job with its files in their place; return the outcome to record. outcome : None where it came to
        nothing.
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


_LEAST_STEP = 0.01
_LEAST_S = 0.1  # each is written to disk, on the thread that captures; people see no more than ten a second
_DETAIL_S = 2.0  # people who watch want a sign every few seconds

_log = structlog.get_logger(__name__)


class ProgressRecorder:
    """Takes progress from the work and records the steps worth reporting: a new stage, a hundredth of the way, at
    most ten times a second, the end, or another detail of a stage that goes on.
    """

    def __init__(
        self,
        store: JobStore,
        job_id: UUID,
        *,
        hidden: str,
        span: tuple[float, float] = (0.0, 1.0),
        attempt: bool = False,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """`hidden` is left out of what is recorded; the fractions are of `span`, a part of the whole job. attempt : the
        first stage that is not one of waiting counts as an attempt of the worker.
        """
        self._attempt = attempt
        self._now_s = now_s
        self._reported_s = -math.inf
        self._hidden = hidden
        self._store = store
        self._job_id = job_id
        self._start, self._end = span
        self._reported = JobProgress("", -1.0, "")

    def file_made(self, name: str) -> None:
        """Take note of a file that can be fetched before the job is over; a refusal fails no work, either."""
        self._recorded("a file of a job could not be announced", lambda: self._store.file_made(self._job_id, name))

    def captured(self) -> None:
        """Take note that the job needs the rig no longer; a refusal fails no work, either."""
        self._recorded("the end of a job's capture could not be recorded", lambda: self._store.captured(self._job_id))

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """Take note, as `Listener.report` does. A record that is refused fails no work: see the
        log.
        """
        if self._attempt and not stage.startswith("waiting"):
            self._attempt = False
            self._recorded("a job's start could not be recorded", lambda: self._store.begin_attempt(self._job_id))
        overall = self._start + (self._end - self._start) * min(max(fraction, 0.0), 1.0)
        since_s = self._now_s() - self._reported_s
        goes_on = detail != self._reported.detail and since_s >= _DETAIL_S
        further = overall - self._reported.fraction >= _LEAST_STEP and (since_s >= _LEAST_S or fraction >= 1)
        if goes_on or stage != self._reported.stage or further:
            self._reported = JobProgress(stage, overall, detail.replace(self._hidden, ""))
            self._reported_s = self._now_s()
            self._recorded(
                "a job's progress could not be recorded", lambda: self._store.progress(self._job_id, self._reported)
            )

    def _recorded(self, refused: str, record: Callable[[], None]) -> None:
        try:
            record()
        except StorageError as error:
            _log.warning(refused, job=str(self._job_id), cause=str(error))

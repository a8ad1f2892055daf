"""Jobs on record, done in two parts: one holds the rig, one computes when the rig is free; each job has one end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol
from uuid import UUID

import structlog

from slrig.errors import ScanCancelledError, ScanInterruptedError, StorageError
from slrig.failure import JobFailure, interruption_error, job_failure
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.endings import Ending, Endings, ending_by
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import JobRecord, JobState, utc_now
from slrig.jobs.store import JobStore
from slrig.rig.session import RigSession, driver_errors

_log = structlog.get_logger(__name__)


class Recorded(Protocol):
    """`slrig.scan.acquisition.Recording`, or what a test puts in its place."""

    def finish(self) -> None:
        """Bring the bundle to its place."""
        ...

    def discard(self) -> None:
        """Let it go."""
        ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a job's second part found. fault : why it came to nothing all the same, None where it succeeded."""

    summary: Mapping[str, Any] | None
    fault: JobFailure | None = None


Capture = Callable[[RigSession, Job, ProgressRecorder], Recorded | None]
"""A job's first part. What it returns is on its way to `DataFolder.recording`."""


@dataclass(frozen=True, slots=True)
class Parts:
    """What one job does.

    compute : its second part, on a thread of its own when the rig is free. capture : its first, on the rig's thread;
    None where it was done before, or is not needed. What it recorded is the staged bundle when the second part begins.
    captured : called between the two, when the rig is free. failed : called once, on any thread, when an error has
    ended the job. salvage : keeps what it can of one that was not cancelled, before its files are removed.
    capture_share : the part of its progress that is capture.
    """

    compute: Callable[[Job, ProgressRecorder], Outcome]
    capture: Capture | None = None
    captured: Callable[[], None] = lambda: None
    failed: Callable[[Exception], None] = lambda _: None
    salvage: Callable[[UUID], None] = lambda _: None
    capture_share: float = 1.0


class RigJobs:
    """Has jobs of one store done, and each put on record with one end. Any thread may call; `close` at the end.

    A job's files are made in the staging folder of its id, which is removed at its end.
    """

    def __init__(self, jobs: JobStore, queue: JobQueue, folder: DataFolder) -> None:
        self.jobs = jobs
        self.queue = queue
        self.folder = folder
        self.endings = Endings(jobs)

    def job(self, job_id: UUID, parts: Parts, holder: Holder) -> Job:
        """What the queue does for a job that is on record, or will be when it begins."""
        return _Work(job_id, parts, self, holder).job

    def submit(
        self, job_id: UUID, parts: Parts, *, holder: Holder, wait: bool, record: Callable[[], object] = lambda: None
    ) -> None:
        """Have a job done; `wait` lets it stand in line. Returns at once.

        record : puts it on record, once a place in the line is certain and before the work can begin.

        Raises
        ------
        RigBusyError, QueueFullError, DeviceError
            As a scan.
        """

        def make() -> Sequence[Job]:
            record()
            return [self.job(job_id, parts, holder)]

        self.queue.submit(make, wait=wait)

    def take_up(self, record: JobRecord, parts: Parts, *, holder: Holder, resumes: bool = False) -> None:
        """Have a job done that is on record and waits; end one that an earlier run of the service had begun as
        interrupted. resumes : whether its second part can be done from what is staged; it is, once.
        """
        if record.state is JobState.QUEUED:
            self.queue.add([self.job(record.id, parts, holder)])
        elif resumes and record.state is JobState.COMPUTING and self.jobs.attempts(record.id) == 1:
            self.queue.add([self.job(record.id, replace(parts, capture=None), holder)])
        else:
            work, error = _Work(record.id, parts, self, holder, resumable=False), interruption_error()
            work.clear_up(error)
            work.job.conclude(error)
            work.job.settle()

    def cancel(self, job_id: UUID) -> None:
        """Ask a job to end early. Returns at once; one that is over stays so. Raises JobNotFoundError."""
        if self.queue.cancel(job_id):
            return
        self.endings.settle()
        if job_id not in self.endings:
            # Nobody works on it, and nobody knows how it ended: the least that can be done is to let it go.
            fault = job_failure(ScanInterruptedError("Nothing works on this any more. Start it again."))
            self.jobs.finish(job_id, JobState.INTERRUPTED, fault=fault)

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent; after the queue has come to its end."""
        self.endings.close()


class _Work:
    """One job that waits or is under way. resumable : whether the next start of the service goes on with it."""

    def __init__(self, job_id: UUID, parts: Parts, of: RigJobs, holder: Holder, *, resumable: bool = True) -> None:
        self._id = job_id
        self._parts = parts
        self._jobs, self._folder, self._endings = of.jobs, of.folder, of.endings
        self._hidden = of.folder.hidden(job_id)
        self._recording: Recorded | None = None
        self._resumable = resumable
        self._worked = self._failed = False
        self._found = Outcome(None)
        capture = None if parts.capture is None else partial(self._capture, parts.capture)
        self.job = Job(
            job_id, holder, utc_now(), capture, self._ended, self._compute, self.clear_up, self._concluded
        )  # fmt: skip

    def _capture(self, capture: Capture, held: RigSession, job: Job) -> None:
        self._endings.settle()
        self._resumable = False
        job.since = self._jobs.advance(self._id, JobState.CAPTURING)
        self._folder.stage(self._id)
        try:
            with driver_errors(held.name):
                self._recording = capture(held, job, self._progress(0.0, self._parts.capture_share))
        except Exception as error:
            held.doubt(error)
            raise
        if job.stop.is_set():
            message = "It was cancelled when all of its frames had come."
            raise ScanCancelledError(message)

    def _compute(self, job: Job) -> None:
        progress = self._progress(self._parts.capture_share, 1.0)
        recording, self._recording = self._recording, None
        if recording is not None:
            progress.captured()
        if self._parts.capture is not None:
            self._tell(self._parts.captured)
        if recording is not None:
            recording.finish()
            self._folder.keep_recording(self._id)
        self._resumable = self._on_record_as_computing()
        self._found = self._parts.compute(job, progress)

    def clear_up(self, error: Exception | None) -> None:
        """See `Job`."""
        self._worked = True
        if error is not None and self._goes_on(error):
            return
        if error is not None:
            self._fail(error)
            if self._recording is not None:
                self._tell(self._recording.discard)
            elif not isinstance(error, ScanCancelledError):
                self._tell(lambda: self._parts.salvage(self._id))
        self._folder.discard(self._id)

    def _concluded(self, error: Exception | None) -> None:
        if error is None:
            state = JobState.SUCCEEDED if self._found.fault is None else JobState.FAILED
            self._endings.add(Ending(self._id, state, self._found.fault, self._found.summary))
        elif self._goes_on(error):
            _log.info("a job is left to the next start of the service", job=str(self._id))
        else:
            ending = ending_by(error, self._id, hidden=self._hidden)
            if ending.state is JobState.FAILED and not self._worked and self.job.stop.is_set():
                # It was to end, and its driver hangs.
                ending = replace(ending, state=JobState.CANCELLED)
            self._endings.add(ending)

    def _ended(self, error: Exception | None) -> None:
        if error is not None and not self._goes_on(error):
            self._fail(error)
        self._endings.settle()

    def _goes_on(self, error: Exception) -> bool:
        return self._resumable and isinstance(error, ScanInterruptedError)

    def _fail(self, error: Exception) -> None:
        if not self._failed:
            self._failed = True
            self._tell(lambda: self._parts.failed(error))

    def _tell(self, what: Callable[[], object]) -> None:
        """Do what must not change how the job itself ends."""
        try:
            what()
        except Exception:  # noqa: BLE001 - see above
            _log.exception("what goes with a job went wrong", job=str(self._id))

    def _on_record_as_computing(self) -> bool:
        """Record that all is there to compute with, whatever ends the service; return whether that could be done."""
        try:
            self._jobs.advance(self._id, JobState.COMPUTING)
        except StorageError as error:
            _log.warning("that a job computes could not be recorded", job=str(self._id), cause=str(error))
            return False
        return True

    def _progress(self, start: float, end: float) -> ProgressRecorder:
        return ProgressRecorder(self._jobs, self._id, hidden=self._hidden, span=(start, end))

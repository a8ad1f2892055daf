"""Jobs of two parts: one that holds the rig, and one that computes when the rig is free."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol
from uuid import UUID

import structlog

from slrig.devices import Rig
from slrig.errors import ScanInterruptedError, SlrigError, StorageError
from slrig.failure import JobFailure, interruption
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.endings import Ending, Endings, ending_by
from slrig.jobs.job import Holder
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobRecord, JobState
from slrig.jobs.store import JobStore

Cancelled = Callable[[], bool]
"""Whether a job is to end early."""

_log = structlog.get_logger(__name__)


class RigQueue(Protocol):
    """`slrig.scan.runner.Runner`, as far as work that is no scan needs it."""

    def submit_work(
        self,
        work: Callable[[Rig, Cancelled], None],
        *,
        work_id: UUID,
        holder: Holder,
        wait: bool,
        ended: Callable[[Exception | None], None],
        begun: Callable[[], object],
    ) -> None:
        """Have work done with the rig."""
        ...

    def cancel_work(self, work_id: UUID) -> None:
        """Ask it to end early."""
        ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a job's second part found. fault : why it came to nothing all the same, None where it succeeded."""

    summary: Mapping[str, Any] | None
    fault: JobFailure | None = None


@dataclass(frozen=True, slots=True)
class Parts:
    """What one job does.

    compute : its second part, on a thread of its own. capture : its first, on the rig's thread, for a job that needs
    the rig. captured : called between the two, on the rig's thread, when the rig is free; it returns soon. ended :
    called when the job is over, before that is on record.
    """

    compute: Callable[[ProgressRecorder], Outcome]
    capture: Callable[[Rig, ProgressRecorder, Cancelled], None] = lambda *_: None
    captured: Callable[[], None] = lambda: None
    ended: Callable[[JobState, JobFailure | None], None] = lambda *_: None


class RigJobs:
    """Has jobs of one store done, and each put on record with one end. Any thread may call; `close` at the end.

    A job's files are made in the staging folder of its id, which is removed at its end. Second parts are done one at a
    time, in their order.
    """

    def __init__(self, jobs: JobStore, queue: RigQueue, folder: DataFolder) -> None:
        self.jobs = jobs
        self._queue = queue
        self._folder = folder
        self._endings = Endings(jobs)
        self._computing = threading.Lock()

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
        self._queue.submit_work(
            lambda rig, cancelled: self._capture(job_id, parts, rig, cancelled),
            work_id=job_id,
            holder=holder,
            wait=wait,
            ended=lambda error: self._captured(job_id, parts, error),
            begun=record,
        )

    def compute(self, job_id: UUID, parts: Parts) -> None:
        """Have the second part of a job done that is on record. Returns at once."""
        try:
            self.jobs.advance(job_id, JobState.COMPUTING)
        except StorageError as refused:
            # That record is for whoever looks on.
            _log.warning("that a job computes could not be recorded", job=str(job_id), cause=str(refused))
        # A daemon, so that it never holds up the end of the service.
        threading.Thread(target=self._compute, args=(job_id, parts), name="slrig-job", daemon=True).start()

    def cancel(self, job_id: UUID) -> None:
        """Ask a job to end early. Returns at once; what the rig is not needed for any more goes on to its end."""
        self._queue.cancel_work(job_id)

    def take_up(self, record: JobRecord, parts: Parts, *, holder: Holder, resumes: bool = False) -> None:
        """Go on with a job of an earlier run of the service: submit it again if it waited, else end it as interrupted.
        resumes : whether its second part can be done from what is staged; it is, once.
        """
        if record.state is JobState.QUEUED:
            try:
                self.submit(record.id, parts, holder=holder, wait=True)
            except SlrigError as error:
                self._end(record.id, parts, error)
        elif resumes and record.state is JobState.COMPUTING and self.jobs.attempts(record.id) == 1:
            self.compute(record.id, parts)
        else:
            self.interrupt(record.id, parts)

    def interrupt(self, job_id: UUID, parts: Parts) -> None:
        """End a job that the end of the service cut off."""
        self._end(job_id, parts, interruption())

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent."""
        self._endings.close()

    def _recorder(self, job_id: UUID) -> ProgressRecorder:
        return ProgressRecorder(self.jobs, job_id, hidden=self._folder.hidden(job_id))

    def _capture(self, job_id: UUID, parts: Parts, rig: Rig, cancelled: Cancelled) -> None:
        self.jobs.advance(job_id, JobState.CAPTURING)
        self._folder.stage(job_id)
        parts.capture(rig, self._recorder(job_id), cancelled)

    def _captured(self, job_id: UUID, parts: Parts, error: Exception | None) -> None:
        if error is not None:
            self._interrupted(job_id, parts, error)
            return
        try:
            parts.captured()
        finally:
            self.compute(job_id, parts)

    def _compute(self, job_id: UUID, parts: Parts) -> None:
        try:
            with self._computing, structlog.contextvars.bound_contextvars(job=str(job_id)):
                found = parts.compute(self._recorder(job_id))
        except Exception as error:  # noqa: BLE001 - whatever goes wrong, the job gets its end
            self._interrupted(job_id, parts, error)
        else:
            state = JobState.SUCCEEDED if found.fault is None else JobState.FAILED
            self._settle(Ending(job_id, state, found.fault, found.summary), parts)

    def _interrupted(self, job_id: UUID, parts: Parts, error: Exception) -> None:
        """End a job by an error, but leave one that the end of the service caught in line, or computing, to the next
        start, which goes on with it or tells that it cannot.
        """
        if isinstance(error, ScanInterruptedError) and self.jobs.get(job_id).state is not JobState.CAPTURING:
            return
        self._end(job_id, parts, error)

    def _end(self, job_id: UUID, parts: Parts, error: Exception) -> None:
        self._settle(ending_by(error, job_id, hidden=self._folder.hidden(job_id)), parts)

    def _settle(self, ending: Ending, parts: Parts) -> None:
        self._folder.discard(ending.id)
        try:
            parts.ended(ending.state, ending.fault)
        except Exception:  # noqa: BLE001 - whoever waits for the job has to be told all the same
            _log.exception("the end of a job went wrong", job=str(ending.id))
        self._endings.add(ending)
        self._endings.settle()

"""How jobs ended, kept until the records have taken it: a disk that refuses now may take it later."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any
from uuid import UUID

import structlog

from slrig.errors import ScanCancelledError, ScanInterruptedError, StorageError
from slrig.failure import UNEXPECTED, JobFailure, job_failure
from slrig.jobs.records import JobState
from slrig.jobs.store import JobStore

RETRY_S = 2.0
"""How long after a refusal the records are tried again: soon enough for whoever waits for the end of a job."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Ending:
    """The final state of a job, why where that is not success, and the summary of its report where it is."""

    id: UUID
    state: JobState
    fault: JobFailure | None
    summary: Mapping[str, Any] | None = None


def ending_by(error: Exception, job_id: UUID, *, hidden: str) -> Ending:
    """How a job ends by an error, which the log is told unless somebody wanted it.

    hidden : left out of its message. The staging folder is gone when that is read.
    """
    fault = job_failure(error)
    fault = replace(fault, message=fault.message.replace(hidden, ""))
    state = JobState.FAILED
    if isinstance(error, ScanCancelledError):
        state = JobState.CANCELLED
    elif isinstance(error, ScanInterruptedError):
        state = JobState.INTERRUPTED
    elif fault.code == UNEXPECTED:
        _log.error("a job failed", job=str(job_id), exc_info=error)
    else:
        _log.warning("a job failed", job=str(job_id), code=fault.code, cause=fault.message)
    return Ending(job_id, state, fault)


class Endings:
    """The endings that are not on record yet. Any thread may call."""

    def __init__(self, store: JobStore) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._unrecorded: list[Ending] = []
        self._again: threading.Timer | None = None
        self._closed = False

    def __contains__(self, scan_id: object) -> bool:
        with self._lock:
            return any(ending.id == scan_id for ending in self._unrecorded)

    def add(self, ending: Ending) -> None:
        """Keep an ending; `settle` records it."""
        with self._lock:
            self._unrecorded.append(ending)

    def close(self) -> None:
        """Try once more, and never again. Whatever is not on record then is found at the next start."""
        with self._lock:
            self._closed = True
            if self._again is not None:
                self._again.cancel()
        self.settle()

    def settle(self) -> None:
        """Record what is kept. What the disk refuses is tried again after a while."""
        with self._lock:
            endings = list(self._unrecorded)
        for ending in endings:
            try:
                made = self._store.finish(ending.id, ending.state, fault=ending.fault, summary=ending.summary)
            except Exception as error:  # noqa: BLE001 - whatever refuses the record, the ending is not lost
                _log.error(
                    "the end of a job could not be recorded",
                    job=str(ending.id), state=str(ending.state), exc_info=not isinstance(error, StorageError),
                    cause=str(error),
                )  # fmt: skip
                self._try_again()
                continue
            with self._lock:
                self._unrecorded = [each for each in self._unrecorded if each is not ending]
            if made:
                _log.info("job finished", job=str(ending.id), state=str(ending.state))

    def _try_again(self) -> None:
        with self._lock:
            if self._again is None and not self._closed:
                self._again = threading.Timer(RETRY_S, self._retry)
                self._again.daemon = True
                self._again.start()

    def _retry(self) -> None:
        with self._lock:
            self._again = None
        if not self._closed:
            self.settle()

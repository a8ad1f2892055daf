"""How far a job is, put on record as often as a person cares to know."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from uuid import UUID

import structlog

from slrig.errors import StorageError
from slrig.jobs.records import JobProgress
from slrig.jobs.store import JobStore

_LEAST_STEP = 0.01
_LEAST_S = 0.1  # each is brought to disk, on the thread that captures; nobody sees more than ten a second
_DETAIL_S = 2.0  # a person who looks on wants a sign every few seconds

_log = structlog.get_logger(__name__)


class ProgressRecorder:
    """Takes progress from the work and records the steps worth telling: a new stage, a hundredth of the way, ten times
    a second at most, the end, or another detail of a stage that goes on.
    """

    def __init__(
        self,
        store: JobStore,
        job_id: UUID,
        *,
        hidden: str,
        span: tuple[float, float] = (0.0, 1.0),
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """`hidden` is left out of what is recorded; the fractions told are of `span`, a part of the whole job."""
        self._now_s = now_s
        self._told_s = -math.inf
        self._hidden = hidden
        self._store = store
        self._job_id = job_id
        self._start, self._end = span
        self._told = JobProgress("", -1.0, "")

    def file_made(self, name: str) -> None:
        """Take note of a file that can be fetched before the job is over; a refusal fails no work, either."""
        self._recorded("a file of a job could not be announced", lambda: self._store.file_made(self._job_id, name))

    def captured(self) -> None:
        """Take note that the job needs the rig no longer; a refusal fails no work, either."""
        self._recorded("that the rig is free of a job could not be told", lambda: self._store.captured(self._job_id))

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """Take note, as `slrig.scan.plan.ProgressCallback` asks. A record that is refused fails no work: see the
        log.
        """
        overall = self._start + (self._end - self._start) * min(max(fraction, 0.0), 1.0)
        since_s = self._now_s() - self._told_s
        goes_on = detail != self._told.detail and since_s >= _DETAIL_S
        further = overall - self._told.fraction >= _LEAST_STEP and (since_s >= _LEAST_S or fraction >= 1)
        if goes_on or stage != self._told.stage or further:
            self._told = JobProgress(stage, overall, detail.replace(self._hidden, ""))
            self._told_s = self._now_s()
            self._recorded(
                "how far a job is could not be recorded", lambda: self._store.progress(self._job_id, self._told)
            )

    def _recorded(self, refused: str, record: Callable[[], None]) -> None:
        try:
            record()
        except StorageError as error:
            _log.warning(refused, job=str(self._job_id), cause=str(error))

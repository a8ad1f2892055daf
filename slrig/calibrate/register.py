"""The calibrations that are on record, what happens to them, and whom that wakes. Any thread may ask and change."""

from __future__ import annotations

import threading
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from uuid import UUID

import structlog

from slrig.calibrate.records import PoseRecord, SessionRecord
from slrig.calibrate.store import CalibrationStore, not_found, swept
from slrig.errors import CalibrationNotFoundError, StorageError
from slrig.jobs.records import JobEvent, JobProgress

MOST_EVENTS = 2000
"""Of one calibration, that are remembered; not beyond the end of the service."""

_LEAST_STEP = 0.01

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _News:
    """What happened to one calibration since the service began."""

    last: int = 0
    events: deque[JobEvent] = field(default_factory=lambda: deque(maxlen=MOST_EVENTS))
    watchers: list[Callable[[], None]] = field(default_factory=list)


class CalibrationRegister:
    """Holds every record in memory, and each change of one on disk before it is seen.

    `lock` may be held over several calls. Only the process that holds the data folder makes one.
    """

    def __init__(self, store: CalibrationStore) -> None:
        self.store = store
        self.lock = threading.RLock()
        self._records = {session.id: session for session in store.load()}
        self._news: dict[UUID, _News] = defaultdict(_News)
        self._closed = False

    def all(self) -> Sequence[SessionRecord]:
        """Return every calibration, newest first."""
        with self.lock:
            return sorted(self._records.values(), key=lambda record: record.number, reverse=True)

    def get(self, session_id: UUID) -> SessionRecord:
        """Return a calibration. Raises CalibrationNotFoundError."""
        with self.lock:
            found = self._records.get(session_id)
        if found is None:
            raise not_found(session_id)
        return found

    def pose(self, session_id: UUID, number: int) -> PoseRecord:
        """Return a pose. Raises CalibrationNotFoundError."""
        record = self.get(session_id)
        for pose in record.poses:
            if pose.number == number:
                return pose
        numbers = ", ".join(str(pose.number) for pose in record.poses) or "none"
        message = f"Calibration {session_id} has no pose {number}; its poses: {numbers}."
        raise CalibrationNotFoundError(message)

    def next_number(self) -> int:
        """Return the number of the next calibration."""
        with self.lock:
            return max((record.number for record in self._records.values()), default=0) + 1

    def add(self, record: SessionRecord) -> None:
        """Put a new calibration on record. Raises StorageError."""
        with self.lock:
            self.store.create(record)
            self._records[record.id] = record

    def remove(self, session_id: UUID) -> None:
        """Forget a calibration and remove its files."""
        with self.lock:
            self.store.delete(session_id)
            del self._records[session_id]
        self._wake(session_id)

    def change(
        self, session_id: UUID, change: Callable[[SessionRecord], SessionRecord], *, must_last: bool = True
    ) -> SessionRecord:
        """Replace a record, first on disk, and tell what is new of it.

        Where `must_last` is False, a disk that refuses leaves the change in memory alone, to be saved with the next:
        the way something ended is not lost because the disk is full.

        Raises
        ------
        CalibrationNotFoundError
            It was deleted.
        StorageError
            The disk refused; nothing has changed.
        """
        with self.lock:
            before = self.get(session_id)
            after = change(before)
            if after is before or self._closed:
                return before
            try:
                self.store.save(after)
            except StorageError as error:
                if must_last:
                    raise
                _log.exception("the end of a pose or a solve could not be saved", calibration=str(session_id))
                _log.warning("it is kept until the disk takes it", cause=str(error))
            self._records[session_id] = after
            self._tell(before, after)
        self._wake(session_id)
        return after

    def change_pose(
        self, session_id: UUID, number: int, change: Callable[[PoseRecord], PoseRecord], *, must_last: bool = True
    ) -> SessionRecord:
        """Replace a pose of a record: see `change`."""

        def changed(record: SessionRecord) -> SessionRecord:
            return record.with_pose(change(self.pose(session_id, number)))

        return self.change(session_id, changed, must_last=must_last)

    def progress(self, session_id: UUID, stage: str, fraction: float, detail: str, *, pose: int | None = None) -> None:
        """Tell how far a pose or a solve is; worth telling are a new stage, and a hundredth of the way."""
        now = JobProgress(stage, min(max(fraction, 0.0), 1.0), detail)
        with self.lock:
            record = self._records.get(session_id)
            if record is None or self._closed:
                return
            told = record.progress
            if told is not None and told.stage == stage and 0 <= now.fraction - told.fraction < _LEAST_STEP:
                return
            # How far it is need not survive the service.
            self._records[session_id] = replace(record, progress=now)
            self._append(session_id, "progress", {**now.as_json(), "pose": pose})
        self._wake(session_id)

    def events(self, session_id: UUID, *, after: int) -> Sequence[JobEvent]:
        """Return what happened to a calibration since the service began, after the event of a number."""
        with self.lock:
            return [event for event in self._news[session_id].events if event.number > after]

    def last_event(self, session_id: UUID) -> int:
        """Return the number of the newest event."""
        with self.lock:
            return self._news[session_id].last

    def watch(self, session_id: UUID, wake: Callable[[], None]) -> Callable[[], None]:
        """Have `wake` called, from any thread, after each new event. Returns the call that ends it."""
        with self.lock:
            self._news[session_id].watchers.append(wake)

        def unwatch() -> None:
            with self.lock:
                self._news[session_id].watchers.remove(wake)

        return unwatch

    def close(self) -> None:
        """Mark what is under way as cut off, and change nothing any more. Idempotent."""
        with self.lock:
            for session_id in list(self._records):
                self.change(session_id, swept, must_last=False)
            self._closed = True

    def _tell(self, before: SessionRecord, after: SessionRecord) -> None:
        known = {pose.number: pose for pose in before.poses}
        for pose in after.poses:
            earlier = known.get(pose.number)
            if earlier is None or earlier.state is not pose.state:
                self._append(after.id, "pose", {"pose": pose.number, "state": pose.state})
        if after.state is not before.state:
            self._append(after.id, "state", {"state": after.state})

    def _append(self, session_id: UUID, kind: str, data: dict[str, Any]) -> None:
        news = self._news[session_id]
        news.last += 1
        news.events.append(JobEvent(news.last, kind, data))

    def _wake(self, session_id: UUID) -> None:
        with self.lock:
            watchers = list(self._news[session_id].watchers)
        for wake in watchers:
            wake()

"""The calibrations that are on record, with what their jobs say. Any thread may ask and change."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from uuid import UUID

import structlog

from slrig.calibrate.records import PoseRecord, SessionRecord, with_jobs
from slrig.calibrate.store import CalibrationStore
from slrig.errors import CalibrationNotFoundError, StorageError
from slrig.jobs.records import JobKind, utc_now
from slrig.jobs.store import JobStore

_log = structlog.get_logger(__name__)


class CalibrationRegister:
    """Holds every session in memory, and each change of one on disk before it is seen.

    jobs : the poses and the solves. `lock` may be held over several calls. Only the process that holds the data folder
    makes one.
    """

    def __init__(self, store: CalibrationStore, jobs: JobStore) -> None:
        self.store = store
        self.jobs = jobs
        self.lock = threading.RLock()
        self._sessions = {session.id: session for session in store.load()}

    def all(self) -> Sequence[SessionRecord]:
        """Return every calibration, newest first."""
        with self.lock:
            sessions = sorted(self._sessions.values(), key=lambda session: session.number, reverse=True)
            jobs = self.jobs.by_parent(JobKind.POSE, JobKind.SOLVE)
        return [with_jobs(session, jobs.get(session.id, ())) for session in sessions]

    def get(self, session_id: UUID) -> SessionRecord:
        """Return a calibration. Raises CalibrationNotFoundError."""
        with self.lock:
            return with_jobs(self._session(session_id), self.jobs.of(session_id))

    def pose(self, session_id: UUID, number: int) -> PoseRecord:
        """Return a pose. Raises CalibrationNotFoundError."""
        poses = {pose.number: pose for pose in self.get(session_id).poses}
        if number not in poses:
            numbers = ", ".join(str(each) for each in poses) or "none"
            message = f"Calibration {session_id} has no pose {number}; its poses: {numbers}."
            raise CalibrationNotFoundError(message)
        return poses[number]

    def add(self, session_id: UUID, rig: str, label: str | None, **fields: Any) -> SessionRecord:
        """Put a new calibration on record, and return it. Raises StorageError."""
        with self.lock:
            number = max((session.number for session in self._sessions.values()), default=0) + 1
            session = SessionRecord(number, session_id, utc_now(), rig, label, **fields)
            self.store.create(session)
            self._sessions[session_id] = session
            return session

    def remove(self, session_id: UUID) -> None:
        """Forget a calibration with its jobs, and remove its files. Raises StorageError."""
        with self.lock:
            self.store.delete(session_id)
            del self._sessions[session_id]
        self.jobs.delete_of(session_id)

    def change(self, session_id: UUID, *, must_last: bool = True, **fields: Any) -> None:
        """Replace fields of a session, first on disk.

        Where `must_last` is False, a disk that refuses leaves the change in memory alone, to be saved with the next:
        the way something ended is not lost because the disk is full.

        Raises CalibrationNotFoundError if it was deleted, StorageError if the disk refused and nothing has changed.
        """
        with self.lock:
            before = self._session(session_id)
            after = replace(before, **fields)
            if after == before:
                return
            try:
                self.store.save(after)
            except StorageError as error:
                if must_last:
                    raise
                _log.warning(
                    "a change of a calibration is kept until the disk takes it",
                    calibration=str(session_id), cause=str(error),
                )  # fmt: skip
            self._sessions[session_id] = after

    def _session(self, session_id: UUID) -> SessionRecord:
        if session_id not in self._sessions:
            message = f"No calibration {session_id} is on record here. GET /calibration lists those that are."
            raise CalibrationNotFoundError(message)
        return self._sessions[session_id]

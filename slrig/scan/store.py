"""The record of scans, their events and idempotency keys, in the service's database."""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import structlog
from sqlalchemy import delete, select, text
from sqlalchemy.orm import Session

from slrig.errors import ScanNotFoundError, StorageError
from slrig.failure import JobFailure, KeyInFlightError
from slrig.jobs.database import Database
from slrig.jobs.records import Clock, require_same_body, utc_now
from slrig.scan.migrations import upgrade
from slrig.scan.plan import ScanPlan
from slrig.scan.records import KeptRecord, ScanEvent, ScanProgress, ScanRecord, ScanState, plan_from_json, plan_json
from slrig.scan.tables import EventRow, KeyRow, ScanRow

_log = structlog.get_logger(__name__)

KEY_LIFE_S = 24 * 3600.0
"""How long an idempotency key is remembered unless told otherwise."""

_LEAST_STEP = 0.01
_PROGRESS_PATIENCE_S = 0.2  # the work waits meanwhile
_DETAIL_S = 2.0  # a person who looks on wants a sign every few seconds


class ScanStore:
    """Scans, their events and idempotency keys. Safe to call from any thread of the one process that owns it."""

    def __init__(self, database: Path, *, clock: Clock = utc_now, key_life_s: float = KEY_LIFE_S) -> None:
        self._clock = clock
        self._key_life = timedelta(seconds=key_life_s)
        self._watching = threading.Lock()
        self._watchers: dict[UUID, list[Callable[[], None]]] = defaultdict(list)
        self._database = Database(database, upgrade=upgrade)

    def close(self) -> None:
        """Let the database go."""
        self._database.close()

    def check(self) -> None:
        """Raise StorageError unless the database answers."""
        with self._database.reading() as session:
            session.execute(text("SELECT 1"))

    def create(self, plan: ScanPlan, *, rig: str, label: str | None, key: str | None = None) -> ScanRecord:
        """Record a new scan as queued and, in the same transaction, tie its idempotency key to it."""
        row = ScanRow(
            id=str(uuid4()),
            state=ScanState.QUEUED,
            label=label,
            rig=rig,
            plan=plan_json(plan),
            created_at=self._now(),
            stage="waiting",
            fraction=0.0,
            detail="",
            last_event=0,
        )
        with self._database.changing() as session:
            session.add(row)
            session.flush()
            if key is not None and (held := session.get(KeyRow, key)) is not None:
                held.scan_id = row.id
            _append(session, row, "state", {"state": row.state, "time": row.created_at})
            return _record(row)

    def restore(self, record: KeptRecord, summary: Mapping[str, Any]) -> None:
        """Put a scan that succeeded on record again. How it went is not known any more; its end is taken for now."""
        row = ScanRow(
            id=str(record.id),
            state=ScanState.SUCCEEDED,
            label=record.label,
            rig=record.rig,
            plan=plan_json(record.plan),
            created_at=_stamp(record.created_at),
            started_at=_stamp(record.started_at),
            stage="",
            fraction=0.0,
            detail="",
            last_event=0,
        )
        with self._database.changing() as session:
            session.add(row)
            session.flush()
            self._close_row(session, row, ScanState.SUCCEEDED, None, summary)

    def get(self, scan_id: UUID) -> ScanRecord:
        """Return a scan. Raises ScanNotFoundError."""
        with self._database.reading() as session:
            return _record(_find(session, scan_id))

    def page(self, *, before: int | None, limit: int) -> Sequence[ScanRecord]:
        """Return up to `limit` scans, newest first, whose number is below `before`."""
        query = select(ScanRow).order_by(ScanRow.number.desc()).limit(limit)
        if before is not None:
            query = query.where(ScanRow.number < before)
        with self._database.reading() as session:
            return [_record(row) for row in session.scalars(query)]

    def unfinished(self) -> Sequence[ScanRecord]:
        """Return the scans that are in no final state, oldest first."""
        running = [state for state in ScanState if not state.final]
        query = select(ScanRow).where(ScanRow.state.in_(running)).order_by(ScanRow.number)
        with self._database.reading() as session:
            return [_record(row) for row in session.scalars(query)]

    def states(self) -> dict[UUID, ScanState]:
        """Return the state of every scan on record."""
        with self._database.reading() as session:
            return {
                UUID(found): ScanState(state) for found, state in session.execute(select(ScanRow.id, ScanRow.state))
            }

    def advance(self, scan_id: UUID, state: ScanState) -> datetime:
        """Record that a running scan entered another running state, and return when."""
        with self._database.changing() as session:
            row = _find(session, scan_id)
            row.state = state
            now = self._now()
            row.started_at = row.started_at or now
            _append(session, row, "state", {"state": state, "time": now})
        self._wake(scan_id)
        return datetime.fromisoformat(now)

    def progress(self, scan_id: UUID, progress: ScanProgress) -> None:
        """Record how far a running scan is. Where that cannot be had at once it is refused: the next will be told."""
        with self._database.changing(patience_s=_PROGRESS_PATIENCE_S) as session:
            row = _find(session, scan_id)
            row.stage, row.fraction, row.detail = progress.stage, progress.fraction, progress.detail
            _append(session, row, "progress", {**progress.as_json(), "state": row.state})
        self._wake(scan_id)

    def finish(
        self,
        scan_id: UUID,
        state: ScanState,
        *,
        fault: JobFailure | None = None,
        summary: Mapping[str, Any] | None = None,
    ) -> bool:
        """Record a final state. The first one stands: returns False, and changes nothing, for a finished scan."""
        with self._database.changing() as session:
            row = _find(session, scan_id)
            if ScanState(row.state).final:
                return False
            self._close_row(session, row, state, fault, summary)
        self._wake(scan_id)
        return True

    def lose_files(self, scan_id: UUID, fault: JobFailure) -> None:
        """Record that a finished scan's files are gone."""
        with self._database.changing() as session:
            self._close_row(session, _find(session, scan_id), ScanState.FAILED, fault, None)

    def delete(self, scan_id: UUID) -> None:
        """Forget a scan and its events. Raises ScanNotFoundError."""
        with self._database.changing() as session:
            session.delete(_find(session, scan_id))
        # Whoever waits for its next event would wait for ever.
        self._wake(scan_id)

    def events(self, scan_id: UUID, *, after: int) -> Sequence[ScanEvent]:
        """Return a scan's events whose number is above `after`, in order."""
        query = (
            select(EventRow).where(EventRow.scan_id == str(scan_id), EventRow.number > after).order_by(EventRow.number)
        )
        with self._database.reading() as session:
            return [ScanEvent(row.number, row.kind, row.data) for row in session.scalars(query)]

    def last_event(self, scan_id: UUID) -> int:
        """Return the number of a scan's newest event. Raises ScanNotFoundError."""
        with self._database.reading() as session:
            return _find(session, scan_id).last_event

    def watch(self, scan_id: UUID, wake: Callable[[], None]) -> Callable[[], None]:
        """Have `wake` called, from any thread, after each new event of a scan and after its deletion. Returns the
        call that ends it.
        """
        with self._watching:
            self._watchers[scan_id].append(wake)

        def unwatch() -> None:
            with self._watching:
                self._watchers[scan_id].remove(wake)
                if not self._watchers[scan_id]:
                    del self._watchers[scan_id]

        return unwatch

    def reserve_key(self, key: str, fingerprint: str) -> UUID | None:
        """Hold an idempotency key for a request, or return the scan that the first request with it made.

        Raises
        ------
        KeyInFlightError
            The first request is still being answered.
        IdempotencyError
            The first request had another body.
        """
        with self._database.changing() as session:
            expired = _stamp(self._clock() - self._key_life)
            session.execute(delete(KeyRow).where(KeyRow.created_at < expired))
            held = session.get(KeyRow, key)
            if held is None:
                session.add(KeyRow(key=key, fingerprint=fingerprint, scan_id=None, created_at=self._now()))
                return None
            require_same_body(held.fingerprint, fingerprint, made="scan")
            if held.scan_id is None:
                message = "The first request with this Idempotency-Key is still being answered. Ask again in a second."
                raise KeyInFlightError(message)
            return UUID(held.scan_id)

    def release_key(self, key: str) -> None:
        """Free a key whose request made no scan, so that it may be tried again."""
        with self._database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.key == key, KeyRow.scan_id.is_(None)))

    def release_keys(self) -> None:
        """Free every key whose request was cut off. For the start of the service, when none can be in flight."""
        with self._database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.scan_id.is_(None)))

    def _close_row(
        self,
        session: Session,
        row: ScanRow,
        state: ScanState,
        fault: JobFailure | None,
        summary: Mapping[str, Any] | None,
    ) -> None:
        row.state = state
        row.finished_at = row.finished_at or self._now()
        row.summary = None if summary is None else dict(summary)
        if state is ScanState.SUCCEEDED:
            row.stage, row.fraction, row.detail = "done", 1.0, ""
        if fault is not None:
            row.fault_kind, row.fault_message = fault.kind, fault.message
        error = None if fault is None else {"kind": fault.kind, "message": fault.message}
        _append(session, row, "state", {"state": state, "time": row.finished_at, "error": error})

    def _now(self) -> str:
        return _stamp(self._clock())

    def _wake(self, scan_id: UUID) -> None:
        with self._watching:
            watchers = list(self._watchers.get(scan_id, ()))
        for wake in watchers:
            wake()


class ProgressRecorder:
    """Takes progress from the work and records the steps worth telling: a new stage, a hundredth of the way, or another
    detail of a stage that goes on.
    """

    def __init__(
        self, store: ScanStore, scan_id: UUID, *, hidden: str, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """`hidden` is left out of what is recorded."""
        self._now_s = now_s
        self._told_s = -math.inf
        self._hidden = hidden
        self._store = store
        self._scan_id = scan_id
        self._start, self._end = 0.0, 1.0
        self._told = ScanProgress("", -1.0, "")

    def span(self, start: float, end: float) -> None:
        """Map the fractions that follow into start..end of the whole scan."""
        self._start, self._end = start, end

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """Take note, as `slrig.scan.plan.Progress` asks. A record that is refused fails no work: see the log."""
        overall = self._start + (self._end - self._start) * min(max(fraction, 0.0), 1.0)
        goes_on = detail != self._told.detail and self._now_s() - self._told_s >= _DETAIL_S
        if goes_on or stage != self._told.stage or overall - self._told.fraction >= _LEAST_STEP:
            self._told = ScanProgress(stage, overall, detail.replace(self._hidden, ""))
            self._told_s = self._now_s()
            try:
                self._store.progress(self._scan_id, self._told)
            except StorageError as error:
                _log.warning("how far a scan is could not be recorded", scan=str(self._scan_id), cause=str(error))


def _find(session: Session, scan_id: UUID) -> ScanRow:
    row = session.scalar(select(ScanRow).where(ScanRow.id == str(scan_id)))
    if row is None:
        message = f"No scan {scan_id} is on record here. GET /scan lists those that are."
        raise ScanNotFoundError(message)
    return row


def _append(session: Session, row: ScanRow, kind: str, data: dict[str, Any]) -> None:
    row.last_event += 1
    session.add(EventRow(scan_id=row.id, number=row.last_event, kind=kind, data=data))


def _record(row: ScanRow) -> ScanRecord:
    return ScanRecord(
        number=row.number,
        id=UUID(row.id),
        state=ScanState(row.state),
        label=row.label,
        rig=row.rig,
        plan=plan_from_json(row.plan),
        created_at=datetime.fromisoformat(row.created_at),
        started_at=_moment(row.started_at),
        finished_at=_moment(row.finished_at),
        progress=ScanProgress(row.stage, row.fraction, row.detail),
        fault=None if row.fault_kind is None else JobFailure(row.fault_kind, row.fault_message or ""),
        summary=row.summary,
    )


def _stamp(moment: datetime) -> str:
    return moment.isoformat(timespec="milliseconds")


def _moment(stamp: str | None) -> datetime | None:
    return None if stamp is None else datetime.fromisoformat(stamp)

"""The one that scans: one rig, one owner thread, one scan at a time, the others waiting in a short queue."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol
from uuid import UUID

import structlog

from slrig.devices import Rig
from slrig.errors import (
    DeviceError,
    InvalidInputError,
    QueueFullError,
    RigBusyError,
    ScanCancelledError,
    ScanStateError,
    SlrigError,
    UnsupportedByDeviceError,
)
from slrig.scan.faults import UNEXPECTED, ScanFault, ScanInterruptedError, disk_errors, fault_of, interruption
from slrig.scan.feed import FrameSink
from slrig.scan.folder import DataFolder, sync_tree
from slrig.scan.holding import HeldRig, RigFacts, check_plan, driver_errors
from slrig.scan.plan import ScanPlan
from slrig.scan.records import ScanRecord, ScanState, report_summary
from slrig.scan.store import ProgressRecorder, ScanStore
from slrig.scan.worker import Job, ReconstructionWorker

CAPTURE_SHARE = 0.5
"""The part of a scan's progress that is capture."""

_LAST_RESORT_S = 1.0

_log = structlog.get_logger(__name__)


class CaptureBundle(Protocol):
    """`slrig.scan.acquisition.capture_bundle`, or what a test puts in its place."""

    def __call__(
        self,
        rig: Rig,
        plan: ScanPlan,
        folder: Path,
        /,
        *,
        progress: Callable[[str, float, str], None],
        cancelled: Callable[[], bool],
        frames: FrameSink,
    ) -> None:
        """Play the patterns and write a complete bundle into `folder`; show each frame to `frames`."""
        ...


@dataclass(frozen=True, slots=True)
class RunnerStatus:
    """What the runner is at: the rig as far as it is known, who holds it and since when, and how many wait.

    `reconstruction` is `ReconstructionWorker.condition`.
    """

    rig: str
    facts: RigFacts | None
    fault: str | None
    holder: UUID | None
    since: datetime | None
    waiting: int
    queue_length: int
    reconstruction: str
    ending: bool


@dataclass(slots=True)
class _Task:
    id: UUID
    plan: ScanPlan
    since: datetime
    stop: threading.Event = field(default_factory=threading.Event)


@dataclass(frozen=True, slots=True, eq=False)
class _Ending:
    id: UUID
    state: ScanState
    fault: ScanFault | None
    summary: Mapping[str, Any] | None = None


class Runner:
    """Takes scans, works them off in order, and leaves every one of them in a final state.

    Every public method may be called from any thread.
    """

    def __init__(
        self,
        store: ScanStore,
        folder: DataFolder,
        rig: HeldRig,
        worker: ReconstructionWorker,
        *,
        capture: CaptureBundle,
        queue_length: int = 8,
        spare_bytes: int = 0,
        give_up: Callable[[InvalidInputError], None] = lambda _: None,
    ) -> None:
        """`give_up` is told, on the owner thread, when the first opening shows that the rig file is wrong."""
        self._store = store
        self._folder = folder
        self._rig = rig
        self._worker = worker
        self._capture = capture
        self._queue_length = queue_length
        self._spare_bytes = spare_bytes
        self._give_up = give_up
        self._closing = threading.Lock()
        self._closed = False
        self._changed = threading.Condition()
        self._waiting: deque[_Task] = deque()
        self._active: _Task | None = None
        self._unrecorded: list[_Ending] = []
        self._ending = False
        self._owner = threading.Thread(target=self._own_rig, name="slrig-rig", daemon=True)

    def start(self) -> None:
        """Start the owner thread, which opens the rig, and the reconstruction process, which loads its kernels."""
        self._owner.start()
        self._worker.start()

    def submit(self, plan: ScanPlan, *, label: str | None, wait: bool, key: str | None = None) -> ScanRecord:
        """Record a scan and have it done; `wait` lets it queue behind others.

        Raises
        ------
        PatternError, UnsupportedByDeviceError
            The rig cannot do what the plan asks for.
        StorageError
            There is too little room for the frames.
        RigBusyError
            The rig is held, and `wait` is False.
        QueueFullError
            As many scans are waiting as may.
        """
        # Before the rig was first open nothing is known about it; the scan then fails with the same errors.
        frame_bytes = 0 if self._rig.facts is None else check_plan(plan, self._rig.facts)
        # Frames once as captured, and as much again for meshes and the zipped bundle of a careful client.
        self._folder.require_space(2 * frame_bytes + self._spare_bytes)
        with self._changed:
            if self._ending:
                raise interruption()
            holder = self._active or (self._waiting[0] if self._waiting else None)
            if holder is not None and not wait:
                since = holder.since.isoformat(timespec="seconds")
                message = (
                    f"The rig is held by scan {holder.id} since {since}. Wait for it, cancel it with "
                    f'POST /scan/{holder.id}/cancel, or send "if_busy": "queue" to wait in line.'
                )
                raise RigBusyError(message, holder=str(holder.id), since=since)
            if len(self._waiting) >= self._queue_length and holder is not None:
                message = (
                    f"The rig is held and {len(self._waiting)} scans are waiting, as many as may. Try again later."
                )
                raise QueueFullError(message)
            record = self._store.create(plan, rig=self._rig.name, label=label, key=key)
            self._waiting.append(_Task(record.id, plan, record.created_at))
            self._changed.notify_all()
        return record

    def cancel(self, scan_id: UUID) -> ScanRecord:
        """Ask a scan to stop. Returns at once; a scan that has finished stays as it is. Raises ScanNotFoundError."""
        record = self._store.get(scan_id)
        with self._changed:
            queued = next((task for task in self._waiting if task.id == scan_id), None)
            if queued is not None:
                self._waiting.remove(queued)
                message = "The scan was cancelled while it waited for the rig."
                self._unrecorded.append(_Ending(scan_id, ScanState.CANCELLED, fault_of(ScanCancelledError(message))))
            elif self._active is not None and self._active.id == scan_id:
                self._active.stop.set()
                return record
        self._settle()
        with self._changed:
            ended = any(ending.id == scan_id for ending in self._unrecorded)
        if not ended:
            # Nobody works on it, and nobody knows how it ended: the least that can be done is to let it go.
            message = "Nothing works on this scan any more. Scan again."
            self._store.finish(scan_id, ScanState.INTERRUPTED, fault=fault_of(ScanInterruptedError(message)))
        return self._store.get(scan_id)

    def delete(self, scan_id: UUID) -> None:
        """Remove a finished scan: its record, its events, its files.

        Raises
        ------
        ScanNotFoundError
            There is no such scan.
        ScanStateError
            It is not finished.
        """
        self._settle()
        record = self._store.get(scan_id)
        if not record.state.final:
            message = (
                f"Scan {scan_id} is {record.state}. Cancel it first (POST /scan/{scan_id}/cancel), then delete it."
            )
            raise ScanStateError(message)
        self._folder.discard(scan_id)
        self._folder.withdraw(scan_id)
        self._store.delete(scan_id)
        self._folder.discard(scan_id)
        _log.info("scan deleted", scan=str(scan_id))

    def status(self) -> RunnerStatus:
        """Return what the runner is at. Touches no device."""
        with self._changed:
            holder = self._active
            return RunnerStatus(
                rig=self._rig.name,
                facts=self._rig.facts,
                fault=None if self._rig.fault is None else self._rig.fault.message,
                holder=None if holder is None else holder.id,
                since=None if holder is None else holder.since,
                waiting=len(self._waiting),
                queue_length=self._queue_length,
                reconstruction=self._worker.condition,
                ending=self._ending,
            )

    def close(self, *, timeout_s: float = 3.0) -> None:
        """Stop scanning, darken and close the rig, and record what was cut off as interrupted. Idempotent.

        A driver that does not return in `timeout_s` is left behind: the projector is darkened past it, as far as it
        lets, and its scan is recorded all the same.
        """
        with self._closing:
            if not self._closed:
                self._closed = True
                self._close(timeout_s)

    def _close(self, timeout_s: float) -> None:
        with self._changed:
            self._ending = True
            cut_off = list(self._waiting)
            self._waiting.clear()
            if self._active is not None:
                self._active.stop.set()
            self._changed.notify_all()
        self._worker.close()
        if self._owner.is_alive():
            self._owner.join(timeout_s)
        if self._owner.is_alive():
            _log.error("the rig's driver does not return; the service ends without it", rig=self._rig.name)
            # On a thread of its own: a driver that is stuck may hold back this call as well.
            last_resort = threading.Thread(target=self._rig.darken_from_outside, name="slrig-dark", daemon=True)
            last_resort.start()
            last_resort.join(_LAST_RESORT_S)
        with self._changed:
            cut_off.extend([] if self._active is None else [self._active])
            fault = fault_of(interruption())
            self._unrecorded.extend(_Ending(task.id, ScanState.INTERRUPTED, fault) for task in cut_off)
        self._settle()

    def _own_rig(self) -> None:
        error = self._rig.try_open()
        if isinstance(error, InvalidInputError):
            self._give_up(error)
        else:
            self._log_unopened(error)
        while (task := self._next()) is not None:
            try:
                self._scan(task)
            except Exception:  # noqa: BLE001 - the owner thread outlives whatever happens to one scan
                _log.exception("the end of a scan went wrong", scan=str(task.id))
        self._rig.darken()
        self._rig.let_go()

    def _next(self) -> _Task | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ending)
            if self._ending:
                return None
            self._active = self._waiting.popleft()
            return self._active

    def _scan(self, task: _Task) -> None:
        self._settle()
        ending = _Ending(task.id, ScanState.FAILED, fault_of(RuntimeError()))
        try:
            ending = self._ended(task)
            self._rig.darken()
            if ending.state is not ScanState.SUCCEEDED:
                self._keep_evidence(task, ending.state)
            self._worker.start()
        finally:
            # The rig is free before anyone can read that the scan is over: a client may start its next one at once.
            with self._changed:
                self._active = None
                self._unrecorded.append(ending)
            self._settle()
        if not self._ending:
            self._log_unopened(self._rig.recover())

    def _ended(self, task: _Task) -> _Ending:
        log = _log.bind(scan=str(task.id))
        state, summary, fault = ScanState.FAILED, None, None
        try:
            summary = self._walk(task)
            state = ScanState.SUCCEEDED
        except Exception as error:
            fault = self._told(task, error)
            if self._ending:
                state, fault = ScanState.INTERRUPTED, fault_of(interruption())
            elif isinstance(error, ScanCancelledError):
                state = ScanState.CANCELLED
            elif fault.kind == UNEXPECTED:
                log.exception("scan failed", kind=fault.kind)
            else:
                log.warning("scan failed", kind=fault.kind, cause=fault.message)
        return _Ending(task.id, state, fault, summary)

    def _settle(self) -> None:
        """Record how scans ended. What the disk refuses is kept and tried again: before the next scan, and at close."""
        with self._changed:
            endings = list(self._unrecorded)
        for ending in endings:
            try:
                made = self._store.finish(ending.id, ending.state, fault=ending.fault, summary=ending.summary)
            except Exception:  # noqa: BLE001 - whatever refuses the record, the ending is not lost
                _log.exception("the end of a scan could not be recorded", scan=str(ending.id), state=str(ending.state))
                continue
            with self._changed:
                self._unrecorded = [each for each in self._unrecorded if each is not ending]
            if made:
                _log.info("scan finished", scan=str(ending.id), state=str(ending.state))

    def _log_unopened(self, error: Exception | None) -> None:
        if isinstance(error, SlrigError):
            _log.warning("the rig cannot be opened; the next scan tries again", rig=self._rig.name, cause=str(error))
        elif error is not None:
            _log.error("the rig's driver failed with an error of its own", rig=self._rig.name, exc_info=error)

    def _told(self, task: _Task, error: Exception) -> ScanFault:
        # The staging folder is gone when the message is read: what it names is then the scan's own bundle.
        fault = fault_of(error)
        return ScanFault(fault.kind, fault.message.replace(f"{self._folder.staging(task.id)}/", ""))

    def _walk(self, task: _Task) -> Mapping[str, Any]:
        progress = ProgressRecorder(self._store, task.id, hidden=f"{self._folder.staging(task.id)}/")
        task.since = self._store.advance(task.id, ScanState.CAPTURING)
        rig = self._rig.open()
        if self._rig.facts is not None:
            self._folder.require_space(2 * check_plan(task.plan, self._rig.facts) + self._spare_bytes)
        staged = self._folder.stage(task.id)
        bundle = staged / "bundle"
        progress.span(0.0, CAPTURE_SHARE)
        feed = self._worker.feed()
        try:
            with driver_errors(self._rig.name):
                self._capture(rig, task.plan, bundle, progress=progress, cancelled=task.stop.is_set, frames=feed)
        except Exception as error:
            feed.abandon()
            kind = fault_of(error).kind
            failed = isinstance(error, DeviceError) and not isinstance(error, UnsupportedByDeviceError)
            if failed or kind == UNEXPECTED:
                # Nobody knows what state the devices are in; the next scan opens them afresh.
                self._rig.let_go(error)
            raise
        self._rig.darken()
        with disk_errors(staged):
            sync_tree(bundle)
        if task.stop.is_set():
            feed.abandon()
            message = "The scan was cancelled."
            raise ScanCancelledError(message)
        self._store.advance(task.id, ScanState.RECONSTRUCTING)
        progress.span(CAPTURE_SHARE, 1.0)
        job = Job(bundle, staged / "result", task.plan.reconstruction)
        report = self._worker.run(job, progress=progress, cancelled=task.stop.is_set, feed=feed)
        self._folder.commit(task.id)
        return report_summary(report)

    def _keep_evidence(self, task: _Task, state: ScanState) -> None:
        """Keep a complete bundle of a scan that failed, so that its cause can be found; clear away all else."""
        try:
            captured = self._store.get(task.id).state is ScanState.RECONSTRUCTING
            if captured and state is not ScanState.CANCELLED and self._folder.staging(task.id).is_dir():
                self._folder.keep_bundle(task.id)
        except Exception:  # noqa: BLE001 - see below
            # The scan's own fault is the one to tell; without its bundle it is told all the same.
            _log.exception("the bundle of a failed scan could not be kept", scan=str(task.id))
        self._folder.discard(task.id)

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
from slrig.errors import DeviceError, QueueFullError, RigBusyError, ScanCancelledError, ScanStateError
from slrig.scan.faults import UNEXPECTED, ScanFault, disk_errors, fault_of, interruption
from slrig.scan.folder import DataFolder, sync_tree
from slrig.scan.holding import HeldRig, RigFacts, check_plan
from slrig.scan.plan import ScanPlan
from slrig.scan.records import ScanProgress, ScanRecord, ScanState, report_summary
from slrig.scan.store import ScanStore
from slrig.scan.worker import Job, ReconstructionWorker

CAPTURE_SHARE = 0.5
"""The part of a scan's progress that is capture."""

_LEAST_STEP = 0.01

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
    ) -> None:
        """Play the patterns and write a complete bundle into `folder`."""
        ...


@dataclass(frozen=True, slots=True)
class RunnerStatus:
    """What the runner is at: the rig as far as it is known, who holds it and since when, and how many wait."""

    rig: str
    facts: RigFacts | None
    fault: str | None
    holder: UUID | None
    since: datetime | None
    waiting: int
    queue_length: int
    worker_warm: bool
    ending: bool


@dataclass(slots=True)
class _Task:
    id: UUID
    plan: ScanPlan
    since: datetime
    stop: threading.Event = field(default_factory=threading.Event)


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
    ) -> None:
        self._store = store
        self._folder = folder
        self._rig = rig
        self._worker = worker
        self._capture = capture
        self._queue_length = queue_length
        self._spare_bytes = spare_bytes
        self._changed = threading.Condition()
        self._waiting: deque[_Task] = deque()
        self._active: _Task | None = None
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
            elif self._active is not None and self._active.id == scan_id:
                self._active.stop.set()
        if queued is not None:
            message = "The scan was cancelled while it waited for the rig."
            self._store.finish(scan_id, ScanState.CANCELLED, fault=fault_of(ScanCancelledError(message)))
        return self._store.get(scan_id) if queued is not None else record

    def delete(self, scan_id: UUID) -> None:
        """Remove a finished scan: its record, its events, its files.

        Raises
        ------
        ScanNotFoundError
            There is no such scan.
        ScanStateError
            It is not finished.
        """
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
                worker_warm=self._worker.warm,
                ending=self._ending,
            )

    def close(self, *, timeout_s: float = 3.0) -> None:
        """Stop scanning, darken and close the rig, and record what was cut off as interrupted. Idempotent.

        A driver that does not return in `timeout_s` is left behind: its scan is recorded all the same.
        """
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
        with self._changed:
            cut_off.extend([] if self._active is None else [self._active])
        for task in cut_off:
            self._store.finish(task.id, ScanState.INTERRUPTED, fault=fault_of(interruption()))

    def _own_rig(self) -> None:
        self._rig.try_open()
        while (task := self._next()) is not None:
            try:
                self._scan(task)
            except Exception:  # noqa: BLE001 - the owner thread outlives whatever happens to one scan
                _log.exception("the end of a scan could not be recorded", scan=str(task.id))
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
        self._rig.darken()
        if state is not ScanState.SUCCEEDED:
            self._keep_evidence(task, state)
        self._worker.start()
        # The rig is free before anyone can read that the scan is over: a client may start its next one at once.
        with self._changed:
            self._active = None
        self._store.finish(task.id, state, fault=fault, summary=summary)
        log.info("scan finished", state=str(state))

    def _told(self, task: _Task, error: Exception) -> ScanFault:
        # The staging folder is gone when the message is read: what it names is then the scan's own bundle.
        fault = fault_of(error)
        return ScanFault(fault.kind, fault.message.replace(f"{self._folder.staging(task.id)}/", ""))

    def _walk(self, task: _Task) -> Mapping[str, Any]:
        progress = _Reporter(self._store, task.id, hidden=f"{self._folder.staging(task.id)}/")
        task.since = self._store.advance(task.id, ScanState.CAPTURING)
        rig = self._rig.open()
        if self._rig.facts is not None:
            self._folder.require_space(2 * check_plan(task.plan, self._rig.facts) + self._spare_bytes)
        staged = self._folder.stage(task.id)
        bundle = staged / "bundle"
        progress.span(0.0, CAPTURE_SHARE)
        try:
            self._capture(rig, task.plan, bundle, progress=progress, cancelled=task.stop.is_set)
        except Exception as error:
            kind = fault_of(error).kind
            if isinstance(error, DeviceError) or kind == UNEXPECTED:
                # Nobody knows what state the devices are in; the next scan opens them afresh.
                self._rig.let_go(error)
            raise
        self._rig.darken()
        with disk_errors(staged):
            sync_tree(bundle)
        if task.stop.is_set():
            message = "The scan was cancelled."
            raise ScanCancelledError(message)
        self._store.advance(task.id, ScanState.RECONSTRUCTING)
        progress.span(CAPTURE_SHARE, 1.0)
        job = Job(bundle, staged / "result", task.plan.reconstruction)
        report = self._worker.run(job, progress=progress, cancelled=task.stop.is_set)
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


class _Reporter:
    """Takes progress from the work and records the steps worth telling: a new stage, or a hundredth of the way."""

    def __init__(self, store: ScanStore, scan_id: UUID, *, hidden: str) -> None:
        self._hidden = hidden
        self._store = store
        self._scan_id = scan_id
        self._start, self._end = 0.0, 1.0
        self._told = ScanProgress("", -1.0, "")

    def span(self, start: float, end: float) -> None:
        """Map the fractions that follow into start..end of the whole scan."""
        self._start, self._end = start, end

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        overall = self._start + (self._end - self._start) * min(max(fraction, 0.0), 1.0)
        if stage != self._told.stage or overall - self._told.fraction >= _LEAST_STEP:
            self._told = ScanProgress(stage, overall, detail.replace(self._hidden, ""))
            self._store.progress(self._scan_id, self._told)

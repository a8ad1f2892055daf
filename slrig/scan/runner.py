"""The one that scans: one rig, one owner thread, one scan at a time, the others waiting in a short queue."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any
from uuid import UUID

import structlog

from slrig.errors import (
    CameraNotFoundError,
    DeviceBusyError,
    DeviceError,
    InvalidInputError,
    QueueFullError,
    ScanCancelledError,
    ScanStateError,
    SlrigError,
    UnsupportedByDeviceError,
)
from slrig.scan.endings import Ending, Endings
from slrig.scan.faults import UNEXPECTED, ScanFault, ScanInterruptedError, disk_errors, fault_of, interruption
from slrig.scan.folder import DataFolder, sync_tree
from slrig.scan.guarding import Call, Watchdog
from slrig.scan.holding import HeldRig, check_plan, driver_errors
from slrig.scan.plan import ScanPlan
from slrig.scan.preview import Light, Previews, Watch
from slrig.scan.records import ScanRecord, ScanState, report_summary
from slrig.scan.store import ProgressRecorder, ScanStore
from slrig.scan.work import CaptureBundle, RunnerStatus, Task, busy
from slrig.scan.worker import Job, ReconstructionWorker

CAPTURE_SHARE = 0.5
"""The part of a scan's progress that is capture."""

_log = structlog.get_logger(__name__)


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
        self._waiting: deque[Task] = deque()
        self._active: Task | None = None
        self._endings = Endings(store)
        self._previews = Previews(self._wake)
        self._ending = False
        self._owner = threading.Thread(target=self._own_rig, name="slrig-rig", daemon=True)
        self._watchdog = Watchdog(rig.calls, self._give_up_on)

    def start(self) -> None:
        """Start the owner thread, which opens the rig, and the reconstruction process, which loads its kernels."""
        self._owner.start()
        self._watchdog.start()
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
        DeviceError
            A driver hangs.
        """
        self._refuse_while_stuck()
        # Before the rig was first open nothing is known about it; the scan then fails with the same errors.
        frame_bytes = 0 if self._rig.facts is None else check_plan(plan, self._rig.facts)
        # Frames once as captured, and as much again for meshes and the zipped bundle of a careful client.
        self._folder.require_space(2 * frame_bytes + self._spare_bytes)
        with self._changed:
            if self._ending:
                raise interruption()
            holder = self._active or (self._waiting[0] if self._waiting else None)
            if holder is not None and not wait:
                raise busy(holder)
            if len(self._waiting) >= self._queue_length and holder is not None:
                message = (
                    f"The rig is held and {len(self._waiting)} scans are waiting, as many as may. Try again later."
                )
                raise QueueFullError(message)
            record = self._store.create(plan, rig=self._rig.name, label=label, key=key)
            self._waiting.append(Task(record.id, plan, record.created_at))
            self._changed.notify_all()
        self._previews.interrupt()
        return record

    def watch(self, camera: str, light: Light) -> Watch:
        """Look through a camera; pictures come while the rig is idle.

        Raises
        ------
        CameraNotFoundError
            The rig has no camera of that name.
        RigBusyError
            A scan holds the rig now.
        DeviceError
            The rig is not open, or not yet.
        """
        self._refuse_while_stuck()
        facts = self._rig.facts
        if self._rig.fault is not None:
            message = f"The rig cannot be opened: {self._rig.fault.message}"
            raise DeviceError(message)
        if facts is None:
            message = "The rig is being opened. Ask again in a moment."
            raise DeviceBusyError(message)
        if camera not in facts.cameras:
            message = f"The rig has no camera '{camera}'; it has {', '.join(facts.cameras)}."
            raise CameraNotFoundError(message)
        with self._changed:
            if self._ending:
                raise interruption()
            if self._active is not None:
                raise busy(self._active)
        return self._previews.watch(camera, light)

    def _refuse_while_stuck(self) -> None:
        call = self._rig.calls.stuck
        if call is not None:
            raise DeviceError(call.hangs())

    def cancel(self, scan_id: UUID) -> ScanRecord:
        """Ask a scan to stop. Returns at once; a scan that has finished stays as it is. Raises ScanNotFoundError."""
        record = self._store.get(scan_id)
        with self._changed:
            queued = next((task for task in self._waiting if task.id == scan_id), None)
            if queued is not None:
                self._waiting.remove(queued)
                message = "The scan was cancelled while it waited for the rig."
                self._endings.add(Ending(scan_id, ScanState.CANCELLED, fault_of(ScanCancelledError(message))))
            elif self._active is not None and self._active.id == scan_id:
                self._active.stop.set()
                return record
        self._endings.settle()
        with self._changed:
            ended = scan_id in self._endings
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
        self._endings.settle()
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
        self._watchdog.stop()
        self._previews.fail(interruption())
        self._worker.close()
        if self._owner.is_alive():
            self._owner.join(timeout_s)
        if self._owner.is_alive():
            _log.error("the rig's driver does not return; the service ends without it", rig=self._rig.name)
            self._rig.darken_from_outside()
        with self._changed:
            cut_off.extend([] if self._active is None else [self._active])
            fault = fault_of(interruption())
        for task in cut_off:
            self._endings.add(Ending(task.id, ScanState.INTERRUPTED, fault))
        self._endings.settle()

    def _give_up_on(self, call: Call) -> None:
        """End, on the watchdog's thread, what waits for a call that hangs."""
        _log.error("a driver hangs", rig=self._rig.name, device=call.device, step=call.step)
        fault = self._rig.give_up(call)
        self._rig.darken_from_outside()
        with self._changed:
            if self._active is not None:
                state = ScanState.CANCELLED if self._active.stop.is_set() else ScanState.FAILED
                self._endings.add(Ending(self._active.id, state, fault))
        self._endings.settle()
        self._previews.fail(DeviceError(fault.message))

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

    def _next(self) -> Task | None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted() or self._previews.wanted)
                if self._ending:
                    return None
                if self._waiting:
                    self._active = self._waiting.popleft()
                    return self._active
            self._show()

    def _wanted(self) -> bool:
        return self._ending or bool(self._waiting)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _show(self) -> None:
        """Take pictures for those who look, until a scan wants the rig."""
        try:
            rig = self._rig.open()
            with driver_errors(self._rig.name):
                self._previews.run(rig, stop=self._wanted)
        except Exception as error:  # noqa: BLE001 - the owner thread outlives whatever happens to a picture
            self._rig.let_go(error)
            self._log_unopened(error)
            fault = fault_of(error)
            self._previews.fail(error if isinstance(error, SlrigError) else DeviceError(fault.message))
            self._log_unopened(self._rig.recover())

    def _scan(self, task: Task) -> None:
        self._endings.settle()
        ending = Ending(task.id, ScanState.FAILED, fault_of(RuntimeError()))
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
                self._endings.add(ending)
            self._endings.settle()
        if not self._ending:
            self._log_unopened(self._rig.recover())

    def _ended(self, task: Task) -> Ending:
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
        return Ending(task.id, state, fault, summary)

    def _log_unopened(self, error: Exception | None) -> None:
        if isinstance(error, SlrigError):
            _log.warning("the rig cannot be opened; the next scan tries again", rig=self._rig.name, cause=str(error))
        elif error is not None:
            _log.error("the rig's driver failed with an error of its own", rig=self._rig.name, exc_info=error)

    def _told(self, task: Task, error: Exception) -> ScanFault:
        # The staging folder is gone when the message is read: what it names is then the scan's own bundle.
        fault = fault_of(error)
        return ScanFault(fault.kind, fault.message.replace(f"{self._folder.staging(task.id)}/", ""))

    def _walk(self, task: Task) -> Mapping[str, Any]:
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

    def _keep_evidence(self, task: Task, state: ScanState) -> None:
        """Keep the bundle of a scan that failed, if it has one, so that its cause can be found; clear away all else."""
        try:
            if state is not ScanState.CANCELLED and (self._folder.staging(task.id) / "bundle").is_dir():
                self._folder.keep_bundle(task.id)
        except Exception:  # noqa: BLE001 - see below
            # The scan's own fault is the one to tell; without its bundle it is told all the same.
            _log.exception("the bundle of a failed scan could not be kept", scan=str(task.id))
        self._folder.discard(task.id)

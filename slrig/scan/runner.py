"""The one that scans: a rig that is lent to one piece of work at a time, and the record of those that are scans."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from uuid import UUID, uuid4

import structlog

from slrig.devices import Rig
from slrig.errors import InvalidInputError, ScanStateError
from slrig.scan.endings import Endings
from slrig.scan.faults import ScanInterruptedError, fault_of
from slrig.scan.folder import DataFolder
from slrig.scan.holding import ActiveCalibration, HeldRig, check_plan
from slrig.scan.lending import Lender
from slrig.scan.plan import ScanPlan
from slrig.scan.preview import Light, Watch
from slrig.scan.records import ScanRecord, ScanState, utc_now
from slrig.scan.store import ScanStore
from slrig.scan.walking import ScanTools, ScanWalk
from slrig.scan.work import CaptureBundle, Holder, Loan, RunnerStatus, WatchesHealth
from slrig.scan.worker import Worker

_log = structlog.get_logger(__name__)


class Runner:
    """Takes scans, works them off in order, and leaves every one of them in a final state; lends the rig to other work.

    Every public method may be called from any thread.
    """

    def __init__(
        self,
        store: ScanStore,
        folder: DataFolder,
        rig: HeldRig,
        worker: Worker,
        *,
        capture: CaptureBundle,
        queue_length: int = 8,
        spare_bytes: int = 0,
        give_up: Callable[[InvalidInputError], None] = lambda _: None,
    ) -> None:
        """`give_up` is told, on the owner thread, when the first opening shows that the rig file is wrong."""
        self._store = store
        self._folder = folder
        self._worker = worker
        self._spare_bytes = spare_bytes
        self._closing = threading.Lock()
        self._closed = False
        self._lender = Lender(rig, queue_length=queue_length, give_up=give_up)
        self._endings = Endings(store)
        self._health: WatchesHealth | None = None
        self._tools = ScanTools(
            store,
            folder,
            worker,
            capture,
            self._endings,
            spare_bytes,
            ending=lambda: self._lender.ending,
            health=lambda: self._health,
        )

    def start(self) -> None:
        """Start the owner thread, which opens the rig, and the worker, which loads its kernels."""
        self._lender.start()
        self._worker.start()

    def take_up(self, scans: Iterable[UUID]) -> None:
        """Put scans in line that a kill of the service left unfinished, see `slrig.scan.sweep`; before `start`."""
        self._lender.take_up([ScanWalk(self._store.get(scan), self._tools) for scan in scans])

    def submit(self, plan: ScanPlan, *, label: str | None, wait: bool, key: str | None = None) -> ScanRecord:
        """Record a scan and have it done; `wait` lets it queue behind others.

        Raises
        ------
        PatternError, UnsupportedByDeviceError
            The rig cannot do what the plan asks for.
        CalibrationError
            The calibration in use is for other devices.
        StorageError
            There is too little room for the frames.
        RigBusyError
            The rig is held, and `wait` is False.
        QueueFullError
            As many wait as may.
        DeviceError
            A driver hangs.
        """
        self._lender.refuse_while_stuck()
        rig = self._lender.rig
        # Before the rig was first open nothing is known about it; the scan then fails with the same errors.
        frame_bytes = 0 if rig.facts is None else check_plan(plan, rig.facts, rig.calibration)
        rig.refuse_misfit()
        # Frames once as captured, and as much again for meshes and the zipped bundle of a careful client.
        self._folder.require_space(2 * frame_bytes + self._spare_bytes)
        record: ScanRecord | None = None

        def make() -> ScanWalk:
            nonlocal record
            record = self._store.create(plan, rig=rig.name, label=label, key=key)
            return ScanWalk(record, self._tools)

        self._lender.take_in(make, wait=wait)
        if record is None:
            raise TypeError(record)
        return record

    def borrow(
        self,
        work: Callable[[Rig, Callable[[], bool]], None],
        *,
        holder: Holder,
        wait: bool,
        ended: Callable[[Exception | None], None],
        begun: Callable[[UUID], None] = lambda _: None,
    ) -> UUID:
        """Have `work` done with the rig, in line with the scans, and return the number of the loan. See `Loan`.

        `begun` is told that number once a place in the line is certain, before the work can begin.

        Raises
        ------
        RigBusyError, QueueFullError, DeviceError
            As `submit` does.
        """
        self._lender.refuse_while_stuck()

        def make() -> Loan:
            loan = Loan(uuid4(), holder, utc_now(), work, ended, lambda: self._lender.ending)
            begun(loan.id)
            return loan

        return self._lender.take_in(make, wait=wait).id

    def recall(self, loan: UUID) -> None:
        """Ask work that has the rig, or waits for it, to end early. Returns at once; one that is over stays so."""
        self._lender.cancel(loan)

    def watch_health(self, health: WatchesHealth) -> None:
        """Have scans that begin from now on carry the health of their calibration, and tell what they find of it."""
        self._health = health

    def use_calibration(self, active: ActiveCalibration | None) -> None:
        """Have what is begun from now on use a calibration; None has it use the rig's own.

        Raises
        ------
        CalibrationError
            It is for other devices than those of the open rig.
        """
        rig = self._lender.rig
        fault = None if active is None else rig.misfit(active)
        # Before the rig is open nobody knows; a scan is then refused with the same words.
        if fault is not None:
            raise fault
        rig.active = active

    def watch(self, camera: str, light: Light) -> Watch:
        """Look through a camera: see `Lender.watch`."""
        return self._lender.watch(camera, light)

    def cancel(self, scan_id: UUID) -> ScanRecord:
        """Ask a scan to stop. Returns at once; a scan that has finished stays as it is. Raises ScanNotFoundError."""
        record = self._store.get(scan_id)
        if self._lender.cancel(scan_id):
            return record
        self._endings.settle()
        if scan_id not in self._endings:
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
        rig, lent = self._lender.rig, self._lender.status()
        active = rig.active
        misfit = None if active is None else rig.misfit(active)
        return RunnerStatus(
            rig=rig.name,
            facts=rig.facts,
            active=active,
            misfit=None if misfit is None else str(misfit),
            fault=None if rig.fault is None else rig.fault.message,
            holder=None if lent.holder is None else lent.holder.name,
            since=lent.since,
            waiting=lent.waiting,
            queue_length=self._lender.queue_length,
            opening=rig.calls.doing,
            reconstruction=self._worker.condition,
            preparing=self._worker.loading,
            ending=lent.ending,
        )

    def close(self, *, timeout_s: float = 3.0) -> None:
        """Stop scanning, darken and close the rig, and record what was cut off as interrupted. Idempotent.

        A driver that does not return in `timeout_s` is left behind: the projector is darkened past it, as far as it
        lets, and its scan is recorded all the same.
        """
        with self._closing:
            if not self._closed:
                self._closed = True
                self._lender.end()
                # The owner thread may be waiting for a reconstruction.
                self._worker.close()
                self._lender.join(timeout_s)
                self._endings.close()

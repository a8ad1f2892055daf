"""Scans: taken, put in the queue of the rig, and their records kept."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID, uuid4

import structlog

from slrig.errors import InvalidInputError, JobNotFoundError, ScanStateError
from slrig.jobs.compute import Compute
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Job
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import JobRecord, utc_now
from slrig.jobs.rig_jobs import RigJobs
from slrig.jobs.store import JobStore
from slrig.rig.session import ActiveCalibration, RigFacts, RigSession
from slrig.scan.job import CaptureFrames, ScanTools, WatchesHealth, scan_job
from slrig.scan.plan import ScanPlan, series_of
from slrig.scan.plan_check import check_plan
from slrig.scan.records import plan_json

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class RunnerStatus:
    """What the runner is at: the rig as far as it is known, who holds it and since when, how many wait, and whose
    frames are computed with, or wait for that, while the rig is free of them.

    `active` is the calibration that takes the place of the rig's own, `misfit` why it cannot be used. `holder` and
    those of `computing` are `Holder.name`. `opening` is what the rig's driver told last, while it is opened.
    `reconstruction` is `Compute.condition`, `preparing` whether that is on its way to ready.
    """

    rig: str
    facts: RigFacts | None
    active: ActiveCalibration | None
    misfit: str | None
    fault: str | None
    holder: str | None
    since: datetime | None
    waiting: int
    queue_length: int
    computing: tuple[str, ...]
    backlog_length: int
    opening: str
    reconstruction: str
    preparing: bool
    ending: bool


class Runner:
    """Takes scans, works them off in order, and leaves each in a final state. `queue` takes other work, too.

    Every public method may be called from any thread.
    """

    def __init__(
        self,
        store: JobStore,
        folder: DataFolder,
        rig: RigSession,
        worker: Compute,
        *,
        capture: CaptureFrames,
        queue_length: int = 8,
        backlog_length: int = 16,
        spare_bytes: int = 0,
        give_up: Callable[[InvalidInputError], None] = lambda _: None,
    ) -> None:
        """`give_up` is told, on the owner thread, when the first opening shows that the rig file is wrong."""
        self._store = store
        self._folder = folder
        self._worker = worker
        self._closing = threading.Lock()
        self._closed = False
        self.queue = JobQueue(rig, queue_length=queue_length, backlog_length=backlog_length, give_up=give_up)
        self._work = RigJobs(store, self.queue, folder)
        self._tools = ScanTools(folder, worker, capture, spare_bytes)
        self._unused: Callable[[UUID], AbstractContextManager[None]] = lambda _: nullcontext()

    def start(self) -> None:
        """Start the owner thread, which opens the rig, and the worker, which loads its kernels."""
        self.queue.start()
        self._worker.start()

    def take_up(self, scans: Iterable[UUID]) -> None:
        """Put scans in line that a kill of the service left unfinished, see `slrig.scan.sweep`; before `start`."""
        self.queue.add([scan_job(self._store.get(scan), self._tools, self._work) for scan in scans])

    def submit(
        self,
        plan: ScanPlan,
        *,
        label: str | None,
        wait: bool,
        key: str | None = None,
        repeat: int = 1,
        every_s: float = 0.0,
    ) -> JobRecord:
        """Record a scan and have it done; `wait` lets it queue behind others. repeat : so many scans, one every
        `every_s`; the first one's record is returned.

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
        self._require_possible(plan)

        def records() -> list[JobRecord]:
            if repeat == 1:
                return [self._store.create(plan_json(plan), rig=self.queue.rig.name, label=label, key=key)]
            series = uuid4()
            plans = series_of(plan, series, count=repeat, every_s=every_s, begins_at=utc_now())
            return self._recorded(plans, label=label, parent=series, key=key)

        return self._submit(records, wait=wait)[0]

    def submit_views(
        self,
        plans: Sequence[ScanPlan],
        parent: UUID,
        *,
        label: str | None,
        wait: bool,
        key: str | None = None,
        begun: Callable[[], object] = lambda: None,
    ) -> None:
        """Record scans of one parent and have them done in their order; `wait` lets the first queue behind others.

        begun : puts the parent on record, once a place in the line is certain. Raises as `submit`.
        """
        for plan in plans:
            self._require_possible(plan, count=len(plans))

        def records() -> list[JobRecord]:
            begun()
            return self._recorded(plans, label=label, parent=parent, key=key)

        self._submit(records, wait=wait)

    def add_views(self, plans: Sequence[ScanPlan], parent: UUID, *, label: str | None) -> None:
        """Have further scans of a parent done, however many wait: nobody is there to hear a refusal."""
        records = self._recorded(plans, label=label, parent=parent)
        self.queue.add([scan_job(record, self._tools, self._work) for record in records])

    def _require_possible(self, plan: ScanPlan, *, count: int = 1) -> None:
        """Raise what `submit` raises of a rig that cannot, or a disk without room for so many."""
        rig = self.queue.rig
        # Before the rig was first open nothing is known about it; the scan then fails with the same errors.
        frame_bytes = 0 if rig.facts is None else check_plan(plan, rig.facts, rig.calibration)
        rig.refuse_misfit()
        # Frames once as captured, and as much again for meshes and the zipped bundle of a careful client.
        self._folder.require_space(2 * count * frame_bytes + self._tools.spare_bytes)

    def _submit(self, make: Callable[[], list[JobRecord]], *, wait: bool) -> list[JobRecord]:
        """Have the scans done that `make` puts on record."""
        records: list[JobRecord] = []

        def jobs() -> list[Job]:
            records.extend(make())
            return [scan_job(record, self._tools, self._work) for record in records]

        self.queue.submit(jobs, wait=wait)
        return records

    def _recorded(
        self, plans: Sequence[ScanPlan], *, label: str | None, parent: UUID, key: str | None = None
    ) -> list[JobRecord]:
        rig, documents = self.queue.rig.name, [plan_json(each) for each in plans]
        return self._store.create_series(documents, rig=rig, label=label, parent=parent, key=key)

    def cancel_series(self, series: UUID) -> list[JobRecord]:
        """Ask all scans of a series to stop, as `cancel` does. Raises JobNotFoundError: there is none of that id."""
        scans = self.series(series)
        # The last first: no other one begins meanwhile.
        return [self.cancel(scan.id) for scan in reversed(scans)][::-1]

    def series(self, series: UUID) -> list[JobRecord]:
        """Return the scans of a series that are on record, in their order. Raises JobNotFoundError: there are none."""
        scans = self._store.of(series).get(series)
        if not scans:
            message = f"No series {series} is on record here. GET /scan lists scans, and the series of each."
            raise JobNotFoundError(message)
        return scans

    def watch_health(self, health: WatchesHealth) -> None:
        """Have scans that begin from now on carry the health of their calibration, and tell what they find of it."""
        self._tools.health = health

    def spare_what_is_used(self, unused: Callable[[UUID], AbstractContextManager[None]]) -> None:
        """Have scans deleted only within what `unused` gives of each: it raises ScanStateError for one that is used."""
        self._unused = unused

    def use_calibration(self, active: ActiveCalibration | None) -> None:
        """Have what is begun from now on use a calibration; None has it use the rig's own.

        Raises
        ------
        CalibrationError
            It is for other devices than those of the open rig.
        """
        rig = self.queue.rig
        fault = None if active is None else rig.misfit(active)
        # Before the rig is open nobody knows; a scan is then refused with the same words.
        if fault is not None:
            raise fault
        rig.active = active

    def cancel(self, scan_id: UUID) -> JobRecord:
        """Ask a scan to stop. Returns at once; a scan that has finished stays as it is. Raises JobNotFoundError."""
        self._work.cancel(scan_id)
        return self._store.get(scan_id)

    def delete(self, scan_id: UUID) -> None:
        """Remove a finished scan: its record, its events, its files.

        Raises
        ------
        JobNotFoundError
            There is no such scan.
        ScanStateError
            It is not finished, or something that is under way uses it.
        """
        self._work.endings.settle()
        record = self._store.get(scan_id)
        if not record.state.final:
            message = (
                f"Scan {scan_id} is {record.state}. Cancel it first (POST /scan/{scan_id}/cancel), then delete it."
            )
            raise ScanStateError(message)
        with self._unused(scan_id):
            self._folder.discard(scan_id)
            self._folder.withdraw(scan_id)
            self._store.delete(scan_id)
        self._folder.discard(scan_id)
        _log.info("scan deleted", scan=str(scan_id))

    def status(self) -> RunnerStatus:
        """Return what the runner is at. Touches no device."""
        rig, held = self.queue.rig, self.queue.status()
        active = rig.active
        misfit = None if active is None else rig.misfit(active)
        return RunnerStatus(
            rig=rig.name,
            facts=rig.facts,
            active=active,
            misfit=None if misfit is None else str(misfit),
            fault=None if rig.fault is None else rig.fault.message,
            holder=None if held.holder is None else held.holder.name,
            since=held.since,
            waiting=held.waiting,
            queue_length=self.queue.queue_length,
            computing=tuple(each.name for each in held.computing),
            backlog_length=self.queue.backlog_length,
            opening=rig.calls.doing,
            reconstruction=self._worker.condition,
            preparing=self._worker.loading,
            ending=held.ending,
        )

    def close(self, *, timeout_s: float = 3.0) -> None:
        """Stop scanning, darken and close the rig, and record what was cut off as interrupted. Idempotent.

        A driver that does not return in `timeout_s` is left behind: the projector is made dark from another thread, as
        far as the driver lets, and its scan is recorded all the same.
        """
        with self._closing:
            if not self._closed:
                self._closed = True
                self.queue.end()
                # What computes waits for it.
                self._worker.close()
                self.queue.join(timeout_s)
                self._work.close()

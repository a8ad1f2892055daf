"""Calibration sessions: opened, shot, solved, activated; imported, exported and compared. No HTTP in here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol
from uuid import UUID, uuid4

import structlog

from slrig.bundle.calibration_file import write_calibration
from slrig.bundle.opencv_calibration import write_opencv_calibration
from slrig.bundle.storage import write_durably
from slrig.calibrate.pose_answering import PoseAnswers, setting_of
from slrig.calibrate.pose_shooting import PoseDesk
from slrig.calibrate.records import USUAL_PATTERNS, SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.solves import SolveDesk
from slrig.calibrate.store import CALIBRATION, ActivePointer, CalibrationStore
from slrig.calibrate.sweep import sweep_calibrations
from slrig.calibrate.tools import CalibrationTools, sizes_of
from slrig.calibration.board import Board
from slrig.calibration.judging.comparison import Comparison
from slrig.errors import ArtefactNotReadyError, CalibrationError, CalibrationStateError, CameraNotFoundError
from slrig.failure import disk_errors
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.records import Clock, utc_now
from slrig.jobs.rig_jobs import RigJobs
from slrig.jobs.store import JobStore
from slrig.model import Calibration
from slrig.rig.session import ActiveCalibration
from slrig.scan.plan import PatternPlan
from slrig.scan.runner import RigAccess

EXPORTS = ("calibration.json", "calibration.yml", "calibration.xml")
"""The forms in which a calibration can be had, and taken in."""

_log = structlog.get_logger(__name__)


class CalibratedRig(RigAccess, Protocol):
    """`slrig.scan.runner.Runner`: does work with the rig, and takes a calibration for what is begun from now on."""

    def use_calibration(self, active: ActiveCalibration | None) -> None:
        """Scan with it; None scans with the rig's own. Raises CalibrationError if it is for other devices."""
        ...


class Calibrations:
    """The calibrations of a data folder, and the work on them. Any thread may call; `close` at the end.

    jobs : those of poses and solves. `poses` shoots, `solves` solves, `register` has the records.

    Raises
    ------
    StorageError
        The folder cannot be read, or the active calibration is gone.
    """

    def __init__(
        self,
        folder: DataFolder,
        rig: CalibratedRig,
        jobs: JobStore,
        *,
        rig_name: str,
        tools: CalibrationTools,
        clock: Clock = utc_now,
        spare_bytes: int = 0,
    ) -> None:
        self.store = CalibrationStore(folder)
        self.register = CalibrationRegister(self.store, jobs)
        self._work = RigJobs(jobs, rig, folder)
        self._rig = rig
        self._rig_name = rig_name
        self._clock = clock
        self._tools = tools
        self.answers = PoseAnswers(self.register, self._tools)
        self.poses = PoseDesk(
            self.register, folder, rig, self._work, self._tools, self.answers, clock=clock, spare_bytes=spare_bytes
        )
        self.solves = SolveDesk(self.register, self._work, self._tools, self.answers, clock=clock, earlier=self._in_use)
        found = self.store.active_calibration()
        if found is not None:
            pointer, calibration = found
            rig.use_calibration(ActiveCalibration(str(pointer.id), calibration))

    def take_up(self) -> None:
        """Go on with what the last run of the service left: see `sweep_calibrations`."""
        sweep_calibrations(self.register, self.poses, self.solves)

    def open(self, board: Board, *, label: str | None = None, patterns: PatternPlan = USUAL_PATTERNS) -> SessionRecord:
        """Open a session for a board. Touches no device. Raises StorageError."""
        with self.register.lock:
            record = SessionRecord(
                self.register.next_number(), uuid4(), self._clock(), self._rig_name, label, board, patterns
            )
            self.register.add(record)
        self.answers.warm()
        return record

    def submit(self, text: bytes, ending: str, *, label: str | None = None) -> SessionRecord:
        """Make a calibration of a file's text: ours, or OpenCV's. `ending` is that of one of `EXPORTS`.

        Raises
        ------
        CalibrationError
            The text is no calibration.
        StorageError
            The disk refused.
        """
        session_id = uuid4()
        staged = self.store.stage_solve(session_id)
        source = staged / f"imported{ending}"
        try:
            with disk_errors(staged):
                write_durably(source, text)
            try:
                calibration = self._tools.parse(source)
            except CalibrationError as error:
                message = str(error).replace(str(source), "the calibration sent")
                raise CalibrationError(message) from error
            source.unlink()
            write_calibration(staged / CALIBRATION, calibration)
            projector = None if calibration.projector is None else calibration.projector.size
            with self.register.lock:
                record = SessionRecord(
                    self.register.next_number(),
                    session_id,
                    self._clock(),
                    self._rig_name,
                    label,
                    cameras={name: device.size for name, device in calibration.cameras.items()},
                    projector=projector,
                    state=SessionState.SOLVED,
                    solve=1,
                )
                self.register.add(replace(record, state=SessionState.OPEN, solve=0))
                try:
                    self.store.commit_solve(session_id, 1, staged)
                    self.register.change(session_id, lambda _: record)
                except BaseException:
                    self.register.remove(session_id)
                    raise
                return record
        finally:
            self.store.discard(staged)

    def activate(self, session_id: UUID) -> SessionRecord:
        """Scan with what this session's last solve gave, from the next scan on, and after a restart.

        Raises
        ------
        CalibrationNotFoundError, CalibrationStateError
            There is no such calibration, or it was never solved.
        CalibrationError
            It is for other devices than the rig has.
        StorageError
            The disk refused.
        """
        with self.register.lock:
            record = self.register.get(session_id)
            calibration = self._calibration(record)
            self._rig.use_calibration(ActiveCalibration(str(session_id), calibration))
            try:
                self.store.activate(ActivePointer(session_id, record.solve))
            except BaseException:
                found = self.store.active_calibration()
                self._rig.use_calibration(None if found is None else ActiveCalibration(str(found[0].id), found[1]))
                raise
        _log.info("calibration activated", calibration=str(session_id), solve=record.solve)
        return record

    def deactivate(self, session_id: UUID) -> SessionRecord:
        """Scan with the rig's own calibration again. Raises CalibrationStateError if this one is not in use."""
        with self.register.lock:
            record = self.register.get(session_id)
            if self.active != session_id:
                message = f"Calibration {session_id} is not in use."
                raise CalibrationStateError(message)
            self.store.activate(None)
            self._rig.use_calibration(None)
        return record

    @property
    def active(self) -> UUID | None:
        """The calibration in use; None where it is the rig's own."""
        pointer = self.store.active()
        return None if pointer is None else pointer.id

    def delete(self, session_id: UUID) -> None:
        """Remove a calibration with all its poses.

        Raises
        ------
        CalibrationNotFoundError
            There is no such calibration.
        CalibrationStateError
            It is in use, or something is under way in it.
        """
        with self.register.lock:
            record = self.register.get(session_id)
            if self.active == session_id:
                message = (
                    f"Calibration {session_id} is in use. Activate another one, or go back to the rig's own with "
                    f"POST /calibration/{session_id}/deactivate, then delete it."
                )
                raise CalibrationStateError(message)
            if record.under_way:
                message = f"Something is under way in calibration {session_id}. Wait for it, then delete it."
                raise CalibrationStateError(message)
            self.register.remove(session_id)
        _log.info("calibration deleted", calibration=str(session_id))

    def calibration(self, session_id: UUID) -> Calibration:
        """Return what the last solve gave. Raises CalibrationNotFoundError, CalibrationStateError, CalibrationError."""
        return self._calibration(self.register.get(session_id))

    def file(self, session_id: UUID, name: str) -> Path:
        """Return where a file of the last solve lies. Raises CalibrationNotFoundError, ArtefactNotReadyError."""
        record = self.register.get(session_id)
        path = self.store.solve(session_id, record.solve) / name
        if not record.solve or not path.is_file():
            what = "was imported, and" if record.board is None else "has no solve yet that went well, and"
            message = f"Calibration {session_id} {what} has no {name}."
            raise ArtefactNotReadyError(message)
        return path

    def exported(self, session_id: UUID, name: str) -> bytes:
        """Return a calibration as one of `EXPORTS`. Raises as `calibration` does."""
        calibration = self.calibration(session_id)
        staged = self.store.stage_solve(session_id)
        try:
            write = write_calibration if name.endswith(".json") else write_opencv_calibration
            write(staged / name, calibration)
            with disk_errors(staged):
                return (staged / name).read_bytes()
        finally:
            self.store.discard(staged)

    def coverage_picture(self, session_id: UUID, device: str | None) -> bytes:
        """Return a PNG of what a device has seen of the board so far; None means the first camera.

        Raises
        ------
        CalibrationNotFoundError, ArtefactNotReadyError
            There is no such session, or it has no pose yet.
        CameraNotFoundError
            It has no such device.
        """
        record = self.register.get(session_id)
        if not record.cameras or record.board is None:
            message = f"Calibration {session_id} has no pose yet, and nothing is covered."
            raise ArtefactNotReadyError(message)
        setting = setting_of(record)
        names = list(sizes_of(setting))
        chosen = names[0] if device is None else device
        if chosen not in names:
            message = f"Calibration {session_id} has no device '{chosen}'; it has {', '.join(names)}."
            raise CameraNotFoundError(message)
        return self._tools.coverage_picture(setting, chosen, self.answers.readings(record), record.next_move or {})

    def compare(self, first: UUID, second: UUID) -> Comparison:
        """Return what the second says otherwise than the first. Raises as `calibration` does."""
        return self._tools.compare(self.calibration(first), self.calibration(second))

    def latest(self) -> Sequence[SessionRecord]:
        """Return all calibrations, newest first."""
        return self.register.all()

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent; after the rig's runner has been closed."""
        self._work.close()

    def _calibration(self, record: SessionRecord) -> Calibration:
        if not record.solve:
            message = (
                f"Calibration {record.id} is {record.state} and was not solved yet. Solve it first "
                f"(POST /calibration/{record.id}/solve)."
            )
            raise CalibrationStateError(message)
        return self.store.calibration(record.id, record.solve)

    def _in_use(self) -> Calibration | None:
        found = self.store.active_calibration()
        return None if found is None else found[1]

"""Calibration sessions: opened, shot, solved, activated; imported, exported and compared. No HTTP in here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from uuid import UUID, uuid4

import structlog

from slrig.bundle import write_calibration, write_durably, write_opencv_calibration
from slrig.calibrate.pose_shooting import PoseDesk, outcome_of
from slrig.calibrate.records import USUAL_PATTERNS, SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.solves import SolveDesk
from slrig.calibrate.store import CALIBRATION, READING, ActivePointer, CalibrationStore
from slrig.calibrate.tools import CalibrationTools, setting_of
from slrig.calibration import Board
from slrig.calibration.accuracy import Comparison
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    CalibrationStateError,
    CameraNotFoundError,
    StorageError,
)
from slrig.failure import disk_errors, job_failure
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.jobs.rig_jobs import RigJobs
from slrig.jobs.store import JobStore
from slrig.model import Calibration
from slrig.rig.session import ActiveCalibration
from slrig.scan.plan import PatternPlan
from slrig.scan.runner import Runner

EXPORTS = ("calibration.json", "calibration.yml", "calibration.xml")
"""The forms in which a calibration can be had, and taken in."""

_log = structlog.get_logger(__name__)


class CalibrationSessions:
    """The calibrations of a data folder, and the work on them. Any thread may call; `close` at the end.

    jobs : those of poses and solves. `poses` shoots, `solves` solves, `register` has the records.

    Raises StorageError if the folder cannot be read, or the active calibration is gone.
    """

    def __init__(
        self,
        folder: DataFolder,
        runner: Runner,
        jobs: JobStore,
        *,
        rig_name: str,
        tools: CalibrationTools,
        spare_bytes: int = 0,
        tolerance_mm: float | None = None,
    ) -> None:
        self._data = folder
        self.store = CalibrationStore(folder)
        self.register = CalibrationRegister(self.store, jobs)
        self._work = RigJobs(jobs, runner.queue, folder)
        self._runner = runner
        self._rig_name = rig_name
        self._tools = tools
        self.poses = PoseDesk(self.register, folder, self._work, tools, spare_bytes)
        self.solves = SolveDesk(self.register, self._work, tools, tolerance_mm, self._of_the_rig)
        runner.use_calibration(self.store.active_calibration())

    def _of_the_rig(self) -> Calibration | None:
        facts = self._runner.queue.rig.facts
        return None if facts is None else facts.calibration

    def take_up(self) -> None:
        """Settle what the last run of the service left open, or have it go on. Before the rig is used.

        - A pose that waited is shot; one whose frames are there is read; one that has its answer gets it; one that had
          the rig, and a solve, was interrupted. See `PoseDesk.take_up`, `SolveDesk.take_up`.
        - A pose that was accepted and has no files is recorded as failed.
        - A pose in its place without a record, as beside a database that was lost, is on record again, as it says
          itself.
        - Jobs of a calibration that is gone are forgotten.
        """
        records = self.register.all()
        by_session = self.register.jobs.of()
        for session_id in by_session.keys() - {record.id for record in records}:
            self.register.jobs.delete_of(session_id)
        for record in records:
            jobs = by_session.get(record.id, [])
            for job in jobs:
                if job.kind is JobKind.POSE:
                    self._settle_pose(record.id, job)
                elif not job.state.final:
                    self.solves.take_up(record.id, job)
            known = {job.plan["number"] for job in jobs if job.kind is JobKind.POSE}
            for number in self.store.pose_numbers(record.id):
                if number not in known:
                    self._restore_pose(record, number)

    def _settle_pose(self, session_id: UUID, job: JobRecord) -> None:
        number = job.plan["number"]
        place, answer = self.store.pose(session_id, number), self.store.answer(session_id, number)
        if job.state.final:
            if job.state is JobState.SUCCEEDED and not (place / READING).is_file():
                message = f"The files of pose {number} are gone from {place}. Shoot it again."
                self.register.jobs.lose_files(job.id, job_failure(StorageError(message)))
        elif answer is None:
            self.poses.take_up(session_id, job)
        else:
            outcome = outcome_of(answer)
            state = JobState.SUCCEEDED if outcome.fault is None else JobState.FAILED
            self.register.jobs.finish(job.id, state, fault=outcome.fault, summary=outcome.summary)

    def _restore_pose(self, record: SessionRecord, number: int) -> None:
        """Put a pose on record again, or remove what is none."""
        answer = self.store.answer(record.id, number)
        if answer is None:
            self.store.discard_pose(record.id, number)
            return
        outcome = outcome_of(answer)
        self.register.jobs.restore(
            uuid4(),
            answer["pose"],
            outcome.summary or {},
            rig=record.rig,
            label=None,
            created_at=record.created_at,
            started_at=record.created_at,
            fault=outcome.fault,
            parent=record.id,
        )
        _log.warning("left by the last run", calibration=str(record.id), pose=number, found="recovered")

    def open(self, board: Board, *, label: str | None = None, patterns: PatternPlan = USUAL_PATTERNS) -> SessionRecord:
        """Open a session for a board. Touches no device. Raises StorageError."""
        record = self.register.add(uuid4(), self._rig_name, label, board=board, patterns=patterns)
        self.poses.warm()
        return record

    def submit(self, text: bytes, ending: str, *, label: str | None = None) -> SessionRecord:
        """Make a calibration of a file's text: ours, or OpenCV's. `ending` is that of one of `EXPORTS`.

        Raises CalibrationError if the text is no calibration, StorageError if the disk refused.
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
            cameras = {name: device.size for name, device in calibration.cameras.items()}
            projector = None if calibration.projector is None else calibration.projector.size
            with self.register.lock:
                self.register.add(session_id, self._rig_name, label, cameras=cameras, projector=projector)
                try:
                    self.store.commit_solve(session_id, 1, staged)
                    self.register.change(session_id, state=SessionState.SOLVED, solve=1)
                except BaseException:
                    self.register.remove(session_id)
                    raise
                return self.register.get(session_id)
        finally:
            self.store.discard(staged)

    def activate(self, session_id: UUID) -> SessionRecord:
        """Scan with what this session's last solve gave, from the next scan on, and after a restart.

        Raises as `calibration` does, CalibrationError also if it is for other devices than the rig has, and
        StorageError.
        """
        with self.register.lock:
            record = self.register.get(session_id)
            self._runner.use_calibration(ActiveCalibration(str(session_id), self.calibration(session_id)))
            try:
                self.store.activate(ActivePointer(session_id, record.solve))
            except BaseException:
                self._runner.use_calibration(self.store.active_calibration())
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
            self._runner.use_calibration(None)
        return record

    @property
    def active(self) -> UUID | None:
        """The calibration in use; None where it is the rig's own."""
        pointer = self.store.active()
        return None if pointer is None else pointer.id

    def delete(self, session_id: UUID) -> None:
        """Remove a calibration with all its poses.

        Raises CalibrationNotFoundError, and CalibrationStateError if it is in use or something is under way in it.
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
        """Return what the last solve gave.

        Raises CalibrationNotFoundError, CalibrationStateError if it was never solved, CalibrationError if it cannot be
        read.
        """
        record = self.register.get(session_id)
        if not record.solve:
            message = (
                f"Calibration {record.id} is {record.state} and was not solved yet. Solve it first "
                f"(POST /calibration/{record.id}/solve)."
            )
            raise CalibrationStateError(message)
        return self.store.calibration(record.id, record.solve)

    def file(self, session_id: UUID, name: str) -> Path:
        """Return where a file of the last solve lies. Raises CalibrationNotFoundError, ArtefactNotReadyError."""
        record = self.register.get(session_id)
        path = self.store.solve(session_id, record.solve) / name
        if not record.solve or not self._data.owns(path):
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

        Raises CalibrationNotFoundError, ArtefactNotReadyError if it has no pose yet, and CameraNotFoundError if it has
        no such device.
        """
        record = self.register.get(session_id)
        if not record.cameras or record.board is None:
            message = f"Calibration {session_id} has no pose yet, and nothing is covered."
            raise ArtefactNotReadyError(message)
        setting = setting_of(record)
        names = list(setting.sizes)
        chosen = names[0] if device is None else device
        if chosen not in names:
            message = f"Calibration {session_id} has no device '{chosen}'; it has {', '.join(names)}."
            raise CameraNotFoundError(message)
        return self._tools.coverage_picture(setting, chosen, self.store.readings(record), record.next_move or {})

    def compare(self, first: UUID, second: UUID) -> Comparison:
        """Return what the second says otherwise than the first. Raises as `calibration` does."""
        return self._tools.compare(self.calibration(first), self.calibration(second))

    def latest(self) -> Sequence[SessionRecord]:
        """Return all calibrations, newest first."""
        return self.register.all()

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent; after the rig's runner has been closed."""
        self._work.close()

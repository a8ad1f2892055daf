"""Poses of a session, answered: read and judged as soon as the rig is free, each with its figures or its cause."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace
from uuid import UUID

import structlog

from slrig.bundle.storage import write_durably
from slrig.calibrate.pose_file import read_reading, reading_bytes
from slrig.calibrate.records import PoseState, SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.solving import ReadPose
from slrig.calibrate.store import ANSWER, BUNDLE, READING, pose_interruption
from slrig.calibrate.tools import CalibrationTools, Judgement, Setting
from slrig.calibration.board import Board
from slrig.errors import CalibrationStateError, PoseRefusedError, ScanCancelledError, ScanInterruptedError, SlrigError
from slrig.failure import JobFailure, disk_errors, failure_of

_log = structlog.get_logger(__name__)


class PoseAnswers:
    """Reads poses, one at a time, and tells what was found. Any thread may call."""

    def __init__(self, register: CalibrationRegister, tools: CalibrationTools) -> None:
        self._register = register
        self._store = register.store
        self._tools = tools
        self._reading = threading.Lock()

    def warm(self) -> None:
        """Load, on a thread of its own, what reading a pose needs."""
        threading.Thread(target=self._warm, name="slrig-warm", daemon=True).start()

    def _warm(self) -> None:
        try:
            self._tools.warm()
        except Exception:  # noqa: BLE001 - the first pose will tell
            _log.exception("what reads poses cannot be loaded")

    def readings(self, record: SessionRecord) -> list[ReadPose]:
        """What was read of the accepted poses. Raises StorageError."""
        return [read_reading(self._store.pose(record.id, pose.number) / READING) for pose in record.accepted]

    def end(self, session_id: UUID, number: int, error: Exception) -> None:
        """Put on record that a pose came to nothing, and why."""
        state, fault = PoseState.FAILED, failure_of(error)
        if isinstance(error, ScanInterruptedError):
            fault = pose_interruption()
        elif isinstance(error, ScanCancelledError):
            message = "The pose was cancelled."
            state, fault = PoseState.CANCELLED, JobFailure(fault.code, message)
        _log.warning("pose not shot", calibration=str(session_id), pose=number, code=fault.code, cause=fault.message)
        hidden = f"{self._store.staged_pose(session_id, number)}/"
        fault = replace(fault, message=fault.message.replace(hidden, ""))

        def ended(found: SessionRecord) -> SessionRecord:
            pose = next(each for each in found.poses if each.number == number)
            return replace(found.with_pose(replace(pose, state=state, fault=fault)), script=(), progress=None)

        self._register.change(session_id, ended, must_last=False)

    def read(self, session_id: UUID, number: int, since_s: float) -> None:
        """Read a pose whose frames lie in staging, and answer it. `since_s` : when the last frame came, monotonic."""
        try:
            with self._reading:
                self._answer(session_id, number, since_s)
        except Exception as error:  # noqa: BLE001 - whatever goes wrong, the pose gets its end
            if not isinstance(error, SlrigError):
                _log.exception("a pose could not be read", calibration=str(session_id), pose=number)
            self._store.discard_pose(session_id, number)
            self.end(session_id, number, error)

    def _answer(self, session_id: UUID, number: int, since_s: float) -> None:
        record, pose = self._register.get(session_id), self._register.pose(session_id, number)
        setting = setting_of(record)
        staged = self._store.staged_pose(session_id, number)
        reading: ReadPose | None = None
        try:
            reading = self._tools.read(staged / BUNDLE, setting.board, pose.name)
            judged = self._tools.judge(reading, self.readings(record), setting)
        except PoseRefusedError as error:
            # The number is told beside it; and the person shot it just now.
            judged = Judgement((str(error).removeprefix(f"pose '{pose.name}': "),), {}, None)
        with disk_errors(staged):
            write_durably(staged / ANSWER, _text(judged))
            for camera in setting.cameras:
                picture = self._tools.picture(staged / BUNDLE, camera, reading, setting.board)
                write_durably(staged / picture_name(camera), picture)
            if reading is not None and not judged.refusals:
                write_durably(staged / READING, reading_bytes(reading))
        self._store.commit_pose(session_id, number)
        fault = JobFailure(PoseRefusedError.code, " ".join(judged.refusals)) if judged.refusals else None
        state = PoseState.ACCEPTED if fault is None else PoseState.REFUSED
        seconds = round(time.monotonic() - since_s, 3)

        def answered(found: SessionRecord) -> SessionRecord:
            before = next(each for each in found.poses if each.number == number)
            after = found.with_pose(replace(before, state=state, answer=judged.answer, fault=fault, seconds=seconds))
            if judged.standing is not None:
                after = replace(after, coverage=judged.standing.coverage, next_move=judged.standing.next_move)
            if not after.under_way:
                after = replace(after, progress=None)
            return opened(after) if state is PoseState.ACCEPTED else after

        self._register.change(session_id, answered, must_last=False)
        _log.info("pose read", calibration=str(session_id), pose=number, state=str(state), seconds=seconds)

    def survey(self, session_id: UUID) -> None:
        """Bring coverage and advice up to date; they are a help, and nothing fails for want of them."""
        try:
            record = self._register.get(session_id)
            if record.board is None or not record.cameras:
                return
            standing = self._tools.survey(self.readings(record), setting_of(record))
            self._register.change(
                session_id,
                lambda found: replace(found, coverage=standing.coverage, next_move=standing.next_move),
                must_last=False,
            )
        except Exception:  # noqa: BLE001 - see above
            _log.exception("coverage could not be told", calibration=str(session_id))


def setting_of(record: SessionRecord) -> Setting:
    """The board and the devices of a session that has shot a pose."""
    return Setting(board_of(record), record.cameras, record.projector)


def picture_name(camera: str) -> str:
    """The file of a pose's picture in one camera."""
    return f"picture-{camera}.png"


def board_of(record: SessionRecord) -> Board:
    """The board of a session. Raises CalibrationStateError for an imported calibration, which has none."""
    if record.board is None:
        message = f"Calibration {record.id} was imported and has no board. Open a new one to shoot poses."
        raise CalibrationStateError(message)
    return record.board


def opened(record: SessionRecord) -> SessionRecord:
    """The record with a solve that does not hold all its poses any more opened again. The earlier result stays."""
    return replace(record, state=SessionState.OPEN, fault=None)


def _text(judged: Judgement) -> bytes:
    document = {"refused": list(judged.refusals), **judged.answer}
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()

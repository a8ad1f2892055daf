"""Poses of a session, answered: read and judged as soon as the rig is free, each with its figures or its cause."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID

import structlog

from slrig.bundle.storage import write_durably
from slrig.calibrate.pose_file import read_reading, reading_bytes
from slrig.calibrate.records import PoseRecord, SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.solving import ReadPose
from slrig.calibrate.store import ANSWER, BUNDLE, READING
from slrig.calibrate.tools import CalibrationTools, Judgement, Setting
from slrig.calibration.board import Board
from slrig.errors import CalibrationStateError, PoseRefusedError
from slrig.failure import JobFailure, disk_errors
from slrig.jobs.rig_jobs import Outcome

_log = structlog.get_logger(__name__)


class PoseAnswers:
    """Reads poses, and tells what was found. Any thread may call."""

    def __init__(self, register: CalibrationRegister, tools: CalibrationTools) -> None:
        self._register = register
        self._store = register.store
        self._tools = tools

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

    def read(self, session_id: UUID, pose: PoseRecord, staged: Path, since_s: float) -> Outcome:
        """Read a pose whose frames lie in `staged`, put it in its place, and return what was found.

        since_s : when the last frame came, on the monotonic clock.
        """
        record = self._register.get(session_id)
        setting = setting_of(record)
        reading: ReadPose | None = None
        try:
            reading = self._tools.read(staged / BUNDLE, setting.board, pose.name)
            judged = self._tools.judge(reading, self.readings(record), setting)
        except PoseRefusedError as error:
            # The number is told beside it; and the person shot it just now.
            judged = Judgement((str(error).removeprefix(f"pose '{pose.name}': "),), {}, None)
        document = {"pose": pose.plan, "refused": list(judged.refusals), "answer": judged.answer}
        with disk_errors(staged):
            write_durably(staged / ANSWER, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
            for camera in setting.cameras:
                picture = self._tools.picture(staged / BUNDLE, camera, reading, setting.board)
                write_durably(staged / picture_name(camera), picture)
            if reading is not None and not judged.refusals:
                write_durably(staged / READING, reading_bytes(reading))
        self._store.commit_pose(session_id, pose.number, staged)
        self._note(session_id, judged)
        seconds = round(time.monotonic() - since_s, 3)
        refused = bool(judged.refusals)
        _log.info("pose read", calibration=str(session_id), pose=pose.number, refused=refused, seconds=seconds)
        return outcome_of(document, seconds=seconds)

    def _note(self, session_id: UUID, judged: Judgement) -> None:
        """Put down where the session stands with a pose; it is solved no more where the pose was accepted."""
        standing = judged.standing

        def noted(found: SessionRecord) -> SessionRecord:
            if standing is not None:
                found = replace(found, coverage=standing.coverage, next_move=standing.next_move)
            return found if judged.refusals else opened(found)

        self._register.change(session_id, noted, must_last=False)

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
    return replace(record, state=SessionState.OPEN)


def outcome_of(answer: Mapping[str, Any], *, seconds: float | None = None) -> Outcome:
    """What the job of a pose came to, by what the pose's folder says."""
    refusals = answer["refused"]
    fault = JobFailure(PoseRefusedError.code, " ".join(refusals)) if refusals else None
    return Outcome({"answer": answer["answer"], "seconds": seconds}, fault)

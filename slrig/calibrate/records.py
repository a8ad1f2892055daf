"""What is on record about a calibration session and its poses: frozen values, and their JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_jsonable_python

from slrig.calibration import PROJECTOR, Board
from slrig.errors import CalibrationStateError, InvalidInputError, PoseRefusedError, StorageError
from slrig.failure import JobFailure
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState
from slrig.model import SequenceName, Size
from slrig.scan.plan import PatternPlan

USUAL_PATTERNS = PatternPlan(sequence=SequenceName.ROBUST, rows=True)
"""White, Gray code and line shift along both axes: the projector has columns and rows to be calibrated."""


class SessionState(StrEnum):
    """Where a session stands. Another pose opens a solved or failed one again."""

    OPEN = "open"
    SOLVING = "solving"
    SOLVED = "solved"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class PoseRecord:
    """One pose, as its job says. `number` counts from 1 within the session and is never given twice.

    state : one that is accepted has succeeded. position : index of the pose that the positioner was asked for, None
    where a person holds the board. answer : what was found of it, as JSON values, see `slrig.calibrate.pose_judging`;
    None until read. fault : why it was refused or failed. seconds : from the last frame to the answer.
    """

    number: int
    id: UUID
    state: JobState
    created_at: datetime
    position: int | None = None
    position_name: str | None = None
    exposure_s: float | None = None
    answer: Mapping[str, Any] | None = None
    fault: JobFailure | None = None
    seconds: float | None = None

    @property
    def name(self) -> str:
        """As a person calls it, and as the solve names it.

        >>> PoseRecord(3, UUID(int=0), JobState.QUEUED, datetime(2026, 11, 22)).name
        'pose 3'
        """
        return f"pose {self.number}"

    @property
    def accepted(self) -> bool:
        """Whether a solve takes it."""
        return self.state is JobState.SUCCEEDED

    @property
    def refused(self) -> bool:
        """Whether its frames show no pose that a solve could take."""
        return self.fault is not None and self.fault.code == PoseRefusedError.code


def pose_of(job: JobRecord) -> PoseRecord:
    """The pose that a job is."""
    found = job.summary or {}
    return PoseRecord(
        id=job.id,
        state=job.state,
        created_at=job.created_at,
        answer=found.get("answer"),
        fault=job.fault,
        seconds=found.get("seconds"),
        **{name: job.plan[name] for name in ("number", "position", "position_name", "exposure_s")},
    )


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """A calibration: of a session that shot poses, or imported.

    number : rises with every calibration and orders lists. board : None where it was imported. cameras, projector :
    the extents of the rig's devices, from the first pose on. latest_pose : the highest number given. state : on disk
    never SOLVING. solve : the number of the last solve that went well, 0 before; result : its figures as JSON values.
    script : positions that are still to be taken.

    The last four are of its jobs, and not on disk. fault : of the last solve. progress : of what is under way.
    under_way : whether a pose is being shot or read, or a solve runs.
    """

    number: int
    id: UUID
    created_at: datetime
    rig: str
    label: str | None = None
    board: Board | None = None
    patterns: PatternPlan = USUAL_PATTERNS
    cameras: Mapping[str, Size] = field(default_factory=dict)
    projector: Size | None = None
    state: SessionState = SessionState.OPEN
    latest_pose: int = 0
    solve: int = 0
    solved_at: datetime | None = None
    result: Mapping[str, Any] | None = None
    coverage: Mapping[str, Any] | None = None
    next_move: Mapping[str, Any] | None = None
    script: tuple[int, ...] = ()
    poses: tuple[PoseRecord, ...] = ()
    progress: JobProgress | None = None
    fault: JobFailure | None = None
    under_way: bool = False

    @property
    def accepted(self) -> tuple[PoseRecord, ...]:
        """The poses that a solve takes."""
        return tuple(pose for pose in self.poses if pose.accepted)


@dataclass(frozen=True, slots=True)
class Setting:
    """The board before the rig, and the extents of the devices; projector is None where only cameras are calibrated."""

    board: Board
    cameras: Mapping[str, Size]
    projector: Size | None

    @property
    def sizes(self) -> Mapping[str, Size]:
        """The extents of the devices, the projector among them where there is one."""
        return self.cameras if self.projector is None else {**self.cameras, PROJECTOR: self.projector}


def setting_of(record: SessionRecord) -> Setting:
    """The setting of a session. Raises CalibrationStateError for an imported calibration, which has no board."""
    if record.board is None:
        message = f"Calibration {record.id} was imported and has no board. Open a new one to shoot poses."
        raise CalibrationStateError(message)
    return Setting(record.board, record.cameras, record.projector)


def with_jobs(session: SessionRecord, jobs: Sequence[JobRecord]) -> SessionRecord:
    """A session as it is on disk, completed by what its jobs, oldest first, say."""
    poses = tuple(sorted((pose_of(job) for job in jobs if job.kind is JobKind.POSE), key=lambda pose: pose.number))
    solves = [job for job in jobs if job.kind is JobKind.SOLVE]
    running = [job for job in jobs if not job.state.final]
    state = SessionState.SOLVING if any(not job.state.final for job in solves) else session.state
    fault = solves[-1].fault if solves and state is SessionState.FAILED else None
    progress = next((job.progress for job in running if job.state is not JobState.QUEUED), None)
    return replace(session, state=state, poses=poses, progress=progress, fault=fault, under_way=bool(running))


_session_adapter = TypeAdapter(SessionRecord)


def session_json(session: SessionRecord) -> bytes:
    """A session as JSON text, without what its jobs say."""
    of_jobs = {"poses", "progress", "fault", "under_way"}
    return _session_adapter.dump_json(session, indent=1, exclude=of_jobs) + b"\n"


def session_from_json(text: bytes, source: str) -> SessionRecord:
    """The inverse of `session_json`. Raises StorageError when it is not that."""
    try:
        return _session_adapter.validate_json(text)
    except (ValidationError, InvalidInputError) as error:
        message = f"{source} is not a calibration session as this version of slrig writes it: {error}"
        raise StorageError(message) from error


def plain(value: Any) -> Any:
    """A value of dataclasses, arrays, tuples and mappings as JSON values; what JSON has no number for is null.

    >>> import numpy as np
    >>> plain({"a": np.array([1.5, np.nan]), "b": (Size(2, 3),)})
    {'a': [1.5, None], 'b': [{'width_px': 2, 'height_px': 3}]}
    """
    return to_jsonable_python(value, inf_nan_mode="null", fallback=lambda array: array.tolist())

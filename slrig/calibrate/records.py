"""What is on record about a calibration session and its poses: frozen values, and their JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

import numpy as np
from pydantic import TypeAdapter, ValidationError

from slrig.calibration.board import Board
from slrig.errors import InvalidInputError, StorageError
from slrig.failure import JobFailure
from slrig.jobs.records import JobProgress
from slrig.model import Size
from slrig.scan.plan import PatternPlan

USUAL_PATTERNS = PatternPlan(rows=True)
"""White, Gray code and line shift along both axes: the projector has columns and rows to be calibrated."""


class SessionState(StrEnum):
    """Where a session stands. Another pose opens a solved or failed one again."""

    OPEN = "open"
    SOLVING = "solving"
    SOLVED = "solved"
    FAILED = "failed"


class PoseState(StrEnum):
    """Where a pose stands. The last four are final."""

    QUEUED = "queued"
    SHOOTING = "shooting"
    READING = "reading"
    ACCEPTED = "accepted"
    REFUSED = "refused"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """True when nothing more will happen to the pose.

        >>> PoseState.REFUSED.final, PoseState.READING.final
        (True, False)
        """
        return self not in {PoseState.QUEUED, PoseState.SHOOTING, PoseState.READING}


@dataclass(frozen=True, slots=True)
class PoseRecord:
    """One pose. `number` counts from 1 within the session and is never given twice.

    position : index of the pose that the positioner was asked for, None where a person holds the board.
    answer : what was found of it, as JSON values, see `slrig.calibrate.pose_judging`; None until read.
    fault : why it was refused or failed. seconds : from the last frame to the answer.
    """

    number: int
    state: PoseState
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

        >>> PoseRecord(3, PoseState.QUEUED, datetime(2026, 11, 22)).name
        'pose 3'
        """
        return f"pose {self.number}"


@dataclass(frozen=True, slots=True)
class KeptKey:
    """The pose that an idempotency key made, and the fingerprint of the request that made it."""

    fingerprint: str
    pose: int


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """A calibration: of a session that shot poses, or imported.

    number : rises with every calibration and orders lists. board : None where it was imported. cameras, projector :
    the extents of the rig's devices, from the first pose on. solve : the number of the last solve that went well, 0
    before; result : its figures as JSON values. latest_pose : the highest number given. keys : of requests for poses.
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
    poses: tuple[PoseRecord, ...] = ()
    latest_pose: int = 0
    progress: JobProgress | None = None
    fault: JobFailure | None = None
    solve: int = 0
    solved_at: datetime | None = None
    result: Mapping[str, Any] | None = None
    coverage: Mapping[str, Any] | None = None
    next_move: Mapping[str, Any] | None = None
    script: tuple[int, ...] = ()
    keys: Mapping[str, KeptKey] = field(default_factory=dict)

    @property
    def accepted(self) -> tuple[PoseRecord, ...]:
        """The poses that a solve takes."""
        return tuple(pose for pose in self.poses if pose.state is PoseState.ACCEPTED)

    @property
    def under_way(self) -> bool:
        """Whether a pose is being shot or read, or a solve runs."""
        return self.state is SessionState.SOLVING or any(not pose.state.final for pose in self.poses)

    def with_pose(self, pose: PoseRecord) -> SessionRecord:
        """The record with a pose put in the place of the one of its number, or added."""
        others = [each for each in self.poses if each.number != pose.number]
        poses = tuple(sorted([*others, pose], key=lambda each: each.number))
        return dataclasses.replace(self, poses=poses, latest_pose=max(self.latest_pose, pose.number))


_session_adapter = TypeAdapter(SessionRecord)


def session_json(session: SessionRecord) -> dict[str, Any]:
    """A session as JSON values."""
    document: dict[str, Any] = _session_adapter.dump_python(session, mode="json")
    return document


def session_from_json(text: bytes, source: str) -> SessionRecord:
    """The inverse of `session_json`, from text. Raises StorageError when it is not that."""
    try:
        return _session_adapter.validate_json(text)
    except (ValidationError, InvalidInputError) as error:
        message = f"{source} is not a calibration session as this version of slrig writes it: {error}"
        raise StorageError(message) from error


def plain(value: Any) -> Any:
    """A value of dataclasses, arrays, tuples and mappings as JSON values; what JSON has no number for is null.

    >>> plain({"a": np.array([1.5, np.nan]), "b": (Size(2, 3),)})
    {'a': [1.5, None], 'b': [{'width_px': 2, 'height_px': 3}]}
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {each.name: plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float)):
        return value
    return str(value)

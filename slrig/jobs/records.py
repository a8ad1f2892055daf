"""What is on record about a job of any kind: frozen values, the clock that dates them, and the key of a request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

from slrig.errors import IdempotencyError
from slrig.failure import JobFailure

Clock = Callable[[], datetime]
"""Gives the present moment with a time zone."""


def utc_now() -> datetime:
    """The present moment, UTC. For records only: durations are measured with a monotonic clock."""
    return datetime.now(UTC)


class JobKind(StrEnum):
    """What a job is."""

    SCAN = "scan"
    VERIFICATION = "verification"


class JobState(StrEnum):
    """Where a job stands. The last four are final: a job never leaves them."""

    QUEUED = "queued"
    CAPTURING = "capturing"
    COMPUTING = "computing"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"

    @property
    def final(self) -> bool:
        """True when nothing more will happen to the job.

        >>> JobState.CANCELLED.final, JobState.QUEUED.final
        (True, False)
        """
        return self not in {JobState.QUEUED, JobState.CAPTURING, JobState.COMPUTING}


@dataclass(frozen=True, slots=True)
class JobProgress:
    """How far a job is: the stage's name, the fraction 0..1 of the whole job, and a detail for people."""

    stage: str
    fraction: float
    detail: str

    def as_json(self) -> dict[str, Any]:
        """As events and answers carry it."""
        return {"stage": self.stage, "fraction": round(self.fraction, 4), "detail": self.detail}


@dataclass(frozen=True, slots=True)
class JobRecord:
    """One job. `number` rises with every job and orders lists; times are UTC. plan : what was asked, as JSON values.

    summary : what came of it, as far as a list shows it; None until the job has succeeded. pinned : no retention
    removes it.
    """

    number: int
    id: UUID
    state: JobState
    label: str | None
    rig: str
    plan: Mapping[str, Any]
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    progress: JobProgress
    fault: JobFailure | None
    summary: Mapping[str, Any] | None
    pinned: bool = False


@dataclass(frozen=True, slots=True)
class JobEvent:
    """One thing that happened to a job. `number` counts from 1 within the job and never changes."""

    number: int
    kind: str
    data: Mapping[str, Any]


def require_same_body(first: str, again: str, *, made: str) -> None:
    """Raise IdempotencyError unless both requests with one key have one fingerprint. made : what a request makes."""
    if first != again:
        message = (
            "This Idempotency-Key was sent before with another request body. "
            f"Use a new key for a new {made}, or repeat the first body unchanged."
        )
        raise IdempotencyError(message)

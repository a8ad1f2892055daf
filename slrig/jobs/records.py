"""What the records of every kind of job share: the clock that dates them, and the key of a request sent twice."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

from slrig.errors import IdempotencyError

Clock = Callable[[], datetime]
"""Gives the present moment with a time zone."""


def utc_now() -> datetime:
    """The present moment, UTC. For records only: durations are measured with a monotonic clock."""
    return datetime.now(UTC)


def require_same_body(first: str, again: str, *, made: str) -> None:
    """Raise IdempotencyError unless both requests with one key have one fingerprint. made : what a request makes."""
    if first != again:
        message = (
            "This Idempotency-Key was sent before with another request body. "
            f"Use a new key for a new {made}, or repeat the first body unchanged."
        )
        raise IdempotencyError(message)

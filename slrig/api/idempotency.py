"""A request that is sent twice does its work once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

from fastapi import Header
from pydantic import BaseModel

from slrig.api.schemas import fingerprint
from slrig.jobs.records import JobProgress, JobRecord, JobState
from slrig.jobs.store import JobStore

IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        description="makes a repeat of this request return what the first one made instead of making another; kept "
        "for a day, or as long as the calibration or the acceptance test that it belongs to",
    ),
]


def started_once(
    store: JobStore, key: str | None, request: BaseModel, start: Callable[[str | None], JobRecord]
) -> JobRecord:
    """The job that a request makes, or made before with this key, as it was when it was made.

    start : makes it, and ties it to the key that it is given; what it raises leaves the key free.

    Raises
    ------
    IdempotencyError
        The key was sent with another request, or its first request is still being answered.
    """
    if key is None:
        return _at_first(start(None))
    earlier = store.reserve_key(key, fingerprint(request))
    if earlier is not None:
        return _at_first(store.get(earlier))
    try:
        return _at_first(start(key))
    finally:
        # Does nothing when the key has its job; a refused request may be tried again with the same key.
        store.release_key(key)


def _at_first(record: JobRecord) -> JobRecord:
    return replace(
        record,
        state=JobState.QUEUED,
        started_at=None,
        finished_at=None,
        progress=JobProgress("waiting", 0.0, ""),
        fault=None,
        summary=None,
    )

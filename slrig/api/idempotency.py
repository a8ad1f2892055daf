"""A request that is sent twice does its work once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated
from uuid import UUID

from fastapi import Header
from pydantic import BaseModel

from slrig.jobs.keys import RequestKeys
from slrig.jobs.records import JobProgress, JobRecord, JobState
from slrig.jobs.store import JobStore

IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        description="makes a repeat of this request return what the first one made instead of making another; kept "
        "for a day, or as long as the service's settings say",
    ),
]


def once(
    keys: RequestKeys,
    key: str | None,
    path: str,
    request: BaseModel,
    start: Callable[[str | None], UUID],
) -> UUID:
    """The id of what a request makes, or made before with this key.

    path : where the request was sent; the same key may be sent elsewhere. start : makes it, and ties it to the key that
    it is given; what it raises leaves the key free.

    Raises
    ------
    IdempotencyError
        The key was sent with another request, or its first request is still being answered.
    """
    if key is None:
        return start(None)
    mine = own_key(key, path)
    earlier = keys.reserve(mine, fingerprint(request))
    if earlier is not None:
        return earlier
    try:
        return start(mine)
    finally:
        # Does nothing when the key has what it made; a refused request may be tried again with the same key.
        keys.release(mine)


def started_once(
    keys: RequestKeys,
    store: JobStore,
    key: str | None,
    path: str,
    request: BaseModel,
    start: Callable[[str | None], UUID],
) -> JobRecord:
    """The job that a request makes, or made before with this key, as it was when it was made. See `once`."""
    return replace(
        store.get(once(keys, key, path, request, start)),
        state=JobState.QUEUED,
        started_at=None,
        finished_at=None,
        progress=JobProgress("waiting", 0.0, ""),
        fault=None,
        summary=None,
    )


def own_key(key: str, path: str) -> str:
    """A key as it is on record: that of the requests to one path."""
    return f"{path} {key}"


def fingerprint(request: BaseModel) -> str:
    """What tells two requests with one idempotency key apart: equal for equal requests, however they were written."""
    return hashlib.sha256(request.model_dump_json().encode()).hexdigest()

"""Idempotency keys: a request that is sent twice makes one job, whatever kind it is of."""

from __future__ import annotations

from datetime import timedelta
from uuid import UUID

from sqlalchemy import delete

from slrig.errors import IdempotencyError, KeyInFlightError
from slrig.jobs.database import Database
from slrig.jobs.records import Clock, stamp, utc_now
from slrig.jobs.tables import KeyRow

KEY_LIFE_S = 24 * 3600.0
"""How long a key is remembered unless told otherwise."""


class RequestKeys:
    """The keys on record. Any thread may call."""

    def __init__(self, database: Database, *, clock: Clock = utc_now, life_s: float = KEY_LIFE_S) -> None:
        self._database = database
        self._clock = clock
        self._life = timedelta(seconds=life_s)

    def reserve(self, key: str, fingerprint: str) -> UUID | None:
        """Hold a key for a request, or return what the first request with it made.

        Raises
        ------
        KeyInFlightError
            The first request is still being answered.
        IdempotencyError
            The first request had another body.
        """
        with self._database.changing() as session:
            expired = stamp(self._clock() - self._life)
            session.execute(delete(KeyRow).where(KeyRow.created_at < expired))
            held = session.get(KeyRow, key)
            if held is None:
                session.add(KeyRow(key=key, fingerprint=fingerprint, job_id=None, created_at=stamp(self._clock())))
                return None
            if held.fingerprint != fingerprint:
                message = (
                    "This Idempotency-Key was sent before with another request body. Use a new key for a new request, "
                    "or repeat the first one unchanged."
                )
                raise IdempotencyError(message)
            if held.job_id is None:
                message = "The first request with this Idempotency-Key is still being answered. Ask again in a second."
                raise KeyInFlightError(message)
            return UUID(held.job_id)

    def tie(self, key: str, made: UUID) -> None:
        """Put on record what a request with a key made. A job is tied to its key by `JobStore.create`."""
        with self._database.changing() as session:
            if (held := session.get(KeyRow, key)) is not None:
                held.job_id = str(made)

    def release(self, key: str) -> None:
        """Free a key whose request made nothing, so that it may be tried again."""
        with self._database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.key == key, KeyRow.job_id.is_(None)))

    def release_all(self) -> None:
        """Free every key whose request was cut off. For the start of the service, when none can be in flight."""
        with self._database.changing() as session:
            session.execute(delete(KeyRow).where(KeyRow.job_id.is_(None)))

"""What is on record about an acceptance test: frozen values, and their JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from uuid import UUID

from pydantic import TypeAdapter

from slrig.accept.evaluation import Reading
from slrig.accept.plan import AcceptancePlan, Step
from slrig.calibrate.records import plain
from slrig.calibration import Decision
from slrig.errors import StorageError
from slrig.failure import JobFailure
from slrig.jobs.records import JobProgress, JobRecord, JobState

_FORMAT = "slrig-acceptance-test"


class AcceptanceState(StrEnum):
    """How far a test is.

    OPEN waits for its next position. INTERRUPTED was cut off by the end of the service while it was measured, and goes
    on, like an open one, when its next position is measured.
    """

    OPEN = "open"
    MEASURING = "measuring"
    INTERRUPTED = "interrupted"
    FINISHED = "finished"
    CANCELLED = "cancelled"

    @property
    def waiting(self) -> bool:
        """True while the next position may be measured."""
        return self in {AcceptanceState.OPEN, AcceptanceState.INTERRUPTED}


@dataclass(frozen=True, slots=True)
class AcceptanceRecord:
    """One test.

    number : rises with every test and orders lists. calibration : id of the one that it is done with. readings : of
    every capture so far, in the order of the plan. state : on disk OPEN, FINISHED or CANCELLED. decision : None before
    the end.

    The last two are of its jobs, and not on disk. fault : why the last position was not measured, None where it was; it
    may be measured again. progress : of what is under way.
    """

    number: int
    id: UUID
    created_at: datetime
    rig: str
    calibration: str
    plan: AcceptancePlan
    state: AcceptanceState = AcceptanceState.OPEN
    readings: tuple[Reading, ...] = ()
    decision: Decision | None = None
    fault: JobFailure | None = None
    progress: JobProgress | None = None

    @property
    def next_take(self) -> tuple[Step, int] | None:
        """The position to measure next, and how many times it was measured before; None when all are."""
        takes = self.plan.takes
        return takes[len(self.readings)] if len(self.readings) < len(takes) else None

    def from_first_take(self) -> AcceptanceRecord:
        """The record without the captures of a position that was not captured as often as planned.

        Between repeats nothing may be moved, and who knows what was since: the position begins anew.
        """
        following = self.next_take
        return self if following is None else replace(self, readings=self.readings[: len(self.readings) - following[1]])


_AFTER = {JobState.INTERRUPTED: AcceptanceState.INTERRUPTED, JobState.CANCELLED: AcceptanceState.CANCELLED}
"""What a test is when its newest job ended so."""


def with_jobs(record: AcceptanceRecord, jobs: Sequence[JobRecord]) -> AcceptanceRecord:
    """A test as it is on disk, completed by what its jobs, oldest first, say."""
    if not record.state.waiting or not jobs:
        return record
    job = jobs[-1]
    if not job.state.final:
        return replace(record, state=AcceptanceState.MEASURING, progress=job.progress)
    return replace(record, state=_AFTER.get(job.state, record.state), fault=job.fault)


_records = TypeAdapter(AcceptanceRecord)


def record_json(record: AcceptanceRecord) -> bytes:
    """A record as JSON text, without what its jobs say."""
    document = {"format": _FORMAT, "version": 3, **plain(record), "created_at": record.created_at.isoformat()}
    del document["progress"], document["fault"]
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def record_from_json(text: bytes, source: str) -> AcceptanceRecord:
    """The inverse of `record_json`. Raises StorageError when it is not that."""
    try:
        found = json.loads(text)
        if found["format"] != _FORMAT:
            raise KeyError(found["format"])  # noqa: TRY301 - told with the other faults of the file
        return _records.validate_python(found)
    except (ValueError, KeyError, TypeError) as error:
        message = f"{source} is not an acceptance test as this version of slrig writes it: {error!r}"
        raise StorageError(message) from error

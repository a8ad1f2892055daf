"""What is on record about an acceptance test: frozen values, and their JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

import numpy as np

from slrig.accept.evaluation import Reading
from slrig.accept.plan import AcceptancePlan, Artefact, Artefacts, Certified, Limits, Quantity, Step
from slrig.calibrate.records import plain
from slrig.calibration.artefacts import Decision
from slrig.errors import StorageError
from slrig.failure import JobFailure
from slrig.jobs.records import JobProgress

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
class RequestKey:
    """An idempotency key, and what tells its request from another."""

    key: str
    fingerprint: str


@dataclass(frozen=True, slots=True)
class AcceptanceRecord:
    """One test.

    number : rises with every test and orders lists. calibration : id of the one that it is done with. readings : of
    every capture so far, in the order of the plan. fault : why the last position was not measured, None where it was;
    it may be measured again. progress : of what is under way. decision : None before the end. opened_by : the key of
    the request that opened it; measured_by : by key, the fingerprints of those that had positions measured.
    """

    number: int
    id: UUID
    created_at: datetime
    rig: str
    calibration: str
    plan: AcceptancePlan
    state: AcceptanceState = AcceptanceState.OPEN
    readings: tuple[Reading, ...] = ()
    fault: JobFailure | None = None
    progress: JobProgress | None = None
    decision: Decision | None = None
    opened_by: RequestKey | None = None
    measured_by: Mapping[str, str] = field(default_factory=dict)

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


def record_json(record: AcceptanceRecord) -> bytes:
    """A record as JSON text; how far it is within a capture is left out."""
    document = {"format": _FORMAT, "version": 1, **plain(replace(record, progress=None))}
    document["created_at"] = record.created_at.isoformat()
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def record_from_json(text: bytes, source: str) -> AcceptanceRecord:
    """The inverse of `record_json`. Raises StorageError when it is not that."""
    try:
        found = json.loads(text)
        if found["format"] != _FORMAT:
            raise KeyError(found["format"])  # noqa: TRY301 - told with the other faults of the file
        fault, key, decision = found["fault"], found["opened_by"], found["decision"]
        return AcceptanceRecord(
            number=int(found["number"]),
            id=UUID(found["id"]),
            created_at=datetime.fromisoformat(found["created_at"]),
            rig=found["rig"],
            calibration=found["calibration"],
            plan=_plan(found["plan"]),
            state=AcceptanceState(found["state"]),
            readings=tuple(_reading(each) for each in found["readings"]),
            fault=None if fault is None else JobFailure(**fault),
            decision=None if decision is None else Decision(decision),
            opened_by=None if key is None else RequestKey(**key),
            measured_by=found["measured_by"],
        )
    except (ValueError, KeyError, TypeError) as error:
        message = f"{source} is not an acceptance test as this version of slrig writes it: {error!r}"
        raise StorageError(message) from error


def _plan(given: Mapping[str, Any]) -> AcceptancePlan:
    artefacts = given["artefacts"]
    certified = {name: Certified(**artefacts[name]) for name in ("diameter", "distance")}
    steps = tuple(
        Step(
            each["name"], Artefact(each["artefact"]), np.array(each["centre_mm"], np.float64),
            np.array(each["axis"], np.float64), each["words"],
        )
        for each in given["steps"]
    )  # fmt: skip
    return AcceptancePlan(
        **{
            **given,
            "volume_mm": np.array(given["volume_mm"], np.float64),
            "artefacts": Artefacts(**{**artefacts, **certified, "plane_mm": tuple(artefacts["plane_mm"])}),
            "limits": Limits(**given["limits"]),
            "steps": steps,
        }
    )


def _reading(given: Mapping[str, Any]) -> Reading:
    by_quantity = {
        name: {Quantity(quantity): _number(value) for quantity, value in given[name].items()}
        for name in ("errors_mm", "limits_mm")
    }
    return Reading(**{**{name: _number(value) for name, value in given.items()}, **by_quantity})


def _number(value: Any) -> Any:
    """JSON has no NaN: `plain` wrote null in its place."""
    return math.nan if value is None else value

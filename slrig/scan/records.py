"""What is on record about a scan: frozen values, and their JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any
from uuid import UUID

from pydantic import TypeAdapter, ValidationError

from slrig.bundle.storage import write_file
from slrig.failure import JobFailure
from slrig.scan.plan import ScanPlan

_RECORD = "record.json"

_plan_adapter = TypeAdapter(ScanPlan)


class ScanState(StrEnum):
    """Where a scan stands. The last four are final: a scan never leaves them."""

    QUEUED = "queued"
    CAPTURING = "capturing"
    RECONSTRUCTING = "reconstructing"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"

    @property
    def final(self) -> bool:
        """True when nothing more will happen to the scan.

        >>> ScanState.CANCELLED.final, ScanState.QUEUED.final
        (True, False)
        """
        return self not in {ScanState.QUEUED, ScanState.CAPTURING, ScanState.RECONSTRUCTING}


@dataclass(frozen=True, slots=True)
class ScanProgress:
    """How far a scan is: the stage's name, the fraction 0..1 of the whole scan, and a detail for people."""

    stage: str
    fraction: float
    detail: str

    def as_json(self) -> dict[str, Any]:
        """As events and answers carry it."""
        return {"stage": self.stage, "fraction": round(self.fraction, 4), "detail": self.detail}


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """One row of the scan table. `number` rises with every scan and orders lists; times are UTC.

    `summary` is the part of the report worth showing in a list; None until the scan has succeeded.
    """

    number: int
    id: UUID
    state: ScanState
    label: str | None
    rig: str
    plan: ScanPlan
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    progress: ScanProgress
    fault: JobFailure | None
    summary: Mapping[str, Any] | None


@dataclass(frozen=True, slots=True)
class KeptRecord:
    """What a finished scan says of its own record, beside its files: enough to put it on record again."""

    id: UUID
    rig: str
    label: str | None
    plan: ScanPlan
    created_at: datetime
    started_at: datetime


_record_adapter = TypeAdapter(KeptRecord)


@dataclass(frozen=True, slots=True)
class ScanEvent:
    """One thing that happened to a scan. `number` counts from 1 within the scan and never changes."""

    number: int
    kind: str
    data: Mapping[str, Any]


def plan_json(plan: ScanPlan) -> dict[str, Any]:
    """The plan as JSON values.

    >>> plan_from_json(plan_json(ScanPlan(exposure_s=0.02))).exposure_s
    0.02
    """
    document: dict[str, Any] = _plan_adapter.dump_python(plan, mode="json")
    return document


def plan_from_json(document: Mapping[str, Any]) -> ScanPlan:
    """The inverse of `plan_json`."""
    return _plan_adapter.validate_python(document)


def write_record(folder: Path, record: KeptRecord) -> None:
    """Write record.json into the folder of a scan. Raises StorageError."""
    write_file(folder / _RECORD, _record_adapter.dump_json(record, indent=1))


def read_record(folder: Path) -> KeptRecord | None:
    """What the record.json of a scan's folder says; None where there is none that can be read."""
    try:
        return _record_adapter.validate_json((folder / _RECORD).read_bytes())
    except (OSError, ValidationError):
        return None


def report_summary(report: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a report that is worth a row in a list: its plain values, and the whole of "truth", "mesh", "notes".

    >>> report_summary({"method": "Gray-only", "stages": {"decode": 0.1}, "truth": {"rms_mm": float("nan")}})
    {'method': 'Gray-only', 'truth': {'rms_mm': None}}
    """
    return {
        name: _finite(value)
        for name, value in report.items()
        if name in {"truth", "mesh", "notes"} or value is None or isinstance(value, (bool, int, float, str))
    }


def _finite(value: Any) -> Any:
    """The value with null for every number that JSON has no form for."""
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

"""What is on record about a scan: frozen values, and their JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from uuid import UUID

from pydantic import TypeAdapter, ValidationError

from slrig.bundle import write_file
from slrig.jobs.timeline import STAGES_S
from slrig.scan.plan import ScanPlan

_RECORD = "record.json"

_plan_adapter = TypeAdapter(ScanPlan)


@dataclass(frozen=True, slots=True)
class KeptRecord:
    """What a finished scan says of its own record, beside its files: enough to put it on record again."""

    id: UUID
    rig: str
    label: str | None
    plan: ScanPlan
    created_at: datetime
    started_at: datetime
    requested_by: str | None = None


_record_adapter = TypeAdapter(KeptRecord)


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
    """The part of a report that is worth a row in a list: its plain values, and the whole of "truth", "mesh",
    "notes", "turntable" (its angle), "computed", and the seconds of each stage of the work.

    >>> report_summary({"method": "Gray-only", "stages": {"decode": 0.1}, "truth": {"rms_mm": float("nan")}})
    {'method': 'Gray-only', 'truth': {'rms_mm': None}}
    """
    return {
        name: _finite(value)
        for name, value in report.items()
        if name in {"truth", "mesh", "notes", "turntable", "computed", STAGES_S}
        or value is None
        or isinstance(value, (bool, int, float, str))
    }


def _finite(value: Any) -> Any:
    """The value with null for every number that JSON has no form for."""
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

"""What is on record about a scan, as JSON values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter

from slrig.jobs.records import STAGES_S
from slrig.scan.plan import ScanPlan

_plan_adapter = TypeAdapter(ScanPlan)


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

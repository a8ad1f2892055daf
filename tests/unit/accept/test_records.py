"""An acceptance test's record survives its JSON."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from uuid import UUID

import numpy as np

from slrig.accept.records import AcceptanceRecord, AcceptanceState, record_from_json, record_json
from slrig.calibration.artefacts import Decision
from tests.unit.accept.test_running import PLAN, told

RECORD = AcceptanceRecord(
    3,
    UUID(int=7),
    datetime(2026, 11, 22, 8, 30, 0, 250_000, tzinfo=UTC),
    "bench",
    "0123456789ab",
    replace(PLAN, exposure_s=0.02, notes="after the move"),
    AcceptanceState.OPEN,
    (told("sphere-1", 0, 0.004), replace(told("sphere-1", 1, -0.001), noise_mm=math.nan)),
    decision=Decision.UNDECIDED,
)


def test_a_record_survives_its_json() -> None:
    text = record_json(RECORD)
    found = record_from_json(text, "test.json")
    assert record_json(found) == text
    assert math.isnan(found.readings[1].noise_mm)
    assert found.readings[0] == RECORD.readings[0]
    assert replace(found, plan=RECORD.plan, readings=()) == replace(RECORD, readings=())
    assert [step.name for step in found.plan.steps] == [step.name for step in PLAN.steps]
    for mine, theirs in zip(found.plan.steps, PLAN.steps, strict=True):
        np.testing.assert_array_equal(mine.centre_mm, theirs.centre_mm)
        np.testing.assert_array_equal(mine.axis, theirs.axis)
    np.testing.assert_array_equal(found.plan.volume_mm, PLAN.volume_mm)
    assert (found.plan.artefacts, found.plan.limits) == (PLAN.artefacts, PLAN.limits)


def test_a_position_begins_anew_where_its_repeats_were_not_finished() -> None:
    one = replace(RECORD, readings=RECORD.readings[:1])
    assert one.from_first_take().readings == ()
    # Both captures of the first position are there, and the second position follows.
    assert RECORD.from_first_take().readings == RECORD.readings
    assert json.loads(record_json(RECORD))["readings"][1]["noise_mm"] is None

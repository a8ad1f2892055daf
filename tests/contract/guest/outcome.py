"""What came of a check that runs in a guest: its fault, how long it took, and what it measured."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import pytest

from slrig.conformance import Check, CheckOutcome
from slrig.conformance.bench import Need
from tests.contract.guest.machine import FILES, require_guest, run_in_guest

Notes = dict[str, float | int | str]


def outcome(check: Callable[[Notes], None]) -> dict[str, object]:
    """Run a check that raises what is wrong and notes what it measured; `fault` is None where nothing is."""
    notes: Notes = {}
    fault: str | None = None
    begun = time.monotonic()
    try:
        check(notes)
    # Whatever it is (pytest's failures are no Exception), the other checks have their turn.
    except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001
        fault = "".join(traceback.format_exception(error))
    return {"fault": fault, "seconds": round(time.monotonic() - begun, 2), "notes": notes}


def told_by(module: str, *arguments: str, folder: Path, **machine: Any) -> dict[str, Any]:
    """What a module wrote of its checks, run in a guest: `machine` is what `run_in_guest` takes. Skips without one."""
    require_guest()
    command = [sys.executable, "-m", module, f"{FILES}/told.json", *arguments]
    finished = run_in_guest(command, folder=folder, **machine)
    assert finished.exit_code == 0, finished.output[-4000:]
    found: dict[str, Any] = json.loads((finished.files / "told.json").read_text())
    sys.stdout.write(f"the guest ran {finished.total_s:.0f} s\n")
    return found


def require_sound(outcome: dict[str, Any]) -> None:
    """Fail unless a check found no fault."""
    sys.stdout.write(f"{outcome['seconds']} s, {outcome['notes']}\n")
    assert outcome["fault"] is None, outcome["fault"]


def require_passed(report: dict[str, Any], check: Check, *, lacking: set[Need], asks_nothing: Collection[str]) -> None:
    """Fail unless a check of the contract passed, or asked nothing where a need is lacking or it is so named."""
    result = next(each for each in report["checks"] if each["name"] == check.name)
    sys.stdout.write(f"{result['seconds']:.2f} s\n")
    applies = lacking.isdisjoint(check.needs) and check.name not in asks_nothing
    assert result["outcome"] == (CheckOutcome.PASSED if applies else CheckOutcome.NOT_APPLICABLE), result["failure"]

"""What came of a check that runs in a guest: its fault, how long it took, and what it measured."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

import pytest

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

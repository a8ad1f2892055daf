"""The guards that this process has set on its outputs: one per output, kept until the process ends."""

from __future__ import annotations

import json
import threading
from dataclasses import asdict

from drivers.display.guarding import Guard
from drivers.screen import guard
from drivers.screen.guard import Duty

_kept: dict[tuple[str | None, str], tuple[Duty, Guard]] = {}
_keeping = threading.Lock()


def keep_dark(duty: Duty) -> Guard:
    """Return the guard of an output, set now if there is none. Raises DeviceError."""
    key = (duty.display, duty.output)
    with _keeping:
        before = _kept.get(key)
        if before is not None and before[1].is_alive and before[0] == duty:
            before[1].step_back()
            return before[1]
        new = Guard(guard.__name__, json.dumps(asdict(duty)), duty.output)
        if before is not None:
            # The new one has relieved it, or it ended before.
            before[1].leave()
        _kept[key] = (duty, new)
        return new


def release(display: str | None, output: str) -> None:
    """End the guard of an output, if this process has set one: what is under its black is seen again."""
    with _keeping:
        found = _kept.pop((display, output), None)
    if found is not None:
        found[1].release()

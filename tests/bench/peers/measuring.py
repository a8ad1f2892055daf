"""Seconds and peak memory of the phases of one method, measured from inside its own process."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TypeVar

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"
_WARM_RUNS = 5
_WARM_SECONDS = 15.0
_LONG_SECONDS = 15.0

Result = TypeVar("Result")


class Phase(StrEnum):
    """What a method is busy with. `FILES` (reading frames, writing results, pictures) is measured and not counted."""

    POINTS = "points"
    MESH = "mesh"
    FILES = "files"


@dataclass(frozen=True, slots=True)
class Cost:
    """What one method cost.

    first_s, warm_s : seconds per phase of the first run, and the median of the runs after it; a method that takes
        long runs once, and both are that run. warm_runs : how many runs there were after the first.
    peak_mb : per phase, the most resident memory in any run above what the process held before its first run, when
        libraries were imported and the input was read. What an earlier phase still holds counts.
    """

    first_s: dict[Phase, float]
    warm_s: dict[Phase, float]
    warm_runs: int
    peak_mb: dict[Phase, float]


class Meter:
    """Told by a method which phase begins; keeps seconds and peak memory of each."""

    def __init__(self) -> None:
        self._phase: Phase | None = None
        self._since_s = 0.0
        self.seconds: dict[Phase, float] = {}
        self.peak_mb: dict[Phase, float] = {}

    def enter(self, phase: Phase | None) -> None:
        """End the phase under way and begin this one; None ends the run."""
        now_s = time.perf_counter()
        if self._phase is not None:
            before = self._phase
            self.seconds[before] = self.seconds.get(before, 0.0) + now_s - self._since_s
            self.peak_mb[before] = max(self.peak_mb.get(before, 0.0), peak_resident_mb())
        reset_peak()
        self._phase, self._since_s = phase, time.perf_counter()


def measured(run: Callable[[Meter], Result], *, compiles: bool) -> tuple[Result, Cost]:
    """Run a method once, and again while that is quick; the last result and what the method cost.

    compiles : the first run may spend long on compiling, so there is always a second.
    """
    before_mb = _status_mb("VmRSS")
    meters: list[Meter] = []
    while True:
        meter = Meter()
        result = run(meter)
        meter.enter(None)
        meters.append(meter)
        first_s, spent_s = sum(meters[0].seconds.values()), sum(sum(each.seconds.values()) for each in meters)
        if compiles and len(meters) == 1:
            continue
        if (first_s > _LONG_SECONDS and not compiles) or len(meters) > _WARM_RUNS or spent_s - first_s > _WARM_SECONDS:
            break
    warm = meters[1:] or meters
    phases = list(meters[0].seconds)
    return result, Cost(
        first_s=meters[0].seconds,
        warm_s={phase: statistics.median(each.seconds[phase] for each in warm) for phase in phases},
        warm_runs=len(meters) - 1,
        peak_mb={phase: max(0.0, max(each.peak_mb[phase] for each in meters) - before_mb) for phase in phases},
    )


def reset_peak() -> None:
    """Make Linux forget this process's peak of resident memory."""
    _CLEAR.write_text(_RESET_PEAK, encoding="ascii")


def peak_resident_mb() -> float:
    """The most resident memory since `reset_peak`, MiB."""
    return _status_mb("VmHWM")


def _status_mb(key: str) -> float:
    lines = _STATUS.read_text(encoding="ascii", errors="replace").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{key}:"))

"""Progress and cancellation of a long call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from slrig.errors import ScanCancelledError

PREPARING = "preparing kernels"
"""Stage in which kernels are compiled, which happens once, and takes a time that is not known ahead."""


def _silent(_stage: str, _fraction: float, _detail: str) -> None:
    pass


def _never() -> bool:
    return False


def _unheard(_file: str) -> None:
    pass


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Listener:
    """Receives the progress of a long call, and can cancel it.

    report : takes the stage, the fraction of the whole call that is done, 0 to 1, and a detail for people. cancelled
    : whether the call is to end early, by ScanCancelledError. file_ready : takes the name of a file that can be fetched
    before the call is over.
    """

    report: Callable[[str, float, str], None] = _silent
    cancelled: Callable[[], bool] = _never
    file_ready: Callable[[str], None] = _unheard

    def check(self, message: str = "It was cancelled.") -> None:
        """Raise ScanCancelledError once the call is to end early."""
        if self.cancelled():
            raise ScanCancelledError(message)

    def step(self, stage: str, fraction: float, detail: str, /) -> None:
        """Report progress, and raise ScanCancelledError once the call is to end early."""
        self.report(stage, fraction, detail)
        self.check()

    def within(self, begin: float, end: float, name: str = "") -> Listener:
        """A listener for the part of this call from one fraction to another. name : prefix of its stages."""

        def report(stage: str, fraction: float, detail: str) -> None:
            whole = begin + (end - begin) * min(max(fraction, 0.0), 1.0)
            self.report(f"{name}: {stage}" if name else stage, whole, detail)

        return Listener(report=report, cancelled=self.cancelled)

    def part(self, number: int, count: int, name: str = "") -> Listener:
        """A listener for one of `count` equally long calls that make up this one. number : from 0."""
        return self.within(number / count, (number + 1) / count, name)


SILENT = Listener()
"""Ignores progress, and never cancels."""

"""The scheduled acceptance test: every prescribed position measured by the rig's positioner, and the decision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from slrig.accept.asking import AcceptanceRequest
from slrig.accept.desk import AcceptanceDesk
from slrig.accept.records import AcceptanceState
from slrig.accept.verdicts import verdicts
from slrig.failure import failure_of
from slrig.jobs.job import Holder
from slrig.scan.runner import RigAccess
from slrig.schedule.polling import error_of, until
from slrig.schedule.positions import require_positions
from slrig.schedule.task_options import checked


class AcceptanceTask:
    """Implements `slrig.schedule.tasks.Task`. The rig is held for the whole of the test."""

    def __init__(self, queue: RigAccess, desk: AcceptanceDesk) -> None:
        self._queue = queue
        self._desk = desk

    def check(self, options: Mapping[str, Any], /) -> None:
        """See `Task`."""
        _options(options)
        require_positions(self._queue.status().facts, ())

    def do(self, holder: Holder, options: Mapping[str, Any], /, *, cancelled: Callable[[], bool]) -> Mapping[str, Any]:
        """See `Task`. A rig that fails the test is a run that succeeded."""
        asked = _options(options)
        test = self._desk.open(asked.plan).id
        try:
            self._desk.measure(test, wait=False, scripted=True, holder=holder)
        except BaseException:
            self._desk.cancel(test)
            raise
        until(
            lambda: self._desk.get(test).state is not AcceptanceState.MEASURING,
            cancelled,
            cancel=lambda: self._desk.cancel(test),
        )
        record = self._desk.get(test)
        if record.decision is None:
            self._desk.cancel(test)
            raise error_of(record.fault or failure_of(RuntimeError("the test ended without a result")))
        return {
            "acceptance": str(test),
            "decision": str(record.decision),
            "quantities": {
                str(each.quantity): {
                    "error_mm": each.error_mm,
                    "limit_mm": each.limit_mm,
                    "uncertainty_mm": each.uncertainty_mm,
                    "position": each.step,
                    "decision": str(each.decision),
                }
                for each in verdicts(record.readings, record.plan)
            },
        }


def _options(given: Mapping[str, Any]) -> AcceptanceRequest:
    return checked(AcceptanceRequest, given, task="acceptance")

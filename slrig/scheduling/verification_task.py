"""The scheduled verification: the board shot where it is, or where the positioner takes it, and judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from slrig.calibration.board import Board
from slrig.errors import CalibrationError
from slrig.scan.work import Holder
from slrig.scheduling.naming import NamedLender
from slrig.scheduling.task_options import VerificationOptions, checked
from slrig.scheduling.waiting import error_of, until
from slrig.sessions.calibration.calibrating import Calibrations
from slrig.sessions.health.verification import VerificationDesk

_TOLD = ("state", "reasons", "remedy", "expected_mm", "drift_mm", "scale_percent", "scale_mm")


class VerificationTask:
    """Implements `slrig.scheduling.tasks.Task`."""

    def __init__(self, lender: NamedLender, calibrations: Calibrations, desk: VerificationDesk) -> None:
        self._lender = lender
        self._calibrations = calibrations
        self._desk = desk

    def check(self, options: Mapping[str, Any], /) -> None:
        """See `Task`."""
        _options(options)

    def do(self, holder: Holder, options: Mapping[str, Any], /, *, cancelled: Callable[[], bool]) -> Mapping[str, Any]:
        """See `Task`. A rig that is found stale is a verification that succeeded."""
        asked = _options(options)
        board = self._board_in_use() if asked.board is None else asked.board.board()
        with self._lender.named(holder):
            job = self._desk.shoot(board, position=asked.position, exposure_s=asked.exposure_s, wait=False)
        until(lambda: self._desk.job(job.id).state.final, cancelled, cancel=lambda: self._desk.cancel(job.id))
        over = self._desk.job(job.id)
        if over.fault is not None:
            raise error_of(over.fault)
        if over.record is None:
            raise TypeError(over)
        found = over.record.document()
        return {"verification": str(over.record.id), **{name: found.get(name) for name in _TOLD}}

    def _board_in_use(self) -> Board:
        active = self._calibrations.active
        board = None if active is None else self._calibrations.register.get(active).board
        if board is None:
            message = (
                "the calibration in use was imported or is the rig's own, and its board is not known here; give the "
                'schedule the option "board" with kind, corners and square_mm of the one that is in view'
            )
            raise CalibrationError(message)
        return board


def _options(given: Mapping[str, Any]) -> VerificationOptions:
    return checked(VerificationOptions, given, task="verification")

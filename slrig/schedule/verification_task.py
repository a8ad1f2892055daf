"""The scheduled verification: the board shot where it is, or where the positioner takes it, and judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from slrig.calibrate.calibrating import Calibrations
from slrig.calibration.board import Board
from slrig.errors import CalibrationError, ScheduleError
from slrig.jobs.job import Holder
from slrig.scan.runner import RigAccess
from slrig.schedule.polling import error_of, until
from slrig.schedule.positions import require_positions
from slrig.schedule.task_options import VerificationOptions, checked
from slrig.verify.job import VerificationDesk

_TOLD = ("state", "reasons", "remedy", "expected_mm", "drift_mm", "scale_percent", "scale_mm")


class VerificationTask:
    """Implements `slrig.schedule.tasks.Task`."""

    def __init__(self, queue: RigAccess, calibrations: Calibrations, desk: VerificationDesk) -> None:
        self._queue = queue
        self._calibrations = calibrations
        self._desk = desk

    def check(self, options: Mapping[str, Any], /) -> None:
        """See `Task`. A calibration may be made before the first run; a board to look at is named now or never."""
        asked = _options(options)
        if asked.position is not None:
            require_positions(self._queue.status().facts, [asked.position])
        if asked.board is None:
            try:
                self._board_in_use()
            except CalibrationError as error:
                message = f"options: {error}"
                raise ScheduleError(message) from error

    def do(self, holder: Holder, options: Mapping[str, Any], /, *, cancelled: Callable[[], bool]) -> Mapping[str, Any]:
        """See `Task`. A rig that is found stale is a verification that succeeded."""
        asked = _options(options)
        board = self._board_in_use() if asked.board is None else asked.board.board()
        job = self._desk.shoot(board, position=asked.position, exposure_s=asked.exposure_s, holder=holder)
        jobs = self._desk.jobs
        until(lambda: jobs.get(job.id).state.final, cancelled, cancel=lambda: self._desk.cancel(job.id))
        over = jobs.get(job.id)
        if over.fault is not None:
            raise error_of(over.fault)
        if over.summary is None:
            raise TypeError(over)
        return {"verification": over.summary["id"], **{name: over.summary.get(name) for name in _TOLD}}

    def _board_in_use(self) -> Board:
        active = self._calibrations.active
        board = None if active is None else self._calibrations.register.get(active).board
        if board is None:
            used = "no calibration that was made here is in use" if active is None else "the one in use was imported"
            message = (
                f"which board is in view is not known: {used}. Give the schedule the option "
                '"board", as {"kind": "charuco", "corners": [11, 8], "square_mm": 12}, or activate a calibration that '
                "was made here"
            )
            raise CalibrationError(message)
        return board


def _options(given: Mapping[str, Any]) -> VerificationOptions:
    return checked(VerificationOptions, given, task="verification")

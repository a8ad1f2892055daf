"""Waiting for work that somebody else does, and the error that its recorded fault stands for."""

from __future__ import annotations

import threading
from collections.abc import Callable

from slrig.errors import DeviceError, LibraryMissingError, RigBusyError, ScanCancelledError, SlrigError
from slrig.failure import JobFailure, errors_by_code

LOOK_S = 0.1


def until(reached: Callable[[], bool], cancelled: Callable[[], bool], *, cancel: Callable[[], object]) -> None:
    """Return once `reached()`; have the work ended by `cancel` when `cancelled()` turns true before.

    Raises
    ------
    ScanCancelledError
        `cancelled()` became true.
    """
    never = threading.Event()
    while not reached():
        if cancelled():
            cancel()
            message = "the run was cancelled"
            raise ScanCancelledError(message)
        never.wait(LOOK_S)


def error_of(fault: JobFailure) -> SlrigError:
    """The error that a recorded fault stands for.

    >>> error_of(JobFailure("pose-refused", "no camera sees the board"))
    PoseRefusedError('no camera sees the board')
    """
    kind = errors_by_code().get(fault.code, SlrigError)
    # These two take more than a message.
    return DeviceError(fault.message) if kind in {RigBusyError, LibraryMissingError} else kind(fault.message)

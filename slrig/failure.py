"""Cause of a failed job, as a value that crosses processes and is stored."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import structlog

from slrig.errors import (
    DeviceError,
    LibraryMissingError,
    OutOfMemoryError,
    RigBusyError,
    ScanInterruptedError,
    SlrigError,
    StorageError,
)
from slrig.printable import foreign_text

UNEXPECTED = "unexpected"
"""The code of a failure that is a defect of slrig: its message is for people, its cause is in the service's log."""

_OPENCV_NO_MEMORY = -4
"""`cv::Error::StsNoMem`, the code of a `cv2.error`."""

_DISK_REFUSALS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.EFBIG}


@dataclass(frozen=True, slots=True)
class JobFailure:
    """code : that of a class of the error tree, or `UNEXPECTED`. message : text for people."""

    code: str
    message: str


def errors_by_code() -> dict[str, type[SlrigError]]:
    """Every class of the error tree that has a code of its own, the base included, by its code."""
    classes: dict[str, type[SlrigError]] = {}
    waiting: list[type[SlrigError]] = [SlrigError]
    while waiting:
        error = waiting.pop()
        if "code" in vars(error):
            classes[error.code] = error
        waiting.extend(error.__subclasses__())
    return classes


def error_of(fault: JobFailure) -> SlrigError:
    """The error of a recorded fault.

    >>> error_of(JobFailure("pose-refused", "no camera sees the board"))
    PoseRefusedError('no camera sees the board')
    """
    kind = errors_by_code().get(fault.code, SlrigError)
    # These two take more than a message.
    return DeviceError(fault.message) if kind in {RigBusyError, LibraryMissingError} else kind(fault.message)


def job_failure(error: BaseException) -> JobFailure:
    """Return the failure of an exception.

    >>> job_failure(StorageError("The disk is full.")).code
    'storage'
    """
    if isinstance(error, SlrigError):
        return JobFailure(error.code, foreign_text(error))
    if isinstance(error, MemoryError) or getattr(error, "code", None) == _OPENCV_NO_MEMORY:
        found = foreign_text(error)
        message = f"The machine has too little memory for this: {found}. Free some, or use a camera of fewer pixels."
        return JobFailure(OutOfMemoryError.code, message)
    if isinstance(error, OSError) and error.errno in _DISK_REFUSALS:
        return JobFailure(StorageError.code, foreign_text(disk_error_message(error, None)))
    message = (
        f"slrig met an error it did not expect ({type(error).__name__}). The service's log has the details under "
        "this job's id; please report them."
    )
    return JobFailure(UNEXPECTED, message)


def interruption_error() -> ScanInterruptedError:
    """Return the error of a job that ended with the service."""
    return ScanInterruptedError("The service ended while this was under way. Start it again.")


def disk_error_message(error: OSError, path: Path | None) -> str:
    """Return the message about a disk that refused a write."""
    where = error.filename or path or "the data folder"
    reason = error.strerror or str(error)
    remedy = "free some space" if error.errno in {errno.ENOSPC, errno.EDQUOT} else "check the disk and its permissions"
    return f"Writing to {where} failed: {reason}. What was being written has been removed; {remedy} and try again."


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Convert a refusal of the disk within the block to a StorageError."""
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK_REFUSALS:
            raise
        raise StorageError(disk_error_message(error, path)) from error


_RESTART_S = 1.0

_log = structlog.get_logger(__name__)


class LastingThread(threading.Thread):
    """A thread that lasts as long as a service. An error that ends its loop is logged, and the loop restarted."""

    def __init__(self, loop: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._loop = loop

    def run(self) -> None:
        """See `threading.Thread`."""
        while True:
            try:
                return self._loop()
            except BaseException:  # noqa: BLE001 - after any error: work waits for this loop
                _log.exception("a loop ended by an error, and is restarted", thread=self.name)
                time.sleep(_RESTART_S)


def as_error(raised: BaseException) -> Exception:
    """The end of a job as an error: no exception of a job, not even SystemExit, ends the service's threads."""
    if isinstance(raised, Exception):
        return raised
    error = RuntimeError(f"{type(raised).__name__} ended it")
    error.__cause__ = raised
    return error

"""All errors that slrig raises on purpose, in one tree.

A message says what was requested, what was found, and what to do, in its reader's terms. Status codes and exit codes
are decided at the edges (`slrig.api.problems`, `slrig.cli`), never here.
"""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from collections.abc import Iterator

_FLAGS = {
    "exposures_s": "exposure-s",
    "kind": "board",
    "line_shift_period_px": "period-px",
    "sine_period_px": "period-px",
    "sine_steps": "steps",
    "turned_by": "manual",
}
"""Flags of the command line with another name than the setting."""


def setting(name: str) -> str:
    """Name a setting in a message for terminal and HTTP: its key in requests and rig files, and its flag.

    >>> setting("gray_cell_px")
    'gray_cell_px (--gray-cell-px)'
    """
    return f"{name} (--{_FLAGS.get(name, name.replace('_', '-'))})"


def is_interrupt(error: BaseException) -> bool:
    """Whether an error is Ctrl-C, which ends a command and comes on its main thread, and not one of foreign code."""
    return isinstance(error, KeyboardInterrupt) and threading.current_thread() is threading.main_thread()


class SlrigError(Exception):
    """Base of the tree. Catch it at an edge; raise one of its children."""

    code: ClassVar[str] = "slrig"
    """Its name over HTTP and in records, independent of the class's name. A child without a code has its parent's."""

    camera: str | None = None
    """The camera that alone failed, as the rig calls it; None if that is not known, or if more than it failed."""

    def __init_subclass__(cls, *, code: str | None = None) -> None:
        super().__init_subclass__()
        if code is not None:
            cls.code = code


@contextmanager
def of_camera(name: str) -> Iterator[None]:
    """Name the camera that failed in errors of the block."""
    try:
        yield
    except SlrigError as error:
        error.camera = name
        raise


class InvalidInputError(SlrigError, code="invalid-input"):
    """Something that a person wrote or sent cannot be used. Raise a child that names the kind of input."""


class ConfigError(InvalidInputError, code="config"):
    """A rig file, scene file or setting is wrong. All its faults belong in one message."""


class BundleError(InvalidInputError, code="bundle"):
    """A scan bundle's description or one of its frames is wrong: missing, cut, another size, an unknown key."""


class CalibrationError(InvalidInputError, code="calibration"):
    """A calibration is missing, malformed, not finite, or made for devices of another size."""


class NotCalibratedError(CalibrationError, code="not-calibrated"):
    """The rig has no calibration, and a scan would have no millimetres. Nothing was captured."""


class PatternError(InvalidInputError, code="pattern"):
    """A pattern cannot be shown or decoded on this projector: too few bits, too small, an impossible period."""


class ScheduleError(InvalidInputError, code="schedule"):
    """A schedule is invalid: cron text that is wrong or never matches, an unknown zone, a negative grace."""


class ScheduleNotFoundError(SlrigError, code="schedule-not-found"):
    """No schedule of this id is on record here."""


class ScanEvidenceError(SlrigError, code="scan-evidence"):
    """The frames contradict their patterns: white not brighter than black, a repeated frame, a bit equal to its
    inverse. Raise it if showing the same patterns again might help.
    """


class NothingToReconstructError(SlrigError, code="nothing-to-reconstruct"):
    """The frames are correct, but contain no surface: nothing lit, nothing decoded, no stripe found."""


class DeviceError(SlrigError, code="device"):
    """A camera or projector did not do what the caller requested. Raise a child if one fits.

    place : the device and the call, added to the message; None if the message names them.
    """

    place: str | None = None

    def __str__(self) -> str:
        text = super().__str__()
        return text if self.place is None else f"{text} ({self.place})"


class DeviceGoneError(DeviceError, code="device-gone"):
    """The device was there and is gone: unplugged, powered off. It has to be opened again."""


class DeviceBusyError(DeviceError, code="device-busy"):
    """Another program holds the device. Name the device and, if the system knows it, the other program."""


class DeviceStateError(DeviceError, code="device-state"):
    """The call came in the wrong state: show before load, trigger before arm, anything after close. This is a fault of
    the caller, not of the device.
    """


class UnsupportedByDeviceError(DeviceError, code="unsupported-by-device"):
    """The device understood the request but cannot do it (an exposure out of range, a pattern of another size)."""


class WrongSystemError(UnsupportedByDeviceError, code="wrong-system"):
    """A driver is installed, but its devices work with another operating system only. Name that system."""


class FrameTimeoutError(DeviceError, code="frame-timeout"):
    """No suitable frame arrived in time. The device may be well: a late frame is not a lost device."""


class DriverNotFoundError(ConfigError, code="driver-not-found"):
    """A rig file names a driver that no installed package provides. Name the installed ones."""


class DriverBrokenError(DeviceError, code="driver-broken"):
    """A driver is installed but cannot be loaded. Name the package and the cause; other drivers keep working."""


class LibraryMissingError(DriverBrokenError, code="library-missing"):
    """A driver is installed, but not the library that it needs. Name the command that installs it.

    install : that command alone.
    """

    def __init__(self, message: str, *, install: str) -> None:
        super().__init__(message)
        self.install = install


class RigBusyError(SlrigError, code="rig-busy"):
    """The rig is held by another job. Name the holder and since when."""

    def __init__(self, message: str, *, holder: str, since: str) -> None:
        super().__init__(message)
        self.holder = holder
        self.since = since


class QueueFullError(SlrigError, code="queue-full"):
    """The line has as many jobs as it may have, or as many of one key. Try again later."""


class ScanCancelledError(SlrigError, code="scan-cancelled"):
    """This scan was cancelled. Not a failure."""


class CameraNotFoundError(SlrigError, code="camera-not-found"):
    """The rig has no camera of this name. Name those that it has."""


class PoseRefusedError(SlrigError, code="pose-refused"):
    """A pose of the calibration board cannot be used: the board is not in view, is another one, moved, is too dark.
    Raise it if another pose, or the same one shot again, would do.
    """


class SolveRefusedError(SlrigError, code="solve-refused"):
    """The poses are usable one by one, but determine no calibration: too few, all parallel, contradictory. Name the
    poses, and what to shoot instead.
    """


class RegistrationRefusedError(SlrigError, code="registration-refused"):
    """Views are usable one by one, but cannot be put into one frame: too little overlap, or surfaces that do not agree.
    Name the views, and what to scan or to specify instead.
    """


class TurntableRefusedError(SlrigError, code="stage-refused"):
    """The poses of a turntable do not determine its axis or its planes, or cutting by them removes a whole view. Name
    the pose or the view, and what to shoot instead.
    """


class ViewsFailedError(SlrigError, code="views-failed"):
    """Too few of a model's views could be shot. Name those that failed, each with its cause."""


class CalibrationNotFoundError(SlrigError, code="calibration-not-found"):
    """No calibration, or no pose of one, of this id is on record here."""


class CalibrationStateError(SlrigError, code="calibration-state"):
    """The calibration exists, but its state forbids the call: activating one before it is solved, for example."""


class JobNotFoundError(SlrigError, code="job-not-found"):
    """No scan of this id is on record here."""


class PresetNotFoundError(SlrigError, code="preset-not-found"):
    """No preset has this name here, or none that can be deleted. Name the existing ones."""


class ArtefactNotReadyError(SlrigError, code="artefact-not-ready"):
    """The scan exists, but the requested file does not exist yet or never will (the scan failed)."""


class DamagedError(SlrigError, code="damaged"):
    """A file of a finished job is not as it was written: cut, changed or gone. It is not given out."""


class ScanStateError(SlrigError, code="scan-state"):
    """The scan exists, but its state forbids the call: deleting one that runs, for example."""


class LiveStateError(SlrigError, code="live-state"):
    """There is no live depth, one is under way already, or it is over."""


class RigFileChangedError(SlrigError, code="rig-file-changed"):
    """The rig file is not the one that a change was made of: it was changed meanwhile. Nothing is lost."""


class IdempotencyError(SlrigError, code="idempotency"):
    """An idempotency key was used again with another request body, or while the first request is in progress."""


class StorageError(SlrigError, code="storage"):
    """The disk refused: full, read-only, gone. The incomplete file has been removed."""


class DataFolderGoneError(StorageError, code="data-folder-gone"):
    """The service's data folder is missing: removed, renamed, or its disk is not mounted any more."""


class ServiceError(SlrigError, code="service"):
    """The slrig service, called by a client, could not be reached or answered with an unknown error."""


class CatalogueError(SlrigError, code="catalogue"):
    """The catalogue that rigs share cannot be reached, refuses, or does not exist. The rig goes on scanning, and its
    reports wait on its own disk.
    """


class WorkerLostError(SlrigError, code="worker-lost"):
    """The process that computes ended, or stopped responding, during a job: killed, stopped, or out of memory."""


class ExtraMissingError(SlrigError, code="extra-missing"):
    """The request needs a library that is not installed where slrig runs. Name the command that installs it."""


class WorkerBusyError(SlrigError, code="worker-busy"):
    """The process that computes has other work, or is not ready yet, and an answer would take too long. Try again
    later.
    """


class OutOfMemoryError(SlrigError, code="out-of-memory"):
    """A computation needs more memory than the machine has."""


class ScanInterruptedError(SlrigError, code="scan-interrupted"):
    """The service ended during this scan: stopped, killed, or without power. It was not cancelled: a cancelled one
    is a ScanCancelledError.
    """


class KeyInFlightError(IdempotencyError, code="key-in-flight"):
    """The first request with this idempotency key is in progress. The same key with another body is a plain
    IdempotencyError.
    """

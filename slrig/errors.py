"""Every error that slrig raises on purpose, in one tree.

A message names four things: what was asked, what was found, and what to do about it, in the words of the person who
reads it. Status codes and exit codes are decided at the edges (`slrig.api.problems`, `slrig.cli`), never here.
"""

from __future__ import annotations

from typing import ClassVar

_FLAGS = {
    "exposures_s": "exposure-s",
    "kind": "board",
    "line_shift_period_px": "period-px",
    "turned_by": "by-hand",
}
"""Flags of the command line that are not called as the setting is."""


def setting(name: str) -> str:
    """A setting in a message that may be read on a terminal or over HTTP: its key in requests and rig files, its flag.

    >>> setting("gray_cell_px")
    'gray_cell_px (--gray-cell-px)'
    """
    return f"{name} (--{_FLAGS.get(name, name.replace('_', '-'))})"


class SlrigError(Exception):
    """Base of the tree. Catch it at an edge; raise one of its children."""

    code: ClassVar[str] = "slrig"
    """What it is called over HTTP and in records, whatever becomes of the class's name. A child without one of its own
    is told as its parent."""

    def __init_subclass__(cls, *, code: str | None = None) -> None:
        super().__init_subclass__()
        if code is not None:
            cls.code = code


class InvalidInputError(SlrigError, code="invalid-input"):
    """Something a person wrote or sent cannot be used as it is. Raise a child that says what kind of thing it was."""


class ConfigError(InvalidInputError, code="config"):
    """A rig file, scene file or setting is wrong. All its faults belong in one message."""


class BundleError(InvalidInputError, code="bundle"):
    """A scan bundle's description or one of its frames is wrong: missing, cut, another size, an unknown key."""


class CalibrationError(InvalidInputError, code="calibration"):
    """A calibration is missing, malformed, not finite, or made for devices of another size."""


class PatternError(InvalidInputError, code="pattern"):
    """A pattern cannot be shown or decoded on this projector: too few bits, too small, an impossible period."""


class ScheduleError(InvalidInputError, code="schedule"):
    """A schedule cannot be kept: cron text that means nothing or never comes, an unknown zone, a negative grace."""


class ScheduleNotFoundError(SlrigError, code="schedule-not-found"):
    """No schedule of this id is on record here."""


class ScanEvidenceError(SlrigError, code="scan-evidence"):
    """The frames themselves contradict what they should show: white not brighter than black, a repeated frame,
    a bit that equals its inverse. Raise it when showing the same patterns again might help.
    """


class NothingToReconstructError(SlrigError, code="nothing-to-reconstruct"):
    """The frames are sound, and still hold no surface: nothing lit, nothing decoded, no stripe found."""


class DeviceError(SlrigError, code="device"):
    """A camera or projector did not do what it was told. Raise a child where one fits.

    place : the device and the call that it came of, told after the message; None where the message names them.
    """

    place: str | None = None

    def __str__(self) -> str:
        text = super().__str__()
        return text if self.place is None else f"{text} ({self.place})"


class DeviceGoneError(DeviceError, code="device-gone"):
    """The device was there and is not any more: unplugged, powered off. Reopening is the only way on."""


class DeviceBusyError(DeviceError, code="device-busy"):
    """Another program holds the device. Name the device, and the other program where the system tells it."""


class DeviceStateError(DeviceError, code="device-state"):
    """The call came in the wrong state: show before load, trigger before arm, anything after close.
    This is a fault of the caller, not of the device.
    """


class UnsupportedByDeviceError(DeviceError, code="unsupported-by-device"):
    """The device understood the request and cannot do it (an exposure out of range, a pattern of another size)."""


class WrongSystemError(UnsupportedByDeviceError, code="wrong-system"):
    """A driver is installed and speaks to its devices by what only another operating system has. Name that system."""


class FrameTimeoutError(DeviceError, code="frame-timeout"):
    """No frame that qualifies came in time. The device may be well: a late frame is not a lost device."""


class DriverNotFoundError(ConfigError, code="driver-not-found"):
    """A rig file names a driver that no installed package provides. Name those that are installed."""


class DriverBrokenError(DeviceError, code="driver-broken"):
    """A driver is installed and cannot be loaded. Name the package and the cause; other drivers keep working."""


class LibraryMissingError(DriverBrokenError, code="library-missing"):
    """A driver is installed and the library that it drives its devices with is not. Name the command that installs it:
    `install` is that command alone.
    """

    def __init__(self, message: str, *, install: str) -> None:
        super().__init__(message)
        self.install = install


class RigBusyError(SlrigError, code="rig-busy"):
    """The rig is held by another piece of work. Name the holder and since when."""

    def __init__(self, message: str, *, holder: str, since: str) -> None:
        super().__init__(message)
        self.holder = holder
        self.since = since


class QueueFullError(SlrigError, code="queue-full"):
    """The rig is held, and as many scans as are allowed to wait are waiting already."""


class ScanCancelledError(SlrigError, code="scan-cancelled"):
    """Somebody asked for this scan to stop. Not a failure."""


class CameraNotFoundError(SlrigError, code="camera-not-found"):
    """The rig has no camera of this name. Name those that it has."""


class PoseRefusedError(SlrigError, code="pose-refused"):
    """A pose of the calibration board cannot be used: the board is not in view, is another one, moved, is too dark.
    Raise it when another pose, or the same one shot again, would do.
    """


class SolveRefusedError(SlrigError, code="solve-refused"):
    """The poses are sound one by one, and together determine no calibration: too few, all parallel, contradictory.
    Name the poses, and what to shoot instead.
    """


class RegistrationRefusedError(SlrigError, code="registration-refused"):
    """Views are sound one by one, and cannot be put into one frame: too little overlap, or surfaces that do not agree.
    Name the views, and what to scan or to tell instead.
    """


class StageRefusedError(SlrigError, code="stage-refused"):
    """What was shot of a stage does not tell its axis or its planes, or a cut by them leaves nothing of a view.
    Name the pose or the view, and what to shoot instead.
    """


class ViewsFailedError(SlrigError, code="views-failed"):
    """Too few of a model's views could be shot. Name those that failed, each with its cause."""


class CalibrationNotFoundError(SlrigError, code="calibration-not-found"):
    """No calibration, or no pose of one, of this id is on record here."""


class CalibrationStateError(SlrigError, code="calibration-state"):
    """The calibration exists and is in a state that forbids the call: activating one before it is solved, say."""


class JobNotFoundError(SlrigError, code="job-not-found"):
    """No scan of this id is on record here."""


class PresetNotFoundError(SlrigError, code="preset-not-found"):
    """No preset has this name here, or none that could be deleted. Name those that there are."""


class ArtefactNotReadyError(SlrigError, code="artefact-not-ready"):
    """The scan exists, and the file asked for does not exist yet or never will (the scan failed)."""


class ScanStateError(SlrigError, code="scan-state"):
    """The scan exists and is in a state that forbids the call: deleting one that runs, for example."""


class IdempotencyError(SlrigError, code="idempotency"):
    """An idempotency key came again with another request body, or while the first one is still being answered."""


class StorageError(SlrigError, code="storage"):
    """The disk refused: full, read-only, gone. What was being written has been removed."""


class DataFolderGoneError(StorageError, code="data-folder-gone"):
    """The service's data folder is not where it was: removed, renamed, or its disk is not mounted any more."""


class ServiceError(SlrigError, code="service"):
    """The slrig service, asked as a client, could not be reached or answered with an error of its own."""


class CatalogueError(SlrigError, code="catalogue"):
    """The catalogue that rigs share cannot be reached, refuses, or there is none. The rig scans on: what it has to tell
    waits on its own disk.
    """


class WorkerLostError(SlrigError, code="worker-lost"):
    """The process that computes ended, or stood still, in the middle of its work: killed, stopped, or out of memory."""


class ExtraMissingError(SlrigError, code="extra-missing"):
    """What was asked for takes a library that is not installed where slrig runs. Name the command that installs it."""


class WorkerBusyError(SlrigError, code="worker-busy"):
    """The process that computes has other work, or is not ready yet, and somebody who waits for an answer would have
    to wait too long. Asking again helps.
    """


class OutOfMemoryError(SlrigError, code="out-of-memory"):
    """A computation asked for more memory than the machine gives."""


class ScanInterruptedError(SlrigError, code="scan-interrupted"):
    """The service ended while this scan was under way: stopped, killed, or without power. Nobody asked for that scan
    to stop; where somebody did, it is a ScanCancelledError.
    """


class KeyInFlightError(IdempotencyError, code="key-in-flight"):
    """The first request with this idempotency key is still being answered. Its sibling case, the same key with
    another body, is a plain IdempotencyError.
    """

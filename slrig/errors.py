"""Every error that slrig raises on purpose, in one tree.

A message names four things: what was asked, what was found, and what to do about it, in the words of the person who
reads it. Status codes and exit codes are decided at the edges (`slrig.api.problems`, `slrig.cli`), never here.
"""

from __future__ import annotations

from typing import ClassVar

_FLAGS = {"exposures_s": "exposure-s", "kind": "board", "line_shift_period_px": "period-px"}
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


class InvalidInputError(SlrigError):
    """Something a person wrote or sent cannot be used as it is. Raise a child that says what kind of thing it was."""

    code = "invalid-input"


class ConfigError(InvalidInputError):
    """A rig file, scene file or setting is wrong. All its faults belong in one message."""

    code = "config"


class BundleError(InvalidInputError):
    """A scan bundle's description or one of its frames is wrong: missing, cut, another size, an unknown key."""

    code = "bundle"


class CalibrationError(InvalidInputError):
    """A calibration is missing, malformed, not finite, or made for devices of another size."""

    code = "calibration"


class PatternError(InvalidInputError):
    """A pattern cannot be shown or decoded on this projector: too few bits, too small, an impossible period."""

    code = "pattern"


class ScheduleError(InvalidInputError):
    """A schedule cannot be kept: cron text that means nothing or never comes, an unknown zone, a negative grace."""

    code = "schedule"


class ScheduleNotFoundError(SlrigError):
    """No schedule of this id is on record here."""

    code = "schedule-not-found"


class ScanEvidenceError(SlrigError):
    """The frames themselves contradict what they should show: white not brighter than black, a repeated frame,
    a bit that equals its inverse. Raise it when showing the same patterns again might help.
    """

    code = "scan-evidence"


class NothingToReconstructError(SlrigError):
    """The frames are sound, and still hold no surface: nothing lit, nothing decoded, no stripe found."""

    code = "nothing-to-reconstruct"


class DeviceError(SlrigError):
    """A camera or projector did not do what it was told. Raise a child where one fits.

    place : the device and the call that it came of, told after the message; None where the message names them.
    """

    code = "device"
    place: str | None = None

    def __str__(self) -> str:
        text = super().__str__()
        return text if self.place is None else f"{text} ({self.place})"


class DeviceGoneError(DeviceError):
    """The device was there and is not any more: unplugged, powered off. Reopening is the only way on."""

    code = "device-gone"


class DeviceBusyError(DeviceError):
    """Another program holds the device. Name the device, and the other program where the system tells it."""

    code = "device-busy"


class DeviceStateError(DeviceError):
    """The call came in the wrong state: show before load, trigger before arm, anything after close.
    This is a fault of the caller, not of the device.
    """

    code = "device-state"


class UnsupportedByDeviceError(DeviceError):
    """The device understood the request and cannot do it (an exposure out of range, a pattern of another size)."""

    code = "unsupported-by-device"


class WrongSystemError(UnsupportedByDeviceError):
    """A driver is installed and speaks to its devices by what only another operating system has. Name that system."""

    code = "wrong-system"


class FrameTimeoutError(DeviceError):
    """No frame that qualifies came in time. The device may be well: a late frame is not a lost device."""

    code = "frame-timeout"


class DriverNotFoundError(ConfigError):
    """A rig file names a driver that no installed package provides. Name those that are installed."""

    code = "driver-not-found"


class DriverBrokenError(DeviceError):
    """A driver is installed and cannot be loaded. Name the package and the cause; other drivers keep working."""

    code = "driver-broken"


class LibraryMissingError(DriverBrokenError):
    """A driver is installed and the library that it drives its devices with is not. Name the command that installs it:
    `install` is that command alone.
    """

    code = "library-missing"

    def __init__(self, message: str, *, install: str) -> None:
        super().__init__(message)
        self.install = install


class RigBusyError(SlrigError):
    """The rig is held by another piece of work. Name the holder and since when."""

    code = "rig-busy"

    def __init__(self, message: str, *, holder: str, since: str) -> None:
        super().__init__(message)
        self.holder = holder
        self.since = since


class QueueFullError(SlrigError):
    """The rig is held, and as many scans as are allowed to wait are waiting already."""

    code = "queue-full"


class ScanCancelledError(SlrigError):
    """Somebody asked for this scan to stop. Not a failure."""

    code = "scan-cancelled"


class CameraNotFoundError(SlrigError):
    """The rig has no camera of this name. Name those that it has."""

    code = "camera-not-found"


class PoseRefusedError(SlrigError):
    """A pose of the calibration board cannot be used: the board is not in view, is another one, moved, is too dark.
    Raise it when another pose, or the same one shot again, would do.
    """

    code = "pose-refused"


class SolveRefusedError(SlrigError):
    """The poses are sound one by one, and together determine no calibration: too few, all parallel, contradictory.
    Name the poses, and what to shoot instead.
    """

    code = "solve-refused"


class CalibrationNotFoundError(SlrigError):
    """No calibration, or no pose of one, of this id is on record here."""

    code = "calibration-not-found"


class CalibrationStateError(SlrigError):
    """The calibration exists and is in a state that forbids the call: activating one before it is solved, say."""

    code = "calibration-state"


class JobNotFoundError(SlrigError):
    """No scan of this id is on record here."""

    code = "job-not-found"


class ArtefactNotReadyError(SlrigError):
    """The scan exists, and the file asked for does not exist yet or never will (the scan failed)."""

    code = "artefact-not-ready"


class ScanStateError(SlrigError):
    """The scan exists and is in a state that forbids the call: deleting one that runs, for example."""

    code = "scan-state"


class IdempotencyError(SlrigError):
    """An idempotency key came again with another request body, or while the first one is still being answered."""

    code = "idempotency"


class StorageError(SlrigError):
    """The disk refused: full, read-only, gone. What was being written has been removed."""

    code = "storage"


class ServiceError(SlrigError):
    """The slrig service, asked as a client, could not be reached or answered with an error of its own."""

    code = "service"


class WorkerLostError(SlrigError):
    """The process that computes ended, or stood still, in the middle of its work: killed, stopped, or out of memory."""

    code = "worker-lost"


class OutOfMemoryError(SlrigError):
    """A computation asked for more memory than the machine gives."""

    code = "out-of-memory"


class ScanInterruptedError(SlrigError):
    """The service ended while this scan was under way: stopped, killed, or without power. Nobody asked for that scan
    to stop; where somebody did, it is a ScanCancelledError.
    """

    code = "scan-interrupted"


class KeyInFlightError(IdempotencyError):
    """The first request with this idempotency key is still being answered. Its sibling case, the same key with
    another body, is a plain IdempotencyError.
    """

    code = "key-in-flight"

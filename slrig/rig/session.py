"""The rig of the service: opened once, kept, closed when a device fails, opened again for the next job. The count of
its turntable's turns is kept on disk.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import structlog
from pydantic import BaseModel, ValidationError

from slrig.bundle import check_calibration, require_two_rays, write_file
from slrig.devices import CameraInfo, ProjectorInfo, Rig, Turntable
from slrig.disk import storage_errors
from slrig.errors import (
    CalibrationError,
    CameraNotFoundError,
    DeviceBusyError,
    DeviceError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.failure import UNEXPECTED, JobFailure, job_failure
from slrig.model import Calibration, RotationAxis, Size
from slrig.rig.watchdog import OPEN, OPEN_LIMIT_S, Call, Calls, SettingsInUse, guarded

SAME_PLACE_DEG = 0.1
"""Largest change of a table's own count while closed: above any step of a motor, below any manual turn."""

FROM_THE_START = "start"
"""The count of a table that each opening brings to the same place."""


class _LastPosition(BaseModel):
    """Last known position of a table. at_deg : None while it turned. own_deg : by its own count."""

    count: str
    at_deg: float | None = None
    own_deg: float = 0.0


class CountedTurntable:
    """Implements `slrig.devices.Turntable` by another one with angles that count from its opening.

    A table with an unchanged own count continues from its angle. One that turned when the service was killed, or that
    has restarted its count, has angles unrelated to those from before: they are of another `count`. A manual turn of a
    table without a scale of its own is not noticed.

    count : equal for all angles with one zero. path : the file that keeps its position; its folder is made.
    """

    def __init__(self, table: Turntable, path: Path) -> None:
        self._table = table
        self._path = path
        self.count, self._offset_deg = FROM_THE_START, 0.0
        if table.opened_at_deg is not None:
            left = _left(path)
            if (
                left is not None
                and left.at_deg is not None
                and abs(left.own_deg - table.opened_at_deg) < SAME_PLACE_DEG
            ):
                self.count, self._offset_deg = left.count, left.at_deg + table.opened_at_deg - left.own_deg
            else:
                self.count = uuid4().hex
                _log.info("the turntable's angles have a new zero, its present position", count=self.count)

    @property
    def poses(self) -> Sequence[str]:
        """See `Positioner`."""
        return self._table.poses

    @property
    def axis(self) -> RotationAxis | None:
        """See `Turntable`."""
        return self._table.axis

    @property
    def angles_deg(self) -> Sequence[float]:
        """See `Turntable`."""
        return self._table.angles_deg

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`."""
        return self._table.opened_at_deg

    def move(self, index: int) -> None:
        """See `Positioner`."""
        if 0 <= index < len(self.angles_deg):
            self.turn(self.angles_deg[index])
        else:
            self._table.move(index)

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`. Raises StorageError, and turns nothing, where the disk refuses to keep that it turns."""
        opened_deg = self._table.opened_at_deg
        if opened_deg is None:
            self._table.turn(angle_deg)
            return
        own_deg = angle_deg - self._offset_deg
        self._keep(_LastPosition(count=self.count))
        self._table.turn(own_deg)
        # If that is refused, the next opening starts a new count.
        with suppress(StorageError):
            self._keep(_LastPosition(count=self.count, at_deg=angle_deg, own_deg=opened_deg + own_deg))

    def close(self) -> None:
        """See `Positioner`."""
        self._table.close()

    def _keep(self, position: _LastPosition) -> None:
        with storage_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
        write_file(self._path, position.model_dump_json().encode())


def _left(path: Path) -> _LastPosition | None:
    """Last position of the table, None where it is unknown or cannot be read."""
    try:
        return _LastPosition.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        _log.warning("where the turntable was left cannot be read", path=str(path), cause=str(error))
        return None


_LAST_RESORT_S = 1.0

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class RigFacts:
    """Facts that an open rig declares about itself: data that any thread may read.

    calibration : of the rig file, or of the head. positions : names of the poses of the machine that moves the board;
    none where a person does. turntable : whether it turns objects to any angle. axis : its axis as its maker states it,
    in the frame of `calibration`; None where that is not known. lost : as of `Rig`.
    """

    cameras: Mapping[str, CameraInfo]
    projector: ProjectorInfo
    calibration: Calibration | None
    positions: tuple[str, ...] = ()
    turntable: bool = False
    axis: RotationAxis | None = None
    lost: Mapping[str, str] = field(default_factory=dict)

    @property
    def sizes(self) -> Mapping[str, Size]:
        """The extent of each camera's frames."""
        return {name: camera.format.size for name, camera in self.cameras.items()}


@dataclass(frozen=True, slots=True)
class ActiveCalibration:
    """A calibration that takes the place of the rig's own. name : the id that it is on record by. calibration : None
    where its files are damaged, as `fault` says; no scan is taken then, with the rig's own neither.
    """

    name: str
    calibration: Calibration | None
    fault: str = ""


@contextmanager
def driver_errors(rig: str) -> Iterator[None]:
    """Convert the operating system's errors of a driver within the block into a DeviceError.

    Code that writes to a disk there has to raise StorageError itself.
    """
    try:
        yield
    except OSError as error:
        message = f"a driver of rig '{rig}' failed: {error}; check cable, power and permissions"
        raise DeviceError(message) from error


class RigSession:
    """A rig and the one thread that may touch it: all but `calls`, `facts`, `settings`, `fault`, `active`, `health`,
    `axis`, `calibration`, `misfit`, `refuse_misfit`, `use_calibration`, `give_up` and `darken_from_outside` belong to
    it.

    `active` replaces the rig's own calibration for all that begins afterwards. One that is for other
    devices leaves the rig without any: the rig can still be calibrated, and a scan is refused.

    table_at : the file that keeps a turntable's position, so that its angles go on from one opening to the next.
    """

    def __init__(
        self, name: str, open_rig: Callable[[], Rig], *, calls: Calls | None = None, table_at: Path | None = None
    ) -> None:
        self.name = name
        self._table_at = table_at
        self.calls = Calls() if calls is None else calls
        self._open_rig = open_rig
        self._rig: Rig | None = None
        self._bare: Rig | None = None
        self.facts: RigFacts | None = None
        self.settings: dict[str, SettingsInUse] = {}
        """Settings of each camera that was set since the rig was opened, by its name."""
        self.fault: JobFailure | None = None
        self.active: ActiveCalibration | None = None
        self.health: Callable[[], Mapping[str, Any] | None] = lambda: None
        """Health of the calibration in use, for the report of a scan; None before it was verified."""
        self._dropped = False

    def open(self) -> Rig:
        """Return the rig, opened if it is not open yet, perhaps without some of its cameras: see `Rig.lost`.
        Raises what the driver raises, an OSError as DeviceError.
        """
        self._drop_failed()
        if self._rig is None:
            self._dropped = False
            rig: Rig | None = None
            try:
                rig = self.calls.make(f"rig '{self.name}'", OPEN, OPEN_LIMIT_S, self._opened)
                self.settings = {}
                opened = guarded(rig, self.calls, self.settings)
                self.facts = self.calls.make(f"rig '{self.name}'", "info", OPEN_LIMIT_S, partial(_facts, opened))
            except Exception as error:
                self.fault = job_failure(error)
                if rig is not None:
                    self._close(rig)
                raise
            self._rig, self._bare = opened, rig
            for name, cause in rig.lost.items():
                _log.warning("a camera cannot be opened; the rig goes on without it", camera=name, cause=cause)
            if self._table_at is not None and isinstance(self._rig.positioner, Turntable):
                table = CountedTurntable(self._rig.positioner, self._table_at)
                self._rig = replace(self._rig, positioner=table)
            self.calls.failure = None
            self.fault = None
        active = self.active
        return self._rig if active is None else replace(self._rig, calibration=self._fitting(active))

    def open_whole(self) -> Rig:
        """As `open`, for work that needs every camera. Raises DeviceError: one cannot be opened."""
        rig = self.open()
        if rig.lost:
            message = f"this needs every camera of the rig: {'; '.join(rig.lost.values())}"
            raise DeviceError(message)
        return rig

    def find_lost(self) -> None:
        """Close a rig without some of its cameras, so that the next work opens it with those that are back."""
        if self._rig is not None and self._rig.lost:
            self.release()

    @property
    def axis(self) -> RotationAxis | None:
        """The turntable's axis as the rig knows it by itself, in the frame of the calibration in use; None where that
        is not the rig's own, or before the rig was open.
        """
        return None if self.facts is None or self.active is not None else self.facts.axis

    @property
    def calibration(self) -> Calibration | None:
        """The calibration of new work: the active one, or else the rig's own; None before the rig was open."""
        active = self.active
        if active is not None:
            return self._fitting(active)
        return None if self.facts is None else self.facts.calibration

    def require_camera(self, camera: str) -> RigFacts:
        """Return what the rig is; on any thread. Raises CameraNotFoundError: it has no such camera. DeviceError: it is
        not open, or not yet.
        """
        facts = self.facts
        if self.fault is not None:
            message = f"The rig cannot be opened: {self.fault.message}"
            raise DeviceError(message)
        if facts is None:
            message = "The rig is being opened. Try again in a moment."
            raise DeviceBusyError(message)
        if camera not in facts.cameras:
            message = f"The rig has no camera '{camera}'; it has {', '.join(facts.cameras)}."
            raise CameraNotFoundError(message)
        return facts

    def misfit(self, active: ActiveCalibration) -> CalibrationError | None:
        """Why a calibration cannot be used with the devices of this rig; None if it can, or before it was open."""
        if active.calibration is None:
            return CalibrationError(active.fault)
        if self.facts is None:
            return None
        try:
            source = f"calibration {active.name}"
            check_calibration(active.calibration, self.facts.projector.size, self.facts.sizes, source)
            require_two_rays(active.calibration, self.facts.sizes, source)
        except CalibrationError as error:
            return error
        return None

    def use_calibration(self, active: ActiveCalibration | None) -> None:
        """Use a calibration for work begun from now on; None for the rig's own. On any thread.

        Raises
        ------
        CalibrationError
            It is for other devices than those of the open rig.
        """
        # Before the rig is open its devices are unknown; a scan is then refused with the same message.
        fault = None if active is None or active.calibration is None else self.misfit(active)
        if fault is not None:
            raise fault
        self.active = active

    def _fitting(self, active: ActiveCalibration) -> Calibration | None:
        return None if self.misfit(active) else active.calibration

    def refuse_misfit(self) -> None:
        """Raise CalibrationError if the calibration in use is for other devices."""
        active = self.active
        error = None if active is None else self.misfit(active)
        if error is not None:
            message = f"{error}\nActivate another one (POST /calibration/ID/activate), or calibrate this rig."
            raise CalibrationError(message)

    def doubt(self, error: Exception) -> None:
        """Close the rig if an error leaves the state of its devices unknown; the next work opens them again."""
        failed = isinstance(error, DeviceError) and not isinstance(error, UnsupportedByDeviceError)
        if failed or job_failure(error).code == UNEXPECTED:
            self.release(error)

    def _opened(self) -> Rig:
        with driver_errors(self.name):
            return self._open_rig()

    def _drop_failed(self) -> None:
        """Close the rig after an unreported failure of a device, as at the end of a scan that had all its frames."""
        if self._rig is not None and self.calls.failure is not None:
            self.release(self.calls.failure)

    def open_for_checks(self) -> Rig:
        """Close the rig, and return it opened once more, for checks of its drivers. No watch is kept over its calls,
        and the caller closes it. May be called again afterwards. `recover` opens the rig as usual. Raises as `open`.
        """
        self.release()
        self._dropped = True
        self._bare = self._opened()
        if self._bare.lost:
            self._close(self._bare)
            raise DeviceError("; ".join(self._bare.lost.values()))
        return self._bare

    def reopen(self, open_rig: Callable[[], Rig], kept: Callable[[], None]) -> None:
        """Close every device, and open the rig by `open_rig` from now on. kept : called when it is open. The rig is
        opened as before where either fails. Raises what they raise.
        """
        before, self._open_rig = self._open_rig, open_rig
        self.release()
        try:
            self.open()
            kept()
        except BaseException:
            self._open_rig = before
            self.release()
            self.try_open()
            raise

    def try_open(self) -> Exception | None:
        """Open the rig, or return why it cannot be opened, which `fault` keeps. The next scan tries again."""
        try:
            self.open()
        except Exception as error:  # noqa: BLE001 - a driver may raise anything, and must not end the owner thread
            return error
        return None

    def recover(self) -> Exception | None:
        """Open the rig again, once, if it was closed because of a failure; return why that cannot be done."""
        self._drop_failed()
        return self.try_open() if self._dropped else None

    def darken(self) -> None:
        """Make the projector dark. If that fails, close all devices."""
        if self._rig is None:
            return
        try:
            with driver_errors(self.name):
                self._rig.projector.blank()
        except Exception as error:  # noqa: BLE001 - a driver may raise anything, and must not end the owner thread
            _log.error("the projector does not go dark; the rig is closed", rig=self.name, cause=repr(error))
            self.release(error)

    def darken_from_outside(self) -> None:
        """Try to make the projector dark past the thread that owns it: for when that one does not come back."""
        rig = self._bare
        if rig is None:
            return

        def darken() -> None:
            try:
                rig.projector.blank()
            except BaseException as error:  # noqa: BLE001 - nothing is left to be tried
                _log.error("the projector may still be lit", rig=self.name, cause=repr(error))

        # On a thread of its own: a driver that hangs may hold back this call as well.
        last_resort = threading.Thread(target=darken, name="slrig-dark", daemon=True)
        last_resort.start()
        last_resort.join(_LAST_RESORT_S)

    def release(self, error: BaseException | None = None) -> None:
        """Close every device. `error` says why, where that is a failure."""
        rig, self._rig = self._rig, None
        if error is not None:
            self.fault = job_failure(error)
        if rig is not None:
            self._dropped = error is not None
            self._close(rig)
            self._bare = None

    def give_up(self, call: Call) -> JobFailure:
        """Note that a call hangs, and return its fault. It ends the rig when it returns after all."""
        fault = self.fault = job_failure(DeviceError(call.hangs()))
        return fault

    def _close(self, rig: Rig) -> None:
        for fault in rig.close():
            _log.error("a device could not be closed in good order", rig=self.name, cause=repr(fault))


def _facts(rig: Rig) -> RigFacts:
    cameras = {name: camera.info for name, camera in rig.cameras.items()}
    positions = () if rig.positioner is None else tuple(rig.positioner.poses)
    table = rig.positioner if isinstance(rig.positioner, Turntable) else None
    axis = None if table is None else table.axis
    return RigFacts(cameras, rig.projector.info, rig.calibration, positions, table is not None, axis, rig.lost)

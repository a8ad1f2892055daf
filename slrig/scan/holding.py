"""The rig as the service holds it: opened once, kept, let go when a device vanishes, opened again for the next scan."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import structlog

from slrig.devices import CameraInfo, ProjectorInfo, Rig
from slrig.errors import DeviceError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size
from slrig.patterns.sequence import encode, scan_patterns
from slrig.scan.faults import ScanFault, fault_of
from slrig.scan.plan import PatternPlan, ScanPlan

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class RigFacts:
    """What an open rig declares about itself: data that any thread may read."""

    cameras: Mapping[str, CameraInfo]
    projector: ProjectorInfo
    calibrated: bool


@contextmanager
def driver_errors(rig: str) -> Iterator[None]:
    """Turn what the operating system tells a driver within the block into a DeviceError.

    Whatever writes to a disk there has to tell its refusals as StorageError itself.
    """
    try:
        yield
    except OSError as error:
        message = f"a driver of rig '{rig}' failed: {error}; check cable, power and permissions"
        raise DeviceError(message) from error


class HeldRig:
    """A rig and the one thread that may touch it: all but `facts`, `fault` and `darken_from_outside` belong to it."""

    def __init__(self, name: str, open_rig: Callable[[], Rig]) -> None:
        self.name = name
        self._open_rig = open_rig
        self._rig: Rig | None = None
        self.facts: RigFacts | None = None
        self.fault: ScanFault | None = None
        self._dropped = False

    def open(self) -> Rig:
        """Return the rig, opened if it is not open yet. Raises what the driver raises, an OSError as DeviceError."""
        if self._rig is None:
            self._dropped = False
            rig: Rig | None = None
            try:
                with driver_errors(self.name):
                    rig = self._open_rig()
                    cameras = {name: camera.info for name, camera in rig.cameras.items()}
                    self.facts = RigFacts(cameras, rig.projector.info, rig.calibration is not None)
            except Exception as error:
                self.fault = fault_of(error)
                if rig is not None:
                    self._close(rig)
                raise
            self._rig = rig
            self.fault = None
        return self._rig

    def try_open(self) -> Exception | None:
        """Open the rig, or return why it cannot be opened, which `fault` keeps. The next scan tries again."""
        try:
            self.open()
        except Exception as error:  # noqa: BLE001 - a driver may raise anything, and must not end the owner thread
            return error
        return None

    def recover(self) -> Exception | None:
        """Open the rig again, once, if it was let go because of a failure; return why that cannot be done."""
        return self.try_open() if self._dropped else None

    def darken(self) -> None:
        """Make the projector dark. One that will not is let go with all other devices."""
        if self._rig is None:
            return
        try:
            with driver_errors(self.name):
                self._rig.projector.blank()
        except Exception as error:  # noqa: BLE001 - a driver may raise anything, and must not end the owner thread
            _log.error("the projector does not go dark; the rig is closed", rig=self.name, cause=repr(error))
            self.let_go(error)

    def darken_from_outside(self) -> None:
        """Try to make the projector dark on a thread that does not own it: for when the owner never comes back."""
        rig = self._rig
        if rig is None:
            return
        try:
            rig.projector.blank()
        except Exception as error:  # noqa: BLE001 - nothing is left to be tried
            _log.error("the projector may still be lit", rig=self.name, cause=repr(error))

    def let_go(self, error: BaseException | None = None) -> None:
        """Close every device. `error` says why, where that is a failure."""
        rig, self._rig = self._rig, None
        if error is not None:
            self.fault = fault_of(error)
        if rig is not None:
            self._dropped = error is not None
            self._close(rig)

    def _close(self, rig: Rig) -> None:
        for fault in rig.close():
            _log.error("a device could not be closed in good order", rig=self.name, cause=repr(fault))


def pattern_sequence(plan: PatternPlan, size: Size) -> PatternSequence:
    """The patterns that a plan means on a projector of this size. Raises PatternError."""
    patterns = scan_patterns(
        size,
        line_shift=plan.line_shift,
        period_px=plan.line_shift_period_px,
        line_width_px=plan.line_width_px,
        gray_cell_px=plan.gray_cell_px,
        gray_offset_px=plan.gray_offset_px,
        rows=plan.rows,
    )
    return encode(patterns, size)


def check_plan(plan: ScanPlan, facts: RigFacts) -> int:
    """Return the bytes that the frames of a scan take on this rig, uncompressed.

    Raises
    ------
    PatternError
        The patterns do not fit the projector.
    UnsupportedByDeviceError
        A camera cannot expose that long, or that briefly.
    """
    count = len(pattern_sequence(plan.patterns, facts.projector.size))
    total = 0
    for name, camera in facts.cameras.items():
        least_s, most_s = camera.exposure_range_s
        if plan.exposure_s is not None and not least_s <= plan.exposure_s <= most_s:
            message = (
                f"exposure_s: {plan.exposure_s:g} s was asked for, camera '{name}' can do {least_s:g} s to "
                f"{most_s:g} s. Ask for a value in that range."
            )
            raise UnsupportedByDeviceError(message)
        size = camera.format.size
        total += count * size.width_px * size.height_px * (1 if camera.format.bit_depth <= 8 else 2)
    return total

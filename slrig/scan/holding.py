"""The rig as the service holds it: opened once, kept, let go when a device vanishes, opened again for the next scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import structlog

from slrig.devices import CameraInfo, ProjectorInfo, Rig
from slrig.errors import DeviceError, SlrigError, UnsupportedByDeviceError
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


class HeldRig:
    """A rig and the one thread that may touch it: all methods but `facts` and `fault` belong to that thread."""

    def __init__(self, name: str, open_rig: Callable[[], Rig]) -> None:
        self.name = name
        self._open_rig = open_rig
        self._rig: Rig | None = None
        self.facts: RigFacts | None = None
        self.fault: ScanFault | None = None

    def open(self) -> Rig:
        """Return the rig, opened if it is not open yet. Raises what the driver raises."""
        if self._rig is None:
            try:
                self._rig = self._open_rig()
            except Exception as error:
                self.fault = fault_of(error)
                raise
            rig = self._rig
            cameras = {name: camera.info for name, camera in rig.cameras.items()}
            self.facts = RigFacts(cameras, rig.projector.info, rig.calibration is not None)
            self.fault = None
        return self._rig

    def try_open(self) -> None:
        """Open the rig; a failure is kept in `fault` and logged, and the next scan tries again."""
        try:
            self.open()
        except SlrigError as error:
            _log.warning("the rig cannot be opened; the next scan tries again", rig=self.name, cause=str(error))
        except Exception:  # noqa: BLE001 - a driver may raise anything, and must not end the owner thread
            _log.exception("the rig's driver failed with an error of its own; the next scan tries again", rig=self.name)

    def darken(self) -> None:
        """Make the projector dark, whatever state the rig is in."""
        if self._rig is not None:
            with suppress(DeviceError):
                self._rig.projector.blank()

    def let_go(self, error: BaseException | None = None) -> None:
        """Close every device. `error` says why, where that is a failure."""
        rig, self._rig = self._rig, None
        if error is not None:
            self.fault = fault_of(error)
        if rig is not None:
            rig.close()


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

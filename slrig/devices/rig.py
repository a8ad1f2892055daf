"""A rig: cameras, a projector and an optional positioner that are opened, used and closed together."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from slrig.devices.camera import Camera, CameraSettings
from slrig.devices.projector import Projector
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Calibration, RotationAxis, Truth


@runtime_checkable
class Clock(Protocol):
    """Clock of a rig's time stamps."""

    def now_ns(self) -> int:
        """Return the current time, ns."""
        ...

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """Wait until `t_ns`, or until `stop` is set."""
        ...


@runtime_checkable
class HasClock(Protocol):
    """A head with its own clock in place of CLOCK_MONOTONIC, such as a rendered rig with virtual time."""

    @property
    def clock(self) -> Clock:
        """Clock of the time stamps of all devices of the head."""
        ...


class SystemClock:
    """CLOCK_MONOTONIC."""

    def now_ns(self) -> int:
        """See `Clock`."""
        return time.monotonic_ns()

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `Clock`."""
        while (left_ns := t_ns - self.now_ns()) > 0:
            if stop.wait(left_ns / 1e9):
                return


@runtime_checkable
class Positioner(Protocol):
    """A machine that moves the object or calibration board. It is used by the thread that owns the rig."""

    @property
    def poses(self) -> Sequence[str]:
        """Names of its poses, in the order in which to use them."""
        ...

    def move(self, index: int) -> None:
        """Move to a pose and return when the object is at rest.
        Raises UnsupportedByDeviceError: no such pose; the message lists all poses. DeviceError: the move failed.
        """
        ...

    def close(self) -> None:
        """Release the device. Idempotent."""
        ...


@runtime_checkable
class Turntable(Positioner, Protocol):
    """A positioner that turns the object about one axis to any angle. Its poses are angles."""

    @property
    def axis(self) -> RotationAxis | None:
        """The axis if the device knows it; None if it must be measured, as on real hardware."""
        ...

    @property
    def angles_deg(self) -> Sequence[float]:
        """Angle of each pose."""
        ...

    @property
    def opened_at_deg(self) -> float | None:
        """Angle in the device's own count when it was opened, which it keeps unless it was restarted or moved manually.
        None if opening brings it to a fixed position.
        """
        ...

    def turn(self, angle_deg: float) -> None:
        """Turn to an angle, right-handed about the axis from the position at opening, and return when the object is at
        rest. Raises DeviceError: the move failed.
        """
        ...


@runtime_checkable
class HasPositioner(Protocol):
    """A head that has a positioner."""

    @property
    def positioner(self) -> Positioner | None:
        """The positioner; None if the user moves the object."""
        ...


class TurntableBase(ABC):
    """Base of turntables: offers `count` evenly spaced angles from 0° as poses. Subclasses implement `turn`."""

    def __init__(self, count: int) -> None:
        self._angles_deg = tuple(360.0 * number / count for number in range(count))
        self._names = tuple(f"{angle_deg:g}°" for angle_deg in self._angles_deg)

    @property
    def poses(self) -> Sequence[str]:
        """See `Positioner`. The angles as text."""
        return self._names

    @property
    def angles_deg(self) -> Sequence[float]:
        """See `Turntable`."""
        return self._angles_deg

    def move(self, index: int) -> None:
        """See `Positioner`."""
        if not 0 <= index < len(self._names):
            message = (
                f"requested pose {index}, the turntable has poses 0 to {len(self._names) - 1}: "
                f"{', '.join(self._names)}; take one of them, or set another number of `poses` in the rig file"
            )
            raise UnsupportedByDeviceError(message)
        self.turn(self._angles_deg[index])

    @abstractmethod
    def turn(self, angle_deg: float) -> None:
        """See `Turntable`."""


@runtime_checkable
class ScannerHead(Protocol):
    """An instrument with cameras and projector: an integrated scanner, or the rendered rig."""

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras by name."""
        ...

    @property
    def projector(self) -> Projector:
        """The projector."""
        ...

    @property
    def calibration(self) -> Calibration | None:
        """Calibration stored in the instrument; None if there is none."""
        ...

    def truth(self) -> Truth | None:
        """Return the ground truth of a rendered scene; None for real hardware."""
        ...


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A connected device: its driver, its id for the rig file, and a label. options : further ones that its table
    needs, by the device's present state.
    """

    driver: str
    device: str
    label: str
    options: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Synchronisation:
    """Timing of a rig in its rig file, as `slrig latency` measures it.

    latency_s : mean time from the instant that the projector states to the change of light, by the cameras' time
    stamps; it includes the clock errors of both and may be negative. latency_error_s : latest end of a change after
    that, beyond the error that the projector states; negative if the projector overstates its error. earliest_s : time
    from the stated instant to the earliest start of a change; None if not measured, and then each pattern waits for the
    frames of the previous one. line_time_s : time between the exposures of adjacent rows of each camera with a rolling
    shutter; 0 or absent for a global shutter. stamp_error_s : error that each camera stated of its time stamps
    meanwhile: their unknown offset is part of the latency, and differs as this error does. trigger_period_s : shortest
    time between trigger pulses, written by the user if the cameras report none or a shorter one.
    """

    latency_s: float
    latency_error_s: float
    line_time_s: Mapping[str, float] = field(default_factory=dict)
    trigger_period_s: float | None = None
    earliest_s: float | None = None
    stamp_error_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Rig:
    """Open devices with settings, calibration and timing. A context manager that closes all devices on exit.

    `synchronisation` is None if latency was not measured. `clock` is the clock of all time stamps. `positioner` is None
    if the user moves the calibration board. `paces_s` : the time from pulse to pulse that worked by wire, by the time
    that patterns were lit and the time that was tried first; kept while the rig is open. `lost` : cameras of the rig
    file that could not be opened, and why.
    """

    name: str
    cameras: Mapping[str, Camera]
    projector: Projector
    settings: Mapping[str, CameraSettings]
    calibration: Calibration | None = None
    head: ScannerHead | None = field(default=None)
    synchronisation: Synchronisation | None = None
    clock: Clock = field(default_factory=SystemClock)
    positioner: Positioner | None = None
    paces_s: dict[tuple[float, float], float] = field(default_factory=dict)
    lost: Mapping[str, str] = field(default_factory=dict)

    def truth(self) -> Truth | None:
        """Return the ground truth of a rendered scene; None for real hardware."""
        return self.head.truth() if self.head is not None else None

    def close(self) -> tuple[BaseException, ...]:
        """Switch the light off, then close every device in any state. Return the exceptions that they raised."""
        faults: list[BaseException] = []
        steps: list[Callable[[], None]] = [self.projector.blank, self.projector.close]
        if self.positioner is not None:
            steps.append(self.positioner.close)
        for step in (*steps, *(camera.close for camera in self.cameras.values())):
            try:
                step()
            except BaseException as error:  # noqa: BLE001 - a driver may raise anything; close the other devices too
                faults.append(error)
        return tuple(faults)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

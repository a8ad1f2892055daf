"""A rig: cameras and a projector that are opened, used and closed together, and what moves a board before them."""

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
from slrig.model import Calibration, StageAxis, Truth


@runtime_checkable
class Clock(Protocol):
    """A rig's time, ns: that of its time stamps."""

    def now_ns(self) -> int:
        """The time now."""
        ...

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """Return when it is `t_ns` or later, or as soon as `stop` is set."""
        ...


@runtime_checkable
class HasClock(Protocol):
    """A head whose time stamps do not count in CLOCK_MONOTONIC, as that of a rendered rig on virtual time."""

    @property
    def clock(self) -> Clock:
        """The time of its devices."""
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
    """Moves an object, a calibration board among others, without a person.

    It puts an object where it is told. One thread uses it, the one that owns the rig.
    """

    @property
    def poses(self) -> Sequence[str]:
        """The poses that it can take, by name, in the order in which they are meant to be taken."""
        ...

    def move(self, index: int) -> None:
        """Take a pose and return when the object stands still.
        Raises UnsupportedByDeviceError: there is no such pose. Name those there are; DeviceError: it did not get there.
        """
        ...

    def close(self) -> None:
        """Let it go. Idempotent."""
        ...


@runtime_checkable
class Turntable(Positioner, Protocol):
    """A positioner that turns what stands on it about one axis, to any angle. Its poses are such angles."""

    @property
    def axis(self) -> StageAxis | None:
        """The axis, where the instrument knows it; None where it has to be found, as on metal."""
        ...

    @property
    def angles_deg(self) -> Sequence[float]:
        """The angle of each of its poses."""
        ...

    @property
    def opened_at_deg(self) -> float | None:
        """Where its own count stood when it was opened, in degrees of the table: as it was left, unless it restarted or
        was moved. None where each opening brings it to the same place.
        """
        ...

    def turn(self, angle_deg: float) -> None:
        """Stand at an angle, counted right-handed about the axis from where it stood when it was opened, and return
        when the object stands still. Raises DeviceError: it did not get there.
        """
        ...


@runtime_checkable
class HasPositioner(Protocol):
    """A head that has a positioner."""

    @property
    def positioner(self) -> Positioner | None:
        """What moves the object before it; None where a person does."""
        ...


class TurntableBase(ABC):
    """A turntable that turns to any angle, and offers `count` of them as poses, evenly round the axis from 0° on. What
    it is made of turns.
    """

    def __init__(self, count: int) -> None:
        self._angles_deg = tuple(360.0 * number / count for number in range(count))
        self._names = tuple(f"{angle_deg:g}°" for angle_deg in self._angles_deg)

    @property
    def poses(self) -> Sequence[str]:
        """See `Positioner`. The angles, as text."""
        return self._names

    @property
    def angles_deg(self) -> Sequence[float]:
        """See `Turntable`."""
        return self._angles_deg

    def move(self, index: int) -> None:
        """See `Positioner`."""
        if not 0 <= index < len(self._names):
            message = (
                f"asked for pose {index}, the turntable has poses 0 to {len(self._names) - 1}: "
                f"{', '.join(self._names)}; take one of them, or set another number of `poses` in the rig file"
            )
            raise UnsupportedByDeviceError(message)
        self.turn(self._angles_deg[index])

    @abstractmethod
    def turn(self, angle_deg: float) -> None:
        """See `Turntable`."""


@runtime_checkable
class ScannerHead(Protocol):
    """One instrument that is cameras and projector in one: an integrated scanner, or the rendered rig."""

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name."""
        ...

    @property
    def projector(self) -> Projector:
        """The projector."""
        ...

    @property
    def calibration(self) -> Calibration | None:
        """The calibration that the instrument carries, if it carries one."""
        ...

    def truth(self) -> Truth | None:
        """What the instrument knows of the scene before it; None on metal."""
        ...


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A device that is plugged in: the driver that can open it, the id to write into a rig file, and a label."""

    driver: str
    device: str
    label: str


@dataclass(frozen=True, slots=True)
class Synchronisation:
    """What a flash test found of a rig's timing, as its rig file keeps it.

    latency_s : from the instant that the projector states to the change of light, on average, as the cameras' time
    stamps see it; it holds what either of them states wrongly, and may be negative. latency_error_s : how much later
    than that a change may end, beyond the error that the projector states itself; negative where it states more than
    there is. earliest_s : from the stated instant to the earliest beginning of a change; None where nobody measured it,
    and then the next pattern is shown only when the frames before it are there. line_time_s : of each camera with a
    rolling shutter, from one row's exposure to the next row's; 0 or absent is a global shutter. trigger_period_s : what
    a person wrote: the least time from one trigger pulse to the next, where cameras tell a lower one or none.
    """

    latency_s: float
    latency_error_s: float
    line_time_s: Mapping[str, float] = field(default_factory=dict)
    trigger_period_s: float | None = None
    earliest_s: float | None = None


@dataclass(frozen=True, slots=True)
class Rig:
    """Open devices, with what is known about them. A context manager: leaving it darkens and closes everything.

    `synchronisation` is None where latency was not measured. All time stamps count in `clock`. `positioner` is None
    where a person moves the calibration board.
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

    def truth(self) -> Truth | None:
        """What a rendered rig knows of its scene; None on metal."""
        return self.head.truth() if self.head is not None else None

    def close(self) -> tuple[Exception, ...]:
        """Darken the projector, then close every device, whatever state each is in. Return what they raised."""
        faults: list[Exception] = []
        steps: list[Callable[[], None]] = [self.projector.blank, self.projector.close]
        if self.positioner is not None:
            steps.append(self.positioner.close)
        for step in (*steps, *(camera.close for camera in self.cameras.values())):
            try:
                step()
            except Exception as error:  # noqa: BLE001 - a driver may raise anything; the other devices are still closed
                faults.append(error)
        return tuple(faults)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

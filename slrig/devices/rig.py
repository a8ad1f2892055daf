"""A rig: cameras and a projector that are opened, used and closed together, and what moves a board before them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from slrig.devices.camera import Camera, CameraSettings
from slrig.devices.clock import Clock, SystemClock
from slrig.devices.positioner import Positioner
from slrig.devices.projector import Projector
from slrig.model import Calibration, Truth


@runtime_checkable
class Head(Protocol):
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
    head: Head | None = field(default=None)
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

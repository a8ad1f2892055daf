"""A rig: cameras and a projector that are opened, used and closed together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from slrig.devices.camera import Camera, CameraSettings
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
class Rig:
    """Open devices, with what is known about them. A context manager: leaving it darkens and closes everything."""

    name: str
    cameras: Mapping[str, Camera]
    projector: Projector
    settings: Mapping[str, CameraSettings]
    calibration: Calibration | None = None
    head: Head | None = field(default=None)

    def truth(self) -> Truth | None:
        """What a rendered rig knows of its scene; None on metal."""
        return self.head.truth() if self.head is not None else None

    def close(self) -> tuple[Exception, ...]:
        """Darken the projector, then close every device, whatever state each is in. Return what they raised."""
        faults: list[Exception] = []
        steps: list[Callable[[], None]] = [self.projector.blank, self.projector.close]
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

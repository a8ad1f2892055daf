"""What puts an object before the cameras: a motorised stage, a robot, a turntable, the rendered rig's script."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from slrig.errors import UnsupportedByDeviceError
from slrig.model import StageAxis


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

    def turn(self, angle_deg: float) -> None:
        """Stand at an angle, counted right-handed about the axis from where it stood when it was opened, and return
        when the object stands still. Raises DeviceError: it did not get there.
        """
        ...


@runtime_checkable
class Positions(Protocol):
    """A head that has a positioner."""

    @property
    def positioner(self) -> Positioner | None:
        """What moves the object before it; None where a person does."""
        ...


@dataclass(frozen=True, slots=True)
class EvenPoses:
    """The poses that a turntable offers where it can turn to any angle: `count` of them, evenly round the axis."""

    count: int

    @property
    def angles_deg(self) -> tuple[float, ...]:
        """From 0 on."""
        return tuple(360.0 * number / self.count for number in range(self.count))

    @property
    def names(self) -> tuple[str, ...]:
        """The angles, as text.

        >>> EvenPoses(3).names
        ('0°', '120°', '240°')
        """
        return tuple(f"{angle_deg:g}°" for angle_deg in self.angles_deg)

    def angle_deg(self, index: int) -> float:
        """The angle of a pose. Raises UnsupportedByDeviceError: there is no such pose."""
        if not 0 <= index < self.count:
            message = (
                f"asked for pose {index}, the turntable has poses 0 to {self.count - 1}: {', '.join(self.names)}; take "
                "one of them, or another number of `poses` in the rig file"
            )
            raise UnsupportedByDeviceError(message)
        return self.angles_deg[index]

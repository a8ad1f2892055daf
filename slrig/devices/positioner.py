"""What puts an object before the cameras: a motorised stage, a robot, a turntable, the rendered rig's script."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from slrig.errors import UnsupportedByDeviceError
from slrig.model import StageAxis


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
class Positions(Protocol):
    """A head that has a positioner."""

    @property
    def positioner(self) -> Positioner | None:
        """What moves the object before it; None where a person does."""
        ...


class AnyAngle(ABC):
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

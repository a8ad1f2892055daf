"""What moves a calibration board without a person: a motorised stage, a robot, the rendered rig's script."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable


class Positioner(Protocol):
    """Holds an object and puts it where it is told. One thread uses it, the one that owns the rig."""

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
class Positions(Protocol):
    """A head that has a positioner."""

    @property
    def positioner(self) -> Positioner | None:
        """What moves the object before it; None where a person does."""
        ...

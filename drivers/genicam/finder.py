"""Which GenICam cameras are plugged in."""

from __future__ import annotations

from drivers.genicam.connection import listed
from slrig.devices import FoundDevice


def find_devices() -> tuple[FoundDevice, ...]:
    """Every GigE Vision and USB3 Vision camera that answers; opens none.

    Raises
    ------
    LibraryMissingError
        Aravis or PyGObject is not installed.
    """
    return tuple(FoundDevice("genicam", identity, label) for identity, label in listed())

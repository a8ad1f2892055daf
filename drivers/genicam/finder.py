"""Which GenICam cameras are plugged in."""

from __future__ import annotations

from drivers.genicam import aravis, producers
from slrig.devices import FoundDevice


def find_devices() -> tuple[FoundDevice, ...]:
    """Every GigE Vision and USB3 Vision camera that answers Aravis; opens none.

    Raises
    ------
    LibraryMissingError
        Aravis or PyGObject is not installed.
    """
    return tuple(FoundDevice("genicam", identity, label) for identity, label in aravis.list_aravis_cameras())


def find_gentl_devices() -> tuple[FoundDevice, ...]:
    """Every camera that an installed GenTL producer sees; opens none.

    Raises
    ------
    LibraryMissingError
        harvesters is not installed.
    """
    return tuple(FoundDevice("gentl", identity, label) for identity, label in producers.list_gentl_cameras())

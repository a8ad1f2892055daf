"""A projector on a display output of this computer (HDMI, DisplayPort), without X or Wayland: by the kernel alone.

Linux. The driver has the graphics card for itself (it is "DRM master"), sets the projector's own mode, switches off
what scales, recolours or covers pictures, and flips from one to the next at a refresh. `t_visible` is the kernel's time
stamp of the flip + one refresh (the rows come one after the other) + the display's own delay, `latency_s`. Where the
graphics driver does not count refreshes (virtual machines, some adapters on USB), all that is known is when it was done
with the request; the stated error is larger by half of that time and of a refresh.

One program at a time has a graphics card: no desktop may run on it. What to do where one does is said by the error; to
list outputs (`slrig devices`), no card is opened.

A small process of its own keeps the output black between scans, after `close` and for `dark_after_s` after slrig has
ended, even by kill -9; then the text console comes back. It hands the card over to the next slrig of the same user. A
service manager that ends all processes of a service ends that one too (systemd: KillMode=process leaves it).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    # The guard is a module of this package, and starts in a tenth of the time without what they bring along.
    from collections.abc import Mapping
    from pathlib import Path

    from slrig.devices import FoundDevice, Projector

DRIVER = "kms"


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open a display output from a rig file's `[projector]` table (without driver).

    Parameters
    ----------
    options
        `drivers.kms.options.KmsOptions`.
    folder
        The rig file's own; unused, a display is not a file of the rig.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    WrongSystemError
        This is not Linux.
    UnsupportedByDeviceError
        The output cannot show patterns pixel for pixel, or there is none of that name.
    DeviceGoneError
        Nothing is connected to it.
    DeviceBusyError
        Another program has the graphics card.
    DeviceError
        This user may not open it, or the kernel refuses.
    """
    from drivers.kms.options import KmsOptions
    from drivers.linux import require_linux
    from slrig.bundle.validation import checked

    del folder
    told = checked(KmsOptions, options, "the [projector] table of driver 'kms'")
    require_linux(DRIVER, through="the kernel's display interface (DRM/KMS)", instead="use driver 'screen'")
    from drivers.display.projector import DisplayProjector
    from drivers.kms.output import KmsOutput

    return DisplayProjector(told, lambda: KmsOutput(told))


def find_devices() -> tuple[FoundDevice, ...]:
    """Return the outputs that a display may be connected to, as the kernel lists them; opens nothing."""
    from drivers.kms import finding
    from slrig.devices import FoundDevice

    there = [each for each in finding.connectors() if each.status != "disconnected"]
    return tuple(FoundDevice(DRIVER, each.name, str(each)) for each in there)


__all__ = ["find_devices", "open_projector"]

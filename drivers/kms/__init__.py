"""A projector on a display output of this computer (HDMI, DisplayPort) through the kernel, without X or Wayland.

Experimental: tested with a fake kernel and virtual graphics cards, not yet with a projector.

Linux only. The driver has the graphics card to itself (as "DRM master"), sets the projector's own mode, switches off
scaling, colour changes and overlays, and flips from one picture to the next at a refresh. `t_visible` is the kernel's
time stamp of the flip + one refresh (rows arrive one after the other) + the display's own delay, `latency_s`. Where the
graphics driver does not count refreshes (virtual machines, some adapters on USB), only the duration of the request is
known; the stated error is larger by half of that time and of a refresh.

One program at a time has a graphics card: no desktop may run on it. Where one does, the error states the remedy.
Listing outputs (`slrig devices`) opens no card.

A guard process keeps the output black between scans, after `close` and for `dark_after_s` after slrig has ended, even
by kill -9; then the text console returns. It passes the card on to the next slrig of the same user. A service manager
that ends all processes of a service ends that one too (systemd: KillMode=process leaves it).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    # The guard is a module of this package, and starts ten times as fast without these imports.
    from collections.abc import Mapping
    from pathlib import Path

    from slrig.devices import FoundDevice, Projector

DRIVER = "kms"


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open a display output from a rig file's `[projector]` table (without driver).

    Parameters
    ----------
    options
        `drivers.kms.card.KmsOptions`.
    folder
        The rig file's folder; unused.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    WrongSystemError
        This is not Linux.
    UnsupportedByDeviceError
        The output cannot show patterns pixel for pixel, or no output has that name.
    DeviceGoneError
        Nothing is connected to it.
    DeviceBusyError
        Another program has the graphics card.
    DeviceError
        This user may not open it, or the kernel refuses.
    """
    from drivers.kms.card import KmsOptions
    from drivers.linux import require_linux
    from slrig.bundle import validate

    del folder
    kms_options = validate(KmsOptions, options, "the [projector] table of driver 'kms'")
    require_linux(DRIVER, through="the kernel's display interface (DRM/KMS)", instead="use driver 'screen'")
    from drivers.display.projector import DisplayProjector
    from drivers.kms.output import KmsOutput

    return DisplayProjector(kms_options, lambda: KmsOutput(kms_options))


def find_devices() -> tuple[FoundDevice, ...]:
    """Return the outputs that a display may be connected to, as the kernel lists them; opens nothing."""
    from drivers.kms import finding
    from slrig.devices import FoundDevice

    found = [each for each in finding.list_connectors() if each.status != "disconnected"]
    return tuple(FoundDevice(DRIVER, each.name, str(each)) for each in found)


__all__ = ["find_devices", "open_projector"]

"""A projector on a display output of this computer (HDMI, DisplayPort, VGA), chosen by its connector's name.

Patterns are useful only if every pixel of the pattern is one pixel of the projector, with the requested brightness, on
that output alone, at a known time. So an output is refused, with the command that corrects it, where its mode is not
the projector's own raster, is rotated, transformed, panned or mirrored, where its gamma ramp or colour matrix is not
the identity (a night light), where a compositor draws the window, or where another program uses it. The display is kept
awake. One picture of each sequence is read back from the frame buffer and compared.

Through X (`backend = "x11"`, the default where there is an X server), flip times come from the Present extension:
t_visible is that stamp + one refresh (rows arrive one after the other) + the display's own delay, `latency_s`. Through
SDL (`backend = "sdl"`) only the time at which calls return is known; the stated error is larger by some refreshes, and
patterns take that much longer. On Wayland, Windows and macOS there is only SDL, and no program can find out what
happens to its pixels: refused unless `trust_compositor = true`, and nothing keeps the output black when slrig is
killed. Both need `pip install 'slrig[screen]'`, X also libxcb.

On X a guard process keeps the output black below the patterns, between scans, after `close` and for `dark_after_s`
after slrig has ended, even by kill -9. A service manager that ends all processes of a service ends that one too
(systemd: KillMode=process leaves it).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from slrig.bundle import validate
from slrig.devices import FoundDevice, Projector
from slrig.errors import DeviceError, LibraryMissingError

DRIVER = "screen"


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open a screen output from a rig file's `[projector]` table (without driver).

    Parameters
    ----------
    options
        `drivers.screen.options.ScreenOptions`.
    folder
        The rig file's folder; unused.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    LibraryMissingError
        xcffib, libxcb or PySDL2 is not installed, whichever is needed.
    UnsupportedByDeviceError
        The output would not show patterns pixel for pixel, or no output has that name.
    DeviceGoneError
        Nothing is connected to it.
    DeviceBusyError
        Another process shows patterns there.
    DeviceError
        No graphical session runs, or it refuses this user.
    """
    from drivers.display.projector import DisplayProjector
    from drivers.screen.options import ScreenOptions
    from drivers.screen.output import open_output

    del folder
    screen_options = validate(ScreenOptions, options, "the [projector] table of driver 'screen'")
    return DisplayProjector(screen_options, lambda: open_output(screen_options))


def find_devices() -> tuple[FoundDevice, ...]:
    """Return the outputs that a display is connected to; none without a graphical session.

    Raises
    ------
    LibraryMissingError
        xcffib, libxcb or PySDL2 is not installed, whichever is needed.
    """
    if sys.platform == "linux" and os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY"):
        return _x11_outputs()
    if sys.platform == "linux" and not os.environ.get("WAYLAND_DISPLAY"):
        return ()
    from drivers.screen.sdl import list_displays

    return tuple(
        FoundDevice(DRIVER, name, f"{name} ({size} at {rate_hz} Hz)") for name, size, rate_hz in list_displays()
    )


def _x11_outputs() -> tuple[FoundDevice, ...]:
    from drivers.screen.randr import list_outputs, require_randr
    from drivers.screen.x11 import XConnection

    try:
        connection = XConnection()
    except LibraryMissingError:
        raise
    except DeviceError:
        # DISPLAY names a server that does not run: no outputs.
        return ()
    try:
        require_randr(connection)
        connected = [output for output in list_outputs(connection, probe=True) if output.connected]
    finally:
        connection.close()
    return tuple(FoundDevice(DRIVER, output.name, str(output)) for output in connected)


__all__ = ["find_devices", "open_projector"]

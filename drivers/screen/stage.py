"""The stage of this machine: an output of its X server, or a full-screen window of SDL."""

from __future__ import annotations

import os
import sys

from drivers.display.stage import Stage
from drivers.display.timing import Presented
from drivers.screen.connection import Connection
from drivers.screen.options import ScreenOptions
from drivers.screen.present import EXTENSION, PresentSurface
from drivers.screen.sdl import SdlSurface, SdlWindow, fullscreen
from drivers.screen.station import Station
from slrig.errors import UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels

_XWAYLAND = "XWAYLAND"


class XStage:
    """An output of an X server."""

    def __init__(self, station: Station, surface: PresentSurface | SdlSurface) -> None:
        self._station = station
        self._surface = surface
        edid = station.output.edid
        self.size = station.picture.size
        self.refresh_s = station.refresh_s
        self.model = f"{str(edid) if edid is not None else 'display'} on {station.output.name}, {station.picture.mode}"
        self.serial = edid.serial if edid is not None and edid.serial else station.output.name

    def load(self, sequence: PatternSequence) -> None:
        """See `Stage`."""
        self._station.inspect(self._surface.window)
        self._surface.load(sequence)

    def show(self, index: int | None) -> Presented:
        """See `Stage`. Raises as `Station.ready` does; when going dark, only if the server is gone."""
        if index is not None:
            self._station.ready(self._surface.window)
        else:
            self._station.require_server()
        return self._surface.show(index)

    def compare(self, levels: Pixels) -> None:
        """See `Stage`."""
        self._station.compare(levels)

    def cover(self) -> bool:
        """See `Stage`."""
        return self._station.cover()

    def close(self) -> None:
        """See `Stage`."""
        self._station.cover()
        try:
            self._station.require_server()
            self._surface.close()
        finally:
            self._station.close()


def opened(options: ScreenOptions) -> Stage:
    """Return the output that a rig file describes, dark. On the thread that is to use it.

    Raises
    ------
    UnsupportedByDeviceError, DeviceGoneError, DeviceBusyError, DeviceError, LibraryMissingError
    """
    wayland = bool(os.environ.get("WAYLAND_DISPLAY")) and options.display is None
    if sys.platform != "linux" or wayland or not (options.display or os.environ.get("DISPLAY")):
        return _untold(options)
    connection = Connection(options.display)
    try:
        if connection.has(_XWAYLAND):
            _require_trust(options, "X on top of Wayland (XWayland)")
        station = Station(connection, options)
        try:
            return XStage(station, _surface(station, options))
        except BaseException:
            station.close()
            raise
    except BaseException:
        connection.close()
        raise


def _surface(station: Station, options: ScreenOptions) -> PresentSurface | SdlSurface:
    if options.backend == "x11" or (options.backend == "auto" and station.connection.has(EXTENSION)):
        return PresentSurface(station)
    if options.display not in (None, os.environ.get("DISPLAY")):
        message = (
            f"backend sdl takes its X server from the environment (DISPLAY={os.environ.get('DISPLAY')}), the rig file "
            f'asks for {options.display}; leave display out, or take backend = "x11"'
        )
        raise UnsupportedByDeviceError(message)
    return SdlSurface(station)


def _untold(options: ScreenOptions) -> SdlWindow:
    system = {"win32": "Windows", "darwin": "macOS"}.get(sys.platform, "a session without X (Wayland, a console)")
    if options.backend == "x11":
        message = f"backend x11 needs an X server, found {system}; log in to an X session, or set DISPLAY"
        raise UnsupportedByDeviceError(message)
    _require_trust(options, system)
    return fullscreen(options)


def _require_trust(options: ScreenOptions, system: str) -> None:
    if not options.trust_compositor:
        message = (
            f"output {options.output}: found {system}, where no program is told whether its pixels are scaled, tinted "
            "or delayed, or which output they go to; log in to an X session (Xorg), or start an X server for the "
            "projector alone. If you have seen that patterns come out right there (scaling 100 %, night light off, not "
            "mirrored), set trust_compositor = true"
        )
        raise UnsupportedByDeviceError(message)

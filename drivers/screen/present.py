"""Pictures shown through X's Present extension, which tells when each one was flipped to, or copied, at a refresh."""

from __future__ import annotations

import struct
import time
from itertools import count

import numpy as np

from drivers.display.timing import Presented, copied, flipped
from drivers.screen.requests import fill_tiled, free_pixmap, graphics_context, pixmap, put_levels
from drivers.screen.station import Station
from slrig.errors import DeviceError, UnsupportedByDeviceError
from slrig.model import Pattern, PatternSequence, Pixels, Size

EXTENSION = "Present"

_COMPLETE_NOTIFY, _COMPLETE_MASK = 1, 2
_GENERIC_EVENT = 35
_FLIP = (1, 3)
_PIXMAP = struct.Struct("<IIIIIhhIIIIxxxxQQQ")
_COMPLETED_IN_S = 1.0
_DARK: Pixels = np.zeros((1, 1), np.uint8)


class PresentSurface:
    """Shows patterns in a station's own window. The station's thread uses it."""

    def __init__(self, station: Station) -> None:
        connection = station.connection
        if not connection.has(EXTENSION):
            message = 'the X server has no Present extension; use Xorg 1.15 or later, or backend = "sdl"'
            raise UnsupportedByDeviceError(message)
        self._station = station
        self.window = station.window
        connection.ask(0, struct.pack("<II", 1, 0), extension=EXTENSION)
        self._events = connection.new_id()
        connection.do(3, struct.pack("<III", self._events, self.window, _COMPLETE_MASK), extension=EXTENSION)
        self._number = connection.number_of(EXTENSION)
        size = station.picture.size
        # One of them may be on its way to the display while the other one is drawn.
        self._pictures = (pixmap(connection, size), pixmap(connection, size))
        self._context = graphics_context(connection, self.window)
        self._dark = self._tile(_DARK)
        self._tiles: tuple[int, ...] = ()
        self._serials = count(1)

    def load(self, sequence: PatternSequence) -> None:
        """Give the server one tile for each pattern, of which it makes the whole."""
        tiles, self._tiles = self._tiles, ()
        for tile in tiles:
            free_pixmap(self._station.connection, tile)
        self._tiles = tuple(map(self._tile, sequence.profiles, sequence.patterns))

    def show(self, index: int | None) -> Presented:
        """Show a pattern of the sequence, None the dark, and return when that happened.

        Raises
        ------
        DeviceError
            The server did not say in time that it happened.
        """
        station, serial = self._station, next(self._serials)
        picture = self._pictures[serial % 2]
        tile = self._dark if index is None else self._tiles[index]
        fill_tiled(station.connection, picture, self._context, tile, station.picture.size)
        asked_ns = time.monotonic_ns()
        # Next refresh of this output's controller; no fences, no further windows.
        body = _PIXMAP.pack(self.window, picture, serial, 0, 0, 0, 0, station.picture.controller, 0, 0, 0, 0, 0, 0)
        station.connection.do(1, body, extension=EXTENSION)
        mode, stamp_ns = self._completed(serial)
        returned_ns = time.monotonic_ns()
        refresh_ns = round(station.refresh_s * 1e9)
        if not asked_ns - refresh_ns <= stamp_ns <= returned_ns + refresh_ns:
            # A driver that counts in another clock: it happened while we waited, that is all.
            return Presented(asked_ns, returned_ns + refresh_ns)
        return flipped(stamp_ns) if mode in _FLIP else copied(stamp_ns, station.refresh_s)

    def close(self) -> None:
        """Nothing remains: the server forgets all of it with the station's connection."""

    def _tile(self, profile: Pixels, pattern: Pattern | None = None) -> int:
        connection = self._station.connection
        tile = pixmap(connection, Size(profile.shape[1], profile.shape[0]))
        put_levels(connection, tile, self._context, profile, pattern)
        return tile

    def _completed(self, serial: int) -> tuple[int, int]:
        """How and when a picture was presented: (mode, ns)."""
        for event in self._station.await_event(_GENERIC_EVENT, _COMPLETED_IN_S):
            if event[1] != self._number or struct.unpack_from("<H", event, 8)[0] != _COMPLETE_NOTIFY:
                continue
            kind, mode, _, window, number, stamp_us = struct.unpack_from("<BBIIIQ", event, 10)
            if kind == 0 and window == self.window and number == serial:
                return mode, stamp_us * 1000
        message = (
            f"output {self._station.output.name} made no refresh in {_COMPLETED_IN_S:g} s: it is switched off, asleep, "
            "or its graphics driver hangs; see xrandr, and: xset dpms force on"
        )
        raise DeviceError(message)

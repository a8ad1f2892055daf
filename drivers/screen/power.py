"""Displays that go to sleep: told not to while a projector is open.

The server's MIT-SCREEN-SAVER extension suspends its saver and its power management (DPMS) for as long as the client
that asked is there: no crash leaves a machine whose displays never sleep. A server without it is told to switch both
off, and what was set is set again afterwards.
"""

from __future__ import annotations

import struct

from drivers.screen.connection import Connection
from slrig.errors import UnsupportedByDeviceError

_SAVER, _POWER = "MIT-SCREEN-SAVER", "DPMS"
_ON = 0
_ASLEEP = {1: "stand-by", 2: "suspended", 3: "off"}
_RESET = 0


class Waking:
    """Keeps the displays of a server awake until `end`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._suspends = False
        self._saver_was: tuple[int, int, int, int] | None = None
        self._power_was = False
        if connection.has(_SAVER):
            version = struct.unpack_from("<HH", connection.ask(0, struct.pack("<BBxx", 1, 1), extension=_SAVER), 8)
            self._suspends = version >= (1, 1)
        if self._suspends:
            connection.do(5, struct.pack("<I", 1), extension=_SAVER)
        else:
            timeout, interval, blanking, exposures = struct.unpack_from("<HHBB", connection.ask(108), 8)
            self._saver_was = (timeout, interval, blanking, exposures)
            connection.do(107, struct.pack("<hhBBxx", 0, interval, blanking, exposures))
            self._power_was = connection.has(_POWER) and self._power()[1]
            if self._power_was:
                connection.do(5, extension=_POWER)
        # One that sleeps already is woken: what is on it is black.
        connection.do(115, data=_RESET)
        if self.level() != _ON:
            connection.do(6, struct.pack("<Hxx", _ON), extension=_POWER)

    def level(self) -> int:
        """The power level of the displays: 0 is on."""
        return self._power()[0] if self._connection.has(_POWER) else _ON

    def require_awake(self) -> None:
        """See that the displays are on. Raises UnsupportedByDeviceError."""
        level = self.level()
        if level != _ON:
            message = (
                f"the displays are put to sleep ({_ASLEEP.get(level, level)}), by another program than the X server's "
                "own saver; switch automatic blanking off in the desktop's power settings, and: xset dpms force on"
            )
            raise UnsupportedByDeviceError(message)

    def end(self) -> None:
        """Let the displays sleep again as they were allowed to before."""
        if self._suspends:
            self._connection.do(5, struct.pack("<I", 0), extension=_SAVER)
        if self._saver_was is not None:
            self._connection.do(107, struct.pack("<hhBBxx", *self._saver_was))
        if self._power_was:
            self._connection.do(4, extension=_POWER)

    def _power(self) -> tuple[int, bool]:
        level, enabled = struct.unpack_from("<HB", self._connection.ask(7, extension=_POWER), 8)
        return int(level), bool(enabled)

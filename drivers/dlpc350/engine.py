"""What the DLPC350 understands beside `drivers.pattern_engine.engine`: its tables, and how it checks them.

Sources as there. The order of commands is that of TI's DLP SDK (lcr4500.cpp, `CreateSendStartSequenceLut`) and of TI's
demonstration of a pattern sequence.
"""

from __future__ import annotations

import struct
import time
from enum import IntEnum

from drivers.dlpc350.tables import PatternTables
from drivers.pattern_engine import engine
from drivers.pattern_engine.timing import Timing
from slrig.errors import UnsupportedByDeviceError


class Dlpc350Command(IntEnum):
    """USB commands."""

    VALIDATE = 0x1A1A
    PATTERN_SOURCE = 0x1A22  # 3 flash, 0 video input
    TRIGGER_MODE = 0x1A23  # 1: internal or external trigger
    EXPOSURE_PERIOD = 0x1A29  # 4 bytes each, µs
    PATTERN_CONFIGURATION = 0x1A31  # entries - 1, repeat, patterns to show - 1, pictures - 1
    MAILBOX_OFFSET = 0x1A32
    MAILBOX = 0x1A33  # 0 closed, 1 image table, 2 pattern table
    MAILBOX_DATA = 0x1A34
    IMAGES_IN_FLASH = 0x1A42
    FIRMWARE_TAG = 0x1AFF


VALIDATION_FAULTS = {
    1: "the exposure or the period is not one that it can do",
    2: "a pattern number in the table is not one that it has",
    4: "the trigger output would be held on through a dark between",
    8: "the dark between is missing in the table",
    16: "exposure and period differ by less than 230 µs",
}
_BUSY = 0x80
_EDGE_NS = 107.2
_EDGE_ZERO = 0xBB
_EDGES = (0, 0xD5)


class Dlpc350Engine(engine.UsbEngine):
    """A DLPC350 behind a link."""

    def set_trigger_out(self, *, active_low: bool, delay_us: float) -> None:
        """Set TRIG_OUT_1: its edges, later than the pattern's light by the delay, in steps of 107.2 ns."""
        edge = min(max(_EDGE_ZERO + round(delay_us * 1e3 / _EDGE_NS), _EDGES[0]), _EDGES[1])
        self._link.write(engine.UsbCommand.TRIGGER_OUT_1, bytes([active_low, edge, edge]))

    def set_timing(self, timing: Timing) -> None:
        """Set exposure and period of all patterns; compare what is read back."""
        self.settle(Dlpc350Command.EXPOSURE_PERIOD, struct.pack("<II", timing.exposure_us, timing.period_us))

    def set_tables(self, tables: PatternTables, before: PatternTables | None = None) -> None:
        """Send the tables of a sequence that is shown once. before : those that the engine has, if that is known; only
        what differs is sent.
        """
        if before is None or tables.patterns != before.patterns:
            self._mail(2, tables.patterns)
        if before is None or tables.images != before.images:
            self._mail(1, tables.images)
        if before is None or (tables.length, len(tables.images)) != (before.length, len(before.images)):
            entries = tables.length - 1
            self._link.write(Dlpc350Command.PATTERN_CONFIGURATION, bytes([entries, 0, entries, len(tables.images) - 1]))

    def _mail(self, mailbox: int, data: bytes) -> None:
        self.set_byte(Dlpc350Command.MAILBOX, mailbox)
        try:
            self.set_byte(Dlpc350Command.MAILBOX_OFFSET, 0)
            self._link.write(Dlpc350Command.MAILBOX_DATA, data)
        finally:
            self.set_byte(Dlpc350Command.MAILBOX, 0)

    def validate(self, timeout_s: float) -> None:
        """Let the engine check what it was told.

        Raises
        ------
        UnsupportedByDeviceError
            It found something wrong, and says what.
        DeviceError
            It did not come to an end in time.
        """
        self.set_byte(Dlpc350Command.VALIDATE, 0)
        until = time.monotonic() + timeout_s
        while (found := self.byte(Dlpc350Command.VALIDATE)) & _BUSY:
            self._wait(until, "come to an end with checking the sequence")
        if found:
            causes = (
                "; ".join(words for bit, words in VALIDATION_FAULTS.items() if found & bit) or f"status {found:#04x}"
            )
            message = f"{self.name} refuses the sequence: {causes}; report this message to the driver's maintainer"
            raise UnsupportedByDeviceError(message)

    def firmware_tag(self) -> str:
        """The name that was given to what lies in the flash, at most 32 characters."""
        return (
            self._link.read(Dlpc350Command.FIRMWARE_TAG, 1)[:32].split(b"\0", 1)[0].decode("ascii", "replace").strip()
        )

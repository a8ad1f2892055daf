"""What the controller understands, in words: each method is one of its commands, with what it answers.

Numbers are CMD2 and CMD3 of the DLPC350's programmer's guide (DLPU010) as TI's own sources have them (dlpc350_api.cpp,
`CmdList`, in github.com/jakobwilm/slstudio under src/projector/LC4500API); the order of commands is that of TI's DLP
SDK (lcr4500.cpp, `CreateSendStartSequenceLut`) and of TI's demonstration of a pattern sequence.
"""

from __future__ import annotations

import struct
import threading
import time
from enum import IntEnum, IntFlag

from drivers.dlpc350.link import Link
from drivers.dlpc350.tables import Tables
from drivers.dlpc350.timing import Timing
from slrig.errors import DeviceError, UnsupportedByDeviceError


class Command(IntEnum):
    """USB commands."""

    POWER = 0x0200  # 1 standby, 0 normal
    LED_CURRENT = 0x0B01  # red, green, blue: 8 bits each
    FLIP_LONG = 0x1008  # 1: mirrored about the long axis
    FLIP_SHORT = 0x1009
    LED_POLARITY = 0x1A05  # bit 0: PWM inverted
    LED_ENABLE = 0x1A07  # bits 0-2 red, green, blue; bit 3: the sequence decides, not these
    HARDWARE_STATUS = 0x1A0A
    SYSTEM_STATUS = 0x1A0B
    MAIN_STATUS = 0x1A0C
    VALIDATE = 0x1A1A
    DISPLAY_MODE = 0x1A1B  # 1 patterns, 0 video
    TRIGGER_OUT_1 = 0x1A1D  # polarity, delay of the rising edge, of the falling edge
    PATTERN_SOURCE = 0x1A22  # 3 flash, 0 video input
    TRIGGER_MODE = 0x1A23  # 1: internal or external trigger
    START_STOP = 0x1A24  # 0 stop, 1 pause, 2 start
    EXPOSURE_PERIOD = 0x1A29  # 4 bytes each, µs
    INVERT_DATA = 0x1A30
    PATTERN_CONFIGURATION = 0x1A31  # entries - 1, repeat, patterns to show - 1, pictures - 1
    MAILBOX_OFFSET = 0x1A32
    MAILBOX = 0x1A33  # 0 closed, 1 image table, 2 pattern table
    MAILBOX_DATA = 0x1A34
    IMAGES_IN_FLASH = 0x1A42
    FIRMWARE_TAG = 0x1AFF


class Main(IntFlag):
    """Main status."""

    PARKED = 1
    RUNNING = 2
    FROZEN = 4
    GAMMA = 8


class Hardware(IntFlag):
    """Hardware status. INITIALISED is well when set, the others when not."""

    INITIALISED = 1
    RESET_CONTROLLER = 4
    FORCED_SWAP = 8
    ABORTED = 64
    SEQUENCER = 128


FAULTS = {
    Hardware.RESET_CONTROLLER: "the mirrors' reset controller failed (several resets at once)",
    Hardware.FORCED_SWAP: "a picture was taken before it was loaded",
    Hardware.ABORTED: "the sequence was aborted",
    Hardware.SEQUENCER: "the sequencer failed",
}
INVALID = {
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
_ASK_AGAIN_S = 0.005


class Engine:
    """The controller behind a link. Every method raises DeviceError and DeviceGoneError as the link does."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._never = threading.Event()

    @property
    def name(self) -> str:
        """Words for it, for messages."""
        return self._link.name

    def close(self) -> None:
        """Let the link go. Idempotent."""
        self._link.close()

    def set_byte(self, command: Command, value: int) -> None:
        """Set a register of one byte."""
        self._link.write(command, bytes([value]))

    def byte(self, command: Command) -> int:
        """Return a register of one byte."""
        return self._link.read(command, 1)[0]

    def settle_byte(self, command: Command, value: int) -> None:
        """Set a register of one byte and read it back. Raises UnsupportedByDeviceError if it says otherwise."""
        self.set_byte(command, value)
        self._same(command, bytes([value]), self._link.read(command, 1)[:1])

    def leds(self, *, by_sequence: bool) -> None:
        """Let the sequence switch the LEDs, or switch them all off."""
        self.set_byte(Command.LED_ENABLE, 8 if by_sequence else 0)

    def set_led_current(self, colours: int, current: int, *, inverted: bool) -> None:
        """Set the current of the LEDs in `colours` (0 to 255), and none of the others; compare what is read back."""
        wanted = [current if colours & bit else 0 for bit in (1, 2, 4)]
        # The register's polarity turns the sense of the values around once more.
        if inverted != bool(self.byte(Command.LED_POLARITY) & 1):
            wanted = [255 - value for value in wanted]
        self._link.write(Command.LED_CURRENT, bytes(wanted))
        self._same(Command.LED_CURRENT, bytes(wanted), self._link.read(Command.LED_CURRENT, 3)[:3])

    def set_trigger_out(self, *, active_low: bool, delay_us: float) -> None:
        """Set TRIG_OUT_1: its edges, later than the pattern's light by the delay, in steps of 107.2 ns."""
        edge = min(max(_EDGE_ZERO + round(delay_us * 1e3 / _EDGE_NS), _EDGES[0]), _EDGES[1])
        self._link.write(Command.TRIGGER_OUT_1, bytes([active_low, edge, edge]))

    def start(self) -> None:
        """Start the sequence that was validated."""
        self.set_byte(Command.START_STOP, 2)

    def stop(self) -> None:
        """Stop the sequence; the next start begins it anew."""
        self.set_byte(Command.START_STOP, 0)

    def set_timing(self, timing: Timing) -> None:
        """Set exposure and period of all patterns; compare what is read back."""
        data = struct.pack("<II", timing.exposure_us, timing.period_us)
        self._link.write(Command.EXPOSURE_PERIOD, data)
        self._same(Command.EXPOSURE_PERIOD, data, self._link.read(Command.EXPOSURE_PERIOD, len(data))[: len(data)])

    def set_tables(self, tables: Tables) -> None:
        """Send the tables of a sequence that is shown once."""
        for mailbox, data in ((2, tables.patterns), (1, tables.images)):
            self.set_byte(Command.MAILBOX, mailbox)
            try:
                self.set_byte(Command.MAILBOX_OFFSET, 0)
                self._link.write(Command.MAILBOX_DATA, data)
            finally:
                self.set_byte(Command.MAILBOX, 0)
        entries = tables.length - 1
        self._link.write(Command.PATTERN_CONFIGURATION, bytes([entries, 0, entries, len(tables.images) - 1]))

    def validate(self, timeout_s: float) -> None:
        """Let the engine check what it was told.

        Raises
        ------
        UnsupportedByDeviceError
            It found something wrong, and says what.
        DeviceError
            It did not come to an end in time.
        """
        self.set_byte(Command.VALIDATE, 0)
        until = time.monotonic() + timeout_s
        while (found := self.byte(Command.VALIDATE)) & _BUSY:
            self._wait(until, "come to an end with checking the sequence")
        if found:
            causes = "; ".join(words for bit, words in INVALID.items() if found & bit) or f"status {found:#04x}"
            message = f"{self.name} refuses the sequence: {causes}; report this message to the driver's maintainer"
            raise UnsupportedByDeviceError(message)

    def wait_until_running(self, timeout_s: float) -> None:
        """Return when the sequencer says that it runs. Raises DeviceError if it does not in time."""
        until = time.monotonic() + timeout_s
        while not self.byte(Command.MAIN_STATUS) & Main.RUNNING:
            self._wait(until, "start the sequence")

    def wait_until_initialised(self, timeout_s: float) -> None:
        """Return when the engine is ready for commands. Raises DeviceError if it is not in time."""
        until = time.monotonic() + timeout_s
        while not self.byte(Command.HARDWARE_STATUS) & Hardware.INITIALISED:
            self._wait(until, "finish its initialisation")

    def firmware_tag(self) -> str:
        """The name that was given to what lies in the flash, at most 32 characters."""
        return self._link.read(Command.FIRMWARE_TAG, 1)[:32].split(b"\0", 1)[0].decode("ascii", "replace").strip()

    def _same(self, command: Command, asked: bytes, got: bytes) -> None:
        if asked != got:
            name = command.name.lower().replace("_", " ")
            message = f"{self.name}: asked for {name} {asked.hex(' ')}, the engine gives {got.hex(' ')}; "
            message += "switch it off and on, and update its firmware to 3.0 or later"
            raise UnsupportedByDeviceError(message)

    def _wait(self, until: float, what: str) -> None:
        if time.monotonic() > until:
            status = self.byte(Command.HARDWARE_STATUS)
            faults = [words for bit, words in FAULTS.items() if status & bit]
            told = "; ".join(faults) or "nothing is wrong"
            message = (
                f"{self.name} did not {what} in time, and says: {told} (hardware status {status:#04x}); switch it "
            )
            message += "off and on"
            raise DeviceError(message)
        self._never.wait(_ASK_AGAIN_S)

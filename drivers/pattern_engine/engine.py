"""What both controllers understand, in words: each method is one of their commands, with what it answers.

Numbers are CMD2 and CMD3. For the DLPC350: its programmer's guide (DLPU010) and TI's own sources (dlpc350_api.cpp,
`CmdList`, in github.com/jakobwilm/slstudio under src/projector/LC4500API). For the DLPC900: its programmer's guide
(DLPU018, revisions F and J) and TI's own sources (API.c of TI's program for it, `CmdList`, in
github.com/RhojAnn/DLPC900_CLI under lib).
"""

from __future__ import annotations

import threading
import time
from enum import IntEnum, IntFlag

from drivers.pattern_engine.link import UsbLink
from slrig.errors import DeviceError, UnsupportedByDeviceError


class UsbCommand(IntEnum):
    """USB commands of both."""

    POWER = 0x0200  # 1 standby, 0 normal
    LED_CURRENT = 0x0B01  # red, green, blue: 8 bits each
    FLIP_LONG = 0x1008  # 1: mirrored about the long axis
    FLIP_SHORT = 0x1009
    LED_POLARITY = 0x1A05  # bit 0: PWM inverted
    LED_ENABLE = 0x1A07  # bits 0-2 red, green, blue; bit 3: the sequence decides, not these
    HARDWARE_STATUS = 0x1A0A
    MAIN_STATUS = 0x1A0C
    DISPLAY_MODE = 0x1A1B
    TRIGGER_OUT_1 = 0x1A1D
    START_STOP = 0x1A24  # 0 stop, 1 pause, 2 start
    INVERT_DATA = 0x1A30


class MainStatus(IntFlag):
    """Main status."""

    PARKED = 1
    RUNNING = 2


class HardwareStatus(IntFlag):
    """Hardware status. INITIALISED is well when set, the others when not."""

    INITIALISED = 1
    RESET_CONTROLLER = 4
    FORCED_SWAP = 8
    ABORTED = 64
    SEQUENCER = 128


FAULTS = {
    HardwareStatus.RESET_CONTROLLER: "the mirrors' reset controller failed (several resets at once)",
    HardwareStatus.FORCED_SWAP: "a picture was taken before it was loaded",
    HardwareStatus.ABORTED: "the sequence was aborted",
    HardwareStatus.SEQUENCER: "the sequencer failed",
}
_ASK_AGAIN_S = 0.005


class UsbEngine:
    """The controller behind a link. Every method raises DeviceError and DeviceGoneError as the link does."""

    def __init__(self, link: UsbLink) -> None:
        self._link = link
        self._never = threading.Event()

    @property
    def name(self) -> str:
        """Words for it, for messages."""
        return self._link.name

    def close(self) -> None:
        """Let the link go. Idempotent."""
        self._link.close()

    def set_byte(self, command: int, value: int) -> None:
        """Set a register of one byte."""
        self._link.write(command, bytes([value]))

    def byte(self, command: int) -> int:
        """Return a register of one byte."""
        return self._link.read(command, 1)[0]

    def settle_byte(self, command: IntEnum, value: int, *, within_s: float = 0.0) -> None:
        """Set a register of one byte and read it back. Raises UnsupportedByDeviceError if it says otherwise."""
        self.settle(command, bytes([value]), within_s=within_s)

    def settle(self, command: IntEnum, data: bytes, *, within_s: float = 0.0) -> None:
        """Set a register and compare what is read back, within some time. Raises UnsupportedByDeviceError if that is
        something else.
        """
        self._link.write(command, data)
        until = time.monotonic() + within_s
        while (got := self._link.read(command, len(data))[: len(data)]) != data and time.monotonic() < until:
            self._never.wait(_ASK_AGAIN_S)
        if got != data:
            name = command.name.lower().replace("_", " ")
            message = f"{self.name}: asked for {name} {data.hex(' ')}, the engine gives {got.hex(' ')}; "
            message += f"switch it off and on, and update its firmware to {self._link.kind.firmware} or later"
            raise UnsupportedByDeviceError(message)

    def leds(self, *, by_sequence: bool) -> None:
        """Let the sequence switch the LEDs, or switch them all off."""
        self.set_byte(UsbCommand.LED_ENABLE, 8 if by_sequence else 0)

    def set_led_current(self, colours: int, current: int, *, inverted: bool) -> None:
        """Set the current of the LEDs in `colours` (0 to 255), and none of the others; compare what is read back."""
        wanted = [current if colours & bit else 0 for bit in (1, 2, 4)]
        # The register's polarity turns the sense of the values around once more.
        if inverted != self.led_polarity_turned:
            wanted = [255 - value for value in wanted]
        self.set_led_registers(bytes(wanted))

    @property
    def led_polarity_turned(self) -> bool:
        """Whether the register of the polarity is set."""
        return bool(self.byte(UsbCommand.LED_POLARITY) & 1)

    def set_led_registers(self, values: bytes) -> None:
        """Set the registers of red, green and blue, whatever their values mean; compare what is read back."""
        self.settle(UsbCommand.LED_CURRENT, values)

    def start(self) -> None:
        """Start the sequence that was set."""
        self.set_byte(UsbCommand.START_STOP, 2)

    def stop(self) -> None:
        """Stop the sequence; the next start begins it anew."""
        self.set_byte(UsbCommand.START_STOP, 0)

    def wait_until_running(self, timeout_s: float) -> None:
        """Return when the sequencer says that it runs. Raises DeviceError if it does not in time."""
        until = time.monotonic() + timeout_s
        while not self.byte(UsbCommand.MAIN_STATUS) & MainStatus.RUNNING:
            self._wait(until, "start the sequence")

    def wait_until_initialised(self, timeout_s: float) -> None:
        """Return when the engine is ready for commands. Raises DeviceError if it is not in time."""
        until = time.monotonic() + timeout_s
        while not self.byte(UsbCommand.HARDWARE_STATUS) & HardwareStatus.INITIALISED:
            self._wait(until, "finish its initialisation")

    def faults(self) -> str:
        """What the hardware status complains of, in words; empty if of nothing."""
        status = self.byte(UsbCommand.HARDWARE_STATUS)
        return "; ".join(words for bit, words in FAULTS.items() if status & bit)

    def _wait(self, until: float, what: str) -> None:
        if time.monotonic() > until:
            told = self.faults() or "nothing is wrong"
            message = f"{self.name} did not {what} in time, and says: {told}; switch it off and on"
            raise DeviceError(message)
        self._never.wait(_ASK_AGAIN_S)

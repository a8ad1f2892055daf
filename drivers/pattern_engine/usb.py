"""USB pattern engines."""

from __future__ import annotations

import errno
import os
import re
import select
import struct
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from pathlib import Path

from drivers.linux import require_linux
from slrig.devices import FoundDevice
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    UnsupportedByDeviceError,
)

REPORT = 64
HEADER = 4
READ, ANSWER, FAILED = 0x80, 0x40, 0x20
MAX_DATA = 512 - HEADER
"""The engine's buffer holds 512 bytes of a message (DLPU018 §1.2)."""

ANSWER_TIMEOUT_S = 1.0
_RAW_INFO = 0x8008_4803
"""HIDIOCGRAWINFO: bus type, vendor, product (include/uapi/linux/hidraw.h)."""

TI = 0x0451


_GONE = {errno.EIO, errno.ENODEV, errno.ENXIO, errno.EPIPE, errno.ESHUTDOWN, errno.ECONNRESET}
SYSFS = Path("/sys/class/hidraw")
DEV = Path("/dev")
_ASK_AGAIN_S = 0.005


@dataclass(frozen=True, slots=True)
class UsbController:
    """A controller on USB. driver : slrig's; product : its id under TI's; firmware : the oldest that serves."""

    driver: str
    product: int
    firmware: str

    @property
    def udev_rule(self) -> str:
        """The line that lets a user open it."""
        return (
            f'KERNEL=="hidraw*", ATTRS{{idVendor}}=="{TI:04x}", ATTRS{{idProduct}}=="{self.product:04x}", '
            'MODE="0660", TAG+="uaccess"'
        )


class CommandRefusedError(DeviceError):
    """The controller said that it does not take a command."""


class UsbLink:
    """An open engine. Threads may share it: each command and its answer are one step.

    Parameters
    ----------
    handle
        A file descriptor of a hidraw node, or of anything that keeps reports apart as it does. The link closes it.
    name
        Words for the engine, for messages.
    kind
        What it is.
    answer_s
        How long an answer may take.
    """

    def __init__(self, handle: int, name: str, kind: UsbController, *, answer_s: float = ANSWER_TIMEOUT_S) -> None:
        self.name = name
        self.kind = kind
        self._handle: int | None = handle
        self._answer_s = answer_s
        self._sequence = 0
        self._lock = threading.Lock()
        os.set_blocking(handle, False)
        self._drain()

    def write(self, command: int, data: bytes = b"") -> None:
        """Send a command, and wait until the engine has taken it. Raises as `read`."""
        self._exchange(command, data, ANSWER)

    def send(self, command: int, data: bytes) -> None:
        """Send a command that is given no answer. Raises as `read`."""
        self._exchange(command, data, 0)

    def read(self, command: int, length: int) -> bytes:
        """Ask for `length` bytes, and return these and what else there is.

        Raises
        ------
        RefusedError
            The engine refused.
        DeviceError
            It did not answer.
        DeviceGoneError
            It was unplugged.
        DeviceStateError
            The link is closed.
        """
        data = self._exchange(command, b"", READ | ANSWER)
        if len(data) < length:
            message = (
                f"{self.name}: asked for {length} bytes of {command:#06x}, it gave {len(data)}; its firmware is not "
                f"one that this driver knows: update it to {self.kind.firmware} or later"
            )
            raise DeviceError(message)
        return data

    def close(self) -> None:
        """Let the node go. Idempotent."""
        with self._lock:
            handle, self._handle = self._handle, None
            if handle is not None:
                os.close(handle)

    def _exchange(self, command: int, data: bytes, flags: int) -> bytes:
        if len(data) > MAX_DATA - 2:
            message = f"{self.name}: asked to send {len(data)} bytes at once, it takes {MAX_DATA - 2}; send fewer"
            raise DeviceError(message)
        with self._lock:
            self._open_handle()
            self._sequence = (self._sequence + 1) % 256
            length = len(data) + 2
            message_bytes = bytes((flags, self._sequence)) + length.to_bytes(2, "little")
            message_bytes += command.to_bytes(2, "little") + data
            for start in range(0, len(message_bytes), REPORT):
                self._send(message_bytes[start : start + REPORT].ljust(REPORT, b"\0"))
            return self._answer(command, time.monotonic() + self._answer_s) if flags & ANSWER else b""

    def _answer(self, command: int, until: float) -> bytes:
        while True:
            report = self._receive(command, until)
            data = report[HEADER:]
            length = int.from_bytes(report[2:HEADER], "little")
            while len(data) < length:
                data += self._receive(command, until)
            if report[1] != self._sequence:
                # The answer to a command that was given up.
                continue
            if report[0] & FAILED:
                message = (
                    f"{self.name} refused the command {command:#06x}; switch it off and on, and update its firmware "
                    f"to {self.kind.firmware} or later if it goes on"
                )
                raise CommandRefusedError(message)
            return data[:length]

    def _send(self, report: bytes) -> None:
        try:
            os.write(self._open_handle(), b"\0" + report)
        except OSError as error:
            raise self._fault(error) from error

    def _receive(self, command: int, until: float) -> bytes:
        handle = self._open_handle()
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        while (left_s := until - time.monotonic()) > 0:
            events = poll.poll(left_s * 1000)
            try:
                report = os.read(handle, REPORT) if events else None
            except BlockingIOError:
                report = None
            except OSError as error:
                raise self._fault(error) from error
            if report == b"" or (report is None and events and events[0][1] & (select.POLLHUP | select.POLLERR)):
                raise self._fault(OSError(errno.ENODEV, "it hung up"))
            if report:
                return report.ljust(REPORT, b"\0")
        message = (
            f"{self.name} did not answer the command {command:#06x} in {self._answer_s:g} s; check that it is powered "
            "(its own supply, not USB), and switch it off and on"
        )
        raise DeviceError(message)

    def _open_handle(self) -> int:
        if self._handle is None:
            message = f"{self.name} is closed; open the rig again"
            raise DeviceStateError(message)
        return self._handle

    def _drain(self) -> None:
        """Forget what another program left unread."""
        with suppress(OSError):
            while os.read(self._open_handle(), REPORT):
                pass

    def _fault(self, error: OSError) -> DeviceError:
        if error.errno in _GONE:
            message = f"{self.name} is gone ({error.strerror}); plug it in and power it, and open the rig again"
            return DeviceGoneError(message)
        message = f"{self.name} failed: {error.strerror}; unplug it, and plug it in again"
        return DeviceError(message)


def open_link(path: Path, kind: UsbController, *, answer_s: float = ANSWER_TIMEOUT_S) -> UsbLink:
    """Open a hidraw node for this program alone.

    Raises
    ------
    DeviceBusyError
        Another program holds it. Only programs that lock the node are noticed: TI's own does not.
    DeviceGoneError
        There is no such node.
    DeviceError
        It may not be opened.
    """
    # Late, so that what looks at this module on another system is not refused.
    import fcntl

    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EPERM):
            message = (
                f"{path}: asked to open the light engine, this user may not; write the line {kind.udev_rule} into "
                f"/etc/udev/rules.d/60-{kind.driver}.rules, run: sudo udevadm control --reload, and plug it in again"
            )
            raise DeviceError(message) from error
        if error.errno == errno.EBUSY:
            raise _busy_error(path) from error
        message = f"{path}: asked to open the light engine, found: {error.strerror}; plug it in, and power it"
        raise DeviceGoneError(message) from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _require_engine(handle, path, kind)
    except BlockingIOError as error:
        os.close(handle)
        raise _busy_error(path) from error
    except BaseException:
        os.close(handle)
        raise
    return UsbLink(handle, f"light engine {path}", kind, answer_s=answer_s)


def _require_engine(handle: int, path: Path, kind: UsbController) -> None:
    """Compare vendor and product of an open node: numbers of nodes are given again after an unplug."""
    import fcntl

    answer = bytearray(8)
    try:
        fcntl.ioctl(handle, _RAW_INFO, answer)
    except OSError as error:
        message = f"{path}: asked for the light engine, found no hidraw node ({error.strerror}); see: slrig devices"
        raise DeviceGoneError(message) from error
    found = struct.unpack("=IHH", answer)[1:]
    if found != (TI, kind.product):
        asked, got = (f"{vendor:04x}:{product:04x}" for vendor, product in ((TI, kind.product), found))
        message = f"{path}: asked for the light engine {asked}, found {got}; plug it in again"
        raise DeviceGoneError(message)


def _busy_error(path: Path) -> DeviceBusyError:
    message = f"{path}: asked for the light engine, another program holds it; end that one (see: fuser -v {path})"
    return DeviceBusyError(message)


@dataclass(frozen=True, slots=True)
class EngineNode:
    """An engine's node. name : the serial number where that is the engine's alone, else its port, else the path."""

    path: Path
    name: str
    label: str


def find_engines(kind: UsbController, sysfs: Path = SYSFS, dev: Path = DEV) -> tuple[EngineNode, ...]:
    """Return the engines that are plugged in, each under a name that no other has."""
    try:
        names = sorted((entry.name for entry in sysfs.iterdir()), key=_number)
    except OSError:
        return ()
    wanted = f"{TI:08X}:{kind.product:08X}"
    listed = ((dev / name, _read_facts(sysfs / name)) for name in names)
    found = [(path, facts) for path, facts in listed if wanted in facts.get("HID_ID", "") and _is_first(facts)]
    for_key = {key: Counter(facts.get(key, "") for _, facts in found) for key in ("HID_UNIQ", "HID_PHYS")}
    nodes = []
    for path, facts in found:
        own = [facts[key] for key, often in for_key.items() if facts.get(key) and often[facts[key]] == 1]
        nodes.append(EngineNode(path, (own or [str(path)])[0], facts.get("HID_NAME", "light engine")))
    return tuple(nodes)


def require_hidraw(kind: UsbController) -> None:
    """Raise WrongSystemError unless this is Linux."""
    require_linux(kind.driver, through="the kernel's /dev/hidraw*", instead="run slrig on Linux for it")


def list_devices(kind: UsbController, sysfs: Path = SYSFS) -> tuple[FoundDevice, ...]:
    """The engines in the words of `slrig devices`. Raises WrongSystemError: this is not Linux."""
    require_hidraw(kind)
    return tuple(
        FoundDevice(kind.driver, node.name, f"{node.label} ({node.path})") for node in find_engines(kind, sysfs)
    )


def choose_engine(device: str | None, found: tuple[EngineNode, ...]) -> EngineNode:
    """Return the engine that a rig file means: a name that `find_engines` gives, a path, or the only one there is.

    Raises
    ------
    DeviceGoneError
        There is none such now.
    ConfigError
        Several are plugged in, and the file names none.
    """
    have = "; ".join(f"{node.name} ({node.path})" for node in found) or "none"
    chosen = [node for node in found if device in (None, node.name, str(node.path))]
    if not chosen:
        asked = "a light engine" if device is None else f'the light engine "{device}"'
        message = f"asked for {asked}, plugged in: {have}; plug it in and power it, or write one of those names"
        raise DeviceGoneError(message)
    if len(chosen) > 1:
        message = f'[projector] names no light engine, plugged in: {have}; write device = "…" with one of those names'
        raise ConfigError(message)
    return chosen[0]


def _is_first(facts: dict[str, str]) -> bool:
    """Whether this is the engine's first interface, as far as its port tells."""
    number = re.search(r"/input(\d+)$", facts.get("HID_PHYS", ""))
    return number is None or int(number[1]) == 0


def _read_facts(entry: Path) -> dict[str, str]:
    try:
        lines = (entry / "device" / "uevent").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return {}
    return {key: value.strip() for key, _, value in (line.partition("=") for line in lines)}


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits.group()) if digits else 0, name)


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

    def switch_leds(self, *, by_sequence: bool) -> None:
        """Let the sequence switch the LEDs, or switch them all off."""
        self.set_byte(UsbCommand.LED_ENABLE, 8 if by_sequence else 0)

    def set_led_current(self, colours: int, current: int, *, inverted: bool) -> None:
        """Set the current of the LEDs in `colours` (0 to 255), and none of the others; compare what is read back."""
        wanted = [current if colours & bit else 0 for bit in (1, 2, 4)]
        # The register's polarity turns the sense of the values around once more.
        if inverted != self.is_led_polarity_inverted:
            wanted = [255 - value for value in wanted]
        self.set_led_registers(bytes(wanted))

    @property
    def is_led_polarity_inverted(self) -> bool:
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

"""Pattern engines with a USB port: finding them, the link to one over a hidraw node, and the common commands.

Finding uses /sys alone and opens nothing. A hidraw node's `device/uevent` names bus, vendor and product (HID_ID), the
serial number (HID_UNIQ) and the port (HID_PHYS): kernel, drivers/hid/hid-core.c. An engine may have several HID
interfaces; commands go to the first (TI's usb.c, `USB_Open`), whose port ends in "/input0" (kernel,
drivers/hid/usbhid/hid-core.c). An engine without a unique serial number is named by its port.

Framing (TI DLPU010 §1.2 and, for the DLPC900, DLPU018 §1.2; TI's sources dlpc350_api.cpp): reports of 64 bytes both
ways, without a report number (the kernel wants a zero before each). The first report of a message begins with a header:

    flags     bits 0-2 destination (0), 5 error, 6 answer wanted, 7 read
    sequence  the answer has the number of its command
    length    2 bytes, low first: of all that follows, including the command's 2 bytes
    command   2 bytes, low first (of CMD2 and CMD3, CMD3 comes first); an answer has none

The remainder follows in further reports without a header. One command is processed at a time.

Command numbers are CMD2 and CMD3. For the DLPC350: its programmer's guide (DLPU010) and TI's own sources
(dlpc350_api.cpp, `CmdList`, in github.com/jakobwilm/slstudio under src/projector/LC4500API). For the DLPC900: its
programmer's guide (DLPU018, revisions F and J) and TI's own sources (API.c of TI's program for it, `CmdList`, in
github.com/RhojAnn/DLPC900_CLI under lib).
"""

from __future__ import annotations

import errno
import os
import re
import select
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from pathlib import Path

from drivers.linux import require_linux
from drivers.pattern_engine.patience import PATIENCE_S, ask_until
from slrig.devices import Clock, FoundDevice, SystemClock
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
"""Message buffer of the engine: 512 bytes (DLPU018 §1.2)."""

ANSWER_TIMEOUT_S = 2.0
_RAW_INFO = 0x8008_4803
"""HIDIOCGRAWINFO: bus type, vendor, product (include/uapi/linux/hidraw.h)."""

TI = 0x0451


_GONE = {errno.EIO, errno.ENODEV, errno.ENXIO, errno.EPIPE, errno.ESHUTDOWN, errno.ECONNRESET}
SYSFS = Path("/sys/class/hidraw")
DEV = Path("/dev")


@dataclass(frozen=True, slots=True)
class UsbController:
    """A type of controller on USB. driver : slrig's name; product : its USB product id; firmware : oldest supported
    version.
    """

    driver: str
    product: int
    firmware: str

    @property
    def udev_rule(self) -> str:
        """The udev rule that lets users open it."""
        return (
            f'KERNEL=="hidraw*", ATTRS{{idVendor}}=="{TI:04x}", ATTRS{{idProduct}}=="{self.product:04x}", '
            'MODE="0660", TAG+="uaccess"'
        )


class CommandRefusedError(DeviceError):
    """The controller refused a command."""


class UsbLink:
    """An open engine. Thread-safe: each command and its answer are one step.

    handle : file descriptor of a hidraw node, or of anything that preserves report boundaries; the link closes it. name
    : for messages. kind : type of the controller. answer_s : longest time for an answer.
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
        """Send a command and wait for its acknowledgement. Raises as `read`."""
        self._exchange(command, data, ANSWER)

    def send(self, command: int, data: bytes) -> None:
        """Send a command that is not acknowledged. Raises as `read`."""
        self._exchange(command, data, 0)

    def read(self, command: int, length: int) -> bytes:
        """Request `length` bytes; return at least these.

        Raises
        ------
        CommandRefusedError
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
                f"{self.name}: requested {length} bytes of {command:#06x}, it gave {len(data)}; update its firmware to "
                f"{self.kind.firmware} or later"
            )
            raise DeviceError(message)
        return data

    def close(self) -> None:
        """Close the node. Idempotent."""
        with self._lock:
            handle, self._handle = self._handle, None
            if handle is not None:
                os.close(handle)

    def _exchange(self, command: int, data: bytes, flags: int) -> bytes:
        if len(data) > MAX_DATA - 2:
            message = (
                f"{self.name}: a command of {len(data)} bytes is too long, the limit is {MAX_DATA - 2}; send fewer"
            )
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
                # The answer to an earlier command that timed out.
                continue
            if report[0] & FAILED:
                message = (
                    f"{self.name} refused the command {command:#06x}; switch it off and on, and update its firmware "
                    f"to {self.kind.firmware} or later if it continues"
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
        """Discard reports that another program left unread."""
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
    """Open a hidraw node exclusively.

    Raises
    ------
    DeviceBusyError
        Another program holds it. Only programs that lock the node are detected; TI's own does not.
    DeviceGoneError
        The node does not exist.
    DeviceError
        This user may not open it.
    """
    # Imported here, so that this module can be imported on other systems.
    import fcntl

    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EPERM):
            message = (
                f"{path}: this user may not open the light engine; write the line {kind.udev_rule} into "
                f"/etc/udev/rules.d/60-{kind.driver}.rules, run: sudo udevadm control --reload, and plug it in again"
            )
            raise DeviceError(message) from error
        if error.errno == errno.EBUSY:
            raise _busy_error(path) from error
        message = f"{path}: cannot open the light engine ({error.strerror}); plug it in, and power it"
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
    """Check vendor and product of an open node: node numbers are reused after an unplug."""
    import fcntl

    answer = bytearray(8)
    try:
        fcntl.ioctl(handle, _RAW_INFO, answer)
    except OSError as error:
        message = f"{path}: expected a light engine, found no hidraw node ({error.strerror}); see: slrig devices"
        raise DeviceGoneError(message) from error
    found = struct.unpack("=IHH", answer)[1:]
    if found != (TI, kind.product):
        expected, got = (f"{vendor:04x}:{product:04x}" for vendor, product in ((TI, kind.product), found))
        message = f"{path}: expected the light engine {expected}, found {got}; plug it in again"
        raise DeviceGoneError(message)


def _busy_error(path: Path) -> DeviceBusyError:
    message = f"{path}: another program holds the light engine; end that program (see: fuser -v {path})"
    return DeviceBusyError(message)


@dataclass(frozen=True, slots=True)
class EngineNode:
    """Node of an engine. name : the serial number if unique, else its port, else the path."""

    path: Path
    name: str
    label: str


def find_engines(kind: UsbController, sysfs: Path = SYSFS, dev: Path = DEV) -> tuple[EngineNode, ...]:
    """Return the engines that are plugged in, each with a unique name."""
    try:
        names = sorted((entry.name for entry in sysfs.iterdir()), key=_number)
    except OSError:
        return ()
    wanted = f"{TI:08X}:{kind.product:08X}"
    listed = ((dev / name, _read_facts(sysfs / name)) for name in names)
    found = [(path, facts) for path, facts in listed if wanted in facts.get("HID_ID", "") and _is_first(facts)]
    counts = {key: Counter(facts.get(key, "") for _, facts in found) for key in ("HID_UNIQ", "HID_PHYS")}
    nodes = []
    for path, facts in found:
        unique = [facts[key] for key, count in counts.items() if facts.get(key) and count[facts[key]] == 1]
        nodes.append(EngineNode(path, (unique or [str(path)])[0], facts.get("HID_NAME", "light engine")))
    return tuple(nodes)


def require_hidraw(kind: UsbController) -> None:
    """Raise WrongSystemError unless this is Linux."""
    require_linux(kind.driver, through="the kernel's /dev/hidraw*", instead="run slrig on Linux for it")


def list_devices(kind: UsbController, sysfs: Path = SYSFS) -> tuple[FoundDevice, ...]:
    """Return the engines as listed by `slrig devices`. Raises WrongSystemError unless this is Linux."""
    require_hidraw(kind)
    return tuple(
        FoundDevice(kind.driver, node.name, f"{node.label} ({node.path})") for node in find_engines(kind, sysfs)
    )


def choose_engine(device: str | None, found: tuple[EngineNode, ...]) -> EngineNode:
    """Return the engine that a rig file names: by a name from `find_engines`, a path, or the only one.

    Raises
    ------
    DeviceGoneError
        No such engine is plugged in.
    ConfigError
        Several are plugged in, and the file names none.
    """
    available = "; ".join(f"{node.name} ({node.path})" for node in found) or "none"
    chosen = [node for node in found if device in (None, node.name, str(node.path))]
    if not chosen:
        requested = "no light engine" if device is None else f'light engine "{device}" not'
        message = f"{requested} found, plugged in: {available}; plug it in and power it, or write one of those names"
        raise DeviceGoneError(message)
    if len(chosen) > 1:
        message = (
            f'[projector] names no light engine, plugged in: {available}; write device = "…" with one of those names'
        )
        raise ConfigError(message)
    return chosen[0]


def _is_first(facts: dict[str, str]) -> bool:
    """True if this is the engine's first interface, as far as its port shows."""
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
    """USB commands common to both controllers."""

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
    """Hardware status. INITIALISED is set in normal operation, the others are clear."""

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


class UsbEngine(ABC):
    """The controller behind a link. Every method raises the link's DeviceError and DeviceGoneError.

    clock : the rig's; default: the system's.
    """

    def __init__(self, link: UsbLink, clock: Clock | None) -> None:
        self._link = link
        self._clock = clock or SystemClock()

    @property
    def name(self) -> str:
        """Name of the engine, for messages."""
        return self._link.name

    def close(self) -> None:
        """Close the link. Idempotent."""
        self._link.close()

    def set_byte(self, command: int, value: int) -> None:
        """Set a register of one byte."""
        self._link.write(command, bytes([value]))

    def byte(self, command: int) -> int:
        """Return a register of one byte."""
        return self._link.read(command, 1)[0]

    def settle_byte(self, command: IntEnum, value: int) -> None:
        """Set a register of one byte and read it back. Raises UnsupportedByDeviceError if it differs."""
        self.settle(command, bytes([value]))

    def settle(self, command: IntEnum, data: bytes) -> None:
        """Set a register and read it back until it agrees. Raises UnsupportedByDeviceError if it never does."""
        self._link.write(command, data)
        got = ask_until(self._clock, lambda: self._link.read(command, len(data))[: len(data)], data.__eq__)
        if got != data:
            name = command.name.lower().replace("_", " ")
            message = (
                f"{self.name}: requested {name} {data.hex(' ')}, the engine gives {got.hex(' ')} after "
                f"{PATIENCE_S:g} s; switch it off and on, and update its firmware to "
                f"{self._link.kind.firmware} or later"
            )
            raise UnsupportedByDeviceError(message)

    def switch_leds(self, *, by_sequence: bool) -> None:
        """Let the sequence switch the LEDs, or switch them all off."""
        self.set_byte(UsbCommand.LED_ENABLE, 8 if by_sequence else 0)

    def set_led_current(self, colours: int, current: int, *, inverted: bool) -> None:
        """Set the current (0 to 255) of the LEDs in `colours`, and 0 for the others; verify by reading back."""
        wanted = [current if colours & bit else 0 for bit in (1, 2, 4)]
        # The polarity register inverts the values again.
        if inverted != self.is_led_polarity_inverted:
            wanted = [255 - value for value in wanted]
        self.set_led_registers(bytes(wanted))

    @property
    def is_led_polarity_inverted(self) -> bool:
        """True if the polarity register is set."""
        return bool(self.byte(UsbCommand.LED_POLARITY) & 1)

    def set_led_registers(self, values: bytes) -> None:
        """Set the raw registers of red, green and blue; verify by reading back."""
        self.settle(UsbCommand.LED_CURRENT, values)

    def start(self) -> None:
        """Start the current sequence from its beginning. It is stopped."""
        self.set_byte(UsbCommand.START_STOP, 2)

    def stop(self) -> None:
        """Stop the sequence. It may take a while to end: `wait_until_stopped`."""
        self.set_byte(UsbCommand.START_STOP, 0)

    def restart(self) -> None:
        """Stop the current sequence, and start it from its beginning. It is dark meanwhile, and stays so if this fails
        or the program ends: a stop may leave the last pattern on the mirrors.
        """
        self.switch_leds(by_sequence=False)
        self.stop()
        self.wait_until_stopped()
        self.start()
        self.switch_leds(by_sequence=True)

    @abstractmethod
    def wait_until_stopped(self) -> None:
        """Wait until a stopped sequence has ended: until then, settings may be refused. In pattern modes only."""

    def wait_until_running(self, timeout_s: float) -> None:
        """Wait until the sequencer runs. Raises DeviceError on time-out."""
        self._wait_for(UsbCommand.MAIN_STATUS, MainStatus.RUNNING, timeout_s, "start the sequence")

    def wait_until_initialised(self, timeout_s: float) -> None:
        """Wait until the engine is ready for commands. Raises DeviceError on time-out."""
        self._wait_for(UsbCommand.HARDWARE_STATUS, HardwareStatus.INITIALISED, timeout_s, "finish its initialisation")

    def faults(self) -> str:
        """Return the faults in the hardware status as text; empty if none."""
        status = self.byte(UsbCommand.HARDWARE_STATUS)
        return "; ".join(text for bit, text in FAULTS.items() if status & bit)

    def _wait_for(self, command: UsbCommand, bit: int, timeout_s: float, action: str) -> None:
        if not ask_until(self._clock, lambda: self.byte(command) & bit, bool, timeout_s):
            raise self._late(action)

    def _late(self, action: str) -> DeviceError:
        status = self.faults() or "no fault"
        return DeviceError(f"{self.name} did not {action} in time, and reports: {status}; switch it off and on")

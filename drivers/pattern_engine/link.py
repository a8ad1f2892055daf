"""One command to the engine and its answer, over a hidraw node.

Framing (TI DLPU010 §1.2 and its like for the DLPC900, DLPU018 §1.2; TI's sources dlpc350_api.cpp): reports of 64 bytes
both ways, no report number (so the kernel wants a zero before each). The first one of a message begins with a header:

    flags     bits 0-2 destination (0), 5 error, 6 answer wanted, 7 read
    sequence  the answer brings the number of its command
    length    2 bytes, low first: of all that follows, the command's 2 bytes among it
    command   2 bytes, low first (of CMD2 and CMD3, CMD3 comes first); an answer has none

What does not fit goes on in further reports without a header. One command is under way at a time.
"""

from __future__ import annotations

import errno
import os
import select
import struct
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, DeviceStateError

REPORT = 64
HEADER = 4
READ, ANSWER, FAILED = 0x80, 0x40, 0x20
MAX_DATA = 512 - HEADER
"""The engine's buffer holds 512 bytes of a message (DLPU018 §1.2)."""

ANSWER_TIMEOUT_S = 1.0
_RAW_INFO = 0x8008_4803
"""HIDIOCGRAWINFO: bus type, vendor, product (include/uapi/linux/hidraw.h)."""

TI = 0x0451


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


_GONE = {errno.EIO, errno.ENODEV, errno.ENXIO, errno.EPIPE, errno.ESHUTDOWN, errno.ECONNRESET}


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

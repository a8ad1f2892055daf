"""A serial port with slrig's errors: pyserial's own ones, and those that it lets through, told apart.

pyserial raises `SerialException` for most, a bare `OSError` where the file descriptor fails under it (`in_waiting`
after an unplug), and `termios.error` from the line discipline. A port that is open elsewhere is `EAGAIN` (its lock) or
`EBUSY` (TIOCEXCL, which root passes by). When two programs read one port all the same, it takes that for an unplug.
"""

from __future__ import annotations

import errno
import importlib
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, LibraryMissingError

SLICE_S = 0.02
"""How long one read waits at most: what is asked of the port meanwhile waits as long."""

_BY_ID = Path("/dev/serial/by-id")
_WRITE_S = 1.0
_BUSY = {errno.EAGAIN, errno.EBUSY}
_ABSENT = {errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO}


class BytePort(Protocol):
    """Bytes to and from a device."""

    def read(self, timeout_s: float) -> bytes:
        """Return what came in, as soon as there is something; nothing after the time-out. Raises DeviceGoneError."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of it. Raises DeviceGoneError."""
        ...

    def close(self) -> None:
        """Let the port go. Idempotent; never raises."""
        ...


class SerialPort:
    """Implements `BytePort` with pyserial, on a port's name or a pyserial URL (`socket://…`, `rfc2217://…`).

    device : what is behind it, in words, as "trigger box"; driver : whose port it is; both for errors.

    Raises
    ------
    LibraryMissingError
        pyserial is not installed.
    DeviceGoneError
        There is no such port.
    DeviceBusyError
        Another program holds it.
    DeviceError
        It cannot be opened.
    """

    def __init__(self, name: str, *, baud: int, device: str, driver: str) -> None:
        serial = _library(driver)
        self._name, self._device, self._driver = name, device, driver
        target = resolve_port(name)
        # Two programs on one port read one another's answers; a URL's handler has no lock.
        exclusive = {} if "://" in target else {"exclusive": True}
        try:
            self._serial = serial.serial_for_url(
                target, baudrate=baud, timeout=SLICE_S, write_timeout=_WRITE_S, **exclusive
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise _open_error(name, target, error, device) from error
        with suppress(Exception):
            # FTDI bridges hold bytes back for 16 ms otherwise. Others have no such mode, and say so in many ways.
            self._serial.set_low_latency_mode(True)

    def read(self, timeout_s: float) -> bytes:
        """See `BytePort`."""
        until_s = time.monotonic() + timeout_s
        with self._translate_errors("read from"):
            while True:
                left_s = max(until_s - time.monotonic(), 0.0)
                self._serial.timeout = min(left_s, SLICE_S)
                data = self._read()
                if data or left_s <= SLICE_S:
                    return data

    def write(self, data: bytes) -> None:
        """See `BytePort`."""
        with self._translate_errors("write to"):
            self._serial.write(data)

    def close(self) -> None:
        """See `BytePort`."""
        with suppress(Exception):
            self._serial.close()

    def _read(self) -> bytes:
        try:
            data: bytes = self._serial.read(max(1, self._serial.in_waiting))
        except _library(self._driver).SerialException:
            # Raised alike when another program read first what this one was told of, and when the port is gone.
            if not self._is_alive():
                raise
            return b""
        return data

    def _is_alive(self) -> bool:
        """Whether the system still has a line here: one that was hung up answers with EIO."""
        try:
            import termios

            termios.tcgetattr(self._serial.fileno())
        except Exception:  # noqa: BLE001 - no terminal, no such module, no open file: nobody to ask
            return False
        return True

    @contextmanager
    def _translate_errors(self, what: str) -> Iterator[None]:
        try:
            if not self._serial.is_open:
                raise _library(self._driver).PortNotOpenError
            yield
        except (_library(self._driver).SerialException, OSError, _line_discipline_error()) as error:
            message = (
                f"asked to {what} the {self._device} on {self._name}, found it gone ({error}): it was unplugged, lost "
                "its power or reset itself; plug it in and open the rig again"
            )
            raise DeviceGoneError(message) from error


def resolve_port(name: str) -> str:
    """Return the port that a rig file means: a path, a URL, a system name (COM3), or a name in /dev/serial/by-id."""
    link = _BY_ID / name
    return str(link) if "/" not in name and link.exists() else name


def _library(driver: str) -> Any:
    try:
        return importlib.import_module("serial")
    except ImportError as missing:
        install = "pip install pyserial"
        message = f"driver '{driver}' needs pyserial, which is not installed ({missing}); {install}"
        raise LibraryMissingError(message, install=install) from missing


def _line_discipline_error() -> type[Exception]:
    try:
        import termios
    except ImportError:  # Windows
        return OSError
    return termios.error


def _open_error(name: str, target: str, error: Exception, device: str) -> DeviceError:
    """What it means that a port does not open."""
    number = _error_number(error)
    if number in _BUSY or "exclusively lock" in str(error):
        holders = " and ".join(_find_holders(target)) or "another program (or you may not see whose it is)"
        return DeviceBusyError(f"port {name} is held by {holders}; end that, or use another port")
    if number in _ABSENT or "could not find" in str(error).lower():
        return DeviceGoneError(
            f"asked to open port {name}, there is none such ({error}); plug the {device} in, and see which port it "
            "has: slrig devices"
        )
    if number == errno.EACCES and os.name == "posix":
        return DeviceError(f"you may not open port {name} ({error}); sudo usermod -aG dialout $USER, and log in again")
    return DeviceError(f"port {name} does not open: {error}; correct the name or the URL in the rig file")


def _error_number(error: Exception) -> int | None:
    """The system's error number; pyserial keeps it in the text where it wraps one error into another."""
    number = getattr(error, "errno", None)
    if isinstance(number, int):
        return number
    found = re.search(r"\[Errno (\d+)\]", str(error))
    return int(found.group(1)) if found else None


def _find_holders(target: str) -> list[str]:
    """The programs that have a port open, as far as the system tells: name and process number."""
    found = []
    real = os.path.realpath(target)
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if any(os.path.realpath(handle) == real for handle in (process / "fd").iterdir()):
                found.append(f"{(process / 'comm').read_text().strip()} (process {process.name})")
    return found

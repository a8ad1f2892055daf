"""A serial port with slrig's errors, which distinguish the causes of pyserial's.

pyserial raises `SerialException` in most cases, a bare `OSError` if the file descriptor fails under it (`in_waiting`
after an unplug), and `termios.error` from the line discipline. A port that is open elsewhere gives `EAGAIN` (its lock)
or `EBUSY` (TIOCEXCL, which does not apply to root). pyserial reports two programs reading one port as an unplug.
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

from drivers.libraries import loading
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError

SLICE_S = 0.02
"""Longest wait of one read; other requests to the port wait for it."""

_BY_ID = Path("/dev/serial/by-id")
_WRITE_S = 1.0
_BUSY = {errno.EAGAIN, errno.EBUSY}
_ABSENT = {errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO}


class BytePort(Protocol):
    """Bytes to and from a device."""

    def read(self, timeout_s: float) -> bytes:
        """Return the received bytes as soon as there are some; nothing after the time-out. Raises DeviceGoneError."""
        ...

    def write(self, data: bytes) -> None:
        """Send all bytes. Raises DeviceGoneError."""
        ...

    def close(self) -> None:
        """Close the port. Idempotent; never raises."""
        ...


class SerialPort:
    """Implements `BytePort` with pyserial, on a port's name or a pyserial URL (`socket://…`, `rfc2217://…`).

    device : name of the device, as "trigger box"; driver : name of the driver; both for errors. Raises
    LibraryMissingError (pyserial is not installed), DeviceGoneError (the port does not exist), DeviceBusyError (another
    program holds it) and DeviceError (it cannot be opened).
    """

    def __init__(self, name: str, *, baud: int, device: str, driver: str) -> None:
        serial = serial_module(driver)
        self._name, self._device, self._driver = name, device, driver
        target = resolve_port(name)
        # Two programs on one port would read each other's answers; a URL's handler has no lock.
        exclusive = {} if "://" in target else {"exclusive": True}
        try:
            self._serial = serial.serial_for_url(
                target, baudrate=baud, timeout=SLICE_S, write_timeout=_WRITE_S, **exclusive
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise _open_error(name, target, error, device) from error
        with suppress(Exception):
            # Otherwise FTDI bridges delay bytes by 16 ms. Others raise various errors here.
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
        except serial_module(self._driver).SerialException:
            # Raised both when another program has read the bytes and when the port is gone.
            if not self._is_alive():
                raise
            return b""
        return data

    def _is_alive(self) -> bool:
        """True if the system still has a line here: a line that was hung up answers with EIO."""
        try:
            import termios

            termios.tcgetattr(self._serial.fileno())
        except Exception:  # noqa: BLE001 - no terminal, no such module, or no open file
            return False
        return True

    @contextmanager
    def _translate_errors(self, action: str) -> Iterator[None]:
        try:
            if not self._serial.is_open:
                raise serial_module(self._driver).PortNotOpenError
            yield
        except (serial_module(self._driver).SerialException, OSError, _line_discipline_error()) as error:
            message = (
                f"cannot {action} the {self._device} on {self._name}, it is gone ({error}): it was unplugged, lost its "
                "power or reset itself; plug it in and open the rig again"
            )
            raise DeviceGoneError(message) from error


def resolve_port(name: str) -> str:
    """Return the port that a rig file names: a path, a URL, a system name (COM3), or a name in /dev/serial/by-id."""
    link = _BY_ID / name
    return str(link) if "/" not in name and link.exists() else name


def serial_module(driver: str, module: str = "serial") -> Any:
    """Return a module of pyserial. Raises LibraryMissingError."""
    with loading(driver, "pyserial", install="pip install 'slrig[serial]'", packages="pyserial"):
        return importlib.import_module(module)


def _line_discipline_error() -> type[Exception]:
    try:
        import termios
    except ImportError:  # Windows
        return OSError
    return termios.error


def _open_error(name: str, target: str, error: Exception, device: str) -> DeviceError:
    """Return the error for a port that cannot be opened."""
    number = _error_number(error)
    if number in _BUSY or "exclusively lock" in str(error):
        holders = " and ".join(_find_holders(target)) or "another program"
        return DeviceBusyError(f"port {name} is held by {holders}; end that, or use another port")
    if number in _ABSENT or "could not find" in str(error).lower():
        return DeviceGoneError(
            f"port {name} does not exist ({error}); plug the {device} in, and look up its port: slrig devices"
        )
    if number == errno.EACCES and os.name == "posix":
        return DeviceError(f"you may not open port {name} ({error}); sudo usermod -aG dialout $USER, and log in again")
    return DeviceError(f"port {name} does not open: {error}; correct the name or the URL in the rig file")


def _error_number(error: Exception) -> int | None:
    """Return the system's error number; pyserial has it in the text if it wraps another error."""
    number = getattr(error, "errno", None)
    if isinstance(number, int):
        return number
    found = re.search(r"\[Errno (\d+)\]", str(error))
    return int(found.group(1)) if found else None


def _find_holders(target: str) -> list[str]:
    """Return the programs that have a port open, as far as the system shows: name and process number."""
    found = []
    real = os.path.realpath(target)
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if any(os.path.realpath(handle) == real for handle in (process / "fd").iterdir()):
                found.append(f"{(process / 'comm').read_text().strip()} (process {process.name})")
    return found

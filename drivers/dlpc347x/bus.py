"""Commands and answers of the engine over an I²C bus of Linux.

Framing (TI DLPU081B §1.2, DLPU075B §1.2): a write is the number of a command and its parameters. A read is such a
write, then a read of the answer. As in TI's own program, the write ends with a stop before the read (cypress_i2c.c,
`isStopBit`, in github.com/isabella232/LightField under dlp-4710): each `write` and each `read` of the node is one
transaction (kernel, Documentation/i2c/dev-interface.rst). The engine stretches the clock while it processes a command.
"""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path
from typing import Protocol

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, DeviceStateError

ADDRESS = 0x1B
"""TI's firmware uses 36h, including the direction bit (release notes of DLPC3478 8.0.1: "0x36")."""
_I2C_SLAVE = 0x0703
"""Selects the address; refused if a driver of the kernel has it (include/uapi/linux/i2c-dev.h)."""
_GONE = {errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ENODEV, errno.ESHUTDOWN}
"""ENXIO and EREMOTEIO: no acknowledgement at the address (kernel, Documentation/i2c/fault-codes.rst)."""


class I2cPort(Protocol):
    """One address of a bus. Every call is one transaction; raises OSError as the kernel does."""

    def write(self, data: bytes) -> None:
        """Send bytes."""
        ...

    def read(self, length: int) -> bytes:
        """Read `length` bytes."""
        ...

    def close(self) -> None:
        """Close the port."""
        ...


class I2cBus:
    """An open port. Thread-safe: each command and its answer are one step. name : for messages."""

    def __init__(self, port: I2cPort, name: str) -> None:
        self.name = name
        self._port: I2cPort | None = port
        self._lock = threading.Lock()

    def write(self, command: int, data: bytes = b"") -> None:
        """Send a command. Raises as `read`."""
        with self._lock:
            self._transfer(bytes([command]) + data, 0)

    def read(self, command: int, length: int, data: bytes = b"") -> bytes:
        """Send a command, and return its answer.

        Raises
        ------
        DeviceGoneError
            No device answers, or the bus is gone.
        DeviceError
            The bus failed.
        DeviceStateError
            It is closed.
        """
        with self._lock:
            return self._transfer(bytes([command]) + data, length)

    def close(self) -> None:
        """Close the port. Idempotent."""
        with self._lock:
            port, self._port = self._port, None
            if port is not None:
                port.close()

    def _transfer(self, data: bytes, length: int) -> bytes:
        if self._port is None:
            message = f"{self.name} is closed; open the rig again"
            raise DeviceStateError(message)
        try:
            self._port.write(data)
            return self._port.read(length) if length else b""
        except OSError as error:
            if error.errno in _GONE:
                message = f"{self.name} does not answer ({error.strerror}); check its power, its wires and its address"
                raise DeviceGoneError(message) from error
            message = (
                f"{self.name}: the bus failed ({error.strerror}); check its wires, and switch the engine off and on"
            )
            raise DeviceError(message) from error


class I2cNode:
    """Implements `I2cPort` on a node of the kernel's i2c-dev."""

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def write(self, data: bytes) -> None:
        """See `I2cPort`."""
        if os.write(self._handle, data) != len(data):
            raise OSError(errno.EIO, "incomplete write")

    def read(self, length: int) -> bytes:
        """See `I2cPort`."""
        data = os.read(self._handle, length)
        if len(data) != length:
            raise OSError(errno.EIO, "incomplete read")
        return data

    def close(self) -> None:
        """See `I2cPort`."""
        os.close(self._handle)


def open_bus(path: Path, address: int) -> I2cBus:
    """Open an address of a bus exclusively.

    Raises
    ------
    DeviceBusyError
        A driver of the kernel, or another slrig, has it.
    DeviceGoneError
        The bus does not exist.
    DeviceError
        This user may not open it.
    """
    # Imported here, so that this module can be imported on other systems.
    import fcntl

    name = f"light engine {path} {address:#04x}"
    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except PermissionError as error:
        message = f"{name}: this user may not open it; run: sudo usermod -aG i2c $USER, and log in again"
        raise DeviceError(message) from error
    except OSError as error:
        available = ", ".join(sorted(map(str, Path("/dev").glob("i2c-*")))) or "none"
        message = f"{name}: {error.strerror}; available buses: {available}; run: sudo modprobe i2c-dev, and name one"
        raise DeviceGoneError(message) from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        fcntl.ioctl(handle, _I2C_SLAVE, address)
    except OSError as error:
        os.close(handle)
        if error.errno in (errno.EBUSY, errno.EWOULDBLOCK):
            message = f"{name}: another program, or a driver of the kernel, uses it; end that one"
            raise DeviceBusyError(message) from error
        message = f"{name}: not an I²C bus ({error.strerror}); name one of /dev/i2c-*"
        raise DeviceGoneError(message) from error
    return I2cBus(I2cNode(handle), name)

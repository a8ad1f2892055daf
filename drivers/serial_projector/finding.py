"""Serial ports that a trigger box may be behind, told by what the system knows: none of them is opened.

Opening a port restarts many boards, and disturbs whatever else is behind it.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

from slrig.devices import FoundDevice
from slrig.errors import LibraryMissingError

BY_ID = Path("/dev/serial/by-id")

MICROPYTHON_RP2 = (0x2E8A, 0x0005)
"""USB ids of an RP2040 that runs MicroPython."""


def find_ports(by_id: Path = BY_ID) -> tuple[FoundDevice, ...]:
    """Return the USB serial ports, each by a name that stays the same where it has one. Raises LibraryMissingError."""
    try:
        list_ports = importlib.import_module("serial.tools.list_ports")
    except ImportError as missing:
        install = "pip install pyserial"
        message = f"driver 'serial_projector' needs pyserial, which is not installed ({missing}); {install}"
        raise LibraryMissingError(message, install=install) from missing
    lasting = _links_by_target(by_id)
    ports = sorted(list_ports.comports(), key=lambda port: str(port.device))
    return tuple(
        FoundDevice("serial_projector", lasting.get(os.path.realpath(port.device), port.device), _label(port))
        for port in ports
        if port.vid is not None
    )


def _label(port: Any) -> str:
    """What the system says of a port, and that nobody asked it."""
    name = " ".join(filter(None, (port.manufacturer, port.product))) or "USB serial port"
    serial = f", serial number {port.serial_number}" if port.serial_number else ""
    likely = "MicroPython on an RP2040: " if (port.vid, port.pid) == MICROPYTHON_RP2 else ""
    return f"{likely}{name} ({port.device}, {port.vid:04X}:{port.pid or 0:04X}{serial}), not asked whether it is a box"


def _links_by_target(folder: Path) -> dict[str, str]:
    try:
        return {os.path.realpath(link): str(link) for link in sorted(folder.iterdir(), reverse=True)}
    except OSError:
        return {}

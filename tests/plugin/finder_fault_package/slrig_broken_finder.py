"""A plug-in whose finder fails."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from slrig.errors import DeviceGoneError


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> NoReturn:
    """Find no device to open."""
    del options, folder
    message = f"camera '{name}' is not there; plug it in"
    raise DeviceGoneError(message)


def find_devices() -> NoReturn:
    """Fail."""
    message = "[Errno 5] the bus does not answer"
    raise OSError(message)

"""A plug-in that can be loaded without the library of its devices, and says how to install that."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from slrig.errors import DeviceGoneError, LibraryMissingError

INSTALL = "pip install 'slrig-lacking-library[vendor]'"


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> NoReturn:
    """Ask the library for the device."""
    del options, folder
    library = _library()
    message = f"camera '{name}' is not known to {library.__name__}; plug it in"
    raise DeviceGoneError(message)


def find_devices() -> tuple[()]:
    """Ask the library for its devices."""
    _library()
    return ()


def _library() -> ModuleType:
    try:
        return importlib.import_module("slrig_vendor_library_of_the_tests")
    except ImportError as cause:
        message = f"driver 'lacking' needs its vendor's library, which is not installed; run: {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL) from cause

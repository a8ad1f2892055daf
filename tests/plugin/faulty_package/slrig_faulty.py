"""Plug-ins that talk on standard output while they load, and fail when they are called.

A factory and a finder fail with errors of no known kind; another one lacks the library of its devices.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from slrig.errors import LibraryMissingError

INSTALL = "pip install 'slrig-lacking-library[vendor]'"

sys.stdout.write("Vendor SDK 4.2 (c) 1998\n")


def open_broken(name: str, options: Mapping[str, object], folder: Path) -> NoReturn:
    """Fail."""
    del options, folder
    message = f"no handle for {name}"
    raise KeyError(message)


def find_broken() -> NoReturn:
    """Fail."""
    message = "[Errno 5] the bus does not answer"
    raise OSError(message)


def ask_library(*_: object) -> None:
    """Ask the library for devices, or for one."""
    try:
        importlib.import_module("slrig_vendor_library_of_the_tests")
    except ImportError as cause:
        message = f"driver 'lacking' needs its vendor's library, which is not installed; run: {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL) from cause

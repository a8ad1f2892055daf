"""The vendor's library, loaded when a device is first asked for: importing it takes seconds."""

from __future__ import annotations

import importlib
import importlib.util
import os
from datetime import timedelta
from typing import Any

from slrig.errors import LibraryMissingError

INSTALL = "pip install 'slrig[depthai]'"

ENVIRONMENT = {
    # It warns of every bus that it cannot see (a container without USB, for example).
    "DEPTHAI_LEVEL": "error",
    # It reports its use to its maker, and asks there for news. A rig tells nobody what it does.
    "DEPTHAI_TELEMETRY": "0",
    "DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS": "1",
}
"""What the library reads when it is imported; what the user has set stays."""

_MICROSECOND = timedelta(microseconds=1)


def load_depthai() -> Any:
    """Return the module `depthai`, version 3.12 or later.

    Raises
    ------
    LibraryMissingError
        It is not installed, cannot be loaded, or is too old.
    """
    # Asking whether it is there takes no time; importing it does.
    if importlib.util.find_spec("depthai") is None:
        message = f"OAK cameras need the library depthai, which is not installed: {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL)
    for variable, value in ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    try:
        vendor = importlib.import_module("depthai")
    except ImportError as cause:
        message = f"OAK cameras need the library depthai, which is installed and cannot be loaded ({cause}): {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL) from cause
    if not hasattr(vendor.Pipeline, "setStopOnDeviceLoss"):
        found = getattr(vendor, "__version__", "an unknown version")
        message = f"OAK cameras need depthai 3.12 or later, found {found}: {INSTALL}"
        raise LibraryMissingError(message, install=INSTALL)
    return vendor


def nanoseconds(span: timedelta) -> int:
    """A duration of the library's, ns; its resolution is a microsecond.

    >>> nanoseconds(timedelta(milliseconds=2))
    2000000
    """
    return span // _MICROSECOND * 1_000


def microseconds(span: timedelta) -> int:
    """A duration of the library's, µs."""
    return span // _MICROSECOND

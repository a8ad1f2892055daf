"""A plug-in whose factory fails with an error of no known kind, and which talks on standard output while it loads."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

sys.stdout.write("Vendor SDK 4.2 (c) 1998\n")


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> NoReturn:
    """Fail."""
    del options, folder
    message = f"no handle for {name}"
    raise KeyError(message)


def find_devices() -> tuple[()]:
    """Find nothing."""
    sys.stdout.write("0 devices on bus 0\n")
    return ()

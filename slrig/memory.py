"""Returns freed memory to the system: glibc keeps a third of a large scan's."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

_MUCH_BYTES = 2**30
"""A scan of 1.3 megapixels holds two thirds of it, and to take memory anew costs more than is saved there."""
_STATM = Path("/proc/self/statm")


def give_back() -> None:
    """Give free memory back before the next step takes its own, where this process holds more than a gigabyte.

    Does nothing without Linux and glibc: others keep less, or have no such call.
    """
    trim = _trim()
    if trim is not None and _resident_bytes() > _MUCH_BYTES:
        trim(0)


@cache
def _trim() -> Any:
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


def _resident_bytes() -> int:
    """0 where the system does not tell."""
    with suppress(OSError):
        return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0

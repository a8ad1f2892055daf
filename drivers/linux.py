"""Operating system check of drivers that use interfaces of the Linux kernel."""

from __future__ import annotations

import sys

from slrig.errors import WrongSystemError

_NAMES = {"win32": "Windows", "darwin": "macOS"}


def require_linux(driver: str, *, through: str, instead: str) -> None:
    """Raise unless this is Linux and Python has the module `fcntl`, which the drivers need.

    Raises
    ------
    WrongSystemError
        It is another system.
    """
    found = _NAMES.get(sys.platform, sys.platform)
    try:
        import fcntl  # noqa: F401 - only its presence matters
    except ImportError:
        found += " without fcntl"
    if found == "linux":
        return
    message = f"{driver}: Linux only: it needs {through}, and this is {found}; {instead}"
    raise WrongSystemError(message)

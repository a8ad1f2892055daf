"""Aravis, loaded when it is first needed, and what its errors mean.

Aravis (LGPL) comes from the system's packages and is reached through GObject introspection: PyGObject and the
`Aravis-0.8` typelib. Neither has wheels, so both have to be named to whoever lacks them.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, LibraryMissingError, UnsupportedByDeviceError

_BUILDS = "libcairo2-dev gcc pkg-config python3-dev"


@dataclass(frozen=True, slots=True)
class AravisLibrary:
    """The loaded library: the `Aravis` namespace, and the class of the errors that come out of it."""

    aravis: Any
    error: type[Exception]


@lru_cache(maxsize=1)
def load_aravis() -> AravisLibrary:
    """Load Aravis once.

    Raises
    ------
    LibraryMissingError
        PyGObject or the Aravis typelib is not installed.
    """
    try:
        gi = importlib.import_module("gi")
        # PyGObject says ValueError where the system has no typelib of that name.
        gi.require_version("Aravis", "0.8")
        aravis = importlib.import_module("gi.repository.Aravis")
        error = importlib.import_module("gi.repository.GLib").Error
    except (ImportError, ValueError, AttributeError) as cause:
        install = install_command()
        message = (
            f"the genicam driver needs Aravis 0.8 and PyGObject, found: {cause}; on Debian or Ubuntu: "
            f"{install_command(system='linux')} (other systems: install Aravis with its introspection data, then the "
            "extra)"
        )
        raise LibraryMissingError(message, install=install) from cause
    return AravisLibrary(aravis, error)


def install_command(python: tuple[int, int] = sys.version_info[:2], system: str = sys.platform) -> str:
    """Return the command that installs what is missing, for a version of Python and a system as `sys.platform` has it.

    PyGObject from 3.51 on builds against girepository 2.0, which came after the systems with Python 3.11 and 3.12;
    the extra asks for an older PyGObject there.

    >>> "libgirepository1.0-dev" in install_command((3, 11)), "libgirepository-2.0-dev" in install_command((3, 13))
    (True, True)
    >>> install_command(system="win32")
    "pip install 'slrig[genicam]' (Aravis with its introspection data first)"
    """
    if system != "linux":
        return "pip install 'slrig[genicam]' (Aravis with its introspection data first)"
    introspection = "libgirepository-2.0-dev" if python >= (3, 13) else "libgirepository1.0-dev"
    return f"sudo apt install gir1.2-aravis-0.8 {introspection} {_BUILDS} && pip install 'slrig[genicam]'"


@contextmanager
def translate_aravis_errors(name: str, doing: str) -> Iterator[None]:
    """Turn Aravis' errors within the block into ours, with the camera's name and what was being done.

    Raises
    ------
    DeviceGoneError
        The device does not answer (Aravis asked it several times), or is not connected.
    DeviceBusyError
        Another program controls it.
    UnsupportedByDeviceError
        It has no such feature, or refused the value.
    DeviceError
        Anything else.
    """
    loaded = load_aravis()
    try:
        yield
    except loaded.error as cause:
        raise _slrig_error(loaded.aravis, name, doing, cause) from cause


def _slrig_error(aravis: Any, name: str, doing: str, cause: Any) -> DeviceError:
    what = f"camera '{name}', {doing}: {cause.message}"
    if cause.domain == "arv-gc-error-quark":
        return UnsupportedByDeviceError(f"{what}; look up what the camera offers in its manual, and ask for that")
    if cause.domain != "arv-device-error-quark":
        return DeviceError(f"{what}; check the camera's cable and power, and try again")
    codes = aravis.DeviceError
    if cause.code in {int(codes.NOT_CONNECTED), int(codes.TIMEOUT), int(codes.NOT_FOUND)}:
        return DeviceGoneError(f"{what}; the camera does not answer: check its cable and power, and open it again")
    if cause.code in {int(codes.NOT_CONTROLLER), int(codes.PROTOCOL_ERROR_ACCESS_DENIED)}:
        return DeviceBusyError(f"{what}; another program controls the camera: close that program")
    if cause.code in {int(codes.PROTOCOL_ERROR_BUSY), int(codes.TRANSFER_ERROR), int(codes.UNKNOWN)}:
        return DeviceError(f"{what}; check the camera's cable and load, and try again")
    return UnsupportedByDeviceError(f"{what}; look up what the camera offers in its manual, and ask for that")

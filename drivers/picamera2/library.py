"""picamera2, loaded when a camera is first asked for, and what its errors mean."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from slrig.devices import FoundDevice
from slrig.errors import DeviceBusyError, DeviceError, LibraryMissingError

INSTALL = "sudo apt install python3-libcamera && pip install 'slrig[picamera2]'"


def library() -> Any:
    """Return the class `Picamera2`.

    Raises
    ------
    LibraryMissingError
        picamera2, or libcamera beneath it, is not installed.
    """
    try:
        return importlib.import_module("picamera2").Picamera2
    except ImportError as cause:
        message = (
            f"cameras of a Raspberry Pi need picamera2 and the system's libcamera, found: {cause}; {INSTALL} (in a "
            "virtual environment that was made with --system-site-packages)"
        )
        raise LibraryMissingError(message, install=INSTALL) from cause


def cameras() -> tuple[dict[str, Any], ...]:
    """What libcamera tells of each camera, in picamera2's order: Id, Model, Num and more."""
    return tuple(library().global_camera_info())


@contextmanager
def told(name: str, doing: str) -> Iterator[None]:
    """Turn the library's errors within the block into slrig's: it raises RuntimeError for whatever goes wrong.

    Raises
    ------
    DeviceBusyError
        Another program has acquired the camera.
    DeviceError
        Anything else.
    """
    try:
        yield
    except RuntimeError as error:
        causes = " ".join(filter(None, (str(error), str(error.__cause__ or ""))))
        what = f"camera '{name}', {doing}: {causes}"
        if "busy" in causes.lower() or "in use" in causes.lower():
            raise DeviceBusyError(f"{what}; another program holds the camera: close that program") from error
        raise DeviceError(f"{what}; check the camera's cable, and try rpicam-hello --list-cameras") from error


def find_devices() -> tuple[FoundDevice, ...]:
    """Every camera that libcamera sees; opens none.

    Raises
    ------
    LibraryMissingError
        picamera2 is not installed.
    """
    return tuple(FoundDevice("picamera2", each["Id"], f"{each['Model']} (libcamera)") for each in cameras())

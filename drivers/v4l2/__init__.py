"""Cameras through the kernel's video interface (V4L2): webcams, USB3 cameras with a kernel driver, capture cards.

Linux only. Free-running: V4L2 has no software trigger. Needs no extra.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from drivers.linux import require_linux
from slrig.bundle import validate
from slrig.devices import Camera, FoundDevice


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a camera from a rig file's `[[camera]]` table (without driver, name, exposure_s and gain).

    Parameters
    ----------
    name
        The camera's name in the rig.
    options
        `drivers.v4l2.options.V4L2Options`.
    folder
        The rig file's folder; unused.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    DeviceGoneError
        The camera is not plugged in.
    DeviceBusyError
        Another program streams from it.
    UnsupportedByDeviceError
        The device cannot do what the options request.
    WrongSystemError
        This is not Linux.
    DeviceError
        This user may not open it, or it failed.
    """
    _require_system()
    from drivers.v4l2.camera import V4L2Camera
    from drivers.v4l2.options import V4L2Options

    del folder
    return V4L2Camera(name, validate(V4L2Options, options, f"the table of camera '{name}'"))


def find_devices() -> tuple[FoundDevice, ...]:
    """Return the cameras that are plugged in, each under a permanent and unique name.

    Raises
    ------
    WrongSystemError
        This is not Linux.
    """
    _require_system()
    from drivers.v4l2.finding import list_nodes

    return tuple(
        FoundDevice(
            "v4l2",
            node.name,
            f"{node.card} ({node.path}){f', {node.note}' if node.note else ''}",
            {} if node.focus is None else {"focus": node.focus},
        )
        for node in list_nodes()
    )


def _require_system() -> None:
    require_linux("v4l2", through="the kernel's video interface", instead="use the driver 'opencv'")


__all__ = ["find_devices", "open_camera"]

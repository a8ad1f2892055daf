"""What the kernel says of a camera and OpenCV keeps to itself: whether it is there and free, and all its controls."""

from __future__ import annotations

import os
from collections.abc import Sequence
from ctypes import Structure
from pathlib import Path

from drivers.v4l2 import kernel
from drivers.v4l2.controls import AUTOGAIN, controls_of, put, without
from drivers.v4l2.finding import identity_of
from drivers.v4l2.processing import switch_off_processing
from slrig.errors import DeviceGoneError, SlrigError


def require_free(path: str) -> None:
    """Raise unless a camera is there and nobody streams from it: only who does may free its buffers.

    Raises
    ------
    DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError, DeviceError
        It is not there, is used, gives no frames, may not be opened.
    """
    none = kernel.BufferRequest(count=0, type=kernel.CAPTURE, memory=kernel.MMAP)
    _asked(path, "asking for frames", kernel.REQBUFS, none)


def require_present(path: str, otherwise: DeviceGoneError) -> None:
    """Raise `otherwise` unless the camera answers."""
    try:
        _asked(path, "asking what it is", kernel.QUERYCAP, kernel.Capability())
    except SlrigError as error:
        raise otherwise from error


def plain_pictures(path: str, skipped: Sequence[str]) -> tuple[frozenset[int], tuple[str, ...]]:
    """Switch a camera's automatic gain and its own image processing off, which OpenCV has no names for.

    Return the numbers of the controls that are left alone, by the names that `skipped` has, and notes for a person.

    Raises
    ------
    DeviceGoneError, DeviceError
        It is not there, or fails.
    UnsupportedByDeviceError
        It has no control of such a name, or its automatic gain cannot be switched off.
    """
    node = Path(path)
    try:
        handle = kernel.open_node(node)
        try:
            everything = controls_of(handle)
            mine = without(everything, skipped, node)
            if AUTOGAIN in mine:
                put(handle, node, mine[AUTOGAIN], 0)
            notes = switch_off_processing(handle, node, mine, named=(), is_uvc=identity_of(handle).is_uvc)
        finally:
            os.close(handle)
    except OSError as error:
        raise kernel.fault(node, "setting its controls", error) from error
    return frozenset(everything.keys() - mine.keys()), notes


def _asked(path: str, doing: str, request: int, argument: Structure) -> None:
    try:
        handle = kernel.open_node(Path(path))
        try:
            kernel.ask(handle, request, argument)
        finally:
            os.close(handle)
    except OSError as error:
        raise kernel.fault(Path(path), doing, error) from error

"""Cameras that are plugged in, under permanent and unique names.

A node number (`/dev/video0`) depends on the order of plugging in. udev's `by-id` names contain the USB serial number;
two cameras of one model without serial numbers share one, so such a name is used only where a serial number is present
and no other node has the same. Next comes udev's `by-path` name (the port), then the bus as the driver names it.
"""

from __future__ import annotations

import errno
import os
import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.v4l2 import kernel
from drivers.v4l2.controls import FOCUS_ABSOLUTE
from slrig.errors import DeviceGoneError

SYSFS = Path("/sys/class/video4linux")
DEV = Path("/dev")


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """Identity of a node. captures : it streams frames in one plane. is_uvc : it uses the kernel's driver for USB Video
    Class cameras. focus : position of its lens; None without a motor.
    """

    card: str
    bus: str
    captures: bool
    several_planes: bool = False
    is_uvc: bool = False
    focus: int | None = None


@dataclass(frozen=True, slots=True)
class CameraNode:
    """A camera's node and its permanent name. serial : serial number of the USB device, or "". focus : see
    `NodeIdentity`.
    """

    path: Path
    name: str
    card: str
    serial: str
    note: str = ""
    focus: int | None = None


_NO_CAMERA = NodeIdentity(card="", bus="", captures=False)


def query_identity(handle: int) -> NodeIdentity:
    """Read the identity of an open node. Raises OSError."""
    answer = kernel.Capability()
    kernel.ioctl(handle, kernel.QUERYCAP, answer)
    known = answer.capabilities & kernel.CAP_DEVICE_CAPS
    can = answer.device_caps if known else answer.capabilities
    return NodeIdentity(
        card=answer.card.decode("utf-8", "replace"),
        bus=answer.bus_info.decode("utf-8", "replace"),
        captures=bool(can & kernel.CAP_VIDEO_CAPTURE and can & kernel.CAP_STREAMING),
        several_planes=bool(can & kernel.CAP_VIDEO_CAPTURE_MPLANE),
        is_uvc=answer.driver == b"uvcvideo",
    )


def probe_node(path: Path) -> NodeIdentity | None:
    """Open a node, read its identity, and close it. None if this user may not open it.

    The node of an unplugged camera stays as long as a program has it open, and does not count as a camera.
    """
    try:
        handle = kernel.open_node(path)
    except OSError as error:
        return None if error.errno in (errno.EACCES, errno.EPERM) else _NO_CAMERA
    try:
        return replace(query_identity(handle), focus=_focus(handle))
    except OSError:
        return _NO_CAMERA
    finally:
        os.close(handle)


def _focus(handle: int) -> int | None:
    answer = kernel.ControlValue(id=FOCUS_ABSOLUTE)
    try:
        kernel.ioctl(handle, kernel.G_CTRL, answer)
    except OSError:
        return None
    return int(answer.value)


@dataclass(frozen=True, slots=True)
class _NodeCandidate:
    path: Path
    identity: NodeIdentity | None
    index: str
    usb: tuple[str, str, str] | None
    label: str

    @property
    def key(self) -> tuple[tuple[str, str, str] | None, str]:
        return (self.usb, self.index)


def list_nodes(
    sysfs: Path = SYSFS, dev: Path = DEV, probe: Callable[[Path], NodeIdentity | None] = probe_node
) -> tuple[CameraNode, ...]:
    """Return every camera that is plugged in, each under a unique name.

    Nodes without frames (metadata, outputs, codecs) are left out. A node that this user may not open has a note.
    """
    candidates = [candidate for name in _names(sysfs) if (candidate := _candidate(sysfs / name, dev / name, probe))]
    serials = Counter(candidate.key for candidate in candidates)
    by_id, by_path = _links(dev / "v4l" / "by-id"), _links(dev / "v4l" / "by-path")
    found = []
    for candidate in candidates:
        is_unique = candidate.usb is not None and bool(candidate.usb[2]) and serials[candidate.key] == 1
        real = os.path.realpath(candidate.path)
        name = (by_id.get(real) if is_unique else None) or by_path.get(real) or _bus_name(candidate)
        serial = candidate.usb[2] if candidate.usb is not None else ""
        note = "" if candidate.identity is not None else "may not be opened: sudo usermod -aG video $USER"
        focus = None if candidate.identity is None else candidate.identity.focus
        found.append(CameraNode(candidate.path, name, candidate.label, serial, note, focus))
    return _rename_duplicates(found, {candidate.path: _bus_name(candidate) for candidate in candidates})


def resolve_node(device: str, dev: Path = DEV, find: Callable[[], tuple[CameraNode, ...]] = list_nodes) -> CameraNode:
    """Return the node of a path or of a name that `list_nodes` returns.

    Raises
    ------
    DeviceGoneError
        No such camera is connected.
    """
    found = find()
    if device.startswith("/"):
        path = Path(device)
        real = os.path.realpath(path)
        for node in found:
            if os.path.realpath(node.path) == real:
                return node
        if path.exists():
            return CameraNode(Path(real), device, device, "")
    for node in found:
        if node.name == device:
            return node
    # udev's names are accepted even where `list_nodes` prefers another one.
    for folder in ("by-id", "by-path"):
        link = dev / "v4l" / folder / device
        if "/" not in device and link.exists():
            return resolve_node(str(link), dev, find)
    have = "; ".join(f"{node.name} ({node.card}, {node.path})" for node in found) or "no camera"
    message = f'device = "{device}": this camera was requested, found {have}; plug it in, or write one of those names'
    raise DeviceGoneError(message)


def _names(sysfs: Path) -> list[str]:
    try:
        names = [entry.name for entry in sysfs.iterdir()]
    except OSError:
        return []
    return sorted((name for name in names if re.fullmatch(r"video\d+", name)), key=lambda name: int(name[5:]))


def _candidate(entry: Path, node: Path, probe: Callable[[Path], NodeIdentity | None]) -> _NodeCandidate | None:
    identity = probe(node)
    if identity is not None and not identity.captures:
        return None
    folder = Path(os.path.realpath(entry))
    label = identity.card if identity is not None else _text(folder / "name") or node.name
    return _NodeCandidate(node, identity, _text(folder / "index"), _usb(folder), label)


def _usb(folder: Path) -> tuple[str, str, str] | None:
    """Return vendor, product and serial number ("" without one) of the USB device that a node belongs to."""
    for parent in folder.parents:
        vendor = _text(parent / "idVendor")
        if vendor:
            return vendor, _text(parent / "idProduct"), _text(parent / "serial")
    return None


def _bus_name(candidate: _NodeCandidate) -> str:
    """Return the bus and the node's index on it: permanent while the camera stays in its port."""
    bus = candidate.identity.bus if candidate.identity is not None else ""
    return f"{bus or candidate.path.name}#{candidate.index or '0'}"


def _links(folder: Path) -> dict[str, str]:
    """Return names that udev made, by the real path of their node; the first in order if a node has several."""
    found: dict[str, str] = {}
    with suppress(OSError):
        for link in sorted(folder.iterdir()):
            found.setdefault(os.path.realpath(link), link.name)
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _rename_duplicates(found: list[CameraNode], buses: dict[Path, str]) -> tuple[CameraNode, ...]:
    """Name nodes that share a name by their bus, and if they still do, by their path."""
    for better in (buses, {path: str(path) for path in buses}):
        often = Counter(node.name for node in found)
        found = [replace(node, name=better[node.path]) if often[node.name] > 1 else node for node in found]
    return tuple(found)

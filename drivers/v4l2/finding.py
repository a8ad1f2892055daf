"""Which cameras are plugged in, under names that stay the same and never stand for two.

A node number (`/dev/video0`) depends on the order of plugging in. udev's `by-id` names hold the USB serial number; two
cameras of one model without serial numbers share one, so such a name is taken only where a serial number is present
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
from slrig.devices import FoundDevice
from slrig.errors import DeviceGoneError

SYSFS = Path("/sys/class/video4linux")
DEV = Path("/dev")


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """What a node says of itself. `captures`: it gives frames in one plane, and streams them. `is_uvc`: the kernel's
    driver is that of USB Video Class cameras.
    """

    card: str
    bus: str
    captures: bool
    several_planes: bool = False
    is_uvc: bool = False


@dataclass(frozen=True, slots=True)
class CameraNode:
    """A camera's node and its stable name. serial : the USB device's own, or ""."""

    path: Path
    name: str
    card: str
    serial: str
    note: str = ""


_NO_CAMERA = NodeIdentity(card="", bus="", captures=False)


def query_identity(handle: int) -> NodeIdentity:
    """Ask an open node who it is. Raises OSError."""
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
    """Open a node, ask who it is, and close it. None where we may not open it.

    The node of a camera that was unplugged stays for as long as a program has it open: it is no camera any more.
    """
    try:
        handle = kernel.open_node(path)
    except OSError as error:
        return None if error.errno in (errno.EACCES, errno.EPERM) else _NO_CAMERA
    try:
        return query_identity(handle)
    except OSError:
        return _NO_CAMERA
    finally:
        os.close(handle)


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
    sysfs: Path = SYSFS, dev: Path = DEV, ask: Callable[[Path], NodeIdentity | None] = probe_node
) -> tuple[CameraNode, ...]:
    """Return every camera that is plugged in, each under a name that no other has.

    Nodes that give no frames (metadata, outputs, codecs) are left out. A node that may not be opened is listed with a
    note, for its user to see why it cannot be used.
    """
    candidates = [candidate for name in _names(sysfs) if (candidate := _candidate(sysfs / name, dev / name, ask))]
    serials = Counter(candidate.key for candidate in candidates)
    by_id, by_path = _links(dev / "v4l" / "by-id"), _links(dev / "v4l" / "by-path")
    found = []
    for candidate in candidates:
        own = candidate.usb is not None and bool(candidate.usb[2]) and serials[candidate.key] == 1
        real = os.path.realpath(candidate.path)
        name = (by_id.get(real) if own else None) or by_path.get(real) or _bus_name(candidate)
        serial = candidate.usb[2] if candidate.usb is not None else ""
        note = "" if candidate.identity is not None else "may not be opened: sudo usermod -aG video $USER"
        found.append(CameraNode(candidate.path, name, candidate.label, serial, note))
    return _rename_duplicates(found, {candidate.path: _bus_name(candidate) for candidate in candidates})


def to_found_devices(found: tuple[CameraNode, ...]) -> tuple[FoundDevice, ...]:
    """The nodes in the words of `slrig devices`."""
    return tuple(
        FoundDevice("v4l2", node.name, f"{node.card} ({node.path}){f', {node.note}' if node.note else ''}")
        for node in found
    )


def resolve_node(device: str, dev: Path = DEV, look: Callable[[], tuple[CameraNode, ...]] = list_nodes) -> CameraNode:
    """Return the node that a rig file means: a path, or a name that `list_nodes` gives.

    Raises
    ------
    DeviceGoneError
        There is none such now.
    """
    found = look()
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
    # udev's names may be written even where `list_nodes` prefers another one.
    for folder in ("by-id", "by-path"):
        link = dev / "v4l" / folder / device
        if "/" not in device and link.exists():
            return resolve_node(str(link), dev, look)
    have = "; ".join(f"{node.name} ({node.card}, {node.path})" for node in found) or "no camera at all"
    message = f'device = "{device}": asked for this camera, found {have}; plug it in, or write one of those names'
    raise DeviceGoneError(message)


def _names(sysfs: Path) -> list[str]:
    try:
        names = [entry.name for entry in sysfs.iterdir()]
    except OSError:
        return []
    return sorted((name for name in names if re.fullmatch(r"video\d+", name)), key=lambda name: int(name[5:]))


def _candidate(entry: Path, node: Path, ask: Callable[[Path], NodeIdentity | None]) -> _NodeCandidate | None:
    identity = ask(node)
    if identity is not None and not identity.captures:
        return None
    folder = Path(os.path.realpath(entry))
    label = identity.card if identity is not None else _text(folder / "name") or node.name
    return _NodeCandidate(node, identity, _text(folder / "index"), _usb(folder), label)


def _usb(folder: Path) -> tuple[str, str, str] | None:
    """Vendor, product and serial number ("" if it has none) of the USB device that a node belongs to."""
    for parent in folder.parents:
        vendor = _text(parent / "idVendor")
        if vendor:
            return vendor, _text(parent / "idProduct"), _text(parent / "serial")
    return None


def _bus_name(candidate: _NodeCandidate) -> str:
    """The bus and the node's place on it: stable as long as the camera stays in its port."""
    bus = candidate.identity.bus if candidate.identity is not None else ""
    return f"{bus or candidate.path.name}#{candidate.index or '0'}"


def _links(folder: Path) -> dict[str, str]:
    """Names that udev made, by the real path of their node; of several for one node, the first in order."""
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
    """Give those that share a name the name of their bus, and those that still do, their path."""
    for better in (buses, {path: str(path) for path in buses}):
        often = Counter(node.name for node in found)
        found = [replace(node, name=better[node.path]) if often[node.name] > 1 else node for node in found]
    return tuple(found)

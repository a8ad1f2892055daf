"""Limits of a camera's link: memory of the USB subsystem, packets, and rights of the user."""

from __future__ import annotations

import os
from pathlib import Path

from drivers.genicam.connection import GenICamConnection
from slrig.devices import FoundDevice

USBFS = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
RECEIVE = Path("/proc/sys/net/core/rmem_max")
USB = Path("/sys/bus/usb/devices")
NODES = Path("/dev/bus/usb")
_FRAMES = 32
"""Frames of a scan that may be under way at once: by wire, all have their buffers before the first comes."""
_SMALL_PACKET_BYTES = 8000
_USB3_VISION = ("ef", "05")
"""Class and subclass of its interfaces (USB3 Vision 1.0, Miscellaneous)."""


def link_notes(connection: GenICamConnection) -> list[str]:
    """Return notes on limits that may lose or delay frames of the present size."""
    features = connection.features
    with connection.access("reading the size of a frame") as camera:
        frame_bytes = int(camera.get_payload())
    notes = []
    if connection.is_usb:
        needed_mb = -(-_FRAMES * frame_bytes // 10**6)
        memory_mb = _number(USBFS)
        if 0 < memory_mb < needed_mb:
            better_mb = max(needed_mb, 1000)
            notes.append(
                f"all USB cameras together have {memory_mb} MB of the system (usbfs_memory_mb), {_FRAMES} of its frames"
                f" need {needed_mb} MB: frames may be lost without an error; run: sudo sh -c 'echo {better_mb} > "
                f"{USBFS}', and to keep it add usbcore.usbfs_memory_mb={better_mb} to the kernel's command line"
            )
    elif features.has("GevSCPSPacketSize"):
        packet_bytes, kept_bytes = int(features.value("GevSCPSPacketSize")), _number(RECEIVE)
        if packet_bytes < _SMALL_PACKET_BYTES:
            notes.append(
                f"its packets have {packet_bytes} bytes, {-(-frame_bytes // packet_bytes)} a frame: with so many the "
                "computer may lose some; allow long ones on its network card (sudo ip link set dev CARD mtu 9000)"
            )
        if 0 < kept_bytes < frame_bytes:
            notes.append(
                f"the system buffers {kept_bytes} bytes, less than its frame of {frame_bytes}: packets "
                f"may be lost; run: sudo sysctl -w net.core.rmem_max={max(2 * frame_bytes, 1 << 25)}"
            )
    limit = "DeviceLinkThroughputLimit"
    if features.has(limit):
        with connection.access("reading the limit of its link") as camera:
            most_bytes_s = int(camera.get_integer_bounds(limit)[1])
        bytes_s = int(features.value(limit))
        if 0 < bytes_s < most_bytes_s:
            notes.append(
                f"it sends at most {bytes_s / 1e6:.3g} MB/s ({limit}; it could send {most_bytes_s / 1e6:.3g}), a frame "
                f"every {frame_bytes / bytes_s * 1e3:.3g} ms; features = {{ {limit} = {most_bytes_s} }} lifts that"
            )
    return notes


def find_forbidden(usb: Path = USB, nodes: Path = NODES) -> tuple[FoundDevice, ...]:
    """Return the USB3 Vision cameras that are plugged in and that this user may not open, each with its udev rule."""
    names = {
        interface.name.split(":")[0]
        for interface in usb.glob("*:*")
        if tuple(_text(interface / f"bInterface{each}") for each in ("Class", "SubClass")) == _USB3_VISION
    }
    found = []
    for device in (usb / name for name in sorted(names)):
        node = nodes / _text(device / "busnum").zfill(3) / _text(device / "devnum").zfill(3)
        if os.access(node, os.R_OK | os.W_OK):
            continue
        serial = _text(device / "serial")
        rule = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{_text(device / "idVendor")}", MODE="0660", TAG+="uaccess"'
        label = (
            f"{_text(device / 'manufacturer')} {_text(device / 'product')} {serial} (USB3Vision): this user may not "
            f"open it; write the line {rule} into /etc/udev/rules.d/60-usb3-vision.rules, run: sudo udevadm control "
            "--reload, and plug it in again"
        )
        found.append(FoundDevice("genicam", serial or device.name, label))
    return tuple(found)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _number(path: Path) -> int:
    """Return a number of the kernel's; 0 if it has none of that name."""
    text = _text(path)
    return int(text) if text.isdecimal() else 0

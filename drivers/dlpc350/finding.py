"""Which light engines are plugged in, told from /sys alone: nothing is opened.

A hidraw node's `device/uevent` names bus, vendor and product (HID_ID), the serial number (HID_UNIQ) and the port
(HID_PHYS): kernel, drivers/hid/hid-core.c. A serial number that two engines share, or none, stands for no engine: the
port does then.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from slrig.devices import FoundDevice
from slrig.errors import ConfigError, DeviceGoneError

SYSFS = Path("/sys/class/hidraw")
DEV = Path("/dev")
HID_ID = "00000451:00006401"


@dataclass(frozen=True, slots=True)
class Node:
    """An engine's node. name : the serial number where that is the engine's alone, else its port, else the path."""

    path: Path
    name: str
    label: str


def engines(sysfs: Path = SYSFS, dev: Path = DEV) -> tuple[Node, ...]:
    """Return the engines that are plugged in, each under a name that no other has."""
    try:
        names = sorted((entry.name for entry in sysfs.iterdir()), key=_number)
    except OSError:
        return ()
    found = [(dev / name, facts) for name in names if HID_ID in (facts := _facts(sysfs / name)).get("HID_ID", "")]
    for_key = {key: Counter(facts.get(key, "") for _, facts in found) for key in ("HID_UNIQ", "HID_PHYS")}
    nodes = []
    for path, facts in found:
        own = [facts[key] for key, often in for_key.items() if facts.get(key) and often[facts[key]] == 1]
        nodes.append(Node(path, (own or [str(path)])[0], facts.get("HID_NAME", "light engine")))
    return tuple(nodes)


def found_devices(found: tuple[Node, ...]) -> tuple[FoundDevice, ...]:
    """The engines in the words of `slrig devices`."""
    return tuple(FoundDevice("dlpc350", node.name, f"{node.label} ({node.path})") for node in found)


def resolved(device: str | None, found: tuple[Node, ...]) -> Node:
    """Return the engine that a rig file means: a name that `engines` gives, a path, or the only one there is.

    Raises
    ------
    DeviceGoneError
        There is none such now.
    ConfigError
        Several are plugged in, and the file names none.
    """
    have = "; ".join(f"{node.name} ({node.path})" for node in found) or "none"
    chosen = [node for node in found if device in (None, node.name, str(node.path))]
    if not chosen:
        asked = "a light engine" if device is None else f'the light engine "{device}"'
        message = f"asked for {asked}, plugged in: {have}; plug it in and power it, or write one of those names"
        raise DeviceGoneError(message)
    if len(chosen) > 1:
        message = f'[projector] names no light engine, plugged in: {have}; write device = "…" with one of those names'
        raise ConfigError(message)
    return chosen[0]


def _facts(entry: Path) -> dict[str, str]:
    try:
        lines = (entry / "device" / "uevent").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return {}
    return {key: value.strip() for key, _, value in (line.partition("=") for line in lines)}


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits.group()) if digits else 0, name)

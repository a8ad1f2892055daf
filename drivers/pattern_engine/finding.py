"""Which light engines are plugged in, told from /sys alone: nothing is opened.

A hidraw node's `device/uevent` names bus, vendor and product (HID_ID), the serial number (HID_UNIQ) and the port
(HID_PHYS): kernel, drivers/hid/hid-core.c. An engine may have several HID interfaces; commands go to the first (TI's
usb.c, `USB_Open`), whose port ends in "/input0" (kernel, drivers/hid/usbhid/hid-core.c). A serial number that two
engines share, or none, stands for no engine: the port does then.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from drivers.linux import require_linux
from drivers.pattern_engine.link import TI, UsbController
from slrig.devices import FoundDevice
from slrig.errors import ConfigError, DeviceGoneError

SYSFS = Path("/sys/class/hidraw")
DEV = Path("/dev")


@dataclass(frozen=True, slots=True)
class EngineNode:
    """An engine's node. name : the serial number where that is the engine's alone, else its port, else the path."""

    path: Path
    name: str
    label: str


def find_engines(kind: UsbController, sysfs: Path = SYSFS, dev: Path = DEV) -> tuple[EngineNode, ...]:
    """Return the engines that are plugged in, each under a name that no other has."""
    try:
        names = sorted((entry.name for entry in sysfs.iterdir()), key=_number)
    except OSError:
        return ()
    wanted = f"{TI:08X}:{kind.product:08X}"
    listed = ((dev / name, _read_facts(sysfs / name)) for name in names)
    found = [(path, facts) for path, facts in listed if wanted in facts.get("HID_ID", "") and _is_first(facts)]
    for_key = {key: Counter(facts.get(key, "") for _, facts in found) for key in ("HID_UNIQ", "HID_PHYS")}
    nodes = []
    for path, facts in found:
        own = [facts[key] for key, often in for_key.items() if facts.get(key) and often[facts[key]] == 1]
        nodes.append(EngineNode(path, (own or [str(path)])[0], facts.get("HID_NAME", "light engine")))
    return tuple(nodes)


def require_hidraw(kind: UsbController) -> None:
    """Raise WrongSystemError unless this is Linux."""
    require_linux(kind.driver, through="the kernel's /dev/hidraw*", instead="run slrig on Linux for it")


def list_devices(kind: UsbController, sysfs: Path = SYSFS) -> tuple[FoundDevice, ...]:
    """The engines in the words of `slrig devices`. Raises WrongSystemError: this is not Linux."""
    require_hidraw(kind)
    return tuple(
        FoundDevice(kind.driver, node.name, f"{node.label} ({node.path})") for node in find_engines(kind, sysfs)
    )


def choose_engine(device: str | None, found: tuple[EngineNode, ...]) -> EngineNode:
    """Return the engine that a rig file means: a name that `find_engines` gives, a path, or the only one there is.

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


def _is_first(facts: dict[str, str]) -> bool:
    """Whether this is the engine's first interface, as far as its port tells."""
    number = re.search(r"/input(\d+)$", facts.get("HID_PHYS", ""))
    return number is None or int(number[1]) == 0


def _read_facts(entry: Path) -> dict[str, str]:
    try:
        lines = (entry / "device" / "uevent").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return {}
    return {key: value.strip() for key, _, value in (line.partition("=") for line in lines)}


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits.group()) if digits else 0, name)

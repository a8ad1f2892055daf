"""Connectors as the kernel lists them in /sys/class/drm: no card is opened, so no desktop is disturbed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from drivers.display.projector import Edid, parse_edid
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError

SYSTEM = Path("/sys/class/drm")
DEVICES = Path("/dev/dri")

_CONNECTOR = re.compile(r"(card\d+)-(.+)")
_NEVER = ("Writeback",)


@dataclass(frozen=True, slots=True)
class ListedConnector:
    """A connector of a graphics card.

    card : the card's node. status : connected, disconnected or unknown, as last detected. mode : the first mode of its
    display, as WxH; empty without one.
    """

    name: str
    card: Path
    status: str
    mode: str
    edid: Edid | None

    def __str__(self) -> str:
        display = ", ".join(part for part in (str(self.edid or ""), self.mode or self.status) if part)
        return f"{self.name} ({display})"


def list_connectors() -> tuple[ListedConnector, ...]:
    """List every connector of every card, by name."""
    found = []
    for folder in SYSTEM.glob("card*-*"):
        matched = _CONNECTOR.fullmatch(folder.name)
        if matched is not None and not matched[2].startswith(_NEVER):
            lines = _read(folder / "modes").decode("ascii", "replace").split()
            found.append(
                ListedConnector(
                    matched[2],
                    DEVICES / matched[1],
                    _read(folder / "status").decode("ascii", "replace").strip() or "unknown",
                    lines[0] if lines else "",
                    parse_edid(_read(folder / "edid")),
                )
            )
    return tuple(sorted(found, key=lambda connector: connector.name))


def find_connector(name: str) -> ListedConnector:
    """Return the connector of that name.

    Raises
    ------
    UnsupportedByDeviceError
        No connector has that name, or no card exists. Lists the connectors.
    """
    connectors = list_connectors()
    if not connectors:
        message = (
            f"output {name}: the kernel has no display output (nothing in {SYSTEM}); its graphics driver is not loaded "
            "(nomodeset in the kernel's command line, or nvidia_drm without modeset=1), or this is a container that "
            "was not given /dev/dri"
        )
        raise UnsupportedByDeviceError(message)
    for connector in connectors:
        if connector.name == name:
            return connector
    names = "; ".join(map(str, connectors))
    message = (
        f"output {name}: the kernel has no connector of that name; it has: {names}; write one of these names into the "
        "rig file (X names them differently: its HDMI-1 is HDMI-A-1 here)"
    )
    raise UnsupportedByDeviceError(message)


def not_connected_error(name: str) -> DeviceGoneError:
    """Return the error for an output with nothing connected."""
    others = "; ".join(str(each) for each in list_connectors() if each.status == "connected") or "none"
    message = (
        f"output {name}: nothing is connected to it; connected are: {others}; check the cable and that the projector "
        "is on and not in stand-by, or write one of these names into the rig file"
    )
    return DeviceGoneError(message)


def is_unplugged(name: str, card: Path) -> bool:
    """True if the kernel has noticed that nothing is connected."""
    return _read(SYSTEM / f"{card.name}-{name}" / "status").strip() == b"disconnected"


def read_edid(name: str, card: Path) -> Edid | None:
    """Return the EDID of the connected display, as last detected."""
    return parse_edid(_read(SYSTEM / f"{card.name}-{name}" / "edid"))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        # The card was unplugged meanwhile.
        return b""

"""Which program has a graphics card, as far as this user may know, and how to get it from there."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from slrig.errors import DeviceBusyError

PROCESSES = Path("/proc")

_DESKTOPS = frozenset(
    {
        *("Xorg", "X", "gnome-shell", "kwin_wayland", "kwin_x11", "sway", "weston", "labwc", "wayfire", "Hyprland"),
        *("cosmic-comp", "mutter", "cage", "phoc", "gamescope", "plymouthd"),
    }
)
"""Programs that take graphics cards, by the kernel's name of their processes."""


def held(path: Path, output: str) -> DeviceBusyError:
    """Say who has a card, and what to do."""
    who = ", ".join(_named(path)) or "another program"
    message = (
        f"output {output}: {path} is held by {who}; one program at a time says what a graphics card shows. Either show "
        "patterns through it: driver 'screen', in a session of X, as Xorg for the projector alone is, too. Or have it "
        "let the card go: end the desktop (sudo systemctl isolate multi-user.target), or go to a text console "
        "(Ctrl+Alt+F3) and stay there. Or give the projector a graphics card of its own, which the desktop is told to "
        "leave alone (config/deploy/README.md)"
    )
    return DeviceBusyError(message)


def _named(path: Path) -> list[str]:
    """Processes that have the card open; where none is to be seen, those that are known to take cards."""
    opened: list[str] = []
    known: list[str] = []
    ours = str(os.getpid())
    for folder in PROCESSES.glob("[0-9]*"):
        # Processes end while we look, and those of other users hide what they have open.
        with suppress(OSError):
            name = (folder / "comm").read_text().strip()
            words = f"{name} (process {folder.name})"
            if name in _DESKTOPS:
                known.append(words)
            if folder.name != ours and any(_leads_to(link, path) for link in (folder / "fd").iterdir()):
                opened.append(words)
    return opened or known


def _leads_to(link: Path, path: Path) -> bool:
    try:
        return link.readlink() == path
    except OSError:
        return False

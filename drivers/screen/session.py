"""Remedies for a session that shows no exact pixels, by the desktop that runs."""

from __future__ import annotations

import os
import sys

_X_SESSIONS = {
    "gnome": (
        "log out, choose 'GNOME on Xorg' ('Ubuntu on Xorg') by the cog wheel of the login screen, and log in; GNOME 49 "
        "and later have no such session"
    ),
    "kde": (
        "log out, choose 'Plasma (X11)' at the login screen, and log in; if it is not offered: sudo apt install "
        "plasma-session-x11 (Fedora: dnf install plasma-workspace-x11)"
    ),
    "cinnamon": "log out, choose 'Cinnamon', not 'Cinnamon on Wayland', at the login screen, and log in",
    "labwc": "run sudo raspi-config, choose Advanced Options, Wayland, X11, and start the machine again",
}
"""Steps to a session with X, by a part of the environment's XDG_CURRENT_DESKTOP."""

_COMPOSITORS = {
    ("xfwm4", "xfce"): "switch compositing off: xfconf-query -c xfwm4 -p /general/use_compositing -s false",
    ("kwin", "kde"): "switch compositing off: Shift+Alt+F12",
    ("muffin", "cinnamon"): "run: gsettings set org.cinnamon.muffin unredirect-fullscreen-windows true",
    ("marco", "mate"): "switch compositing off: gsettings set org.mate.Marco.general compositing-manager false",
    ("picom",): "set unredir-if-possible = true in picom.conf, or end picom",
    ("gnome", "mutter"): "no setting of GNOME changes that: log in to another desktop with X, such as Xfce",
}
"""Steps to exempt a window, by a part of a compositor's name or XDG_CURRENT_DESKTOP."""

WITHOUT_DESKTOP = (
    "or show patterns without a desktop, by the driver 'kms': end the desktop (sudo systemctl isolate "
    "multi-user.target), log in on the text console, where slrig devices names the output for the rig file, and bring "
    "the desktop back afterwards (sudo systemctl isolate graphical.target)"
)


def session_name() -> str:
    """Describe a session that has no X."""
    if sys.platform != "linux":
        return {"win32": "Windows", "darwin": "macOS"}.get(sys.platform, sys.platform)
    desktop = os.environ.get("XDG_CURRENT_DESKTOP", "")
    if os.environ.get("WAYLAND_DISPLAY") or os.environ.get("XDG_SESSION_TYPE") == "wayland":
        return f"a session without X: Wayland{desktop and f' ({desktop})'}"
    return "a session without X: neither DISPLAY nor WAYLAND_DISPLAY is set"


def exact_session() -> str:
    """Describe the steps to a session that shows exact pixels."""
    if sys.platform != "linux":
        return "use Linux with X for the projector"
    desktop = os.environ.get("XDG_CURRENT_DESKTOP", "").lower()
    found = next((steps for name, steps in _X_SESSIONS.items() if name in desktop), None)
    if found is None:
        found = "log in to a session with X (Xorg)"
        if not os.environ.get("WAYLAND_DISPLAY") and not os.environ.get("DISPLAY"):
            found = f"if one with X runs on this machine, set DISPLAY=:0 and XAUTHORITY as they are there; else {found}"
    return f"{found}; {WITHOUT_DESKTOP}"


def exempting(compositor: str) -> str:
    """Describe how to keep a compositor of X from drawing the patterns. compositor : its name, "" if it has none."""
    for known in (compositor.lower(), os.environ.get("XDG_CURRENT_DESKTOP", "").lower()):
        for names, steps in _COMPOSITORS.items():
            if any(name in known for name in names):
                return f"{steps}; {WITHOUT_DESKTOP}"
    return f"switch compositing off in the settings of the desktop; {WITHOUT_DESKTOP}"

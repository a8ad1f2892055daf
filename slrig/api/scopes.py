"""Scopes of keys, and the scope that a request needs. Loads nothing heavy: commands read it."""

from __future__ import annotations

from enum import StrEnum


class KeyScope(StrEnum):
    """Permissions of a key. Every key may read."""

    LOOK = "look"
    SCAN = "scan"
    CALIBRATE = "calibrate"
    ADMINISTER = "administer"


READING = frozenset({"GET", "HEAD", "OPTIONS"})


_SCOPES = {
    "session": KeyScope.LOOK,
    "scan": KeyScope.SCAN,
    "live": KeyScope.SCAN,
    "model": KeyScope.SCAN,
    "exposure": KeyScope.SCAN,
    "calibration": KeyScope.CALIBRATE,
    "acceptance": KeyScope.CALIBRATE,
    "hand-eye": KeyScope.CALIBRATE,
    "rig": KeyScope.CALIBRATE,
}


RIG_FILE = ("/rig/file", "/rig/settings")
"""Its options may hold a password, and name files and programs."""


def needed_scope(method: str, path: str) -> KeyScope:
    """The scope that a key needs for a request. Reading needs `look`, except a preview and live depth, which use the
    rig, and the rig file.

    >>> [str(needed_scope("GET", path)) for path in ("/scan", "/live", "/preview/left", "/live/depth", "/audit")]
    ['look', 'look', 'scan', 'scan', 'administer']
    >>> [str(needed_scope("POST", path)) for path in ("/scan", "/rig/verification", "/schedule")]
    ['scan', 'calibrate', 'administer']
    >>> [str(needed_scope(method, "/rig/file")) for method in ("GET", "PUT")]
    ['administer', 'administer']
    """
    if path in RIG_FILE:
        return KeyScope.ADMINISTER
    room = path.split("/")[1] if "/" in path else ""
    if moves(method, path):
        return KeyScope.SCAN if room == "preview" else _SCOPES.get(room, KeyScope.ADMINISTER)
    return KeyScope.ADMINISTER if room == "audit" else KeyScope.LOOK


def moves(method: str, path: str) -> bool:
    """Whether a request changes something, or moves light or rig."""
    return method not in READING or path.startswith(("/preview/", "/live/"))

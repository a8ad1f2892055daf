"""What a key is for, and what for a request needs one."""

from __future__ import annotations

from enum import StrEnum


class Scope(StrEnum):
    """What a key is for. Every key may look."""

    LOOK = "look"
    SCAN = "scan"
    CALIBRATE = "calibrate"
    ADMINISTER = "administer"


READING = frozenset({"GET", "HEAD", "OPTIONS"})
_SCOPES = {
    "session": Scope.LOOK,
    "scan": Scope.SCAN,
    "model": Scope.SCAN,
    "exposure": Scope.SCAN,
    "calibration": Scope.CALIBRATE,
    "acceptance": Scope.CALIBRATE,
    "rig": Scope.CALIBRATE,
}


def needed_scope(method: str, path: str) -> Scope:
    """What a key must be for to send this request: reading is looking, but for a preview, which takes the rig.

    >>> [str(needed_scope("GET", path)) for path in ("/scan", "/preview/left", "/audit")]
    ['look', 'scan', 'administer']
    >>> [str(needed_scope("POST", path)) for path in ("/scan", "/rig/verification", "/schedule")]
    ['scan', 'calibrate', 'administer']
    """
    room = path.split("/")[1] if "/" in path else ""
    if moves(method, path):
        return Scope.SCAN if room == "preview" else _SCOPES.get(room, Scope.ADMINISTER)
    return Scope.ADMINISTER if room == "audit" else Scope.LOOK


def moves(method: str, path: str) -> bool:
    """Whether a request changes something, or moves light or rig."""
    return method not in READING or path.startswith("/preview/")

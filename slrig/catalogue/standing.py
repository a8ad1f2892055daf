"""How a rig is, as its service knows it: what the catalogue is told of it."""

from __future__ import annotations

import importlib.metadata
import platform
from datetime import datetime
from pathlib import Path
from typing import Any

from slrig.calibrate.verification import RigHealth
from slrig.jobs.manager import JobManager, RigStatus
from slrig.jobs.worker import READY


def standing(manager: JobManager, health_of: RigHealth, *, data: Path, started_at: datetime) -> dict[str, Any]:
    """The columns of a rig's row, but for when it is seen and what is not copied. data : the service's folder."""
    status = manager.status()
    health, latest, _ = health_of.health()
    state, words = _state(status)
    return {
        "name": status.rig,
        "origin": f"{platform.node()}:{data}",
        "host": platform.node(),
        "version": importlib.metadata.version("slrig"),
        "started_at": started_at,
        "state": state,
        "words": words,
        "waiting": status.waiting,
        "computing": len(status.computing),
        "health": str(health.state),
        "health_message": "; ".join(health.reasons),
        "verified_at": None if latest is None else latest.at,
    }


def _state(status: RigStatus) -> tuple[str, str]:
    """What a rig is at, and in words."""
    if status.fault is not None:
        return "fault", status.fault
    if status.facts is None:
        return "opening", status.opening
    if status.reconstruction != READY and not status.preparing:
        return "fault", status.reconstruction
    return ("ready", "") if status.holder is None else ("busy", status.holder)

"""When a process ends: what campaigns that kill processes wait for."""

from __future__ import annotations

import os
import select


def alive(process: int) -> int:
    """A descriptor of a process that tells when it ends."""
    return os.pidfd_open(process)


def ends(descriptor: int, limit_s: float = 30.0) -> bool:
    """Whether a process ends in time."""
    ended = bool(select.select([descriptor], [], [], limit_s)[0])
    os.close(descriptor)
    return ended

"""What the runner works on, and what it tells of it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Protocol
from uuid import UUID

from slrig.devices import Rig
from slrig.errors import RigBusyError
from slrig.scan.feed import FrameSink
from slrig.scan.holding import RigFacts
from slrig.scan.plan import ScanPlan


class CaptureBundle(Protocol):
    """`slrig.scan.acquisition.capture_bundle`, or what a test puts in its place."""

    def __call__(
        self,
        rig: Rig,
        plan: ScanPlan,
        folder: Path,
        /,
        *,
        progress: Callable[[str, float, str], None],
        cancelled: Callable[[], bool],
        frames: FrameSink,
    ) -> None:
        """Play the patterns and write a complete bundle into `folder`; show each frame to `frames`."""
        ...


@dataclass(frozen=True, slots=True)
class RunnerStatus:
    """What the runner is at: the rig as far as it is known, who holds it and since when, and how many wait.

    `reconstruction` is `ReconstructionWorker.condition`.
    """

    rig: str
    facts: RigFacts | None
    fault: str | None
    holder: UUID | None
    since: datetime | None
    waiting: int
    queue_length: int
    reconstruction: str
    ending: bool


@dataclass(slots=True)
class Task:
    """One scan that waits or is under way. `stop` is set when it is to end early."""

    id: UUID
    plan: ScanPlan
    since: datetime
    stop: threading.Event = field(default_factory=threading.Event)


def busy(holder: Task) -> RigBusyError:
    """The error that names who holds the rig."""
    since = holder.since.isoformat(timespec="seconds")
    message = (
        f"The rig is held by scan {holder.id} since {since}. Wait for it, cancel it with "
        f'POST /scan/{holder.id}/cancel, or send "if_busy": "queue" with a scan to wait in line.'
    )
    return RigBusyError(message, holder=str(holder.id), since=since)

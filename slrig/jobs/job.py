"""Work with the rig: a piece of it, and who it is named by while it holds the rig."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from uuid import UUID

from slrig.errors import RigBusyError
from slrig.rig.session import RigSession


@dataclass(frozen=True, slots=True)
class Holder:
    """Who holds the rig. name : what an answer calls it, the id of a scan; words : the same for a person; path : where
    it is found over HTTP, below which `cancel` ends it; None for what is over in seconds.
    """

    name: str
    words: str
    path: str | None


@dataclass(slots=True, eq=False)
class Job:
    """A piece of work with the rig. Its first end stands: whatever ends it again later is not told.

    work : called on the thread that owns the rig; the projector is darkened afterwards, whatever happened. None where
    only the second part is left to be done. compute : the second part, called on a thread of its own when the rig is
    free for the next job; None where there is none. clear_up : does what remains, on the same thread as the part that
    was done last; after `work` the rig is not free yet. concluded : takes note, on any thread, how it ended; a lock is
    held: it returns at once. ended : called once, when the rig is free. These three are given what was raised, None
    where nothing was. due_s : by `time.monotonic`, before which it does not begin and others may pass it. stop : set
    when it is to end early.
    """

    id: UUID
    holder: Holder
    since: datetime
    work: Callable[[RigSession, Job], object] | None
    ended: Callable[[Exception | None], None]
    compute: Callable[[Job], None] | None = None
    clear_up: Callable[[Exception | None], None] = lambda _: None
    concluded: Callable[[Exception | None], None] = lambda _: None
    due_s: float = -math.inf
    stop: threading.Event = field(default_factory=threading.Event)
    _error: Exception | None = None
    _noted: bool = False
    _telling: threading.Lock = field(default_factory=threading.Lock)
    _told: bool = False

    @property
    def ended_by(self) -> Exception | None:
        """What has ended it, perhaps while it still was under way; None before that, or where nothing has."""
        return self._error

    def conclude(self, error: Exception | None) -> None:
        """Take note of its end, with the lock held under which the rig is given and taken."""
        if not self._noted:
            self._error, self._noted = error, True
            self.concluded(error)

    def settle(self) -> None:
        """Tell how it ended, if that was noted. The rig is free; on any thread."""
        with self._telling:
            if not self._noted or self._told:
                return
            self._told = True
        self.ended(self._error)


def busy(job: Job) -> RigBusyError:
    """The error that names who holds the rig."""
    since = job.since.isoformat(timespec="seconds")
    cancel = "" if job.holder.path is None else f"cancel it with POST {job.holder.path}/cancel, "
    message = (
        f'The rig is held by {job.holder.words} since {since}. Wait for it, {cancel}or send "if_busy": "queue" to wait '
        "in line."
    )
    return RigBusyError(message, holder=job.holder.name, since=since)

"""How long a driver's calls may take, and how a driver says what it is at in one that takes long."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Declared by a device: after how long without progress a call of it counts as hung.

    call_s : any call but `read`; a sequence is sent over a slow wire, a camera's streams are set up.
    read_slack_s : how much longer than twice its time-out a `read` may take.
    computed : the device is rendered or replayed. There is nothing to unplug, and no cable to check.
    """

    call_s: float = 30.0
    read_slack_s: float = 5.0
    computed: bool = False


USUAL = CallLimits()

COMPUTED = CallLimits(call_s=600.0, read_slack_s=600.0, computed=True)
"""Of what is rendered or replayed: as long as the machine takes beside its other work. A frame of 12 megapixels takes a
few seconds on a quiet one."""

_hearing = threading.local()


def progress_reporter() -> Callable[[str], None]:
    """What to tell, in the call under way, what the driver is at: "tracing light, 30 %". A call that goes on telling is
    not taken for hung, and people are shown what it tells.

    Ask for it on the thread that was called; it may then be told on any. Where nobody listens it does nothing.
    """
    listener: Callable[[str], None] = getattr(_hearing, "listener", _ignore)
    return listener


@contextmanager
def progress_heard(listener: Callable[[str], None]) -> Iterator[None]:
    """Have `listener` told, within the block, what a driver called on this thread is at."""
    before = getattr(_hearing, "listener", _ignore)
    _hearing.listener = listener
    try:
        yield
    finally:
        _hearing.listener = before


def _ignore(_doing: str) -> None:
    pass

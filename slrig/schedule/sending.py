"""What waits for one receiver is sent to it, in order, one at a time, until that has taken it."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import ClassVar

import structlog

from slrig.errors import StorageError
from slrig.jobs.outbox import Notice, Outbox

FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 300.0
TIMEOUT_S = 15.0
"""For one try, from the connection to the head of the answer."""

_END_S = 1.0
_REFUSED_S = 5.0
"""How long after the records refused they are looked at again."""

_log = structlog.get_logger(__name__)


class Sender(ABC):
    """Sends notices on a thread of its own. Nothing waits for it, but `close`, for a second at most.

    A notice is sent again until its receiver takes it, and then forgotten. receiver : its name in the outbox. host :
    what logs say of its address.
    """

    receiver: ClassVar[str]

    def __init__(self, outbox: Outbox, host: str) -> None:
        self.host = host
        self._outbox = outbox
        self._news = outbox.news[self.receiver]
        self._failures = 0
        self._gone = self._left = False
        self._taken: str | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._send_all, name="slrig-notices", daemon=True)

    @abstractmethod
    def refusal(self, notice: Notice) -> str | None:
        """Send a notice once. Returns why it was not taken. May raise anything: the next try may get through."""

    def start(self) -> None:
        """Begin to send."""
        self._thread.start()

    def close(self) -> None:
        """Send no more than what waits, and that only if it goes quickly. Idempotent."""
        self._ending.set()
        self._news.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)
        self._left = True

    def step(self) -> float | None:
        """Send the oldest notice that waits. Returns how many seconds to wait before the next step; None: until there
        is one more. Raises StorageError.
        """
        notice = self._outbox.oldest(self.receiver)
        if notice is None or self._gone:
            return None if notice is None else LONGEST_WAIT_S
        # One that could not be taken off the record is not sent again by this process.
        if notice.id != self._taken:
            try:
                cause = self.refusal(notice)
            except Exception as error:  # noqa: BLE001 - whatever it was, the next try may get through
                cause = type(error).__name__
            if cause is not None:
                return self._failed(notice, cause)
        self._taken, self._failures = notice.id, 0
        if not self._left:
            self._outbox.sent(notice)
        return 0.0

    def _failed(self, notice: Notice, cause: str) -> float:
        told = {"receiver": self.receiver, "host": self.host, "cause": cause}
        told["notice"] = notice.body["words"]
        if self._gone:
            _log.error("the receiver is gone: nothing is sent before the next start of the service", **told)
            return LONGEST_WAIT_S
        wait_s = min(FIRST_WAIT_S * 2.0 ** min(self._failures, 30), LONGEST_WAIT_S)
        self._failures += 1
        _log.warning("a notice was not delivered", tries=self._failures, again_in_s=wait_s, **told)
        return wait_s

    def _send_all(self) -> None:
        while not self._left:
            self._news.clear()
            try:
                wait_s = self.step()
            except Exception as error:  # noqa: BLE001 - a full disk may be emptied; the notices wait
                unexpected = not isinstance(error, StorageError)
                _log.error("the notices could not be looked at", cause=str(error), exc_info=unexpected)
                wait_s = _REFUSED_S
            if wait_s is None and not self._ending.is_set():
                self._news.wait()
            elif wait_s is None or (wait_s > 0 and self._ending.wait(wait_s)):
                return

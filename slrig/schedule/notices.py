"""Notices to a webhook: what nobody would see until it is too late is sent, as JSON, to the address that is set.

Nothing is sent unless an address is set. A notice is sent once: one that cannot be delivered is in the log.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from typing import Any
from urllib.parse import urlsplit

import structlog

from slrig.calibration.health.verdict import HealthState
from slrig.calibration.health.verification import Verification
from slrig.jobs.database import Database
from slrig.jobs.records import Clock, utc_now
from slrig.schedule.records import Run, RunState, Schedule
from slrig.verify.store import HealthStore, VerificationRecord

TOLD = frozenset({RunState.MISSED, RunState.SKIPPED, RunState.FAILED, RunState.INTERRUPTED})
"""What becomes of a run that a person has to know of."""

TIMEOUT_S = 5.0
MOST_WAITING = 100
_END_S = 1.0

_log = structlog.get_logger(__name__)


class Notices:
    """Sends notices on a thread of its own. Any thread may call; no call waits, and none raises.

    url : where to POST to; None sends nothing.
    """

    def __init__(self, url: str | None, *, rig: str, clock: Clock = utc_now, most: int = MOST_WAITING) -> None:
        self._url = url
        # The rest of the address often holds a secret.
        self._host = None if url is None else urlsplit(url).hostname
        self._rig = rig
        self._clock = clock
        self._waiting: queue.Queue[dict[str, Any] | None] = queue.Queue(most)
        self._sender: threading.Thread | None = None
        if url is not None:
            self._sender = threading.Thread(target=self._send_all, args=(url,), name="slrig-notices", daemon=True)
            self._sender.start()

    def run(self, schedule: Schedule, run: Run, /) -> None:
        """A `slrig.schedule.scheduler.Notice`: tell of a run that a person has to know of."""
        if run.state not in TOLD:
            return
        due = schedule.order.cron.local(run.due)
        what = f"{schedule.order.task} due {due:%Y-%m-%d %H:%M %z}"
        more = "" if run.count == 1 else f", {run.count} times"
        self._put(
            f"run.{run.state}",
            f"rig '{self._rig}': {what} was {run.state}{more}: {run.reason or 'no reason is known'}",
            schedule={
                "id": str(schedule.id),
                "label": schedule.order.label,
                "task": str(schedule.order.task),
                "cron": schedule.order.cron.text,
                "time_zone": schedule.order.cron.time_zone,
            },
            run={
                "number": run.number,
                "due": run.due.isoformat(),
                "state": str(run.state),
                "reason": run.reason,
                "count": run.count,
            },
        )

    def health(self, before: VerificationRecord | None, now: VerificationRecord, /) -> None:
        """Tell of a health that is another one than before. A first verification that finds all well is no news."""
        earlier = HealthState.UNKNOWN if before is None else before.health.state
        state = now.health.state
        if state is earlier or (before is None and state is HealthState.GOOD):
            return
        words = "; ".join(now.health.reasons) or "nothing is wrong"
        self._put(
            "health.changed",
            f"rig '{self._rig}' was {earlier} and is {state}: {words}",
            health={
                "before": str(earlier),
                "state": str(state),
                "reasons": list(now.health.reasons),
                "remedy": now.health.remedy,
                "verification": str(now.id),
                "calibration": now.calibration,
            },
        )

    def close(self) -> None:
        """Send no more than what waits, and that only if it goes quickly. Idempotent."""
        if self._sender is None:
            return
        while True:
            try:
                self._waiting.put_nowait(None)
                break
            except queue.Full:
                with suppress(queue.Empty):
                    self._waiting.get_nowait()
        self._sender.join(_END_S)

    def _put(self, kind: str, words: str, /, **members: Mapping[str, Any]) -> None:
        if self._sender is None:
            return
        notice = {"kind": kind, "at": self._clock().isoformat(), "rig": self._rig, "words": words, **members}
        try:
            self._waiting.put_nowait(notice)
        except queue.Full:
            _log.warning("a notice was dropped: too many wait", host=self._host, notice=words)

    def _send_all(self, url: str) -> None:
        # Loaded by those who use it.
        import httpx2

        with httpx2.Client(timeout=TIMEOUT_S, follow_redirects=False) as client:
            while (notice := self._waiting.get()) is not None:
                try:
                    status = client.post(url, json=notice).status_code
                    if not 200 <= status < 300:
                        _log.warning("a notice was refused", host=self._host, status=status, notice=notice["words"])
                except Exception as error:  # noqa: BLE001 - the next notice may get through
                    cause = type(error).__name__
                    _log.warning("a notice was not delivered", host=self._host, cause=cause, notice=notice["words"])


class NoticedHealth(HealthStore):
    """The history of a rig's health, every change of which is told."""

    def __init__(self, database: Database, notices: Notices) -> None:
        super().__init__(database)
        self._notices = notices
        self._adding = threading.Lock()

    def add(self, found: Verification, *, calibration: str, at: datetime) -> VerificationRecord:
        """See `HealthStore`."""
        with self._adding:
            before = self.latest()
            record = super().add(found, calibration=calibration, at=at)
        self._notices.health(before, record)
        return record

"""The host's sign of life to a box: while it comes, the box's watchdog keeps the light."""

from __future__ import annotations

import threading

from drivers.serial_projector.client import BoxClient
from slrig.devices import Clock
from slrig.errors import DeviceError

BEATS_PER_WATCHDOG = 5
"""So many that a few lost ones, or a busy host, do not put the light out."""


class KeepAlive:
    """A thread that beats until it is stopped, except while the box is abandoned.

    It says that the process lives, not that its owner thread does: a pattern that a stuck owner leaves lit is put out
    by the box after `max_on_s`. clock : by which it waits.
    """

    def __init__(self, client: BoxClient, *, watchdog_s: float, clock: Clock) -> None:
        self._client, self._clock = client, clock
        self._period_ns = round(watchdog_s * 1e9 / BEATS_PER_WATCHDOG)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="serial projector", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End it. Idempotent; from any thread."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while True:
            self._clock.wait_until(self._clock.now_ns() + self._period_ns, self._stop)
            if self._stop.is_set():
                return
            try:
                self._client.beat()
            except DeviceError:
                # What the box answers, and that it is gone, is the owner's business: its next command finds out.
                continue

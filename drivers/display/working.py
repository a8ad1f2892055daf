"""One thread on which everything is done that a library wants to be done on one thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from slrig.errors import DeviceError

Result = TypeVar("Result")


class OwnThread:
    """A thread that does what it is given, one thing after the other, whichever thread asks. Dies with the process."""

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._name = name
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def do(self, job: Callable[[], Result], *, timeout_s: float) -> Result:
        """Do it there, and return what it returns; raise what it raises.

        Raises
        ------
        DeviceError
            It was not done in time. It may be done later.
        """
        done: Future[Result] = Future()
        self._jobs.put((job, done))
        try:
            return done.result(timeout_s)
        except TimeoutError:
            if done.cancel() or not done.done():
                message = (
                    f"{self._name} did not answer in {timeout_s:g} s: the graphics driver hangs; see the kernel's log "
                    "(dmesg)"
                )
                raise DeviceError(message) from None
            return done.result()

    def end(self, *, timeout_s: float) -> None:
        """Let the thread end when it has done what it was given."""
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while (given := self._jobs.get()) is not None:
            job, done = given
            if not done.set_running_or_notify_cancel():
                continue
            try:
                done.set_result(job())
            except BaseException as error:  # noqa: BLE001 - it is raised where it was asked for
                done.set_exception(error)

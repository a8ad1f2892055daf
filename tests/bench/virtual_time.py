"""A clock for dask that jumps: nothing waits, and a day passes as fast as its events can be computed.

dask's scheduler, workers and clients run on one asyncio loop over `inproc`. Whenever nothing is to be done, the loop's
clock is set to its next timer, so that what dask itself takes costs no time of the day: `test_pool_day` measures that.
"""

from __future__ import annotations

import asyncio
import selectors
import sys
from collections.abc import Callable, Coroutine
from typing import Any

import dask
import pytest
from distributed import metrics
from tornado.ioloop import PeriodicCallback
from tornado.platform.asyncio import BaseAsyncIOLoop

EARLY_S = 2e-9
"""asyncio takes a timer for due up to a nanosecond before its time. Who then looks at the clock, and waits on, would
wait for ever at a clock that stands still."""

PERIODIC = ("WorkStealing.balance",)
"""What dask does again and again that matters here; signs of life and figures for its pages do not."""


class _Jumping(selectors.SelectSelector):
    """Waits for nothing: time passes instead."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(0)
        if not found:
            assert timeout is not None, "everybody waits, and nobody for a time"
            self.now_s += max(timeout, EARLY_S)
        return found


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop whose clock is at start_s. What others give to threads is done at once."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._jumping = _Jumping()
        self._jumping.now_s = start_s
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now_s

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any  # noqa: ARG002
    ) -> asyncio.Future[Any]:  # fmt: skip
        done = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 - it is whoever awaits it who is told
            done.set_exception(error)
        return done


def run_virtually(life: Coroutine[Any, Any, None], loop: VirtualLoop, patch: pytest.MonkeyPatch) -> None:
    """Run a coroutine until it is over, with dask's clocks following the loop's."""
    real = {"time": metrics.time, "monotonic": metrics.monotonic}
    for name in [each for each in sys.modules if each.partition(".")[0] == "distributed"]:
        for clock, function in real.items():
            if getattr(sys.modules[name], clock, None) is function:
                patch.setattr(sys.modules[name], clock, loop.time)
    patch.setattr(BaseAsyncIOLoop, "time", lambda self: self.asyncio_loop.time())
    started = PeriodicCallback.start

    def start(periodic: PeriodicCallback) -> None:
        if getattr(periodic.callback, "__qualname__", "") in PERIODIC:
            started(periodic)

    patch.setattr(PeriodicCallback, "start", start)
    config = {
        "distributed.scheduler.active-memory-manager.start": False,
        "distributed.scheduler.worker-ttl": None,
        "distributed.worker.profile.enabled": False,
    }
    try:
        with dask.config.set(config):
            loop.run_until_complete(life)
    finally:
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.run_until_complete(asyncio.sleep(1.0))
        loop.close()

"""What the service asks of whatever computes for it: a process of its own (`slrig.jobs.worker`), or a pool of machines
with that process to fall back on (`slrig.compute`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from slrig.jobs.frame_feed import FrameFeed
from slrig.jobs.worker_process import Task
from slrig.jobs.worker_wait import Made, Told
from slrig.model import Region


class Compute(Protocol):
    """Does named tasks for the service. Any thread may call. `slrig.jobs.worker.Worker` says what each part does."""

    @property
    def module(self) -> str:
        """What the reconstruction is: a module with `reconstruct_into`."""
        ...

    @property
    def condition(self) -> str:
        """`slrig.jobs.worker.READY`, how far the kernels are, or why nothing can be computed."""
        ...

    @property
    def loading(self) -> bool:
        """Whether it is not ready yet, and there is hope."""
        ...

    def start(self) -> None:
        """Begin to be ready. Returns at once."""
        ...

    def feed(self, region: Region | None = None) -> FrameFeed:
        """A way for the frames of a capture while they are taken; to be given to `run` afterwards."""
        ...

    def run(
        self,
        task: Task,
        *,
        progress: Told = ...,
        cancelled: Callable[[], bool] = ...,
        made: Made = ...,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        """Do a task, and return its result."""
        ...

    def task(self, function: str, what: str) -> Callable[..., Any]:
        """A function that is done by `run`, "module:function"."""
        ...

    def close(self) -> None:
        """End what is computed. Idempotent."""
        ...

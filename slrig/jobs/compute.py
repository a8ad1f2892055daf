"""What the service asks of whatever computes for it: a process of its own (`slrig.jobs.worker`), or a pool of machines
with that process to fall back on (`slrig.compute`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from slrig.jobs.frame_feed import FrameFeed
from slrig.jobs.job import Job, JobRun
from slrig.jobs.worker_process import JobFiles, Task
from slrig.jobs.worker_wait import Made, Told
from slrig.model import Region


def job_task(job: Job, run: JobRun) -> Task:
    """The second part of a job as a task."""
    files = JobFiles(run.id, run.folder, run.place, run.evidence)
    return Task(job.compute, (), files, what=job.noun, remedy=job.remedy, movable=job.movable)


class Compute(Protocol):
    """Does tasks for the service. Any thread may call. `slrig.jobs.worker.Worker` says what each part does."""

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

    def close(self) -> None:
        """End what is computed. Idempotent."""
        ...

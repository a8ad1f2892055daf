"""The mathematics in a process of its own: it shares no interpreter lock with capture and HTTP, and may end alone.

One process and one pipe rather than a process pool: a pool can report no progress, cannot stop a running task, and
joins it at exit. Here a lost process is seen at once, and the next job starts a fresh one.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import c_double
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.sharedctypes import RawValue
from pathlib import Path
from typing import Any

import structlog

from slrig import logs
from slrig.errors import ScanCancelledError, WorkerBusyError, WorkerLostError
from slrig.failure import errors_by_code, interruption_error
from slrig.jobs.frame_feed import FrameFeed
from slrig.jobs.worker_process import Failed, Fed, Preparing, Ready, RunTask, Task, Unloadable, received, sent, serve
from slrig.jobs.worker_wait import POLL_S, PREPARING, JobWait, Made, Told
from slrig.model import Region

SILENCE_TOLD_S = 5.0
"""From when on `condition` tells that the process shows no sign of life."""

LOADING = "loading"
READY = "ok"

WAITING = "waiting for the worker"
"""The stage of a job while another one is computed."""

_log = structlog.get_logger(__name__)


class UnexpectedWorkerError(Exception):
    """A defect in a task. Carries the traceback of the other process as its text."""


def _silent(_stage: str, _fraction: float, _detail: str) -> None:
    pass


def _unheard(_file: str) -> None:
    pass


def _never() -> bool:
    return False


class Worker:
    """Runs one task at a time in a child process, in the order in which they come. Any thread may call."""

    def __init__(self, module: str) -> None:
        """`module` : see `slrig.jobs.worker_process.serve`."""
        self.module = module
        self._spawning = multiprocessing.get_context("spawn")
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._stops: Connection | None = None
        self._heartbeat: c_double = RawValue(c_double, 0.0)
        self._guard = threading.Lock()
        self._sending = threading.Lock()
        self._turns: deque[int] = deque()
        self._turn = threading.Condition()
        self._numbers = itertools.count(1)
        self._feeding: FrameFeed | None = None
        self._closed = False
        self._running = False
        self._condition, self._loading = LOADING, True

    @property
    def condition(self) -> str:
        """`READY` once the process has loaded its kernels, `LOADING` or how far that is, or why it cannot compute."""
        with self._guard:
            # While a job is under way `run` reads the pipe, and an answer read here would be lost.
            while self._loading and not self._running and self._pipe is not None and self._pipe.poll():
                self._note(received(self._pipe))
            silence_s = self._silence_s()
            if self._condition == READY and silence_s > SILENCE_TOLD_S:
                return (
                    f"the worker shows no sign of life for {silence_s:.0f} s; a job that waits for it has it replaced"
                )
            return self._condition

    def _silence_s(self) -> float:
        if self._process is None or not self._process.is_alive():
            return 0.0
        return time.monotonic() - self._heartbeat.value

    @property
    def loading(self) -> bool:
        """Whether the process is not ready yet, and there is hope, as `condition` found it last."""
        return self._loading

    def _note(self, told: object | None) -> None:
        """Take what a process says before its first answer; None stands for its death."""
        if isinstance(told, Preparing):
            self._condition = f"{PREPARING}, {told}"
        elif isinstance(told, Ready):
            self._condition, self._loading = READY, False
        elif self._loading:
            # Of a process that is gone, and nothing more is to be read from its pipe, whoever ended it.
            self._loading = False
            if self._closed:
                return
            cause = told.cause if isinstance(told, Unloadable) else "its process ended"
            self._condition = f"the reconstruction cannot be loaded: {cause}; the service's log has the details"
            _log.error("the reconstruction cannot be loaded", cause=cause)

    @property
    def process_id(self) -> int | None:
        """The process id of the child, None when there is none."""
        return None if self._process is None else self._process.pid

    @property
    def jobs(self) -> int:
        """How many jobs are under way or wait."""
        with self._turn:
            return len(self._turns)

    def start(self) -> None:
        """Start the process unless one lives. Returns at once; the process loads its kernels by itself."""
        with self._guard:
            if self._closed or (self._process is not None and self._process.is_alive()):
                return
            if self._pipe is not None and self._stops is not None:
                # A feed may still be in the middle of a message to the process that ended.
                with self._sending:
                    self._pipe.close()
                    self._stops.close()
            self._condition, self._loading = LOADING, True
            self._pipe, far_end = self._spawning.Pipe()
            stops, self._stops = self._spawning.Pipe(duplex=False)
            self._heartbeat = RawValue(c_double, time.monotonic())
            self._process = self._spawning.Process(
                target=serve,
                args=(far_end, stops, self._heartbeat, self.module, logs.log_settings()),
                name="slrig-worker",
                daemon=True,
            )
            self._process.start()
            # The child holds the only other ends now, so its death reads as end of file here.
            far_end.close()
            stops.close()

    def feed(self, region: Region | None = None) -> FrameFeed:
        """A way for the frames of a capture to reach the process while they are taken; give it to `run` afterwards.
        region : what of the scene is asked for.

        While those of an earlier capture still wait to be sent, it is abandoned from the start: the process is busy,
        and frames of one capture are enough to be kept in memory.
        """
        self.start()
        number = next(self._numbers)
        with self._guard:
            pipe = self._pipe

        def send(message: object) -> bool:
            # A feed that was abandoned in the middle of a message finishes it before anyone sends the next.
            with self._sending:
                return pipe is not None and sent(pipe, Fed(number, message))

        earlier, self._feeding = self._feeding, FrameFeed(send, number=number, receiver=pipe, region=region)
        if earlier is not None and earlier.receiver is pipe and not earlier.settled(0.0):
            self._feeding.abandon()
        return self._feeding

    def run(
        self,
        task: Task,
        *,
        progress: Told = _silent,
        cancelled: Callable[[], bool] = _never,
        made: Made = _unheard,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        """Do a task when it is its turn, and return its result. Frames that `feed` has sent, all of them, are used.
        made : is told the name of each file of the result that is there before the task is over. within_s : the longest
        wait for its beginning, None for any.

        Whatever but an answer ends the wait, the process is replaced: what it still computes belongs to nobody.

        Raises
        ------
        SlrigError
            Whatever the task raised, by class and message.
        ScanCancelledError
            `cancelled` turned true.
        ScanInterruptedError
            The worker was closed.
        WorkerBusyError
            It did not begin within `within_s`: others were before it, or the process was not ready.
        WorkerLostError
            The process ended, showed no sign of life, or told no progress for too long.
        UnexpectedWorkerError
            The task has a defect.
        """
        until_s = None if within_s is None else time.monotonic() + within_s
        with self._its_turn(task, progress, cancelled, until_s):
            self.start()
            if until_s is not None:
                self._wait_until_ready(task, until_s)
            with self._guard:
                process, pipe, stops = self._process, self._pipe, self._stops
                self._running = True
            if process is None or pipe is None or stops is None:
                raise interruption_error()
            number, fed = next(self._numbers), False
            # A process that was started since the capture has not seen its frames.
            if feed is not None and feed.receiver is pipe:
                number, fed = feed.number, True
            job = JobWait(task, number, process, pipe, stops, self._heartbeat, progress, cancelled, made, self._noted)
            try:
                if fed and feed is not None:
                    fed = job.settled(feed)
                with self._sending:
                    begun = sent(pipe, RunTask(number, task, fed, structlog.contextvars.get_contextvars()))
                if not begun:
                    # What it last said may lie in the pipe still: why it could not be loaded.
                    self._noted(received(pipe))
                    raise job.lost()
                answer = job.answer()
            except WorkerLostError as error:
                if self._closed:
                    raise interruption_error() from error
                if not self._loading and self._condition != READY:
                    message = f"The {task.what} did not begin: {self._condition}. {task.remedy}"
                    raise WorkerLostError(message) from error
                raise
            finally:
                with self._guard:
                    self._running = False
                if not job.answered:
                    process.kill()
                    process.join()
            if isinstance(answer, Failed):
                raise _error(answer)
            return answer.result

    def _noted(self, told: object | None) -> None:
        with self._guard:
            self._note(told)

    @contextmanager
    def _its_turn(
        self, task: Task, progress: Told, cancelled: Callable[[], bool], until_s: float | None
    ) -> Iterator[None]:
        """Wait until the jobs that came before are over."""
        turn, told = next(self._numbers), False
        with self._turn:
            self._turns.append(turn)
        try:
            while True:
                with self._turn:
                    if self._turn.wait_for(lambda: self._turns[0] == turn, timeout=POLL_S):
                        break
                if not told:
                    progress(WAITING, 0.0, "another job is computed first")
                    told = True
                if cancelled():
                    message = f"The {task.what} was cancelled."
                    raise ScanCancelledError(message)
                if until_s is not None and time.monotonic() > until_s:
                    message = f"Another job is computed, and the {task.what} has to wait for it. Ask again."
                    raise WorkerBusyError(message)
            yield
        finally:
            with self._turn:
                self._turns.remove(turn)
                self._turn.notify_all()

    def _wait_until_ready(self, task: Task, until_s: float) -> None:
        """Wait, in its turn, until the process has loaded its kernels, or cannot."""
        while self.condition != READY and self._loading:
            if time.monotonic() > until_s:
                message = f"The worker is not ready yet for the {task.what} ({self._condition}). Ask again."
                raise WorkerBusyError(message)
            time.sleep(POLL_S)

    def close(self) -> None:
        """End the process, whatever it does. Idempotent."""
        with self._guard:
            self._closed = True
            process = self._process
        if process is not None:
            process.kill()
            process.join()


def prepare_kernel_cache(folder: Path) -> None:
    """Tell numba where to keep compiled kernels when slrig's own folder is read-only; call before numba is loaded.

    numba itself refuses to load a cached kernel when it finds no place to write, as under systemd or in a container.
    """
    package = Path(__file__).resolve().parent.parent
    if "NUMBA_CACHE_DIR" not in os.environ and not os.access(package, os.W_OK):
        folder.mkdir(parents=True, exist_ok=True)
        os.environ["NUMBA_CACHE_DIR"] = str(folder)


def _error(failed: Failed) -> Exception:
    known = errors_by_code().get(failed.fault.code)
    return UnexpectedWorkerError(failed.trace) if known is None else known(failed.fault.message)

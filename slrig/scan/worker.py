"""Reconstruction in a process of its own, so that it shares no interpreter lock with capture and HTTP.

One process and one pipe rather than a process pool: a pool can report no progress, cannot stop a running task, and
joins it at exit. Here a lost process is seen at once, and the next job starts a fresh one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import structlog

from slrig.errors import ScanCancelledError
from slrig.scan.faults import WorkerLostError, error_classes
from slrig.scan.feed import FrameFeed
from slrig.scan.worker_process import (
    Done,
    Failed,
    Job,
    Preparing,
    Progressed,
    Ready,
    Run,
    Stop,
    Unloadable,
    received,
    sent,
    serve,
)

RECONSTRUCT = "slrig.scan.pipeline:reconstruct_bundle"
"""What the process runs, named rather than passed: the service itself need not load numba for it."""

CANCEL_LIMIT_S = 10.0
"""A job that has not stopped this long after it was asked to is stopped by ending its process."""

LOADING = "loading"
READY = "ok"

PREPARING = "preparing kernels"
"""The stage of compiling what numba has not compiled on this machine before."""

_POLL_S = 0.1

_Told = Callable[[str, float, str], None]

_log = structlog.get_logger(__name__)


class UnexpectedWorkerError(Exception):
    """A defect in the reconstruction. Carries the traceback of the other process as its text."""


class ReconstructionWorker:
    """Runs one reconstruction at a time in a child process. `run` belongs to one thread; `close` to any."""

    def __init__(self, task: str = RECONSTRUCT) -> None:
        self._task = task
        self._spawning = multiprocessing.get_context("spawn")
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._guard = threading.Lock()
        self._sending = threading.Lock()
        self._fed: tuple[FrameFeed, Connection | None] | None = None
        self._closed = False
        self._running = False
        self._condition, self._loading = LOADING, True

    @property
    def condition(self) -> str:
        """`READY` once the process has loaded its task, `LOADING` or how far that is, or why it cannot; never waits."""
        with self._guard:
            # While a job is under way `run` reads the pipe, and an answer read here would be lost.
            while self._loading and not self._running and self._pipe is not None and self._pipe.poll():
                self._note(received(self._pipe))
            return self._condition

    @property
    def loading(self) -> bool:
        """Whether the process is not ready yet, and there is hope, as `condition` found it last."""
        return self._loading

    def _hear(self, told: object | None, progress: _Told) -> None:
        """Take note of what is no answer, and pass on how far the kernels are."""
        if told is None or isinstance(told, (Preparing, Ready, Unloadable)):
            with self._guard:
                self._note(told)
        if isinstance(told, Preparing):
            progress(PREPARING, 0.0, str(told))

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

    def start(self) -> None:
        """Start the process unless one lives. Returns at once; the process loads its task by itself."""
        with self._guard:
            if self._closed or (self._process is not None and self._process.is_alive()):
                return
            if self._pipe is not None:
                # A feed may still be in the middle of a message to the process that ended.
                with self._sending:
                    self._pipe.close()
            self._condition, self._loading = LOADING, True
            self._pipe, far_end = self._spawning.Pipe()
            self._process = self._spawning.Process(
                target=serve, args=(far_end, self._task), name="slrig-reconstruction", daemon=True
            )
            self._process.start()
            # The child holds the only other end now, so its death reads as end of file here.
            far_end.close()

    def feed(self) -> FrameFeed:
        """A way for the frames of a capture to reach the process while they are taken; give it to `run` afterwards."""
        self.start()
        with self._guard:
            pipe = self._pipe

        def send(message: object) -> bool:
            # A feed that was abandoned in the middle of a message finishes it before anyone sends the next.
            with self._sending:
                return pipe is not None and sent(pipe, message)

        self._fed = FrameFeed(send), pipe
        return self._fed[0]

    def run(
        self,
        job: Job,
        *,
        progress: _Told,
        cancelled: Callable[[], bool],
        feed: FrameFeed | None = None,
    ) -> Mapping[str, Any]:
        """Reconstruct, and return the report. Frames that `feed` has sent, all of them, are not read again.

        Raises
        ------
        SlrigError
            Whatever the reconstruction raised, by class and message.
        ScanCancelledError
            `cancelled` turned true.
        WorkerLostError
            The process ended.
        UnexpectedWorkerError
            The reconstruction has a defect.
        """
        self.start()
        with self._guard:
            process, pipe = self._process, self._pipe
            self._running = True
        if process is None or pipe is None:
            message = "The service is ending and reconstructs no more."
            raise ScanCancelledError(message)
        try:
            # A process that was started since the capture has not seen its frames.
            fed = (
                feed is not None
                and self._fed == (feed, pipe)
                and self._settled(feed, process, pipe, progress, cancelled)
            )
            return self._answered(process, pipe, Run(job, fed), progress, cancelled)
        finally:
            with self._guard:
                self._running = False

    def _settled(
        self, feed: FrameFeed, process: BaseProcess, pipe: Connection, progress: _Told, cancelled: Callable[[], bool]
    ) -> bool:
        """Wait until the frames of a capture have been sent, or cannot be; return whether all were."""
        stop_after: float | None = None
        while not feed.settled(_POLL_S):
            # A process that still prepares its kernels takes no frames, and tells how far it is.
            while pipe.poll() and (told := received(pipe)) is not None:
                self._hear(told, progress)
            if cancelled():
                if stop_after is None:
                    stop_after = time.monotonic() + CANCEL_LIMIT_S
                    feed.abandon()
                elif time.monotonic() > stop_after:
                    self._end(process)
                    message = "The reconstruction was cancelled."
                    raise ScanCancelledError(message)
        return feed.whole

    def _end(self, process: BaseProcess) -> None:
        _log.warning("reconstruction did not stop when asked, ending its process", pid=process.pid)
        process.kill()
        process.join()

    def _answered(
        self,
        process: BaseProcess,
        pipe: Connection,
        run: Run,
        progress: _Told,
        cancelled: Callable[[], bool],
    ) -> Mapping[str, Any]:
        with self._sending:
            begun = sent(pipe, run)
        if not begun:
            # What it last said may lie in the pipe still: why it could not be loaded.
            with self._guard:
                self._note(received(pipe))
            raise self._lost(process)
        stop_after: float | None = None
        while True:
            if process.sentinel in wait([pipe, process.sentinel], timeout=_POLL_S) and not pipe.poll():
                with self._guard:
                    self._note(None)
                raise self._lost(process)
            while pipe.poll():
                message_in = received(pipe)
                self._hear(message_in, progress)
                if message_in is None or isinstance(message_in, Unloadable):
                    raise self._lost(process)
                if isinstance(message_in, Progressed):
                    progress(message_in.stage, message_in.fraction, message_in.detail)
                elif isinstance(message_in, Done):
                    return message_in.report
                elif isinstance(message_in, Failed):
                    raise _error(message_in)
            if cancelled():
                if stop_after is None:
                    stop_after = time.monotonic() + CANCEL_LIMIT_S
                    with self._sending:
                        sent(pipe, Stop())
                elif time.monotonic() > stop_after:
                    self._end(process)
                    message = "The reconstruction was cancelled."
                    raise ScanCancelledError(message)

    def close(self) -> None:
        """End the process, whatever it does. Idempotent."""
        with self._guard:
            self._closed = True
            process = self._process
        if process is not None:
            process.kill()
            process.join()

    def _lost(self, process: BaseProcess) -> WorkerLostError:
        process.join()
        if not self._loading and self._condition != READY:
            message = f"No mesh was made: {self._condition}. The bundle is kept: scan again once that is put right."
            return WorkerLostError(message)
        code = process.exitcode
        how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
        message = (
            f"The reconstruction process ended in the middle of its work ({how}). If the machine ran out of memory, "
            "free some or use a camera of fewer pixels. The bundle is kept: download bundle.zip and run "
            "`slrig reconstruct` on it, or scan again; a fresh process has been started."
        )
        return WorkerLostError(message)


def prepare_kernel_cache(folder: Path) -> None:
    """Tell numba where to keep compiled kernels when slrig's own folder is read-only; call before numba is loaded.

    numba itself refuses to load a cached kernel when it finds no place to write, as under systemd or in a container.
    """
    package = Path(__file__).resolve().parent.parent
    if "NUMBA_CACHE_DIR" not in os.environ and not os.access(package, os.W_OK):
        folder.mkdir(parents=True, exist_ok=True)
        os.environ["NUMBA_CACHE_DIR"] = str(folder)


def _error(failed: Failed) -> Exception:
    known = error_classes().get(failed.fault.kind)
    return UnexpectedWorkerError(failed.trace) if known is None else known(failed.fault.message)

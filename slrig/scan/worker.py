"""Reconstruction in a process of its own, so that it shares no interpreter lock with capture and HTTP.

One process and one pipe rather than a process pool: a pool can report no progress, cannot stop a running task, and
joins it at exit. Here a lost process is seen at once, and the next job starts a fresh one.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import pkgutil
import signal
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import structlog

from slrig.errors import ScanCancelledError, SlrigError
from slrig.scan.faults import ScanFault, WorkerLostError, error_classes, fault_of
from slrig.scan.feed import FedFrames, FrameFeed
from slrig.scan.plan import ReconstructionPlan

RECONSTRUCT = "slrig.scan.pipeline:reconstruct_bundle"
"""What the process runs, named rather than passed: the service itself need not load numba for it."""

CANCEL_LIMIT_S = 10.0
"""A job that has not stopped this long after it was asked to is stopped by ending its process."""

LOADING = "loading"
READY = "ok"

_POLL_S = 0.1

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Job:
    """One reconstruction: the arguments of `slrig.scan.pipeline.reconstruct_bundle`."""

    bundle: Path
    output: Path
    plan: ReconstructionPlan


@dataclass(frozen=True, slots=True)
class _Run:
    """Parent to child: do this job, with the frames that were sent before if `fed`."""

    job: Job
    fed: bool


@dataclass(frozen=True, slots=True)
class _Stop:
    """Parent to child: the job under way is not wanted any more."""


@dataclass(frozen=True, slots=True)
class _Ready:
    """Child to parent: the task is loaded."""


@dataclass(frozen=True, slots=True)
class _Unloadable:
    """Child to parent: the task cannot be loaded, and the process ends."""

    cause: str


@dataclass(frozen=True, slots=True)
class _Progressed:
    stage: str
    fraction: float
    detail: str


@dataclass(frozen=True, slots=True)
class _Done:
    report: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class _Failed:
    fault: ScanFault
    trace: str


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
        self._condition = LOADING

    @property
    def condition(self) -> str:
        """`LOADING`, `READY` once the process has loaded its task, or why it cannot; looks, and never waits."""
        with self._guard:
            # While a job is under way `run` reads the pipe, and an answer read here would be lost.
            if self._condition == LOADING and not self._running and self._pipe is not None and self._pipe.poll():
                self._note(_received(self._pipe))
            return self._condition

    def _note(self, told: object | None) -> None:
        """Take what a process says before its first answer; None stands for its death."""
        if isinstance(told, _Ready):
            self._condition = READY
        elif self._condition == LOADING and not self._closed:
            cause = told.cause if isinstance(told, _Unloadable) else "its process ended"
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
            self._condition = LOADING
            self._pipe, far_end = self._spawning.Pipe()
            self._process = self._spawning.Process(
                target=_serve, args=(far_end, self._task), name="slrig-reconstruction", daemon=True
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
                return pipe is not None and _sent(pipe, message)

        self._fed = FrameFeed(send), pipe
        return self._fed[0]

    def run(
        self,
        job: Job,
        *,
        progress: Callable[[str, float, str], None],
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
            fed = feed is not None and self._fed == (feed, pipe) and self._settled(feed, process, cancelled)
            return self._answered(process, pipe, _Run(job, fed), progress, cancelled)
        finally:
            with self._guard:
                self._running = False

    def _settled(self, feed: FrameFeed, process: BaseProcess, cancelled: Callable[[], bool]) -> bool:
        """Wait until the frames of a capture have been sent, or cannot be; return whether all were."""
        stop_after: float | None = None
        while not feed.settled(_POLL_S):
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
        run: _Run,
        progress: Callable[[str, float, str], None],
        cancelled: Callable[[], bool],
    ) -> Mapping[str, Any]:
        with self._sending:
            begun = _sent(pipe, run)
        if not begun:
            # What it last said may lie in the pipe still: why it could not be loaded.
            with self._guard:
                self._note(_received(pipe))
            raise self._lost(process)
        stop_after: float | None = None
        while True:
            if process.sentinel in wait([pipe, process.sentinel], timeout=_POLL_S) and not pipe.poll():
                with self._guard:
                    self._note(None)
                raise self._lost(process)
            while pipe.poll():
                message_in = _received(pipe)
                if message_in is None or isinstance(message_in, (_Ready, _Unloadable)):
                    with self._guard:
                        self._note(message_in)
                if message_in is None or isinstance(message_in, _Unloadable):
                    raise self._lost(process)
                if isinstance(message_in, _Progressed):
                    progress(message_in.stage, message_in.fraction, message_in.detail)
                elif isinstance(message_in, _Done):
                    return message_in.report
                elif isinstance(message_in, _Failed):
                    raise _error(message_in)
            if cancelled():
                if stop_after is None:
                    stop_after = time.monotonic() + CANCEL_LIMIT_S
                    with self._sending:
                        _sent(pipe, _Stop())
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
        if self._condition not in {LOADING, READY}:
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


def _error(failed: _Failed) -> Exception:
    known = error_classes().get(failed.fault.kind)
    if known is None:
        return UnexpectedWorkerError(failed.trace)
    return known(failed.fault.message)


def _sent(pipe: Connection, message: object) -> bool:
    try:
        pipe.send(message)
    except OSError:
        return False
    return True


def _received(pipe: Connection) -> object | None:
    try:
        received: object = pipe.recv()
    except (EOFError, OSError):
        return None
    return received


def _serve(pipe: Connection, task: str) -> None:
    """The child's life: load the task, then do jobs until the parent's end of the pipe is gone."""
    # Ctrl-C reaches the whole foreground group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    module, _, name = task.partition(":")
    try:
        loaded = importlib.import_module(module)
        warm = getattr(loaded, "warm_kernels", None)
        if warm is not None:
            warm()
        reconstruct = pkgutil.resolve_name(f"{module}:{name}")
        begin = getattr(loaded, "LiveScan", None)
    except Exception as error:
        _sent(pipe, _Unloadable(f"{type(error).__name__}: {error}"))
        # The traceback goes to the service's log.
        raise
    _sent(pipe, _Ready())
    frames = FedFrames(begin)
    while (message := _received(pipe)) is not None:
        if isinstance(message, _Run):
            live = frames.taken() if message.fed else None
            frames.forget()
            try:
                answer = _answer(pipe, reconstruct, message.job, live)
            except (ConnectionError, EOFError):
                return
            del live
            _sent(pipe, answer)
        else:
            frames.hear(message)


def _answer(pipe: Connection, reconstruct: Callable[..., Mapping[str, Any]], job: Job, live: Any) -> _Done | _Failed:
    stopped = False
    seen = {} if live is None else {"live": live}

    def progress(stage: str, fraction: float, detail: str) -> None:
        pipe.send(_Progressed(stage, fraction, detail))

    def cancelled() -> bool:
        nonlocal stopped
        while pipe.poll():
            stopped = isinstance(pipe.recv(), _Stop) or stopped
        return stopped

    try:
        return _Done(reconstruct(job.bundle, job.output, plan=job.plan, progress=progress, cancelled=cancelled, **seen))
    except (ConnectionError, EOFError):
        # The parent is gone: nobody waits for an answer.
        raise
    except (SlrigError, OSError) as error:
        return _Failed(fault_of(error), traceback.format_exc())
    except Exception as error:  # noqa: BLE001 - the traceback travels to the parent, which logs it
        return _Failed(fault_of(error), traceback.format_exc())

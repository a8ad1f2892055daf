"""The mathematics in a process of its own: it shares no interpreter lock with capture and HTTP, and may end alone.

One process and one pipe rather than a process pool: a pool can report no progress, cannot stop a running task, and
joins it at exit. Here a lost process is noticed at once, and the next job starts a fresh one.
"""

from __future__ import annotations

import importlib
import itertools
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from ctypes import c_double
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.sharedctypes import RawValue
from pathlib import Path
from typing import Any, Protocol
from uuid import UUID

import structlog

from slrig import logs
from slrig.capture import EvidenceSummary
from slrig.errors import ScanCancelledError, WorkerBusyError, WorkerLostError
from slrig.failure import JobFailure, errors_by_code, interruption_error, job_failure
from slrig.jobs.job import FedCaptures, FrameFeed, Job, JobRun
from slrig.jobs.listener import PREPARING, SILENT, Listener
from slrig.logs import LogSettings, set_up_logs
from slrig.model import Region

HEARTBEAT_S = 0.5
"""Interval of the process's heartbeat: short enough that `/readyz` shows a stop within seconds."""


@dataclass(frozen=True, slots=True)
class JobFiles:
    """Folders in which the files of a job are made and where they belong; the evidence of its captured frames."""

    id: UUID
    folder: Path
    place: Path | None = None
    evidence: EvidenceSummary | None = None


@dataclass(frozen=True, slots=True)
class Task:
    """A task of the worker: a call of a function, which is found there by its name and loads its mathematics itself.

    files : of a job, if the function is its `Job.compute`: it is given a `JobRun`. what : the task's name for people.
    remedy : what a person can do when the worker is lost in the middle of it. where : the reason for the place of the
    computation, for a report.
    """

    function: Callable[..., Any]
    given: tuple[Any, ...] = ()
    files: JobFiles | None = None
    what: str = "task"
    remedy: str = "Try again."
    where: Mapping[str, str] = field(default_factory=lambda: {"where": "local"})


@dataclass(frozen=True, slots=True)
class RunTask:
    """Parent to child: do this, with the frames that were sent under the same number if `fed`.

    named : what the lines of the log carry meanwhile, as the job's id.
    """

    number: int
    task: Task
    fed: bool
    named: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Fed:
    """Parent to child, before the job of this number: a message for what receives frames."""

    number: int
    message: object


@dataclass(frozen=True, slots=True)
class Preparing:
    """Child to parent: a kernel is being compiled, after `done` of `total`."""

    done: int
    total: int

    def __str__(self) -> str:
        return f"first time only: {self.done} of {self.total}"


@dataclass(frozen=True, slots=True)
class Ready:
    """Child to parent: the kernels are loaded."""


@dataclass(frozen=True, slots=True)
class Unloadable:
    """Child to parent: the kernels cannot be loaded, and the process ends."""

    cause: str


@dataclass(frozen=True, slots=True)
class Progressed:
    """Child to parent: where the job is."""

    number: int
    stage: str
    fraction: float
    detail: str


@dataclass(frozen=True, slots=True)
class FileMade:
    """Child to parent: a file of the result is there, whole; the job goes on."""

    number: int
    name: str


@dataclass(frozen=True, slots=True)
class Done:
    """Child to parent: the job ended well."""

    number: int
    result: Any


@dataclass(frozen=True, slots=True)
class Failed:
    """Child to parent: the job failed. trace : the traceback, for the log."""

    number: int
    fault: JobFailure
    trace: str


def sent(pipe: Connection, message: object) -> bool:
    """Send a message; return whether the receiver is there."""
    try:
        pipe.send(message)
    except OSError:
        return False
    return True


def received(pipe: Connection) -> object | None:
    """Wait for the next message; None once the other end is gone."""
    try:
        message: object = pipe.recv()
    except (EOFError, OSError):
        return None
    return message


def serve(
    pipe: Connection, stops: Connection, heartbeat: c_double, module: str, logs: LogSettings | None = None
) -> None:
    """The child's life: prepare, then do jobs until the parent's end of the pipe is gone.

    stops : brings the numbers of jobs that are no longer wanted, past other messages in the pipe. heartbeat : takes
    the time of the last sign of life, `time.monotonic`. module : offers `warm_kernels(report)`, and `LiveScan`
    for the frames of a capture; jobs find it as `JobRun.pipeline`. logs : how the parent logs.
    """
    if logs is not None:
        set_up_logs(logs.level, logs.form)
    # Ctrl-C reaches the whole foreground group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "SIGHUP"):  # not on Windows
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    _be_ended_first()
    threading.Thread(target=_beat, args=(heartbeat,), name="slrig-heartbeat", daemon=True).start()
    try:
        loaded = importlib.import_module(module)
        fed = FedCaptures(loaded.LiveScan)
        loaded.warm_kernels(lambda prepared: sent(pipe, Preparing(prepared.done, prepared.total)))
    except Exception as error:  # noqa: BLE001 - any error is reported to the parent and logged
        sent(pipe, Unloadable(f"{type(error).__name__}: {error}"))
        _log.exception("the worker cannot load what it computes with", module=module)
        raise SystemExit(1) from None
    sent(pipe, Ready())
    while (message := received(pipe)) is not None:
        if isinstance(message, RunTask):
            live = fed.taken(message.number) if message.fed else None
            try:
                with structlog.contextvars.bound_contextvars(**message.named):
                    answer = _answer(pipe, stops, message, loaded, live)
            except (ConnectionError, EOFError):
                return
            del live
            sent(pipe, answer)
            del answer
        elif isinstance(message, Fed):
            fed.hear(message.number, message.message)


def _beat(heartbeat: c_double) -> None:
    """Show that this process runs; end it with the service: a kernel that compiles would go on for minutes."""
    parent = multiprocessing.parent_process()
    # The service may have ended while this process was loading: its parent is another one then.
    waiting, service = threading.Event(), os.getppid() if parent is None else parent.pid
    while not waiting.wait(HEARTBEAT_S):
        heartbeat.value = time.monotonic()
        if os.getppid() != service:
            os._exit(1)


def _be_ended_first() -> None:
    """Make the kernel end this process rather than the service, which holds the rig, where memory runs out."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")


def _answer(pipe: Connection, stops: Connection, run: RunTask, pipeline: Any, live: Any) -> Done | Failed:
    stopped = False
    # A task may report progress from several threads.
    sending = threading.Lock()

    def progress(stage: str, fraction: float, detail: str) -> None:
        with sending:
            pipe.send(Progressed(run.number, stage, fraction, detail))

    def made(name: str) -> None:
        with sending:
            pipe.send(FileMade(run.number, name))

    def cancelled() -> bool:
        nonlocal stopped
        while stops.poll():
            stopped = stops.recv() == run.number or stopped
        return stopped

    task, files = run.task, run.task.files
    try:
        if files is None:
            return Done(run.number, task.function(*task.given))
        job_run = JobRun(
            files.id, files.folder, files.place, report=progress, cancelled=cancelled, file_ready=made,
            live=live, evidence=files.evidence, where=task.where, pipeline=pipeline,
        )  # fmt: skip
        return Done(run.number, task.function(job_run))
    except (ConnectionError, EOFError):
        # The parent is gone: no one waits for an answer.
        raise
    except BaseException as error:  # noqa: BLE001 - the traceback travels to the parent, which logs it
        return Failed(run.number, job_failure(error), traceback.format_exc())


CANCEL_LIMIT_S = 10.0
"""A job that has not stopped this long after the request is stopped by ending its process."""

SILENCE_LIMIT_S = 30.0
"""A process that shows no sign of life this long during a job counts as hung. It shows two a second, and no single
step of the mathematics holds the interpreter for more than a second or two; a machine that swaps may."""

STANDSTILL_LIMIT_S = 900.0
"""A job that reports no progress this long counts as one that never ends: the longest step that was measured, a solve
of sixty poses, takes about a minute."""

POLL_S = 0.1


@dataclass(slots=True)
class JobWait:
    """Waits for one job of the process and finds how the wait ends. noted : takes the process's
    messages about itself.
    """

    task: Task
    number: int
    process: BaseProcess
    pipe: Connection
    stops: Connection
    heartbeat: c_double
    listener: Listener
    noted: Callable[[object | None], None]
    answered: bool = False
    _answer: Done | Failed | None = None
    _stop_after: float | None = None
    _checked_s: float = field(default_factory=time.monotonic)
    _beat: float = -1.0
    _silence_s: float = 0.0
    _standstill_s: float = 0.0

    def settled(self, feed: FrameFeed) -> bool:
        """Wait until the frames of a capture have been sent, or cannot be; return whether all were."""
        while not feed.settled(POLL_S):
            # A process that still prepares its kernels takes no frames, and reports how far it is.
            self._hear()
            if self._watch():
                feed.abandon()
        return feed.whole

    def answer(self) -> Done | Failed:
        """Wait for the answer."""
        while True:
            ended = self.process.sentinel in wait([self.pipe, self.process.sentinel], timeout=POLL_S)
            self._hear()
            if self._answer is not None:
                return self._answer
            if ended and not self.pipe.poll():
                self.noted(None)
                raise self.lost()
            self._watch()

    def _hear(self) -> None:
        while self._answer is None and self.pipe.poll():
            match received(self.pipe):
                case Progressed(number, stage, fraction, detail) if number == self.number:
                    self._standstill_s = 0.0
                    self.listener.report(stage, fraction, detail)
                case FileMade(number, name) if number == self.number:
                    self.listener.file_ready(name)
                case Done(number) | Failed(number) as answer if number == self.number:
                    self.answered, self._answer = True, answer
                case Progressed() | FileMade() | Done() | Failed():
                    _log.warning("an unexpected answer was dropped")
                case None | Unloadable() as message:
                    self.noted(message)
                    raise self.lost()
                case message:
                    self._standstill_s = 0.0
                    self.noted(message)
                    if isinstance(message, Preparing):
                        self.listener.report(PREPARING, 0.0, str(message))

    def _watch(self) -> bool:
        """Request the process to stop when the job is cancelled, and end it when it does not, or hangs. Returns whether
        the job is cancelled.
        """
        now_s = time.monotonic()
        # Counted by checks rather than by the clock: a stopped service knows nothing of the worker.
        step_s, self._checked_s = min(now_s - self._checked_s, 1.0), now_s
        if self.heartbeat.value != self._beat:
            self._beat, self._silence_s = self.heartbeat.value, 0.0
        else:
            self._silence_s += step_s
        self._standstill_s += step_s
        if self._silence_s > SILENCE_LIMIT_S:
            raise self._replaced(f"showed no sign of life for {self._silence_s:.0f} s")
        if self._standstill_s > STANDSTILL_LIMIT_S:
            raise self._replaced(f"reported no progress for {self._standstill_s / 60:.0f} minutes")
        if self._stop_after is not None and now_s > self._stop_after:
            _log.warning("a job did not stop when requested, its process is ended", job=self.task.what)
            message = f"The {self.task.what} was cancelled."
            raise ScanCancelledError(message)
        if self._stop_after is None and self.listener.cancelled():
            self._stop_after = now_s + CANCEL_LIMIT_S
            sent(self.stops, self.number)
        return self._stop_after is not None

    def _replaced(self, why: str) -> WorkerLostError:
        _log.error("the worker is replaced", job=self.task.what, why=why)
        message = (
            f"The worker {why} in the middle of the {self.task.what}, and has been replaced. Find out what stops or "
            f"overloads this machine. {self.task.remedy}"
        )
        return WorkerLostError(message)

    def lost(self) -> WorkerLostError:
        """The error of a process that ended."""
        self.process.join()
        code = self.process.exitcode
        how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
        message = (
            f"The worker's process ended in the middle of the {self.task.what} ({how}), and has been replaced. If the "
            f"machine ran out of memory, free some or use a camera of fewer pixels. {self.task.remedy}"
        )
        return WorkerLostError(message)


_ENDED = "its process ended (if the machine ran out of memory, free some)"

SILENCE_SHOWN_S = 5.0
"""Silence after which `condition` says that the process shows no sign of life."""

LOADING = "loading the numerical code (a minute or more where it has to be compiled)"
READY = "ok"

WAITING = "waiting for the worker"
"""The stage of a job while another one is computed."""

_log = structlog.get_logger(__name__)


class UnexpectedWorkerError(Exception):
    """A defect in a task. Carries the traceback of the other process as its text."""


class Worker:
    """Runs one task at a time in a child process, in the order in which they come. Any thread may call."""

    def __init__(self, module: str) -> None:
        """`module` : see `slrig.jobs.worker.serve`."""
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
            if self._condition == READY and silence_s > SILENCE_SHOWN_S:
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
        """Whether the process is not ready yet, but may become so, as `condition` found it last."""
        return self._loading

    def _note(self, message: object | None) -> None:
        """Take a message of a process before its first answer; None represents its end."""
        if isinstance(message, Preparing):
            self._condition = f"{PREPARING}, {message}"
        elif isinstance(message, Ready):
            self._condition, self._loading = READY, False
        elif self._loading:
            # The process is gone, and nothing more is to be read from its pipe.
            self._loading = False
            if self._closed:
                return
            cause = message.cause if isinstance(message, Unloadable) else _ENDED
            self._condition = f"the reconstruction cannot be loaded: {cause}; the service's log has the details"
            _log.error("the reconstruction cannot be loaded", cause=cause)

    @property
    def process_id(self) -> int | None:
        """The process id of the child, None when there is none."""
        return None if self._process is None else self._process.pid

    @property
    def jobs(self) -> int:
        """Number of jobs under way or waiting."""
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
        region : the requested part of the scene.

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
        listener: Listener = SILENT,
        *,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        """Do a task when it is its turn, and return its result. Frames that `feed` has sent, all of them, are used.
        within_s : the longest wait for its beginning, None for any.

        Where anything but an answer ends the wait, the process is replaced: its results would have no owner.

        Raises
        ------
        SlrigError
            The error of the task, by class and message.
        ScanCancelledError
            The listener had it cancelled.
        ScanInterruptedError
            The worker was closed.
        WorkerBusyError
            It did not begin within `within_s`: others were before it, or the process was not ready.
        WorkerLostError
            The process ended, showed no sign of life, or reported no progress for too long.
        UnexpectedWorkerError
            The task has a defect.
        """
        until_s = None if within_s is None else time.monotonic() + within_s
        with self._its_turn(task, listener, until_s):
            self.start()
            if until_s is not None:
                self._wait_until_ready(task, until_s)
            with self._guard:
                process, pipe, stops = self._process, self._pipe, self._stops
                self._running = True
            if process is None or pipe is None or stops is None:
                raise interruption_error()
            number, fed = next(self._numbers), False
            # A process that was started since the capture has not received its frames.
            if feed is not None and feed.receiver is pipe:
                number, fed = feed.number, True
            job = JobWait(task, number, process, pipe, stops, self._heartbeat, listener, self._noted)
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

    def _noted(self, message: object | None) -> None:
        with self._guard:
            self._note(message)

    @contextmanager
    def _its_turn(self, task: Task, listener: Listener, until_s: float | None) -> Iterator[None]:
        """Wait until the jobs that came before are over."""
        turn, reported = next(self._numbers), False
        with self._turn:
            self._turns.append(turn)
        try:
            while True:
                with self._turn:
                    if self._turn.wait_for(lambda: self._turns[0] == turn, timeout=POLL_S):
                        break
                if not reported:
                    listener.report(WAITING, 0.0, "another job is computed first")
                    reported = True
                listener.check(f"The {task.what} was cancelled.")
                if until_s is not None and time.monotonic() > until_s:
                    message = f"Another job is computed, and the {task.what} has to wait for it. Try again."
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
                message = f"The worker is not ready yet for the {task.what} ({self._condition}). Try again."
                raise WorkerBusyError(message)
            time.sleep(POLL_S)

    def close(self) -> None:
        """Kill the process. Idempotent."""
        with self._guard:
            self._closed = True
            process = self._process
        if process is not None:
            process.kill()
            process.join()


def _error(failed: Failed) -> Exception:
    known = errors_by_code().get(failed.fault.code)
    return UnexpectedWorkerError(failed.trace) if known is None else known(failed.fault.message)


def job_task(job: Job, run: JobRun) -> Task:
    """The second part of a job as a task."""
    files = JobFiles(run.id, run.folder, run.place, run.evidence)
    return Task(job.compute, (), files, what=job.noun, remedy=job.remedy)


REQUEST_WAIT_S = 30.0
"""Longest wait of a request for the worker to begin; then its client, who waits a minute, is refused for now."""


class Compute(Protocol):
    """Does tasks for the service. Any thread may call. `slrig.jobs.worker.Worker` says what each part does."""

    @property
    def condition(self) -> str:
        """`slrig.jobs.worker.READY`, how far the kernels are, or why nothing can be computed."""
        ...

    @property
    def loading(self) -> bool:
        """Whether it is not ready yet, but may become so."""
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
        listener: Listener = ...,
        *,
        feed: FrameFeed | None = None,
        within_s: float | None = None,
    ) -> Any:
        """Do a task, and return its result."""
        ...

    def close(self) -> None:
        """End what is computed. Idempotent."""
        ...

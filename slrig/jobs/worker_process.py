"""The worker's own process: prepares its kernels once, and then does one job after another; and what it is told.

Every message of a job carries the job's number. A job whose wait ended early may still be answered: an answer with
another number than that of the job that is waited for belongs to nobody, and is dropped.
"""

from __future__ import annotations

import importlib
import signal
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from ctypes import c_double
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from uuid import UUID

import structlog

from slrig.capture import EvidenceSummary
from slrig.failure import JobFailure, job_failure
from slrig.jobs.frame_feed import FedCaptures
from slrig.jobs.job import JobRun
from slrig.logs import LogSettings, set_up_logs

_log = structlog.get_logger(__name__)

HEARTBEAT_S = 0.5
"""How often the process says that it runs: often enough that a person who asks `/readyz` sees a stop within seconds."""


@dataclass(frozen=True, slots=True)
class JobFiles:
    """Where the files of a job are made, and where they belong; what its frames proved as they were captured."""

    id: UUID
    folder: Path
    place: Path | None = None
    evidence: EvidenceSummary | None = None


@dataclass(frozen=True, slots=True)
class Task:
    """A task of the worker: a call of a function, which is found there by its name and loads its mathematics itself.

    files : of a job, whose `Job.compute` the function is: it is given a `JobRun`. what : the task in words. remedy :
    what a person can do when the worker is lost in the middle of it. movable : the bundle among its files is all that
    is needed: another machine may do it. where : how it came to be done where it is, for a report.
    """

    function: Callable[..., Any]
    given: tuple[Any, ...] = ()
    files: JobFiles | None = None
    what: str = "task"
    remedy: str = "Try again."
    movable: bool = False
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
    """Send a message; return whether somebody is there to receive it."""
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

    stops : brings the numbers of jobs that are not wanted any more, past whatever waits in the pipe. heartbeat : takes
    the time of the last sign of life, `time.monotonic`. module : offers `warm_kernels(told)`, and `frame_receiver()`
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
        fed = FedCaptures(loaded.frame_receiver)
        loaded.warm_kernels(lambda prepared: sent(pipe, Preparing(prepared.done, prepared.total)))
    except Exception as error:  # noqa: BLE001 - whatever it is, the parent and the log are told
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
    waiting = threading.Event()
    while not waiting.wait(HEARTBEAT_S):
        heartbeat.value = time.monotonic()


def _be_ended_first() -> None:
    """Have the kernel end this process rather than the service, which holds the rig, where memory runs out."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")


def _answer(pipe: Connection, stops: Connection, run: RunTask, pipeline: Any, live: Any) -> Done | Failed:
    stopped = False
    # A task may tell of its progress from several threads.
    telling = threading.Lock()

    def progress(stage: str, fraction: float, detail: str) -> None:
        with telling:
            pipe.send(Progressed(run.number, stage, fraction, detail))

    def made(name: str) -> None:
        with telling:
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
            files.id, files.folder, files.place, progress, cancelled, made,
            live=live, evidence=files.evidence, where=task.where, pipeline=pipeline,
        )  # fmt: skip
        return Done(run.number, task.function(job_run))
    except (ConnectionError, EOFError):
        # The parent is gone: nobody waits for an answer.
        raise
    except Exception as error:  # noqa: BLE001 - the traceback travels to the parent, which logs it
        return Failed(run.number, job_failure(error), traceback.format_exc())

"""The reconstruction's own process: what it does, and the messages between it and the service."""

from __future__ import annotations

import importlib
import signal
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from slrig.scan.faults import ScanFault, fault_of
from slrig.scan.feed import FedFrames
from slrig.scan.plan import ReconstructionPlan


@dataclass(frozen=True, slots=True)
class Job:
    """One reconstruction: the arguments of `slrig.scan.pipeline.reconstruct_bundle`."""

    bundle: Path
    output: Path
    plan: ReconstructionPlan


@dataclass(frozen=True, slots=True)
class Run:
    """Parent to child: do this job, with the frames that were sent before if `fed`."""

    job: Job
    fed: bool


@dataclass(frozen=True, slots=True)
class Stop:
    """Parent to child: the job under way is not wanted any more."""


@dataclass(frozen=True, slots=True)
class Preparing:
    """Child to parent: a kernel is being compiled, after `done` of `total`."""

    done: int
    total: int

    def __str__(self) -> str:
        return f"first time only: {self.done} of {self.total}"


@dataclass(frozen=True, slots=True)
class Ready:
    """Child to parent: the task is loaded."""


@dataclass(frozen=True, slots=True)
class Unloadable:
    """Child to parent: the task cannot be loaded, and the process ends."""

    cause: str


@dataclass(frozen=True, slots=True)
class Progressed:
    """Child to parent: where the job under way is."""

    stage: str
    fraction: float
    detail: str


@dataclass(frozen=True, slots=True)
class Done:
    """Child to parent: the job ended well."""

    report: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Failed:
    """Child to parent: the job failed. trace : the traceback, for the log."""

    fault: ScanFault
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


def serve(pipe: Connection, task: str) -> None:
    """The child's life: load the task, then do jobs until the parent's end of the pipe is gone."""
    # Ctrl-C reaches the whole foreground group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "SIGHUP"):  # not on Windows
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    module, _, name = task.partition(":")
    try:
        loaded = importlib.import_module(module)
        reconstruct, begin = getattr(loaded, name), loaded.LiveScan
        loaded.warm_kernels(lambda prepared: sent(pipe, Preparing(prepared.done, prepared.total)))
    except Exception as error:
        sent(pipe, Unloadable(f"{type(error).__name__}: {error}"))
        # The traceback goes to the service's log.
        raise
    sent(pipe, Ready())
    frames = FedFrames(begin)
    while (message := received(pipe)) is not None:
        if isinstance(message, Run):
            live = frames.taken() if message.fed else None
            frames.forget()
            try:
                answer = _answer(pipe, reconstruct, message.job, live)
            except (ConnectionError, EOFError):
                return
            del live
            sent(pipe, answer)
        else:
            frames.hear(message)


def _answer(pipe: Connection, reconstruct: Callable[..., Mapping[str, Any]], job: Job, live: Any) -> Done | Failed:
    stopped = False
    seen = {} if live is None else {"live": live}

    def progress(stage: str, fraction: float, detail: str) -> None:
        pipe.send(Progressed(stage, fraction, detail))

    def cancelled() -> bool:
        nonlocal stopped
        while pipe.poll():
            stopped = isinstance(pipe.recv(), Stop) or stopped
        return stopped

    try:
        return Done(reconstruct(job.bundle, job.output, plan=job.plan, progress=progress, cancelled=cancelled, **seen))
    except (ConnectionError, EOFError):
        # The parent is gone: nobody waits for an answer.
        raise
    except Exception as error:  # noqa: BLE001 - the traceback travels to the parent, which logs it
        return Failed(fault_of(error), traceback.format_exc())

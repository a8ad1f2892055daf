"""The worker's own process: prepares its kernels once, and then does one job after another."""

from __future__ import annotations

import importlib
import inspect
import signal
import threading
import time
import traceback
from contextlib import suppress
from ctypes import c_double
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from slrig.failure import failure_of
from slrig.jobs.channel import (
    Done,
    Failed,
    Fed,
    Preparing,
    Progressed,
    Ready,
    Run,
    Task,
    Unloadable,
    received,
    sent,
)

HEARTBEAT_S = 0.5
"""How often the process says that it runs: often enough that a person who asks `/readyz` sees a stop within seconds."""


def serve(pipe: Connection, stops: Connection, heartbeat: c_double, module: str) -> None:
    """The child's life: prepare, then do jobs until the parent's end of the pipe is gone.

    stops : brings the numbers of jobs that are not wanted any more, past whatever waits in the pipe. heartbeat : takes
    the time of the last sign of life, `time.monotonic`. module : offers `warm_kernels(told)`, and `frame_receiver()`,
    what the frames of a capture are told to.
    """
    # Ctrl-C reaches the whole foreground group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "SIGHUP"):  # not on Windows
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    _be_ended_first()
    threading.Thread(target=_beat, args=(heartbeat,), name="slrig-heartbeat", daemon=True).start()
    try:
        loaded = importlib.import_module(module)
        frames = loaded.frame_receiver()
        loaded.warm_kernels(lambda prepared: sent(pipe, Preparing(prepared.done, prepared.total)))
    except Exception as error:
        sent(pipe, Unloadable(f"{type(error).__name__}: {error}"))
        # The traceback goes to the service's log.
        raise
    sent(pipe, Ready())
    capture = 0
    while (message := received(pipe)) is not None:
        if isinstance(message, Run):
            live = frames.taken() if message.fed and message.number == capture else None
            frames.forget()
            try:
                answer = _answer(pipe, stops, message, live)
            except (ConnectionError, EOFError):
                return
            del live
            sent(pipe, answer)
            del answer
        elif isinstance(message, Fed) and message.number >= capture:
            if message.number > capture:
                capture = message.number
                frames.forget()
            frames.hear(message.message)


def _beat(heartbeat: c_double) -> None:
    waiting = threading.Event()
    while not waiting.wait(HEARTBEAT_S):
        heartbeat.value = time.monotonic()


def _be_ended_first() -> None:
    """Have the kernel end this process rather than the service, which holds the rig, where memory runs out."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")


def _answer(pipe: Connection, stops: Connection, run: Run, live: Any) -> Done | Failed:
    stopped = False

    def progress(stage: str, fraction: float, detail: str) -> None:
        pipe.send(Progressed(run.number, stage, fraction, detail))

    def cancelled() -> bool:
        nonlocal stopped
        while stops.poll():
            stopped = stops.recv() == run.number or stopped
        return stopped

    try:
        given = {"progress": progress, "cancelled": cancelled}
        if live is not None:
            given["live"] = live
        return Done(run.number, _called(run.task, given))
    except (ConnectionError, EOFError):
        # The parent is gone: nobody waits for an answer.
        raise
    except Exception as error:  # noqa: BLE001 - the traceback travels to the parent, which logs it
        return Failed(run.number, failure_of(error), traceback.format_exc())


def _called(task: Task, given: dict[str, Any]) -> Any:
    module, _, name = task.function.partition(":")
    function = getattr(importlib.import_module(module), name)
    taken = inspect.signature(function).parameters
    return function(*task.given, **task.options, **{name: each for name, each in given.items() if name in taken})

"""What the service and its worker say to each other. Every message of a job carries the job's number.

A job whose wait ended early may still be answered: an answer with another number than that of the job that is waited
for belongs to nobody, and is dropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from slrig.failure import JobFailure


@dataclass(frozen=True, slots=True)
class Task:
    """A task of the worker: a function that is named rather than passed, so that the service need not load it.

    function : "module:function". It is given `progress` and `cancelled` if it takes arguments of these names, and
    `live`, what received the frames of a capture, if there were any. what : the task in words. remedy : what a person
    can do when the worker is lost in the middle of it.
    """

    function: str
    given: tuple[Any, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    what: str = "task"
    remedy: str = "Try again."


@dataclass(frozen=True, slots=True)
class Run:
    """Parent to child: do this, with the frames that were sent under the same number if `fed`."""

    number: int
    task: Task
    fed: bool


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

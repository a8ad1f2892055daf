"""Messages between members of a pool: JSON objects, one a line, over TLS for which both ends show certificates. They
are data: nothing that comes is code, or is loaded as such.
"""

from __future__ import annotations

import asyncio
import signal
import ssl
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from slrig.compute.security import PoolAddress
from slrig.failure import JobFailure
from slrig.jobs.job import Outcome

CONNECT_S = 5.0
"""The longest that a scheduler may take to answer, and a connection to end: it does nothing else."""

BEAT_S = 2.0
"""Interval of each end's heartbeat."""

LOST_S = 10.0
"""From when on an end that was not heard of is given up."""

BEAT = b"\n"

LINE_BYTES = 2**20
"""The longest message. An order takes some kB, a report's summary less."""


POOL_FAULT = "pool"
"""The code of a fault that is not the task's own: another try may go well."""


class PoolError(Exception):
    """The pool or its store did not do its part; its text says why. The rig computes by itself.
    final : whether another try would end in the same way.
    """

    def __init__(self, message: str, *, final: bool = False) -> None:
        super().__init__(message)
        self.final = final


class Message(BaseModel):
    """Base of the messages of a connection. Any other message ends it."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")


JobKey = Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
"""A job of a pool: a random number, which is part of names in the store."""

Versions = dict[str, str]
"""See `slrig.jobs.records.versions`."""


class Hello(Message):
    """Member to scheduler, the first message. versions : of a worker; None: a rig. protocol : of these messages."""

    says: Literal["hello"] = "hello"
    protocol: Literal[1] = 1
    versions: Versions | None = None


class Refused(Message):
    """Scheduler to member, the last message."""

    says: Literal["refused"] = "refused"
    cause: str


class Workers(Message):
    """Scheduler to rig: the versions of its workers, each once."""

    says: Literal["workers"] = "workers"
    versions: list[Versions]


class PoolRequest(Message):
    """Rig to scheduler to worker. task : a `slrig.compute.host.PoolTask`, which the worker alone reads. versions : of
    the rig; others must not compute it.
    """

    says: Literal["request"] = "request"
    job: JobKey
    versions: Versions
    task: dict[str, Any]


class Withdrawal(Message):
    """Rig to scheduler to worker: a job is not wanted any more."""

    says: Literal["withdrawal"] = "withdrawal"
    job: JobKey


class Progress(Message):
    """Worker to scheduler to rig: where a job is; the first, without a stage, that it has begun."""

    says: Literal["progress"] = "progress"
    job: JobKey
    stage: str = ""
    fraction: float = 0.0
    detail: str = ""


class PoolResponse(Message):
    """Worker to scheduler to rig: what came of a job, its result and the hash of each file in the store by its name; or
    a fault.
    """

    says: Literal["response"] = "response"
    job: JobKey
    result: Outcome | None = None
    files: dict[str, str] = {}
    fault: JobFailure | None = None


_MESSAGE: TypeAdapter[Message] = TypeAdapter(
    Annotated[
        Hello | Refused | Workers | PoolRequest | Withdrawal | Progress | PoolResponse, Field(discriminator="says")
    ]
)


class Link:
    """One end of a connection; of one event loop."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    def send(self, message: Message) -> None:
        """Send a message, if the other end is there. Returns at once."""
        if not self._writer.is_closing():
            self._writer.write(message.model_dump_json().encode() + b"\n")

    async def hear(self, heard: Callable[[Message], None]) -> None:
        """Give what comes to `heard` until the other end is gone, and say meanwhile that this one is there.

        Raises
        ------
        OSError
            The connection broke, or nothing came for `LOST_S`.
        PoolError
            An invalid message came, the other end refuses this one, or `heard` raised it.
        """
        beating = asyncio.create_task(self._beat())
        try:
            while (message := await self._next()) is not None:
                if isinstance(message, Refused):
                    raise PoolError(message.cause)
                heard(message)
        finally:
            beating.cancel()

    def close(self) -> None:
        """End the connection, after what was sent. Idempotent."""
        self._writer.close()

    async def _next(self) -> Message | None:
        try:
            line = BEAT
            while line == BEAT:
                async with asyncio.timeout(LOST_S):
                    line = await self._reader.readline()
            return _MESSAGE.validate_json(line) if line else None
        except ValueError as error:
            message = "the other end sent no valid message; install one version of slrig on all machines of the pool"
            raise PoolError(message) from error

    async def _beat(self) -> None:
        while not self._writer.is_closing():
            self._writer.write(BEAT)
            await asyncio.sleep(BEAT_S)


def cause(error: Exception) -> str:
    """Why a connection failed, for people."""
    if isinstance(error, ssl.SSLError):
        return f"the certificates of the two ends have ended, or are not of one authority ({error.reason})"
    return str(error) or type(error).__name__


async def connect(address: PoolAddress, hello: Hello) -> Link:
    """Join a pool. Raises OSError, ConfigError."""
    opened = asyncio.open_connection(
        address.host, address.port, limit=LINE_BYTES, ssl=address.tls(listens=False), ssl_shutdown_timeout=CONNECT_S
    )
    async with asyncio.timeout(CONNECT_S):
        link = Link(*await opened)
    link.send(hello)
    return link


def run_until_stopped(life: Callable[[], Awaitable[None]]) -> None:
    """Run until SIGTERM or Ctrl-C, which cancel."""

    async def live() -> None:
        living = asyncio.ensure_future(life())
        for each in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(each, living.cancel)
        with suppress(asyncio.CancelledError):
            await living

    asyncio.run(live())

"""Connections of the service: how long a client may take, how many there may be, and who makes room.

uvicorn has a time limit for an idle connection only, and its `limit_concurrency` refuses everybody alike once strangers
have opened enough connections. Here a client that owes the service something (the head of a request, its body, the
taking of an answer) owes it for a limited time, and where no room is left, the one that has owed for longest makes room
for the newcomer: half-sent requests keep nobody out.
"""

from __future__ import annotations

import asyncio
import json
import socket
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

import h11
import structlog
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from slrig.api.problems import MEDIA_TYPE, http_problem
from slrig.config import is_loopback

KEPT_DESCRIPTORS = 256
"""What connections leave to the rig, the records and the worker. A service with a rendered rig has 60 open, each USB
camera about 10."""

DESCRIPTORS_PER_CONNECTION = 2
"""Its socket, and a file that is sent through it."""

NEWCOMERS = 32
"""Connections beyond the most that wait for their request to be read while all others are being answered: a probe that
comes just then is no stranger. They are taken from the kept descriptors."""

WANTED_DESCRIPTORS = 4096
"""The soft limit that the service asks for; systems give 1024 unless asked. Enough for the most connections that the
settings allow."""

_ACCEPT_QUIET_S = 60.0
"""How long nothing more is said of connections that could not be accepted."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Deadlines:
    """How long, in seconds, a client may take: to send the head of a request, to send its body, to begin another one,
    and to take what is being sent to it.
    """

    head_s: float = 10.0
    body_s: float = 60.0
    idle_s: float = 30.0
    stall_s: float = 60.0


class Room:
    """How many connections there may be, in all and from one address; this machine itself has no limit of its own.

    Lives on the event loop's thread.
    """

    def __init__(self, most: int, *, most_per_address: int) -> None:
        self.most = most
        self.most_per_address = most_per_address
        self._open: Counter[str] = Counter()
        # Those that owe something, the one that has owed for longest first.
        self._owing: dict[HttpConnection, None] = {}

    @property
    def open(self) -> int:
        """How many connections are open."""
        return self._open.total()

    def enter(self, newcomer: HttpConnection) -> None:
        """Let a connection in, and have one make room for it where there is none: itself if nobody else owes anything,
        and `NEWCOMERS` wait already.
        """
        self._open[newcomer.address] += 1
        self._owing[newcomer] = None
        if not is_loopback(newcomer.address) and self._open[newcomer.address] > self.most_per_address:
            self._make_room(each for each in self._owing if each.address == newcomer.address)
        elif self.open > self.most + NEWCOMERS or (self.open > self.most and next(iter(self._owing)) is not newcomer):
            self._make_room(iter(self._owing))

    def _make_room(self, candidates: Iterator[HttpConnection]) -> None:
        chosen = next(candidates)
        self._owing.pop(chosen)
        chosen.leave(
            HTTPStatus.SERVICE_UNAVAILABLE,
            "As many connections are open as this service allows. Try again in a moment.",
        )

    def owes(self, connection: HttpConnection, *, owing: bool) -> None:
        """Note whether a connection owes the service something from now on."""
        if not owing:
            self._owing.pop(connection, None)
        elif connection.address in self._open:
            self._owing.setdefault(connection)

    def exit(self, connection: HttpConnection) -> None:
        """Forget a connection."""
        self._owing.pop(connection, None)
        self._open[connection.address] -= 1
        if self._open[connection.address] <= 0:
            del self._open[connection.address]


class ConnectionConfig(uvicorn.Config):
    """uvicorn's settings, with deadlines and the room for connections."""

    def __init__(self, app: Any, *, deadlines: Deadlines, room: Room, **settings: Any) -> None:
        super().__init__(
            app,
            http=HttpConnection,
            # An upgrade is answered as the plain request that it came with.
            ws="none",
            proxy_headers=False,
            server_header=False,
            access_log=False,
            timeout_keep_alive=round(deadlines.idle_s),
            # asyncio accepts as many at a time, and says of each that it could not.
            backlog=128,
            **settings,
        )
        self.deadlines = deadlines
        self.room = room


class HttpConnection(H11Protocol):
    """One connection, held to its deadlines."""

    config: ConnectionConfig
    address = ""
    _deadline: asyncio.TimerHandle | None = None
    _stalled: asyncio.TimerHandle | None = None
    _awaited = ""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as uvicorn's
        """See `asyncio.Protocol`."""
        super().connection_made(transport)
        self.address = self.client[0] if self.client else ""
        self._await("head")
        self.config.room.enter(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        self._await("")
        self.resume_writing()
        self.config.room.exit(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        super().data_received(data)
        if not self.transport.is_closing():
            self._look(begun=True)

    def on_response_complete(self) -> None:
        """See `H11Protocol`."""
        super().on_response_complete()
        if not self.transport.is_closing():
            self._look(begun=False)

    def _look(self, *, begun: bool) -> None:
        """See what the client owes now. begun : it has sent something; else an idle connection owes no head yet."""
        if self.conn.their_state is h11.SEND_BODY:
            self._await("body")
        elif self.conn.their_state is h11.IDLE and begun:
            self._await("head")
        else:
            self._await("")
            # An idle connection owes nothing in time, and is the first to make room all the same.
            self.config.room.owes(self, owing=self.conn.their_state is h11.IDLE)

    def _await(self, part: str) -> None:
        if part == self._awaited:
            return
        self._awaited = part
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        self.config.room.owes(self, owing=False)
        if part:
            self.config.room.owes(self, owing=True)
            wait_s = self.config.deadlines.head_s if part == "head" else self.config.deadlines.body_s
            self._deadline = self.loop.call_later(wait_s, self._too_late, part, wait_s)

    def _too_late(self, part: str, wait_s: float) -> None:
        self.leave(
            HTTPStatus.REQUEST_TIMEOUT,
            f"The {part} of the request did not arrive within {wait_s:g} s. Send it at once.",
        )

    def leave(self, status: HTTPStatus, detail: str) -> None:
        """Close the connection, and say why where no answer has begun."""
        if self.transport.is_closing():
            return
        if self.conn.our_state in {h11.IDLE, h11.SEND_RESPONSE} and self._awaited:
            body = json.dumps(http_problem(status, detail)).encode()
            head = (
                f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {MEDIA_TYPE}\r\n"
                f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
            )
            self.transport.write(head.encode() + body)
        if self.cycle is not None:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self.transport.close()

    def pause_writing(self) -> None:
        """See `asyncio.Protocol`."""
        super().pause_writing()
        if self._stalled is None:
            self._stalled = self.loop.call_later(self.config.deadlines.stall_s, self.transport.abort)

    def resume_writing(self) -> None:
        """See `asyncio.Protocol`."""
        super().resume_writing()
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def _unsupported_upgrade_warning(self) -> None:
        """Say nothing: anybody could fill the log with it."""


def room_for(most: int, *, most_per_address: int) -> Room:
    """As much room as the descriptors of this process leave, at most `most` connections."""
    limit = raise_descriptor_limit()
    if limit is not None:
        most = max(min(most, (limit - KEPT_DESCRIPTORS) // DESCRIPTORS_PER_CONNECTION), 16)
    return Room(most, most_per_address=most_per_address)


def raise_descriptor_limit() -> int | None:
    """Raise the soft limit of open files to what the service wants, and return it; None where there is none."""
    try:
        import resource
    except ImportError:
        # Windows, and systems like it.
        return None
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    if soft == unlimited:
        return None
    wanted = WANTED_DESCRIPTORS if hard == unlimited else min(WANTED_DESCRIPTORS, hard)
    if soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return int(soft)


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket bound to an address, whose connections send small answers at once: asyncio switches Nagle's delay off
    only where the protocol is named.
    Raises OSError: the address is taken, or not this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        if sys.platform != "win32":
            # There it would let two programs listen at one address.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
    except BaseException:
        listener.close()
        raise
    return listener


def quiet_accepts(loop: asyncio.AbstractEventLoop) -> None:
    """Have a loop say once a minute, and not for each connection, that it can accept none."""
    last_s = -_ACCEPT_QUIET_S

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        nonlocal last_s
        if "socket.accept()" not in str(context.get("message")):
            loop.default_exception_handler(context)
        elif loop.time() - last_s >= _ACCEPT_QUIET_S:
            last_s = loop.time()
            _log.error("connections cannot be accepted", error=str(context.get("exception")))

    loop.set_exception_handler(handle)

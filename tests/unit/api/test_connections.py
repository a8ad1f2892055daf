"""What a client of the service owes, for how long, and who makes room: a real server on loopback, short deadlines."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from http import HTTPStatus

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from slrig.api import connections
from slrig.api.connections import (
    Connection,
    ConnectionConfig,
    Deadlines,
    Room,
    listening_socket,
    quiet_accepts,
    raise_descriptor_limit,
)
from tests.unit.looped import on_loop

SHORT = Deadlines(head_s=0.3, body_s=0.3, idle_s=1, stall_s=0.3)
LONG = Deadlines(head_s=60, body_s=60, idle_s=60, stall_s=60)
GET = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"
HALF_HEAD = b"GET / HTTP/1.1\r\nHo"
HALF_BODY = b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 10\r\n\r\nabc"


async def application(scope: Scope, receive: Receive, send: Send) -> None:
    """Read the body, then answer: with 50 MB under /long."""
    while (message := await receive())["type"] == "http.request" and message.get("more_body"):
        pass
    if message["type"] == "http.disconnect":
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    if scope["path"] == "/long":
        for _ in range(50):
            await send({"type": "http.response.body", "body": bytes(10**6), "more_body": True})
    await send({"type": "http.response.body", "body": b"ok"})


async def until(condition: Callable[[], bool]) -> None:
    for _ in range(100_000):
        if condition():
            return
        await asyncio.sleep(0.001)
    pytest.fail("it never came to hold")


@dataclass
class Served:
    """A server, and the connections that a test opened to it."""

    port: int
    room: Room
    server: uvicorn.Server
    writers: list[asyncio.StreamWriter]

    async def connect(self, data: bytes = b"") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        writer.write(data)
        self.writers.append(writer)
        return reader, writer


@asynccontextmanager
async def serving(deadlines: Deadlines, *, most: int = 100) -> AsyncIterator[Served]:
    listener = listening_socket("127.0.0.1", 0)
    room = Room(most, most_per_address=1)
    config = ConnectionConfig(
        application, deadlines=deadlines, room=room, lifespan="off", log_config=None, timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    task = asyncio.create_task(server._serve([listener]))
    await until(lambda: server.started)
    served = Served(listener.getsockname()[1], room, server, [])
    try:
        yield served
    finally:
        for writer in served.writers:
            writer.transport.abort()
        server.should_exit = True
        await task


@pytest.mark.parametrize(("sent", "part"), [(b"", "head"), (HALF_HEAD, "head"), (HALF_BODY, "body")])
@on_loop
async def test_request_that_does_not_arrive_in_time_gets_408(sent: bytes, part: str) -> None:
    async with serving(SHORT) as served:
        reader, _ = await served.connect(sent)
        head, _, body = (await reader.read()).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 408 ")
        told = json.loads(body)
        assert told["type"] == "/problems/request-timeout"
        assert told["detail"].startswith(f"The {part} of the request did not arrive within 0.3 s.")
        assert served.room.open == 0


@on_loop
async def test_a_head_that_drips_gains_no_time() -> None:
    async with serving(SHORT) as served:
        reader, writer = await served.connect()
        answer = asyncio.create_task(reader.read())
        drops = [bytes([byte]) for byte in HALF_HEAD * 4]
        # Each byte but the last takes 50 ms at least, and the whole head has 300 ms.
        while not answer.done() and drops:
            writer.write(drops.pop())
            await asyncio.wait({answer}, timeout=0.05)
        assert (await answer).startswith(b"HTTP/1.1 408 ")
        assert len(drops) > 40


@on_loop
async def test_an_idle_connection_is_closed_without_a_word() -> None:
    async with serving(SHORT) as served:
        reader, _ = await served.connect(GET)
        answered = await reader.read()
        assert answered.startswith(b"HTTP/1.1 200 ")
        assert answered.count(b"HTTP/1.1") == 1


@on_loop
async def test_who_does_not_take_its_answer_is_let_go() -> None:
    async with serving(SHORT) as served:
        reader, _ = await served.connect(b"GET /long HTTP/1.1\r\nHost: a\r\n\r\n")
        await until(lambda: served.room.open == 1)
        await until(lambda: served.room.open == 0)
        assert len(await reader.read()) < 50 * 10**6


@on_loop
async def test_half_sent_requests_make_room_for_whole_ones() -> None:
    async with serving(LONG, most=8) as served:
        held = [await served.connect(HALF_HEAD if number % 2 else HALF_BODY) for number in range(40)]
        for _ in range(10):
            reader, _ = await served.connect(GET)
            assert (await reader.readline()).startswith(b"HTTP/1.1 200 ")
            assert served.room.open <= 8
        oldest = await held[0][0].read()
        assert b" 503 " in oldest.partition(b"\r\n")[0]
        assert b"/problems/service-unavailable" in oldest


@on_loop
async def test_a_request_under_way_never_makes_room() -> None:
    release = asyncio.Event()

    async def slow(_scope: Scope, _receive: Receive, send: Send) -> None:
        await release.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"done"})

    async with serving(LONG, most=4) as served:
        served.server.config.loaded_app = slow
        # A probe that comes while all others are being answered is heard; more than a few are not.
        working = [await served.connect(GET) for _ in range(4)]
        await until(lambda: len(served.server.server_state.tasks) == 4)
        for count in range(5, 5 + connections.NEWCOMERS):
            working.append(await served.connect(GET))
            await until(lambda count=count: len(served.server.server_state.tasks) == count)  # type: ignore[misc]
        refused, _ = await served.connect()
        assert b" 503 " in await refused.readline()
        release.set()
        for reader, _ in working:
            assert (await reader.readline()).startswith(b"HTTP/1.1 200 ")


class _Peer(Connection):
    """A connection without a socket."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.left = 0

    def leave(self, status: HTTPStatus, detail: str) -> None:
        assert "Try again" in detail
        self.left = status


def test_one_address_makes_room_among_its_own() -> None:
    room = Room(100, most_per_address=2)
    mine, others = [_Peer("192.0.2.1") for _ in range(4)], [_Peer("192.0.2.2") for _ in range(2)]
    for peer in (others[0], *mine, others[1]):
        room.enter(peer)
    assert [peer.left for peer in mine] == [503, 503, 0, 0]
    assert [peer.left for peer in others] == [0, 0]


@on_loop
async def test_answers_are_not_held_back() -> None:
    async with serving(LONG) as served:
        await served.connect(GET)
        await until(lambda: len(served.server.server_state.connections) == 1)
        (connection,) = served.server.server_state.connections
        accepted = connection.transport.get_extra_info("socket")
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


@on_loop
async def test_refused_accept_is_logged_once_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(connections._log, "error", lambda message, **_: told.append(message))

    loop = asyncio.get_running_loop()
    quiet_accepts(loop)
    for _ in range(1000):
        message = "socket.accept() out of system resource"
        loop.call_exception_handler({"message": message, "exception": OSError(24, "Too many open files")})
    assert told == ["connections cannot be accepted"]


def test_the_limit_of_open_files_is_raised() -> None:
    resource = pytest.importorskip("resource", reason="Windows has no such limit")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = min(connections.WANTED_DESCRIPTORS, before[1])
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))
        assert raise_descriptor_limit() == wanted
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] == wanted
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)

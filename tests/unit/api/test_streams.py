"""Clients of the service: their streams of events, whole and in order; their connections, and who makes room."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator, MutableMapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
import uvicorn
from fastapi import FastAPI
from fastapi.testclient import TestClient
from starlette.types import Receive, Scope, Send

from slrig.api import server as connections
from slrig.api.events import Followed, SharedQueries, followed_feed, followed_job
from slrig.api.events import event_stream as stream_of
from slrig.api.server import (
    ConnectionConfig,
    Deadlines,
    HttpConnection,
    Room,
    listening_socket,
    quiet_accepts,
    raise_descriptor_limit,
)
from slrig.failure import JobFailure
from slrig.jobs.database import Database
from slrig.jobs.records import JobEvent, JobKind, JobProgress, JobState
from slrig.jobs.store import EVERY_JOB, JobStore
from tests.unit.api.conftest import KEY, ServedBench
from tests.unit.looped import on_loop
from tests.unit.scan.fakes import WAIT_S


class ActingStore(JobStore):
    """Does something of its own before the next look at a scan's events, on the thread that looks."""

    act: Callable[[], None] | None = None

    def events(self, job_id: UUID, *, after: int) -> Sequence[JobEvent]:
        act, self.act = self.act, None
        if act is not None:
            act()
        return super().events(job_id, after=after)


class Jobs:
    """The jobs of one database. `looks` : after which number each look was."""

    def __init__(self, folder: Path) -> None:
        database = Database(folder / "slrig.sqlite")
        self.store = ActingStore(database)
        self.open: dict[UUID, SharedQueries] = {}
        self.looks: list[int] = []

    def followed(self, *, most: int = 500) -> Followed:
        whole = followed_feed(self.store, most)

        def look(after: int) -> Any:
            self.looks.append(after)
            found = whole.query(after)
            assert len(found[0]) <= most
            return found

        return Followed(look, whole.watch, whole.last, most)

    def scan(self, steps: int = 0) -> UUID:
        job = self.store.create({}, kind=JobKind.SCAN, rig="bench", label=None)
        for step in range(steps):
            self.store.progress(job.id, JobProgress("capture", step / 1000, ""))
        return job.id

    def follow(self, after: int = 0, *, most: int = 500) -> AsyncGenerator[bytes]:
        stream = stream_of(self.open, EVERY_JOB, self.followed(most=most), after, keepalive_s=WAIT_S)
        assert isinstance(stream, AsyncGenerator)
        return stream

    def follow_scan(self, scan: UUID, after: int) -> AsyncIterator[bytes]:
        return stream_of(self.open, scan, followed_job(self.store, scan), after, keepalive_s=WAIT_S)

    async def looked(self, count: int) -> None:
        async with asyncio.timeout(WAIT_S):
            while len(self.looks) < count:
                await asyncio.to_thread(int)


@pytest.fixture
def jobs(tmp_path: Path) -> Iterator[Jobs]:
    made = Jobs(tmp_path)
    yield made
    made.store.database.close()


def parts(sent: bytes) -> dict[str, str]:
    """The fields of an event as it is sent; a comment's is ''."""
    return dict(line.split(": ", 1) for line in sent.decode().strip().splitlines())


async def some(stream: AsyncIterator[bytes], count: int) -> list[dict[str, Any]]:
    told: list[dict[str, str]] = []
    async with asyncio.timeout(WAIT_S):
        while len(told) < count:
            event = parts(await anext(stream))
            told += [event] if event.get("id") else []
    return [{"number": int(each["id"]), "event": each["event"], **json.loads(each["data"])} for each in told]


async def rest(stream: AsyncIterator[bytes]) -> list[str | None]:
    async with asyncio.timeout(WAIT_S):
        return [parts(event).get("id") async for event in stream]


@on_loop
async def test_client_ahead_of_its_scan_gets_what_comes_next(jobs: Jobs) -> None:
    scan = jobs.scan()

    def go_on() -> None:
        jobs.store.progress(scan, JobProgress("capture", 0.5, ""))
        jobs.store.finish(scan, JobState.SUCCEEDED)

    jobs.store.act = go_on
    assert await rest(jobs.follow_scan(scan, 1000)) == ["2", "3"]
    assert jobs.open == {}


@pytest.mark.parametrize("final", [True, False])
@on_loop
async def test_stream_of_a_deleted_scan_ends(jobs: Jobs, final: bool) -> None:
    scan = jobs.scan()
    woken: list[bool] = []
    unwatch = jobs.store.watch(scan, lambda: woken.append(True))
    stream = jobs.follow_scan(scan, 0)
    assert parts(await anext(stream))["id"] == "1"
    if final:
        # The last event wakes the stream, which then finds the scan gone.
        jobs.store.act = lambda: jobs.store.delete(scan)
        jobs.store.finish(scan, JobState.SUCCEEDED)
    else:
        jobs.store.delete(scan)
    assert await rest(stream) == []
    unwatch()
    assert woken[0]


@on_loop
async def test_event_of_any_job_wakes_the_streams_of_all_jobs(jobs: Jobs) -> None:
    stream, calibration = jobs.follow(), uuid4()
    waiting = asyncio.ensure_future(some(stream, 1))
    await jobs.looked(1)
    scan = await asyncio.to_thread(jobs.scan)
    (first,) = await waiting
    assert (first["number"], first["job"]["id"], first["state"]) == (1, str(scan), "queued")
    waiting = asyncio.ensure_future(some(stream, 2))
    await asyncio.sleep(0)
    pose = await asyncio.to_thread(
        jobs.store.create, {"number": 4}, kind=JobKind.POSE, rig="bench", label=None, parent=calibration
    )
    fault = JobFailure("pose-refused", "no board")
    await asyncio.to_thread(jobs.store.finish, pose.id, JobState.FAILED, fault=fault)
    queued, failed = await waiting
    assert (queued["number"], queued["event"], failed["number"]) == (2, "state", 3)
    assert failed["job"] == {
        "id": str(pose.id),
        "kind": "pose",
        "label": None,
        "calibration": str(calibration),
        "links": {
            "self": f"/calibration/{calibration}/pose/4",
            "events": f"/calibration/{calibration}/events",
            "calibration": f"/calibration/{calibration}",
        },
    }
    # As everywhere, a fault is the problem that it is.
    assert (failed["error"]["type"], failed["error"]["detail"]) == ("/problems/pose-refused", "no board")


@on_loop
async def test_many_events_come_in_pieces_and_then_the_stream_waits(jobs: Jobs) -> None:
    jobs.scan(steps=41)

    stream = jobs.follow(most=7)
    assert [each["number"] for each in await some(stream, 42)] == list(range(1, 43))
    waiting = asyncio.ensure_future(some(stream, 1))
    await jobs.looked(7)
    # Looks run on these threads: were there further ones, they would have begun.
    for _ in range(20):
        await asyncio.to_thread(int)
    assert (jobs.looks, waiting.done()) == ([0, 7, 14, 21, 28, 35, 42], False), "it looks again and again"
    await asyncio.to_thread(jobs.scan)
    assert (await waiting)[0]["number"] == 43


@pytest.mark.slow
@on_loop
async def test_twenty_clients_cost_little_more_than_one(jobs: Jobs) -> None:
    jobs.scan(steps=59)

    # Each begins somewhere else: no look serves two of them.
    late = [jobs.follow(start, most=2) for start in range(20)]
    await asyncio.gather(*(some(stream, 60 - start) for start, stream in enumerate(late)))
    assert len(jobs.open[EVERY_JOB]._queries) <= 16
    for stream in late:
        await stream.aclose()
    jobs.looks.clear()
    everyone = [asyncio.ensure_future(some(jobs.follow(60), 10)) for _ in range(20)]
    await jobs.looked(1)
    await asyncio.to_thread(jobs.scan, steps=9)
    found = await asyncio.gather(*everyone)
    assert all([each["number"] for each in one] == list(range(61, 71)) for one in found)
    # Each alone would look for each event, 200 times in all.
    assert len(jobs.looks) <= 44


@on_loop
async def test_end_of_the_service_ends_the_stream_after_the_last_event(jobs: Jobs) -> None:
    scan = jobs.scan()

    stream = jobs.follow(1)
    waiting = asyncio.ensure_future(some(stream, 1))
    await jobs.looked(1)
    await asyncio.to_thread(jobs.store.finish, scan, JobState.INTERRUPTED)
    jobs.store.end()
    assert (await waiting)[0]["state"] == "interrupted"
    assert await rest(stream) == []
    assert jobs.open == {}


@on_loop
async def test_events_of_a_deleted_job_are_gone_and_others_go_on(jobs: Jobs) -> None:
    first, second = jobs.scan(steps=2), jobs.scan()
    jobs.store.delete(first)

    stream = jobs.follow()
    assert [each["number"] for each in await some(stream, 1)] == [4]
    waiting = asyncio.ensure_future(some(stream, 1))
    await asyncio.sleep(0)
    await asyncio.to_thread(jobs.store.delete, second)
    await asyncio.to_thread(jobs.scan)
    # A number that was used is never used again.
    assert (await waiting)[0]["number"] == 5


@on_loop
async def test_client_that_names_no_event_gets_the_number_where_it_begins(jobs: Jobs) -> None:
    jobs.scan(steps=4)

    stream = stream_of(jobs.open, EVERY_JOB, jobs.followed(), 5, begins=5, keepalive_s=0.001)
    async with asyncio.timeout(WAIT_S):
        assert await anext(stream) == b"id: 5\n\n"
        # In silence the connection is kept by comments.
        assert await anext(stream) == b": ping\n\n"
    await asyncio.to_thread(jobs.scan)
    assert [each["number"] for each in await some(stream, 1)] == [6]


def test_bad_number_of_an_event_is_refused(client: TestClient) -> None:
    for path, headers in (("/events?after=-1", {}), ("/events?after=x", {}), ("/events", {"Last-Event-ID": "x"})):
        assert client.get(path, headers=headers).status_code == 422


def asked(app: FastAPI, path: str, gone: asyncio.Event, *, method: str = "GET") -> asyncio.Future[int]:
    """The status of an answer to a client that stays until `gone` is set, and until then has not sent all."""
    status: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "path": path,
        "raw_path": path.encode(), "query_string": b"", "root_path": "", "scheme": "http", "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 80),
        "headers": [(b"host", b"127.0.0.1"), (b"x-api-key", KEY.encode()), (b"content-type", b"application/json")],
    }  # fmt: skip

    async def receive() -> dict[str, str]:
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            status.set_result(message["status"])

    async def whole() -> int:
        await app(scope, receive, send)
        return await status

    return asyncio.ensure_future(whole())


@pytest.mark.parametrize("path", ["of a scan", "/events"])
@on_loop
async def test_only_so_many_streams_are_open_at_once(client: TestClient, served: ServedBench, path: str) -> None:
    path = served.held(client)["links"]["events"] if path == "of a scan" else path
    gone = asyncio.Event()
    waiting = [asyncio.ensure_future(asked(served.app, path, gone)) for _ in range(6)]
    # All but those that stay open are answered; these end when their clients go.
    refused: list[int] = []
    while len(waiting) > 1:
        done, pending = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED, timeout=WAIT_S)
        assert done, "more streams are open than may"
        refused += [answer.result() for answer in done]
        waiting = list(pending)
    assert served.service.streams.taken.total() == 1
    gone.set()
    assert (refused, await waiting[0]) == ([429] * 5, 200)
    assert not served.service.streams.taken


@on_loop
async def test_client_that_is_gone_before_its_stream_begins_keeps_no_place(
    client: TestClient, served: ServedBench
) -> None:
    gone = asyncio.Event()
    gone.set()
    await asked(served.app, served.held(client)["links"]["events"], gone)
    assert not served.service.streams.taken


@on_loop
async def test_upload_whose_client_goes_away_is_no_fault(client: TestClient, served: ServedBench) -> None:
    gone = asyncio.Event()
    gone.set()
    for path in ("/calibration/import", "/scan"):
        assert await asked(served.app, path, gone, method="POST") == 400
    assert client.get("/scan").json()["scans"] == []


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


@pytest.mark.skipif(not hasattr(socket, "TCP_NOTSENT_LOWAT"), reason="the kernel decides it by itself")
def test_little_is_kept_for_a_client_that_does_not_read() -> None:
    with listening_socket("127.0.0.1", 0) as listener, socket.socket() as client:
        listener.listen()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**15)
        client.connect(listener.getsockname())
        connection, _ = listener.accept()
        connection.setblocking(False)
        sent = 0
        with connection, suppress(BlockingIOError):
            while sent < 10_000_000:
                sent += connection.send(bytes(50_000))
        # Six depth images of a third of a million points, in place of forty.
        assert sent < 600_000


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
            # The deadline may have passed in this turn: a byte that comes after it resets the connection.
            for _ in range(5):
                await asyncio.sleep(0)
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


class _Peer(HttpConnection):
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

"""The service as a process: claim the data folder, sweep it, open the port, limit connections, serve until it is
stopped.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from http import HTTPStatus
from types import FrameType
from typing import Any, get_args

import h11
import structlog
import uvicorn
from pydantic import SecretStr
from starlette.concurrency import run_in_threadpool
from uvicorn.protocols.http.h11_impl import H11Protocol

from slrig import KEY_VARIABLE
from slrig.accept.job import PositionJob
from slrig.api.app import create_app
from slrig.api.auth import LINK_PATH, KeyRing, Sessions, first_key, local_key
from slrig.api.problems import MEDIA_TYPE, http_problem
from slrig.api.service import Service
from slrig.bundle import write_file
from slrig.calibrate.job import AxisJob, PoseJob, SolveJob
from slrig.calibrate.verification import VerificationJob
from slrig.compute.security import require_pool_extra
from slrig.config import RigConfig, ServiceSettings, is_loopback
from slrig.conformance import ConformanceJob
from slrig.discovery import open_rig
from slrig.disk import prepare_kernel_cache
from slrig.doctor import DoctorJob, LatencyJob
from slrig.errors import ConfigError, InvalidInputError, ServiceError
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.manager import JobManager
from slrig.jobs.records import utc_now
from slrig.jobs.store import Copies, JobStore, Outbox
from slrig.jobs.worker import LOADING, READY, Compute, Worker
from slrig.logs import set_up_logs
from slrig.model_jobs.job import TURNTABLE, ModelJob
from slrig.rig.session import RigSession
from slrig.scan.job import PIPELINE, ScanJob
from slrig.schedule.notices import wanted_kinds

KEPT_DESCRIPTORS = 256
"""Descriptors reserved for the rig, the records and the worker. A service with a rendered rig has 60 open, each USB
camera about 10."""

DESCRIPTORS_PER_CONNECTION = 2
"""Its socket, and a file that is sent through it."""

NEWCOMERS = 32
"""Connections beyond the most that wait for their request to be read while all others are being answered: probes that
come just then are answered. They are taken from the kept descriptors."""

WANTED_DESCRIPTORS = 4096
"""The soft limit that the service requests; systems give 1024 by default. Enough for the most connections that the
settings allow."""

_ACCEPT_QUIET_S = 60.0
"""Least interval of messages about connections that could not be accepted."""


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Time limits of a client, in seconds: to send the head of a request, to send its body, to begin another one,
    and to take what is being sent to it.
    """

    head_s: float = 10.0
    body_s: float = 60.0
    idle_s: float = 30.0
    stall_s: float = 60.0


class Room:
    """Limits of connections, in all and from one address; this machine itself has no limit of its own.

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
        """Number of open connections."""
        return self._open.total()

    def enter(self, newcomer: HttpConnection) -> None:
        """Admit a connection, and close one to make room where there is none: itself if no other one owes anything, and
        `NEWCOMERS` wait already.
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
            self._check_deadline(begun=True)

    def on_response_complete(self) -> None:
        """See `H11Protocol`."""
        super().on_response_complete()
        if not self.transport.is_closing():
            self._check_deadline(begun=False)

    def _check_deadline(self, *, begun: bool) -> None:
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


_MOST_UNSENT_BYTES = 2**17
"""That the kernel holds for a client of what it has not sent yet."""


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
    """A socket bound to an address, with connections that send small answers at once: asyncio switches Nagle's delay
    off only where the protocol is named.
    Raises OSError: the address is taken, or not this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        if sys.platform != "win32":
            # There it would allow two programs to listen at one address.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_NOTSENT_LOWAT"):
            # The kernel would keep megabytes for one who reads slowly: of live streams, pictures of seconds ago.
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _MOST_UNSENT_BYTES)
        listener.bind((host, port))
    except BaseException:
        listener.close()
        raise
    return listener


def quiet_accepts(loop: asyncio.AbstractEventLoop) -> None:
    """Limit a loop's message that it can accept no connection to one a minute."""
    last_s = -_ACCEPT_QUIET_S

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        nonlocal last_s
        if "socket.accept()" not in str(context.get("message")):
            loop.default_exception_handler(context)
        elif loop.time() - last_s >= _ACCEPT_QUIET_S:
            last_s = loop.time()
            _log.error("connections cannot be accepted", error=str(context.get("exception")))

    loop.set_exception_handler(handle)


KINDS = (
    ScanJob, VerificationJob, PoseJob, SolveJob, PositionJob, ModelJob, DoctorJob, LatencyJob, ConformanceJob, AxisJob,
)  # fmt: skip
"""Every kind of job that a service runs."""

ADDRESS_FILE = "service.json"
"""File in the data folder with the URL and process id of a running service."""

_FIRST_KEY_FILE = "first-key"

_REPORT_S = 2.5
"""Interval of messages about the progress of the kernels."""

_log = structlog.get_logger(__name__)


def open_service(
    settings: ServiceSettings, rig: RigConfig, *, give_up: Callable[[InvalidInputError], None] = lambda _: None
) -> Service:
    """Claim the data folder, bring it in order, and return a service that is ready to be started.

    `give_up` is called, on another thread, when the rig file turns out to be wrong as the rig is first opened.

    Raises
    ------
    StorageError
        The folder is in use, or the disk refused.
    """
    folder = DataFolder(settings.data_dir, group=settings.data_group)
    try:
        prepare_kernel_cache(folder.root / "cache")
        database = Database(folder.database, aside=folder.orphans)
        copies = None if settings.catalogue is None else Copies(database)
        outbox = Outbox(database, rig=rig.name, wanted=wanted_kinds(settings), copies=copies)
        worker = _worker(settings)
    except BaseException:
        folder.release()
        raise
    try:
        manager = JobManager(
            JobStore(database, outbox=outbox),
            folder,
            RigSession(rig.name, lambda: open_rig(rig, may_lose=True), table_at=folder.root / TURNTABLE / "table.json"),
            worker,
            *KINDS,
            queue_length=settings.queue_length,
            backlog_length=settings.backlog_length,
            spare_bytes=settings.min_free_bytes,
            give_up=give_up,
        )
        return Service(settings, rig, manager)
    except BaseException:
        database.close()
        folder.release()
        raise


def _worker(settings: ServiceSettings) -> Compute:
    """This machine's own, or the pool's. Raises ConfigError, ExtraMissingError."""
    worker = Worker(PIPELINE)
    if settings.compute is None and settings.compute_store is None:
        return worker
    require_pool_extra()
    from slrig.compute.pooled import pooled

    return pooled(settings, worker)


def serve(
    settings: ServiceSettings,
    rig: RigConfig,
    *,
    new_key: bool = False,
    until_eof: bool = False,
    say: Callable[[str], None],
) -> None:
    """Serve until SIGTERM, SIGHUP or Ctrl-C. `say` shows a person the service's address and, once, its key.

    `until_eof` stops it as well when standard input ends: a service that another program started does not outlive it,
    however that program came to its end.

    Raises
    ------
    ConfigError, CalibrationError, BundleError
        The rig can never be opened as its file describes it, or the key of the environment cannot be used.
    StorageError
        The data folder is in use, or the disk refused.
    ServiceError
        The address is taken.
    """
    set_up_logs(settings.log_level, settings.log_format)
    given = take_secrets()
    # Files written from now on are for the service's user alone, or may be read by one group.
    os.umask(0o077 if settings.data_group is None else 0o027)
    # uvicorn catches SIGTERM while it serves, ends in good order, and then raises it again: here it must not kill the
    # process before the rest of this function has run.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    # A terminal that is closed, or a connection that breaks, ends the service in good order, too; not under nohup.
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: _terminate())
    if until_eof:
        threading.Thread(target=_stop_at_eof, name="slrig-stdin", daemon=True).start()
    listener = _listener(settings)
    host, port = listener.getsockname()[:2]
    url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
    wrong: list[InvalidInputError] = []
    server: uvicorn.Server | None = None

    def give_up(error: InvalidInputError) -> None:
        wrong.append(error)
        if server is not None:
            server.should_exit = True

    try:
        service = open_service(settings, rig, give_up=give_up)
    except BaseException:
        listener.close()
        raise
    address, ended = service.folder.root / ADDRESS_FILE, threading.Event()
    stack = ExitStack()
    try:
        ring = _keys(settings, given, fresh=new_key) if settings.require_key else None
        app = create_app(service, ring=ring, cookie=f"slrig_session_{port}")
        say(f"slrig serves rig '{rig.name}' at {url}, data in {service.folder.root}. Ctrl-C stops it.")
        if ring is not None:
            key = stack.enter_context(local_key(port))
            if key is not None:
                ring.admit(key)
            _show_keys(ring, app.state.sessions, url, service.folder, fresh=new_key, say=say)
        if not is_loopback(settings.host):
            say("Other machines can reach it. Keys and scans travel unencrypted: put a TLS proxy in front.")
        write_file(address, json.dumps({"url": url, "process_id": os.getpid()}).encode())
        config = ConnectionConfig(
            app,
            deadlines=Deadlines(),
            room=room_for(settings.max_connections, most_per_address=settings.max_connections_per_address),
            log_level="warning",
            # Its lines go the way of all others.
            log_config=None,
            # Streams end by themselves once their scans have; this is for every other request under way.
            timeout_graceful_shutdown=1,
        )
        server = _Server(config, service)
        threading.Thread(
            target=_report_preparation, args=(service, say, ended), name="slrig-preparation", daemon=True
        ).start()
        with suppress(KeyboardInterrupt):
            server.run(sockets=[listener])
        if wrong:
            raise wrong[0]
    finally:
        ended.set()
        stack.close()
        service.close()
        with suppress(OSError):
            address.unlink(missing_ok=True)


class _Server(uvicorn.Server):
    """Ends the scans first, while their followers are still connected, and the connections after that."""

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """See `uvicorn.Server`. A second signal ends what the first one waits for."""
        if self.should_exit:
            self._service.hurry.set()
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """See `uvicorn.Server`."""
        quiet_accepts(asyncio.get_running_loop())
        await super().startup(sockets)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """See `uvicorn.Server`."""
        if signal.SIGTERM in self._captured_signals:
            await run_in_threadpool(self._service.drain)
        await run_in_threadpool(self._service.end_work)
        await super().shutdown(sockets)


def _report_preparation(service: Service, say: Callable[[str], None], ended: threading.Event) -> None:
    """Report the progress of the kernels to a person, the first time that they are compiled."""
    reported = ""
    while (status := service.manager.status()).preparing and not status.ending:
        if status.reconstruction not in {reported, LOADING}:
            reported = status.reconstruction
            say(reported)
        ended.wait(_REPORT_S)
    if reported and not status.ending:
        say("kernels are ready" if status.reconstruction == READY else status.reconstruction)


def take_secrets() -> str | None:
    """Take what is secret out of the environment, which the processes that the service starts are given; return the
    key.
    """
    for name, field in ServiceSettings.model_fields.items():
        if SecretStr in get_args(field.annotation):
            os.environ.pop(f"SLRIG_{name}".upper(), None)
    return os.environ.pop(KEY_VARIABLE, None) or None


def _keys(settings: ServiceSettings, given: str | None, *, fresh: bool) -> KeyRing:
    if given is not None and fresh:
        message = f"--new-key requests a new key, and {KEY_VARIABLE} holds the one to use. Leave out one of the two."
        raise ConfigError(message)
    return KeyRing(settings.key_path, given=given)


def _show_keys(
    ring: KeyRing, sessions: Sessions, url: str, folder: DataFolder, *, fresh: bool, say: Callable[[str], None]
) -> None:
    """Make the first key, if there is none, and show it to a person; output that is not a terminal may be kept as a
    log, and gets the path of a file with the key instead.
    """
    key = first_key(ring, fresh=fresh)
    if sys.stdout.isatty():
        if key is not None:
            say(f"API key, shown only now: {key}\nIn the terminal of the client: export {KEY_VARIABLE}={key}")
        owner = next((each for each in ring.everybody if each.fault(utc_now()) is None), None)
        if owner is not None:
            secret = sessions.link(owner.name, owner.digest)
            say(f"In a browser, once, within a quarter of an hour: {url}{LINK_PATH}?token={secret}")
    elif key is not None:
        path = folder.root / _FIRST_KEY_FILE
        write_file(path, f"{key}\n".encode("ascii"))
        path.chmod(0o600)
        say(f"First API key written to {path}. Copy it, then delete the file.")


def _stop_at_eof() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    _terminate()


def _terminate() -> None:
    """End in good order, as by SIGTERM from outside."""
    if sys.platform == "win32":
        # os.kill would end the process then and there.
        signal.raise_signal(signal.SIGTERM)
    else:
        os.kill(os.getpid(), signal.SIGTERM)


def _listener(settings: ServiceSettings) -> socket.socket:
    try:
        listener = listening_socket(settings.host, settings.port)
        # From now on a client that knows the address may connect: it is answered once the service is up.
        listener.listen()
    except OSError as error:
        message = (
            f"The service cannot listen on {settings.host} port {settings.port}: {error.strerror}. Stop what uses that "
            "port, choose another with --port, or any free one with --port 0."
        )
        raise ServiceError(message) from error
    listener.set_inheritable(False)
    return listener

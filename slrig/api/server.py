"""The service as a process: claim the data folder, sweep it, open the port, serve until told to stop."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType

import structlog
import uvicorn
from starlette.concurrency import run_in_threadpool

from slrig import KEY_VARIABLE
from slrig.accept.job import PositionJob
from slrig.api.app import create_app
from slrig.api.connections import ConnectionConfig, Deadlines, listening_socket, quiet_accepts, room_for
from slrig.api.keys import KeyRing, first_key
from slrig.api.service import Service
from slrig.api.sessions import LINK_PATH, Sessions
from slrig.bundle import write_file
from slrig.calibrate.jobs import PoseJob, SolveJob
from slrig.calibrate.verification import VerificationJob
from slrig.combine.job import TURNTABLE, ModelJob
from slrig.compute.security import require_pool_extra
from slrig.config import RigConfig, ServiceSettings, is_loopback
from slrig.conformance import ConformanceJob
from slrig.discovery import open_rig
from slrig.doctor import DoctorJob, LatencyJob
from slrig.errors import ConfigError, InvalidInputError, ServiceError
from slrig.jobs.compute import Compute
from slrig.jobs.copies import Copies
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.manager import JobManager
from slrig.jobs.outbox import Outbox
from slrig.jobs.records import utc_now
from slrig.jobs.store import JobStore
from slrig.jobs.worker import LOADING, READY, Worker, prepare_kernel_cache
from slrig.logs import set_up_logs
from slrig.rig.session import RigSession
from slrig.scan.job import PIPELINE, ScanJob
from slrig.schedule.receivers import wanted_kinds

KINDS = (
    ScanJob, VerificationJob, PoseJob, SolveJob, PositionJob, ModelJob, DoctorJob, LatencyJob, ConformanceJob,
)  # fmt: skip
"""Every kind of job that a service runs."""

ADDRESS_FILE = "service.json"
"""Where in the data folder a running service tells its URL and process id."""

_FIRST_KEY_FILE = "first-key"

_TELL_S = 2.5
"""How often a person is told how far the kernels are."""

_log = structlog.get_logger(__name__)


def open_service(
    settings: ServiceSettings, rig: RigConfig, *, give_up: Callable[[InvalidInputError], None] = lambda _: None
) -> Service:
    """Claim the data folder, bring it in order, and return a service that is ready to be started.

    `give_up` is told, on another thread, when the rig file turns out to be wrong as the rig is first opened.

    Raises
    ------
    StorageError
        The folder is in use, or the disk refused.
    """
    folder = DataFolder(settings.data_dir, group=settings.data_group)
    try:
        prepare_kernel_cache(folder.root / "cache")
        database = Database(folder.database)
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
            RigSession(rig.name, lambda: open_rig(rig), table_at=folder.root / TURNTABLE / "table.json"),
            worker,
            *KINDS,
            queue_length=settings.queue_length,
            backlog_length=settings.backlog_length,
            spare_bytes=settings.min_free_bytes,
            give_up=give_up,
        )
        return Service(
            settings,
            rig.scan,
            manager,
            refuse_when_stale=rig.refuse_when_stale,
            tolerance_mm=rig.tolerance_mm,
            presets=rig.presets,
        )
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
    """Serve until SIGTERM, SIGHUP or Ctrl-C. `say` tells a person where the service is and, once, its key.

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
    # Whatever is written from now on is for the service's user alone, or may be read by one group.
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
    try:
        ring = _keys(settings, fresh=new_key) if settings.require_key else None
        app = create_app(service, ring=ring, cookie=f"slrig_session_{port}")
        say(f"slrig serves rig '{rig.name}' at {url}, data in {service.folder.root}. Ctrl-C stops it.")
        if ring is not None:
            _tell_keys(ring, app.state.sessions, url, service.folder, fresh=new_key, say=say)
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
            target=_tell_preparation, args=(service, say, ended), name="slrig-preparation", daemon=True
        ).start()
        with suppress(KeyboardInterrupt):
            server.run(sockets=[listener])
        if wrong:
            raise wrong[0]
    finally:
        ended.set()
        service.close()
        with suppress(OSError):
            address.unlink(missing_ok=True)


class _Server(uvicorn.Server):
    """Ends the scans first, while everybody who follows one can still be told, and the connections after that."""

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


def _tell_preparation(service: Service, say: Callable[[str], None], ended: threading.Event) -> None:
    """Tell a person every few seconds how far the kernels are, the first time that they are compiled."""
    told = ""
    while (status := service.manager.status()).preparing and not status.ending:
        if status.reconstruction not in {told, LOADING}:
            told = status.reconstruction
            say(told)
        ended.wait(_TELL_S)
    if told and not status.ending:
        say("kernels are ready" if status.reconstruction == READY else status.reconstruction)


def _keys(settings: ServiceSettings, *, fresh: bool) -> KeyRing:
    given = os.environ.get(KEY_VARIABLE)
    if given and fresh:
        message = f"--new-key asks for a new key, and {KEY_VARIABLE} holds the one to use. Leave out one of the two."
        raise ConfigError(message)
    return KeyRing(settings.key_path, given=given or None)


def _tell_keys(
    ring: KeyRing, sessions: Sessions, url: str, folder: DataFolder, *, fresh: bool, say: Callable[[str], None]
) -> None:
    """Make the first key, if there is none, and tell a person; what is not a terminal may be kept for years as a log,
    and is told where the key lies instead.
    """
    key = first_key(ring, fresh=fresh)
    if sys.stdout.isatty():
        if key is not None:
            say(f"API key, shown only now: {key}\nIn the terminal of the client: export {KEY_VARIABLE}={key}")
        owner = next((each.name for each in ring.everybody if each.fault(utc_now()) is None), None)
        if owner is not None:
            say(f"In a browser, once, within a quarter of an hour: {url}{LINK_PATH}?token={sessions.link(owner)}")
    elif key is not None:
        path = folder.root / _FIRST_KEY_FILE
        write_file(path, f"{key}\n".encode("ascii"))
        path.chmod(0o600)
        say(f"A first API key was made; read it in {path}, then remove that file.")


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
        # From now on a client that was told the address may connect: it is answered once the service is up.
        listener.listen()
    except OSError as error:
        message = (
            f"The service cannot listen on {settings.host} port {settings.port}: {error.strerror}. Stop what uses that "
            "port, choose another with --port, or any free one with --port 0."
        )
        raise ServiceError(message) from error
    listener.set_inheritable(False)
    return listener

"""A machine of a pool, which computes as the worker of a rig does, and the store through which its files travel."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import os
import platform
import signal
import tarfile
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import urlsplit

import dask
import obstore
import structlog
from distributed import Scheduler, Security, WorkerPlugin, get_worker
from distributed import Worker as DaskWorker
from distributed.diskutils import WorkSpace
from obstore.exceptions import BaseError
from obstore.store import LocalStore, S3Store

from slrig.config import is_loopback, read_private_text
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ScanCancelledError, ServiceError, WorkerLostError
from slrig.failure import JobFailure, job_failure
from slrig.jobs.data_folder import BUNDLE, RESULT
from slrig.jobs.database import versions
from slrig.jobs.worker import POLL_S, READY, Compute, Task, Worker, prepare_kernel_cache
from slrig.scan.job import PIPELINE

if TYPE_CHECKING:
    from obstore.store import ClientConfig, ObjectStore, RetryConfig

CHUNK_BYTES = 5 * 2**20
"""The least part of S3's uploads in parts, but for the last."""

_AT_ONCE = 1
"""Parts under way at a time: more of them would share the line, and none be through in its time."""

_CLIENT: ClientConfig = {"connect_timeout": "3s", "timeout": "20s"}
"""Of one request, which carries one chunk: 2 Mbit/s will do."""

_RETRIES: RetryConfig = {"max_retries": 2, "retry_timeout": timedelta(seconds=15)}

Check = Callable[[], None]
"""Is called before each chunk, and raises what is to end the transfer. It must not use the store: that one is busy."""


class PoolError(Exception):
    """The pool or its store did not do its part; its text says why. The rig computes by itself.
    final : whether another try would end in the same way.
    """

    def __init__(self, message: str, *, final: bool = False) -> None:
        super().__init__(message)
        self.final = final


class PoolStore:
    """`address` is told to people; `objects` is what it stands for."""

    def __init__(self, address: str, objects: ObjectStore) -> None:
        self.address = address
        self._objects = objects

    def put_bundle(self, bundle: Path, check: Check) -> str:
        """Bring a bundle to the store, unless it is there, and return its key: a hash of all of its bytes.

        Raises
        ------
        PoolError
            The store did not take it.
        StorageError
            This machine's disk refused.
        """
        # Beside the bundle, where there is room; it has no name, and is gone however this ends.
        with storage_errors(bundle.parent), tempfile.TemporaryFile(dir=bundle.parent) as packed:
            with tarfile.open(fileobj=packed, mode="w") as archive:
                for path in sorted(bundle.rglob("*")):
                    if path.is_file():
                        check()
                        _add(archive, path, path.relative_to(bundle).as_posix())
            packed.seek(0)
            key = hashlib.file_digest(packed, "sha256").hexdigest()
            with self._faults():
                if not self._has(_bundle(key)):
                    packed.seek(0)
                    self._put(_bundle(key), packed, check)
        return key

    def fetch_bundle(self, key: str, bundle: Path, check: Check) -> None:
        """Unpack the bundle of a key into a new folder. Raises as `put_bundle` does."""
        with storage_errors(bundle.parent), tempfile.TemporaryFile(dir=bundle.parent) as packed:
            self._fetch(_bundle(key), key, packed, check)
            packed.seek(0)
            with tarfile.open(fileobj=packed) as archive:
                archive.extractall(bundle, filter="data")

    def put_result(self, job: str, path: Path, check: Check) -> str:
        """Bring a file of a result to the store; return its hash. Raises as `put_bundle`."""
        with storage_errors(path), path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            file.seek(0)
            with self._faults():
                self._put(_result(job, path.name), file, check)
        return digest

    def fetch_result(self, job: str, hashes: Mapping[str, str], folder: Path, check: Check) -> Iterator[str]:
        """Fetch the files of a result into a folder one after another, each whole or not at all, and yield their names.
        Raises as `put_bundle` does.
        """
        for name, digest in hashes.items():
            if Path(name).name != name or name.startswith("."):
                message = f"the pool names a result '{name}', which is no name of a file"
                raise PoolError(message)
            part = folder / f".{name}.part"
            try:
                with storage_errors(folder):
                    with part.open("wb") as file:
                        self._fetch(_result(job, name), digest, file, check)
                    part.replace(folder / name)
            finally:
                part.unlink(missing_ok=True)
            yield name

    def stop(self, job: str) -> None:
        """Have the machine that computes a job stop. Raises PoolError."""
        with self._faults():
            obstore.put(self._objects, _stop(job), b"stop")

    def stopped(self, job: str) -> bool:
        """Whether a job is to stop. Raises PoolError."""
        with self._faults():
            return self._has(_stop(job))

    def clear(self, *, bundle: str | None = None, job: str | None = None) -> None:
        """Remove a bundle, or what a job left. Raises PoolError."""
        with self._faults():
            if bundle is not None:
                self._delete(_bundle(bundle))
            if job is not None:
                listed = obstore.list(self._objects, prefix=f"results/{job}").collect()
                for path in (*(each["path"] for each in listed), _stop(job)):
                    self._delete(path)

    def _put(self, path: str, file: IO[bytes], check: Check) -> None:
        chunks = _chunks(file, check)
        obstore.put(self._objects, path, chunks, chunk_size=CHUNK_BYTES, max_concurrency=_AT_ONCE)

    def _delete(self, path: str) -> None:
        # A folder tells that there is none; S3 does not.
        with suppress(FileNotFoundError):
            obstore.delete(self._objects, path)

    def _has(self, path: str) -> bool:
        try:
            obstore.head(self._objects, path)
        except FileNotFoundError:
            return False
        return True

    def _fetch(self, path: str, digest: str, file: IO[bytes], check: Check) -> None:
        hashed = hashlib.sha256()
        with self._faults():
            reader = obstore.open_reader(self._objects, path, buffer_size=CHUNK_BYTES)
        while True:
            check()
            with self._faults():
                chunk = bytes(reader.read(CHUNK_BYTES))
            if not chunk:
                break
            hashed.update(chunk)
            file.write(chunk)
        if hashed.hexdigest() != digest:
            message = f"what {self.address} holds as {path} is not what was put there"
            raise PoolError(message)

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except (BaseError, OSError) as error:
            message = f"the store {self.address} failed ({type(error).__name__})"
            raise PoolError(message) from None


def open_store(address: str, login: Path | None = None) -> PoolStore:
    """The store at s3://BUCKET/PREFIX or file:///FOLDER. login : a file with `KEY ID:SECRET`, in place of the variables
    AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; where an S3 store is that is not Amazon's, AWS_ENDPOINT_URL says.

    Raises
    ------
    ConfigError
        The address is none, its folder cannot be made, its credentials are missing, may be read by others, or would
        travel unencrypted.
    """
    parts = urlsplit(address)
    if parts.scheme == "file" and parts.path and not parts.netloc:
        with _unusable(address):
            return PoolStore(address, LocalStore(prefix=parts.path, automatic_cleanup=True, mkdir=True))
    if parts.scheme != "s3" or not parts.hostname or parts.username or parts.query:
        # What was found is not repeated: it may hold a secret.
        message = "The pool's store has no address: expected s3://BUCKET/PREFIX, or file:///FOLDER that all share."
        raise ConfigError(message)
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    server = urlsplit(endpoint or "")
    plain = server.scheme == "http"
    if plain and not is_loopback(server.hostname or ""):
        message = "AWS_ENDPOINT_URL: scans would travel unencrypted. Use https://; http:// is for 127.0.0.1 alone."
        raise ConfigError(message)
    options: dict[str, Any] = {} if endpoint is None else {"endpoint": endpoint, "virtual_hosted_style_request": False}
    if login is not None:
        name, found, secret = read_private_text(login, f"compute_login_file: {login}").strip().partition(":")
        if not found:
            message = f"compute_login_file: {login} does not hold KEY ID:SECRET."
            raise ConfigError(message)
        options |= {"access_key_id": name, "secret_access_key": secret}
    elif not (os.environ.get("AWS_ACCESS_KEY_ID") and os.environ.get("AWS_SECRET_ACCESS_KEY")):
        message = (
            f"{address}: there are no credentials for it. Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
            "compute_login_file, a file with KEY ID:SECRET that nobody else may read."
        )
        raise ConfigError(message)
    options["region"] = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
    client: ClientConfig = {**_CLIENT, "allow_http": plain}
    prefix = parts.path.strip("/") or None
    with _unusable(address):
        objects = S3Store(parts.netloc, prefix=prefix, client_options=client, retry_config=_RETRIES, **options)
    return PoolStore(address, objects)


@contextmanager
def _unusable(address: str) -> Iterator[None]:
    try:
        yield
    except (BaseError, OSError, ValueError) as error:
        message = (
            f"{address}: the pool's store cannot be opened ({type(error).__name__}). Name a folder that can be made "
            "and written, or a bucket; see to AWS_ENDPOINT_URL and AWS_REGION as well."
        )
        raise ConfigError(message) from None


def _bundle(key: str) -> str:
    return f"bundles/{key}.tar"


def _result(job: str, name: str) -> str:
    return f"results/{job}/{name}"


def _stop(job: str) -> str:
    return f"stops/{job}"


def _add(archive: tarfile.TarFile, path: Path, name: str) -> None:
    """Add a file such that the same bytes give the same archive, whoever wrote them and when."""
    entry = tarfile.TarInfo(name)
    entry.size = path.stat().st_size
    with path.open("rb") as file:
        archive.addfile(entry, file)


def _chunks(file: IO[bytes], check: Check) -> Iterator[bytes]:
    check()
    while chunk := file.read(CHUNK_BYTES):
        yield chunk
        check()


BEAT_S = 2.0
"""How often a machine says that it works at a job, and looks whether it is to stop."""

TELL_S = 0.2
"""How often a stage's progress is told at most: each time passes through this machine, the scheduler and the rig."""

POOL_FAULT = "pool"
"""The code of a fault that is not the task's own: another try may go well."""

Tell = Callable[[Mapping[str, Any]], None]

_VERSIONS = Task(versions, what="statement of versions")

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PoolRequest:
    """A task for a pool. bundle : its key in the store. task : its files are the rig's, see `Task.movable`.
    topic : of dask's events, where its progress is told. versions : of the rig; others must not compute it.
    """

    job: str
    bundle: str
    task: Task
    topic: str
    versions: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class PoolResponse:
    """What came of an order: the task's result, and the hash of each file in the store by its name; or a fault."""

    result: Any = None
    files: Mapping[str, str] = field(default_factory=dict)
    fault: JobFailure | None = None


def resource(found: Mapping[str, str]) -> str:
    """The name that dask knows machines of these versions by: only they are given what asks for it."""
    return f"slrig-{hashlib.sha256(json.dumps(dict(found), sort_keys=True).encode()).hexdigest()[:16]}"


class Host(WorkerPlugin):
    """Does orders with `worker`. clock : seconds that only grow."""

    name = "slrig"

    def __init__(self, store: PoolStore, worker: Compute, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._left = False
        self._store = store
        self._worker = worker
        self._clock = clock

    def teardown(self, worker: DaskWorker) -> None:  # noqa: ARG002 - dask's own signature
        """Drop what is computed: the pool is left, and dask gives it to another one. See `WorkerPlugin`."""
        self._left = True

    def done(self, order: PoolRequest, tell: Tell) -> PoolResponse:
        """Do an order. tell : takes progress, and signs of life. Whatever goes wrong is in the answer."""
        beaten_s, looked_s, stop = self._clock(), self._clock(), False

        def beat() -> None:
            nonlocal beaten_s
            if self._clock() - beaten_s >= BEAT_S:
                beaten_s = self._clock()
                tell({"job": order.job})

        def stopped() -> bool:
            nonlocal looked_s, stop
            beat()
            if not stop and self._clock() - looked_s >= BEAT_S:
                looked_s = self._clock()
                try:
                    stop = self._store.stopped(order.job)
                except PoolError as error:
                    _log.warning("whether a job is to stop could not be found out", cause=str(error))
            return stop or self._left

        tell({"job": order.job})
        _log.info("computes for a rig", job=order.job, what=order.task.what)
        try:
            return self._computed(order, tell, beat, stopped)
        except (PoolError, WorkerLostError) as error:
            # A process that is lost, as where memory runs out, is the machine's fault rather than the task's.
            return PoolResponse(fault=JobFailure(POOL_FAULT, str(error)))
        except BaseException as error:  # noqa: BLE001 - a panic of obstore, too: the rig is told, and computes by itself
            if not isinstance(error, ScanCancelledError):
                _log.warning("an order came to nothing", job=order.job, cause=repr(error))
            return PoolResponse(fault=job_failure(error))

    def _computed(
        self, order: PoolRequest, tell: Tell, beat: Callable[[], None], stopped: Callable[[], bool]
    ) -> PoolResponse:
        # Of the process that computes: after an update of the files beneath, it is newer than this one.
        mine = self._worker.run(_VERSIONS, cancelled=stopped)
        if mine != order.versions:
            message = "the machine's versions of slrig and its libraries have changed; start slrig worker again"
            raise PoolError(message)
        with tempfile.TemporaryDirectory(prefix="slrig-pool-") as scratch:
            last, told_s = "", 0.0

            def progress(stage: str, fraction: float, detail: str) -> None:
                nonlocal last, told_s
                if stage == last and self._clock() - told_s < TELL_S:
                    return
                last, told_s = stage, self._clock()
                told = detail.replace(f"{scratch}/", "")
                tell({"job": order.job, "stage": stage, "fraction": fraction, "detail": told})

            bundle, result = Path(scratch) / BUNDLE, Path(scratch) / RESULT
            self._store.fetch_bundle(order.bundle, bundle, beat)
            files = None if order.task.files is None else replace(order.task.files, folder=Path(scratch), place=None)
            task = replace(order.task, files=files, where={"where": "pool"}, remedy="Its rig computes by itself.")
            # While the next file is made, the last one travels.
            line, sent = ThreadPoolExecutor(1, thread_name_prefix="slrig-store"), dict[str, Future[str]]()

            def made(name: str) -> None:
                sent[name] = line.submit(self._store.put_result, order.job, result / name, beat)

            try:
                answer = self._worker.run(task, progress=progress, cancelled=stopped, made=made)
                # A task that makes no file makes no folder.
                for path in result.glob("*"):
                    if path.name not in sent:
                        made(path.name)
                return PoolResponse(answer, {name: sent[name].result() for name in sorted(sent)})
            finally:
                line.shutdown(cancel_futures=True)


def compute(order: PoolRequest) -> PoolResponse:
    """Do an order on the machine that dask chose: what a rig submits."""
    worker = get_worker()
    host: Any = worker.plugins[Host.name]
    answer: PoolResponse = host.done(order, lambda told: worker.log_event(order.topic, dict(told)))
    return answer


RETURN_S = 2.0
"""How often a worker looks for its scheduler."""

LOST_WORKER_S = 30
"""From when on a worker that was not heard of is given up by the scheduler; each is heard of once a second."""

KEPT_EVENTS = 50
"""How many events of each topic the scheduler keeps, which nobody asks for. Each start of a rig's service is a topic,
and never forgotten: of dask's 1 000 it would keep 0.3 MB."""

_PAGES = "127.0.0.1:0"
"""Where dask's HTTP server listens, which cannot be left out and asks nobody for a certificate. It has no pages."""

_SETTINGS: dict[str, Any] = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # What dask learns about itself for pages that are not there: stacks 100 times a second, delays 50 times, memory
    # twice. Each process took 4 % of a core while it had nothing to do.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    # Copies of results, of which there are none.
    "distributed.scheduler.active-memory-manager.start": False,
}


def serve_scheduler(address: str, security: Security | None, *, say: Callable[[str], None]) -> None:
    """Be the scheduler of a pool at `address` until SIGTERM or Ctrl-C. Raises ServiceError: it cannot listen there."""

    async def life(stopped: asyncio.Event) -> None:
        scheduler = Scheduler(host=address, security=security, dashboard=False, dashboard_address=_PAGES)
        try:
            await scheduler
        except (OSError, RuntimeError) as error:
            cause = error.__cause__ or error
            message = f"The pool's scheduler cannot listen at {address}: {cause}. Choose another host or port."
            raise ServiceError(message) from error
        async with scheduler:
            say(f"the pool's scheduler is at {scheduler.address}. Ctrl-C stops it.")
            await stopped.wait()

    dask.config.set({"distributed.scheduler.worker-ttl": LOST_WORKER_S, **_SETTINGS})
    dask.config.set({"distributed.admin.low-level-log-length": KEPT_EVENTS})
    _until_told(life)


def serve_worker(
    scheduler: str, security: Security | None, store: PoolStore, *, cache: Path, say: Callable[[str], None]
) -> None:
    """Compute for a pool until SIGTERM or Ctrl-C. A scheduler that is not there, or is lost, is waited for.
    cache : for kernels, where slrig's own folder is read-only. Raises WorkerLostError: kernels cannot be loaded.
    """
    dask.config.set(_SETTINGS)
    prepare_kernel_cache(cache)
    # dask's own choice is every interface, also where there are no certificates.
    host = "127.0.0.1" if is_loopback(urlsplit(scheduler).hostname or "") else None
    beneath, name = Worker(PIPELINE), f"{platform.node()}-{os.getpid()}"

    async def life(stopped: asyncio.Event) -> None:
        told = ""
        # A rig would wait for kernels to be compiled.
        while beneath.condition != READY and not stopped.is_set():
            if not beneath.loading:
                raise WorkerLostError(beneath.condition)
            await asyncio.sleep(POLL_S)
        while not stopped.is_set():
            try:
                # A job at a time: the process beneath has one, and machines with more cores run more workers.
                async with DaskWorker(
                    scheduler, name=name, security=security, nthreads=1, memory_limit=0, host=host,
                    local_directory=tempfile.gettempdir(), resources={resource(versions()): 1},
                    plugins=(Host(store, beneath),), death_timeout=CONNECT_S,
                    dashboard=False, dashboard_address=_PAGES,
                ) as member:  # fmt: skip
                    say(told := f"computes for the pool {scheduler}. Ctrl-C stops it.")
                    ends = [asyncio.create_task(stopped.wait()), asyncio.create_task(member.finished())]
                    await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
                    for each in ends:
                        each.cancel()
            except (OSError, RuntimeError) as error:
                found = f"the scheduler {scheduler} does not answer ({type(error.__cause__ or error).__name__})"
                if told != found:
                    say(told := found)
            with suppress(TimeoutError):
                await asyncio.wait_for(stopped.wait(), RETURN_S)

    try:
        with _scratch():
            beneath.start()
            _until_told(life)
    finally:
        beneath.close()


@contextmanager
def _scratch() -> Iterator[None]:
    """Have what this process and those beneath it put into TMPDIR lie in a folder of its own there, and remove what a
    worker of the same user left that was killed.
    """
    place = Path(tempfile.gettempdir(), f"slrig-workers-{os.getuid()}")
    with storage_errors(place):
        place.mkdir(mode=0o700, exist_ok=True)
        if place.lstat().st_uid != os.getuid():
            message = f"{place} belongs to somebody else. Set TMPDIR to a folder of your own."
            raise ConfigError(message)
    # dask's own: it locks the folder as long as this process lives.
    folder = WorkSpace(str(place)).new_work_dir(prefix="worker-")
    os.environ["TMPDIR"] = tempfile.tempdir = folder.dir_path
    try:
        yield
    finally:
        folder.release()


def _until_told(life: Callable[[asyncio.Event], Awaitable[None]]) -> None:
    """Run until SIGTERM or Ctrl-C."""
    join_logs()

    async def live() -> None:
        stopped = asyncio.Event()
        for each in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(each, stopped.set)
        await life(stopped)

    asyncio.run(live())


CONNECT_S = 5.0
"""The longest that the scheduler may take to answer: it does nothing else."""


def join_logs() -> None:
    """Have the lines of distributed, which brings handlers of its own along, go the way of all others."""
    for name in [each for each in logging.root.manager.loggerDict if each.partition(".")[0] == "distributed"]:
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True
        logger.setLevel(logging.NOTSET)

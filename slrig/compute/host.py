"""A machine of a pool, which computes as the worker of a rig does, and the store through which its files travel."""

from __future__ import annotations

import asyncio
import hashlib
import os
import shutil
import tarfile
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlsplit
from uuid import UUID

import obstore
import structlog
from filelock import FileLock, Timeout
from obstore.exceptions import BaseError
from obstore.store import LocalStore, S3Store
from pydantic import Field

from slrig.capture import EvidenceSummary
from slrig.compute.link import (
    POOL_FAULT,
    Hello,
    Message,
    PoolError,
    PoolRequest,
    PoolResponse,
    Progress,
    Withdrawal,
    cause,
    connect,
    run_until_stopped,
)
from slrig.compute.security import PoolAddress, require_private
from slrig.config import is_loopback, read_private_text
from slrig.disk import prepare_kernel_cache, storage_errors
from slrig.errors import ConfigError, ScanCancelledError, WorkerLostError
from slrig.failure import JobFailure, job_failure
from slrig.jobs.job import JobRun
from slrig.jobs.listener import Listener
from slrig.jobs.records import versions
from slrig.jobs.worker import POLL_S, READY, Compute, Task, Worker, job_task
from slrig.scan.job import PIPELINE, ScanJob
from slrig.scan.plan import ScanPlan

if TYPE_CHECKING:
    from obstore.store import ClientConfig, ObjectStore, RetryConfig

CHUNK_BYTES = 5 * 2**20
"""The least part of S3's uploads in parts, except the last."""

_AT_ONCE = 1
"""Parts under way at a time: more of them would share the line, and none be through in its time."""

_CLIENT: ClientConfig = {"connect_timeout": "3s", "timeout": "20s"}
"""Limits of one request, which carries one chunk: 2 Mbit/s will do."""

_RETRIES: RetryConfig = {"max_retries": 2, "retry_timeout": timedelta(seconds=15)}

Check = Callable[[], None]
"""Is called before each chunk, and raises what is to end the transfer. It must not use the store: that one is busy."""


class PoolStore:
    """The store of a pool. address : for messages. objects : its contents."""

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
        # Next to the bundle, where there is room; it has no name, and is always removed at the end.
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
                message = f"the pool names a result '{name}', which is not a file name"
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

    def clear(self, *, bundle: str | None = None, job: str | None = None) -> None:
        """Remove a bundle, or what a job left. Raises PoolError."""
        with self._faults():
            if bundle is not None:
                self._delete(_bundle(bundle))
            if job is not None:
                listed = obstore.list(self._objects, prefix=f"results/{job}").collect()
                for each in listed:
                    self._delete(each["path"])

    def _put(self, path: str, file: IO[bytes], check: Check) -> None:
        chunks = _chunks(file, check)
        obstore.put(self._objects, path, chunks, chunk_size=CHUNK_BYTES, max_concurrency=_AT_ONCE)

    def _delete(self, path: str) -> None:
        # A folder reports a missing file; S3 does not.
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
            "compute_login_file, a file with KEY ID:SECRET that only this user may read."
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


def _add(archive: tarfile.TarFile, path: Path, name: str) -> None:
    """Add a file such that the same bytes give the same archive, without owner and time."""
    entry = tarfile.TarInfo(name)
    entry.size = path.stat().st_size
    with path.open("rb") as file:
        archive.addfile(entry, file)


def _chunks(file: IO[bytes], check: Check) -> Iterator[bytes]:
    check()
    while chunk := file.read(CHUNK_BYTES):
        yield chunk
        check()


REPORT_S = 0.2
"""Least interval of reports of a stage's progress: each passes through this machine, the scheduler and the rig."""

_VERSIONS = Task(versions, what="statement of versions")

_log = structlog.get_logger(__name__)


class PoolTask(Message):
    """The only task of a pool's worker: the second part of a scan. bundle : its key in the store."""

    name: Literal["scan"] = "scan"
    id: UUID
    bundle: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    plan: ScanPlan
    evidence: EvidenceSummary | None = None


class Host:
    """Does orders with `worker`. clock : seconds that only grow."""

    def __init__(self, store: PoolStore, worker: Compute, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._store = store
        self._worker = worker
        self._clock = clock

    def done(self, order: PoolRequest, report: Callable[[Progress], None], stop: threading.Event) -> PoolResponse:
        """Do an order, until `stop` is set. report : takes progress. Failures are in the answer."""
        try:
            return self._computed(order, report, stop)
        except (PoolError, WorkerLostError) as error:
            # A process that is lost, as where memory runs out, is the machine's fault rather than the task's.
            fault = JobFailure(POOL_FAULT, str(error))
        except BaseException as error:  # noqa: BLE001 - a panic of obstore, too: the rig then computes by itself
            if not isinstance(error, ScanCancelledError):
                _log.warning("an order came to nothing", job=order.job, cause=repr(error))
            fault = job_failure(error)
        with suppress(PoolError):  # the store removes it by and by
            self._store.clear(job=order.job)
        return PoolResponse(job=order.job, fault=fault)

    def _computed(self, order: PoolRequest, report: Callable[[Progress], None], stop: threading.Event) -> PoolResponse:
        try:
            given = PoolTask.model_validate(order.task)
        except ValueError as error:
            message = "the order is not a task of a pool, and is not done"
            raise PoolError(message) from error
        _log.info("computes for a rig", job=order.job, what=given.name)
        report(Progress(job=order.job))
        # Of the process that computes: after an update of the files beneath, it is newer than this one.
        if self._worker.run(_VERSIONS, Listener(cancelled=stop.is_set)) != order.versions:
            message = "the machine's versions of slrig and its libraries have changed; start slrig worker again"
            raise PoolError(message)

        def check() -> None:
            if stop.is_set():
                message = "It was cancelled."
                raise ScanCancelledError(message)

        with tempfile.TemporaryDirectory(prefix="slrig-pool-") as scratch:
            last, reported_s = "", 0.0

            def progress(stage: str, fraction: float, detail: str) -> None:
                nonlocal last, reported_s
                if stage == last and self._clock() - reported_s < REPORT_S:
                    return
                last, reported_s = stage, self._clock()
                shown = detail.replace(f"{scratch}/", "")
                report(Progress(job=order.job, stage=stage, fraction=fraction, detail=shown))

            run = JobRun(given.id, Path(scratch), None, evidence=given.evidence)
            task = replace(
                job_task(ScanJob(given.plan), run), where={"where": "pool"}, remedy="Its rig computes by itself."
            )
            self._store.fetch_bundle(given.bundle, run.bundle, check)
            # While the next file is made, the last one travels.
            line, sent = ThreadPoolExecutor(1, thread_name_prefix="slrig-store"), dict[str, Future[str]]()

            def made(name: str) -> None:
                sent[name] = line.submit(self._store.put_result, order.job, run.result / name, check)

            try:
                listener = Listener(report=progress, cancelled=stop.is_set, file_ready=made)
                result = self._worker.run(task, listener)
                # A task that makes no file makes no folder.
                for path in run.result.glob("*"):
                    if path.name not in sent:
                        made(path.name)
                files = {name: sent[name].result() for name in sorted(sent)}
                answer = PoolResponse(job=order.job, result=result, files=files)
                answer.model_dump_json()  # raises here, where the rig is still informed
                return answer
            finally:
                line.shutdown(cancel_futures=True)


RETURN_S = 2.0
"""Interval at which a worker tries to reach its scheduler."""


async def join(address: PoolAddress, host: Host, *, say: Callable[[str], None]) -> None:
    """Be a worker of a pool until the connection ends. Raises OSError, PoolError, ConfigError."""
    loop, link = asyncio.get_running_loop(), await connect(address, Hello(versions=dict(versions())))
    say(f"computes for the pool {address}. Ctrl-C stops it.")
    stop, doing, job = threading.Event(), set[asyncio.Task[None]](), ""

    def report(progress: Progress) -> None:
        loop.call_soon_threadsafe(link.send, progress)

    async def do(order: PoolRequest) -> None:
        link.send(await asyncio.to_thread(host.done, order, report, stop))

    def heard(message: Message) -> None:
        nonlocal stop, job
        if isinstance(message, PoolRequest) and all(each.done() for each in doing):
            stop, job = threading.Event(), message.job
            doing.clear()
            doing.add(asyncio.create_task(do(message)))
        elif isinstance(message, Withdrawal) and message.job == job:
            stop.set()

    try:
        await link.hear(heard)
    finally:
        # Its result is not awaited: the scheduler gives it to another one.
        link.close()
        stop.set()
        await asyncio.gather(*doing, return_exceptions=True)


def serve_worker(address: PoolAddress, store: PoolStore, *, cache: Path, say: Callable[[str], None]) -> None:
    """Compute for a pool until SIGTERM or Ctrl-C. A scheduler that is not there, or is lost, is waited for.
    cache : for kernels, where slrig's own folder is read-only. Raises WorkerLostError: kernels cannot be loaded.
    """
    prepare_kernel_cache(cache)
    beneath = Worker(PIPELINE)

    async def life() -> None:
        reported = ""

        def report(found: str) -> None:
            nonlocal reported
            if found != reported:
                say(reported := found)

        # A rig would wait for kernels to be compiled.
        while beneath.condition != READY:
            if not beneath.loading:
                raise WorkerLostError(beneath.condition)
            await asyncio.sleep(POLL_S)
        while True:
            try:
                # A job at a time: the process beneath has one, and machines with more cores run more workers.
                await join(address, Host(store, beneath), say=report)
                report(f"the scheduler {address} is gone")
            except (OSError, PoolError, ConfigError) as error:
                report(f"the scheduler {address} does not answer: {cause(error)}")
            await asyncio.sleep(RETURN_S)

    try:
        with _scratch():
            beneath.start()
            run_until_stopped(life)
    finally:
        beneath.close()


@contextmanager
def _scratch() -> Iterator[None]:
    """A folder of its own in TMPDIR for the temporary files of this process and its children; removes those that killed
    workers of the same user left.
    """
    place = Path(tempfile.gettempdir(), f"slrig-workers-{os.geteuid()}")
    with storage_errors(place):
        place.mkdir(mode=0o700, exist_ok=True)
    require_private(place)
    with ExitStack() as stack:
        with FileLock(place / "lock"):
            for left in place.glob("worker-*"):
                with suppress(Timeout), FileLock(left / "lock", timeout=0):
                    shutil.rmtree(left, ignore_errors=True)
            folder = tempfile.mkdtemp(prefix="worker-", dir=place)
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            # As long as this process lives.
            stack.enter_context(FileLock(Path(folder, "lock")))
        os.environ["TMPDIR"] = tempfile.tempdir = folder
        yield

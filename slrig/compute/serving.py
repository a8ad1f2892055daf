"""The processes of a pool: dask's scheduler, and dask's workers with a process that computes beneath each."""

from __future__ import annotations

import asyncio
import os
import platform
import signal
import tempfile
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import dask
from distributed import Scheduler, Security
from distributed import Worker as DaskWorker
from distributed.diskutils import WorkSpace

from slrig.compute.cluster import CONNECT_S, join_logs
from slrig.compute.host import Host, resource
from slrig.compute.store import PoolStore
from slrig.config import is_loopback
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ServiceError, WorkerLostError
from slrig.jobs.versions import versions
from slrig.jobs.worker import READY, Worker, prepare_kernel_cache
from slrig.jobs.worker_wait import POLL_S
from slrig.scan.job import PIPELINE

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

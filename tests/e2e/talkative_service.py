"""A service over a tame bench in which everything that may write to the log does: `python -m … DATA`."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import structlog

from slrig import KEY_VARIABLE
from slrig.api import server
from slrig.config import ServiceSettings, rig_of
from slrig.jobs import worker_process
from tests.unit.api.conftest import ServedBench

LIBRARIES = ("sqlalchemy.pool", "alembic.runtime.migration", "sse_starlette.sse", "uvicorn.error", "asyncio")
SAID = "Authorization: Bearer {key}, Cookie: session={key}; X-API-Key: {key}"


class Unraisable:
    """Fails where nobody can be told."""

    def __del__(self) -> None:
        message = "too late"
        raise RuntimeError(message)


def fail() -> None:
    message = "nobody caught this"
    raise ValueError(message)


def speak() -> None:
    """What a process says that is not made of our own calls to the log."""
    warnings.warn("a library will change", stacklevel=1)
    for name in LIBRARIES:
        logging.getLogger(name).warning("%s complains", name)
        logging.getLogger(name).info("%s chats", name)
    thread = threading.Thread(target=fail, name="unlucky")
    thread.start()
    thread.join()
    Unraisable()
    gc.collect()


class Server(server._Server):
    """Speaks once it has started."""

    async def startup(self, sockets: list[Any] | None = None) -> None:
        await super().startup(sockets)
        asyncio.get_running_loop().call_soon(fail)
        asyncio.get_running_loop().create_task(asyncio.to_thread(fail))
        logging.getLogger("uvicorn.error").error(SAID.format(key=os.environ[KEY_VARIABLE]))
        await asyncio.to_thread(speak)


def _called(task: worker_process.Task, given: dict[str, Any]) -> Any:
    structlog.get_logger("worker").warning("told by the worker")
    speak()
    return _call(task, given)


_call = worker_process._called
if __name__ == "__mp_main__":
    # In the worker, which loads the main module of its parent under this name.
    worker_process._called = _called


def main(data: Path) -> None:
    """Serve from a data folder until SIGTERM, and end by an error that nobody catches."""
    bench = ServedBench(data)
    bench.gate.set()
    server._Server = Server  # type: ignore[misc] # whoever serves makes one of these
    server.open_service = lambda *_, **__: bench.service
    settings = ServiceSettings(data_dir=data, port=0, log_format="json")
    rig = rig_of({"name": "bench", "head": {"driver": "none"}}, data / "rig.toml")
    try:
        server.serve(settings, rig, say=lambda line: print(line, flush=True))  # noqa: T201 - as the command does
    finally:
        fail()


if __name__ == "__main__":
    main(Path(sys.argv[1]))

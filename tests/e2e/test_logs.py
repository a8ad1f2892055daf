"""Every line that a service writes to its log is JSON with the same fields and holds no key, whatever library wrote it.

Run as a program, `python -m tests.e2e.test_logs DATA`, this is a service in which everything that may log does.
"""

from __future__ import annotations

import asyncio
import gc
import json
import logging
import socket
import sys
import threading
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import structlog

from slrig import KEY_VARIABLE
from slrig.api import server
from slrig.config import ServiceSettings, parse_rig
from slrig.jobs import worker as worker_process
from slrig.jobs.worker import Worker
from tests.e2e.conftest import Start, ended
from tests.unit.api.conftest import ServedBench
from tests.unit.scan.bench import PIPELINE

KEY = "Zm9vYmFy-_x0.key~of+the/tests"
LIBRARIES = ("sqlalchemy.pool", "uvicorn.error", "asyncio")
SAID = "Authorization: Bearer {key}, Cookie: session={key}; X-API-Key: {key}"


class Unraisable:
    """Fails where no caller can catch it."""

    def __del__(self) -> None:
        raise RuntimeError("too late")


def fail() -> None:
    raise ValueError("this was not caught")


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
        logging.getLogger("uvicorn.error").error(SAID.format(key=KEY))
        await asyncio.to_thread(speak)


def _answered(
    pipe: Any, stops: Any, run: worker_process.RunTask, pipeline: Any, live: Any
) -> worker_process.Done | worker_process.Failed:
    structlog.get_logger("worker").warning("said by the worker")
    speak()
    return _answer(pipe, stops, run, pipeline, live)


_answer = worker_process._answer
if __name__ == "__mp_main__":
    # In the worker, which loads the main module of its parent under this name.
    worker_process._answer = _answered


def main(data: Path) -> None:
    """Serve from a data folder until SIGTERM, and end by an error that is not caught."""
    bench = ServedBench(data, worker=Worker(PIPELINE))
    bench.gate.set()
    server._Server = Server  # type: ignore[misc] # `serve` makes one of these
    server.open_service = lambda *_, **__: bench.service
    settings = ServiceSettings(data_dir=data, port=0, log_format="json")
    rig = parse_rig({"name": "bench", "head": {"driver": "none"}}, data / "rig.toml")
    try:
        server.serve(settings, rig, say=lambda line: print(line, flush=True))  # noqa: T201 - as the command does
    finally:
        fail()


@pytest.mark.slow
def test_all_lines_have_one_form(start: Start, tmp_path: Path) -> None:
    data = tmp_path / "data"
    service = start(data, data, program=("tests.e2e.test_logs", str(data)), **{KEY_VARIABLE: KEY})
    address = urlsplit(service.url)
    with socket.create_connection((address.hostname, address.port), timeout=10) as malformed:
        malformed.sendall(f"GET\r\nAuthorization Bearer {KEY}\r\n\r\n".encode())
        assert malformed.recv(100).startswith(b"HTTP/1.1 400")
    with service.client(KEY) as client:
        scan = client.scans.start(label="one")
        assert ended(client, scan)["state"] == "succeeded"
    assert service.stop() == 1
    written = service.log.read_text()
    lines = [json.loads(line) for line in written.splitlines()]
    assert all({"event", "level", "logger", "timestamp"} <= set(line) for line in lines)
    assert all(isinstance(line["event"], str) and line["timestamp"].endswith("Z") for line in lines)
    loggers = {line["logger"] for line in lines}
    assert loggers >= {*LIBRARIES, "py.warnings", "slrig.logs", "slrig.jobs.manager", "worker"}
    events = [line["event"] for line in lines]
    assert "Invalid HTTP request received." in events
    assert any("a library will change" in event for event in events)
    assert not any("chats" in event for event in events)
    assert KEY not in written
    assert "Bearer ***" in written
    errors = {line["event"]: line for line in lines if "exception" in line}
    assert {"a thread ended by an error", "the process ended by an error"} <= set(errors)
    assert "this was not caught" in errors["a thread ended by an error"]["exception"]
    assert any(line["logger"] == "asyncio" and "ValueError" in line.get("exception", "") for line in lines)
    assert any("Unraisable" in line.get("object", "") for line in lines)
    # Each line of the worker carries the scan that it computes.
    (ours,) = [line for line in lines if line["event"] == "said by the worker"]
    assert ours["job"] == scan["id"]
    assert {line["logger"] for line in lines if line.get("job") == scan["id"]} >= {
        "worker",
        "py.warnings",
        "sqlalchemy.pool",
    }
    assert next(line for line in lines if line["event"] == "job finished")["job"] == scan["id"]


if __name__ == "__main__":
    main(Path(sys.argv[1]))

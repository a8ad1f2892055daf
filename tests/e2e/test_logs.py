"""Every line that a service writes to its log is JSON with the same fields, whoever wrote it, and holds no key."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

from slrig import KEY_VARIABLE
from slrig.client import Client
from slrig.client.events import StateChange
from tests.e2e import talkative_service
from tests.e2e.conftest import STOP_LIMIT_S

KEY = "Zm9vYmFy-_x0.key~of+the/tests"


def test_all_lines_have_one_form(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.e2e.talkative_service", str(tmp_path / "data")]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and code
            command, stdout=subprocess.PIPE, stderr=log, env={**os.environ, KEY_VARIABLE: KEY}
        )
    try:
        assert process.stdout is not None
        greeting = process.stdout.readline().decode()
        assert " at http://" in greeting, (tmp_path / "log").read_text()
        url = greeting.split(" at ")[1].split(",")[0]
        address = urlsplit(url)
        with socket.create_connection((address.hostname, address.port), timeout=10) as malformed:
            malformed.sendall(f"GET\r\nAuthorization Bearer {KEY}\r\n\r\n".encode())
            assert malformed.recv(100).startswith(b"HTTP/1.1 400")
        with Client(url, KEY) as client:
            scan = client.scans.start(label="one")
            *_, last = client.follow(scan["links"]["events"])
            assert isinstance(last, StateChange)
            assert last.state == "succeeded"
        process.send_signal(signal.SIGTERM)
        assert process.wait(STOP_LIMIT_S) == 1
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
    written = (tmp_path / "log").read_text()
    lines = [json.loads(line) for line in written.splitlines()]
    assert all({"event", "level", "logger", "timestamp"} <= set(line) for line in lines)
    assert all(isinstance(line["event"], str) and line["timestamp"].endswith("Z") for line in lines)
    loggers = {line["logger"] for line in lines}
    assert loggers >= {*talkative_service.LIBRARIES, "py.warnings", "slrig.logs", "slrig.jobs.endings", "worker"}
    events = [line["event"] for line in lines]
    assert "Invalid HTTP request received." in events
    assert any("a library will change" in event for event in events)
    assert not any("chats" in event for event in events)
    assert KEY not in written
    assert "Bearer ***" in written
    told = {line["event"]: line for line in lines if "exception" in line}
    assert {"a thread ended by an error", "the process ended by an error"} <= set(told)
    assert "nobody caught this" in told["a thread ended by an error"]["exception"]
    assert any(line["logger"] == "asyncio" and "ValueError" in line.get("exception", "") for line in lines)
    assert any("Unraisable" in line.get("object", "") for line in lines)
    # What the worker says carries the scan that it computes, whoever says it.
    (ours,) = [line for line in lines if line["event"] == "told by the worker"]
    assert ours["job"] == scan["id"]
    assert {line["logger"] for line in lines if line.get("job") == scan["id"]} >= {
        "worker",
        "py.warnings",
        "alembic.runtime.migration",
    }
    assert next(line for line in lines if line["event"] == "job finished")["job"] == scan["id"]

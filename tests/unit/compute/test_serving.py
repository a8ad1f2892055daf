"""Where a pool's scheduler listens."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys

import pytest

pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")

from slrig.compute.serving import serve_scheduler
from tests.listening import listening_at


def test_nothing_of_a_scheduler_listens_beyond_its_address() -> None:
    found: set[str] = set()

    def say(_words: str) -> None:
        found.update(listening_at())
        signal.raise_signal(signal.SIGTERM)

    before = listening_at()
    serve_scheduler("tcp://127.0.0.1:0", None, say=say)
    assert len(found - before) == 2
    assert {address.rpartition(":")[0] for address in found - before} == {"127.0.0.1"}


def test_an_address_that_is_taken_is_named() -> None:
    # In a process of its own: what cannot be bound is not closed by dask.
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = str(holder.getsockname()[1])
        command = [sys.executable, "-m", "slrig.cli", "pool", "--port", port]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)  # noqa: S603 - our own
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert f"cannot listen at tcp://127.0.0.1:{port}: " in done.stderr
    assert "in use" in done.stderr

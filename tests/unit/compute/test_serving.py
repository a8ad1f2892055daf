"""Where a pool's scheduler listens, and what its workers leave on a disk."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")

from distributed import Scheduler, Status

from slrig.compute.serving import KEPT_EVENTS, _scratch, serve_scheduler
from slrig.errors import ConfigError
from tests.listening import listening_at


def test_a_scheduler_listens_at_its_address_alone_and_keeps_few_events() -> None:
    found: set[str] = set()
    kept: set[int] = set()

    def say(_words: str) -> None:
        found.update(listening_at())
        (scheduler,) = (each for each in Scheduler._instances if each.status is Status.running)
        for number in range(2 * KEPT_EVENTS):
            scheduler.log_event("a rig", number)
        kept.add(len(scheduler.get_events("a rig")))
        signal.raise_signal(signal.SIGTERM)

    before = listening_at()
    serve_scheduler("tcp://127.0.0.1:0", None, say=say)
    assert kept == {KEPT_EVENTS}
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


def test_what_a_killed_worker_left_is_removed_by_the_next_one(tmp_path: Path) -> None:
    lives = (
        "import os, sys, tempfile; from slrig.compute.serving import _scratch\n"
        "with _scratch(): os.mkdir(tempfile.mkdtemp() + '/bundle'); print(flush=True); sys.stdin.read()"
    )

    def worker() -> subprocess.Popen[bytes]:
        started = subprocess.Popen(  # noqa: S603 - our own
            [sys.executable, "-c", lives], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, "TMPDIR": str(tmp_path)},
        )  # fmt: skip
        assert started.stdout is not None
        assert started.stdout.readline()
        return started

    with worker() as lasting, worker() as killed:
        assert len([*tmp_path.rglob("bundle")]) == 2
        killed.kill()
        killed.wait()
        with worker() as later:
            assert len([*tmp_path.rglob("bundle")]) == 2
            for each in (lasting, later):
                each.communicate()
                assert each.returncode == 0
    assert {path.name for path in tmp_path.glob("*/*")} == {"global.lock", "purge.lock"}


def test_workers_use_no_folder_of_somebody_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / f"slrig-workers-{os.getuid()}").mkdir()
    monkeypatch.setattr(Path, "lstat", lambda _: os.stat_result((0o40777, 0, 0, 1, os.getuid() + 1, *[0] * 5)))
    with pytest.raises(ConfigError, match="belongs to somebody else"), _scratch():
        pass

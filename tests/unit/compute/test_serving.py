"""Where a pool's scheduler listens, and what its workers leave on a disk."""

from __future__ import annotations

import gc
import os
import signal
import socket
import tempfile
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")

from distributed import Scheduler, Status
from distributed.diskutils import DIR_LOCK_EXT

from slrig.compute.serving import KEPT_EVENTS, _scratch, serve_scheduler
from slrig.errors import ConfigError, ServiceError
from tests.listening import listening_at


def test_scheduler_listens_at_its_address_alone_and_keeps_few_events() -> None:
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


# dask leaves what it could not bind to Python's collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_address_in_use_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        address = f"tcp://127.0.0.1:{holder.getsockname()[1]}"
        with pytest.raises(ServiceError, match=f"cannot listen at {address}: .*in use"):
            serve_scheduler(address, None, say=print)
    gc.collect()


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of this user's workers."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    found = tmp_path / f"slrig-workers-{os.getuid()}"
    found.mkdir()
    return found


def test_what_a_killed_worker_left_is_removed_by_the_next_one(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # dask's file is locked as long as the worker lives.
    (place / "worker-killed" / "bundle").mkdir(parents=True)
    (place / f"worker-killed{DIR_LOCK_EXT}").touch()
    with _scratch():
        bundle = Path(tempfile.mkdtemp(), "bundle")
        bundle.mkdir()
        assert [*place.rglob("bundle")] == [bundle]
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        with _scratch():
            assert bundle.is_dir()
    assert {path.name for path in place.iterdir()} == {"global.lock", "purge.lock"}


def test_workers_use_no_folder_of_another_user(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "lstat", lambda _: os.stat_result((0o40777, 0, 0, 1, os.getuid() + 1, *[0] * 5)))
    with pytest.raises(ConfigError, match=f"{place.name} belongs to somebody else"), _scratch():
        pass

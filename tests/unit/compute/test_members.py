"""Who may join a pool, where its scheduler listens, and what its workers leave on a disk."""

from __future__ import annotations

import gc
import os
import signal
import socket
import ssl
import tempfile
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")
pytest.importorskip("cryptography", reason="needs a pool's libraries: pip install 'slrig[pool]'")

from distributed import Scheduler, Status
from distributed.diskutils import DIR_LOCK_EXT

from slrig.cli.commands import app
from slrig.compute.certificates import AUTHORITY_KEY, make_certificates
from slrig.compute.security import KEY, pool_security
from slrig.compute.serving import KEPT_EVENTS, _scratch, serve_scheduler
from slrig.errors import ConfigError, ServiceError, StorageError
from tests.listening import listening_at

ADDRESS = "tls://pool:8786"


def context(folder: Path, part: str) -> ssl.SSLContext:
    security: Any = pool_security(ADDRESS, folder)
    found: ssl.SSLContext = getattr(security, f"get_{part}_args")(
        *(["client"] if part == "connection" else ["scheduler"])
    )["ssl_context"]
    return found


def greet(client: ssl.SSLContext, server: ssl.SSLContext) -> None:
    """Let two shake hands, without a network. Raises ssl.SSLError: one of them refuses."""
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True)]
    for _ in range(4):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    ends[0].write(b"hello")
    assert ends[1].read() == b"hello"


def test_members_of_one_pool_accept_one_another_and_no_others(tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    made = CliRunner().invoke(app, ["pool", "certificates", str(ours)])
    assert made.output.split() == [str(ours / name) for name in ("scheduler", "worker", "rig")]
    assert make_certificates(ours, ("rig", "rig-7")) == [ours / "rig-7"]
    make_certificates(theirs, ("rig",))
    server = context(ours / "scheduler", "listen")
    greet(context(ours / "rig", "connection"), server)
    greet(context(ours / "rig-7", "connection"), server)
    with pytest.raises(ssl.SSLError):
        greet(context(theirs / "rig", "connection"), server)
    with pytest.raises(ssl.SSLError):
        greet(context(ours / "rig", "connection"), context(theirs / "rig", "listen"))
    nobody = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    nobody.check_hostname, nobody.verify_mode = False, ssl.CERT_NONE
    with pytest.raises(ssl.SSLError):
        greet(nobody, server)
    keys = [*ours.glob(f"*/{KEY}"), ours / AUTHORITY_KEY]
    assert len(keys) == 5
    assert {oct(path.stat().st_mode & 0o777) for path in keys} == {"0o600"}
    assert {oct(path.parent.stat().st_mode & 0o777) for path in keys} == {"0o700"}


def test_certificates_are_needed_beyond_this_machine_and_their_key_is_private(tmp_path: Path) -> None:
    assert pool_security("tcp://127.0.0.1:8786", None) is None
    with pytest.raises(ConfigError, match=r"lacks authority\.pem, certificate\.pem, key\.pem"):
        pool_security(ADDRESS, tmp_path)
    (place,) = make_certificates(tmp_path, ("worker",))
    (place / KEY).chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        pool_security(ADDRESS, place)


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("tcp://pool:8786", "any code"),
        ("tcp://0.0.0.0:8786", "any code"),
        ("pool:8786", "no address"),
        ("tls://pool", "no address"),
        ("tls://pool:port", "no address"),
        (ADDRESS, "found none"),
    ],
)
def test_an_address_that_is_not_safe_is_refused(address: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        pool_security(address, None)


def test_certificates_are_made_in_folders_that_can_be_for_names_of_machines(tmp_path: Path) -> None:
    for name in ("../rig", "r" * 65):
        with pytest.raises(ConfigError, match=r"no name for a machine.*64"):
            make_certificates(tmp_path, (name,))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "certificates"):
        with pytest.raises(StorageError, match="choose another folder"):
            make_certificates(folder, ("rig",))


def test_a_service_with_a_pool_needs_a_store(tmp_path: Path) -> None:
    for options in (["--compute", "tcp://127.0.0.1:1"], ["--store", "s3://scans"]):
        rig = str(Path(__file__).parents[3] / "config" / "rigs" / "demo.toml")
        told = CliRunner().invoke(app, ["serve", rig, "--data", str(tmp_path / "data"), "--port", "0", *options])
        assert (told.exit_code, "needs a store as well" in told.stderr) == (2, True), told.output
    told = CliRunner().invoke(app, ["worker", "--scheduler", "tcp://127.0.0.1:1"])
    assert (told.exit_code, "--store" in told.stderr) == (2, True)


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

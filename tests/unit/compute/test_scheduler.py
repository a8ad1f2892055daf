"""The scheduler of a pool, who may join it, and what it takes from whom."""

from __future__ import annotations

import asyncio
import json
import os
import pickle
import re
import signal
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cryptography", reason="needs a pool's libraries: pip install 'slrig[pool]'")

from slrig.compute.certificates import AUTHORITY_KEY, make_certificates
from slrig.compute.link import (
    BEAT,
    LINE_BYTES,
    POOL_FAULT,
    Hello,
    Link,
    Message,
    PoolRequest,
    PoolResponse,
    Progress,
    Withdrawal,
    Workers,
)
from slrig.compute.scheduler import Scheduler, serve_scheduler
from slrig.compute.security import KEY, MEMBER, PoolAddress, pool_address
from slrig.errors import ConfigError, ServiceError, StorageError
from slrig.examples import EXAMPLES
from slrig.failure import JobFailure
from tests.core import parametrize_core
from tests.unit.command import slrig
from tests.unit.scan.fakes import never

ADDRESS = "tls://pool:8786"


def test_certificates_are_made_once_and_their_keys_are_private(tmp_path: Path) -> None:
    ours = tmp_path / "ours"
    made = slrig("pool", "certificates", ours)
    assert made.output.split() == [str(ours / name) for name in ("scheduler", "worker", "rig")]
    assert make_certificates(ours, ("rig", "rig-7")) == [ours / "rig-7"]
    keys = [*ours.glob(f"*/{KEY}"), ours / AUTHORITY_KEY]
    assert len(keys) == 5
    assert {oct(path.stat().st_mode & 0o777) for path in keys} == {"0o600"}
    assert {oct(path.parent.stat().st_mode & 0o777) for path in keys} == {"0o700"}


def test_certificates_are_whole_and_their_key_is_private(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"lacks authority\.pem, certificate\.pem, key\.pem"):
        pool_address(ADDRESS, tmp_path)
    (place,) = make_certificates(tmp_path, ("worker",))
    (place / KEY).chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        pool_address(ADDRESS, place)
    (place / KEY).chmod(0o600)
    (place / KEY).write_text("no key")
    with pytest.raises(ConfigError, match="cannot be used"):
        pool_address(ADDRESS, place)


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("tcp://pool:8786", "Write tls:// in place of tcp://"),
        ("tcp://127.0.0.1:8786", "no plain mode, not at 127.0.0.1 either"),
        ("tcp://localhost:8786", "no plain mode"),
        ("pool:8786", "not an address of"),
        ("tls://pool", "not an address of"),
        ("tls://pool:port", "not an address of"),
        (ADDRESS, "found none"),
        ("tls://0.0.0.0:8786", "found none"),
    ],
)
def test_an_address_that_is_not_safe_is_refused(address: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        pool_address(address, None)


def test_certificates_are_made_in_folders_that_can_be_for_names_of_machines(tmp_path: Path) -> None:
    for name in ("../rig", "r" * 65):
        with pytest.raises(ConfigError, match=r"cannot name a machine.*64"):
            make_certificates(tmp_path, (name,))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "certificates"):
        with pytest.raises(StorageError, match="choose another folder"):
            make_certificates(folder, ("rig",))


def test_a_service_with_a_pool_needs_a_store(tmp_path: Path) -> None:
    for options in (["--compute", "tls://127.0.0.1:1"], ["--store", "s3://scans"]):
        rig = EXAMPLES / "rigs" / "demo.toml"
        told = slrig("serve", rig, "--data", tmp_path / "data", "--port", "0", *options)
        assert (told.exit_code, "needs a store as well" in told.stderr) == (2, True), told.output
    told = slrig("worker", "--scheduler", "tls://127.0.0.1:1")
    assert (told.exit_code, "--store" in told.stderr) == (2, True)


def beside_a_scheduler(act: Callable[[PoolAddress], None]) -> None:
    """Be a scheduler, as `slrig pool` without certificates is, while something is done in a thread."""
    failed: list[BaseException] = []

    def acted(address: PoolAddress) -> None:
        try:
            act(address)
        except BaseException as error:  # noqa: BLE001 - raised again below
            failed.append(error)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    def say(words: str) -> None:
        found = re.search(r"tls://127\.0\.0\.1:\d+", words)
        assert found is not None
        threading.Thread(target=acted, args=(pool_address(found[0], None),)).start()

    # Everybody may look around where it has its own folder.
    with tempfile.TemporaryDirectory() as around, pytest.MonkeyPatch.context() as patched:
        Path(around).chmod(0o755)
        patched.setenv("XDG_RUNTIME_DIR", around)
        serve_scheduler(PoolAddress("127.0.0.1", 0), say=say)
    if failed:
        raise failed[0]


class Peer:
    """Somebody who connects to a scheduler. tls : None: without."""

    def __init__(self, address: PoolAddress, tls: ssl.SSLContext | None) -> None:
        plain = socket.create_connection((address.host, address.port), timeout=30)
        self._wire = plain if tls is None else tls.wrap_socket(plain)
        self._lines = self._wire.makefile("rb")

    def says(self, words: bytes | Message) -> None:
        with suppress(OSError):
            self._wire.sendall(words if isinstance(words, bytes) else words.model_dump_json().encode() + b"\n")

    def hears(self) -> dict[str, Any] | None:
        """The next that is no sign of life; None: the connection has ended."""
        try:
            line = next((line for line in self._lines if line != BEAT), None)
        except OSError:
            line = None
        found: dict[str, Any] | None = None if line is None else json.loads(line)
        return found

    def close(self) -> None:
        self._lines.close()
        self._wire.close()


def plain(address: PoolAddress, words: bytes) -> str:
    return said(Peer(address, None), words)


def without_certificate(address: PoolAddress, words: bytes) -> str:
    anyone = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    anyone.check_hostname, anyone.verify_mode = False, ssl.CERT_NONE
    return said(Peer(address, anyone), words)


def of_another_authority(address: PoolAddress, words: bytes) -> str:
    (place,) = make_certificates(address.own_folder.parent / "theirs", ("rig",))
    stranger = pool_address(ADDRESS, place).tls(listens=False)
    # It does not take this scheduler for its own either.
    with pytest.raises(ssl.SSLCertVerificationError):
        Peer(address, stranger)
    stranger.verify_mode = ssl.CERT_NONE
    return said(Peer(address, stranger), words)


def another_user(address: PoolAddress, words: bytes) -> str:
    if os.geteuid() != 0:
        pytest.skip("only root can be another user")
    # It becomes so after its imports: Python may lie where nobody else reads.
    code = """if True:
        import encodings.idna, os, socket, ssl, sys
        folder, port, words = sys.argv[1:]
        os.setgroups([])
        os.setgid(65534)
        os.setuid(65534)
        anyone = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        anyone.check_hostname, anyone.verify_mode = False, ssl.CERT_NONE
        try:
            anyone.load_cert_chain(folder + "/certificate.pem", folder + "/key.pem")
        except PermissionError:
            pass
        wire = anyone.wrap_socket(socket.create_connection(("127.0.0.1", int(port))))
        try:
            wire.sendall(words.encode())
            print(wire.recv(10_000).decode())
        except OSError:
            pass
    """
    told = (str(address.own_folder / MEMBER), str(address.port), words.decode())
    return subprocess.check_output([sys.executable, "-c", code, *told], text=True, timeout=60).strip()  # noqa: S603


def a_member(address: PoolAddress, words: bytes) -> str:
    return said(Peer(address, address.tls(listens=False)), words)


def said(peer: Peer, words: bytes) -> str:
    """What a peer hears that says something, until it is let go."""
    peer.says(words)
    heard = peer.hears()
    peer.close()
    return "" if heard is None else str(heard)


JOB = "0" * 32
RIG = Hello().model_dump_json().encode() + b"\n"
ORDER = b'{"says": "request", "job": "%s", "versions": {}, "task": {}}\n' % (b"1" * 32)


@parametrize_core(
    ("peer", "words", "heard"),
    [
        (plain, RIG + ORDER, ""),
        (without_certificate, RIG + ORDER, ""),
        (of_another_authority, RIG + ORDER, ""),
        (another_user, RIG + ORDER, ""),
        (a_member, ORDER, "has no place here"),
        (a_member, pickle.dumps(print) + b"\n", "no valid message"),
        (a_member, b'{"says": "run_function", "function": "os.system"}\n', "no valid message"),
        (a_member, ORDER.replace(b"{}}", b'{}, "function": "os.system"}'), "no valid message"),
        (a_member, ORDER.replace(b"1" * 32, b"../../" + b"1" * 26), "no valid message"),
        (a_member, RIG.replace(b":1", b":2"), "no valid message"),
        (a_member, b" " * (3 * LINE_BYTES), "no valid message"),
    ],
    core=[0, 1, 2, 3],
)
def test_only_orders_of_members_reach_a_worker(
    peer: Callable[[PoolAddress, bytes], str], words: bytes, heard: str
) -> None:
    def act(address: PoolAddress) -> None:
        worker, rig = (Peer(address, address.tls(listens=False)) for _ in range(2))
        worker.says(Hello(versions={}))
        rig.says(Hello())
        both = {"says": "workers", "versions": [{}]}
        assert rig.hears() == both or rig.hears() == both
        found = peer(address, words)
        assert found == heard or (heard and heard in found), found
        mine = PoolRequest(job=JOB, versions={}, task={})
        rig.says(mine)
        assert worker.hears() == mine.model_dump()
        for each in (worker, rig):
            each.close()

    beside_a_scheduler(act)


def test_address_in_use_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        address = PoolAddress("127.0.0.1", holder.getsockname()[1])
        with pytest.raises(ServiceError, match=f"cannot listen at {address}: .*in use"):
            serve_scheduler(address, say=print)
    assert not address.own_folder.exists()


class TameLink(Link):
    """said : what was said to the member at the other end."""

    def __init__(self) -> None:
        self.said: list[Message] = []

    def send(self, message: Message) -> None:
        self.said.append(message)

    def last(self) -> Message | None:
        return self.said[-1] if self.said else None


def request(number: int, code: str = "ours") -> PoolRequest:
    return PoolRequest(job=f"{number:032x}", versions={"code": code}, task={})


class Hall:
    """A scheduler, its rigs and workers, all of one version but the last worker."""

    def __init__(self) -> None:
        self.scheduler = Scheduler()
        self.rigs, self.workers = [TameLink(), TameLink()], [TameLink(), TameLink()]
        for each in self.rigs:
            self.scheduler.heard(each, Hello())
        for each, code in zip(self.workers, ("ours", "theirs"), strict=True):
            self.scheduler.heard(each, Hello(versions={"code": code}))


def test_a_worker_has_one_order_at_a_time_of_its_versions() -> None:
    hall = Hall()
    hear, (rig, other), (ours, theirs) = hall.scheduler.heard, hall.rigs, hall.workers
    assert rig.last() == other.last() == Workers(versions=[{"code": "ours"}, {"code": "theirs"}])
    for each, number in ((rig, 1), (other, 2), (rig, 3)):
        hear(each, request(number))
    assert ours.said == [request(1)]
    hear(ours, Progress(job=request(1).job, stage="decode"))
    assert rig.last() == Progress(job=request(1).job, stage="decode")
    # What is another's is not its business.
    hear(ours, PoolResponse(job=request(2).job))
    assert len(other.said) == 3
    hear(ours, PoolResponse(job=request(1).job))
    assert (rig.last(), ours.said[1:]) == (PoolResponse(job=request(1).job), [request(2)])
    hear(rig, request(4, "theirs"))
    assert theirs.said == [request(4, "theirs")]


def test_what_a_lost_worker_did_is_given_back_and_what_a_lost_rig_ordered_is_dropped() -> None:
    hall = Hall()
    hear, (rig, other), (ours, _) = hall.scheduler.heard, hall.rigs, hall.workers
    hear(rig, request(1))
    hall.scheduler.gone(ours)
    answer = rig.said[-2]
    assert isinstance(answer, PoolResponse)
    assert answer.fault == JobFailure(POOL_FAULT, "its worker was lost")
    assert rig.last() == other.last() == Workers(versions=[{"code": "theirs"}])
    for each, number in ((rig, 2), (rig, 3), (other, 4)):
        hear(each, request(number))
    hear(newer := TameLink(), Hello(versions={"code": "ours"}))
    hall.scheduler.gone(rig)
    assert newer.said == [request(2), Withdrawal(job=request(2).job)]
    hear(newer, PoolResponse(job=request(2).job))
    assert newer.last() == request(4)


def test_a_withdrawn_order_is_stopped_or_never_given() -> None:
    hall = Hall()
    hear, (rig, other), (ours, _) = hall.scheduler.heard, hall.rigs, hall.workers
    for number in (1, 2, 3):
        hear(rig, request(number))
    hear(other, Withdrawal(job=request(1).job))
    assert ours.last() == request(1)
    for number in (1, 2):
        hear(rig, Withdrawal(job=request(number).job))
    assert ours.last() == Withdrawal(job=request(1).job)
    hear(ours, PoolResponse(job=request(1).job))
    assert ours.last() == request(3)
    assert not [each for each in rig.said if isinstance(each, PoolResponse)]


def test_an_end_that_falls_silent_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slrig.compute.link.LOST_S", 0.0)

    async def life() -> None:
        near, far = socket.socketpair()
        with far:
            link = Link(*await asyncio.open_connection(sock=near))
            try:
                await link.hear(never)
            finally:
                link.close()

    with pytest.raises(TimeoutError):
        asyncio.run(life())


@pytest.mark.parametrize(("mode", "user"), [(0o40700, os.geteuid() + 1), (0o40755, os.geteuid()), (0o120700, 0)])
def test_members_use_no_folder_of_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int, user: int) -> None:
    monkeypatch.setattr(Path, "lstat", lambda _: os.stat_result((mode, 0, 0, 1, user, *[0] * 5)))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    address = PoolAddress("127.0.0.1", 8786)
    address.own_folder.mkdir()
    with pytest.raises(ConfigError, match="slrig-pool-8786 belongs to another user"):
        address.tls(listens=False)

"""A pool of real processes over TLS, and an S3 server that is not ours: whatever is lost, a scan has one result."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import httpx2
import pytest

from slrig.jobs.listener import Listener
from slrig.jobs.worker import Compute, Worker
from slrig.scan.job import PIPELINE
from tests.e2e.conftest import Start, write_rig
from tests.listening import free_port, listening_at
from tests.npm import lacking
from tests.unit.command import done
from tests.unit.scan.fakes import reconstruction

if TYPE_CHECKING:
    from slrig.compute.pooled import PoolClient, PooledWorker

SECRET = "the-secret-of-the-store"  # noqa: S105 - nothing but a test's
BUCKET = "s3://scans/hall-3"
START_LIMIT_S = 60.0


class Process:
    """A command that runs until it is killed. said : what it says once it works; None: it says nothing."""

    def __init__(self, args: list[str], environment: Mapping[str, str], log: Path, said: str | None = None) -> None:
        self._args, self._environment, self._log, self._said = args, dict(environment), log, said
        self.process = self._started()

    def _started(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as log:
            return subprocess.Popen(  # noqa: S603 - our own command
                [sys.executable, "-m", *self._args], stdout=subprocess.PIPE, stderr=log,
                env={**os.environ, **self._environment, "PYTHONUNBUFFERED": "1"},
            )  # fmt: skip

    def wait_until_it_works(self) -> None:
        assert self.process.stdout is not None
        assert self._said is not None
        for line in self.process.stdout:
            if self._said in line.decode():
                return
        raise AssertionError(self._log.read_text())

    def start_again(self) -> None:
        self.process = self._started()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


class S3Server(Process):
    """moto's server, on loopback, with one bucket."""

    def __init__(self, log: Path) -> None:
        self.port = free_port()
        super().__init__(["moto.server", "-H", "127.0.0.1", "-p", str(self.port)], {}, log)

    def make_bucket(self) -> None:
        """Wait for the server, and make the bucket of `BUCKET`: what it held is gone with a server that was killed."""
        transport = httpx2.HTTPTransport(retries=20)  # half a minute, at doubling intervals
        credential = {"Authorization": "AWS4-HMAC-SHA256 Credential=x/20240101/us-east-1/s3/aws4_request"}
        with httpx2.Client(transport=transport, timeout=START_LIMIT_S) as client:
            client.put(f"http://127.0.0.1:{self.port}/{urlsplit(BUCKET).netloc}", headers=credential).raise_for_status()


class Wire:
    """Carries connections to a port of this machine until it is cut: then nothing passes, without a word."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._whole = threading.Event()
        self._whole.set()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listening.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._whole.clear()

    def mend(self) -> None:
        self._whole.set()

    def close(self) -> None:
        self._listening.close()
        self.mend()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listening.accept()
                try:
                    far = socket.create_connection(("127.0.0.1", self._to))
                except OSError:
                    near.close()
                    continue
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=ends, daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(2**16):
                self._whole.wait()
                sink.sendall(data)
        for each in (source, sink):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()


class Pool:
    """A scheduler, two workers, which have what they compute in `scratch`, and a store.

    logs : of the store, the scheduler, and each worker. wires : which services reach scheduler and store by, if they
    are wired.
    """

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        certificates, port = folder / "certificates", free_port()
        done("pool", "certificates", certificates)
        self.certificates, self.scratch = certificates / "rig", folder / "scratch"
        self.scratch.mkdir()
        self.logs = [folder / f"{name}.log" for name in ("store", "scheduler", "one", "two")]
        self.store = S3Server(self.logs[0])
        self.wires, self._ports = (Wire(port), Wire(self.store.port)), (port, self.store.port)
        scheduler = ["slrig.cli", "pool", "--port", str(port), "--certificates", str(certificates / "scheduler")]
        worker = ["slrig.cli", "worker", "--scheduler", f"tls://127.0.0.1:{port}", "--store", BUCKET, "--certificates"]
        worker = [*worker, str(certificates / "worker")]
        environment = {**_store(self.store.port), "TMPDIR": str(self.scratch)}
        self.scheduler = Process(scheduler, {}, self.logs[1], said="scheduler is at tls://")
        self.workers = [Process(worker, environment, log, said="computes for") for log in self.logs[2:]]
        for each in (self.store, self.scheduler, *self.workers):
            stack.callback(each.kill)
        for wire in self.wires:
            stack.callback(wire.close)
        self.store.make_bucket()
        for each in (self.scheduler, *self.workers):
            each.wait_until_it_works()
        assert listening_at(self.scheduler.process.pid) == {f"127.0.0.1:{port}"}
        assert not any(listening_at(each.process.pid) for each in self.workers)

    def service(self, *, wired: bool = False) -> dict[str, str]:
        """What the environment of a service says of the pool."""
        scheduler, store = [each.port for each in self.wires] if wired else self._ports
        return {
            **_store(store),
            "SLRIG_COMPUTE": f"tls://127.0.0.1:{scheduler}",
            "SLRIG_COMPUTE_STORE": BUCKET,
            "SLRIG_COMPUTE_CERTIFICATES": str(self.certificates),
        }

    def rig(self, local: Compute, *, wired: bool = False) -> tuple[PooledWorker, PoolClient]:
        """A service's worker, begun, and its connection; `service` is in the environment already."""
        from slrig.compute.host import open_store
        from slrig.compute.pooled import PoolClient, PooledWorker
        from slrig.compute.security import pool_address

        address = self.service(wired=wired)["SLRIG_COMPUTE"]
        client = PoolClient(pool_address(address, self.certificates))
        worker = PooledWorker(local, client, open_store(BUCKET))
        worker.start()
        return worker, client


def _store(port: int) -> dict[str, str]:
    endpoint = f"http://127.0.0.1:{port}"
    return {"AWS_ENDPOINT_URL": endpoint, "AWS_ACCESS_KEY_ID": "somebody", "AWS_SECRET_ACCESS_KEY": SECRET}


@pytest.fixture
def pool(tmp_path: Path) -> Iterator[Pool]:
    if not all(map(find_spec, ("flask_cors", "moto", "obstore"))):
        lacking("needs a pool's libraries, and an S3 server: pip install -e '.[pool,s3]'")
    with ExitStack() as stack:
        yield Pool(tmp_path, stack)


FOUND_LIMIT_S = 60.0
"""So long a service may take to find its pool."""


class Rig:
    """What a service has bundles reconstructed by, and what came of one."""

    def __init__(self, pool: Pool, bundle: Path, local: Worker) -> None:
        self.bundle = bundle
        self.worker, self.client = pool.rig(local, wired=True)

    def computed(self, result: Path, *, when_begun: Callable[[], None]) -> dict[str, Any]:
        """Reconstruct, with something done in the middle; return the report's section."""
        shutil.copytree(self.bundle, result / "bundle")
        begun = False

        def progress(_stage: str, fraction: float, _detail: str) -> None:
            nonlocal begun
            if fraction > 0 and not begun:
                begun = True
                when_begun()

        self.worker.run(reconstruction(result), Listener(report=progress))
        assert begun
        report = json.loads((result / "result" / "report.json").read_text())
        section: dict[str, Any] = report["computed"]
        return section


@pytest.mark.slow
def test_whatever_is_lost_a_scan_has_its_one_result(
    pool: Pool, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in pool.service(wired=True).items():
        monkeypatch.setenv(name, value)
    service = start(write_rig(tmp_path / "rig"))
    with service.client() as client:
        # The first ones may come before the service has found its pool.
        until_s = time.monotonic() + FOUND_LIMIT_S
        while (scan := client.scan()).report["computed"]["where"] != "pool":
            assert time.monotonic() < until_s, scan.report["computed"]
        names = set(scan.files)
    bundle, pooled = (service.data / "scans" / str(scan.id) / name for name in ("bundle", "mesh.ply"))
    assert service.stop() == 0

    local = Worker(PIPELINE)
    rig = Rig(pool, bundle, local)
    assert rig.client.usable(30)
    try:
        shutil.copytree(bundle, tmp_path / "alone" / "bundle")
        alone = tmp_path / "alone" / "result"
        assert local.run(reconstruction(alone.parent)).summary["computed"]["where"] == "local"
        whole = {path.name for path in alone.iterdir()}
        assert (alone / "mesh.ply").read_bytes() == pooled.read_bytes()
        assert whole <= names

        def right(case: str, when_begun: Callable[[], None]) -> dict[str, Any]:
            section = rig.computed(tmp_path / case, when_begun=when_begun)
            assert {path.name for path in (tmp_path / case / "result").iterdir()} == whole
            assert (tmp_path / case / "result" / "mesh.ply").read_bytes() == pooled.read_bytes()
            return section

        def kill_who_computes() -> None:
            (order,) = rig.client._orders
            (found,) = (each for each, log in zip(pool.workers, pool.logs[2:], strict=True) if order in log.read_text())
            found.process.send_signal(signal.SIGKILL)

        assert right("worker", kill_who_computes)["where"] == "pool"
        assert sorted(each.process.poll() is None for each in pool.workers) == [False, True]

        with monkeypatch.context() as impatient:
            impatient.setattr("slrig.compute.link.LOST_S", 3.0)
            assert "because" in right("network", pool.wires[0].cut)
        pool.wires[0].mend()
        assert rig.client.usable(30)

        assert "lost" in right("scheduler", pool.scheduler.kill)["because"]
        pool.scheduler.start_again()
        assert rig.client.usable(30)
        assert right("again", lambda: None)["where"] == "pool"

        assert "store s3://scans/hall-3 failed" in right("store", pool.store.kill)["because"]
    finally:
        rig.worker.close()
    logs = "".join(log.read_text() for log in [*pool.logs, service.log])
    assert SECRET not in logs
    assert os.environ["AWS_SECRET_ACCESS_KEY"] == SECRET

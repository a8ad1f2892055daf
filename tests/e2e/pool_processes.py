"""A pool as real processes on this machine, its S3 server, which is moto's, and a network that can be cut."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import httpx2
from typer.testing import CliRunner

from slrig.cli.commands import app
from slrig.jobs.compute import Compute
from tests.listening import free_port, listening_at

if TYPE_CHECKING:
    from slrig.compute.cluster import DaskCluster
    from slrig.compute.pooled import PooledWorker

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
        made = CliRunner().invoke(app, ["pool", "certificates", str(certificates)])
        assert made.exit_code == 0, made.output
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
            assert {at.rpartition(":")[0] for at in listening_at(each.process.pid)} == {"127.0.0.1"}

    def service(self, *, wired: bool = False) -> dict[str, str]:
        """What the environment of a service says of the pool."""
        scheduler, store = [each.port for each in self.wires] if wired else self._ports
        return {
            **_store(store),
            "SLRIG_COMPUTE": f"tls://127.0.0.1:{scheduler}",
            "SLRIG_COMPUTE_STORE": BUCKET,
            "SLRIG_COMPUTE_CERTIFICATES": str(self.certificates),
        }

    def rig(self, local: Compute, *, wired: bool = False) -> tuple[PooledWorker, DaskCluster]:
        """A service's worker, begun, and its connection; `service` is in the environment already."""
        from slrig.compute.cluster import DaskCluster
        from slrig.compute.pooled import PooledWorker
        from slrig.compute.security import pool_security
        from slrig.compute.store import open_store

        address = self.service(wired=wired)["SLRIG_COMPUTE"]
        cluster = DaskCluster(address, pool_security(address, self.certificates))
        worker = PooledWorker(local, cluster, open_store(BUCKET))
        worker.start()
        return worker, cluster


def _store(port: int) -> dict[str, str]:
    endpoint = f"http://127.0.0.1:{port}"
    return {"AWS_ENDPOINT_URL": endpoint, "AWS_ACCESS_KEY_ID": "somebody", "AWS_SECRET_ACCESS_KEY": SECRET}

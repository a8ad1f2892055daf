"""A pool as real processes on this machine, its S3 server, which is moto's, and a network that can be cut."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import httpx2

from tests.listening import free_port

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
        """End it as a power cut would."""
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


class S3Server(Process):
    """moto's server, on loopback, with one bucket."""

    def __init__(self, log: Path) -> None:
        self.port = free_port()
        super().__init__(["moto.server", "-H", "127.0.0.1", "-p", str(self.port)], {}, log)

    def make_bucket(self, name: str) -> None:
        """Wait for the server, and make a bucket."""
        transport = httpx2.HTTPTransport(retries=20)  # half a minute, at doubling intervals
        credential = {"Authorization": "AWS4-HMAC-SHA256 Credential=x/20240101/us-east-1/s3/aws4_request"}
        with httpx2.Client(transport=transport, timeout=START_LIMIT_S) as client:
            client.put(f"http://127.0.0.1:{self.port}/{name}", headers=credential).raise_for_status()


class Wire:
    """Carries connections to a port of this machine until it is cut: then nothing passes, and nobody is told."""

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

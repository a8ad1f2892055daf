"""A Postgres server as a real process on loopback, which can be killed and started again. It syncs to disk as usual."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

from tests.listening import free_port
from tests.npm import lacking

START_LIMIT_S = 60.0
OWNER, PASSWORD = "slrig", "hidden:part-of-it"
LOGIN = f"{OWNER}:{PASSWORD}"


def binaries() -> Path:
    """The folder of Postgres's programs, the newest. Skips, or in CI fails, where there is none."""
    found = shutil.which("postgres")
    # Debian's are not on the path.
    others = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
    if found is None and not others:
        lacking("needs a Postgres server: apt install postgresql")
    return others[-1] if found is None else Path(found).parent


class Postgres:
    """A server, with one owner of all databases, who logs in by `LOGIN`. Use it as a context, or `remove` it.

    certificate : a file with a key and a certificate, for TLS beside plain connections.
    """

    def __init__(self, *, certificate: Path | None = None) -> None:
        pytest.importorskip("pg8000", reason="needs Postgres's driver: pip install 'slrig[fleet]'")
        self._binaries = binaries()
        self.port = free_port()
        # Not in pytest's folder, which other users may not enter, and Postgres does not run as root.
        self._folder = Path(tempfile.mkdtemp(prefix="slrig-postgres-"))
        self._data = self._folder / "data"
        self._user: dict[str, Any] = {}
        if os.geteuid() == 0:
            self._user = {"user": "nobody", "group": "nogroup", "extra_groups": []}
        self._process: subprocess.Popen[str] | None = None
        self.said: list[str] = []
        password = self._folder / "password"
        password.write_text(PASSWORD)
        self._options = ["--unix_socket_directories=", f"--port={self.port}", "--listen_addresses=127.0.0.1"]
        if certificate is not None:
            shutil.copy(certificate, self._folder / "certificate.pem")
            own = self._folder / "certificate.pem"
            self._options += ["--ssl=on", f"--ssl_cert_file={own}", f"--ssl_key_file={own}"]
        for path in (self._folder, *self._folder.iterdir()):
            path.chmod(0o700 if path.is_dir() else 0o600)
            if self._user:
                shutil.chown(path, "nobody", "nogroup")
        subprocess.run(  # noqa: S603 - our own command
            [
                self._binaries / "initdb", "-D", self._data, "-U", OWNER, "--auth=scram-sha-256",
                f"--pwfile={password}", "--locale=C", "--encoding=UTF8",
            ],
            check=True, capture_output=True, cwd=self._folder, **self._user,
        )  # fmt: skip

    def address(self, database: str = "postgres") -> str:
        """As the settings of a service name it."""
        return f"postgresql://127.0.0.1:{self.port}/{database}"

    def start(self) -> None:
        """Take connections, with what was committed. Idempotent."""
        if self._process is not None:
            return
        self._process = process = subprocess.Popen(  # noqa: S603 - our own command
            [self._binaries / "postgres", "-D", self._data, *self._options],
            stderr=subprocess.PIPE, text=True, cwd=self._folder, **self._user,
        )  # fmt: skip
        settled = threading.Event()
        ready: list[str] = []

        def read() -> None:
            assert process.stderr is not None
            with process.stderr:
                for line in process.stderr:
                    self.said.append(line)
                    if "ready to accept connections" in line:
                        ready.append(line)
                        settled.set()
            settled.set()

        self._reading = threading.Thread(target=read, daemon=True)
        self._reading.start()
        settled.wait(START_LIMIT_S)
        assert ready, self.said[-20:]

    def kill(self) -> None:
        """End it as a power cut would. Idempotent."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            # Until the last of its processes, which notice that by themselves, is gone.
            self._reading.join(START_LIMIT_S)
            self._process = None

    def execute(self, statement: str, database: str = "postgres") -> list[Any]:
        """Do a statement as the owner, and return the rows of its answer."""
        from pg8000.native import Connection

        connection = Connection(OWNER, "127.0.0.1", database, self.port, PASSWORD, timeout=START_LIMIT_S)
        try:
            return list(connection.run(statement) or [])
        finally:
            connection.close()

    def remove(self) -> None:
        """End it, and remove its data. Idempotent."""
        self.kill()
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.remove()

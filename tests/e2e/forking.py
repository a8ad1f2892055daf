"""The service, and its worker, in processes that are forked from one that has loaded them, and so load nothing anew.

Most tests of the service are about what it does once it runs, and start it dozens of times; loading FastAPI, the
rendered rig, the mathematics and its kernels takes ten seconds of processor time each. What is forked is the same
command with the same arguments, environment, output and signals; its worker does the same as one that is spawned. What
such processes load by themselves is seen by tests that start them afresh.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any
from unittest import mock

_LOADED = (
    "slrig.cli.commands", "slrig.api.server", "simulated_rig.device", "scipy.signal", "slrig.scan.reconstruct",
)  # fmt: skip
"""What a service of a rendered rig and its worker load; before the last one, so that it finds their kernels."""


_ENVIRONMENT = dict(os.environ)
"""Before any test."""


class ForkedCommand:
    """A `slrig` command, with what a test uses of `subprocess.Popen`.

    args : after `slrig`. environment : all of it. log : where its standard error is added.
    """

    def __init__(self, args: Sequence[str], environment: Mapping[str, str], log: Path) -> None:
        self.args = args
        assert "LD_PRELOAD" not in environment, "it is read as a program begins: this one has to be fresh"
        near, far = _context().Pipe(duplex=False)
        context = _context()
        address = vars(forkserver._forkserver)["_forkserver_address"]
        self._process = context.Process(target=_run, args=(list(args), dict(environment), str(log), far, address))
        self._process.start()
        far.close()
        self.stdout = os.fdopen(os.dup(near.fileno()), "rb")
        near.close()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    def poll(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """The exit code once it has ended. Raises subprocess.TimeoutExpired."""
        self._process.join(timeout)
        code = self._process.exitcode
        if code is None:
            raise subprocess.TimeoutExpired(list(self.args), timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it as a power cut would."""
        self.send_signal(signal.SIGKILL)


@cache
def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_LOADED, "tests.e2e.kept_kernels"])
    # What a test has set by now, as where its plug-ins lie, is for the services of that test.
    with mock.patch.dict(os.environ, _ENVIRONMENT, clear=True):
        forkserver.ensure_running()
    return context


def worker_of(service: int) -> int | None:
    """The process id of the worker that a forked service has; None if it has none."""
    for comm in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):  # one that has just ended
            if comm.read_text().strip() == _worker_name(service):
                return int(comm.parent.name)
    return None


def _worker_name(service: int) -> str:
    return f"worker {service}"


class _Workers(ForkServerContext):
    """In a forked service: has its worker forked, too. log : where the service's standard error goes."""

    def __init__(self, log: str) -> None:
        super().__init__()
        self._log = log

    def Process(self, *, target: Any, args: tuple[Any, ...], **options: Any) -> Any:  # type: ignore[override] # noqa: N802
        """A process that is forked where another context would spawn one."""
        given = dict(os.environ), self._log, os.getpid(), target, args
        return super().Process(target=_work, args=given, **options)


def _work(environment: dict[str, str], log: str, service: int, target: Any, args: tuple[Any, ...]) -> None:
    """Become the worker of a service, in the process that was forked."""
    _become(environment, log)
    Path("/proc/self/comm").write_text(_worker_name(service))
    from slrig.kernels import prepared
    from slrig.scan import reconstruct

    # Where all kernels are loaded, a made-up scan would load none, and takes a second of processor time.
    now = prepared()
    prepare = reconstruct.warm_kernels if now.done < now.total else lambda _: None
    with mock.patch.object(reconstruct, "warm_kernels", prepare):
        target(*args)


def _run(args: list[str], environment: dict[str, str], log: str, output: Connection, address: str) -> None:
    """Become the command, in the process that was forked. address : of the process that forks, for the worker."""
    # By itself it would start one of its own, which has loaded nothing.
    vars(forkserver._forkserver).update(_forkserver_address=address, ensure_running=lambda: None)
    _become(environment, log)
    os.dup2(output.fileno(), 1)
    output.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.argv = ["slrig", *args]

    from slrig.cli.commands import main

    with mock.patch.object(multiprocessing, "get_context", return_value=_Workers(log)):
        main()


def _become(environment: dict[str, str], log: str) -> None:
    """Take an environment and a standard error."""
    os.environ.clear()
    os.environ.update(environment)
    # As Python does at its start.
    given = [each for each in environment.get("PYTHONPATH", "").split(os.pathsep) if each]
    sys.path[:] = [*given, *(each for each in sys.path if each not in given)]
    errors = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    os.dup2(errors, 2)
    os.close(errors)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    if environment.get("PYTHONFAULTHANDLER"):
        faulthandler.enable()

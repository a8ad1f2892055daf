"""The service in a process that is forked from one that has loaded it, and so loads nothing anew.

Most tests of the service are about what it does once it runs, and start it dozens of times; loading FastAPI,
SQLAlchemy and the rest takes three to four seconds of processor time each. What is forked is the same command with the
same arguments, environment, output and signals; it loads the rig's driver and its worker by itself.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from unittest import mock

_LOADED = ("slrig.cli.commands", "slrig.api.server")
"""What every service loads, whatever its rig is."""


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
        self._process = _context().Process(target=_run, args=(list(args), dict(environment), str(log), far))
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
    context.set_forkserver_preload(list(_LOADED))
    # What a test has set by now, as where its plug-ins lie, is for the services of that test.
    with mock.patch.dict(os.environ, _ENVIRONMENT, clear=True):
        forkserver.ensure_running()
    return context


def _run(args: list[str], environment: dict[str, str], log: str, output: Connection) -> None:
    """Become the command, in the process that was forked."""
    os.environ.clear()
    os.environ.update(environment)
    # As Python does at its start.
    given = [each for each in environment.get("PYTHONPATH", "").split(os.pathsep) if each]
    sys.path[:] = [*given, *(each for each in sys.path if each not in given)]
    errors = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    os.dup2(errors, 2)
    os.close(errors)
    os.dup2(output.fileno(), 1)
    output.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    if environment.get("PYTHONFAULTHANDLER"):
        faulthandler.enable()
    sys.argv = ["slrig", *args]

    from slrig.cli.commands import main

    main()

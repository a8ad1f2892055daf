"""The fenced `sh` commands of every README, and a person with two terminals and a fresh folder who types them."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import httpx2

from tests.listening import free_port

ROOT = Path(__file__).resolve().parents[3]
_FENCE = re.compile(r"^```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_COMMENT = re.compile(r"\s+#\s")


@dataclass(frozen=True, slots=True)
class Command:
    """A command as it is typed, without a comment behind it. readme : path in the repository. line : its first one."""

    readme: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.readme}:{self.line}: {self.text}"


def readmes() -> list[Path]:
    """The root's README first, then the others by their paths."""
    folders = ("config", "drivers", "simulated_rig", "slrig", "tests")
    return [ROOT / "README.md", *sorted(path for folder in folders for path in (ROOT / folder).rglob("README.md"))]


def commands() -> list[Command]:
    return [command for readme in readmes() for command in _of(readme)]


def _of(readme: Path) -> Iterator[Command]:
    text, name = readme.read_text(encoding="utf-8"), str(readme.relative_to(ROOT))
    for block in _FENCE.finditer(text):
        first = text.count("\n", 0, block.start(1)) + 1
        begun: list[str] = []
        for number, line in enumerate(block.group(1).splitlines()):
            if not begun and (not line.strip() or line.lstrip().startswith("#")):
                continue
            begun.append(line)
            if _is_whole("\n".join(begun)):
                typed = "\n".join([*begun[:-1], _without_comment(begun[-1])])
                yield Command(name, first + number + 1 - len(begun), typed)
                begun = []
        assert not begun, f"{name}: a command does not end: {begun}"


def _is_whole(text: str) -> bool:
    """Whether bash asks for no further line: not within quotes, a here-document or a loop, nor after a backslash."""
    if text.endswith("\\"):
        return False
    checked = subprocess.run(["bash", "-n"], input=text + "\n", capture_output=True, text=True, check=False)  # noqa: S607
    return checked.returncode == 0 and not checked.stderr


def _without_comment(line: str) -> str:
    """The line up to a number sign that stands by itself, outside quotes."""
    for sign in _COMMENT.finditer(line):
        before = line[: sign.start()]
        if before.count("'") % 2 == before.count('"') % 2 == 0:
            return before
    return line


COMMAND_LIMIT_S = 600.0
_START_LIMIT_S = 60.0
_STOP_LIMIT_S = 15.0
_POLL_S = 0.1
USUAL_ADDRESS = "127.0.0.1:8731"
"""Where the READMEs have the service; here it takes a free port, so that it is in no other program's way."""


class Person:
    """A context manager. folder : holds `config` and an environment that is made; address : host and port."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        shutil.copytree(ROOT / "config", folder / "config")
        _lay_out_environment(folder / ".venv" / "bin")
        home = folder / "home"
        home.mkdir()
        self.address = f"127.0.0.1:{free_port()}"
        host, _, port = self.address.partition(":")
        self._environment = os.environ | {
            "HOME": str(home),
            "PYTHONPATH": str(ROOT),
            "SLRIG_HOST": host,
            "SLRIG_PORT": port,
            "SLRIG_URL": f"http://{self.address}",
            "SLRIG_MIN_FREE_BYTES": "0",
        }
        self.key: str | None = None
        self._service: subprocess.Popen[bytes] | None = None
        self._log = folder / "service.log"

    def __enter__(self) -> Person:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop_service()

    def type(self, command: str) -> str:
        """Run a command in the client's terminal, with what it leaves in the environment. Raises AssertionError."""
        if command.startswith("slrig serve "):
            return self.serve(command)
        kept = self.folder / ".environment"
        typed = subprocess.run(  # noqa: S603 - the commands of our own READMEs
            ["bash", "-c", f"{command}\nstatus=$?\nenv -0 > {kept}\nexit $status"],  # noqa: S607
            cwd=self.folder, env=self._environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, timeout=COMMAND_LIMIT_S, check=False,
        )  # fmt: skip
        said = typed.stdout.decode(errors="replace")
        assert typed.returncode == 0, f"it ended with exit code {typed.returncode}:\n{said[-3000:]}"
        self._environment = dict(each.split("=", 1) for each in kept.read_text().split("\0") if each)
        return said

    def serve(self, command: str) -> str:
        """Start the service in the other terminal, in place of one that runs there; wait until it answers."""
        self.stop_service()
        # The key was exported in the client's terminal only.
        environment = {name: text for name, text in self._environment.items() if name != "SLRIG_API_KEY"}
        # A terminal: keys are shown on no other output.
        screen, terminal = os.openpty()
        self._service = subprocess.Popen(  # noqa: S603 - the commands of our own READMEs
            ["bash", "-c", f"exec {command}"],  # noqa: S607
            cwd=self.folder, env=environment | {"PYTHONUNBUFFERED": "1"}, stdin=subprocess.DEVNULL,
            stdout=terminal, stderr=subprocess.STDOUT,
        )  # fmt: skip
        os.close(terminal)
        self._log.write_bytes(b"")
        threading.Thread(target=_copy, args=(screen, self._log), daemon=True).start()
        give_up = time.monotonic() + _START_LIMIT_S
        while not self._answers():
            said = self._log.read_text(errors="replace")
            assert self._service.poll() is None, f"the service ended with {self._service.returncode}:\n{said[-3000:]}"
            assert time.monotonic() < give_up, f"the service did not answer in {_START_LIMIT_S:g} s:\n{said[-3000:]}"
            time.sleep(_POLL_S)
        said = self._log.read_text(errors="replace")
        # It is printed once for each data folder; a later service there has the same one.
        shown = re.search(r"^API key, shown only now: (\S+)$", said, re.MULTILINE)
        self.key = self.key if shown is None else shown.group(1)
        assert self.key is not None, f"the service showed no key:\n{said}"
        return said

    def stop_service(self) -> None:
        """Ctrl-C in the service's terminal. Raises AssertionError if it does not end well."""
        if self._service is None:
            return
        self._service.send_signal(signal.SIGINT)
        service, self._service = self._service, None
        try:
            code = service.wait(_STOP_LIMIT_S)
        finally:
            service.kill()
        assert code in {0, 130}, f"the service ended with {code}:\n{self._log.read_text(errors='replace')[-3000:]}"

    def _answers(self) -> bool:
        try:
            return httpx2.get(f"http://{self.address}/livez", timeout=2).status_code == 200
        except httpx2.TransportError:
            return False


def _copy(screen: int, log: Path) -> None:
    """Write down what a terminal shows, until the last program leaves it."""
    with log.open("ab", buffering=0) as file, suppress(OSError):
        while shown := os.read(screen, 65536):
            file.write(shown.replace(b"\r", b""))
    os.close(screen)


def _lay_out_environment(folder: Path) -> None:
    """What `python3 -m venv` and `pip install -e .` would have made: `slrig`, and a file that puts it on the path."""
    folder.mkdir(parents=True)
    (folder / "slrig").write_text(
        f"#!/bin/sh\nexec '{sys.executable}' -c 'import sys; from slrig.cli import main; sys.exit(main())' \"$@\"\n"
    )
    (folder / "slrig").chmod(0o755)
    (folder / "activate").write_text(f'export PATH="{folder}:$PATH"\n')

"""Every fenced `sh` command of every README of the repository."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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

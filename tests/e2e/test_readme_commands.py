"""Every command of every README works: typed in order, in a fresh folder, by somebody with two terminals."""

from __future__ import annotations

import logging
import shutil
import time
from pathlib import Path

import pytest

from tests.e2e.readmes.commands import Command, commands, readmes
from tests.e2e.readmes.person import Person
from tests.e2e.readmes.stand_ins import STAND_INS, WORDS, as_typed, lay_out_rigs
from tests.npm import lacking

COMMANDS = commands()
_log = logging.getLogger(__name__)  # with --log-cli-level=INFO, each command as it is typed


def test_every_exception_is_one() -> None:
    """A stand-in, or an example of a word, that no README has any more is taken out."""
    typed = {command.text for command in COMMANDS}
    assert [each.command for each in STAND_INS if each.command not in typed] == []
    assert [each.word for each in WORDS if not any(each.word in text for text in typed)] == []
    assert len({each.command for each in STAND_INS}) == len(STAND_INS)


def test_the_commands_are_read_as_bash_reads_them() -> None:
    assert len(readmes()) >= 5
    root = [command for command in COMMANDS if command.readme == "README.md"]
    assert root[0].text.endswith("slrig demo")
    assert "slrig scan --output first-scan" in [command.text for command in root]  # without the comment behind it
    assert any(' \'board={"kind"' in command.text for command in COMMANDS)


@pytest.mark.slow
def test_the_commands_work_in_order_in_a_fresh_folder(tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        lacking("needs curl, which the README of the service has: apt install curl")
    failed: list[str] = []
    with Person(tmp_path / "fresh") as person:
        lay_out_rigs(person.folder)
        for command in _different():
            why_not = _tried(command, person)
            if why_not is not None:
                failed.append(f"{command}\n  {why_not}")
    assert not failed, "\n".join(failed)


def _different() -> list[Command]:
    """The commands without those that have been there word for word, except where the word stands for another one."""
    found: list[Command] = []
    for command in COMMANDS:
        if any(each.word in command.text for each in WORDS) or command.text not in {each.text for each in found}:
            found.append(command)
    return found


def _tried(command: Command, person: Person) -> str | None:
    """Why the command does not work; None if it does, or is not run here."""
    begun_s = time.monotonic()
    try:
        typed = as_typed(command.text, person)
        if typed is not None:
            person.type(typed)
    except AssertionError as error:
        return str(error)
    finally:
        _log.info("%.1f s  %s", time.monotonic() - begun_s, command)
    return None

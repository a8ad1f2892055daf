"""Every command of every README works: typed in order, in a fresh folder, by a person with two terminals."""

from __future__ import annotations

import logging
import resource
import shutil
from pathlib import Path

import pytest

from tests.e2e.readmes.person import Person, commands
from tests.e2e.readmes.stand_ins import STAND_INS, WORDS, as_typed, lay_out_rigs
from tests.npm import lacking

pytestmark = pytest.mark.slow

_log = logging.getLogger(__name__)  # with --log-cli-level=INFO, each command and its processor time


def test_every_exception_is_one() -> None:
    """A stand-in, or an example of a word, that no README has any more is taken out."""
    found = commands()
    texts = {command.text for command in found}
    assert [each.command for each in STAND_INS if each.command not in texts] == []
    assert [each.word for each in WORDS if not any(each.word in text for text in texts)] == []
    assert len({each.command for each in STAND_INS}) == len(STAND_INS)
    # They are read as bash reads them: without a comment at the end, and with quotes over several lines.
    root = [command.text for command in found if command.readme == "README.md"]
    assert root[0].endswith("slrig demo")
    assert "slrig scan --output first-scan" in root
    assert any(' \'board={"kind"' in text for text in texts)


def test_the_commands_work_in_order_in_a_fresh_folder(tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        lacking("needs curl, which the README of the service has: apt install curl")
    failed: list[str] = []
    done: set[str] = set()
    with Person(tmp_path / "fresh") as person:
        lay_out_rigs(person.folder)
        for command in commands():
            # A command is typed once, except where one of its words stands for another thing each time.
            if command.text in done and not any(each.word in command.text for each in WORDS):
                continue
            done.add(command.text)
            before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
            try:
                typed = as_typed(command.text, person)
                if typed is not None:
                    person.type(typed)
            except AssertionError as error:
                failed.append(f"{command}\n  {error}")
            _log.info("%.1f s  %s", resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before, command)
    assert not failed, "\n".join(failed)

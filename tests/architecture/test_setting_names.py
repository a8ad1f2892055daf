"""Messages that reach a terminal and a client of the service alike name a setting by its key and by its flag."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import typer

from slrig.cli.commands import app
from slrig.errors import setting

ROOT = Path(__file__).parents[2]
# What only a terminal shows: commands by hand, words to whoever starts the service, and what is printed on a board.
OF_THE_COMMAND_LINE = (
    "slrig/cli", "slrig/api", "slrig/doctor", "slrig/jobs/data_folder.py", "slrig/jobs/database.py",
    "slrig/calibration/boards/printing.py", "slrig/foreign",
    "drivers/screen/refusals.py",  # options of xrandr
)  # fmt: skip
# Programs that are not ours.
OF_OTHERS = ("v4l2-ctl", "xrandr", "udevadm", "{command}")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def sources(having: str) -> Iterator[tuple[str, ast.Module]]:
    for package in ("slrig", "drivers"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if having in (text := path.read_text()):
                yield path.relative_to(ROOT).as_posix(), ast.parse(text)


def named_settings() -> set[str]:
    calls = (node for _, tree in sources("setting(") for node in ast.walk(tree) if isinstance(node, ast.Call))
    named = (call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "setting")
    return {str(ast.literal_eval(call.args[0])) for call in named}


@cache
def flags() -> set[str]:
    """Every long option of every command."""
    found: set[str] = set()
    waiting = [typer.main.get_command(app)]
    while waiting:
        command = waiting.pop()
        waiting += getattr(command, "commands", {}).values()
        found |= {each for option in command.params for each in (*option.opts, *option.secondary_opts)}
    return found


@cache
def keys() -> set[str]:
    """Every key of a request or a rig file."""
    found: set[str] = set()
    waiting = [json.loads((ROOT / "config" / name).read_text()) for name in ("openapi.json", "schema.json")]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict):
            found |= set(each.get("properties", {}))
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each
    return found


NAMED = sorted(named_settings())


@pytest.mark.parametrize("name", NAMED)
def test_a_setting_is_a_key_and_its_flag_an_option(name: str) -> None:
    assert name in keys()
    (flag,) = FLAG.findall(setting(name))
    assert flag in flags()


def test_settings_are_named_at_all() -> None:
    assert {"gray_cell_px", "rows", "corners"} <= set(NAMED)


def test_no_message_for_both_names_a_flag_by_hand() -> None:
    wrong, known = [], flags()
    for path, tree in sources("--"):
        if path.startswith(OF_THE_COMMAND_LINE) or path == "slrig/errors.py":
            continue
        documents = {id(node.body[0].value) for node in ast.walk(tree)
                     if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
                     and node.body and isinstance(node.body[0], ast.Expr)}  # fmt: skip
        for node in ast.walk(tree):
            if not isinstance(node, ast.JoinedStr | ast.Constant) or id(node) in documents:
                continue
            text = ast.unparse(node)
            mine = [flag for flag in FLAG.findall(text) if flag in known]
            if mine and not any(each in text for each in OF_OTHERS):
                wrong.append(f"{path}:{node.lineno}: {mine}")
    assert wrong == []

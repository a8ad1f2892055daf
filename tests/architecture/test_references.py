"""What docstrings and messages refer to is there, and comes with the package."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("slrig", "drivers", "simulated_rig")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
DOTTED = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)`")
FILE_TYPES = {"py", "ply", "json", "toml", "png", "yml"}
UNSHIPPED = re.compile(r"\bDESIGN\b|\bin the design\b|\b(?!README)\w+\.md\b")
Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _names(body: list[ast.stmt]) -> Iterator[str]:
    """The names that a module or a class defines or imports."""
    for node in body:
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.Import(names=names) | ast.ImportFrom(names=names):
                yield from (each.asname or each.name for each in names)
            case ast.Assign(targets=targets):
                yield from (name.id for each in targets for name in ast.walk(each) if isinstance(name, ast.Name))
            case ast.AnnAssign(target=ast.Name(id=name)):
                yield name
            case ast.If() | ast.Try() | ast.With():
                yield from _names(node.body)


def _module(parts: list[str]) -> Path | None:
    base = ROOT.joinpath(*parts)
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


def _exists(parts: list[str]) -> bool:
    """Whether a module, something in it, or something in a class in it is called so."""
    for length in range(len(parts), 0, -1):
        module = _module(parts[:length])
        if module is not None:
            body = _tree(module).body
            for name in parts[length:]:
                if name not in _names(body):
                    return False
                inside = [node.body for node in body if isinstance(node, ast.ClassDef) and node.name == name]
                if not inside:
                    # An import, or a value: what it has is not to be seen here.
                    return True
                (body,) = inside
            return True
    return False


def _docstrings(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, Documented):
            yield ast.get_docstring(node, clean=False) or ""


def _parameters(tree: ast.Module) -> set[str]:
    return {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}


def _dangling(path: Path) -> Iterator[str]:
    tree = _tree(path)
    for text in _docstrings(tree):
        for name in DOTTED.findall(text):
            first, *rest = parts = name.split(".")
            if first in PACKAGES:
                found = _exists(parts)
            elif rest[-1] in FILE_TYPES or first in _parameters(tree):
                continue
            else:
                # The name of a module beside this one, or in the room that it is in.
                rooms = [list(room.relative_to(ROOT).parts) for room in (path.parent, path.parent.parent)]
                beside = [room for room in rooms if room and _module([*room, first]) is not None]
                found = not beside or any(_exists([*room, *parts]) for room in beside)
            if not found:
                yield f"{path.relative_to(ROOT)}: `{name}`"


@pytest.mark.slow
def test_dotted_names_in_docstrings_are_names_of_something() -> None:
    assert [each for path in SOURCES for each in _dangling(path)] == []


def test_a_name_that_is_not_there_would_be_found() -> None:
    assert _exists(["slrig", "model", "Pinhole"])
    assert _exists(["slrig", "model", "rig", "Pinhole", "centre_mm"])
    assert _exists(["slrig", "jobs", "job", "Job", "conclude"])
    assert not _exists(["slrig", "scan", "work", "Tasks"])
    assert not _exists(["slrig", "model", "rig", "Pinhole", "center_mm"])
    assert not _exists(["slrig", "no_room"])


def test_sources_refer_to_no_document_that_is_not_shipped() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in SOURCES
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if UNSHIPPED.search(line)
    ]
    assert found == []

"""Rules of the house that no linter holds."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import pytest

import slrig.errors
from slrig.cli.rig_schema import rig_schema

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("slrig", "drivers", "simulated_rig") for path in (ROOT / package).rglob("*.py"))
MOST_LINES = 1000
BANNED_NAMES = {"utils", "util", "common", "helpers", "misc"}


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


ERRORS = [
    found
    for _, found in inspect.getmembers(slrig.errors, inspect.isclass)
    if issubclass(found, slrig.errors.SlrigError)
]


def test_there_are_sources_to_look_at() -> None:
    assert len(SOURCES) > 30


def test_a_module_says_what_it_is_for() -> None:
    assert [_name(path) for path in SOURCES if not ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))] == []


def test_a_module_has_one_subject() -> None:
    lengths = {_name(path): len(path.read_text(encoding="utf-8").splitlines()) for path in SOURCES}
    assert {name: lines for name, lines in lengths.items() if lines > MOST_LINES} == {}


def test_a_module_is_named_for_its_subject() -> None:
    named = [path for path in SOURCES if BANNED_NAMES & set(path.relative_to(ROOT).with_suffix("").parts)]
    assert [_name(path) for path in named] == []


def test_kernels_keep_to_the_rules_of_ieee_arithmetic() -> None:
    # Free association or contraction lets a kernel that was compiled just now round otherwise than the same kernel
    # from the cache, and a bundle would no longer give the bytes of its scan.
    assert [_name(path) for path in SOURCES if "fastmath" in path.read_text(encoding="utf-8")] == []


def test_kernels_are_compiled_in_one_way() -> None:
    # numba's parallel loops do not compile on every Python, and its cache is not safe for two processes.
    own = [path for path in SOURCES if re.search(r"\bnjit\b|\bprange\b", path.read_text(encoding="utf-8"))]
    assert [_name(path) for path in own] == ["slrig/kernels.py"]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: error.__name__)
def test_an_error_says_when_to_raise_it(error: type[slrig.errors.SlrigError]) -> None:
    own = error.__dict__.get("__doc__")
    assert own
    assert len(own.split()) >= 5


def test_an_error_has_a_code_of_its_own() -> None:
    # Clients and records know errors by these, whatever becomes of the names of classes.
    codes = {error.__name__: vars(error).get("code") for error in ERRORS}
    assert [name for name, code in codes.items() if not re.fullmatch(r"[a-z]+(-[a-z]+)*", code or "")] == []
    assert len(set(codes.values())) == len(codes)


def test_errors_are_one_tree() -> None:
    tree = set(ERRORS)
    defined = {found for _, found in inspect.getmembers(slrig.errors, inspect.isclass)}
    assert defined == tree
    assert {error.__mro__[-4] for error in tree if error is not slrig.errors.SlrigError} == {slrig.errors.SlrigError}


def test_only_the_rooms_of_the_plan_stand_at_the_top() -> None:
    allowed = {"slrig", "drivers", "simulated_rig", "config", "tests"}
    packages = {path.name for path in ROOT.iterdir() if path.is_dir() and (path / "__init__.py").is_file()}
    assert packages <= allowed


def test_the_schema_of_rig_files_is_current() -> None:
    kept = (ROOT / "config" / "schema.json").read_text(encoding="utf-8")
    assert kept == rig_schema(), "run: python -m slrig.cli.rig_schema > config/schema.json"

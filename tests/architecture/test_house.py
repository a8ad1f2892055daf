"""Rules of the house that no linter checks: sources, errors, names in messages, READMEs and the wheel."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import json
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from zipfile import ZipFile

import pytest
import typer

import slrig.errors
from slrig.cli.commands import app
from slrig.cli.rig_schema import rig_schema
from slrig.errors import setting
from slrig.examples import EXAMPLES as SHIPPED

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("slrig", "drivers", "simulated_rig")
MOST_LINES = 1000
MOST_LINES_OF_THE_FIRST_README = 200
BANNED_NAMES = {"utils", "util", "common", "helpers", "misc"}
DOTTED = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)`")
FILE_TYPES = {"py", "ply", "json", "toml", "png", "yml"}
UNSHIPPED = re.compile(r"\bDESIGN\b|\bin the design\b|\b(?!README)\w+\.md\b")
LINK = re.compile(r"\]\(([^)\s]+)\)")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
# Only a terminal shows these messages: of commands, of the start of the service, and on printed boards.
OF_THE_COMMAND_LINE = (
    "slrig/cli", "slrig/api", "slrig/doctor", "slrig/jobs/data_folder.py", "slrig/jobs/database.py",
    "slrig/calibration/printing.py", "slrig/importers", "slrig/errors.py",
    "slrig/model/plausibility.py",  # names the commands that have the option
    "drivers/screen/randr.py",  # options of xrandr
)  # fmt: skip
OF_OTHER_PROGRAMS = ("v4l2-ctl", "xrandr", "udevadm", "{command}")


@dataclass(frozen=True)
class Source:
    """A file of the product. `name` : its path in the repository."""

    path: Path

    @cached_property
    def name(self) -> str:
        return self.path.relative_to(ROOT).as_posix()

    @cached_property
    def text(self) -> str:
        return self.path.read_text(encoding="utf-8")

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> list[ast.AST]:
        return list(ast.walk(self.tree))


SOURCES = {path: Source(path) for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}
READMES = [
    ROOT / "README.md",
    *(path for each in (*PACKAGES, "config", "tests") for path in (ROOT / each).rglob("README.md")),
]
ERRORS = [error for _, error in inspect.getmembers(slrig.errors, inspect.isclass)]


def test_no_source_is_longer_than_one_subject() -> None:
    assert len(SOURCES) > 30
    lengths = {each.name: len(each.text.splitlines()) for each in SOURCES.values()}
    assert {name: lines for name, lines in lengths.items() if lines > MOST_LINES} == {}


def test_no_source_is_named_for_nothing() -> None:
    assert [each.name for each in SOURCES.values() if BANNED_NAMES & set(Path(each.name).with_suffix("").parts)] == []


def test_kernels_keep_to_ieee_arithmetic() -> None:
    # With free association or contraction, a kernel compiled now may round otherwise than the same kernel from the
    # cache, and a bundle would no longer give the bytes of its scan.
    assert [each.name for each in SOURCES.values() if "fastmath" in each.text] == []


def test_only_one_module_compiles_kernels() -> None:
    # numba's parallel loops do not compile on every Python, and its cache is not safe for two processes.
    own = [each.name for each in SOURCES.values() if re.search(r"\bnjit\b|\bprange\b", each.text)]
    assert own == ["slrig/kernels.py"]


@pytest.mark.slow
def test_every_name_that_a_test_replaces_is_there() -> None:
    # Neither types nor the tests of the core see that a test of a long part replaces a name that moved.
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): each for path, each in SOURCES.items()}
    modules = {name.removesuffix(".__init__"): each for name, each in modules.items()}
    replaced = [
        (f"{path.relative_to(ROOT)}:{line}", module, name)
        for path in sorted((ROOT / "tests").rglob("*.py"))
        if "setattr(" in (text := path.read_text(encoding="utf-8"))
        for line, module, name in _replaced(ast.parse(text))
        if module in modules
    ]
    assert len(replaced) > 50
    assert [where for where, module, name in replaced if name not in _names(modules[module])] == []


def _replaced(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Line, module and name of what a test replaces: `setattr("module.name", …)`, `setattr(module, "name", …)`."""
    imported = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            imported.update({each.asname or each.name: f"{node.module}.{each.name}" for each in node.names})
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr"):
            continue
        match node.args:
            case [ast.Constant(value=str(target)), *_]:
                module, _, name = target.rpartition(".")
                yield node.lineno, module, name
            case [ast.Name(id=alias), ast.Constant(value=str(name)), *_] if alias in imported:
                yield node.lineno, imported[alias], name


def _names(source: Source) -> set[str]:
    """Names at the top of a module, imported ones among them."""
    found = set()
    waiting: list[ast.stmt] = list(source.tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If | ast.Try | ast.With):
            waiting += [each for each in ast.walk(node) if isinstance(each, ast.stmt) and each is not node]
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {(each.asname or each.name).split(".")[0] for each in node.names}
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        else:
            found |= {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
    return found


def test_packages_at_the_top_are_those_of_the_plan() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages <= {*PACKAGES, "config", "tests"}


def test_every_error_has_a_docstring_and_a_code_in_one_tree() -> None:
    # Clients and records know errors by their codes, whatever the names of the classes become.
    codes = [vars(error).get("code", "") for error in ERRORS]
    assert [error for error in ERRORS if not issubclass(error, slrig.errors.SlrigError)] == []
    assert {error.__mro__[-4] for error in ERRORS if error is not slrig.errors.SlrigError} == {slrig.errors.SlrigError}
    assert [error for error in ERRORS if len((vars(error).get("__doc__") or "").split()) < 5] == []
    assert [code for code in codes if not re.fullmatch(r"[a-z]+(-[a-z]+)*", code)] == []
    assert len(set(codes)) == len(codes)


def test_the_schema_of_rig_files_is_current() -> None:
    kept = (SHIPPED / "schema.json").read_text(encoding="utf-8")
    assert kept == rig_schema(), "run: python -m slrig.cli.rig_schema > slrig/examples/schema.json"


def flags() -> set[str]:
    """Every long option of every command."""
    found: set[str] = set()
    waiting = [typer.main.get_command(app)]
    while waiting:
        command = waiting.pop()
        waiting += getattr(command, "commands", {}).values()
        found |= {each for option in command.params for each in (*option.opts, *option.secondary_opts)}
    return found


def keys() -> set[str]:
    """Every key of a request or a rig file."""
    found: set[str] = set()
    waiting = [json.loads(path.read_text()) for path in (ROOT / "config" / "openapi.json", SHIPPED / "schema.json")]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict):
            found |= set(each.get("properties", {}))
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each
    return found


def test_a_setting_in_a_message_is_a_key_and_its_flag_an_option() -> None:
    nodes = (node for each in SOURCES.values() if "setting(" in each.text for node in each.nodes)
    calls = [node for node in nodes if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "setting"]
    named = {str(ast.literal_eval(call.args[0])) for call in calls}
    assert named >= {"gray_cell_px", "rows", "corners"}
    assert named <= keys()
    assert {flag for name in named for flag in FLAG.findall(setting(name))} <= flags()
    assert all(len(FLAG.findall(setting(name))) == 1 for name in named)


def test_no_message_for_terminal_and_client_names_a_flag_by_hand() -> None:
    wrong, known = [], flags()
    for source in SOURCES.values():
        if not FLAG.search(source.text) or source.name.startswith(("simulated_rig", *OF_THE_COMMAND_LINE)):
            continue
        lines = source.text.splitlines()
        documents = {id(node.body[0].value) for node in source.nodes
                     if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
                     and node.body and isinstance(node.body[0], ast.Expr)}  # fmt: skip
        for node in source.nodes:
            if isinstance(node, ast.JoinedStr | ast.Constant) and id(node) not in documents:
                if not any("--" in line for line in lines[node.lineno - 1 : node.end_lineno]):
                    continue
                text = ast.unparse(node)
                mine = [flag for flag in FLAG.findall(text) if flag in known]
                if mine and not any(each in text for each in OF_OTHER_PROGRAMS):
                    wrong.append(f"{source.name}:{node.lineno}: {mine}")
    assert wrong == []


def names(body: list[ast.stmt]) -> Iterator[str]:
    """The names that a module or a class defines or imports."""
    for node in body:
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.Import(names=imported) | ast.ImportFrom(names=imported):
                yield from (each.asname or each.name for each in imported)
            case ast.Assign(targets=targets):
                yield from (name.id for each in targets for name in ast.walk(each) if isinstance(name, ast.Name))
            case ast.AnnAssign(target=ast.Name(id=name)):
                yield name
            case ast.If() | ast.Try() | ast.With():
                yield from names(node.body)


def module(parts: list[str]) -> Source | None:
    base = ROOT.joinpath(*parts)
    return SOURCES.get(base.with_suffix(".py")) or SOURCES.get(base / "__init__.py")


def exists(parts: list[str]) -> bool:
    """Whether a module, something in it, or something in a class in it has this name."""
    for length in range(len(parts), 0, -1):
        found = module(parts[:length])
        if found is not None:
            body = found.tree.body
            for name in parts[length:]:
                if name not in names(body):
                    return False
                inside = [node.body for node in body if isinstance(node, ast.ClassDef) and node.name == name]
                if not inside:
                    # An import or a value: this file does not say what it has.
                    return True
                (body,) = inside
            return True
    return False


def dangling(source: Source) -> Iterator[str]:
    """The dotted names in docstrings of a file that name nothing."""
    if not DOTTED.search(source.text):
        return
    parameters = {node.arg for node in source.nodes if isinstance(node, ast.arg)}
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    texts = [ast.get_docstring(node, clean=False) or "" for node in source.nodes if isinstance(node, documented)]
    for name in (name for text in texts for name in DOTTED.findall(text)):
        first, *rest = parts = name.split(".")
        if first in PACKAGES:
            found = exists(parts)
        elif rest[-1] in FILE_TYPES or first in parameters:
            continue
        else:
            # The name of a module in the same room, or in the room around it.
            rooms = [list(room.relative_to(ROOT).parts) for room in (source.path.parent, source.path.parent.parent)]
            near = [room for room in rooms if room and module([*room, first]) is not None]
            found = not near or any(exists([*room, *parts]) for room in near)
        if not found:
            yield f"{source.name}: `{name}`"


@pytest.mark.slow
def test_dotted_names_in_docstrings_exist() -> None:
    assert exists(["slrig", "model", "Pinhole"])
    assert exists(["slrig", "model", "geometry", "Pinhole", "centre_mm"])
    assert not exists(["slrig", "model", "geometry", "Pinhole", "center_mm"])
    assert not exists(["slrig", "no_room"])
    assert [each for source in SOURCES.values() for each in dangling(source)] == []


def test_sources_refer_to_no_document_outside_the_package() -> None:
    assert [f"{each.name}: {line}" for each in SOURCES.values() for line in each.text.splitlines()
            if UNSHIPPED.search(line)] == []  # fmt: skip


def anchors(path: Path) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_in_readmes_lead_somewhere_and_the_first_links_to_all_others() -> None:
    lost, linked = [], set()
    for readme in READMES:
        for link in LINK.findall(readme.read_text(encoding="utf-8")):
            place, _, anchor = link.partition("#")
            target = readme if not place else (readme.parent / place).resolve()
            if "://" not in place and (not target.exists() or (anchor and anchor not in anchors(target))):
                lost.append(f"{readme}: {link}")
            if readme == READMES[0]:
                linked.add(target)
    assert lost == []
    assert [path for path in READMES[1:] if path not in linked] == []


def test_files_of_tests_that_are_named_exist() -> None:
    texts = [path.read_text(encoding="utf-8") for path in [*READMES, *(ROOT / "tests").rglob("*.py")]]
    named = {name for text in texts for name in re.findall(r"\btests/[\w/]+\.(?:py|png|md)", text)}
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_the_first_readme_is_short() -> None:
    assert len(READMES[0].read_text(encoding="utf-8").splitlines()) <= MOST_LINES_OF_THE_FIRST_README


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, built in a copy."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, folder)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-c", "from setuptools.build_meta import build_wheel; build_wheel('.')"]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)  # noqa: S603
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_template(wheel: Path) -> None:
    held = set(ZipFile(wheel).namelist())
    kinds = {".py", ".html", ".css", ".js", ".svg"}
    needed = {path.relative_to(ROOT).as_posix() for package in PACKAGES for path in (ROOT / package).rglob("*.*")
              if path.suffix in kinds}  # fmt: skip
    assert "slrig/reports/templates/report.html" in needed
    assert needed - held == set()


# ---- An installed wheel: its types reach the type checker of another project


PROGRAM = """
from slrig.client import Client
from slrig.devices import Camera

result = Client().scan(label="cup", exposure_s=0.01)
reveal_type(result.points_mm)
reveal_type(result.causes)
Client().scan(exposure="bright")
Client().scans.get(7)
"""


@pytest.mark.slow
def test_a_scan_is_typed_in_another_project(wheel: Path, tmp_path: Path) -> None:
    pytest.importorskip("mypy", reason="needs mypy: pip install -e '.[lint]'")
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)  # noqa: S603
    site = next(environment.glob("lib/python*/site-packages"))
    ZipFile(wheel).extractall(site)
    # numpy and httpx2 come from where the tests run.
    (site / "others.pth").write_text(sysconfig.get_paths()["purelib"])
    (tmp_path / "program.py").write_text(PROGRAM)
    checked = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "mypy", "--strict", "--python-executable", environment / "bin" / "python", "program.py"],
        cwd=tmp_path,
        env={"PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = checked.stdout.splitlines()
    revealed = [line for line in lines if "Revealed type" in line]
    assert "ndarray" in revealed[0], checked.stdout
    assert "float" in revealed[0]
    assert "tuple[" in revealed[1]
    faults = [line for line in lines if "error:" in line]
    assert len(faults) == 2, checked.stdout
    assert 'Unexpected keyword argument "exposure"' in faults[0]
    assert 'expected "str"' in faults[1]


# ---- The examples in docstrings

EXAMPLES = sorted(
    ".".join(Path(each.name).with_suffix("").parts).removesuffix(".__init__")
    for each in SOURCES.values()
    if ">>>" in each.text
)


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples(name: str) -> None:
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0

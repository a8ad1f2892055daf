"""OpenCV's FileStorage, read: the part of its YAML and XML that calibrations are written in, and nothing else.

OpenCV's own reader is not for files of strangers: a short file can make it write outside its memory. This one knows
maps, text, numbers and dense matrices of `d`, `f` or `i` with one channel. It keeps to its limits before it builds
anything, and calls itself nowhere, so that no file is too deep for it. Everything else is refused with its line.
OpenCV 5 writes an array of one dimension as an `opencv-nd-matrix` of one size; that is read, more sizes are not.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NoReturn, TypeAlias
from xml.parsers import expat

import numpy as np

from slrig.bundle.faults import shorten
from slrig.errors import CalibrationError
from slrig.model import FloatArray

MOST_DEPTH = 8
MOST_NODES = 4096
MOST_NUMBERS = 2**16
"""Of one matrix: the covariance of 16 devices has 57 600."""

Value: TypeAlias = "dict[str, Value] | FloatArray | list[str | int | float] | str | int | float"

_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,63}")
_INT = re.compile(r"[+-]?(?:0|[1-9][0-9]{0,18})")
_REAL = re.compile(r"[+-]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))(?:[eE][+-]?[0-9]{1,5})?")
_SPECIAL = {".nan": np.nan, ".inf": np.inf, "+.inf": np.inf, "-.inf": -np.inf}
_MATRIX_KEYS = {
    "opencv-matrix": {"rows", "cols", "dt", "data"},
    "opencv-nd-matrix": {"sizes", "dt", "data"},
}
_KINDS = {"d": np.float64, "f": np.float32, "i": np.int32}
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")
_YAML_HEAD = re.compile(r"%YAML[: ]1\.[0-9]")
_YAML_ENTRY = re.compile(r"( *)([^\s:]+):(?:[ \t]+(.*))?")
_QUOTED = re.compile(r'"((?:[^"\\]|\\.)*)"|\'((?:[^\']|\'\')*)\'')
_COMMENT = re.compile(r"[ \t]*(?:#.*)?")
_ESCAPE = re.compile(r"\\(x[0-9A-Fa-f]{2}|.)")
_ESCAPED = {"n": "\n", "r": "\r", "t": "\t", "0": "\0"}


def read_file_storage(text: str, path: Path) -> dict[str, Value]:
    """Return the maps, numbers, texts and matrices (float64) of a FileStorage text; `path` is for messages.
    Raises CalibrationError, with the line: the text is cut, of another layout, or beyond a limit.
    """
    tree = _Tree(path)
    text = text.removeprefix("\ufeff")
    control = _CONTROL.search(text)
    if control:
        tree.line = text.count("\n", 0, control.start()) + 1
        tree.refuse("text", f"the control character {control[0]!r}")
    if text.startswith("<"):
        _read_xml(text, tree)
    elif text.startswith("%YAML"):
        _read_yaml(text.split("\n"), tree)
    else:
        tree.refuse("OpenCV FileStorage, which begins with %YAML or <", shorten(text[:40]))
    return tree.root


class _Tree:
    """What was read so far, by map, with the limits. `line` is where the reader stands."""

    def __init__(self, path: Path) -> None:
        self.root: dict[str, Value] = {}
        self.line = 1
        self._path = path
        self._open: list[tuple[str, str, dict[str, Value], int]] = [("", "", self.root, 1)]
        self._nodes = 0

    @property
    def depth(self) -> int:
        """How many maps are open, beside the root."""
        return len(self._open) - 1

    def refuse(self, expected: str, found: str, remedy: str = "export it again") -> NoReturn:
        raise CalibrationError(f"{self._path}: expected {expected}, found {found} at line {self.line}; {remedy}")

    def open(self, key: str, kind: str) -> None:
        """Begin a map; `kind` is empty, or that of a matrix."""
        if self.depth >= MOST_DEPTH:
            self.refuse(f"at most {MOST_DEPTH} maps in each other", "another one")
        if kind and kind not in _MATRIX_KEYS:
            self.refuse("an opencv-matrix", shorten(kind), "export matrices of numbers only")
        self._check(key)
        self._open.append((key, kind, {}, self.line))

    def add(self, key: str, value: Value) -> None:
        """Put a value into the map that was begun last."""
        self._check(key)
        self._open[-1][2][key] = value

    def close(self) -> None:
        """End the map that was begun last."""
        key, kind, found, opened = self._open.pop()
        # What is wrong with a matrix shows at its end, which may be the line of another key.
        line, self.line = self.line, opened
        self._open[-1][2][key] = self._matrix(key, kind, found) if kind else found
        self.line = line

    def _check(self, key: str) -> None:
        self._nodes += 1
        if self._nodes > MOST_NODES:
            self.refuse(f"at most {MOST_NODES} entries", "more", "leave out all but the calibration")
        if not _KEY.fullmatch(key):
            self.refuse("a key of at most 64 letters, digits, - and _", shorten(key), "rename it")
        if key in self._open[-1][2]:
            self.refuse("each key once in a map", f"'{key}' twice", "keep one of them")

    def _matrix(self, key: str, kind: str, found: dict[str, Value]) -> FloatArray:
        if set(found) != _MATRIX_KEYS[kind]:
            self.refuse(f"{', '.join(sorted(_MATRIX_KEYS[kind]))} in '{key}'", f"{', '.join(sorted(found)[:8])}")
        shape = [found[name] for name in ("rows", "cols", "sizes") if name in found]
        shape = [part[0] if isinstance(part, list) and len(part) == 1 else part for part in shape]
        sides = [part for part in shape if isinstance(part, int) and 1 <= part <= MOST_NUMBERS]
        if len(sides) != len(shape):
            self.refuse(f"whole numbers from 1 as extent of '{key}', two of them at most", shorten(shape))
        dt = str(found["dt"]).removeprefix("1") if isinstance(found["dt"], str) else ""
        if dt not in _KINDS:
            self.refuse(f"d, f or i as dt of '{key}'", shorten(found["dt"]), "export it with one channel of numbers")
        data = found["data"] if isinstance(found["data"], list) else [found["data"]]
        count = int(np.prod(sides, dtype=np.int64))
        if len(data) != count:
            self.refuse(f"{count} numbers as data of '{key}'", f"{len(data)}")
        most = 2**31
        wrong = [
            each
            for each in data
            if not isinstance(each, int if dt == "i" else int | float) or (dt == "i" and not -most <= each < most)
        ]
        if wrong:
            self.refuse(f"numbers of the kind '{dt}' as data of '{key}'", shorten(wrong[0]))
        with np.errstate(over="ignore"):
            return np.array(data, dtype=_KINDS[dt]).astype(np.float64).reshape(sides)

    def scalar(self, word: str) -> str | int | float:
        """What an unquoted word stands for."""
        if _INT.fullmatch(word):
            return int(word)
        if _REAL.fullmatch(word):
            return float(word)
        return _SPECIAL.get(word.lower(), word)

    def scalars(self, words: list[str]) -> list[str | int | float]:
        """What the words of a sequence stand for."""
        if len(words) > MOST_NUMBERS:
            self.refuse(f"at most {MOST_NUMBERS} numbers in a matrix", f"{len(words)}")
        return [self.scalar(word.strip()) for word in words]


def _read_yaml(lines: list[str], tree: _Tree) -> None:
    if not _YAML_HEAD.fullmatch(lines[0].rstrip()):
        tree.refuse("%YAML:1.0 or %YAML 1.2", shorten(lines[0]))
    columns = [-1]
    """Where the keys of each open map begin; that of one just opened is that of its opener until its first key."""
    opener: int | None = None
    place = 1
    while place < len(lines):
        line, tree.line, place = lines[place].rstrip("\r"), place + 1, place + 1
        if _COMMENT.fullmatch(line) or (line.rstrip() == "---" and not tree.root and not tree.depth):
            continue
        if line.rstrip() == "..." and not any(map(str.strip, lines[place:])):
            break
        entry = _YAML_ENTRY.fullmatch(line)
        if entry is None:
            tree.refuse("`key: value`, indented with spaces", shorten(line), "write maps and opencv-matrices only")
        column, key, rest = len(entry[1]), entry[2], entry[3] or ""
        if opener is not None and column > opener:
            columns.append(column)
        elif opener is not None:
            tree.close()
        elif columns == [-1]:
            columns = [column]
        opener = None
        while column < columns[-1] and len(columns) > 1:
            columns.pop()
            tree.close()
        if column != columns[-1]:
            tree.refuse(
                "a key below that of its map", f"'{key[:64]}' in column {column + 1}", "indent it as the others"
            )
        if _COMMENT.fullmatch(rest) or rest.startswith("!!"):
            tree.open(key, rest[2:].partition("#")[0].strip() or "!!" if rest.startswith("!!") else "")
            opener = column
        elif rest.startswith("["):
            first = place
            while "]" not in lines[place - 1] and place < len(lines):
                place += 1
            parts = [rest, *lines[first:place]]
            body, end, after = " ".join(part.rstrip("\r").split(" #")[0] for part in parts).partition("]")
            tree.line = place
            if not end or not _COMMENT.fullmatch(after):
                tree.refuse("a sequence that ends in ]", "none that does", "the file may be cut: copy it again")
            tree.add(key, tree.scalars(body[1:].split(",") if body[1:].strip() else []))
        else:
            tree.add(key, _yaml_scalar(rest, tree))
    for _ in range(tree.depth):
        tree.close()


def _yaml_scalar(rest: str, tree: _Tree) -> str | int | float:
    quoted = _QUOTED.match(rest)
    if quoted and _COMMENT.fullmatch(rest, quoted.end()):
        if quoted[1] is None:
            return quoted[2].replace("''", "'")
        return _ESCAPE.sub(lambda e: chr(int(e[1][1:], 16)) if len(e[1]) > 1 else _ESCAPED.get(e[1], e[1]), quoted[1])
    if rest[0] in "\"'{}[]&*!|>%@`?,":
        tree.refuse("a number, text or an opencv-matrix", shorten(rest), "write nothing else")
    return tree.scalar(re.split(r"[ \t]#", rest, maxsplit=1)[0].strip())


def _read_xml(text: str, tree: _Tree) -> None:
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    # One for each open element: its key, its type, what text it holds, and whether it holds elements.
    elements: list[list[Any]] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        tree.line = parser.CurrentLineNumber
        if set(attributes) - {"type_id"}:
            tree.refuse("no attribute but type_id", shorten(sorted(attributes)[0]), "leave it out")
        if not elements:
            if name != "opencv_storage":
                tree.refuse("<opencv_storage>", shorten(name))
        elif len(elements) > MOST_DEPTH + 1:
            tree.refuse(f"at most {MOST_DEPTH} maps in each other", "another one")
        else:
            parent = elements[-1]
            if "".join(parent[2]).strip():
                tree.refuse("a map or text", "both in one element")
            if len(elements) > 1 and not parent[3]:
                tree.open(parent[0], parent[1])
            parent[3] = True
        elements.append([name, attributes.get("type_id", ""), [], False])

    def end(_: str) -> None:
        tree.line = parser.CurrentLineNumber
        key, kind, parts, holds_elements = elements.pop()
        text = "".join(parts).strip(" \t\r\n")
        if holds_elements or not elements:
            if text:
                tree.refuse("a map or text", "both in one element")
            if elements:
                tree.close()
        elif kind:
            tree.refuse("an opencv-matrix with rows, cols, dt and data", shorten(kind))
        elif text.startswith('"'):
            if len(text) < 2 or not text.endswith('"'):
                tree.refuse("one quoted text", shorten(text))
            tree.add(key, text[1:-1])
        else:
            words = text.split()
            tree.add(key, tree.scalar(words[0]) if len(words) == 1 else tree.scalars(words))

    def refuse_kind(*_: object) -> None:
        tree.line = parser.CurrentLineNumber
        tree.refuse("elements, text and comments", "a document type, an entity or an instruction", "leave it out")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = lambda data: elements[-1][2].append(data)
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = parser.ProcessingInstructionHandler = refuse_kind
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as cause:
        tree.line = cause.lineno
        tree.refuse("sound XML", expat.ErrorString(cause.code) or "a fault", "the file may be cut: copy it again")

"""OpenCV's FileStorage (YAML, XML), read by a small parser of its own.

OpenCV's reader is unsafe for files from others: a short file can make it write outside its memory. PyYAML's pure Python
parser takes seconds for a large covariance, and refuses what OpenCV writes: `%YAML:1.0`, `{ x:1 }`. This reader knows
the format whole: maps, sequences of any items, in blocks and in one line, text, numbers, and dense matrices of any kind
and number of channels, also empty ones. It checks its limits before it builds anything. Anchors, documents behind the
first, and entities of XML are refused with the line number.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, NoReturn, TypeAlias
from xml.parsers import expat

import numpy as np

from slrig.bundle.validation import shorten
from slrig.errors import CalibrationError
from slrig.model import FloatArray

MAX_STORAGE_BYTES = 4 * 2**20
MAX_DEPTH = 16
MAX_NODES = 2**16
MAX_NUMBERS = 2**16
"""Numbers of one matrix or sequence: the covariance of 16 devices has 57 600."""

Value: TypeAlias = "dict[str, Value] | list[Value] | FloatArray | str | int | float"

_KEY = re.compile(r"[^\s\x00-\x1f:<>&\"']{1,64}")
_INT = re.compile(r"[+-]?(?:0|[1-9][0-9]{0,18})")
_REAL = re.compile(r"[+-]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))(?:[eE][+-]?[0-9]{1,5})?")
_SPECIAL = {".nan": np.nan, ".inf": np.inf, "+.inf": np.inf, "-.inf": -np.inf}
_MATRIX_KEYS = {
    "opencv-matrix": {"rows", "cols", "dt", "data"},
    "opencv-nd-matrix": {"sizes", "dt", "data"},
}
_DT = re.compile(r"([1-9][0-9]{0,2})?([ucwsifdhr])")
_MAX_SIZES = 32
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")
_YAML_HEAD = re.compile(r"%YAML[: ]1\.[0-9]")
_YAML_ENTRY = re.compile(r"(\"(?:[^\"\\]|\\.)*\"|'(?:[^']|'')*'|[^\s:\"'\[{][^:]*):(?:[ \t]+(.*))?")
_YAML_TAG = re.compile(r"!!([^\s,\[\]{}]*)[ \t]*")
_QUOTED = re.compile(r'"((?:[^"\\]|\\.)*)"|\'((?:[^\']|\'\')*)\'')
_COMMENT = re.compile(r"[ \t]*(?:#.*)?")
_FLOW = re.compile(r"[ \t]+(?:#.*)?|([\[\]{},])|(\"(?:[^\"\\]|\\.)*\"|'(?:[^']|'')*')|([^\[\]{},\s\"'][^\[\]{},]*)")
_ESCAPE = re.compile(r"\\(x[0-9A-Fa-f]{2}|.)")
_ESCAPED = {"n": "\n", "r": "\r", "t": "\t", "0": "\0"}
_XML_WORD = re.compile(r'"[^"]*"|[^\s"]+')
_XML_WORDS = re.compile(rf"(?:{_XML_WORD.pattern})(?:\s+(?:{_XML_WORD.pattern}))*")


def read_file_storage(text: str, path: Path) -> dict[str, Value]:
    """Return the maps, sequences, numbers, texts and matrices (float64) of a FileStorage text; `path` is for messages.
    A matrix of several channels has one dimension more. Raises CalibrationError, with the line: the text is cut, of
    another layout, or beyond a limit.
    """
    storage = _Storage(path)
    text = text.removeprefix("\ufeff")
    control = _CONTROL.search(text)
    if control:
        storage.line = text.count("\n", 0, control.start()) + 1
        storage.refuse("text", f"the control character {control[0]!r}")
    if text.startswith("<"):
        return _read_xml(text, storage)
    if not text.startswith("%YAML"):
        storage.refuse("OpenCV FileStorage, which begins with %YAML or <", shorten(text[:40]))
    return _Yaml(text.split("\n"), storage).read()


class _Storage:
    """Limits and conversions that both notations share. `line` is the reader's present line."""

    def __init__(self, path: Path) -> None:
        self.line = 1
        self._path = path
        self._nodes = 0

    def refuse(self, expected: str, found: str, remedy: str = "export it again") -> NoReturn:
        raise CalibrationError(f"{self._path}: expected {expected}, found {found} at line {self.line}; {remedy}")

    def require_depth(self, depth: int) -> None:
        if depth > MAX_DEPTH:
            self.refuse(f"at most {MAX_DEPTH} maps and sequences in each other", "another one")

    def count_node(self) -> None:
        self._nodes += 1
        if self._nodes > MAX_NODES:
            self.refuse(f"at most {MAX_NODES} entries", "more", "leave out all but the calibration")

    def require_key(self, key: str, known: dict[str, Any]) -> None:
        """Count and check a key of a map. Raises CalibrationError."""
        self.count_node()
        if not _KEY.fullmatch(key):
            self.refuse("a key of at most 64 characters without spaces", shorten(key), "rename it")
        if key in known:
            self.refuse("each key once in a map", f"'{key}' twice", "keep one of them")

    def matrix(self, key: str, kind: str, value: Value, opening_line: int) -> FloatArray:
        """Return the array of a map with the type of a matrix; its faults have the line where it begins."""
        line, self.line = self.line, opening_line
        entries = value if isinstance(value, dict) else {}
        if set(entries) != _MATRIX_KEYS[kind]:
            self.refuse(f"{', '.join(sorted(_MATRIX_KEYS[kind]))} in '{key}'", f"{', '.join(sorted(entries)[:8])}")
        sizes = entries.get("sizes", [entries.get("rows", 0), entries.get("cols", 0)])
        sizes = sizes if isinstance(sizes, list) else [sizes]
        sides = [side for side in sizes if isinstance(side, int) and 0 <= side <= MAX_NUMBERS]
        if len(sides) != len(sizes) or len(sizes) > _MAX_SIZES:
            self.refuse(f"whole numbers from 0 as extent of '{key}', {_MAX_SIZES} at most", shorten(sizes))
        dt = _DT.fullmatch(str(entries["dt"]))
        if dt is None:
            self.refuse(f"u, c, w, s, i, f or d as dt of '{key}'", shorten(entries["dt"]))
        channels = int(dt[1] or 1)
        data = entries["data"] if isinstance(entries["data"], list) else [entries["data"]]
        # An element without text is an empty map.
        data = [] if data == [{}] else data
        count = math.prod(sides) * channels
        if len(data) != count:
            self.refuse(f"{count} numbers as data of '{key}'", f"{len(data)}")
        whole = dt[2] not in "fdh"
        limit = 2**31
        wrong = [
            each
            for each in data
            if not isinstance(each, int if whole else int | float) or (whole and not -limit <= each < limit)
        ]
        if wrong:
            self.refuse(f"numbers of the kind '{dt[2]}' as data of '{key}'", shorten(wrong[0]))
        self.line = line
        with np.errstate(over="ignore"):
            array = np.array(data, dtype=np.float32 if dt[2] == "f" else np.float64).astype(np.float64)
        return array.reshape([*sides, channels] if channels > 1 else sides)

    def scalar(self, word: str) -> str | int | float:
        """Return the value of an unquoted word."""
        if _INT.fullmatch(word):
            return int(word)
        if _REAL.fullmatch(word):
            return float(word)
        return _SPECIAL.get(word.lower(), word)

    def scalars(self, words: list[str]) -> list[Value]:
        """Return the values of the words of a sequence."""
        if len(words) > MAX_NUMBERS:
            self.refuse(f"at most {MAX_NUMBERS} numbers in a matrix", f"{len(words)}")
        return [self.scalar(word.strip()) for word in words]


class _Yaml:
    """Reads blocks by their indentation. A line has its number, its column and its text."""

    def __init__(self, lines: list[str], storage: _Storage) -> None:
        self._storage = storage
        if not _YAML_HEAD.fullmatch(lines[0].rstrip()):
            storage.refuse("%YAML:1.0 or %YAML 1.2", shorten(lines[0]))
        self._lines: list[tuple[int, int, str]] = []
        for number, line in enumerate(lines[1:], 2):
            text = line.rstrip("\r \t")
            if _COMMENT.fullmatch(text) or (text == "---" and not self._lines):
                continue
            if text == "..." and not any(map(str.strip, lines[number:])):
                break
            self._lines.append((number, len(text) - len(text.lstrip(" ")), text.lstrip(" ")))
        self._at = 0

    def read(self) -> dict[str, Value]:
        """Return the map of the whole document."""
        found = self._map(self._lines[0][1], 0) if self._lines else {}
        if self._at < len(self._lines):
            self._refuse_line()
        return found

    def _refuse_line(self) -> NoReturn:
        self._storage.line, _, text = self._lines[self._at]
        self._storage.refuse("`key: value`, indented with spaces", shorten(text), "write what OpenCV writes")

    def _block(self, key: str, depth: int) -> Value:
        """Return the map, the sequence or the value that begins in the present line."""
        _, column, text = self._lines[self._at]
        if text == "-" or text.startswith("- "):
            return self._sequence(key, column, depth)
        if _YAML_ENTRY.fullmatch(text):
            return self._map(column, depth)
        return self._value(key, text, column, depth)

    def _map(self, column: int, depth: int) -> dict[str, Value]:
        self._storage.require_depth(depth)
        entries: dict[str, Value] = {}
        while self._at < len(self._lines) and self._lines[self._at][1] >= column:
            self._storage.line, found, text = self._lines[self._at]
            entry = _YAML_ENTRY.fullmatch(text)
            if entry is None or text.startswith("- "):
                self._refuse_line()
            key = str(self._text(entry[1])) if entry[1][0] in "\"'" else entry[1]
            if found != column:
                place = f"'{key[:64]}' in column {found + 1}"
                self._storage.refuse("a key below that of its map", place, "indent it as the others")
            self._storage.require_key(key, entries)
            entries[key] = self._value(key, entry[2] or "", column, depth)
        return entries

    def _sequence(self, key: str, column: int, depth: int) -> list[Value]:
        self._storage.require_depth(depth)
        items: list[Value] = []
        while self._at < len(self._lines) and self._lines[self._at][1] >= column:
            number, found, text = self._lines[self._at]
            if found != column or not (text == "-" or text.startswith("- ")):
                if found == column:
                    break
                self._refuse_line()
            self._storage.line = number
            self._storage.count_node()
            rest = text[1:].lstrip(" ")
            if _YAML_ENTRY.fullmatch(rest) or rest.startswith("- "):
                # The item begins in the line of its dash.
                self._lines[self._at] = (number, column + len(text) - len(rest), rest)
                items.append(self._block(key, depth + 1))
            else:
                items.append(self._value(key, rest, column, depth))
        return items

    def _value(self, key: str, text: str, column: int, depth: int) -> Value:
        """Return what follows a key or a dash in the present line, and in those below that belong to it."""
        opening_line = self._storage.line = self._lines[self._at][0]
        tag = _YAML_TAG.match(text)
        kind, rest = (tag[1], text[tag.end() :]) if tag else ("", text)
        if _COMMENT.fullmatch(rest) or rest[0] in "|>":
            value = self._below(key, column, depth, as_text=rest[:1] in ("|", ">"))
        elif rest[0] in "[{":
            value = self._flow(rest, depth + 1)
        else:
            value = self._text(rest)
            self._at += 1
        return self._storage.matrix(key, kind, value, opening_line) if kind in _MATRIX_KEYS else value

    def _below(self, key: str, column: int, depth: int, *, as_text: bool) -> Value:
        """Return the block in the lines below, which are deeper; an empty map if there is none."""
        self._at += 1
        if as_text:
            first = self._at
            while self._at < len(self._lines) and self._lines[self._at][1] > column:
                self._at += 1
            return "\n".join(text for _, _, text in self._lines[first : self._at])
        if self._at == len(self._lines):
            return {}
        _, found, text = self._lines[self._at]
        is_item = text == "-" or text.startswith("- ")
        return self._block(key, depth + 1) if found > column or (found == column and is_item and key) else {}

    def _flow(self, text: str, depth: int) -> Value:
        """Return a sequence or a map in brackets, which may take several lines."""
        if text[0] == "[":
            # Long rows of numbers, without anything in them.
            last = self._at
            while "]" not in (text if last == self._at else self._lines[last][2]) and last + 1 < len(self._lines):
                last += 1
            parts = [text, *(line for _, _, line in self._lines[self._at + 1 : last + 1])]
            body, end, after = " ".join(part.split(" #")[0] for part in parts)[1:].partition("]")
            if end and not re.search(r"[\[{\"']", body) and _COMMENT.fullmatch(after):
                self._storage.line, self._at = self._lines[last][0], last + 1
                return self._storage.scalars(body.rstrip(" ,").split(",") if body.strip(" ,") else [])
        return self._nested_flow(text, depth)

    def _nested_flow(self, text: str, depth: int) -> Value:
        open_: list[tuple[list[Value] | dict[str, Value], str]] = []
        key = ""

        def add(value: Value) -> None:
            nonlocal key
            self._storage.count_node()
            container = open_[-1][0]
            if isinstance(container, list):
                container.append(value)
            else:
                self._storage.require_key(key, container)
                container[key], key = value, ""

        while True:
            at = 0
            while at < len(text):
                token = _FLOW.match(text, at)
                if token is None:
                    self._storage.refuse("a number, text, a sequence or a map", shorten(text[at:]))
                at = token.end()
                mark, quoted, plain = token.groups()
                if mark and mark in "[{":
                    self._storage.require_depth(depth + len(open_))
                    open_.append(([] if mark == "[" else {}, key))
                    key = ""
                elif mark and mark in "]}":
                    container, key = open_.pop()
                    if (mark == "]") != isinstance(container, list):
                        self._storage.refuse("brackets that close as they open", f"'{mark}'")
                    if open_:
                        add(container)
                        continue
                    if not _COMMENT.fullmatch(text, at):
                        self._storage.refuse("nothing behind the end of a sequence", shorten(text[at:]))
                    self._at += 1
                    return container
                elif plain and isinstance(open_[-1][0], dict):
                    # OpenCV writes `{ x:1 }`, other programs `{ "x": 1 }`: the name may stand before the colon.
                    name, _, plain = plain.partition(":")
                    key = key or name.strip()
                    if plain.strip():
                        add(self._text(plain.strip()))
                elif quoted and isinstance(open_[-1][0], dict) and not key:
                    key = str(self._text(quoted))
                elif plain or quoted:
                    add(self._text((plain or quoted).rstrip()))
            self._at += 1
            if self._at == len(self._lines):
                self._storage.refuse(
                    "a sequence that ends in ]", "none that does", "the file may be cut: copy it again"
                )
            self._storage.line, _, text = self._lines[self._at]

    def _text(self, text: str) -> str | int | float:
        quoted = _QUOTED.match(text)
        if quoted and _COMMENT.fullmatch(text, quoted.end()):
            if quoted[1] is None:
                return quoted[2].replace("''", "'")
            return _ESCAPE.sub(
                lambda e: chr(int(e[1][1:], 16)) if len(e[1]) > 1 else _ESCAPED.get(e[1], e[1]), quoted[1]
            )
        if text[0] in "\"'{}[]&*!|>%@`?,":
            self._storage.refuse("a number, text or an opencv-matrix", shorten(text), "write nothing else")
        return self._storage.scalar(re.split(r"[ \t]#", text, maxsplit=1)[0].strip())


class _Element:
    """An open element of XML: text that is not yet read, and what it holds."""

    def __init__(self, key: str, kind: str, line: int) -> None:
        self.key, self.kind, self.line = key, kind, line
        self.parts: list[str] = []
        self.items: list[Value] = []
        self.entries: dict[str, Value] = {}


def _read_xml(text: str, storage: _Storage) -> dict[str, Value]:
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    elements: list[_Element] = []
    root: dict[str, Value] = {}

    def start(name: str, attributes: dict[str, str]) -> None:
        storage.line = parser.CurrentLineNumber
        if set(attributes) - {"type_id"}:
            storage.refuse("no attribute but type_id", shorten(sorted(attributes)[0]), "leave it out")
        if not elements and name != "opencv_storage":
            storage.refuse("<opencv_storage>", shorten(name))
        storage.require_depth(len(elements) - 1)
        if elements:
            parent = elements[-1]
            if name == "_":
                # Words and elements of a sequence alternate.
                parent.items += _xml_words("".join(parent.parts), storage)
                parent.parts = []
                storage.count_node()
            else:
                storage.require_key(name, parent.entries)
        elements.append(_Element(name, attributes.get("type_id", ""), storage.line))

    def end(_: str) -> None:
        storage.line = parser.CurrentLineNumber
        element = elements.pop()
        words = _xml_words("".join(element.parts), storage)
        if (element.entries or not elements) and (words or element.items):
            storage.refuse("a map or text", "both in one element")
        value: Value = element.entries
        if element.items or len(words) > 1 or element.kind == "seq":
            value = element.items + words
        elif words:
            value = words[0]
        if element.kind in _MATRIX_KEYS:
            if not element.entries:
                storage.refuse("an opencv-matrix with rows, cols, dt and data", shorten(element.kind))
            value = storage.matrix(element.key, element.kind, value, element.line)
        if not elements:
            root.update(element.entries)
        elif element.key == "_":
            elements[-1].items.append(value)
        else:
            elements[-1].entries[element.key] = value

    def refuse_kind(*_: object) -> None:
        storage.line = parser.CurrentLineNumber
        storage.refuse("elements, text and comments", "a document type, an entity or an instruction", "leave it out")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = lambda data: elements[-1].parts.append(data)
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = parser.ProcessingInstructionHandler = refuse_kind
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as cause:
        storage.line = cause.lineno
        storage.refuse("sound XML", expat.ErrorString(cause.code) or "a fault", "the file may be cut: copy it again")
    return root


def _xml_words(text: str, storage: _Storage) -> list[Value]:
    text = text.strip(" \t\r\n")
    if '"' not in text:
        return storage.scalars(text.split())
    if _XML_WORDS.fullmatch(text):
        return [w[1:-1] if w[0] == '"' else storage.scalar(w) for w in _XML_WORD.findall(text)]
    if len(text) < 2 or not (text.startswith('"') and text.endswith('"')):
        storage.refuse("one quoted text", shorten(text))
    return [text[1:-1]]

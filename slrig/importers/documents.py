"""Files of numbers of other programs, as one tree of names: OpenCV, MATLAB, NumPy, JSON, YAML, text.

Strangers write these files: sizes are checked before anything is unpacked, and what could run code is refused.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from slrig.bundle import (
    MAX_CALIBRATION_BYTES,
    MAX_STORAGE_BYTES,
    HoldsObjectsError,
    natural_sort_key,
    read_arrays,
    read_file_storage,
    read_text,
    unreadable,
)
from slrig.disk import storage_errors
from slrig.errors import CalibrationError
from slrig.model import FloatArray

MAX_YAML_BYTES = 2**18
MAX_YAML_DEPTH = 12
MAX_BINARY_BYTES = 2**25
"""Of NumPy's and MATLAB's files, packed and unpacked."""
MAX_NUMBERS = 2**16
_MAX_DEPTH = 16
_MAX_ENTRIES = 2**16
_MAX_FILES = 32
_MAX_STACKED = 16  # matrices in one array
_MAX_WORDS = 3  # of a name
_REAL = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")

DOCUMENT_SUFFIXES = (".json", ".yml", ".yaml", ".xml", ".mat", ".npz", ".npy", ".txt", ".csv", ".m", ".slcalib")

_PICKLE = (
    "a Python object in pickle's form, which can run code; save plain arrays: "
    "np.savez('rig.npz', K1=K1, D1=D1, K2=K2, D2=D2, R=R, T=T)"
)
_HDF5 = (
    "HDF5, which slrig does not read; in MATLAB save it again with save('rig.mat', '-v7'), or write its arrays with "
    "NumPy's savez"
)
_OBJECT = (
    "a MATLAB object, which only MATLAB can open; save it as a struct: s = toStruct(stereoParams); "
    "save('rig.mat', 's', '-v7')"
)

_ALONE = "save the calibration alone"

_Loader: Any = type("_Loader", (yaml.SafeLoader,), {})
# YAML 1.1 requires a point in a number with an exponent; other programs write 1e-05.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)

Leaf = FloatArray | float | str
Name = tuple[str, ...]


def read_document(path: Path) -> dict[Name, Leaf]:
    """Return the numbers, arrays (float64) and texts of a file by the path of their names; lists have names 0, 1, ...
    A folder has the names of its files in front. Raises CalibrationError: the format is unknown, or the file is
    damaged, too large, or could run code.
    """
    if not path.is_dir():
        document = _read_file(path)
        return dict(_leaves(document, () if isinstance(document, Mapping) else (path.stem,), path))
    with storage_errors(path):
        files = sorted((e for e in path.iterdir() if e.suffix.lower() in DOCUMENT_SUFFIXES), key=natural_sort_key)
    if not 1 <= len(files) <= _MAX_FILES:
        raise CalibrationError(
            f"{path}: expected 1 to {_MAX_FILES} files of a calibration ({', '.join(DOCUMENT_SUFFIXES)}), found "
            f"{len(files)}; give the file"
        )
    leaves: dict[Name, Leaf] = {}
    for file in files:
        document = _read_file(file)
        # An array alone is called as its file.
        leaves |= _leaves(document, (file.stem,), file)
    return leaves


def _read_file(path: Path) -> Any:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BINARY_BYTES + 1)
    except OSError as cause:
        raise CalibrationError(unreadable(path, cause)) from cause
    if len(data) > MAX_BINARY_BYTES:
        raise CalibrationError(f"{path}: expected at most {MAX_BINARY_BYTES} bytes, found a larger file; {_ALONE}")
    if data.startswith((b"\x89HDF", b"MATLAB 7.3")):
        raise CalibrationError(f"{path}: expected numbers, found {_HDF5}")
    if data.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")):
        raise CalibrationError(f"{path}: expected numbers, found {_PICKLE}")
    readers = {b"PK\x03\x04": _read_npz, b"\x93NUMPY": _read_npz, b"MATLAB 5.0": _read_mat}
    reader = next((each for head, each in readers.items() if data.startswith(head)), None)
    if reader is not None:
        try:
            return reader(data, path)
        except CalibrationError:
            raise
        except Exception as cause:  # The decoders raise many kinds for damaged files.
            raise CalibrationError(
                f"{path}: expected a sound file, found {type(cause).__name__}: {str(cause)[:80]}; save it again"
            ) from cause
    return _read_text_document(path)


def _read_text_document(path: Path) -> Any:
    text = read_text(path, MAX_STORAGE_BYTES, CalibrationError).removeprefix("\ufeff")
    start = text.lstrip()[:1]
    if text.startswith("%YAML") or start == "<":
        return read_file_storage(text.lstrip(), path)
    if start in ("{", "[") and path.suffix.lower() not in (".yml", ".yaml"):
        try:
            # OpenCV writes comments into JSON.
            return json.loads(re.sub(r"(?m)^\s*//.*$", "", text[:MAX_CALIBRATION_BYTES]))
        except (ValueError, RecursionError) as cause:
            # Sections of other texts begin with a bracket, too.
            if start == "{" or _read_numbers(text) is None:
                raise CalibrationError(f"{path}: expected JSON, found {str(cause)[:80]}; save it again") from cause
    numbers = None if path.suffix.lower() in (".yml", ".yaml") else _read_numbers(text)
    return read_yaml(path) if numbers is None else numbers


def _read_numbers(text: str) -> dict[str, Any] | FloatArray | None:
    """Return the arrays of a text of names, each with rows of numbers behind or below it, or of one array without a
    name; None for another text.

    So write SLStudio (.slcalib, .m), ROS (ost.txt), `np.savetxt` and people. Brackets and punctuation are left out; a
    name without numbers is that of a section.
    """
    found: dict[tuple[str, ...], list[list[float]]] = {("",): []}
    section: tuple[str, ...] = ()
    name: tuple[str, ...] = ("",)
    for line in text.splitlines():
        words = re.sub(r"[\[\](){}=:,;]|[#%].*", " ", line).split()
        first = next((n for n, word in enumerate(words) if _REAL.fullmatch(word)), len(words))
        if not all(map(_REAL.fullmatch, words[first:])) or first > _MAX_WORDS:
            return None
        if first:
            if any(name) and not found[name]:
                del found[name]
                section = name[-1:]
            name = (*section, "_".join(words[:first]))
            found[name] = []
        if words[first:]:
            found[name].append([float(word) for word in words[first:]])
    arrays: dict[str, Any] = {}
    for (*around, last), rows in found.items():
        if rows:
            is_even = len({len(row) for row in rows}) == 1
            group = arrays.setdefault(around[0], {}) if around else arrays
            group[last] = np.array(rows) if is_even else np.concatenate(rows)
    return arrays[""] if list(arrays) == [""] else arrays or None


def read_yaml(path: Path, *, several: bool = False) -> Any:
    """Return the data of a YAML file; several : a list of its documents, as ROS prints messages. Raises
    CalibrationError, with the line: the file is truncated, too large, nested too deep, or has anchors, which can expand
    a short file without limit.
    """
    text = read_text(path, MAX_YAML_BYTES, CalibrationError)
    depth = 0
    try:
        # Check all events before anything is built from them.
        for event in yaml.parse(text, _Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_YAML_DEPTH or isinstance(event, yaml.AliasEvent):
                mark: Any = event.start_mark
                message = (
                    f"{path}: expected YAML without anchors, nested at most {MAX_YAML_DEPTH} deep, found otherwise"
                )
                raise CalibrationError(f"{message} at line {mark.line + 1}; export it again")
        for node in yaml.compose_all(text, _Loader) if several else (yaml.compose(text, _Loader),):
            _require_single_keys(node, path)
        if several:
            return [each for each in yaml.load_all(text, _Loader) if each is not None]
        return yaml.load(text, _Loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError) as cause:
        mark = getattr(cause, "problem_mark", None)
        where = "" if mark is None else f" at line {mark.line + 1}"
        problem = getattr(cause, "problem", None) or str(cause)
        if "python/" in problem:
            raise CalibrationError(f"{path}: expected numbers, found python/object{where}, which can run code; write "
                                   "lists: K1.tolist()") from cause  # fmt: skip
        raise CalibrationError(f"{path}: expected YAML, found {problem}{where}; correct it") from cause


def _require_single_keys(node: Any, path: Path) -> None:
    """Reject duplicate keys in a map, of which PyYAML would keep the last."""
    if isinstance(node, yaml.MappingNode):
        keys = [str(key.value) for key, _ in node.value]
        if len(set(keys)) < len(keys):
            line = node.start_mark.line + 1
            raise CalibrationError(f"{path}: expected each key once, found one twice in the map at line {line}")
    for part in node.value if isinstance(node, yaml.CollectionNode) else ():
        for each in part if isinstance(part, tuple) else (part,):
            _require_single_keys(each, path)


def _read_npz(_data: bytes, path: Path) -> Any:
    try:
        arrays = read_arrays(path, MAX_BINARY_BYTES)
    except HoldsObjectsError as cause:
        raise CalibrationError(f"{path}: expected arrays, found {_PICKLE}") from cause
    return arrays.get("", arrays)


_MAT_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MAT_TEXTS = {1: "latin-1", 2: "utf-8", 4: "utf-16-", 16: "utf-8", 17: "utf-16-", 18: "utf-32-"}
_MAT_MATRIX, _MAT_COMPRESSED = 14, 15
_MAT_CELL, _MAT_STRUCT, _MAT_CHAR, _MAT_OPAQUE, _MAT_NUMBERS = 1, 2, 4, 17, range(6, 16)


def _read_mat(data: bytes, path: Path) -> dict[str, Any]:
    """Return the numbers, texts, structs and cells of a MATLAB file of version 5 ("MAT-File Level 5 File Format").

    SciPy's reader is unsafe for files from others: a damaged one ends the process.
    """
    reader = _MatReader("<" if data[126:128] == b"IM" else ">")
    found: dict[str, Any] = {}
    total = 0
    for kind, content in reader.elements(data[128:]):
        if kind == _MAT_COMPRESSED:
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(content, MAX_BINARY_BYTES - total)
            total += len(content)
            if unpacker.unconsumed_tail:
                message = f"{path}: expected at most {MAX_BINARY_BYTES} bytes of arrays, found more; {_ALONE}"
                raise CalibrationError(message)
            kind, content = next(reader.elements(content))
        if kind == _MAT_MATRIX:
            name, value = reader.variable(content)
            found[name] = value
    if reader.has_objects and all(value is None for name, value in found.items() if name):
        raise CalibrationError(f"{path}: expected numbers, found {_OBJECT}")
    return found


class _MatReader:
    """Elements of a MATLAB file. order : of bytes, "<" or ">"; has_objects : True once one of an object was read."""

    def __init__(self, order: Literal["<", ">"]) -> None:
        self._order, self._ending = order, "le" if order == "<" else "be"
        self.has_objects = False

    def elements(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield the type and the content of each element. Raises ValueError: the data are cut."""
        at = 0
        while at + 8 <= len(data):
            kind, count = struct.unpack_from(f"{self._order}II", data, at)
            start = at + 8
            if kind >> 16:
                # A small element has its size and its content in the tag.
                kind, count, start = kind & 0xFFFF, kind >> 16, at + 4
            if start + count > len(data):
                raise ValueError("the file is cut")
            yield kind, data[start : start + count]
            at = max(at + 8, start + count)
            at += 0 if kind == _MAT_COMPRESSED else -at % 8

    def variable(self, data: bytes, depth: int = 0) -> tuple[str, Any]:
        """Return the name and the value of an array; None for kinds that hold no numbers."""
        if depth > _MAX_DEPTH:
            raise ValueError("structs are nested too deep")
        parts = self.elements(data)
        flags, sides, name = (next(parts)[1] for _ in range(3))
        kind = int.from_bytes(flags[:4], "little" if self._order == "<" else "big") & 0xFF
        self.has_objects |= kind == _MAT_OPAQUE
        shape = self._numbers(5, sides).astype(int) if kind != _MAT_OPAQUE else np.zeros(1, dtype=int)
        title = name.decode("latin-1")
        if kind in _MAT_NUMBERS:
            values = self._numbers(*next(parts, (9, b"")))
            return title, values.reshape(shape, order="F") if values.size else None
        if kind == _MAT_CHAR:
            code, text = next(parts, (16, b""))
            return title, text.decode(_MAT_TEXTS[code] + ("" if code not in (4, 17, 18) else self._ending))
        if kind == _MAT_CELL:
            return title, [self.variable(content, depth + 1)[1] for _, content in parts]
        if kind != _MAT_STRUCT:
            return title, None
        width = int(self._numbers(*next(parts))[0])
        names = next(parts)[1]
        fields = [names[n : n + width].split(b"\0")[0].decode("latin-1") for n in range(0, len(names), max(width, 1))]
        held = [self.variable(content, depth + 1)[1] if content else None for _, content in parts]
        items = [dict(zip(fields, held[n:], strict=False)) for n in range(0, len(held), max(len(fields), 1))]
        return title, items[0] if len(items) == 1 else items

    def _numbers(self, kind: int, data: bytes) -> FloatArray:
        return np.frombuffer(data, dtype=f"{self._order}{_MAT_KINDS[kind]}").astype(np.float64)


def _leaves(value: Any, path: Name, file: Path) -> Iterator[tuple[Name, Leaf]]:
    """Yield numbers, arrays and texts. Lists of numbers of one length, and maps of rows, cols and data, are arrays."""
    count = 0
    pending = [(path, value)]
    while pending:
        path, value = pending.pop()
        count += 1
        if count > _MAX_ENTRIES:
            message = f"{file}: expected at most {_MAX_ENTRIES} entries, found more; leave out all but the calibration"
            raise CalibrationError(message)
        if isinstance(value, Mapping):
            array = _matrix(value)
            if array is not None:
                yield path, array
            elif len(path) < _MAX_DEPTH:
                pending += [((*path, str(key)), each) for key, each in reversed(list(value.items()))]
        elif isinstance(value, bool) or value is None:
            continue
        elif isinstance(value, str):
            yield path, value
        elif isinstance(value, int | float):
            yield path, float(value)
        elif isinstance(value, list | tuple | np.ndarray):
            array = _array(value)
            if array is not None and array.ndim > 2 and 1 < len(array) <= _MAX_STACKED:
                pending += [((*path, str(n)), each) for n, each in reversed(list(enumerate(array)))]
            elif array is not None:
                yield path, array if array.ndim else float(array)
            elif isinstance(value, list | tuple) or value.dtype == object:
                items = list(np.ravel(np.asarray(value, dtype=object)) if isinstance(value, np.ndarray) else value)
                pending += [((*path, str(n)), each) for n, each in reversed(list(enumerate(items)))]
            elif value.dtype.kind == "U" and value.size == 1:
                yield path, str(value.item())


def _matrix(value: Mapping[Any, Any]) -> Any | None:
    """Return the array of a map of rows, cols and data, as OpenCV's JSON and ROS have it; None for another map."""
    if not {"rows", "cols", "data"} <= set(value):
        return None
    array = _array(value["data"])
    if array is None:
        return None
    rows, columns = value["rows"], value["cols"]
    fits = isinstance(rows, int) and isinstance(columns, int) and rows > 0 and rows * columns == array.size
    return array.reshape(rows, columns) if fits else array


def _array(value: Any) -> Any | None:
    """Return numbers as float64; None for what is no array of at most `MAX_NUMBERS` numbers."""
    if isinstance(value, list | tuple):
        flat: list[Any] = [*value]
        while flat and isinstance(flat[0], list | tuple) and len(flat) <= MAX_NUMBERS:
            flat = [each for part in flat for each in (part if isinstance(part, list | tuple) else [None])]
        if not flat or not all(isinstance(each, int | float) and not isinstance(each, bool) for each in flat):
            return None
        try:
            value = np.array(value, dtype=np.float64)
        except (ValueError, OverflowError):
            return None
    return value.astype(np.float64) if value.dtype.kind in "fiu" and 1 <= value.size <= MAX_NUMBERS else None

"""Validation of files and requests: all faults in one message, and types for text and times.

A description (bundle.json, calibration.json, a rig file) is validated by a pydantic model; its errors become lines of
the form `cameras.cam0.bit_depth: expected …, found …; do …`, all of them in one message.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    field_validator,
)
from pydantic_core import ErrorDetails

from slrig.errors import ConfigError, InvalidInputError
from slrig.printable import UNSAFE, unsafe

MAX_FAULTS = 20
MAX_VALUE_LENGTH = 60
MAX_NUMBER = 1e60


def _refuse_unsafe(text: str) -> str:
    found = unsafe.search(text)
    if found is not None:
        message = (
            f"expected text without control characters, found U+{ord(found[0]):04X} at character {found.start() + 1}; "
            "leave it out"
        )
        raise ValueError(message)
    return text


SafeText = Annotated[str, Field(json_schema_extra={"pattern": f"^[^{UNSAFE}]*$"}), AfterValidator(_refuse_unsafe)]
"""Text without characters that affect a terminal."""

FreeText = Annotated[SafeText, Field(min_length=1, max_length=200)]
"""The same, of 1 to 200 characters."""


_number = re.compile(r"\s*[+-]?[\d._]+(e[+-]?\d+)?\s*", re.IGNORECASE | re.ASCII)


def _refuse_number(value: object) -> object:
    """Refuse numbers, which pydantic would take for seconds since 1970."""
    if isinstance(value, (int, float)) or (isinstance(value, str) and _number.fullmatch(value)):
        message = (
            f"expected a date and time with the offset from UTC, as 2026-11-20T06:00:00Z, found the number {value}; "
            "write it as ISO 8601 does"
        )
        raise ValueError(message)
    return value


Moment = Annotated[datetime, Field(strict=False), BeforeValidator(_refuse_number)]
"""A date and time as ISO 8601 text, not a number."""

AwareMoment = Annotated[AwareDatetime, Field(strict=False), BeforeValidator(_refuse_number)]
"""The same, with its offset from UTC."""


class Strict(BaseModel):
    """A description without unknown keys, without numbers that are not finite, and without silent conversions."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _refuse_immense(cls, value: Any) -> Any:
        """Refuse numbers whose squares and products overflow: nothing that is measured has such."""
        pending = [value]
        while pending:
            each = pending.pop()
            if isinstance(each, (list, tuple)):
                pending.extend(each)
            elif isinstance(each, dict):
                pending.extend(each.values())
            elif isinstance(each, (int, float)) and abs(each) > MAX_NUMBER:
                message = f"expected numbers of at most {MAX_NUMBER:g}, found a greater one"
                raise ValueError(message)
        return value


Described = TypeVar("Described", bound=BaseModel)


def unreadable(path: Path, cause: OSError) -> str:
    """What to say of a file that cannot be read.

    >>> unreadable(Path("rig.toml"), FileNotFoundError(2, "No such file or directory"))
    'rig.toml: no such file'
    """
    if isinstance(cause, FileNotFoundError):
        return f"{path}: no such file"
    return f"{path}: expected a file that can be read, found: {cause.strerror}"


def read_text(path: Path, max_bytes: int, error: type[InvalidInputError]) -> str:
    """Return the text of a small UTF-8 file.
    Raises InvalidInputError, of the class `error`: the file is missing, larger than `max_bytes`, or not text.
    """
    try:
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as cause:
        raise error(unreadable(path, cause)) from cause
    if len(data) > max_bytes:
        raise error(
            f"{path}: expected at most {max_bytes} bytes, found a larger file; "
            "a description is short: check that this is the right file"
        )
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as cause:
        message = f"{path}: expected UTF-8 text, found byte {data[cause.start]:#04x} at {cause.start}; save it as UTF-8"
        raise error(message) from cause


def stored_json(text: str | bytes) -> Any:
    """The data of a JSON text that slrig wrote itself. Raises ValueError: it is damaged."""
    try:
        return json.loads(text)
    except RecursionError as error:
        message = "JSON that is nested too deeply"
        raise ValueError(message) from error


def read_json(text: str, source: Path, error: type[InvalidInputError]) -> Any:
    """Return the data of a strict JSON text: no NaN, no infinity, no duplicate key.
    Raises InvalidInputError, of the class `error`, with the line of the fault.
    """

    def refuse_constant(name: str) -> NoReturn:
        raise ValueError(f"found {name}, which is not JSON; every number must be finite, leave an unknown value out")

    def refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        data = dict(pairs)
        if len(data) != len(pairs):
            keys = [key for key, _ in pairs]
            duplicates = sorted({key for key in keys if keys.count(key) > 1})
            listed = ", ".join(map(shorten, duplicates[:MAX_FAULTS]))
            raise ValueError(f"found the key {listed} twice in one object; keep one of them")
        return data

    try:
        return json.loads(text, parse_constant=refuse_constant, object_pairs_hook=refuse_duplicates)
    except json.JSONDecodeError as cause:
        raise error(
            f"{source}: expected JSON, found a fault at line {cause.lineno} column {cause.colno} ({cause.msg}); "
            "the file may be cut: copy it again or correct that line"
        ) from cause
    except RecursionError as cause:
        message = f"{source}: expected a description, found JSON nested too deeply; check that this is the right file"
        raise error(message) from cause
    except ValueError as cause:
        raise error(f"{source}: {cause}") from cause


def read_toml(path: Path, max_bytes: int) -> dict[str, Any]:
    """Return the tables of a TOML file. Raises ConfigError: see `read_text` and `parse_toml`."""
    return parse_toml(read_text(path, max_bytes, ConfigError), path)


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Return the tables of a TOML text. path : of its file. Raises ConfigError with the line of the fault."""
    try:
        return tomllib.loads(text)
    except RecursionError as cause:
        message = f"{path}: expected a description, found TOML nested too deeply; check that this is the right file"
        raise ConfigError(message) from cause
    except tomllib.TOMLDecodeError as cause:
        raise ConfigError(f"{path}: expected TOML, found a fault: {cause}; correct that line") from cause


def validate(
    model: type[Described], data: object, name: str, *, hint: str = "", error: type[InvalidInputError] = ConfigError
) -> Described:
    """Return `data` as a `model`.
    Raises InvalidInputError, of the class `error`: says that `name` is wrong, lists every fault, and ends with `hint`.
    """
    try:
        return model.model_validate(dict(data) if isinstance(data, Mapping) else data)
    except ValidationError as cause:
        raise error(f"{name} is wrong:\n{describe_errors(cause, data, model_keys(model))}{hint}") from cause


def read_json_model(
    path: Path, model: type[Described], name: str, *, max_bytes: int, error: type[InvalidInputError]
) -> Described:
    """Return the contents of a JSON file as a `model`.
    Raises InvalidInputError, of the class `error`: see `read_text` and `read_json`; or the file is not a valid `name`,
    with every fault in one message.
    """
    text = read_text(path, max_bytes, error)
    data = read_json(text, path, error)
    try:
        return model.model_validate_json(text)
    except ValidationError as cause:
        raise error(f"{path} is not a valid {name}:\n{describe_errors(cause, data, model_keys(model))}") from cause


def describe_errors(cause: ValidationError, data: object, known_keys: Mapping[str, str]) -> str:
    """Return one line per fault. known_keys : keys to propose for a misspelt one."""
    lines = [f"  {_line(fault, data, known_keys)}" for fault in cause.errors(include_url=False)]
    if len(lines) > MAX_FAULTS:
        lines[MAX_FAULTS:] = [f"  … and {len(lines) - MAX_FAULTS} more"]
    return "\n".join(lines)


def model_keys(model: type[BaseModel] | TypeAdapter[Any]) -> Mapping[str, str]:
    """Every key of a model and of the models in it, with the path of the first model that has it; for proposals."""
    schema = model.json_schema() if isinstance(model, TypeAdapter) else model.model_json_schema()
    found: dict[str, str] = {}
    definitions = schema.get("$defs", {})
    waiting: list[tuple[object, tuple[str, ...]]] = [(schema, ())]
    seen = set()
    for part, path in waiting:
        if isinstance(part, list):
            waiting += [(each, path) for each in part]
        if not isinstance(part, Mapping):
            continue
        reference = part.get("$ref")
        if reference is not None and reference not in seen:
            seen.add(reference)
            waiting.append((definitions[reference.rpartition("/")[2]], path))
        properties = part.get("properties", {})
        for name, each in properties.items():
            found.setdefault(name, ".".join(path))
            waiting.append((each, (*path, name)))
        waiting += [(each, path) for name, each in part.items() if name not in ("$defs", "properties", "$ref")]
    return found


def proposal(key: str, known: Mapping[str, str]) -> str | None:
    """What to say of an unknown key: its place, or the nearest of the known ones; None where nothing is near."""
    if key in known:
        return f"it belongs into '{known[key]}'" if known[key] else "it belongs outside, into the whole"
    near = difflib.get_close_matches(key, known, n=1)
    return f"did you mean '{near[0]}'?" if near else None


def _line(fault: ErrorDetails, data: object, known_keys: Mapping[str, str]) -> str:
    path = _path(fault["loc"], data, keep_last=fault["type"] == "missing")
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{path}: unknown key; {proposal(str(fault['loc'][-1]), known_keys) or 'remove it'}"
    if fault["type"] == "missing":
        return f"{path}: missing; add it"
    if fault["type"] == "value_error":
        return f"{path}: {fault['ctx']['error']}"
    return f"{path}: {fault['msg'][0].lower()}{fault['msg'][1:]}, found {shorten(fault['input'])}; correct it"


def shorten(value: object) -> str:
    """Return the value as text that fits into a line."""
    text = repr(value)
    return text if len(text) <= MAX_VALUE_LENGTH else f"{text[: MAX_VALUE_LENGTH - 1]}…"


def _path(loc: Sequence[int | str], data: object, *, keep_last: bool) -> str:
    # Pydantic puts the tag of a union into the path, which the file does not have: only steps in the data count.
    path = ""
    for position, step in enumerate(loc):
        if isinstance(step, int) and isinstance(data, Sequence) and step < len(data):
            data, path = data[step], f"{path}[{step}]"
        elif isinstance(data, Mapping) and step in data:
            data, path = data[step], f"{path}.{step}"
        elif keep_last and position == len(loc) - 1:
            path = f"{path}.{step}"
    return path.removeprefix(".") or "top level"

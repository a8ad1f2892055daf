"""A rig file with the values that an examination found, each with a comment that says why."""

from __future__ import annotations

import copy
import datetime
import json
import os
import re
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from slrig.bundle.storage import write_durably
from slrig.bundle.validation import read_text
from slrig.config import MOST_CONFIG_BYTES, read_rig
from slrig.disk import refusals_of, staging_name
from slrig.doctor.advice import ExposureAdvice
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.findings import Severity, ms
from slrig.errors import ConfigError

_WIDTH = 116
_WAITS = "synchronisation"
_BARE = re.compile(r"[A-Za-z0-9_-]+")

Path_ = tuple[str | int, ...]
Comments = Mapping[Path_, str]


def write_rig_file(diagnosis: Diagnosis, source: Path, target: Path, *, force: bool) -> None:
    """Write the rig file `source` to `target` with what was found: exposures, lines and the table [synchronisation].

    Everything else stays; paths that are relative to the one file are made relative to the other. Its own comments are
    not kept. Raises ConfigError where there is a file of that name and `force` is not given; StorageError.
    """
    refuse_existing(target, force=force)
    data = tomllib.loads(read_text(source, MOST_CONFIG_BYTES, ConfigError))
    text = doctored(data, diagnosis, source=source.resolve(), target=target.resolve())
    with refusals_of(target):
        staged = staging_name(target)
        try:
            write_durably(staged, text.encode())
            # Read before it takes its place: a rig file that nobody can read helps nobody.
            read_rig(staged)
            staged.replace(target)
        finally:
            staged.unlink(missing_ok=True)


def refuse_existing(target: Path, *, force: bool) -> None:
    """Raise ConfigError where a file would be overwritten and nobody asked for that."""
    if target.exists() and not force:
        message = f"{target} exists, and is kept; choose another name with --output, or overwrite it with --force"
        raise ConfigError(message)


def doctored(data: Mapping[str, Any], diagnosis: Diagnosis, *, source: Path, target: Path) -> str:
    """Return the text of the new rig file. `data` : what the old one holds; source, target : absolute."""
    tables = copy.deepcopy(dict(data))
    if source.parent != target.parent:
        tables = _moved(tables, source.parent, target.parent)
    comments: dict[Path_, str] = {}
    _expose(tables, diagnosis.exposures, comments)
    lines = diagnosis.lines
    table: dict[str, Any]
    if lines is not None:
        table = tables.setdefault("scan", {})
        # What belonged to other lines goes: half a period wide, and cells as wide, is the default.
        for key in ("line_width_px", "gray_cell_px"):
            table.pop(key, None)
        table |= {"line_shift_period_px": lines.period_px, "line_steps": lines.steps}
        comments["scan", "line_shift_period_px"] = f"{lines.reason}; {lines.less_noise} is expected"
    found = diagnosis.synchronisation
    if found is not None:
        latency_s, error_s = round(found.latency_s, 6), round(found.latency_error_s, 6)
        table = {"latency_s": latency_s, "latency_error_s": error_s}
        comments |= {
            (_WAITS, "latency_s"): "measured by flashes: how much later than the projector says its light comes, on "
            "average",
            (_WAITS, "latency_error_s"): "and how much later than that it may come, beyond what the projector states; "
            "scans wait for both",
        }
        if found.earliest_s is not None:
            table["earliest_s"] = round(found.earliest_s, 6)
            why = "when it begins to change at the earliest: with it, scans wait for no frame before the next pattern"
            comments[_WAITS, "earliest_s"] = why
        if "trigger_period_s" in tables.get(_WAITS, {}):
            table["trigger_period_s"] = tables[_WAITS]["trigger_period_s"]
        if found.line_time_s:
            table["line_time_s"] = {name: round(seconds, 9) for name, seconds in found.line_time_s.items()}
            rolling = "measured: a rolling shutter exposes each row this much later than the row above it"
            comments |= dict.fromkeys(((_WAITS, "line_time_s", name) for name in found.line_time_s), rolling)
        tables[_WAITS] = table
    return "\n".join([*_heading(diagnosis, source), *_table(tables, (), comments)]) + "\n"


def _expose(tables: dict[str, Any], exposures: Mapping[str, ExposureAdvice], comments: dict[Path_, str]) -> None:
    """Write the exposures; one of all scans would hide them."""
    if not exposures:
        return
    if isinstance(tables.get("scan"), dict):
        tables["scan"].pop("exposure_s", None)
    advised: list[tuple[Path_, dict[str, Any], ExposureAdvice]] = [
        (("camera", number), camera, exposures[camera["name"]])
        for number, camera in enumerate(tables.get("camera", ()))
        if camera["name"] in exposures
    ]
    if "head" in tables:
        advised = [(("head",), tables["head"], min(exposures.values(), key=lambda each: each.exposure_s))]
    for path, table, advice in advised:
        shortest_s, longest_s = advice.usable_s
        table["exposure_s"] = float(f"{advice.exposure_s:.6g}")
        comments[(*path, "exposure_s")] = f"{advice.reason}; usable are {ms(shortest_s)} to {ms(longest_s)}"


def _heading(diagnosis: Diagnosis, source: Path) -> Iterator[str]:
    yield from _comment(f"Written by slrig doctor, from {source.name}.")
    if diagnosis.refresh_hz is not None:
        yield from _comment(f"The display refreshes {diagnosis.refresh_hz:.2f} times a second.")
    if diagnosis.response is not None:
        yield from _comment(f"Light grows with the grey value to the power of {diagnosis.response.gamma:.2f}.")
    for severity in (Severity.FAULT, Severity.NOTE):
        for finding in diagnosis.of(severity):
            yield from _comment(f"{severity.capitalize()}, {finding.subject}: {finding.found}. Do: {finding.remedy}.")
    yield ""


def _comment(text: str) -> list[str]:
    return textwrap.wrap(" ".join(text.split()), _WIDTH, initial_indent="# ", subsequent_indent="#   ")


def _moved(value: Any, old: Path, new: Path) -> Any:
    """The same with every text that names a file or folder relative to `old` made relative to `new`."""
    if isinstance(value, Mapping):
        return {key: _moved(each, old, new) for key, each in value.items()}
    if isinstance(value, list):
        return [_moved(each, old, new) for each in value]
    if isinstance(value, str) and value and not Path(value).is_absolute() and _exists(old / value):
        return Path(os.path.relpath((old / value).resolve(), new)).as_posix()
    return value


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _table(table: Mapping[str, Any], path: Path_, comments: Comments) -> Iterator[str]:
    """The lines of a table: its values, then its tables, then its arrays of tables."""
    for key, value in table.items():
        if not _is_table(value):
            if (*path, key) in comments:
                yield from _comment(comments[(*path, key)])
            yield f"{_key(key)} = {toml_value(value)}"
    for key, value in table.items():
        if not _is_table(value):
            continue
        for number, each in enumerate(value if isinstance(value, list) else [value]):
            inner: Path_ = (*path, key, number) if isinstance(value, list) else (*path, key)
            name = ".".join(_key(step) for step in inner if isinstance(step, str))
            yield ""
            yield f"[[{name}]]" if isinstance(value, list) else f"[{name}]"
            yield from _table(each, inner, comments)


def _is_table(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(isinstance(each, Mapping) for each in value)
    return isinstance(value, Mapping)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def toml_value(value: Any) -> str:
    """A TOML value on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)} = {toml_value(each)}" for key, each in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    # Integers, and floats as Python writes them, are TOML's.
    return repr(value)


def _text(text: str) -> str:
    """A TOML basic string: that of JSON, but for one character."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")

"""Rig file with the values that an examination measured, each with a comment that gives the reason."""

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

from slrig.bundle import read_text, write_durably
from slrig.config import MAX_CONFIG_BYTES, read_rig
from slrig.devices import Synchronisation
from slrig.disk import staging_name, storage_errors
from slrig.doctor.advice import ExposureAdvice
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.light import Severity, format_ms
from slrig.errors import ConfigError

_WIDTH = 116
_SYNC = "synchronisation"

_LEAST_STAMP_ERROR_S = 1e-4
"""Smaller errors of time stamps make no difference between exposures."""
_BARE = re.compile(r"[A-Za-z0-9_-]+")

KeyPath = tuple[str | int, ...]
Comments = Mapping[KeyPath, str]


def write_rig_file(diagnosis: Diagnosis, source: Path, target: Path, *, force: bool) -> None:
    """Write the rig file `source` to `target` with the measured exposures, lines and table [synchronisation].

    All other values stay; paths relative to the one file become relative to the other. Comments are lost. Raises
    ConfigError if the target exists and `force` is False; StorageError.
    """
    refuse_existing(target, force=force)
    data = tomllib.loads(read_text(source, MAX_CONFIG_BYTES, ConfigError))
    text = rig_file_text(data, diagnosis, source=source.resolve(), target=target.resolve())
    with storage_errors(target):
        staged = staging_name(target)
        try:
            write_durably(staged, text.encode())
            # Validate it before it replaces a file.
            read_rig(staged)
            staged.replace(target)
        finally:
            staged.unlink(missing_ok=True)


def refuse_existing(target: Path, *, force: bool) -> None:
    """Raise ConfigError if a file would be overwritten without `force`."""
    if target.exists() and not force:
        message = f"{target} exists and is unchanged; choose another name, or overwrite it with --force"
        raise ConfigError(message)


def rig_file_text(data: Mapping[str, Any], diagnosis: Diagnosis, *, source: Path, target: Path) -> str:
    """Return the text of the new rig file. data : contents of the old one. source, target : absolute."""
    tables = copy.deepcopy(dict(data))
    if source.parent != target.parent:
        tables = _rebase_paths(tables, source.parent, target.parent)
    comments: dict[KeyPath, str] = {}
    _set_exposures(tables, diagnosis.exposures, comments)
    lines = diagnosis.lines
    table: dict[str, Any]
    if lines is not None:
        table = tables.setdefault("scan", {})
        # These belong to the old period; their defaults follow the new one.
        for key in () if lines.sines else ("line_width_px", "gray_cell_px"):
            table.pop(key, None)
        table |= lines.options
        comments["scan", next(iter(lines.options))] = f"{lines.reason}; {lines.gain_text} is expected"
    measured = diagnosis.synchronisation
    if measured is not None:
        latency_s, error_s = round(measured.latency_s, 6), round(measured.latency_error_s, 6)
        table = {"latency_s": latency_s, "latency_error_s": error_s}
        comments |= {
            (_SYNC, "latency_s"): "measured by flashes: mean delay of the light after the instant that the projector "
            "states",
            (_SYNC, "latency_error_s"): "and the longest further delay, beyond the error that the projector states; "
            "scans wait for both",
        }
        if measured.earliest_s is not None:
            table["earliest_s"] = round(measured.earliest_s, 6)
            reason = "earliest instant of a change: with it, scans show the next pattern before the frames have arrived"
            comments[_SYNC, "earliest_s"] = reason
        if "trigger_period_s" in tables.get(_SYNC, {}):
            table["trigger_period_s"] = tables[_SYNC]["trigger_period_s"]
        if measured.line_time_s:
            table["line_time_s"] = {name: round(seconds, 9) for name, seconds in measured.line_time_s.items()}
            rolling = "measured: a rolling shutter exposes each row this much later than the row above it"
            comments |= dict.fromkeys(((_SYNC, "line_time_s", name) for name in measured.line_time_s), rolling)
        if errors_s := known_stamp_errors_s(measured):
            table["stamp_error_s"] = errors_s
            stamps = (
                "of the time stamps meanwhile; at other exposures, frames keep the difference from changes of light"
            )
            comments |= dict.fromkeys(((_SYNC, "stamp_error_s", name) for name in errors_s), stamps)
        tables[_SYNC] = table
    if diagnosis.trigger_period_s is not None:
        tables.setdefault(_SYNC, {})["trigger_period_s"] = round(diagnosis.trigger_period_s, 6)
        comments[_SYNC, "trigger_period_s"] = "measured by wire: the least time between pulses that all cameras follow"
    return "\n".join([*_heading(diagnosis, source), *_table_lines(tables, (), comments)]) + "\n"


def known_stamp_errors_s(measured: Synchronisation) -> dict[str, float]:
    """The errors of time stamps that are worth a line of a rig file."""
    errors_s = measured.stamp_error_s.items()
    return {name: round(error_s, 6) for name, error_s in errors_s if error_s > _LEAST_STAMP_ERROR_S}


def _set_exposures(
    tables: dict[str, Any], exposures: Mapping[str, ExposureAdvice], comments: dict[KeyPath, str]
) -> None:
    """Write the exposure of each camera, or of a head, and remove the one of [scan], which would override them."""
    if not exposures:
        return
    if isinstance(tables.get("scan"), dict):
        tables["scan"].pop("exposure_s", None)
    advised: list[tuple[KeyPath, dict[str, Any], ExposureAdvice]] = [
        (("camera", number), camera, exposures[camera["name"]])
        for number, camera in enumerate(tables.get("camera", ()))
        if camera["name"] in exposures
    ]
    if "head" in tables:
        advised = [(("head",), tables["head"], min(exposures.values(), key=lambda each: each.exposure_s))]
    for path, table, advice in advised:
        shortest_s, longest_s = advice.usable_s
        table["exposure_s"] = float(f"{advice.exposure_s:.6g}")
        comments[(*path, "exposure_s")] = (
            f"{advice.reason}; usable are {format_ms(shortest_s)} to {format_ms(longest_s)}"
        )


def _heading(diagnosis: Diagnosis, source: Path) -> Iterator[str]:
    yield from _comment(f"Written by slrig doctor, from {source.name}.")
    if diagnosis.refresh_hz is not None:
        yield from _comment(f"The display refreshes {diagnosis.refresh_hz:.2f} times a second.")
    if diagnosis.response is not None:
        yield from _comment(f"Light grows with the grey value to the power of {diagnosis.response.gamma:.2f}.")
    for severity in (Severity.FAULT, Severity.NOTE):
        for finding in diagnosis.with_severity(severity):
            yield from _comment(f"{severity.capitalize()}, {finding.subject}: {finding.found}. Do: {finding.remedy}.")
    yield ""


def _comment(text: str) -> list[str]:
    return textwrap.wrap(" ".join(text.split()), _WIDTH, initial_indent="# ", subsequent_indent="#   ")


def _rebase_paths(value: Any, old: Path, new: Path) -> Any:
    """Return the value with every text that names a file or folder relative to `old` made relative to `new`."""
    if isinstance(value, Mapping):
        return {key: _rebase_paths(each, old, new) for key, each in value.items()}
    if isinstance(value, list):
        return [_rebase_paths(each, old, new) for each in value]
    if isinstance(value, str) and value and not Path(value).is_absolute() and _exists(old / value):
        return Path(os.path.relpath((old / value).resolve(), new)).as_posix()
    return value


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _table_lines(table: Mapping[str, Any], path: KeyPath, comments: Comments) -> Iterator[str]:
    """Yield the lines of a table: its values, then its tables, then its arrays of tables."""
    for key, value in table.items():
        if not _is_table(value):
            if (*path, key) in comments:
                yield from _comment(comments[(*path, key)])
            yield f"{_format_key(key)} = {toml_value(value)}"
    for key, value in table.items():
        if not _is_table(value):
            continue
        for number, each in enumerate(value if isinstance(value, list) else [value]):
            inner: KeyPath = (*path, key, number) if isinstance(value, list) else (*path, key)
            name = ".".join(_format_key(step) for step in inner if isinstance(step, str))
            yield ""
            yield f"[[{name}]]" if isinstance(value, list) else f"[{name}]"
            yield from _table_lines(each, inner, comments)


def _is_table(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(isinstance(each, Mapping) for each in value)
    return isinstance(value, Mapping)


def _format_key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _quote(key)


def toml_value(value: Any) -> str:
    """Return a TOML value on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _quote(value)
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_format_key(key)} = {toml_value(each)}" for key, each in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    # Python's integers and floats are valid TOML.
    return repr(value)


def _quote(text: str) -> str:
    """Return a TOML basic string, which is a JSON string with DEL escaped as well."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")

"""Rig file with the values that an examination measured, each with a comment that gives the reason.

What a person wrote stays as it is written, comments and order too.
"""

from __future__ import annotations

import datetime
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from slrig.bundle import read_text, write_durably
from slrig.config import MAX_CONFIG_BYTES, read_rig
from slrig.devices import Synchronisation
from slrig.disk import staging_name, storage_errors
from slrig.doctor.advice import ExposureAdvice
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.light import format_ms
from slrig.errors import ConfigError

_SYNC = "synchronisation"

_LEAST_STAMP_ERROR_S = 1e-4
"""Smaller errors of time stamps make no difference between exposures."""
_BARE = re.compile(r"[A-Za-z0-9_-]+")


def write_rig_file(diagnosis: Diagnosis, source: Path, target: Path, *, force: bool) -> None:
    """Write the rig file `source` to `target` with the measured exposures, lines and table [synchronisation].

    All other values stay; paths relative to the one file become relative to the other. Raises ConfigError if the target
    exists and `force` is False; StorageError.
    """
    refuse_existing(target, force=force)
    text = read_text(source, MAX_CONFIG_BYTES, ConfigError)
    old, new = source.resolve().parent, target.resolve().parent
    if old != new:
        tables = tomlkit.parse(text)
        _rebase_paths(tables, old, new)
        text = tomlkit.dumps(tables)
    text = with_diagnosis(text, diagnosis)
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


def with_diagnosis(text: str, diagnosis: Diagnosis) -> str:
    """The text of a rig file with what the doctor measured: exposures, lines, latency, period of the trigger."""
    tables = tomlkit.parse(text)
    _set_exposures(tables, diagnosis.exposures)
    lines = diagnosis.lines
    if lines is not None:
        table = _table(tables, "scan")
        # These belong to the old period; their defaults follow the new one.
        for key in () if lines.sines else ("line_width_px", "gray_cell_px"):
            table.pop(key, None)
        words = f"{lines.reason}; {lines.gain_text} is expected"
        for key, value in lines.options.items():
            put_value(table, key, value, words)
            words = ""
    if diagnosis.synchronisation is not None:
        _set_synchronisation(tables, diagnosis.synchronisation)
    if diagnosis.trigger_period_s is not None:
        words = "measured by wire: the least time between pulses that all cameras follow"
        put_value(_table(tables, _SYNC), "trigger_period_s", round(diagnosis.trigger_period_s, 6), words)
    return tomlkit.dumps(tables)


def with_synchronisation(text: str, measured: Synchronisation) -> str:
    """The text of a rig file with a measured latency."""
    tables = tomlkit.parse(text)
    _set_synchronisation(tables, measured)
    return tomlkit.dumps(tables)


def put_value(table: Any, key: str, value: float | bool | None, words: str = "") -> None:
    """Set a value of a table, and why; one that is the same already keeps its words. value : None removes it."""
    if value is None:
        table.pop(key, None)
    elif table.get(key) != value:
        table[key] = value
        if words:
            table.item(key).comment(words)


def _table(tables: Any, key: str) -> Any:
    if key not in tables:
        tables[key] = tomlkit.table()
    return tables[key]


def _set_synchronisation(tables: Any, measured: Synchronisation) -> None:
    table = _table(tables, _SYNC)
    words = "measured by flashes: mean delay of the light after the instant that the projector states"
    put_value(table, "latency_s", round(measured.latency_s, 6), words)
    words = "and the longest further delay, beyond the error that the projector states; scans wait for both"
    put_value(table, "latency_error_s", round(measured.latency_error_s, 6), words)
    words = "earliest instant of a change: with it, scans show the next pattern before the frames have arrived"
    put_value(table, "earliest_s", None if measured.earliest_s is None else round(measured.earliest_s, 6), words)
    words = "measured: a rolling shutter exposes each row this much later than the row above it"
    line_time_s = {name: round(seconds, 9) for name, seconds in (measured.line_time_s or {}).items()}
    _put_table(table, "line_time_s", line_time_s, words)
    words = "of the time stamps meanwhile; at other exposures, frames keep the difference from changes of light"
    _put_table(table, "stamp_error_s", known_stamp_errors_s(measured), words)


def _put_table(table: Any, key: str, values: Mapping[str, float], words: str) -> None:
    """Set a table within a table; without values there is none."""
    if not values:
        table.pop(key, None)
        return
    inner = _table(table, key)
    for name in set(inner) - set(values):
        inner.pop(name)
    for name, value in values.items():
        put_value(inner, name, value, words)


def known_stamp_errors_s(measured: Synchronisation) -> dict[str, float]:
    """The errors of time stamps that are worth a line of a rig file."""
    errors_s = measured.stamp_error_s.items()
    return {name: round(error_s, 6) for name, error_s in errors_s if error_s > _LEAST_STAMP_ERROR_S}


def _set_exposures(tables: Any, exposures: Mapping[str, ExposureAdvice]) -> None:
    """Write the exposure of each camera, or of a head, and remove the one of [scan], which would override them."""
    if not exposures:
        return
    if "scan" in tables:
        tables["scan"].pop("exposure_s", None)
    advised = [
        (camera, exposures[camera["name"]]) for camera in tables.get("camera", ()) if camera["name"] in exposures
    ]
    if "head" in tables:
        advised = [(tables["head"], min(exposures.values(), key=lambda each: each.exposure_s))]
    for table, advice in advised:
        shortest_s, longest_s = advice.usable_s
        words = f"{advice.reason}; usable are {format_ms(shortest_s)} to {format_ms(longest_s)}"
        put_value(table, "exposure_s", float(f"{advice.exposure_s:.6g}"), words)


def _rebase_paths(table: Any, old: Path, new: Path) -> None:
    """Make every text that names a file or folder relative to `old` relative to `new`, in tables and lists too."""
    for key, value in table.items() if isinstance(table, Mapping) else enumerate(table):
        if isinstance(value, Mapping | list):
            _rebase_paths(value, old, new)
        elif isinstance(value, str) and value and not Path(value).is_absolute() and _exists(old / value):
            table[key] = Path(os.path.relpath((old / value).resolve(), new)).as_posix()


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


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

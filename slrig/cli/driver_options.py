"""`slrig devices --options DRIVER`: what a rig file may say to a driver, told from the driver's own model."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import typer

from slrig.cli.display import print_json
from slrig.discovery import driver_kinds, option_model

Schema = Mapping[str, Any]

_TABLES = {"camera": "[[camera]]", "projector": "[projector]", "head": "[head]", "positioner": "[positioner]"}
_HEADS = "driver, exposure_s and gain"
_OWN = {"camera": f"name, {_HEADS}", "projector": "driver", "head": _HEADS, "positioner": "driver"}
# The end of an option's name, the longer first, and its unit.
_UNITS = {
    **{"px_s": "px/s", "mm_s": "mm/s", "bytes": "bytes", "deg": "°", "dn": "DN", "hz": "Hz", "mm": "mm", "ms": "ms"},
    **{"ns": "ns", "px": "px", "us": "µs", "e": "e⁻", "k": "K", "s": "s"},
}
_TYPES = {"string": "text", "boolean": "true/false", "object": "table"}
_WIDEST = 100
_INDENT = " " * 4


@dataclass(frozen=True, slots=True)
class Option:
    """A key of a table in a rig file. limits : range or choices, in words; "" where there are none."""

    name: str
    kind: str
    unit: str
    default: str
    limits: str
    meaning: str


@dataclass(frozen=True, slots=True)
class Section:
    """A table of a rig file, and the driver's keys in it."""

    heading: str
    options: tuple[Option, ...]


def tell_options(driver: str, *, as_json: bool) -> None:
    """Print the options of a driver, for people or as JSON Schema.

    Raises
    ------
    DriverNotFoundError, DriverBrokenError
        There is no such driver, or what describes its options cannot be loaded.
    """
    kinds, model = driver_kinds(driver), option_model(driver)
    if as_json:
        print_json({} if model is None else model.model_json_schema())
        return
    if model is None:
        typer.echo(f"driver '{driver}' does not describe its options; they are in the manual of its package")
        return
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    for kind in kinds:
        own = f"Options of the {kind} driver {driver}. Every {_TABLES[kind]} table also takes {_OWN[kind]}."
        lines = _lines(sections(model.model_json_schema(), kind), width)
        typer.echo("\n".join([*textwrap.wrap(own, width), "", *lines]))


def sections(schema: Schema, table: str) -> tuple[Section, ...]:
    """The options of a model, given as JSON Schema: its own first, then those of the tables in it."""
    return tuple(_sections(schema, schema, table, _TABLES.get(table, f"[{table}]")))


def option(name: str, part: Schema, schema: Schema, *, required: bool) -> Option:
    """What one property of a model's JSON Schema says. `schema` is the whole."""
    default = "required" if required else _value(part.get("default"))
    unit = part.get("unit") or next((unit for end, unit in _UNITS.items() if name.endswith(f"_{end}")), "–")
    meaning = " ".join(str(part.get("description", "")).split())
    return Option(name, _kind(part, schema), unit, default, _limits(part, schema), meaning)


def explained(told: Option) -> str:
    """What an option means, and what it may be."""
    limits = f"{told.limits[:1].upper()}{told.limits[1:]}." if told.limits else ""
    return f"{told.meaning} {limits}".strip()


def _sections(part: Schema, schema: Schema, path: str, heading: str) -> Iterator[Section]:
    properties: Mapping[str, Schema] = part.get("properties", {})
    required = part.get("required", ())
    yield Section(
        heading, tuple(option(name, each, schema, required=name in required) for name, each in properties.items())
    )
    for name, each in properties.items():
        inner = _resolved(each, schema)
        row = _resolved(inner.get("items", {}), schema)
        if "properties" in inner:
            yield from _sections(inner, schema, f"{path}.{name}", f"[{path}.{name}]")
        elif "properties" in row:
            yield from _sections(row, schema, f"{path}.{name}", f"[[{path}.{name}]]")


def _resolved(part: Schema, schema: Schema) -> Schema:
    """A part without its reference, and without the null of what may be left out: TOML has none."""
    several = [each for each in part.get("anyOf", ()) if each.get("type") != "null"]
    if len(several) == 1:
        return _resolved(several[0], schema)
    if "$ref" in part:
        defined: Schema = schema["$defs"][part["$ref"].rpartition("/")[2]]
        return defined
    return {**part, "anyOf": several} if several else part


def _kind(part: Schema, schema: Schema) -> str:
    part = _resolved(part, schema)
    if "anyOf" in part:
        return " or ".join(dict.fromkeys(_kind(each, schema) for each in part["anyOf"]))
    if "prefixItems" in part:
        one, count = _kind(part["prefixItems"][0], schema), len(part["prefixItems"])
        return f"{count} × {one}" if one[0].isdigit() else f"{count} {one}s"
    if part.get("type") == "array":
        return f"list of {_kind(part['items'], schema)}s"
    if isinstance(part.get("additionalProperties"), Mapping) and "type" in part["additionalProperties"]:
        return f"table of {_kind(part['additionalProperties'], schema)}s"
    kind = str(part.get("type", "any"))
    return _TYPES.get(kind, kind)


def _limits(part: Schema, schema: Schema) -> str:
    part = _resolved(part, schema)
    if "anyOf" in part:
        return ", or ".join(filter(None, (_limits(each, schema) for each in part["anyOf"])))
    if "enum" in part:
        return f"one of {', '.join(map(str, part['enum']))}"
    if "const" in part:
        return str(part["const"])
    if within := [*part.get("prefixItems", ())[:1], *filter(None, [part.get("items")])]:
        limits = _limits(within[0], schema)
        return f"each {limits.removeprefix('each ')}" if limits else ""
    least = f"above {part['exclusiveMinimum']}" if "exclusiveMinimum" in part else part.get("minimum")
    most = f"below {part['exclusiveMaximum']}" if "exclusiveMaximum" in part else part.get("maximum")
    if least is not None and most is not None:
        return f"{least} to {most}"
    if least is not None:
        return str(least) if "exclusiveMinimum" in part else f"at least {least}"
    if most is not None:
        return str(most) if "exclusiveMaximum" in part else f"at most {most}"
    return ""


def _value(value: object) -> str:
    """A default as a rig file would have it; "–" where the meaning says what holds."""
    match value:
        case bool():
            return "true" if value else "false"
        case list() if not value:
            return "none"
        case list():
            return f"[{', '.join(map(_value, value))}]"
        case None | dict():
            return "–"
        case "":
            return '""'
        case _:
            return str(value).removesuffix(".0")


def _lines(told: Sequence[Section], width: int) -> Iterator[str]:
    """A row per option, and what it means below it: four columns and a sentence do not fit side by side."""
    rows = [("option", "type", "unit", "default")]
    rows += [(each.name, each.kind, each.unit, each.default) for part in told for each in part.options]
    wide = [max(len(row[column]) for row in rows) for column in range(3)]

    def row(name: str, kind: str, unit: str, default: str) -> str:
        shown = typer.style(name.ljust(wide[0]), bold=True)
        return f"{shown}  {kind.ljust(wide[1])}  {unit.ljust(wide[2])}  {default}"

    yield row(*rows[0])
    for part in told:
        yield f"\n{part.heading}"
        for each in part.options:
            yield row(each.name, each.kind, each.unit, each.default)
            yield from textwrap.wrap(explained(each), width, initial_indent=_INDENT, subsequent_indent=_INDENT)

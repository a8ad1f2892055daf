"""`slrig init`, from plugged-in devices to a rig file that the models of its drivers check before it is written; `slrig
devices`, with options of drivers.
"""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from slrig.bundle import describe_errors, model_keys, write_file
from slrig.cli.display import print_json
from slrig.config import parse_rig
from slrig.devices import FoundDevice
from slrig.discovery import (
    DiscoveredDevices,
    InstalledDriver,
    discover_devices,
    driver_kinds,
    installed_drivers,
    option_model,
)
from slrig.disk import storage_errors
from slrig.doctor import refuse_existing, toml_value
from slrig.errors import ConfigError, DeviceGoneError
from slrig.examples import copy_example

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
_MAX_OPTION_WIDTH = 100
_INDENT = " " * 4


@dataclass(frozen=True, slots=True)
class Option:
    """A key of a table in a rig file. limits : range or choices, as text; "" where there are none."""

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


def print_options(driver: str, *, as_json: bool) -> None:
    """Print the options of a driver, for people or as JSON Schema.

    Raises
    ------
    DriverNotFoundError, DriverBrokenError
        There is no such driver, or the description of its options cannot be loaded.
    """
    kinds, model = driver_kinds(driver), option_model(driver)
    if as_json:
        print_json({} if model is None else model.model_json_schema())
        return
    if model is None:
        typer.echo(f"driver '{driver}' does not describe its options; they are in the manual of its package")
        return
    width = min(shutil.get_terminal_size().columns, _MAX_OPTION_WIDTH)
    for kind in kinds:
        own = f"Options of the {kind} driver {driver}. Every {_TABLES[kind]} table also takes {_OWN[kind]}."
        lines = _option_lines(sections(model.model_json_schema(), kind), width)
        typer.echo("\n".join([*textwrap.wrap(own, width), "", *lines]))


def sections(schema: Schema, table: str) -> tuple[Section, ...]:
    """The options of a model, given as JSON Schema: its own first, then those of the tables in it."""
    return tuple(_sections(schema, schema, table, _TABLES.get(table, f"[{table}]")))


def option(name: str, part: Schema, schema: Schema, *, required: bool) -> Option:
    """An option by one property of a model's JSON Schema. `schema` is the whole."""
    default = "required" if required else _value(part.get("default"))
    unit = part.get("unit") or next((unit for end, unit in _UNITS.items() if name.endswith(f"_{end}")), "–")
    meaning = " ".join(str(part.get("description", "")).split())
    return Option(name, _kind(part, schema), unit, default, _limits(part, schema), meaning)


def explained(option: Option) -> str:
    """Meaning and limits of an option."""
    limits = f"{option.limits[:1].upper()}{option.limits[1:]}." if option.limits else ""
    return f"{option.meaning} {limits}".strip()


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


def _option_lines(sections: Sequence[Section], width: int) -> Iterator[str]:
    """A row per option, and its meaning below it: four columns and a sentence do not fit side by side."""
    rows = [("option", "type", "unit", "default")]
    rows += [(each.name, each.kind, each.unit, each.default) for part in sections for each in part.options]
    wide = [max(len(row[column]) for row in rows) for column in range(3)]

    def row(name: str, kind: str, unit: str, default: str) -> str:
        shown = typer.style(name.ljust(wide[0]), bold=True)
        return f"{shown}  {kind.ljust(wide[1])}  {unit.ljust(wide[2])}  {default}"

    yield row(*rows[0])
    for part in sections:
        yield f"\n{part.heading}"
        for each in part.options:
            yield row(each.name, each.kind, each.unit, each.default)
            yield from textwrap.wrap(explained(each), width, initial_indent=_INDENT, subsequent_indent=_INDENT)


Answer = TypeVar("Answer")

_NAMES = {1: ("camera",), 2: ("left", "right")}
_KINDS = {bool: "boolean", int: "integer", float: "number", str: "string", list: "array", dict: "object"}
_WIDTH, _WIDEST = 80, 100
"""Columns of the file, and the most of messages."""
_USUAL_EXPOSURE_S = 0.0167
"""A period of 60 Hz."""


@dataclass(frozen=True, slots=True)
class RigFileTable:
    """A table of the rig file: the projector's or a camera's. label : what the device is, for people."""

    kind: str
    driver: str
    label: str
    options: dict[str, Any]
    name: str

    @property
    def title(self) -> str:
        """The device's name for people."""
        return f"{'camera ' + repr(self.name) if self.kind == 'camera' else 'the projector'} (driver {self.driver})"


def init(
    output: Path,
    *,
    name: str,
    cameras: Sequence[str],
    projector: str | None,
    settings: Sequence[str],
    exposure_s: float | None,
    yes: bool,
    force: bool,
) -> None:
    """Write a rig file for what is plugged in or named, and say what comes next.

    cameras : [NAME=]DRIVER[:DEVICE]; projector : DRIVER[:DEVICE]; settings : TABLE.KEY=VALUE.

    Raises ConfigError where a file would be overwritten, an answer is wrong, or something is not known and
    cannot be asked; DeviceGoneError where no camera or no projector is plugged in, and none is named; another
    SlrigError where a named driver is not installed or broken, or the disk refused.
    """
    refuse_existing(output, force=force)
    ask = not yes and terminal()
    found = discover_devices()
    named = {
        "camera": _named_cameras(cameras, found),
        "projector": [] if projector is None else [_named("projector", projector, found, "projector")],
    }
    offered = {
        kind: [device for device in found.devices if kind in driver_kinds(device.driver)]
        for kind in ("camera", "projector", "head")
    }
    lacking = [kind for kind, parts in named.items() if not parts and not offered[kind]]
    if lacking:
        raise DeviceGoneError(_nothing_there(lacking, offered, found))
    shot = named["camera"] or _chosen_cameras(offered["camera"], ask=ask)
    (lit,) = named["projector"] or [_chosen_projector(offered["projector"], ask=ask)]
    exposure_s = _exposure_s(exposure_s, ask=ask)
    parts = {part.name: part for part in (lit, *shot)}
    for each in settings:
        _assign(each, parts)
    for part in (lit, *shot):
        _complete(part, ask=ask)
    write_file(output, rig_text(output, name, lit, shot, exposure_s).encode())
    _print_next_steps(lit, shot, output)


def write_example(name: str, output: Path, *, force: bool) -> None:
    """Write an example's rig file and its scene. Raises ConfigError, StorageError."""
    refuse_existing(output, force=force)
    with storage_errors(output):
        copy_example(name, output)
    _say(f"Wrote {output}. Change it; slrig demo {output} scans with it, slrig serve {output} starts its service.")


def terminal() -> bool:
    """Whether there is a person to ask."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _named_cameras(texts: Sequence[str], found: DiscoveredDevices) -> list[RigFileTable]:
    parts = []
    for number, text in enumerate(texts):
        name, _, rest = text.partition("=") if "=" in text.partition(":")[0] else ("", "", text)
        parts.append(_named("camera", rest, found, name or _name(number, len(texts))))
    return parts


def _named(kind: str, text: str, found: DiscoveredDevices, name: str) -> RigFileTable:
    """The device of DRIVER:DEVICE; a driver alone means its only device. Raises ConfigError, DriverNotFoundError."""
    driver, _, device = text.partition(":")
    kinds = driver_kinds(driver)
    if kind not in kinds:
        message = f"--{kind} {text}: driver '{driver}' opens a {' and a '.join(kinds)}, no {kind}; see slrig devices"
        raise ConfigError(message)
    devices = [each for each in found.devices if each.driver == driver]
    if not device and len(devices) > 1:
        message = f"--{kind} {text}: {_listed(devices)}; name one of them: --{kind} {driver}:{devices[0].device}"
        raise ConfigError(message)
    found_one = next((each for each in devices if device in ("", each.device)), FoundDevice(driver, device, ""))
    return _part(kind, found_one, name)


def _part(kind: str, found: FoundDevice, name: str) -> RigFileTable:
    """The table of a device. It is named by the option of which the driver's model says `json_schema_extra={"takes":
    "device"}`, else by `device`.
    """
    driver, device, label = found.driver, found.device, found.label
    if not device:
        return RigFileTable(kind, driver, label, {}, name)
    known = _properties(driver)
    key = next((key for key, part in known.items() if part.get("takes") == "device"), "device")
    named = {key: typed(device, json_types(known.get(key, {"type": "string"})))}
    return RigFileTable(kind, driver, label, {**named, **found.options}, name)


def _chosen_cameras(offered: Sequence[FoundDevice], *, ask: bool) -> list[RigFileTable]:
    chosen = list(offered)
    if ask:
        _offer("Cameras", offered)
        everyone = " ".join(str(number + 1) for number in range(len(offered)))
        _say("Give the numbers of those of the rig, left to right; one that holds several cameras may be given twice.")
        chosen = _ask("Cameras", everyone, lambda text: [_numbered(offered, each) for each in text.split()])
    return [_part("camera", each, _name(number, len(chosen))) for number, each in enumerate(chosen)]


def _chosen_projector(offered: Sequence[FoundDevice], *, ask: bool) -> RigFileTable:
    if len(offered) > 1 and not ask:
        one = f"{offered[0].driver}:{offered[0].device}"
        message = f"{len(offered)} devices may be the projector: {_listed(offered)}; name it: --projector {one}"
        raise ConfigError(message)
    chosen = offered[0]
    if ask:
        _offer("Projectors", offered)
        usual = "1" if len(offered) == 1 else None
        chosen = _ask("Projector", usual, lambda text: _numbered(offered, text))
    return _part("projector", chosen, "projector")


def _exposure_s(given: float | None, *, ask: bool) -> float:
    if given is None and ask:
        _say("\nOn a video projector, expose for whole refresh periods: 0.0167 s, 0.0333 s and so on at 60 Hz.")
        return _ask("Exposure, s", str(_USUAL_EXPOSURE_S), float)
    return _USUAL_EXPOSURE_S if given is None else given


def _assign(text: str, parts: Mapping[str, RigFileTable]) -> None:
    """Set the option of TABLE.KEY=VALUE. Raises ConfigError."""
    table, dot, rest = text.partition(".")
    key, equals, value = rest.partition("=")
    if not (dot and equals and key) or table not in parts:
        message = (
            f"--set {text}: expected TABLE.KEY=VALUE with a table of {', '.join(parts)}; for example "
            f"--set {[*parts][:2][-1]}.gain=1.5"
        )
        raise ConfigError(message)
    part = parts[table]
    part.options[key] = typed(value, json_types(_properties(part.driver).get(key, {})))


def _complete(part: RigFileTable, *, ask: bool) -> None:
    """Ask for options that the driver needs and the rig file lacks. Raises ConfigError where that is not possible."""
    model = option_model(part.driver)
    schema = {} if model is None else model.model_json_schema()
    for name in [each for each in schema.get("required", ()) if each not in part.options]:
        needed = schema["properties"][name]
        text = f"{part.title} needs {name}: {explained(option(name, needed, schema, required=True))}"
        if not ask:
            message = f"{text}\n  say it with --set {part.name}.{name}=VALUE"
            raise ConfigError(message)
        _say(f"\n{text}")

        def answer(text: str, key: str = name, kinds: Collection[str] = json_types(needed)) -> object:
            value = typed(text, kinds)
            if fault := failure_of(part.driver, {**part.options, key: value}, key):
                raise ConfigError(fault)
            return value

        part.options[name] = _ask(name, None, answer)


def _ask(question: str, usual: str | None, read: Callable[[str], Answer]) -> Answer:
    """Ask until the answer can be read."""
    while True:
        text = str(typer.prompt(question, default=usual)).strip()
        try:
            return read(text)
        except (ConfigError, ValueError) as error:
            _say(str(error).strip())


def _say(text: str) -> None:
    """Print a sentence that fits the terminal."""
    if text.startswith("\n"):
        typer.echo()
    typer.echo(textwrap.fill(text.strip(), min(shutil.get_terminal_size().columns, _WIDEST)))


def _numbered(offered: Sequence[FoundDevice], text: str) -> FoundDevice:
    if not text.isdigit() or not 1 <= int(text) <= len(offered):
        message = f"expected a number from 1 to {len(offered)}, found '{text}'"
        raise ConfigError(message)
    return offered[int(text) - 1]


def _name(number: int, count: int) -> str:
    return _NAMES[count][number] if count in _NAMES else f"camera{number + 1}"


def _offer(title: str, offered: Sequence[FoundDevice]) -> None:
    typer.echo(f"\n{title} that are plugged in:")
    for number, device in enumerate(offered, 1):
        typer.echo(f"  {number}  {device.label}\n     {device.driver}:{device.device}")


def _listed(devices: Sequence[FoundDevice]) -> str:
    return "".join(f"\n  {each.driver}:{each.device}  {each.label}" for each in devices) + "\n"


def _nothing_there(
    lacking: Sequence[str], offered: Mapping[str, Sequence[FoundDevice]], found: DiscoveredDevices
) -> str:
    """Message about a camera or a projector that is neither named nor plugged in, with what to check."""
    there = [f"{each.driver}:{each.device}" for kind in ("camera", "projector") for each in offered[kind]]
    flags = " ".join(f"--{kind} DRIVER:DEVICE" for kind in lacking)
    screen = (
        "a projector on HDMI must be on, and a display of its own in a session of X (see DISPLAY), or without a desktop"
    )
    lines = [
        f"no {' and no '.join(lacking)} is plugged in that an installed driver can find",
        *([f"found: {', '.join(there)}"] if there else []),
        "check cable and power, and your right to open the device: slrig devices lists what it finds",
        *([screen] if "projector" in lacking else []),
        *(f"more can be found after, for {each.driver}: {each.install}" for each in found.missing),
        *(f"not looked for: {fault}" for fault in found.faults),
        *(
            f"{head.driver}:{head.device} is camera and projector in one: write a [head] table for it"
            for head in offered["head"]
        ),
        f"name what cannot be found: slrig init {flags}",
        "without any hardware there is a rendered rig: slrig demo, or slrig serve demo",
    ]
    return "\n  ".join(lines)


def _print_next_steps(projector: RigFileTable, cameras: Sequence[RigFileTable], output: Path) -> None:
    named = ", ".join(f"{each.name} ({each.driver})" for each in cameras)
    _say(f"\nWrote {output}: projector ({projector.driver}), {named}. No device was opened. Next:")
    better = output.with_stem(f"{output.stem}-measured")
    steps = (
        (f"slrig doctor {output} --output {better}", "light, focus, timing; a file with the measured values"),
        (f"slrig serve {better}", "the service; it prints a key for the next steps"),
        ("slrig calibrate board --output board.pdf", "a board to print"),
        ("slrig calibrate run", "walks you through its poses"),
        ("slrig scan", "the first mesh"),
    )
    for number, (command, why) in enumerate(steps, 1):
        typer.echo(f"  {number}. {command}\n     {why}")
    typer.echo("To have Tab complete commands and options in this shell: slrig --install-completion")


def _properties(driver: str) -> Mapping[str, Any]:
    """The options of a driver by name, as JSON Schema; none where it does not describe them."""
    model = option_model(driver)
    return {} if model is None else model.model_json_schema()["properties"]


def json_types(part: Mapping[str, Any]) -> frozenset[str]:
    """The JSON types that a property takes; none where its schema names none."""
    several = [json_types(each) for each in part.get("anyOf", ())]
    return frozenset({part["type"]} if "type" in part else set()).union(*several)


def typed(text: str, kinds: Collection[str]) -> object:
    """A typed value: TOML where the option takes such a value, else text.

    >>> typed("0", frozenset({"integer", "string"})), typed("0", frozenset({"string"})), typed("CAM_B", frozenset())
    (0, '0', 'CAM_B')
    """
    try:
        data = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    kind = _KINDS.get(type(data["value"]))
    fits = not kinds or kind in kinds or (kind == "integer" and "number" in kinds)
    return data["value"] if kind is not None and fits and len(data) == 1 else text


def failure_of(driver: str, options: Mapping[str, object], key: str = "") -> str:
    """Faults of options by the driver's model, of one of them or of all; "" where it takes them."""
    model = option_model(driver)
    if model is None:
        return ""
    try:
        model.model_validate(dict(options))
    except ValidationError as cause:
        if not key or any(fault["loc"][:1] == (key,) for fault in cause.errors()):
            return describe_errors(cause, options, model_keys(model))
    return ""


def rig_text(path: Path, name: str, projector: RigFileTable, cameras: Sequence[RigFileTable], exposure_s: float) -> str:
    """Return the file's text, which was read again and checked by every driver's model. Raises ConfigError.

    exposure_s : of every camera that has none of its own.
    """
    text = "\n".join(_lines(name, projector, cameras, exposure_s)) + "\n"
    rig = parse_rig(tomllib.loads(text), path)
    tables = {f"camera '{table.name}'": table for table in rig.cameras} | {"the projector": rig.projector}
    faults = [
        f"driver '{table.driver}' does not take these options of {what}:\n{fault}"
        for what, table in tables.items()
        if table is not None and (fault := failure_of(table.driver, table.options))
    ]
    if faults:
        message = "\n".join([*faults, "nothing was written; every option: slrig devices --options DRIVER"])
        raise ConfigError(message)
    return text


def _lines(name: str, projector: RigFileTable, cameras: Sequence[RigFileTable], exposure_s: float) -> Iterator[str]:
    yield "# Written by slrig init. For every option: slrig devices --options DRIVER"
    yield f"name = {toml_value(name)}"
    yield '# calibration = "calibration.json"  # next to this file, once there is one'
    yield "\n[projector]"
    yield from _keys(projector)
    for number, camera in enumerate(cameras):
        yield "\n[[camera]]"
        yield f"name = {toml_value(camera.name)}"
        yield from _keys(camera, without="exposure_s")
        if number == 0:
            yield from _comment(
                "Whole refresh periods of a video projector (1/60 s at 60 Hz): in a part of one, colour wheel and lamp "
                "light some rows more than others. An engine that flashes its LEDs may take less."
            )
        yield f"exposure_s = {toml_value(camera.options.get('exposure_s', exposure_s))}"
    yield ""
    yield from _comment(
        "How late light comes is not known yet. slrig doctor measures it, and writes a rig file with it, in "
        "[synchronisation], and with the exposures that suit."
    )


def _keys(part: RigFileTable, *, without: str = "") -> Iterator[str]:
    if part.label:
        yield from _comment(part.label)
    yield f"driver = {toml_value(part.driver)}"
    yield from (f"{key} = {toml_value(value)}" for key, value in part.options.items() if key != without)


def _comment(text: str) -> list[str]:
    plain = "".join(each if each.isprintable() else " " for each in text)
    return textwrap.wrap(plain, _WIDTH, initial_indent="# ", subsequent_indent="# ")


_STDOUT, _STDERR = 1, 2


@dataclass(frozen=True, slots=True)
class BrokenPackage:
    """An installed package with a driver that cannot be loaded: why, and the command that removes the package."""

    package: str
    drivers: tuple[str, ...]
    fault: str
    remove: str


def list_devices(*, as_json: bool) -> None:
    """Print the installed drivers, the devices that are plugged in, and what is missing for more."""
    with _only_ours_on_stdout():
        drivers = installed_drivers()
        finders = sorted({driver.name for driver in drivers if driver.kind == "finder" and driver.fault is None})
        # Some query a network, and wait for answers.
        typer.echo(f"Looking for devices of {', '.join(finders)} …", err=True)
        found = discover_devices()
    if as_json:
        print_json(devices_document(drivers, found))
        return
    broken = broken_packages(drivers)
    console = Console()
    _print_drivers(drivers, found, console)
    _print_devices(found, console)
    _print_remedies(found, broken, {driver.fault for driver in drivers})


def devices_document(drivers: Sequence[InstalledDriver], found: DiscoveredDevices) -> dict[str, Any]:
    """The document of `slrig devices --json`."""
    return {
        "drivers": [asdict(driver) for driver in drivers],
        "devices": [{key: each for key, each in asdict(device).items() if each != {}} for device in found.devices],
        "missing": [asdict(library) for library in found.missing],
        "broken": [asdict(package) for package in broken_packages(drivers)],
        "elsewhere": [asdict(driver) for driver in found.elsewhere],
        "faults": [str(fault) for fault in found.faults],
    }


def broken_packages(drivers: Sequence[InstalledDriver]) -> tuple[BrokenPackage, ...]:
    """The packages with drivers that cannot be loaded, by name, each with the first of its faults."""
    faulty = [driver for driver in drivers if driver.fault is not None]
    return tuple(
        BrokenPackage(
            package,
            tuple(sorted({driver.name for driver in faulty if driver.package == package})),
            next(driver.fault or "" for driver in faulty if driver.package == package),
            f"pip uninstall {package}",
        )
        for package in sorted({driver.package for driver in faulty})
    )


def _print_drivers(drivers: Sequence[InstalledDriver], found: DiscoveredDevices, console: Console) -> None:
    missing = {library.driver for library in found.missing}
    elsewhere = {driver.driver for driver in found.elsewhere}
    table = _table("Installed drivers", "driver", "for a", "package", "state")
    for driver in drivers:
        if driver.kind == "finder":
            continue
        state = "ok"
        if driver.fault is not None:
            state = "broken, see below"
        elif driver.name in missing:
            state = "its library is missing, see below"
        elif driver.name in elsewhere:
            state = "not on this system, see below"
        elif any(f"'{driver.name}'" in str(fault) for fault in found.faults):
            state = "its search failed, see below"
        package = f"{driver.package} {driver.version}".strip()
        table.add_row(escape(driver.name), driver.kind, escape(package), state)
    console.print(table)
    console.print()


def _print_devices(found: DiscoveredDevices, console: Console) -> None:
    if not found.devices:
        console.print(
            "No device is plugged in that an installed driver can find. Check cable and power; if the system does see "
            "the device, check your right to open it. A rendered rig needs none: slrig demo"
        )
        return
    table = _table("Plugged-in devices", "driver", "device", "what it is")
    for device in found.devices:
        table.add_row(escape(device.driver), escape(device.device), escape(device.label))
    console.print(table)
    console.print("\nslrig init writes a rig file for them. Every option: slrig devices --options DRIVER")


def _print_remedies(found: DiscoveredDevices, broken: Sequence[BrokenPackage], printed: set[str | None]) -> None:
    # Neither wrapped nor styled: commands are there to be copied whole.
    if found.missing:
        typer.echo("\nMore devices can be used after:")
        for library in found.missing:
            typer.echo(f"  {library.driver}: {library.install}")
    if found.elsewhere:
        typer.echo("\nNot on this system:")
        for other in found.elsewhere:
            typer.echo(f"  {other.message}")
    for package in broken:
        names = ", ".join(package.drivers)
        typer.echo(f"\nBroken: package {package.package} (drivers: {names}); the others work without it.")
        typer.echo(f"  {package.fault}\n  to remove it: {package.remove}")
    # A finder that cannot be loaded was printed with its package.
    for fault in map(str, found.faults):
        if fault not in printed:
            typer.echo(f"\nNot looked for: {fault}")


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=None)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


@contextmanager
def _only_ours_on_stdout() -> Iterator[None]:
    """Send what drivers and their libraries, Python or not, write on standard output to standard error."""
    sys.stdout.flush()
    ours = os.dup(_STDOUT)
    try:
        os.dup2(_STDERR, _STDOUT)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(ours, _STDOUT)
        os.close(ours)

"""`slrig init`: from what is plugged in to a rig file, which the models of its drivers check before it is written.

What it cannot know it asks, or takes as options.
"""

from __future__ import annotations

import shutil
import sys
import textwrap
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import typer
from pydantic import ValidationError

from slrig.bundle import describe_errors, model_keys, write_file
from slrig.cli.driver_options import explained, option
from slrig.config import parse_rig
from slrig.devices import FoundDevice
from slrig.discovery import DiscoveredDevices, discover_devices, driver_kinds, option_model
from slrig.doctor import refuse_existing, toml_value
from slrig.errors import ConfigError, DeviceGoneError

Answer = TypeVar("Answer")

_NAMES = {1: ("camera",), 2: ("left", "right")}
_KINDS = {bool: "boolean", int: "integer", float: "number", str: "string", list: "array", dict: "object"}
_WIDTH, _WIDEST = 80, 100
"""Columns of the file, and the most of what is said."""
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
        """The device in words."""
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

    Raises ConfigError where a file would be overwritten, an answer is wrong, or something is not known and there is
    nobody to ask; DeviceGoneError where no camera or no projector is plugged in, and none is named; another SlrigError
    where a named driver is not installed or broken, or the disk refused.
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
    _tell(lit, shot, output)


def terminal() -> bool:
    """Whether somebody can be asked."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _named_cameras(texts: Sequence[str], found: DiscoveredDevices) -> list[RigFileTable]:
    parts = []
    for number, text in enumerate(texts):
        name, _, rest = text.partition("=") if "=" in text.partition(":")[0] else ("", "", text)
        parts.append(_named("camera", rest, found, name or _name(number, len(texts))))
    return parts


def _named(kind: str, text: str, found: DiscoveredDevices, name: str) -> RigFileTable:
    """What DRIVER:DEVICE means; a driver alone means its only device. Raises ConfigError, DriverNotFoundError."""
    driver, _, device = text.partition(":")
    kinds = driver_kinds(driver)
    if kind not in kinds:
        message = f"--{kind} {text}: driver '{driver}' opens a {' and a '.join(kinds)}, no {kind}; see slrig devices"
        raise ConfigError(message)
    devices = [each for each in found.devices if each.driver == driver]
    if not device and len(devices) > 1:
        message = f"--{kind} {text}: {_listed(devices)}; name one of them: --{kind} {driver}:{devices[0].device}"
        raise ConfigError(message)
    label = next((each.label for each in devices if device in ("", each.device)), "")
    return _part(kind, driver, device or next((each.device for each in devices), ""), label, name)


def _part(kind: str, driver: str, device: str, label: str, name: str) -> RigFileTable:
    """The table of a device. It is named by the option of which the driver's model says `json_schema_extra={"takes":
    "device"}`, else by `device`.
    """
    if not device:
        return RigFileTable(kind, driver, label, {}, name)
    known = _properties(driver)
    key = next((key for key, part in known.items() if part.get("takes") == "device"), "device")
    return RigFileTable(kind, driver, label, {key: typed(device, json_types(known.get(key, {"type": "string"})))}, name)


def _chosen_cameras(offered: Sequence[FoundDevice], *, ask: bool) -> list[RigFileTable]:
    chosen = list(offered)
    if ask:
        _offer("Cameras", offered)
        everyone = " ".join(str(number + 1) for number in range(len(offered)))
        _say("Give the numbers of those of the rig, left to right; one that holds several cameras may be given twice.")
        chosen = _ask("Cameras", everyone, lambda text: [_numbered(offered, each) for each in text.split()])
    return [
        _part("camera", each.driver, each.device, each.label, _name(number, len(chosen)))
        for number, each in enumerate(chosen)
    ]


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
    return _part("projector", chosen.driver, chosen.device, chosen.label, "projector")


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
    """Ask for what the driver needs and the rig file does not say. Raises ConfigError where there is nobody to ask."""
    model = option_model(part.driver)
    schema = {} if model is None else model.model_json_schema()
    for name in [each for each in schema.get("required", ()) if each not in part.options]:
        needed = schema["properties"][name]
        told = f"{part.title} needs {name}: {explained(option(name, needed, schema, required=True))}"
        if not ask:
            message = f"{told}\n  say it with --set {part.name}.{name}=VALUE"
            raise ConfigError(message)
        _say(f"\n{told}")

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
    """Words for a camera or a projector that is neither named nor plugged in, with what to check."""
    there = [f"{each.driver}:{each.device}" for kind in ("camera", "projector") for each in offered[kind]]
    flags = " ".join(f"--{kind} DRIVER:DEVICE" for kind in lacking)
    screen = (
        "a projector on HDMI must be on, and a display of its own in a session of X (see DISPLAY), or without a desktop"
    )
    lines = [
        f"no {' and no '.join(lacking)} is plugged in that an installed driver can find",
        *([f"found: {', '.join(there)}"] if there else []),
        "check cable and power, and your right to open the device: slrig devices tells what it sees",
        *([screen] if "projector" in lacking else []),
        *(f"more can be found after, for {each.driver}: {each.install}" for each in found.missing),
        *(f"not looked for: {fault}" for fault in found.faults),
        *(
            f"{head.driver}:{head.device} is camera and projector in one: write a [head] table for it"
            for head in offered["head"]
        ),
        f"name what cannot be found: slrig init {flags}",
        "without any hardware there is a rendered rig: slrig demo, or slrig serve config/rigs/demo.toml",
    ]
    return "\n  ".join(lines)


def _tell(projector: RigFileTable, cameras: Sequence[RigFileTable], output: Path) -> None:
    named = ", ".join(f"{each.name} ({each.driver})" for each in cameras)
    _say(f"\nWrote {output}: projector ({projector.driver}), {named}. No device was opened. Next:")
    better = output.with_stem(f"{output.stem}-measured")
    steps = (
        (f"slrig doctor {output} --output {better}", "light, focus, timing; a file with what it measured"),
        (f"slrig serve {better}", "the service; it prints a key for the next steps"),
        ("slrig calibrate board --output board.pdf", "a board to print"),
        ("slrig calibrate run", "walks you through its poses"),
        ("slrig scan", "the first mesh"),
    )
    for number, (command, why) in enumerate(steps, 1):
        typer.echo(f"  {number}. {command}\n     {why}")


def _properties(driver: str) -> Mapping[str, Any]:
    """The options of a driver by name, as JSON Schema; none where it does not describe them."""
    model = option_model(driver)
    return {} if model is None else model.model_json_schema()["properties"]


def json_types(part: Mapping[str, Any]) -> frozenset[str]:
    """The JSON types that a property takes; none where its schema names none."""
    several = [json_types(each) for each in part.get("anyOf", ())]
    return frozenset({part["type"]} if "type" in part else set()).union(*several)


def typed(text: str, kinds: Collection[str]) -> object:
    """What a person wrote as a value: TOML where the option takes such a value, else text.

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
    """What the driver's model says against options, of one of them or of all; "" where it takes them."""
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
    yield '# calibration = "calibration.json"  # beside this file, once there is one'
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

"""A rig file in the making: tables of devices, checked by the models of their drivers, and written with comments."""

from __future__ import annotations

import textwrap
import tomllib
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from slrig.bundle.faults import explain, keys_of
from slrig.cli.driver_options import explained, option
from slrig.config import rig_of
from slrig.doctor.rig_file import toml_value
from slrig.errors import ConfigError
from slrig.option_models import kinds_of, option_model

_WIDTH = 80
_KINDS = {bool: "boolean", int: "integer", float: "number", str: "string", list: "array", dict: "object"}


@dataclass(frozen=True, slots=True)
class Needed:
    """An option that a driver cannot do without. kinds : JSON types of its values. told : its meaning and limits."""

    name: str
    kinds: frozenset[str]
    told: str


@dataclass(frozen=True, slots=True)
class Part:
    """A table of a rig file: the projector's or a camera's. label : what the device is, for people."""

    kind: str
    driver: str
    label: str
    options: dict[str, Any]
    name: str

    @property
    def title(self) -> str:
        """The device in words."""
        return f"{'camera ' + repr(self.name) if self.kind == 'camera' else 'the projector'} (driver {self.driver})"

    def lacking(self) -> tuple[Needed, ...]:
        """The required options that are not set yet."""
        model = option_model(self.driver)
        if model is None:
            return ()
        schema = model.model_json_schema()
        return tuple(
            Needed(name, json_types(part), explained(option(name, part, schema, required=True)))
            for name, part in schema["properties"].items()
            if name in schema.get("required", ()) and name not in self.options
        )


@dataclass(frozen=True, slots=True)
class Draft:
    """What a rig file is going to say. exposure_s : of every camera that has none of its own."""

    name: str
    projector: Part
    cameras: tuple[Part, ...]
    exposure_s: float

    @property
    def parts(self) -> tuple[Part, ...]:
        """Projector and cameras, as in the file."""
        return (self.projector, *self.cameras)

    def with_settings(self, settings: Sequence[tuple[Part, str, object]]) -> Draft:
        """The same with options set."""
        changed = {id(part): dict(part.options) for part in self.parts}
        for part, key, value in settings:
            changed[id(part)][key] = value
        projector, *cameras = (replace(part, options=changed[id(part)]) for part in self.parts)
        return replace(self, projector=projector, cameras=tuple(cameras))


def split_device(text: str, kind: str) -> tuple[str, str]:
    """Driver and device of DRIVER[:DEVICE].

    Raises
    ------
    ConfigError, DriverNotFoundError
        The driver is not installed, or opens no such device.
    """
    driver, _, device = text.partition(":")
    kinds = kinds_of(driver)
    if kind not in kinds:
        message = f"--{kind} {text}: driver '{driver}' opens a {' and a '.join(kinds)}, no {kind}; see slrig devices"
        raise ConfigError(message)
    return driver, device


def split_assignment(text: str, draft: Draft) -> tuple[Part, str, object]:
    """Part, key and value of TABLE.KEY=VALUE. Raises ConfigError."""
    table, dot, rest = text.partition(".")
    key, equals, value = rest.partition("=")
    parts = {part.name: part for part in draft.parts}
    if not (dot and equals and key) or table not in parts:
        message = (
            f"--set {text}: expected TABLE.KEY=VALUE with a table of {', '.join(parts)}; for example "
            f"--set {draft.cameras[0].name}.gain=1.5"
        )
        raise ConfigError(message)
    model = option_model(parts[table].driver)
    known: Mapping[str, Any] = {} if model is None else model.model_json_schema()["properties"]
    return parts[table], key, typed(value, json_types(known.get(key, {})))


def device_key(driver: str) -> tuple[str, frozenset[str]]:
    """The option that takes what a finder of this driver lists, and the JSON types of its values.

    It is `device`, unless another field of the driver's model says `json_schema_extra={"takes": "device"}`.
    """
    model = option_model(driver)
    if model is None:
        return "device", frozenset({"string"})
    known: Mapping[str, Any] = model.model_json_schema()["properties"]
    key = next((name for name, part in known.items() if part.get("takes") == "device"), "device")
    return key, json_types(known.get(key, {"type": "string"}))


def json_types(part: Mapping[str, Any]) -> frozenset[str]:
    """The JSON types that a property takes; none where its schema names none."""
    several = [json_types(each) for each in part.get("anyOf", ())]
    return frozenset({part["type"]} if "type" in part else set()).union(*several)


def typed(text: str, kinds: frozenset[str]) -> object:
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
            return explain(cause, options, keys_of(model))
    return ""


def rig_text(draft: Draft, path: Path) -> str:
    """Return the file's text, which was read again and checked by every driver's model.

    Raises
    ------
    ConfigError
        A value is wrong.
    """
    text = "\n".join(_lines(draft)) + "\n"
    rig = rig_of(tomllib.loads(text), path)
    tables = [*rig.cameras, *([] if rig.projector is None else [rig.projector])]
    names = [*(f"camera '{table.name}'" for table in rig.cameras), "the projector"]
    faults = [
        f"driver '{table.driver}' does not take these options of {name}:\n{fault}"
        for name, table in zip(names, tables, strict=True)
        if (fault := failure_of(table.driver, table.options))
    ]
    if faults:
        message = "\n".join([*faults, "nothing was written; every option: slrig devices --options DRIVER"])
        raise ConfigError(message)
    return text


def _lines(draft: Draft) -> Iterator[str]:
    yield "# Written by slrig init. For every option: slrig devices --options DRIVER"
    yield f"name = {toml_value(draft.name)}"
    yield '# calibration = "calibration.json"  # beside this file, once there is one'
    yield "\n[projector]"
    yield from _part(draft.projector, set())
    for number, camera in enumerate(draft.cameras):
        yield "\n[[camera]]"
        yield f"name = {toml_value(camera.name)}"
        yield from _part(camera, {"exposure_s"})
        if number == 0:
            yield from _comment(
                "Whole refresh periods of a video projector (1/60 s at 60 Hz): in a part of one, colour wheel and lamp "
                "light some rows more than others. An engine that flashes its LEDs may take less."
            )
        yield f"exposure_s = {toml_value(camera.options.get('exposure_s', draft.exposure_s))}"
    yield ""
    yield from _comment(
        "How late light comes is not known yet. slrig doctor measures it, and writes a rig file with it, in "
        "[synchronisation], and with the exposures that suit."
    )


def _part(part: Part, without: Container[str]) -> Iterator[str]:
    if part.label:
        yield from _comment(part.label)
    yield f"driver = {toml_value(part.driver)}"
    yield from (f"{key} = {toml_value(value)}" for key, value in part.options.items() if key not in without)


def _comment(text: str) -> list[str]:
    plain = "".join(each if each.isprintable() else " " for each in text)
    return textwrap.wrap(plain, _WIDTH, initial_indent="# ", subsequent_indent="# ")

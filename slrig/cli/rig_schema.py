"""The JSON schema of rig files with the options of slrig's own drivers, for editors.

`python -m slrig.cli.rig_schema` prints it; it is kept as slrig/examples/schema.json.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from slrig.config import RigTable
from slrig.discovery import driver_kinds, drivers_with_options, option_model

PACKAGE = "slrig"
_NULL = {"type": "null"}
_TABLES = {"camera": "CameraTable", "projector": "DriverTable", "head": "HeadTable", "positioner": "DriverTable"}


def rig_schema() -> str:
    """The JSON schema, as text.

    A table of a driver that is known here is checked by `if` and `then`, which editors report well; the same driver's
    schema is among `anyOf` as well, where editors find keys to propose (Taplo does not read `then`). The last of these
    takes any driver.
    """
    models = {name: model for name in drivers_with_options(PACKAGE) if (model := option_model(name)) is not None}
    every: list[type[BaseModel]] = [RigTable, *models.values()]
    parts, whole = models_json_schema([(model, "validation") for model in every], ref_template="#/$defs/{model}")
    defined: dict[str, Any] = _as_in_toml(whole["$defs"])
    rig = defined.pop(_name(parts[RigTable, "validation"]))
    offered: dict[str, list[str]] = {kind: [] for kind in _TABLES}
    for driver, model in models.items():
        own = defined.pop(_name(parts[model, "validation"]))
        for kind in driver_kinds(driver):
            defined[f"{kind}_{driver}"] = _merged(defined[_TABLES[kind]], own, driver)
            offered[kind].append(driver)
    tables = {**rig["properties"], "camera": rig["properties"]["camera"]["items"]}
    for kind in _TABLES:
        table = tables[kind]
        plain = {"$ref": table.pop("$ref")}
        table["anyOf"] = [*({"$ref": _at(kind, driver)} for driver in offered[kind]), plain]
        table["allOf"] = [
            {
                "if": {"properties": {"driver": {"const": driver}}, "required": ["driver"]},
                "then": {"$ref": _at(kind, driver)},
            }
            for driver in offered[kind]
        ]
    document = {"$schema": "https://json-schema.org/draft/2020-12/schema", **rig, "$defs": defined}
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


def _merged(table: Mapping[str, Any], own: Mapping[str, Any], driver: str) -> dict[str, Any]:
    """A table of the rig file with the keys of a driver. No other key is known then."""
    named = {"driver": {**table["properties"]["driver"], "const": driver}}
    return {
        **own,
        "properties": {**table["properties"], **named, **own["properties"]},
        "required": [*table["required"], *own.get("required", ())],
        "additionalProperties": False,
    }


def _name(part: Mapping[str, Any]) -> str:
    return str(part["$ref"]).rpartition("/")[2]


def _at(kind: str, driver: str) -> str:
    return f"#/$defs/{kind}_{driver}"


def _as_in_toml(part: Any) -> Any:
    """The same without null, which TOML has not, and with descriptions that are not wrapped as in the source."""
    if isinstance(part, list):
        return [_as_in_toml(each) for each in part]
    if not isinstance(part, dict):
        return part
    kept = {key: _as_in_toml(each) for key, each in part.items() if (key, each) != ("default", None)}
    if isinstance(kept.get("description"), str):
        kept["description"] = " ".join(kept["description"].split())
    if _NULL in kept.get("anyOf", ()):
        several = [each for each in kept.pop("anyOf") if each != _NULL]
        kept = {**kept, **several[0]} if len(several) == 1 else {**kept, "anyOf": several}
    return kept


if __name__ == "__main__":
    sys.stdout.write(rig_schema())

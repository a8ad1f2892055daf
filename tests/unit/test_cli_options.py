"""`slrig devices --options`: a driver's options for people and as JSON Schema, and the schema that editors read."""

from __future__ import annotations

import importlib.metadata
import json
import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, Field

from slrig.cli.driver_options import Option, sections
from slrig.cli.rig_schema import rig_schema
from tests.unit.command import slrig

RIGS = sorted((Path(__file__).resolve().parents[2] / "config" / "rigs").glob("*.toml"))
HERE = __name__
DECLARED = f"""
[slrig.cameras]
undescribed = {HERE}:open_camera
strange = {HERE}:open_camera
unloadable = {HERE}:open_camera
[slrig.projectors]
two_sided = {HERE}:open_camera
[slrig.heads]
two_sided = {HERE}:open_camera
[slrig.options]
strange = {HERE}:open_camera
unloadable = no_such_module:Options
two_sided = {HERE}:Sample
"""


def open_camera() -> None:
    """Stands for a factory: nothing here opens it."""


class Row(BaseModel):
    """A table in the table."""

    width_px: int = Field(description="How wide.")


class Sample(BaseModel):
    """An option of every kind."""

    choice: Literal["a", "b"] = Field(default="a", description="Which.")
    share: Annotated[float, Field(gt=0, lt=1)] = 0.5
    turn_deg: Annotated[float, Field(le=90)] | None = None
    rate: int = Field(default=9600, ge=1, json_schema_extra={"unit": "bit/s"})
    size_px: Annotated[tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]], Field(strict=False)]
    either: Annotated[int, Field(ge=0, le=9)] | str = "x"
    on: bool = True
    named: dict[str, int] = {}
    many: tuple[float, ...] = (1.0, 2.5)
    row: Row | None = None
    rows: list[Row] = []


def run(*arguments: str) -> tuple[int, str]:
    result = slrig("devices", *arguments, COLUMNS="80")
    return result.exit_code, result.output


@pytest.fixture(autouse=True)
def _installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking through all that is installed takes 20 ms, and a command does it for each driver and kind."""
    monkeypatch.setattr("importlib.metadata.entry_points", cache(importlib.metadata.entry_points))


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(rig_schema())
    return found


@pytest.fixture
def _fake_drivers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metadata = tmp_path / "site" / "fake_drivers-1.2.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: fake_drivers\nVersion: 1.2\n")
    (metadata / "entry_points.txt").write_text(DECLARED)
    monkeypatch.syspath_prepend(tmp_path / "site")


def test_options_are_shown_by_type_unit_default_and_limits() -> None:
    own, row, rows = sections(Sample.model_json_schema(), "head")
    assert [section.heading for section in (own, row, rows)] == ["[head]", "[head.row]", "[[head.rows]]"]
    assert own.options == (
        Option("choice", "text", "–", "a", "one of a, b", "Which."),
        Option("share", "number", "–", "0.5", "above 0 to below 1", ""),
        Option("turn_deg", "number", "°", "–", "at most 90", ""),
        Option("rate", "integer", "bit/s", "9600", "at least 1", ""),
        Option("size_px", "2 integers", "px", "required", "each at least 1", ""),
        Option("either", "integer or text", "–", "x", "0 to 9", ""),
        Option("on", "true/false", "–", "true", "", ""),
        Option("named", "table of integers", "–", "–", "", ""),
        Option("many", "list of numbers", "–", "[1, 2.5]", "", ""),
        Option("row", "table", "–", "–", "", ""),
        Option("rows", "list of tables", "–", "none", "", ""),
    )
    assert row.options == (Option("width_px", "integer", "px", "required", "", "How wide."),)
    assert sections(Sample.model_json_schema(), "camera")[0].heading == "[[camera]]"


def test_options_fit_80_columns() -> None:
    for driver in ("v4l2", "genicam", "dlpc350", "serial_projector", "opencv", "replay"):
        code, shown = run("--options", driver)
        assert code == 0
        assert max(map(len, shown.splitlines())) <= 80, driver
    code, shown = run("--options", "depthai")
    lines = shown.splitlines()
    place = next(number for number, line in enumerate(lines) if line.startswith("fps "))
    assert lines[place].split() == ["fps", "number", "Hz", "20"]
    assert lines[place + 1].startswith("    How many frames the sensor makes per second")
    assert "1 to 240." in " ".join(lines[place + 1 : place + 3])
    assert "[[camera]]" in lines
    assert "name, driver, exposure_s and gain" in " ".join(shown.split())


def test_programs_get_json_schema() -> None:
    code, shown = run("--options", "screen", "--json")
    schema = json.loads(shown)
    assert code == 0
    assert schema["required"] == ["output"]
    assert schema["properties"]["backend"]["enum"] == ["auto", "sdl", "x11"]


@pytest.mark.usefixtures("_fake_drivers")
def test_drivers_of_others_are_shown_or_refused() -> None:
    code, shown = run("--options", "undescribed")
    assert (code, "'undescribed' does not describe its options" in shown) == (0, True)
    assert json.loads(run("--options", "undescribed", "--json")[1]) == {}
    shown = run("--options", "two_sided")[1]
    assert "projector driver two_sided" in shown
    assert "head driver two_sided" in shown
    for driver, words in (
        ("strange", "driver 'strange' of fake_drivers are no pydantic model"),
        ("unloadable", "'unloadable' of fake_drivers cannot be loaded (no_such_module:Options): ModuleNotFoundError"),
        ("v4l", "no installed package provides a driver 'v4l'; installed: "),
    ):
        code, shown = run("--options", driver)
        assert (code, words in shown) == (2, True), shown
    # The schema for editors holds the drivers of slrig alone.
    assert "two_sided" not in rig_schema()


def checked(rig: dict[str, Any], kind: str, table: dict[str, Any]) -> tuple[set[str], set[str]]:
    """The keys that the schema's `then` for a table's driver knows and requires: what an editor goes by."""
    part = rig["properties"][kind]
    holder = part["items"] if kind == "camera" else part
    chosen = [
        each["then"] for each in holder["allOf"] if each["if"]["properties"]["driver"]["const"] == table["driver"]
    ]
    assert len(chosen) == 1
    # The same is offered where editors look for keys to propose, and anything at all is allowed there.
    assert chosen[0] in holder["anyOf"]
    assert holder["anyOf"][-1]["$ref"] in {"#/$defs/CameraTable", "#/$defs/DriverTable", "#/$defs/HeadTable"}
    schema = rig["$defs"][chosen[0]["$ref"].removeprefix("#/$defs/")]
    assert schema["additionalProperties"] is False
    return set(schema["properties"]), set(schema["required"])


@pytest.mark.parametrize("path", RIGS, ids=lambda path: path.stem)
def test_schema_for_editors_knows_every_key_of_the_rigs_we_ship(schema: dict[str, Any], path: Path) -> None:
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    tables = [(kind, data[kind]) for kind in ("head", "projector") if kind in data]
    for kind, table in [*tables, *(("camera", each) for each in data.get("camera", []))]:
        known, required = checked(schema, kind, table)
        assert required <= set(table) <= known


def test_every_reference_of_the_schema_leads_somewhere(schema: dict[str, Any]) -> None:
    found: list[str] = []

    def look(part: object) -> None:
        if isinstance(part, dict):
            found.extend(each for key, each in part.items() if key == "$ref")
            for each in part.values():
                look(each)
        elif isinstance(part, list):
            for each in part:
                look(each)

    look(schema)
    assert {each.removeprefix("#/$defs/") for each in found} == set(schema["$defs"])

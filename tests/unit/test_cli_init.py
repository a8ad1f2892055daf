"""`slrig init`, from found devices to a rig file; the options of drivers, and the schema of rig files for editors."""

from __future__ import annotations

import importlib.metadata
import json
import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, Field

from slrig.cli import rig_file as init
from slrig.cli.rig_file import Option, failure_of, sections, typed
from slrig.cli.rig_schema import rig_schema
from slrig.config import RigConfig, read_rig
from slrig.devices import Camera, FoundDevice, Projector
from slrig.discovery import DiscoveredDevices, MissingLibrary, open_rig
from slrig.errors import DriverBrokenError
from slrig.examples import EXAMPLES
from tests.unit import test_discovery
from tests.unit.command import slrig

LEFT = FoundDevice("v4l2", "usb-046d_C920_1A-video-index0", "HD Pro Webcam C920 (/dev/video0)")
RIGHT = FoundDevice("v4l2", "usb-046d_C920_2B-video-index0", "HD Pro Webcam C920 (/dev/video2)", {"focus": 30})
HDMI = FoundDevice("screen", "HDMI-1", "HDMI-1 (Acer H6510, 1280x720 at 60.00 Hz)")
LAPTOP = FoundDevice("screen", "eDP-1", "eDP-1 (1920x1080 at 60.00 Hz)")
BOX = FoundDevice("serial_projector", "/dev/serial/by-id/usb-MicroPython-if00", "MicroPython on an RP2040")
OAK = FoundDevice("depthai", "14442C10D13EABCE00", "OAK device at 1.2")
ENGINE = FoundDevice("dlpc350", "0001", "DLPC350")
GIGE = FoundDevice("genicam", "Basler-acA1300-60gm-21234567", "Basler acA1300-60gm")


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


class Bench:
    """Devices that are found, a folder, and maybe somebody who answers."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = folder / "rig.toml"
        self._monkeypatch = monkeypatch

    def run(self, *arguments: str, found: tuple[FoundDevice, ...] = (), answers: str | None = None) -> tuple[int, str]:
        return self.run_with(DiscoveredDevices(found, (), ()), *arguments, answers=answers)

    def run_with(self, findings: DiscoveredDevices, *arguments: str, answers: str | None = None) -> tuple[int, str]:
        self._monkeypatch.setattr(init, "discover_devices", lambda: findings)
        self._monkeypatch.setattr(init, "terminal", lambda: answers is not None)
        result = slrig("init", "--output", self.path, *arguments, typed=answers)
        return result.exit_code, result.output

    def rig(self) -> RigConfig:
        """The file, read again, and taken by the model of every driver in it."""
        rig = read_rig(self.path)
        assert rig.projector is not None
        for table in (rig.projector, *rig.cameras):
            assert failure_of(table.driver, table.options) == ""
        return rig


def test_two_webcams_and_a_screen_lead_to_a_rig_file(bench: Bench) -> None:
    code, shown = bench.run(found=(LEFT, RIGHT, HDMI))
    assert code == 0, shown
    rig = bench.rig()
    assert rig.projector is not None
    assert (rig.projector.driver, rig.projector.options) == ("screen", {"output": "HDMI-1"})
    assert [(each.name, each.driver, each.options) for each in rig.cameras] == [
        ("left", "v4l2", {"device": LEFT.device}),
        ("right", "v4l2", {"device": RIGHT.device, "focus": 30}),
    ]
    assert [each.exposure_s for each in rig.cameras] == [0.0167, 0.0167]
    text = bench.path.read_text(encoding="utf-8")
    assert "# HD Pro Webcam C920 (/dev/video2)\n" in text
    assert "# Whole refresh periods of a video projector" in text
    assert max(map(len, text.splitlines())) <= 80
    for command in (
        f"slrig doctor {bench.path}",
        "slrig serve",
        "slrig calibrate run",
        "slrig scan",
        "slrig --install-completion",
    ):
        assert command in shown


def test_person_chooses_among_several_devices(bench: Bench) -> None:
    code, shown = bench.run(found=(LEFT, RIGHT, LAPTOP, HDMI), answers="2 1\nHDMI\n3\n2\n\n")
    assert code == 0, shown
    rig = bench.rig()
    assert rig.projector is not None
    assert rig.projector.options == {"output": "HDMI-1"}
    assert [each.options["device"] for each in rig.cameras] == [RIGHT.device, LEFT.device]
    # What is no number of the list is asked again.
    assert "expected a number from 1 to 2, found 'HDMI'" in shown
    assert "expected a number from 1 to 2, found '3'" in shown


def test_person_is_asked_until_the_driver_takes_the_answer(bench: Bench) -> None:
    code, shown = bench.run(found=(OAK, HDMI), answers="1 1\n1\n0.0333\nleft\nCAM_B\nCAM_C\n")
    assert code == 0, shown
    assert "socket: input should be 'CAM_A', 'CAM_B'" in " ".join(shown.split())
    assert "Camera of the device." in shown
    rig = bench.rig()
    assert [(each.name, each.options["socket"], each.exposure_s) for each in rig.cameras] == [
        ("left", "CAM_B", 0.0333),
        ("right", "CAM_C", 0.0333),
    ]


def test_option_to_give_is_named_off_a_terminal(bench: Bench) -> None:
    code, shown = bench.run(found=(OAK, HDMI))
    assert code == 2
    assert "camera 'camera' (driver depthai) needs socket" in shown
    assert "--set camera.socket=VALUE" in shown
    code, shown = bench.run(found=(LEFT, HDMI, BOX))
    assert code == 2
    assert "2 devices may be the projector" in shown
    assert f"serial_projector:{BOX.device}" in shown
    assert "name it: --projector screen:HDMI-1" in shown
    assert not bench.path.exists()


@pytest.mark.parametrize(
    ("arguments", "found", "projector", "cameras"),
    [
        (["--projector", "serial_projector"], (GIGE, HDMI, BOX), {"port": BOX.device}, [{"device": GIGE.device}]),
        (
            ["--set", "projector.patterns=engine", "--set", "projector.led=blue", "--set", "right.gain=2"],
            (GIGE, LEFT, ENGINE),
            {"device": "0001", "patterns": "engine", "led": "blue"},
            [{"device": GIGE.device}, {"device": LEFT.device}],
        ),
        (
            ["--camera", "front=opencv:0", "--camera", "top=opencv:rtsp://10.0.0.2/a?b=c", "--projector", "screen"],
            (HDMI,),
            {"output": "HDMI-1"},
            [{"device": 0}, {"device": "rtsp://10.0.0.2/a?b=c"}],
        ),
        (
            ["--camera", "v4l2:pci-0000:00:14.0-usb-0:1:1.0", "--set", "camera.size_px=[640, 480]"],
            (LEFT, RIGHT, HDMI),
            {"output": "HDMI-1"},
            [{"device": "pci-0000:00:14.0-usb-0:1:1.0", "size_px": [640, 480]}],
        ),
    ],
    ids=["trigger box", "light engine", "streams", "port"],
)
def test_devices_and_options_can_be_named(
    bench: Bench,
    arguments: list[str],
    found: tuple[FoundDevice, ...],
    projector: dict[str, object],
    cameras: list[dict[str, object]],
) -> None:
    code, shown = bench.run(*arguments, found=found)
    assert code == 0, shown
    rig = bench.rig()
    assert rig.projector is not None
    assert rig.projector.options == projector
    assert [each.options for each in rig.cameras] == cameras


def test_a_cameras_own_exposure_and_gain_stay_its_own(bench: Bench) -> None:
    settings = ["--set", "left.exposure_s=0.05", "--set", "left.gain=2", "--exposure-s", "0.02"]
    assert bench.run(*settings, "--name", 'a "b"', found=(LEFT, RIGHT, HDMI))[0] == 0
    rig = bench.rig()
    assert rig.name == 'a "b"'
    assert [(each.exposure_s, each.gain) for each in rig.cameras] == [(0.05, 2.0), (0.02, 1.0)]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "left.size_px=[1, 0]"], "driver 'v4l2' does not take these options of camera 'left':\n  size_px[1]"),
        (["--set", "left.focsu=1"], "focsu: unknown key; did you mean 'focus'?"),
        (["--set", "middle.focus=1"], "a table of projector, left, right"),
        (["--set", "focus=1"], "expected TABLE.KEY=VALUE"),
        (["--exposure-s", "0"], "camera[0].exposure_s: input should be greater than 0"),
        (["--camera", "a b=v4l2:x"], "name: string should match pattern"),
        (["--camera", "a=v4l2:x", "--camera", "a=v4l2:y"], "found a twice"),
        (["--camera", "screen:HDMI-1"], "driver 'screen' opens a projector, no camera"),
        (["--camera", "v4l3:x"], "provides a driver 'v4l3'; installed: "),
        (["--camera", "v4l2"], f"name one of them: --camera v4l2:{LEFT.device}"),
    ],
)
def test_a_wrong_answer_is_named_and_nothing_is_written(bench: Bench, arguments: list[str], words: str) -> None:
    code, shown = bench.run(*arguments, found=(LEFT, RIGHT, HDMI))
    assert code == 2
    assert words in shown
    assert not bench.path.exists()


def test_nothing_plugged_in_is_said_with_what_to_check(bench: Bench) -> None:
    install = "pip install 'slrig[depthai]'"
    fault = DriverBrokenError("finder 'x' failed: no bus")
    code, shown = bench.run_with(DiscoveredDevices((), (MissingLibrary("depthai", install, "…"),), (fault,)))
    assert code == 2
    for words in ("no camera and no projector is plugged in", install, str(fault), "slrig demo", "HDMI"):
        assert words in shown
    code, shown = bench.run(found=(LEFT,), answers="")
    assert code == 2
    assert "no projector is plugged in" in shown
    assert f"found: v4l2:{LEFT.device}" in shown
    assert "slrig init --projector DRIVER:DEVICE" in shown
    assert not bench.path.exists()


def test_a_file_is_kept_unless_it_may_go(bench: Bench) -> None:
    bench.path.write_text("mine\n")
    code, shown = bench.run(found=(LEFT, HDMI))
    assert code == 2
    assert "exists and is unchanged" in shown
    assert bench.path.read_text() == "mine\n"
    assert bench.run("--force", found=(LEFT, HDMI))[0] == 0
    assert bench.rig().name == "bench"


def test_what_devices_say_of_themselves_stays_a_comment(bench: Bench) -> None:
    loud = FoundDevice("v4l2", 'usb-"\\x', 'Cam\n[head]\ndriver = "simulated"\x1b[31m')
    assert bench.run(found=(loud, HDMI))[0] == 0
    data = tomllib.loads(bench.path.read_text(encoding="utf-8"))
    assert "head" not in data
    assert data["camera"][0]["device"] == 'usb-"\\x'
    assert "\x1b" not in bench.path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "kinds", "value"),
    [
        ("0", {"integer", "string"}, 0),
        ("0", {"string"}, "0"),
        ("1", {"number"}, 1),
        ("1.5", {"integer"}, "1.5"),
        ("true", {"boolean"}, True),
        ("2020-01-01", set(), "2020-01-01"),
        ("1\nother = 2", set(), "1\nother = 2"),
        ("GREY", set(), "GREY"),
    ],
)
def test_a_value_is_toml_where_the_option_takes_it(text: str, kinds: set[str], value: object) -> None:
    found = typed(text, frozenset(kinds))
    assert found == value
    assert type(found) is type(value)


def test_a_rig_of_drivers_that_describe_nothing_opens(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    test_discovery.OPENED.clear()
    test_discovery._install(tmp_path / "site", "fake_drivers", test_discovery.DECLARED)
    monkeypatch.syspath_prepend(tmp_path / "site")
    found = tuple(FoundDevice("fake", f"usb-{number}", "a fake") for number in (1, 2))
    code, shown = bench.run("--projector", "fake:usb-2", "--camera", "fake:usb-1", "--exposure-s", "0.05", found=found)
    assert code == 0, shown
    with open_rig(read_rig(bench.path)) as rig:
        assert isinstance(rig.projector, Projector)
        assert isinstance(rig.cameras["camera"], Camera)
        assert rig.settings["camera"].exposure_s == 0.05
        assert [dict(each.options) for each in test_discovery.OPENED] == [{"device": "usb-2"}, {"device": "usb-1"}]


RIGS = sorted((EXAMPLES / "rigs").glob("*.toml"))
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


def devices(*arguments: str) -> tuple[int, str]:
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
    test_discovery._install(tmp_path / "site", "fake_drivers", DECLARED)
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
        code, shown = devices("--options", driver)
        assert code == 0
        assert max(map(len, shown.splitlines())) <= 80, driver
    code, shown = devices("--options", "depthai")
    lines = shown.splitlines()
    place = next(number for number, line in enumerate(lines) if line.startswith("fps "))
    assert lines[place].split() == ["fps", "number", "Hz", "20"]
    assert lines[place + 1].startswith("    Frame rate of the sensor")
    assert "1 to 240." in " ".join(lines[place + 1 : place + 3])
    assert "[[camera]]" in lines
    assert "name, driver, exposure_s and gain" in " ".join(shown.split())


def test_programs_get_json_schema() -> None:
    code, shown = devices("--options", "screen", "--json")
    schema = json.loads(shown)
    assert code == 0
    assert schema["required"] == ["output"]
    assert schema["properties"]["backend"]["enum"] == ["auto", "sdl", "x11"]


@pytest.mark.usefixtures("_fake_drivers")
def test_drivers_of_others_are_shown_or_refused() -> None:
    code, shown = devices("--options", "undescribed")
    assert (code, "'undescribed' does not describe its options" in shown) == (0, True)
    assert json.loads(devices("--options", "undescribed", "--json")[1]) == {}
    shown = devices("--options", "two_sided")[1]
    assert "projector driver two_sided" in shown
    assert "head driver two_sided" in shown
    for driver, words in (
        ("strange", "driver 'strange' of fake_drivers are not a pydantic model"),
        ("unloadable", "'unloadable' of fake_drivers cannot be loaded (no_such_module:Options): ModuleNotFoundError"),
        ("v4l", "no installed package provides a driver 'v4l'; installed: "),
    ):
        code, shown = devices("--options", driver)
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

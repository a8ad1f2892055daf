"""`slrig init`: from found devices to a rig file that the drivers take, with and without somebody to ask."""

from __future__ import annotations

import importlib.metadata
import tomllib
from functools import cache
from pathlib import Path

import pytest

from slrig.cli import init
from slrig.cli.init import failure_of, typed
from slrig.config import RigConfig, read_rig
from slrig.devices import Camera, FoundDevice, Projector
from slrig.discovery import Findings, MissingLibrary, open_rig
from slrig.errors import DriverBrokenError
from tests.unit import test_discovery
from tests.unit.command import slrig

LEFT = FoundDevice("v4l2", "usb-046d_C920_1A-video-index0", "HD Pro Webcam C920 (/dev/video0)")
RIGHT = FoundDevice("v4l2", "usb-046d_C920_2B-video-index0", "HD Pro Webcam C920 (/dev/video2)")
HDMI = FoundDevice("screen", "HDMI-1", "HDMI-1 (Acer H6510, 1280x720 at 60.00 Hz)")
LAPTOP = FoundDevice("screen", "eDP-1", "eDP-1 (1920x1080 at 60.00 Hz)")
BOX = FoundDevice("serial_projector", "/dev/serial/by-id/usb-MicroPython-if00", "MicroPython on an RP2040")
OAK = FoundDevice("depthai", "14442C10D13EABCE00", "OAK device at 1.2")
ENGINE = FoundDevice("dlpc350", "0001", "DLPC350")
GIGE = FoundDevice("genicam", "Basler-acA1300-60gm-21234567", "Basler acA1300-60gm")


# Looking through all that is installed takes 20 ms, and a command does it for each driver and kind.
ENTRY_POINTS = cache(importlib.metadata.entry_points)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr("importlib.metadata.entry_points", ENTRY_POINTS)
    return Bench(tmp_path, monkeypatch)


class Bench:
    """Devices that are found, a folder, and maybe somebody who answers."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = folder / "rig.toml"
        self._monkeypatch = monkeypatch

    def run(self, *arguments: str, found: tuple[FoundDevice, ...] = (), answers: str | None = None) -> tuple[int, str]:
        return self.run_with(Findings(found, (), ()), *arguments, answers=answers)

    def run_with(self, findings: Findings, *arguments: str, answers: str | None = None) -> tuple[int, str]:
        self._monkeypatch.setattr(init, "found_devices", lambda: findings)
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
        ("right", "v4l2", {"device": RIGHT.device}),
    ]
    assert [each.exposure_s for each in rig.cameras] == [0.0167, 0.0167]
    text = bench.path.read_text(encoding="utf-8")
    assert "# HD Pro Webcam C920 (/dev/video2)\n" in text
    assert "# Whole refresh periods of a video projector" in text
    assert max(map(len, text.splitlines())) <= 80
    for command in (f"slrig doctor {bench.path}", "slrig serve", "slrig calibrate run", "slrig scan"):
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
    assert "Which camera of it." in shown
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
    code, shown = bench.run_with(Findings((), (MissingLibrary("depthai", install, "…"),), (fault,)))
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
    assert "exists, and is kept" in shown
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
    monkeypatch.setattr("importlib.metadata.entry_points", cache(ENTRY_POINTS.__wrapped__))
    found = tuple(FoundDevice("fake", f"usb-{number}", "a fake") for number in (1, 2))
    code, shown = bench.run("--projector", "fake:usb-2", "--camera", "fake:usb-1", "--exposure-s", "0.05", found=found)
    assert code == 0, shown
    with open_rig(read_rig(bench.path)) as rig:
        assert isinstance(rig.projector, Projector)
        assert isinstance(rig.cameras["camera"], Camera)
        assert rig.settings["camera"].exposure_s == 0.05
        assert [dict(each.options) for each in test_discovery.OPENED] == [{"device": "usb-2"}, {"device": "usb-1"}]

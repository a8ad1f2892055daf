"""What a machine without a rig does otherwise than the READMEs say, and why."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slrig.examples import EXAMPLES
from tests.e2e.readmes.person import USUAL_ADDRESS, Person

RENDERED = "rendered.toml"
"""In the fresh folder: a rendered rig that moves the default board by itself, in place of devices."""


@dataclass(frozen=True, slots=True)
class StandIn:
    """A command that is not run as it is written. instead : what is run, None for nothing."""

    command: str
    instead: str | None
    why: str


INIT_NAMED = (
    "slrig init --camera left=v4l2:usb-…-video-index0 --camera right=opencv:2 --projector screen:HDMI-1 \\\n"
    "  --exposure-s 0.0333 --set left.pixel_format=GREY --set projector.native_px='[1280, 800]'"
)

STAND_INS = (
    StandIn(
        "python3 -m venv .venv && .venv/bin/pip install -q --no-compile -e . && .venv/bin/slrig demo",
        ".venv/bin/slrig demo",
        ".ci/run makes an environment of its own by the same two commands, and this test runs in it",
    ),
    StandIn(
        "python3 -m venv .venv && .venv/bin/pip install -q --no-compile -e '.[test]' && .venv/bin/pytest -q -n 2",
        None,
        "the test command: .ci/run runs it first of all, word for word",
    ),
    StandIn(
        "slrig init --output rig.toml",
        f"cp {RENDERED} rig.toml",
        "needs cameras and a projector that are plugged in; a rendered rig takes their place",
    ),
    StandIn(
        INIT_NAMED,
        f"{INIT_NAMED} --output named.toml",
        "rig.toml is there already, from the command before",
    ),
    StandIn(
        "slrig calibrate run",
        "slrig calibrate run --scripted --activate",
        "a person moves the board, and says when to solve; the rendered rig moves it by itself",
    ),
    StandIn(
        "pip install ./config/examples/slrig-ramp",
        None,
        "would change the environment of the tests; tests/plugin/test_readme_driver.py installs it into a folder",
    ),
    StandIn(
        "slrig accept rig-measured.toml --output acceptance --sphere 34.7 0.002 --bar 126 0.003 --plane 189 132",
        None,
        "a person puts an artefact before the rig 23 times",
    ),
    StandIn(
        "slrig accept rendered-acceptance --output rendered-acceptance --scripted",
        None,
        "29 captures take as long as all other commands together; tests/e2e/test_acceptance_walk.py makes smaller ones",
    ),
    StandIn(
        "slrig scan --coloured-light --file bundle.zip --output board",
        "slrig demo plane --output board --data board/service",
        "a person puts a white board before a calibrated rig; a rendered plate takes its place",
    ),
    StandIn(
        "python3 -m zipfile -e board/bundle.zip board/bundle",
        "cp -r board/service/scans/*/bundle board/bundle",
        "the demonstration keeps its bundle as a folder",
    ),
    StandIn(
        "slrig import teapot --projector 1024x768 --output teapot-bundle",
        "mkdir teapot && sed '2a [scan]\\nline_shift = false\\ngray_cell_px = 2' demo "
        "> codes.toml && slrig demo codes.toml --output codes --data codes/service "
        "&& cp codes/service/scans/*/bundle/frames/left/00?.png codes/service/scans/*/bundle/frames/left/01[0-5].png "
        "codes/service/scans/*/bundle/calibration.json teapot "
        "&& slrig import teapot --projector 256x192 --camera left --yes --output teapot-bundle",
        "the demonstration in Gray code alone, in smaller pictures, takes the place of another program's images",
    ),
    StandIn(
        "make -C arduino flash PORT=/dev/ttyACM0",
        "grep -q avrdude arduino/Makefile",
        "needs an Arduino; tests/unit/drivers/serial_projector/test_arduino.py compiles it for one in a simulator",
    ),
    StandIn(
        "slrig calibrate hand-eye robot.csv poses --kind in-hand --calibration solved.json --board charuco "
        "--corners 11x8 --square-mm 14 --output hand_eye.json",
        None,
        "needs a robot; tests/golden/test_hand_eye.py and tests/unit/test_cli_hand_eye.py give it rendered poses",
    ),
    StandIn(
        "slrig calibrate hand-eye today.csv today --calibration solved.json --board charuco --corners 11x8 "
        "--square-mm 14 --check hand_eye.json",
        None,
        "the same",
    ),
    StandIn("pytest tests/bench/test_pipeline_speed.py -s", None, "measures speed: nothing else may run beside it"),
    StandIn("pytest tests/bench -s", None, "takes an hour, on a machine that does nothing else"),
)


@dataclass(frozen=True, slots=True)
class Word:
    """What the READMEs can only give an example of. found : the real one."""

    word: str
    what: str
    found: Callable[[Person], str]


def _key(person: Person) -> str:
    assert person.key is not None, "no service was started that could have shown its key"
    return person.key


def _calibration(label: str) -> Callable[[Person], str]:
    def found(person: Person) -> str:
        kept = json.loads(person.type("slrig calibrate list --json"))["calibrations"]
        ids: list[str] = [each["id"] for each in kept if each["label"] == label]
        assert ids, f"the service keeps no calibration with the label '{label}'"
        return ids[0][:8]

    return found


WORDS = (
    Word("SLRIG_API_KEY=…", "the key that serve showed", lambda person: f"SLRIG_API_KEY={_key(person)}"),
    Word(USUAL_ADDRESS, "where the service is", lambda person: person.address),
    Word("3f2a1b2c", "a calibration that was solved", _calibration("rendered")),
    Word("9c81e0d4", "a calibration that was imported", _calibration("again")),
)


def as_typed(command: str, person: Person) -> str | None:
    """What is typed here for a command of the READMEs; None for nothing."""
    for each in STAND_INS:
        if each.command == command:
            return each.instead
    for word in WORDS:
        if word.word in command:
            command = command.replace(word.word, word.found(person))
    return command


_EXTENTS = re.compile(r"^((?:size|focal|principal)_px = )\[([\d.]+), ([\d.]+)\]$", re.MULTILINE)


def _halved(extent: re.Match[str]) -> str:
    halves = [f"{float(text) / 2:g}" if "." in text else str(int(text) // 2) for text in (extent[2], extent[3])]
    return f"{extent[1]}[{', '.join(halves)}]"


def _example(name: str) -> str:
    """The rig file of an example, for any folder."""
    text = (EXAMPLES / "rigs" / f"{name}.toml").read_text(encoding="utf-8")
    return text.replace("../scenes", f"{EXAMPLES}/scenes")


def lay_out_rigs(folder: Path) -> None:
    """Write smaller rigs under the names of examples that are scanned and calibrated, and the stand-ins' rendered rig.

    A file comes before the example of its name.
    """
    for each, halvings in (("demo", 2), ("plane", 1)):
        smaller = _example(each)
        for _ in range(halvings):
            smaller, count = _EXTENTS.subn(_halved, smaller)
            assert count == 6, smaller
        (folder / each).write_text(re.sub(r"samples_per_axis = \d", "samples_per_axis = 1", smaller), encoding="utf-8")
    small = _example("rendered-calibration-small")
    (folder / "rendered-calibration").write_text(small, encoding="utf-8")
    bench = small.replace(f"{EXAMPLES}/scenes/charuco_board.toml", "board.toml")
    bench = bench.replace('name = "rendered-calibration-small"', 'name = "bench"')
    (folder / RENDERED).write_text(bench, encoding="utf-8")
    board = (EXAMPLES / "scenes" / "charuco_board.toml").read_text(encoding="utf-8")
    (folder / "board.toml").write_text(board.replace("14.0", "12.0").replace("10.5", "9.0"), encoding="utf-8")

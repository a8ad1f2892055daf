"""What a machine without a rig does otherwise than the READMEs say, and why."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.e2e.readmes.person import USUAL_ADDRESS, Person

RENDERED = "rendered.toml"
"""In the fresh folder: a rendered rig that moves the default board by itself, in place of devices."""

_CALIBRATED = "config/rigs/rendered-calibration.toml"

_BOARD = """
name = "board"
[[object]]
name = "board"
shape = "board"
kind = "charuco"
columns = 11
rows = 8
square_mm = {square_mm}
marker_mm = {marker_mm}
margin_mm = 8.0
[[object]]
name = "wall"
shape = "plane"
size_mm = [900.0, 800.0]
position_mm = [0.0, 0.0, 260.0]
albedo = 0.35
"""

# Small pictures, a ray a pixel, and the fewest poses that determine a calibration: what takes minutes takes seconds.
_RIG = """
name = "bench"
[head]
driver = "simulated"
scene = "{scene}"
seed = 6
samples_per_axis = 1
ambient = 0.01
carries_calibration = false
[head.poses]
count = 8
tilt_deg = [15.0, 40.0]
roll_deg = 25.0
depth_mm = [-60.0, 80.0]
[head.projector]
size_px = [320, 200]
focal_px = [390.0, 390.4]
principal_px = [159.3, 226.4]
distortion = [-0.035, 0.022, 0.0003, -0.0002, 0.0]
position_mm = [120.0, 190.0, -585.0]
target_mm = [10.0, 190.0, 0.0]
blur_px = 0.6
gamma = 1.8
[[head.camera]]
name = "left"
size_px = [560, 448]
focal_px = [1064.0, 1065.0]
principal_px = [281.6, 221.3]
distortion = [-0.11, 0.15, -0.0003, 0.0005, 0.0]
position_mm = [-110.0, -10.0, -575.0]
target_mm = [0.0, 0.0, 0.0]
saturation_s = 0.02
blur_px = 0.6
"""


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
        "python3 -m venv .venv && .venv/bin/pip install -q -e . && .venv/bin/slrig demo",
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
        "pip install ./slrig-ramp",
        None,
        "would change the environment of the tests; tests/plugin/test_readme_driver.py installs it into a folder",
    ),
    StandIn(
        "slrig accept rig-measured.toml --output acceptance --sphere 34.7 0.002 --bar 126 0.003 --plane 189 132",
        None,
        "a person puts an artefact before the rig 23 times",
    ),
    StandIn(
        "slrig accept config/rigs/rendered-acceptance.toml --output rendered-acceptance --scripted",
        None,
        "29 captures take as long as all other commands together; tests/e2e/test_acceptance_walk.py makes smaller ones",
    ),
    StandIn(
        "slrig scan --coloured-light --file bundle.zip --output board",
        "slrig demo config/rigs/plane.toml --output board",
        "a person puts a white board before a calibrated rig; a rendered plate takes its place",
    ),
    StandIn(
        "python3 -m zipfile -e board/bundle.zip board/bundle",
        "cp -r board/service/scans/*/bundle board/bundle",
        "the demonstration keeps its bundle as a folder",
    ),
    StandIn(
        "slrig import teapot --projector 1024x768 --output teapot-bundle",
        "mkdir teapot && cp scans/demo/service/scans/*/bundle/frames/left/00?.png "
        "scans/demo/service/scans/*/bundle/frames/left/01[0-3].png scans/demo/service/scans/*/bundle/calibration.json "
        "teapot && slrig import teapot --projector 256x192 --pattern 'white black columns' --cell-px 4 --camera left "
        "--output teapot-bundle",
        "the Gray code of the demonstration, in smaller pictures, takes the place of another program's images",
    ),
    StandIn("pip install -e '.[test,bench]'", None, "would change the environment of the tests"),
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


def lay_out_rigs(folder: Path) -> None:
    """Write the rendered rig of the stand-ins, and make the one whose calibration takes minutes as small as it.

    The others that are scanned and examined have pictures as small as those of the tests' small rig, and a ray a pixel.
    """
    for each, halvings in (("demo", 2), ("plane", 1)):
        rig = folder / "config" / "rigs" / f"{each}.toml"
        smaller = rig.read_text(encoding="utf-8")
        for _ in range(halvings):
            smaller, count = _EXTENTS.subn(_halved, smaller)
            assert count == 6, smaller
        rig.write_text(re.sub(r"samples_per_axis = \d", "samples_per_axis = 1", smaller), encoding="utf-8")
    for rig, scene, square_mm in (
        (folder / RENDERED, folder / "board.toml", 12.0),
        (folder / _CALIBRATED, folder / "config" / "scenes" / "small-board.toml", 14.0),
    ):
        scene.write_text(_BOARD.format(square_mm=square_mm, marker_mm=0.75 * square_mm), encoding="utf-8")
        name = re.search(r'^name = "(.*)"$', rig.read_text(), re.MULTILINE) if rig.is_file() else None
        text = _RIG.format(scene=scene)
        rig.write_text(text if name is None else text.replace('"bench"', f'"{name.group(1)}"', 1), encoding="utf-8")

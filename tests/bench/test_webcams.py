"""Webcams as people have them, before a screen: from the doctor to a scan that is held against the truth.

Nothing of slrig is below the drivers: the screen driver's output lights a rendered world, late as a display, and a V4L2
node shows that world with the clocks, the rows and the habits of its camera. Takes some six minutes:

    pytest tests/bench/test_webcams.py -s -n 4 --dist load
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle.calibration import write_calibration
from slrig.bundle.reading import read_bundle
from slrig.meshing.quality import SearchTree
from slrig.patterns import encode
from tests.contract.screen_bench import let_go
from tests.contract.screen_server import DummyServer, OutputPixels, require_xorg
from tests.contract.test_habits import HABITS, Habit, faked
from tests.e2e.conftest import serving, slrig
from tests.e2e.test_calibration_walk import Caller
from tests.e2e.test_calibration_walk import write_rig as write_board_rig
from tests.e2e.test_closed_loop import (
    OUTPUT,
    SHOT,
    VideoNode,
    WatchedOutput,
    World,
    calibrated_and_verified,
    ended,
    mesh_in,
    rendered_rig,
    require_umockdev,
)

LATE_S = 0.03
BELOW_MM = 1.0
"""Errors at depth edges are gross and few."""
MOST_OUTLIERS, LEAST_VERTICES = 0.01, 5000
MOST_MM, MOST_CALIBRATED_MM = 0.3, 1.0
RIG = """
name = "first day"
{calibration}
[projector]
driver = "screen"
output = "{output}"
backend = "x11"
native_px = [{width}, {height}]
dark_after_s = 60
[[camera]]
name = "left"
driver = "v4l2"
device = "/dev/video0"
exposure_s = 0.0167
focus = {focus}
"""
WORST = Habit(
    "quanta-hd",
    {each: {"forgets_at_start": True} for each in ("Exposure Time, Absolute", "Focus, Absolute")},
    options={"focus": 60},
    faked={"sharp_at": 60, "first_frame_s": 0.5, "padding_bytes": 24},
)
"""What no other habit hides: refuses a harmless control, drops a tenth, 29.97 Hz, forgets exposure and lens at each
start, whose first frame is slow, and pads its rows.
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DummyServer]:
    require_xorg()
    with DummyServer(tmp_path_factory.mktemp("xorg")) as server:
        yield server


@dataclass
class Bench:
    """A rig file, the world before its devices, and what the programs need in their environment to find them."""

    rig: Path
    world: World
    node: VideoNode
    environment: dict[str, str] = field(default_factory=dict)

    def doctored(self, habit: Habit) -> Path:
        """The file that the doctor writes; it finds what it has to, and no other fault."""
        better = self.rig.with_name("doctored.toml")
        # It ends with 1 where it finds a fault.
        done = slrig("doctor", self.rig, "--output", better, "--json", codes=(0, 1), timeout_s=900, **self.environment)
        found = json.loads(done.stdout)["findings"]
        severities = {each["name"]: each["severity"] for each in found}
        # That nothing was measured before is all that is wrong.
        faults = {name for name, severity in severities.items() if severity == "fault"}
        assert faults - {*habit.advice, "timing.late"} == set(), found
        assert all(severities.get(each, "ok") != "ok" for each in habit.advice), found
        return better

    def require_true(self, results: Path, most_mm: float) -> None:
        """Each frame of a scan is its pattern's, and the mesh is what stood there. What a rig calibrates is in its
        camera's place.
        """
        bundle = read_bundle(results / "bundle")
        capture, found = bundle.capture, bundle.calibration
        assert found is not None
        images = {shot.pattern: shot.image for shot in capture.shots}
        assert images.keys() == set(range(len(capture.patterns)))
        exposure_s = self.node.sensor.asked[-1]["exposure_ns"] / 1e9
        sequence = encode(capture.patterns, capture.projector)
        expected = np.array([self.world.expected(each, exposure_s=exposure_s) for each in sequence.profiles])
        distances = [np.abs(expected - image).mean(axis=(1, 2)) for _, image in sorted(images.items())]
        # Some patterns come twice.
        wrong = [index for index, each in enumerate(distances) if each[index] > each.min() + 1e-6]
        here, there = found.cameras["left"], self.world.calibration.cameras["left"]
        seen_mm = mesh_in(results).vertices_mm @ here.rotation.T + here.translation_mm
        surface = SearchTree.build(self.world.surface.vertices_mm, self.world.surface.faces)
        errors_mm = surface.distances_mm((seen_mm - there.translation_mm) @ there.rotation)
        near_mm = errors_mm[errors_mm < BELOW_MM]
        rms_mm = float(np.sqrt(np.mean(near_mm**2)))
        print(  # noqa: T201
            f"{len(images)} frames, of them wrong {len(wrong)}; rms {rms_mm:.3f} mm of {len(near_mm)} vertices, beyond "
            f"{BELOW_MM} mm {len(errors_mm) - len(near_mm)}"
        )
        assert wrong == []
        assert len(near_mm) > LEAST_VERTICES
        assert len(errors_mm) - len(near_mm) < MOST_OUTLIERS * len(errors_mm)
        assert rms_mm < most_mm


@contextmanager
def bench(folder: Path, server: DummyServer, habit: Habit, world_rig: Path, *, calibrated: bool) -> Iterator[Bench]:
    require_umockdev()
    white = habit.scene.get("white", 0.5)
    world = World(world_rig, seed=3, saturation_s=0.01 / white)
    size = world.projector
    rig = folder / "rig" / "rig.toml"
    rig.parent.mkdir()
    calibration = ""
    if calibrated:
        write_calibration(rig.with_name("calibration.json"), world.calibration)
        calibration = 'calibration = "calibration.json"'
    given = {"width": size.width_px, "height": size.height_px, "focus": habit.options.get("focus", 0)}
    rig.write_text(RIG.format(calibration=calibration, output=OUTPUT, **given))
    place = server.arrange(DUMMY0=size, DUMMY1=size)[OUTPUT]
    pixels = OutputPixels(server.display, place, size)
    camera = faked(habit, code="YUYV", size=world.format.size)
    try:
        with (
            WatchedOutput(pixels, world, late_s=LATE_S) as watched,
            VideoNode(folder / "node", watched, camera) as node,
        ):
            yield Bench(rig, world, node, {**node.environment, "DISPLAY": server.display, "WAYLAND_DISPLAY": ""})
    finally:
        let_go(OUTPUT)


@pytest.mark.parametrize("name", HABITS)
def test_a_webcam_is_examined_and_scans_with_its_habit(name: str, server: DummyServer, tmp_path: Path) -> None:
    habit = HABITS[name]
    with bench(tmp_path, server, habit, rendered_rig(tmp_path / "world", seed=1), calibrated=True) as rig:
        doctored = rig.doctored(habit)
        with serving(doctored, tmp_path / "data", **rig.environment) as service, Caller(service) as caller:
            scan = ended(caller, "/scan")
        rig.require_true(service.data / "scans" / scan["id"], MOST_MM)


def test_the_worst_webcam_goes_from_the_doctor_to_a_verified_calibration(server: DummyServer, tmp_path: Path) -> None:
    with bench(tmp_path, server, WORST, write_board_rig(tmp_path / "world"), calibrated=False) as rig:
        rig.world.move(SHOT[0])
        doctored = rig.doctored(WORST)
        results = calibrated_and_verified(doctored, rig.world, **rig.environment)
        rig.require_true(results, MOST_CALIBRATED_MM)

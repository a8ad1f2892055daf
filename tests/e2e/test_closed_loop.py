"""Real drivers around the rendered world give the mesh that the simulator alone gives: only the photons are simulated.

The screen driver shows on an Xorg output, whose pixels light the world; the trigger box does so at the end of a serial
line. What the world's camera sees of it comes through a V4L2 node and its driver, or by wire triggers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest

from slrig.bundle.calibration_file import write_calibration
from slrig.devices import CameraSettings, Rig
from slrig.meshing.quality import TruthScore
from slrig.model import Mesh, Truth
from slrig.scan.plan import PatternPlan
from slrig.scan.plan_check import pattern_sequence
from tests.contract.screen_bench import let_go
from tests.contract.screen_server import DummyServer, OutputPixels, require_xorg
from tests.contract.serial_bench import TriggerBox
from tests.contract.wired_camera import WiredCamera
from tests.e2e.closed_loop.node import VideoNode, require_umockdev
from tests.e2e.closed_loop.output import WatchedOutput
from tests.e2e.closed_loop.scans import (
    EXPOSURE_S,
    Scanned,
    distances_mm,
    rendered,
    rendered_rig,
    rms_mm,
    scanned_here,
    scored,
    served,
    truth_of,
)
from tests.e2e.closed_loop.world import World
from tests.e2e.conftest import Start

if TYPE_CHECKING:
    from tests.contract.stage import Stage

pytestmark = pytest.mark.slow

OUTPUT = "DUMMY1"
MOST_OF_NOISE = 1.1
BELOW_MM = (1.0, 0.3)
"""Gross errors at depth edges are few, and weigh so much that they hide the rest: without them, too."""
SIMULATED = 4
"""Scans by the simulator: the noise of one pair is known to 5 %, that of six pairs to 2 %."""
SAME_COMPLETENESS = 0.005

RIG = """
name = "loop"
calibration = "calibration.json"
[projector]
{projector}
[[camera]]
name = "left"
driver = "v4l2"
device = "/dev/video0"
exposure_s = {exposure_s}
frame_rate_hz = 50
gain_unity = 16
"""
SCREEN = """driver = "screen"
output = "{output}"
display = "{display}"
backend = "x11"
native_px = [{width}, {height}]
latency_s = 0
latency_error_s = 0
dark_after_s = 60
"""


@dataclass(frozen=True)
class Reference:
    """Scans by the simulator alone, which differ by their sensor's noise, and what was there to be scanned.

    noise_mm : the rms distance between two of these meshes, for each limit in `BELOW_MM`.
    """

    rig: Path
    scans: tuple[Scanned, ...]
    noise_mm: Mapping[float, float]
    scores: tuple[TruthScore, ...]
    truth: Truth

    def ratios(self, found: Mesh) -> dict[float, float]:
        """How far a mesh is from the simulator's, over how far these are from one another, for each limit."""
        pairs = [distances_mm(found, scan.mesh) for scan in self.scans]
        return {below: rms_mm(pairs, below_mm=below) / self.noise_mm[below] for below in BELOW_MM}

    def require_same(self, found: Scanned, world: World, what: str) -> None:
        """Compare a scan around the world with the simulator's own, and print the figures."""
        ratios = self.ratios(found.mesh)
        ours = scored(found.mesh, self.truth, world.calibration.cameras["left"].centre_mm)
        rows = [f"{what}: {len(found.mesh.faces)} triangles, the simulator {len(self.scans[0].mesh.faces)}"]
        rows += [
            f"rms of distances below {below} mm: {ratio:.3f} x noise, {self.noise_mm[below]:.5f} mm"
            for below, ratio in ratios.items()
        ]
        evidence = found.report["evidence"]
        rows.append(f"{evidence['patterns_verified']} patterns verified, {evidence['shot_again']} frames shot again")
        missed = {}
        for name in ("complete_01mm", "complete_03mm", "rms_mm"):
            mine, usual = getattr(ours, name), float(np.mean([getattr(score, name) for score in self.scores]))
            missed[name] = abs(mine - usual)
            rows.append(f"{name} against the truth: {mine:.5f}, the simulator {usual:.5f}")
        print("", *rows, sep="\n  ")  # noqa: T201 - the table of the test
        assert max(ratios.values()) <= MOST_OF_NOISE
        assert max(missed["complete_01mm"], missed["complete_03mm"]) <= SAME_COMPLETENESS


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    folder = tmp_path_factory.mktemp("simulator")
    scans = tuple(rendered(folder / str(seed), seed=seed) for seed in range(1, SIMULATED + 1))
    rig = rendered_rig(folder / "world", seed=1)
    truth, eye = truth_of(rig), World(rig, seed=1).calibration.cameras["left"].centre_mm
    pairs = [distances_mm(first.mesh, second.mesh) for first, second in itertools.combinations(scans, 2)]
    noise_mm = {below: rms_mm(pairs, below_mm=below) for below in BELOW_MM}
    return Reference(rig, scans, noise_mm, tuple(scored(scan.mesh, truth, eye) for scan in scans), truth)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DummyServer]:
    require_xorg()
    with DummyServer(tmp_path_factory.mktemp("xorg")) as server:
        yield server


def rig_file(folder: Path, world: World, projector: str) -> Path:
    """A rig of real drivers, calibrated as the world is."""
    folder.mkdir()
    write_calibration(folder / "calibration.json", world.calibration)
    path = folder / "rig.toml"
    path.write_text(RIG.format(projector=projector, exposure_s=EXPOSURE_S))
    return path


def flashed_box(world: World) -> TriggerBox:
    return TriggerBox(cast("Stage", world), pattern_sequence(PatternPlan(), world.projector))


def test_a_mesh_that_lies_two_hundredths_of_a_millimetre_deeper_is_told(reference: Reference) -> None:
    mesh = reference.scans[0].mesh
    moved = replace(mesh, vertices_mm=mesh.vertices_mm + np.array([0, 0, 0.02], np.float32))
    assert min(reference.ratios(moved).values()) > MOST_OF_NOISE


def test_screen_and_v4l2_around_the_world(
    server: DummyServer, reference: Reference, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    require_umockdev()
    world = World(reference.rig, seed=3)
    size = world.projector
    place = server.arrange(DUMMY0=size, DUMMY1=size)[OUTPUT]
    screen = SCREEN.format(output=OUTPUT, display=server.display, width=size.width_px, height=size.height_px)
    rig = rig_file(tmp_path / "rig", world, screen)
    monkeypatch.setenv("DISPLAY", server.display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    pixels = OutputPixels(server.display, place, size)
    try:
        with WatchedOutput(pixels, world) as watched, VideoNode(tmp_path / "node", watched) as node:
            with monkeypatch.context() as environment:
                for name, value in node.environment.items():
                    environment.setenv(name, value)
                found = served(start, rig, tmp_path / "data")
            shown = {picture.tobytes() for picture in watched.pictures}
            frames = len(node.sensor.asked)
    finally:
        let_go(OUTPUT)
    patterns = pattern_sequence(PatternPlan(), size)
    print(  # noqa: T201 - the table of the test
        f"\n{len(patterns)} patterns, {len(watched.pictures)} pictures, {frames} frames, "
        f"looks {np.median(watched.gaps_s) * 1e3:.1f} ms apart, at most {max(watched.gaps_s) * 1e3:.0f} ms",
    )
    wanted = {patterns.image(index)[..., None].repeat(3, axis=2).tobytes() for index in range(len(patterns))}
    assert wanted <= shown
    # A white desktop before, and none after the scan, nor after the service has ended.
    assert not watched.pictures[-1].any()
    reference.require_same(found, world, "screen, v4l2, POST /scan")


def test_trigger_box_and_v4l2_around_the_world(
    reference: Reference, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    require_umockdev()
    world = World(reference.rig, seed=4)
    box = flashed_box(world)
    try:
        # Under a name of its own: umockdev takes every terminal in /dev for a device of its test bed.
        port = tmp_path / "box"
        port.symlink_to(box.line.path)
        rig = rig_file(tmp_path / "rig", world, f'driver = "serial_projector"\nport = "{port}"')
        with VideoNode(tmp_path / "node", world) as node, monkeypatch.context() as environment:
            for name, value in node.environment.items():
                environment.setenv(name, value)
            found = served(start, rig, tmp_path / "data")
        assert not world.profiles[-1].any()
    finally:
        box.line.close()
    reference.require_same(found, world, "serial_projector, v4l2, POST /scan")


def test_trigger_box_plays_to_a_camera_on_its_wire(reference: Reference, tmp_path: Path) -> None:
    world = World(reference.rig, seed=5)
    box = flashed_box(world)
    try:
        camera = WiredCamera("left", cast("Stage", world))
        box.cameras = {"left": camera}
        projector = box.projector()
        assert projector.info.plays
        settings = {"left": CameraSettings(EXPOSURE_S)}
        rig = Rig("wired", {"left": camera}, projector, settings, world.calibration)
        found = scanned_here(rig, tmp_path / "scan")
        assert not world.profiles[-1].any()
    finally:
        box.line.close()
    reference.require_same(found, world, "serial_projector plays, wired camera")

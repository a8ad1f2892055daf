"""A rig on its first day: a camera of the kernel and a trigger box on a serial line, and one flash of the box.

From an empty box to a verified calibration, with the commands and requests that a person gives: slrig patterns, slrig
doctor, then through the service a calibration, a scan and a verification. Below the drivers is a rendered world.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.model import Pixels
from tests.e2e.closed_loop.node import VideoNode, require_umockdev
from tests.e2e.closed_loop.scans import mesh_in
from tests.e2e.closed_loop.world import World, profile_of
from tests.e2e.conftest import Start
from tests.e2e.test_calibration_walk import BOARD, Caller, write_rig
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import SerialLine

RIG = """
name = "first day"
[projector]
driver = "serial_projector"
port = "{port}"
[[camera]]
name = "left"
driver = "v4l2"
device = "/dev/video0"
exposure_s = 0.0167
frame_rate_hz = 50
gain_unity = 16
"""
SHOT = range(1, 6)
"""Poses that calibrate; 0 is behind the wall, and a later one verifies."""
VERIFIED = 9


class Box:
    """A trigger box with an empty flash, whose light falls on a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._flash: list[Pixels] = []
        size = world.projector
        about = description((), width_px=size.width_px, height_px=size.height_px)
        self._about = about
        self.line = SerialLine(CoreEngine(Scene(watch=[self._lit]), about))

    def flash(self, folder: Path) -> None:
        """What a person does with the files of `slrig patterns`: images into the engine, patterns.json onto the box."""
        crc32 = [int(each, 16) for each in json.loads((folder / "patterns.json").read_text())["crc32"]]
        for number in range(len(crc32)):
            image = cv2.imread(str(folder / f"{number:03d}.png"), cv2.IMREAD_COLOR)
            assert image is not None
            self._flash.append(profile_of(np.asarray(image, np.uint8)))
        flashed = description(crc32, width_px=self._about.width_px, height_px=self._about.height_px)

        def power_cycled() -> None:
            self._about.crc32, self._about.count = flashed.crc32, flashed.count
            self.line.restart()

        self.line.do(power_cycled)

    def _lit(self, pattern: int | None) -> None:
        self._world.show(None if pattern is None else self._flash[pattern])


def slrig(*words: str) -> str:
    """Run a command as a person does, and return what it prints. The doctor ends with 1 where it finds a fault."""
    command = [sys.executable, "-m", "slrig.cli", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - ours
    assert done.returncode in {0, 1}, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_one_flash_of_the_box_serves_from_the_doctor_to_a_verification(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    require_umockdev()
    world = World(write_rig(tmp_path / "world"), seed=8)
    world.move(SHOT[0])
    box = Box(world)
    # Under a name of its own: umockdev takes every terminal in /dev for a device of its test bed.
    port = tmp_path / "box"
    port.symlink_to(box.line.path)
    rig = tmp_path / "rig" / "rig.toml"
    rig.parent.mkdir()
    rig.write_text(RIG.format(port=port))
    try:
        with VideoNode(tmp_path / "node", world) as node:
            for name, value in node.environment.items():
                monkeypatch.setenv(name, value)
            walk(start, rig, world, box)
    finally:
        box.line.close()
    exported = list((rig.parent / "patterns").iterdir())
    assert len(exported) == 1, "one export, whatever was shown"
    assert not world.profiles[-1].any()


def shoot(caller: Caller, made: dict[str, Any]) -> None:
    """Shoot a pose, and do as a refusal says: once more. A busy machine may hold a frame's light back."""
    shot: dict[str, Any] = {}
    for _ in range(2):
        caller.post(made["links"]["pose"], 202)
        shot = caller.settled(made)["shot"][-1]
        if shot["state"] == "succeeded":
            return
        sys.stdout.write(f"{shot['error']}\n")
        assert shot["error"]["detail"].endswith("shoot again") or "shoot again;" in shot["error"]["detail"]
    pytest.fail(str(shot["error"]))


def walk(start: Start, rig: Path, world: World, box: Box) -> None:
    """Everything from the empty box to the verdict; what is expected of each step is asserted on the way."""
    told = slrig("patterns", str(rig))
    (folder,) = (rig.parent / "patterns").iterdir()
    assert str(folder) in told
    box.flash(folder)

    doctored = rig.with_name("doctored.toml")
    found = json.loads(slrig("doctor", str(rig), "--output", str(doctored), "--search-s", "0.05", "--json"))
    names = {finding["name"]: finding["severity"] for finding in found["findings"]}
    assert "patterns.own" not in names, "the doctor's own patterns are among those that were flashed"
    # It is the camera's stamps that are uncertain; the file that the doctor writes waits for that.
    assert {name for name, severity in names.items() if severity == "fault"} <= {"timing.late"}, found

    service = start(doctored)
    with Caller(service) as caller:
        made = caller.post("/calibration", 201, board=BOARD)
        for pose in SHOT:
            world.move(pose)
            shoot(caller, made)
        caller.post(made["links"]["solve"], 202)
        solved = caller.settled(made)
        assert solved["state"] == "solved", solved["error"]
        caller.post(solved["links"]["activate"], 200)

        world.move(VERIFIED)
        scan = ended(caller, caller.post("/scan", 202))
        assert scan["state"] == "succeeded", scan["error"]
        verified = ended(caller, caller.post("/rig/verification", 202))
        assert verified["state"] == "succeeded", verified["error"]
        assert verified["found"]["state"] == "good", verified["found"]
    assert service.stop() == 0
    depth_mm = mesh_in(service.data / "scans" / scan["id"]).vertices_mm[:, 2]
    assert np.isfinite(depth_mm).all()
    assert len(depth_mm) > 10_000


def ended(caller: Caller, begun: dict[str, Any]) -> dict[str, Any]:
    """What came of a job, once its stream of events has ended."""
    caller.http.get(begun["links"]["events"])
    return caller.get(begun["links"]["self"])

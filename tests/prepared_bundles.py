"""Bundles that tests share: each is rendered once for all processes of a test run, and kept for its length."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from filelock import FileLock

from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.examples import EXAMPLES
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan

SCENES = EXAMPLES / "scenes"

_HEAD = """
name = "sphere"
[head]
driver = "simulated"
{scene}
seed = 12
samples_per_axis = 2
ambient = 0.01
"""

_DEVICES = """
[head.projector]
size_px = [256, 192]
focal_px = [1100.0, 1101.1]
principal_px = [128.9, 94.6]
distortion = [0.03, -0.02, 0.0003, 0.0, 0.0]
position_mm = [{projector_mm}]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
gamma = 1.8
"""

_CAMERA = """
[[head.camera]]
name = "{name}"
size_px = [240, 192]
saturation_s = 0.02
focal_px = [950.0, 950.9]
principal_px = [120.5, 94.6]
distortion = [-0.11, 0.15, -0.0003, 0.0005, 0.0]
position_mm = [{position_mm}]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
"""


@dataclass(frozen=True)
class Rendered:
    """A ball before a plate, as `slrig/examples/rigs/sphere.toml` at half the size; without cameras, that rig itself.

    cameras_mm, projector_mm : where the devices stand. plan : of the scan. truth : whether what the rig knows of its
    scene stays in the bundle: a reconstruction is then compared with it, which takes longer than all the rest.
    """

    cameras_mm: Mapping[str, str] = field(default_factory=dict)
    projector_mm: str = "105.0, -10.0, -590.0"
    plan: ScanPlan = ScanPlan()  # noqa: RUF009 - frozen
    truth: bool = False

    def rig_file(self, folder: Path) -> Path:
        """The rig file, written into `folder` where it is not one that is shipped."""
        if not self.cameras_mm:
            return SCENES.parent / "rigs" / "sphere.toml"
        path = folder / "rig.toml"
        path.write_text(self._text())
        return path

    def _text(self) -> str:
        cameras = "".join(_CAMERA.format(name=name, position_mm=place) for name, place in self.cameras_mm.items())
        scene = f'scene = "{SCENES / "sphere.toml"}"'
        return _HEAD.format(scene=scene) + _DEVICES.format(projector_mm=self.projector_mm) + cameras


_LEFT = {"left": "-150.0, -12.0, -560.0"}

BUNDLES: Mapping[str, Rendered] = {
    "ball": Rendered(_LEFT),
    "ball with its truth": Rendered(_LEFT, truth=True),
    "whole ball with its truth": Rendered(truth=True),
    "ball by both axes": Rendered(_LEFT, plan=ScanPlan(PatternPlan(rows=True))),
    # The camera stands above the projector: rows cross the baseline, columns do not.
    "ball from above": Rendered(
        {"left": "5.0, -160.0, -560.0"}, "0.0, 90.0, -590.0", ScanPlan(PatternPlan(rows=True)), truth=True
    ),
    "ball by a bracket": Rendered(_LEFT, plan=ScanPlan(exposures_s=(0.005, 0.015))),
    "ball by two cameras": Rendered(_LEFT | {"right": "20.0, -140.0, -570.0"}),
}
"""The scenes that there are, by name."""


def prepared_bundle(folders: pytest.TempPathFactory, name: str) -> Path:
    """One of BUNDLES. All tests share the folder: who changes files works on a copy."""
    base = folders.getbasetemp()
    # Each process of pytest-xdist has a folder of its own below that of the run.
    kept = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "prepared" / name.replace(" ", "-")
    kept.mkdir(parents=True, exist_ok=True)
    bundle = kept / "bundle"
    with FileLock(kept / "lock"):
        if not bundle.exists():
            wanted = BUNDLES[name]
            shutil.rmtree(kept / "part", ignore_errors=True)
            with open_rig(read_rig(wanted.rig_file(kept))) as rig:
                capture_frames(rig, wanted.plan, kept / "part").finish()
            if not wanted.truth:
                for path in (*(kept / "part").glob("truth*"), kept / "part" / "visible_points.npy"):
                    path.unlink(missing_ok=True)
            (kept / "part").rename(bundle)
    return bundle

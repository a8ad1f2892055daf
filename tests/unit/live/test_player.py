"""Live depth on a rig: its pace, lost frames, and the dark at its end."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from simulated_rig.device import open_simulated_head
from slrig.devices import CameraSettings, Rig
from slrig.doctor.timing import measure_live
from slrig.errors import FrameTimeoutError
from slrig.live.plan import live_plan
from slrig.live.player import play
from slrig.model import Axis, Shot

SCENE = '[[object]]\nname = "plate"\nshape = "plane"\nsize_mm = [160.0, 130.0]\n'
DEVICE = {"focal_px": [200.0, 200.0], "target_mm": [0.0, 0.0, 0.0]}


def _rig(tmp_path: Path, **faults: object) -> Rig:
    (tmp_path / "scene.toml").write_text(SCENE)
    projector = {**DEVICE, "size_px": [64, 48], "position_mm": [105.0, 0.0, -590.0], "latency_s": 0.01}
    camera = {**DEVICE, "name": "left", "size_px": [32, 24], "position_mm": [-150.0, 0.0, -560.0], "readout_s": 0.01}
    options = {"scene": "scene.toml", "projector": projector, "camera": [camera], "faults": faults}
    head = open_simulated_head(options, tmp_path)
    settings = {"left": CameraSettings(0.02)}
    return Rig("small", head.cameras, head.projector, settings, head.calibration, head=head, clock=head.clock)


@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_patterns_are_repeated_until_it_is_over_and_the_projector_is_dark_then(tmp_path: Path, lost: float) -> None:
    rig = _rig(tmp_path, drop_probability=lost)
    plan = live_plan(rig.projector.info, Axis.COLUMN)
    came: Counter[int] = Counter()

    def take(pattern: int, _shot: Shot, _begin_s: float, _end_s: float) -> None:
        came[pattern] += 1

    play(rig, plan, "left", take, lambda: came.total() >= 500)
    assert set(came) == set(range(len(plan.patterns)))
    assert max(came.values()) - min(came.values()) <= 2
    assert rig.head is not None
    assert not rig.projector.is_lit  # type: ignore[attr-defined] # of the simulated one


def test_a_camera_that_gives_no_frames_ends_it(tmp_path: Path) -> None:
    rig = _rig(tmp_path, drop_probability=1.0)
    plan = live_plan(rig.projector.info, Axis.COLUMN)
    with pytest.raises(FrameTimeoutError, match="no frame came"):
        play(rig, plan, "left", lambda *_: None, lambda: False)
    assert not rig.projector.is_lit  # type: ignore[attr-defined] # of the simulated one


def test_the_doctor_says_how_many_depth_images_a_second_there_are(tmp_path: Path) -> None:
    finding = measure_live(_rig(tmp_path), "left", 0.02)
    # 10 ms until the light is there, 20 ms of exposure, 10 ms of read-out.
    assert "live depth gives 25" in finding.found or "live depth gives 24" in finding.found

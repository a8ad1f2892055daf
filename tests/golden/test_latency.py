"""Latency and shutters of rendered rigs, whose truth is written into their rig files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from slrig.capture.latency import CameraLatency, measure_latency
from slrig.capture.sequencer import capture
from slrig.cli.commands import app
from slrig.config import read_rig
from slrig.devices import Synchronisation, Trigger
from slrig.discovery import open_rig
from slrig.errors import ScanEvidenceError
from slrig.model import FloatArray, Size
from slrig.patterns.sequence import encode, scan_patterns
from tests.golden.test_light_axis import rig_file

PLATE = """
name = "plate"
[[object]]
name = "plate"
shape = "plane"
size_mm = [400.0, 400.0]
rotation_deg = [6.0, -10.0, 0.0]
albedo = 0.8
"""
LAMP = {
    "size_px": (96, 72), "focal_px": (220.0, 220.0), "position_mm": (90.0, 0.0, -500.0), "target_mm": (0.0, 0.0, 0.0),
    "latency_s": 0.02,
}  # fmt: skip
EYE = {"size_px": (96, 240), "focal_px": (600.0, 600.0), "target_mm": (0.0, 0.0, 0.0), "read_noise_e": 60.0}

pytestmark = pytest.mark.slow
PROJECTOR = Size(96, 72)
SHUTTERS_S = (0.0, 15e-6, 60e-6)


def written(
    folder: Path,
    *,
    latency_s: float,
    exposure_s: float,
    line_s: float,
    bit_depth: int = 8,
    ambient: float = 0.05,
    twin: bool = False,
) -> Path:
    """The path of a rig file: light comes `latency_s` later than the projector says it does.

    twin : whether there is a second camera, whose shutter is global.
    """
    seen = {**EYE, "saturation_s": 2 * exposure_s, "bit_depth": bit_depth}
    cameras = [{**seen, "position_mm": (-60.0, 0.0, -500.0), "line_time_s": line_s}]
    if twin:
        cameras.append({**seen, "position_mm": (180.0, 0.0, -500.0), "line_time_s": 0.0})
    options = {"seed": 1, "samples_per_axis": 1, "ambient": ambient, "exposure_s": exposure_s}
    path = rig_file(folder, PLATE, LAMP, *cameras, **options)
    path.write_text(f"{path.read_text()}[head.faults]\nlight_delay_s = {latency_s}\n")
    return path


def found_on(path: Path, trigger: Trigger) -> CameraLatency:
    with open_rig(read_rig(path)) as rig:
        return measure_latency(rig, trigger=trigger).cameras["camera0"]


def require_truth(found: CameraLatency, *, latency_s: float, line_s: float) -> None:
    # Each show is off by up to 0.5 ms at random: the mean of 40 is not.
    assert abs(found.latency_s - latency_s) <= 0.2e-3
    assert found.latest_s == pytest.approx(latency_s + 0.5e-3, abs=0.3e-3)
    assert found.jitter_s == pytest.approx(0.5e-3 / 3**0.5, rel=0.3)
    assert found.rolling is (line_s > 0)
    assert abs(found.line_time_s - line_s) <= (0.02 * line_s if line_s else 1e-7)


@pytest.mark.parametrize("ambient", [0.05, 0.2])
@pytest.mark.parametrize(
    ("exposure_s", "line_s", "latency_s", "bit_depth", "trigger"),
    [
        (0.005, SHUTTERS_S[0], 0.0, 12, Trigger.FREE),
        (0.005, SHUTTERS_S[2], 0.083, 8, Trigger.SOFTWARE),
        (0.010, SHUTTERS_S[1], 0.083, 8, Trigger.FREE),
        (0.010, SHUTTERS_S[2], 0.012, 12, Trigger.FREE),
        (0.020, SHUTTERS_S[0], 0.083, 12, Trigger.SOFTWARE),
        (0.020, SHUTTERS_S[1], 0.047, 8, Trigger.SOFTWARE),
    ],
)
def test_latency_and_shutter_are_those_of_the_rig_file(
    tmp_path: Path, exposure_s: float, line_s: float, latency_s: float, bit_depth: int, trigger: Trigger, ambient: float
) -> None:
    """In a dim and in a bright room."""
    path = written(
        tmp_path / "rig",
        latency_s=latency_s,
        exposure_s=exposure_s,
        line_s=line_s,
        bit_depth=bit_depth,
        ambient=ambient,
    )
    require_truth(found_on(path, trigger), latency_s=latency_s, line_s=line_s)


def test_the_command_prints_a_table_that_the_rig_file_takes(tmp_path: Path) -> None:
    path = written(tmp_path / "rig", latency_s=0.031, exposure_s=0.01, line_s=3e-5, twin=True)
    bare = path.read_text()
    path.write_text(f"{bare}\n[synchronisation]\ntrigger_period_s = 0.02\n")
    done = CliRunner().invoke(app, ["latency", str(path), "--flashes", "20"])
    assert done.exit_code == 0, done.output
    assert "camera camera0" in done.stdout
    assert "rolling shutter: 30." in done.stdout or "rolling shutter: 29.9" in done.stdout
    assert "global shutter" in done.stdout.partition("camera camera1")[2]
    table = done.stdout[done.stdout.index("[synchronisation]") :]
    path.write_text(bare + table)
    with open_rig(read_rig(path)) as rig:
        kept = rig.synchronisation
        assert kept is not None
        assert kept.latency_s == pytest.approx(0.031, abs=0.5e-3)
        assert 0 < kept.latency_error_s < 0.5e-3
        assert kept.line_time_s == {"camera0": pytest.approx(3e-5, rel=0.02)}
        # What flashes do not measure stays.
        assert kept.trigger_period_s == 0.02


def images(path: Path, synchronisation: Synchronisation | None) -> dict[tuple[int, str], FloatArray]:
    """The frames of one sequence, by pattern and camera."""
    patterns = scan_patterns(
        PROJECTOR, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    with open_rig(read_rig(path)) as rig:
        shots = capture(replace(rig, synchronisation=synchronisation), encode(patterns, PROJECTOR))
        return {(shot.pattern, shot.camera): shot.image.astype(np.float64) for shot in shots}


def test_a_scan_with_a_late_projector_is_right_once_its_latency_is_known(tmp_path: Path) -> None:
    honest = images(written(tmp_path / "honest", latency_s=0.0, exposure_s=0.01, line_s=3e-5, twin=True), None)
    path = written(tmp_path / "late", latency_s=0.031, exposure_s=0.01, line_s=3e-5, twin=True)
    with open_rig(read_rig(path)) as rig:
        measured = measure_latency(rig).synchronisation
    late = images(path, measured)
    assert late.keys() == honest.keys()
    for key, image in late.items():
        # Equal but for noise.
        assert abs(image.mean() - honest[key].mean()) < 0.1
        assert np.abs(image - honest[key]).mean() < 2
    with pytest.raises(ScanEvidenceError):
        images(path, None)

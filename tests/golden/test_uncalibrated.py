"""A rig without a calibration makes a shape, and a calibration, of its first scan."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.bundle import open_bundle, read_calibration
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.errors import CalibrationError, SolveRefusedError
from slrig.examples import EXAMPLES
from slrig.importers import import_calibration
from slrig.model import Axis, Calibration, MeshAxes
from slrig.reconstruction import PixelPairs, project
from slrig.reconstruction.self_calibration import similarity_rms, triangulate
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.measured import refine_by_scans
from slrig.scan.plan import ReconstructionPlan, RigGuess, ScanPlan, length_unit
from slrig.scan.reconstruct import reconstruct_bundle

RIG = """
name = "wide"
[head]
driver = "simulated"
scene = "{scene}"
seed = 5
samples_per_axis = 2
ambient = 0.01
[head.projector]
size_px = [512, 384]
focal_px = [700.0, 700.7]
principal_px = [258.3, 189.6]
distortion = [0.03, -0.02, 0.0003, 0.0, 0.0]
position_mm = [0.0, -20.0, -230.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
[[head.camera]]
name = "left"
size_px = [480, 384]
saturation_s = 0.02
focal_px = [620.0, 620.6]
principal_px = [241.4, 189.7]
distortion = [-0.05, 0.03, -0.0003, 0.0005, 0.0]
position_mm = [-70.0, -12.0, -215.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
"""
BASELINE_MM = float(np.linalg.norm([70.0, -8.0, -15.0]))


def guess(**others: Any) -> RigGuess:
    """The throw ratio 3 % wrong. The camera's focal length is what its pictures state."""
    return RigGuess(throw_ratio=700 / 512 * 0.97, throw_sigma=0.03, **others)


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Calibration]:
    """A bundle without a calibration, whose pictures state a focal length 3 % wrong; and that of the renderer."""
    folder = tmp_path_factory.mktemp("uncalibrated")
    (folder / "rig.toml").write_text(RIG.format(scene=(EXAMPLES / "scenes" / "demo.toml").as_posix()))
    plan = ScanPlan(reconstruction=ReconstructionPlan(uncalibrated=RigGuess()))
    with open_rig(read_rig(folder / "rig.toml")) as rig:
        assert rig.calibration is not None
        capture_frames(replace(rig, calibration=None), plan, folder / "bundle").finish()
        description = folder / "bundle" / "bundle.json"
        told = json.loads(description.read_text())
        told["cameras"]["left"]["focal_px"] = 620 * 1.03
        description.write_text(json.dumps(told))
        return folder / "bundle", rig.calibration


def test_a_first_scan_gives_a_shape_that_is_as_right_as_it_states(
    scanned: tuple[Path, Calibration], tmp_path: Path
) -> None:
    bundle, truth = scanned
    plan = ReconstructionPlan(uncalibrated=guess(baseline_mm=BASELINE_MM, most_error=0.02), mesh_axes=MeshAxes.RIG)
    report: dict[str, Any] = reconstruct_bundle(bundle, tmp_path / "out", plan=plan)
    found = read_calibration(tmp_path / "out" / "calibration.json")
    stated = report["self_calibration"]
    assert found.projector is not None
    assert truth.projector is not None
    # The same pixels, by the renderer's devices.
    vertices = decode_mesh_ply((tmp_path / "out" / "mesh.ply").read_bytes()).vertices_mm.astype(np.float64)
    pixels = (project(found.cameras["left"], vertices), project(found.projector, vertices))
    pairs = PixelPairs(*pixels, np.zeros(len(vertices)), Axis.COLUMN)
    true = triangulate(truth.cameras["left"], truth.projector, pairs)
    error = similarity_rms(true, vertices) / np.linalg.norm(np.ptp(true, axis=0))
    assert 0 < error < 2 * stated["shape_error"] < 0.02
    assert stated["unit"] == "mm"
    assert abs(float(np.linalg.norm(found.projector.centre_mm)) - BASELINE_MM) < 1e-3
    assert "calibrated by this scan alone" in report["notes"][0]
    assert "began from what its pictures state (EXIF): 639 px, right to 3%" in report["notes"][1]
    assert abs(stated["focal_changed"]["left"] - (1 / 1.03 - 1)) < 0.03
    assert report["calibration"]["id"] == found.solve_id
    assert "truth" not in report

    refined, lines = refine_by_scans(found, [bundle], lambda *_: None)
    assert refined.solved is not None
    assert found.solved is not None
    assert any(line.startswith("shape") for line in lines)
    assert (length_unit(None), length_unit(guess(baseline_mm=9)), length_unit(guess())) == ("mm", "mm", "% of baseline")
    assert np.trace(refined.solved.covariance) < np.trace(found.solved.covariance)


def test_a_calibration_without_a_known_length_is_not_used_as_one_in_mm(
    scanned: tuple[Path, Calibration], tmp_path: Path
) -> None:
    plan = ReconstructionPlan(uncalibrated=guess(most_error=0.02))
    report: dict[str, Any] = reconstruct_bundle(scanned[0], tmp_path / "out", plan=plan)
    found = tmp_path / "out" / "calibration.json"
    assert report["self_calibration"]["unit"] == "baseline/100"
    rig = tmp_path / "rig.toml"
    scene = (EXAMPLES / "scenes" / "demo.toml").as_posix()
    rig.write_text(f'calibration = "{found.as_posix()}"\n{RIG.format(scene=scene)}')
    for use in (
        partial(import_calibration, found),
        partial(open_bundle, scanned[0], calibration_file=found),
        partial(open_rig, read_rig(rig)),
    ):
        with pytest.raises(CalibrationError, match="expected lengths in mm, found hundredths of the baseline"):
            use()


@pytest.mark.parametrize(
    ("known", "words"),
    [
        (guess(most_error=0.0005), "determines the shape to"),
        (replace(guess(), focal_px={"right": 600.0}), "names camera right, and the scan has left"),
    ],
)
def test_a_scan_that_leaves_the_shape_open_is_refused(
    scanned: tuple[Path, Calibration], tmp_path: Path, known: RigGuess, words: str
) -> None:
    with pytest.raises(SolveRefusedError, match=words):
        reconstruct_bundle(scanned[0], tmp_path / "out", plan=ReconstructionPlan(uncalibrated=known))
    assert not (tmp_path / "out").exists()

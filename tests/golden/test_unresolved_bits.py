"""A code whose finest bit, or lines, the camera resolves on one part of what it sees and not on another.

Of two plates one faces the camera, and the other is turned away from it and towards the projector: there as many code
cells pass in half as many camera pixels. What is covered is compared with per-pixel decode.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from slrig.bundle import read_bundle
from slrig.meshing.rasteriser import rasterise
from slrig.model import Axis
from slrig.reconstruction.frames import axis_frames
from slrig.scan.pictures import placed_vertices
from slrig.scan.plan import PatternPlan, ReconstructionPlan
from tests.golden.test_bundles import reconstructed
from tests.golden.test_light_axis import Device, rig_file, scanned

pytestmark = pytest.mark.slow
CAMERA: Device = {
    "size_px": (800, 720), "focal_px": (3800.0, 3800.0), "distortion": (-0.1, 0.12, 0.0003, -0.0005, 0.0),
    "position_mm": (-200.0, 0.0, -500.0), "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.6, "saturation_s": 0.02,
}  # fmt: skip
PROJECTOR: Device = {
    "size_px": (1024, 768), "focal_px": (3800.0, 3800.0), "distortion": (0.03, -0.02, 0.0, 0.0003, 0.0),
    "position_mm": (200.0, 0.0, -500.0), "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.5,
}  # fmt: skip
GRAY_ONLY = PatternPlan(line_shift=False, gray_cell_px=1)
LEAST_SWING = 5.0


PLATES = 'name = "plates"\n' + "".join(
    f'[[object]]\nshape = "plane"\nposition_mm = [{x}, 0.0, 0.0]\nsize_mm = [54.0, 80.0]\n'
    f"rotation_deg = [0.0, {turn_deg}, 0.0]\n"
    for x, turn_deg in ((-28.0, 20.0), (28.0, -38.0))
)
"""The one that faces the camera is on the left."""


def covered_shares(rig: Path) -> list[float]:
    """Of what is lit and swings by at least 5 of 255 in every bit but the finest, as anybody would decode, the shares
    that the mesh covers on the left and on the right.
    """
    bundle = read_bundle(rig.parent / "bundle")
    assert bundle.calibration is not None
    frames = axis_frames(bundle.capture, "camera0", Axis.COLUMN)
    bits = np.array(frames.bits, dtype=np.float32)[:-1]
    inverses = frames.white + frames.black - bits if frames.inverses is None else np.array(frames.inverses)[:-1]
    decoded = (frames.contrast > 20) & (np.abs(bits - inverses) >= LEAST_SWING).all(axis=0)
    loaded: Any = trimesh.load(rig.parent / "out" / "mesh.ply", process=False)
    device = bundle.calibration.cameras["camera0"]
    placed = placed_vertices(np.asarray(loaded.vertices, np.float64) * [1, -1, -1], device)
    met = rasterise(placed, np.asarray(loaded.faces, np.int32), device.size).face >= 0
    left = np.indices(met.shape)[1] < met.shape[1] / 2
    return [float((met & decoded & part).sum() / (decoded & part).sum()) for part in (left, ~left)]


def test_both_halves_are_covered(tmp_path: Path) -> None:
    rig = rig_file(tmp_path / "rig", PLATES, PROJECTOR, CAMERA)
    report = scanned(rig, plan=GRAY_ONLY)
    truth = report["truth"]
    assert min(covered_shares(rig)) >= 0.95
    assert truth["rms_mm"] <= 0.003
    assert 0.8 <= truth["error_over_sigma_p68"] <= 1.25
    assert truth["false_area_0.5mm"] == 0
    assert truth["nonmanifold_edges"] == truth["misoriented_edges"] == 0
    assert report["mesh"]["covers_of_decoded"] >= 0.95
    assert any("does not resolve the 2 finest Gray bits" in note for note in report["notes"])
    assert not any("the mesh covers" in note for note in report["notes"])
    # A limit at depth edges that takes most triangles for such makes a thin mesh, which is told.
    report = reconstructed(rig.parent / "bundle", tmp_path / "thin", ReconstructionPlan(depth_edge_ratio=1.2))
    notes = report["notes"]
    assert isinstance(notes, list)
    assert any("of what camera 'camera0' decoded" in note for note in notes), notes


# Half as many pixels, and a lens a little out of focus: on the plate turned away lines of one frame are 3 px apart.
COARSE: Device = {**CAMERA, "size_px": (400, 360), "focal_px": (1900.0, 1900.0), "blur_px": 1.2}


def test_code_edges_stand_for_lines_that_are_not_resolved(tmp_path: Path) -> None:
    # Projector pixels are half as wide as a camera's there: two samples to a pixel would displace them by 0.1 px.
    rig = rig_file(tmp_path / "rig", PLATES, PROJECTOR, COARSE, samples_per_axis=6)
    report = scanned(rig)
    truth, camera = report["truth"], report["cameras"]["camera0"]
    # That plate is 84 px wide, and its border of 3 px is refused: 7 %, and 2 % above and below. With inverses 89 %.
    assert min(covered_shares(rig)) >= 0.87
    assert 0.8 <= truth["error_over_sigma_p68"] <= 1.25
    assert truth["false_area_0.5mm"] == 0
    assert truth["nonmanifold_edges"] == truth["misoriented_edges"] == 0
    assert 0.25 <= camera["lit_without_lines"] <= 0.4
    assert any("does not resolve the shifted lines on" in note for note in report["notes"])

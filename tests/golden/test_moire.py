"""A projector much finer than the camera: the finest bits beat with the pixels, and are told from those that resolve.

What is covered is compared with the same frames without the bits that are of no use.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle import read_bundle, write_bundle
from slrig.model import Gray
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.plan import PatternPlan, ReconstructionPlan
from tests.golden.test_bundles import reconstructed
from tests.golden.test_light_axis import Device, rig_file, scanned

pytestmark = pytest.mark.slow
SCREEN = """name = "screen"
[[object]]
shape = "plane"
size_mm = [400.0, 400.0]
rotation_deg = [0.0, 8.0, 3.0]
"""
CAMERA: Device = {
    "size_px": (200, 160), "focal_px": (750.0, 750.0), "distortion": (-0.1, 0.12, 0.0003, -0.0005, 0.0),
    "position_mm": (-120.0, 0.0, -560.0), "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.6, "saturation_s": 0.02,
}  # fmt: skip
USELESS = 4
"""Twelve projector pixels to one of the camera: stripes of 0.17, 0.33, 0.67 and 1.3 camera pixels."""
PROJECTOR: Device = {
    "size_px": (1920, 1080), "focal_px": (9000.0, 9000.0), "position_mm": (120.0, 0.0, -560.0),
    "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.5,
}  # fmt: skip


def without_bits(bundle: Path, folder: Path, count: int) -> Path:
    """The bundle without the frames of its finest bits."""
    known = read_bundle(bundle)

    def is_kept(pattern: object) -> bool:
        return not isinstance(pattern, Gray) or pattern.bit < pattern.bits - count

    patterns = tuple(
        replace(each, bits=each.bits - count, cell_px=each.cell_px << count) if isinstance(each, Gray) and is_kept(each)
        else each
        for each in known.capture.patterns
    )  # fmt: skip
    shots = tuple(each for each in known.capture.shots if is_kept(known.capture.patterns[each.pattern]))
    used = sorted({each.pattern for each in shots})
    shots = tuple(replace(each, pattern=used.index(each.pattern)) for each in shots)
    capture = replace(known.capture, patterns=tuple(patterns[index] for index in used), shots=shots)
    write_bundle(folder, capture, known.calibration)
    for name in ("truth.ply", "visible_points.npy"):
        shutil.copy(bundle / name, folder / name)
    return folder


def test_a_screen_is_covered_as_without_the_useless_bits(tmp_path: Path) -> None:
    rig = rig_file(tmp_path / "rig", SCREEN, PROJECTOR, CAMERA, samples_per_axis=12)
    report = scanned(rig, plan=PatternPlan(line_shift=False, gray_cell_px=1))
    camera, truth = report["cameras"]["camera0"], report["truth"]
    assert camera["lit_by_unresolved_bits"][USELESS] > 0.98
    assert any(f"does not resolve the {USELESS} finest Gray bits" in note for note in report["notes"])
    assert truth["false_area_0.5mm"] == 0
    # Every pixel has a surface or a cause.
    assert camera["measured_pixels"] + sum(camera["refused_pixels"].values()) == 200 * 160
    bundle = rig.parent / "bundle"
    by_hand = reconstructed(without_bits(bundle, tmp_path / "few", USELESS), tmp_path / "few-out")
    dropped = reconstructed(bundle, tmp_path / "dropped", ReconstructionPlan(drop_finest_bits=USELESS))
    for other in (by_hand, dropped):
        assert truth["complete_0.1mm"] >= other["truth"]["complete_0.1mm"] - 0.01
    sigma_mm = [
        float(np.median(decode_mesh_ply((folder / "mesh.ply").read_bytes()).sigma_mm))
        for folder in (rig.parent / "out", tmp_path / "few-out", tmp_path / "dropped")
    ]
    assert max(sigma_mm) <= 1.1 * min(sigma_mm)

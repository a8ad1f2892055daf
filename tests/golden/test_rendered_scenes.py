"""Every scene of the rendered rig, captured and reconstructed, against its own truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.scan.acquisition import capture_bundle
from slrig.scan.plan import ScanPlan
from tests.golden.test_bundles import reconstructed

RIGS = sorted((Path(__file__).parents[2] / "config" / "rigs").glob("*.toml"))


@pytest.mark.parametrize("rig_file", RIGS, ids=lambda path: path.stem)
def test_a_rendered_scene_meets_its_figures(rig_file: Path, tmp_path: Path) -> None:
    with open_rig(read_rig(rig_file)) as rig:
        capture_bundle(rig, ScanPlan(), tmp_path / "bundle", progress=lambda *_: None, cancelled=lambda: False)
    report = reconstructed(tmp_path / "bundle", tmp_path / "out")
    truth = report["truth"]
    assert truth["rms_mm"] <= 0.05
    assert truth["complete_0.3mm"] >= 0.90
    assert truth["gross_fraction"] <= 0.003
    assert truth["false_area_0.5mm"] <= 0.01
    assert truth["nonmanifold_edges"] == truth["misoriented_edges"] == truth["duplicate_faces"] == 0
    verified, shown = map(int, report["evidence"]["patterns_verified"].split("/"))
    assert verified == shown
    assert report["evidence"]["contradictions"] == []

"""A dark relief that shines like a mirror here and there: single exposures, and all of them as a bracket."""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.capture.verifier import EvidenceSummary
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import Calibration, Shot
from slrig.model.capture import CaptureHeader
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ScanPlan
from slrig.scan.stream import LiveScan
from tests.golden.shipped_rigs import PAINT, SMALL, rig_file
from tests.golden.test_bundles import reconstructed

pytestmark = pytest.mark.slow
# The relief's darkest and brightest places are some thousand times apart.
GLOSSY = {
    PAINT: """albedo = 0.3
texture = { kind = "noise", contrast = 0.995, scale_mm = 14.0 }
specular = { strength = 8.0, exponent = 60.0 }"""
}
EXPOSURES_S = (0.003, 0.015, 0.075)


class Watching:
    """Has the frames reconstructed while they come."""

    def __init__(self) -> None:
        self.live: LiveScan | None = None

    def begin(self, header: CaptureHeader, calibration: Calibration | None) -> None:
        assert calibration is not None
        self.live = LiveScan(header, calibration)

    def take(self, shot: Shot) -> None:
        assert self.live is not None
        self.live.take(shot)

    def end(self, evidence: EvidenceSummary) -> None:
        assert self.live is not None
        self.live.end(evidence)


def captured(rig: Path, plan: ScanPlan, bundle: Path, watching: Watching | None = None) -> Path:
    with open_rig(read_rig(rig)) as opened:
        capture_frames(opened, plan, bundle, frames=watching).finish()
    return bundle


def test_a_bracket_is_more_complete_and_no_less_exact_than_any_of_its_exposures(tmp_path: Path) -> None:
    rig = rig_file(tmp_path, "relief", scene=GLOSSY, head={})
    singles = []
    for exposure_s in EXPOSURES_S:
        bundle = captured(rig, ScanPlan(exposure_s=exposure_s), tmp_path / f"{exposure_s}")
        singles.append(reconstructed(bundle, tmp_path / f"{exposure_s}-out"))
    report = reconstructed(captured(rig, ScanPlan(exposures_s=EXPOSURES_S), tmp_path / "all"), tmp_path / "all-out")
    truth = report["truth"]
    for figure in ("complete_0.1mm", "complete_0.3mm"):
        # The best single exposure leaves out a twenty-fifth; what is left out here is the relief's border.
        assert truth[figure] > 0.985
        assert truth[figure] > max(single["truth"][figure] for single in singles) + 0.015
    assert truth["rms_mm"] <= min(single["truth"]["rms_mm"] for single in singles) / 2
    assert truth["p99_mm"] <= min(single["truth"]["p99_mm"] for single in singles)
    assert 0.85 < truth["error_over_sigma_p68"] < 1.35
    assert truth["false_area_0.5mm"] == 0
    camera = report["cameras"]["left"]
    # Wide lines are as bright as white: in the glints the shortest exposure clips, too.
    assert camera["refused_pixels"]["saturated"] < 0.01 * camera["decoded_pixels"]
    assert report["identity"] == "18/18 patterns verified"
    uses = camera["exposures"]
    assert [use["exposure_s"] for use in uses] == list(EXPOSURES_S)
    assert [use["light"] for use in uses] == pytest.approx([1, 1, 1], abs=0.01)
    assert all(use["longest_of"] > 0.03 for use in uses)
    assert sum(use["longest_of"] for use in uses) == pytest.approx(1)
    assert "exposures_note" not in camera


def test_a_bracket_gives_the_same_bytes_live_and_from_disk(tmp_path: Path) -> None:
    watching = Watching()
    rig = rig_file(tmp_path, "relief", scene=GLOSSY, head=SMALL)
    bundle = captured(rig, ScanPlan(exposures_s=EXPOSURES_S), tmp_path / "bundle", watching)
    read = reconstructed(bundle, tmp_path / "read")
    live = reconstructed(bundle, tmp_path / "live", live=watching.live)
    for name in ("mesh.ply", "points.ply"):
        assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "read" / name).read_bytes(), name
    assert all(live[part] == read[part] for part in ("notes", "identity", "frames", "evidence", "cameras"))
    assert live["cameras"]["left"]["exposures"]

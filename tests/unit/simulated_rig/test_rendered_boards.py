"""Captures of a board that moves by itself: one bundle per pose, with its truth, by the path that a scan takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slrig.bundle import read_capture
from slrig.bundle.truth import read_truth
from slrig.errors import ScanEvidenceError
from slrig.model import Axis, Gray, LineShift
from tests.rendered_boards import board_options, rendered_poses


@pytest.mark.slow
def test_each_pose_is_a_bundle_of_both_axes_with_the_truth_of_its_pose(tmp_path: Path) -> None:
    bundles = rendered_poses(tmp_path, board_options(cameras=2), poses=[0, 5])
    assert [bundle.name for bundle in bundles] == ["pose_00", "pose_01"]
    depths = []
    for bundle in bundles:
        assert not (bundle / "calibration.json").exists()
        patterns = read_capture(bundle).patterns
        for kind in (Gray, LineShift):
            assert {each.axis for each in patterns if isinstance(each, kind)} == set(Axis)
        truth = read_truth(bundle)
        assert truth is not None
        assert list(truth.cameras) == ["left", "right"]
        depths.append(truth.cameras["left"].depth_mm)
    assert np.abs(depths[0] - depths[1]).max() > 5


def test_a_board_that_is_carried_along_during_its_capture_is_no_pose(tmp_path: Path) -> None:
    moving = {"moving": [{"shift_mm": [3.0, 1.0, 0.0]}]}
    with pytest.raises(ScanEvidenceError):
        rendered_poses(tmp_path, board_options(faults=moving), poses=[0])

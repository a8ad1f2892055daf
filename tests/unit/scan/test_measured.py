"""Which axis a recording of both is triangulated by: the calibration's, unless what the frames hold says otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle import read_bundle, write_bundle
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import Axis, Gray, Shot
from slrig.scan.acquisition import capture_frames
from slrig.scan.measured import measured
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.golden.test_light_axis import BALL, Device, rig_file

# The baseline lies across columns a little more than across rows.
CAMERA: Device = {
    "size_px": (240, 200), "focal_px": (1100.0, 1100.0), "position_mm": (-130.0, -110.0, -560.0),
    "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.6, "saturation_s": 0.02,
}  # fmt: skip
PROJECTOR: Device = {
    "size_px": (96, 96), "focal_px": (480.0, 480.0), "position_mm": (0.0, 0.0, -600.0),
    "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.3,
}  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("slanted")
    with open_rig(read_rig(rig_file(folder / "rig", BALL, PROJECTOR, CAMERA))) as rig:
        plan = ScanPlan(patterns=PatternPlan(rows=True, line_shift=False, gray_cell_px=1))
        capture_frames(rig, plan, folder / "bundle", progress=lambda *_: None, cancelled=lambda: False).finish()
    return folder / "bundle"


def smeared(recorded: Path, folder: Path, axis: Axis, width: int, *, from_px: int = 60) -> Path:
    """A copy whose code of an axis is smeared across its stripes from a column of the image on."""
    bundle = read_bundle(recorded)

    def change(shot: Shot) -> Shot:
        pattern = bundle.capture.patterns[shot.pattern]
        if not isinstance(pattern, Gray) or pattern.axis is not axis:
            return shot
        image = cv2.blur(shot.image, (width, 1) if axis is Axis.COLUMN else (1, width))
        image[:, :from_px] = shot.image[:, :from_px]
        return replace(shot, image=np.asarray(image, dtype=shot.image.dtype))

    write_bundle(folder, replace(bundle.capture, shots=tuple(map(change, bundle.capture.shots))), bundle.calibration)
    return folder


@pytest.mark.slow
def test_the_axis_that_decodes_far_more_is_used_and_told(recorded: Path, tmp_path: Path) -> None:
    walked, _ = measured(recorded, None, None, lambda *_: None, axis=None)
    assert walked.axis is Axis.COLUMN
    assert not any("triangulated by" in note for note in walked.notes)
    worse = smeared(recorded, tmp_path / "worse", Axis.COLUMN, 121)
    walked, found = measured(worse, None, None, lambda *_: None, axis=None)
    assert walked.axis is Axis.ROW
    (note,) = (note for note in walked.notes if note.startswith("triangulated by rows"))
    assert "the columns, which cross the baseline more steeply, decode" in note
    assert len(found.joined.curves.points_mm) > 1000
    asked, _ = measured(worse, None, None, lambda *_: None, axis=Axis.COLUMN)
    assert asked.axis is Axis.COLUMN


def test_both_axes_are_tried_and_the_first_kept_where_the_other_is_worse(recorded: Path, tmp_path: Path) -> None:
    worse = smeared(
        smeared(recorded, tmp_path / "worse", Axis.COLUMN, 121), tmp_path / "worst", Axis.ROW, 191, from_px=0
    )
    stages: list[str] = []
    walked, _ = measured(worse, None, None, lambda stage, _fraction, _detail: stages.append(stage), axis=None)
    assert stages.count("triangulate") == 2
    assert walked.axis is Axis.COLUMN

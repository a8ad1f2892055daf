"""Row lines that lie nearly along the image's rows are no damage, and damage in them is still seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slrig.bundle import Bundle, read_bundle
from slrig.capture.evidence import check_capture
from slrig.model import Axis, Capture, LineShift
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.bench.test_calibration_seeds import rig_options
from tests.rendered_boards import board_head, board_rig, board_scene

pytestmark = pytest.mark.slow
POSE = 4


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """A board in whose lower part few row lines are seen, each at the border of a code cell in shift 0.

    Its capture was once refused for damage that it does not have.
    """
    folder = tmp_path_factory.mktemp("lines")
    options = rig_options(28)
    with board_rig(board_head(folder, options, board_scene("chessboard")), options) as rig:
        assert rig.positioner is not None
        rig.positioner.move(POSE)
        plan = ScanPlan(patterns=PatternPlan(rows=True))
        capture_frames(rig, plan, folder / "pose", progress=lambda *_: None, cancelled=lambda: False).finish()
    return read_bundle(folder / "pose")


def test_few_lines_along_the_rows_are_no_damage(recorded: Bundle) -> None:
    assert check_capture(recorded.capture).faults == ()


def test_rows_of_another_frame_are_damage(recorded: Bundle) -> None:
    capture = recorded.capture
    index = next(
        number
        for number, shot in enumerate(capture.shots)
        if isinstance(pattern := capture.patterns[shot.pattern], LineShift)
        and pattern.axis is Axis.ROW
        and pattern.shift == 2
    )
    shot, other = capture.shots[index], capture.shots[index + 4]
    image = shot.image.copy()
    middle = len(image) // 2
    image[middle - 40 : middle + 20] = np.roll(other.image, 11, axis=1)[middle - 40 : middle + 20]
    shots = (*capture.shots[:index], replace(shot, image=image), *capture.shots[index + 1 :])
    damaged = Capture(capture.projector, capture.patterns, capture.cameras, shots)
    (found,) = check_capture(damaged).faults
    assert "its lines are not where the Gray code says" in found

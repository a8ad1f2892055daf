"""A rendered rig is calibrated, then a device is turned, moved or zoomed, and one look at the board tells which.

The rig is small (320 x 256 pixels), with blur, noise and distorted lenses; what is changed is changed in the renderer,
which shares no geometry with what judges it. And a board whose row lines lie nearly along the image's rows.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.bundle import Bundle, read_bundle
from slrig.calibrate.pose_reading import read_pose
from slrig.calibrate.store import solve_poses
from slrig.calibrate.verification import verify_bundle
from slrig.calibration.board import Board, BoardKind
from slrig.calibration.health import HealthState, judge_health
from slrig.calibration.solution import PROJECTOR
from slrig.capture.verifier import check_capture
from slrig.model import Axis, Calibration, Capture, LineShift, Size
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.bench.test_calibration_seeds import rig_options
from tests.rendered_boards import board_head, board_options, board_rig, board_scene, rendered_poses

pytestmark = pytest.mark.slow

BOARD = Board(BoardKind.CHARUCO, 6, 4, 26.0, 20.0, "DICT_4X4_50")
_LAMP_MM = np.array([120.0, 190.0, -585.0])
_CAMERA_MM = np.array([-110.0, -10.0, -575.0])


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """The rig as it is calibrated from twelve of its twenty poses."""
    bundles = rendered_poses(tmp_path_factory.mktemp("poses"), board_options(cameras=2), poses=range(12))
    poses = [read_pose(bundle, BOARD, bundle.name) for bundle in bundles]
    sizes = {"left": Size(320, 256), "right": Size(320, 256)}
    return solve_poses(BOARD, sizes, Size(320, 200), poses).calibration


def bumped(device: str, turn_deg: list[float]) -> dict[str, Any]:
    """The rig's options, a device turned about its own axes."""
    bump = {"device": device, "pose": 0, "turn_deg": turn_deg}
    return board_options(cameras=2) | {"faults": {"bump": [bump]}}


def changed(change: str) -> dict[str, Any]:
    """The rig's options after a change."""
    options = board_options(cameras=2)
    if change == "camera turned":
        return bumped("left", [0.0, 0.05, 0.0])
    if change == "projector turned":
        return bumped(PROJECTOR, [0.0, 0.05, 0.0])
    if change == "baseline":
        way = 0.1 * (_LAMP_MM - _CAMERA_MM) / np.linalg.norm(_LAMP_MM - _CAMERA_MM)
        options["projector"]["position_mm"] = (_LAMP_MM + way).tolist()
        options["projector"]["target_mm"] = (np.array(options["projector"]["target_mm"]) + way).tolist()
    if change == "focal":
        options["camera"][0]["focal_px"] = [1.0005 * focal for focal in options["camera"][0]["focal_px"]]
    return options


@pytest.mark.parametrize(
    ("change", "device"),
    [("camera turned", "left"), ("projector turned", PROJECTOR), ("baseline", PROJECTOR), ("focal", "left")],
)
def test_a_change_is_stale_and_its_device_named(
    tmp_path: Path, calibration: Calibration, change: str, device: str
) -> None:
    (bundle,) = rendered_poses(tmp_path, changed(change), poses=[0])
    found = verify_bundle(bundle, BOARD, calibration)
    assert judge_health([found]).state is HealthState.STALE
    assert found.drifts[0].device == device
    if change.endswith("turned"):
        assert "turned by 0.0" in found.drifts[0].words


def test_a_rig_that_did_not_change_is_good_in_every_pose(tmp_path: Path, calibration: Calibration) -> None:
    options = board_options(cameras=2) | {"seed": 77}
    for bundle in rendered_poses(tmp_path, options, poses=[1, 11]):
        found = verify_bundle(bundle, BOARD, calibration)
        assert judge_health([found]).state is HealthState.GOOD
        assert max(abs(pair.mean_px) for pair in found.pairs) < 0.02
        assert abs(found.scale_percent or 1) < 0.03


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
        capture_frames(rig, plan, folder / "pose").finish()
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
    assert "shift 2 of 8): on " in found
    assert "its light does not fit the other line frames" in found

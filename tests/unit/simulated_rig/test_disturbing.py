"""Devices that are bumped or drift, boards that do not stand still: on demand, and never in the stated calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simulated_rig.device import SimulatedHead
from simulated_rig.light import Float32Array
from simulated_rig.movements import PoseDrift, PoseOffset, apply_pose_offset
from slrig.devices import Trigger
from slrig.errors import ConfigError
from tests.rendered_boards import board_head, board_options
from tests.unit.simulated_rig.building import coarser, head_options, small_head, white_black_lines

POSES = [{"position_mm": [0.0, 0.0, 10.0 * k], "rotation_deg": [15.0, 10.0, 0.0]} for k in range(3)]
BUMP = {"pose": 1, "turn_deg": [0.1, 0.3, 0.0], "shift_mm": [0.5, 0.0, 0.0]}


def head_of(folder: Path, **options: Any) -> SimulatedHead:
    return board_head(folder, coarser(board_options(poses=None, pose=POSES, **options), 2))


def frames(head: SimulatedHead, count: int = 10) -> list[Float32Array]:
    """What the first camera sees by the room's light alone at each pattern of a sequence, without noise."""
    head.projector.load(white_black_lines(head.projector.info.size, lines=count - 2))
    name, eye = next(iter(head.cameras.items()))
    eye.arm(count, Trigger.SOFTWARE)
    images: list[Float32Array] = []
    for index in range(count):
        head.projector.show(index)
        images.append(head._views[name].image([]))
    eye.disarm()
    return images


def test_a_push_turns_and_shifts_a_device_in_its_own_frame(tmp_path: Path) -> None:
    device = small_head(tmp_path).exact_calibration.cameras["eye"]
    push = PoseOffset(device="eye", turn_deg=(0.0, 0.0, 90.0), shift_mm=(1.0, 2.0, 3.0))
    now = apply_pose_offset(device, push)
    point = np.array([4.0, 5.0, 6.0])
    seen = device.rotation @ point + device.translation_mm
    moved = now.rotation @ point + now.translation_mm
    np.testing.assert_allclose(moved, [-(seen[1] + 2), seen[0] + 1, seen[2] + 3], atol=1e-12)
    half = apply_pose_offset(device, push, share=0.5)
    angle = Rotation.from_matrix(half.rotation @ device.rotation.T).magnitude()
    assert np.rad2deg(angle) == pytest.approx(45.0)
    np.testing.assert_allclose(apply_pose_offset(device, push, share=0.0).translation_mm, device.translation_mm)


def test_a_bumped_camera_sees_otherwise_than_its_calibration_says(tmp_path: Path) -> None:
    bumped = head_of(tmp_path / "a", faults={"bump": [BUMP | {"device": "left"}]})
    steady = head_of(tmp_path / "b")
    assert bumped.positioner is not None
    assert steady.positioner is not None
    for index, alike in ((0, True), (1, False), (2, False), (0, True)):
        bumped.positioner.move(index)
        steady.positioner.move(index)
        a, b = bumped.truth().cameras["left"].depth_mm, steady.truth().cameras["left"].depth_mm
        assert np.array_equal(a, b, equal_nan=True) is alike
    stated, again = bumped.exact_calibration.cameras["left"], steady.exact_calibration.cameras["left"]
    np.testing.assert_array_equal(stated.rotation, again.rotation)
    # What it sees at pose 1 is what a rig sees whose camera stands there from the beginning.
    there = apply_pose_offset(
        stated, PoseOffset.model_validate({k: v for k, v in BUMP.items() if k != "pose"} | {"device": "left"})
    )
    options = coarser(board_options(poses=None, pose=POSES), 2)
    posed = {key: options["camera"][0][key] for key in options["camera"][0] if key not in ("position_mm", "target_mm")}
    posed |= {"rotation": there.rotation.tolist(), "translation_mm": there.translation_mm.tolist()}
    moved = board_head(tmp_path / "c", options | {"camera": [posed]})
    for head in (bumped, moved):
        assert head.positioner is not None
        head.positioner.move(1)
    np.testing.assert_allclose(
        bumped.truth().cameras["left"].depth_mm, moved.truth().cameras["left"].depth_mm, atol=1e-9
    )


def test_a_bumped_projector_lights_otherwise_and_moves_no_depth(tmp_path: Path) -> None:
    head = head_of(tmp_path, faults={"bump": [BUMP | {"device": "projector"}]})
    steady = head_of(tmp_path / "b")
    for each in (head, steady):
        assert each.positioner is not None
        each.positioner.move(1)
    here, there = head.truth().cameras["left"], steady.truth().cameras["left"]
    np.testing.assert_array_equal(here.depth_mm, there.depth_mm)
    moved = np.nanmedian(np.abs(here.projector_px - there.projector_px), axis=(0, 1))
    # 0.3° about y is 1.0 px at 195 px, less what the shift takes back; 0.1° about x is 0.35 px.
    assert 0.5 < moved[0] < 1.5
    assert 0.15 < moved[1] < 0.6


def test_drift_settles() -> None:
    drift = PoseDrift(device="left", turn_deg=(0.0, 0.1, 0.0), settle_s=100.0)
    shares = [drift.progress(time_s, 0) for time_s in (0.0, 100.0, 1e6)]
    np.testing.assert_allclose(shares, [0.0, 1 - np.exp(-1), 1.0])
    counted = PoseDrift(device="left", settle_captures=2.0)
    np.testing.assert_allclose([counted.progress(99.0, n) for n in (0, 2)], [0.0, 1 - np.exp(-1)])
    for table in ({}, {"settle_s": 1.0, "settle_captures": 1.0}):
        with pytest.raises(ValueError, match="either settle_s"):
            PoseDrift.model_validate({"device": "left", **table})


def test_a_device_drifts_from_capture_to_capture_and_stands_still_within_one(tmp_path: Path) -> None:
    turn = {"device": "eye", "turn_deg": [0.0, 2.0, 0.0], "settle_captures": 1.0}
    head = small_head(tmp_path, drift=[turn])
    sequence = white_black_lines(head.projector.info.size)
    stated = head.exact_calibration.cameras["eye"]
    angles = []
    for _capture in range(4):
        head.projector.load(sequence)
        head.projector.show(0)
        first = head._views["eye"].camera
        head.projector.show(5)
        assert head._views["eye"].camera is first
        angles.append(np.rad2deg(Rotation.from_matrix(first.rotation @ stated.rotation.T).magnitude()))
    np.testing.assert_allclose(angles, 2.0 * (1 - np.exp(-np.arange(4.0))), atol=1e-9)


def test_a_device_drifts_with_the_time_of_the_world(tmp_path: Path) -> None:
    warm = {"device": "projector", "shift_mm": [0.0, 1.0, 0.0], "settle_s": 10.0}
    head = small_head(tmp_path, drift=[warm])
    sequence = white_black_lines(head.projector.info.size)
    begun = head.clock.now_ns()
    eye = head.cameras["eye"]
    eye.arm(1, Trigger.SOFTWARE)
    with pytest.raises(Exception, match="no frame"):
        eye.read(0, 10.0)
    assert head.clock.now_ns() - begun == 10 * 10**9
    head.projector.load(sequence)
    now, stated = head._scene_state.projector, head.exact_calibration.projector
    assert stated is not None
    np.testing.assert_allclose(now.translation_mm - stated.translation_mm, [0.0, 1 - np.exp(-1), 0.0], atol=1e-9)


@pytest.mark.slow
def test_a_board_that_moves_is_elsewhere_in_the_last_frame(tmp_path: Path) -> None:
    moving = [{"pose": 1, "shift_mm": [2.0, 0.0, 0.0], "steps": 5}]
    head, steady = head_of(tmp_path / "a", faults={"moving": moving}), head_of(tmp_path / "b")
    for each in (head, steady):
        assert each.positioner is not None
        each.positioner.move(1)
    seen, still = frames(head), frames(steady)
    np.testing.assert_array_equal(seen[0], still[0])
    kinds = len({image.tobytes() for image in seen})
    assert kinds == 5
    end = [POSES[1] | {"position_mm": [2.0, 0.0, 10.0]}]
    there = board_head(tmp_path / "c", coarser(board_options(poses=None, pose=end), 2))
    # The same turn by way of a rotation matrix: equal but for rounding.
    np.testing.assert_allclose(seen[-1], frames(there)[0], atol=1e-4)
    # The next capture begins where this one did, and other poses stand still.
    np.testing.assert_array_equal(frames(head)[0], seen[0])
    assert head.positioner is not None
    head.positioner.move(2)
    assert len({image.tobytes() for image in frames(head)}) == 1


def test_an_object_moves_without_a_script_too(tmp_path: Path) -> None:
    head = small_head(tmp_path, faults={"moving": [{"turn_deg": [0.0, 3.0, 0.0], "steps": 2}]}, ambient=0.5)
    assert head.positioner is None
    before = head.truth().cameras["eye"].depth_mm
    frames(head)
    after = head.truth().cameras["eye"].depth_mm
    assert np.abs(after - before).max() > 1.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"faults": {"bump": [BUMP | {"device": "third"}]}}, "third.*the rig has.*left.*projector"),
        ({"drift": [{"device": "third", "settle_s": 1.0}]}, "third"),
        ({"faults": {"bump": [BUMP | {"device": "left", "pose": 9}]}}, "pose 9 does not exist; the script has 3"),
        ({"faults": {"moving": [{"pose": 3}]}}, "pose 3 does not exist"),
        ({"faults": {"moving": [{"steps": 1}]}}, "steps"),
    ],
)
def test_faults_of_what_is_not_there_are_refused(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=f"(?s){words}"):
        head_of(tmp_path, **options)


def test_nothing_is_disturbed_by_default(tmp_path: Path) -> None:
    head = small_head(tmp_path)
    stage, eye = head._scene_state.snapshot, head._views["eye"].camera
    frames(head)
    assert head._scene_state.snapshot is stage
    assert head._views["eye"].camera is eye
    assert head_options().keys().isdisjoint({"drift", "pose", "poses", "faults"})

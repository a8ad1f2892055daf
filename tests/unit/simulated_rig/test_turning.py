"""The rendered turntable: which objects turn, which way, and by how much it errs when told to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simulated_rig.device import SimulatedHead
from simulated_rig.movements import TurntableOptions
from slrig.devices import Turntable
from slrig.errors import ConfigError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import FloatArray
from tests.unit.simulated_rig.building import small_head

SCENE = """
[[object]]
name = "arm"
shape = "ball_bar"
position_mm = [20.0, 5.0, 3.0]
rotation_deg = [0.0, 30.0, 10.0]
radius_mm = 4.0
distance_mm = 20.0
bar_radius_mm = 2.0

[[object]]
name = "backdrop"
shape = "plane"
position_mm = [0.0, 0.0, 60.0]
size_mm = [400.0, 400.0]
"""
POINT, UP = np.array([3.0, 0.0, -4.0]), np.array([0.0, -1.0, 0.0])


def head_of(folder: Path, *, seed: int = 1, **table: Any) -> tuple[SimulatedHead, Turntable]:
    head = small_head(folder, SCENE, seed=seed, turntable={"point_mm": POINT.tolist(), **table})
    assert isinstance(head.positioner, Turntable)
    return head, head.positioner


def vertices(head: SimulatedHead) -> FloatArray:
    return head._scene_state.surface.vertices_mm


def turn_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """(3,) the rotation vector, rad, that takes points, (n, 3), to others."""
    found, _ = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))
    return np.asarray(found.as_rotvec())


def test_what_stands_on_it_turns_right_handed_about_its_axis_and_the_backdrop_stays(tmp_path: Path) -> None:
    head, table = head_of(tmp_path)
    seen, before = head.truth().cameras["eye"].depth_mm, vertices(head)
    table.turn(90.0)
    after = vertices(head)
    wall = 4  # corners of the plane, which is the last object
    np.testing.assert_array_equal(after[-wall:], before[-wall:])
    # Right-handed about -y: x goes to z, and z to -x.
    x, y, z = (before[:-wall] - POINT).T
    np.testing.assert_allclose(after[:-wall] - POINT, np.column_stack([-z, y, x]), atol=1e-9)
    assert not np.array_equal(head.truth().cameras["eye"].depth_mm, seen)
    table.turn(360.0)
    np.testing.assert_allclose(vertices(head), before, atol=1e-9)


def test_objects_may_be_named(tmp_path: Path) -> None:
    head, table = head_of(tmp_path, objects=["backdrop"])
    before = vertices(head)
    table.move(1)
    np.testing.assert_array_equal(vertices(head)[:-4], before[:-4])
    assert not np.array_equal(vertices(head)[-4:], before[-4:])


@pytest.mark.slow
def test_its_angle_errs_by_scale_and_at_random_as_configured(tmp_path: Path) -> None:
    def stops(seed: int, times: int) -> list[float]:
        head, table = head_of(tmp_path, seed=seed, scale_error=0.01, angle_sigma_deg=0.2)
        before = vertices(head)[:-4]
        found = []
        for angle in np.tile([90.0, 0.0], times):
            table.turn(angle)
            found.append(float(np.rad2deg(turn_between(before, vertices(head)[:-4]) @ UP)))
        return found

    one = stops(1, 10)
    assert stops(1, 1) == one[:2] != stops(2, 1)
    assert np.mean(one[::2]) == pytest.approx(90.9, abs=0.15)
    assert np.mean(one[1::2]) == pytest.approx(0.0, abs=0.15)
    assert 0.12 < np.std(one[::2]) < 0.3


def test_it_stays_where_it_is_when_it_is_there_already(tmp_path: Path) -> None:
    head, table = head_of(tmp_path, angle_sigma_deg=1.0)
    before = vertices(head)
    table.turn(0.0)
    np.testing.assert_array_equal(vertices(head), before)
    table.turn(45.0)
    there = vertices(head)
    table.move(1)
    np.testing.assert_array_equal(vertices(head), there)


def test_its_axis_leans_twice_in_a_turn() -> None:
    table = TurntableOptions(point_mm=(1.0, 2.0, 3.0), direction=(0.1, -1.0, 0.3), wobble_deg=0.5)
    axis = table.axis
    leans = []
    for angle in (0.0, 45.0, 90.0, 135.0):
        motion = table.motion(angle)
        leans.append(np.rad2deg(np.arccos(np.clip((motion[:3, :3] @ axis.direction) @ axis.direction, -1, 1))))
        np.testing.assert_allclose(motion[:3, :3] @ axis.point_mm + motion[:3, 3], axis.point_mm, atol=1e-12)
    np.testing.assert_allclose(leans, [0.0, 0.5, 0.0, 0.5], atol=1e-5)
    # To one side and to the other.
    sides = [table.motion(angle)[:3, :3] @ axis.direction - axis.direction for angle in (45.0, 135.0)]
    np.testing.assert_allclose(sides[0] + sides[1], 0.0, atol=1e-4)


def test_it_reports_its_axis_only_if_configured(tmp_path: Path) -> None:
    assert head_of(tmp_path)[1].axis is None
    told = head_of(tmp_path, knows_axis=True, direction=[0.0, -2.0, 0.0])[1].axis
    assert told is not None
    np.testing.assert_allclose([told.point_mm, told.direction], [POINT, UP])


def test_what_it_cannot_do_is_refused(tmp_path: Path) -> None:
    _, table = head_of(tmp_path, poses=3)
    assert list(table.poses) == ["0°", "120°", "240°"]
    with pytest.raises(UnsupportedByDeviceError, match="poses 0 to 2: 0°, 120°, 240°"):
        table.move(3)
    with pytest.raises(UnsupportedByDeviceError, match="nan"):
        table.turn(float("nan"))
    for _ in range(2):
        table.close()
    with pytest.raises(DeviceStateError, match="closed"):
        table.turn(10.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"turntable": {"point_mm": [0.0, 0.0, 0.0], "objects": ["leg"]}}, r"unknown object 'leg'.*'arm', 'backdrop'"),
        ({"turntable": {"point_mm": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, 0.0]}}, "expected a direction"),
        (
            {"turntable": {"point_mm": [0.0] * 3}, "pose": [{"object": "arm", "position_mm": [0.0] * 3}]},
            r"\[head.turntable\] cannot be combined with \[\[head.pose\]\]",
        ),
    ],
)
def test_tables_that_contradict_themselves_are_refused(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        small_head(tmp_path, SCENE, **options)

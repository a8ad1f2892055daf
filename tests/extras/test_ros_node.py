"""The node for ROS 2 where ROS is not: what it says. `tests/e2e/services` runs it in ROS."""

from __future__ import annotations

import httpx2
import numpy as np
import pytest

from slrig.client import Client
from slrig.errors import ExtraMissingError
from slrig.extras.ros_node import _class_of, _devices, _robot, main
from tests.unit.client.service import client_of

pytestmark = pytest.mark.slow


def test_a_calibration_without_a_projector_has_its_cameras() -> None:
    device = {
        "size_px": [4, 3],
        "matrix": [[50.0, 0, 1.5], [0, 50, 1], [0, 0, 1]],
        "distortion": [-0.1, 0.05, 0.001, 0, 0],
        "rotation": [[1.0, 0, 0], [0, -1, 0], [0, 0, -1]],
        "translation_mm": [0.0, 0, 400],
    }
    assert list(_devices({"cameras": {"left-2": device}, "projector": None})) == ["left-2"]


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        ("tf2_msgs/msg/TFMessage", r"tf2_msgs is missing: apt install ros-\$ROS_DISTRO-tf2-msgs"),
        (
            "slrig_interfaces/action/Scan",
            "slrig_interfaces is missing: colcon build --paths .*/extras/slrig_interfaces",
        ),
    ],
)
def test_a_missing_package_is_named_with_how_it_is_had(kind: str, advice: str) -> None:
    with pytest.raises(ExtraMissingError, match=f"{advice}$"):
        _class_of(kind)


@pytest.mark.parametrize(("kind", "frame"), [("in-hand", "tcp"), ("fixed", "base")])
def test_the_world_is_in_the_robots_frame_where_that_is_known_for_the_scans_calibration(kind: str, frame: str) -> None:
    told = {"kind": kind, "calibration": "a", "flange_frame": "tcp", "base_frame": "base", "rig": np.eye(4).tolist()}

    def client(status: int) -> Client:
        fault = {
            "type": "/problems/calibration-not-found",
            "title": "none",
            "status": 404,
            "detail": "None.",
            "code": "x",
        }
        return client_of(lambda _: httpx2.Response(status, json=told if status == 200 else fault))

    placed = _robot(client(200), "a")
    assert placed is not None
    assert placed[0] == frame
    assert _robot(client(200), "another") is None
    assert _robot(client(404), "a") is None


def test_without_ros_the_node_says_what_it_needs() -> None:
    with pytest.raises(SystemExit, match=r"rclpy is missing.*source /opt/ros/jazzy/setup\.bash"):
        main([])

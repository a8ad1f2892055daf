"""The node for ROS 2, over a fake rclpy: what it publishes, how, and what its service answers. ROS itself is not here;
its messages are rosbags' classes of the same fields.
"""

from __future__ import annotations

import array
import io
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import httpx2
import numpy as np
import pytest

from slrig.client import Client
from slrig.errors import ConfigError
from slrig.extras import ros_node
from slrig.extras.ros_node import ScanNode, main
from tests.ros_readers import colours, library, point_columns, seen_at
from tests.unit.client.service import HERE, SCAN, client_of, event_answer, stream

HIGH, WIDE = 3, 4
DEVICE = {
    "size_px": [WIDE, HIGH],
    "matrix": [[50.0, 0, 1.5], [0, 50, 1], [0, 0, 1]],
    "distortion": [-0.1, 0.05, 0.001, 0, 0],
    "rotation": [[1.0, 0, 0], [0, -1, 0], [0, 0, -1]],
    "translation_mm": [0.0, 0, 400],
}
CALIBRATION = {"format": "slrig-calibration", "version": 1, "cameras": {"left-2": DEVICE}, "projector": DEVICE}
FILES = {name: f"{HERE}/{name}" for name in ("points-left-2.npz", "calibration.json")}
DONE = {
    **SCAN,
    "state": "succeeded",
    "started_at": "2026-03-04T05:06:07.250000Z",
    "links": {**SCAN["links"], "files": FILES},
}

pytestmark = pytest.mark.slow


@dataclass
class FakeNode:
    """What rclpy's node is asked for."""

    parameters: dict[str, str] = field(default_factory=dict)
    services: dict[str, Any] = field(default_factory=dict)
    offered: dict[str, Any] = field(default_factory=dict)
    published: dict[str, list[Any]] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    destroyed: bool = False

    def declare_parameter(self, name: str, value: str) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def create_service(self, kind: Any, name: str, callback: Any) -> None:
        assert kind.__name__ == "Trigger"
        self.services[name] = callback

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        assert topic not in self.offered
        self.offered[topic] = (kind, qos)
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.errors.append)

    def destroy_node(self) -> None:
        self.destroyed = True


@pytest.fixture
def types() -> Any:
    typesys = library("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


@pytest.fixture
def node(types: Any, monkeypatch: pytest.MonkeyPatch) -> FakeNode:
    made = FakeNode()
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda **_: None, "create_node": lambda _: made, "try_shutdown": lambda: None},
        "rclpy.executors": {"ExternalShutdownException": type("ExternalShutdownException", (Exception,), {})},
        "rclpy.qos": {
            "QoSProfile": SimpleNamespace,
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="latched"),
            "ReliabilityPolicy": SimpleNamespace(RELIABLE="reliable"),
        },
        "std_srvs.srv": {"Trigger": type("Trigger", (), {})},
    }
    for kind, each in types.types.items():
        package, sort, name = kind.split("/")
        modules.setdefault(f"{package}.{sort}", {})[name] = each
    for name, members in modules.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    return made


def answer(request: httpx2.Request) -> httpx2.Response:
    if request.url.path == f"{HERE}/events":
        if request.headers["Last-Event-ID"] == "1":
            return httpx2.Response(204)
        return event_answer(stream({"id": 1, "kind": "state", "state": "succeeded"}))
    if request.url.path == FILES["calibration.json"]:
        return httpx2.Response(200, json=CALIBRATION)
    if request.url.path == FILES["points-left-2.npz"]:
        out = io.BytesIO()
        np.savez(out, **arrays())
        return httpx2.Response(200, content=out.getvalue())
    return httpx2.Response(202 if request.method == "POST" else 200, json=DONE)


def arrays() -> dict[str, Any]:
    points = np.arange(HIGH * WIDE * 3, dtype=np.float32).reshape(HIGH, WIDE, 3)
    points[0, 1] = np.nan
    return {
        "points_mm": points,
        "normals": points,
        "sigma_mm": points[..., 0] / 100,
        "colour": np.arange(HIGH * WIDE * 3, dtype=np.uint8).reshape(HIGH, WIDE, 3),
        "mark": np.zeros((HIGH, WIDE), dtype=np.uint8),
        "cause": np.isnan(points[..., 0]).astype(np.uint8),
        "causes": np.array(["none", "not_lit"]),
        "camera": np.array("left-2"),
    }


@pytest.fixture
def client() -> Iterator[Client]:
    with client_of(answer) as made:
        yield made


def test_a_scan_is_published_latched_and_answered_with_its_id(node: FakeNode, types: Any, client: Client) -> None:
    ScanNode(node, client, world="cell")
    answers = [node.services["~/scan"](None, SimpleNamespace()) for _ in range(2)]
    assert [(each.success, each.message) for each in answers] == [(True, "5f")] * 2
    assert set(node.published) == {
        "/tf_static",
        "~/left_2/points",
        "~/left_2/camera_info",
        "~/projector/camera_info",
    }
    for topic, (kind, qos) in node.offered.items():
        assert (qos.durability, qos.reliability, qos.depth) == ("latched", "reliable", 1), topic
        assert [type(each) for each in node.published[topic]] == [kind, kind]
    (points, _), (info, _) = node.published["~/left_2/points"], node.published["~/left_2/camera_info"]
    # As ROS's setters take without a look at each number.
    assert isinstance(points.data, array.array)
    assert (points.data.typecode, info.d.typecode) == ("B", "d")
    assert (points.header.frame_id, info.header.frame_id) == ("cell", "left-2_optical_frame")
    assert (points.header.stamp.sec, points.header.stamp.nanosec) == (1772600767, 250_000_000)
    columns, expected = point_columns(points), arrays()
    for place, axis in enumerate("xyz"):
        np.testing.assert_allclose(columns[axis], expected["points_mm"][..., place] / 1000, rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(columns["sigma"]), expected["cause"] != 0)
    np.testing.assert_array_equal(colours(columns), expected["colour"])
    (transforms, _) = node.published["/tf_static"]
    assert [each.child_frame_id for each in transforms.transforms] == [
        "left-2_optical_frame",
        "projector_optical_frame",
    ]
    np.testing.assert_allclose(seen_at(transforms, info, np.array([[0.0, 0, 0]])), [[1.5, 1]], atol=1e-9)
    for each in (info, transforms):
        assert types.deserialize_cdr(types.serialize_cdr(_plain(each), each.__msgtype__), each.__msgtype__)


def _plain(message: Any) -> Any:
    """Rosbags writes arrays of numpy."""
    if isinstance(getattr(message, "d", None), array.array):
        message.d = np.array(message.d)
    return message


def test_a_scan_that_cannot_be_is_answered_and_published_nowhere(node: FakeNode) -> None:
    problem = {"type": "/problems/rig-busy", "status": 409, "detail": "The rig is held."}
    with client_of(lambda _: httpx2.Response(409, json=problem)) as refused:
        ScanNode(node, refused)
        answered = node.services["~/scan"](None, SimpleNamespace())
    assert (answered.success, answered.message) == (False, "The rig is held.")
    assert (node.errors, node.published) == (["The rig is held."], {})


def test_the_node_runs_until_it_is_stopped(node: FakeNode, monkeypatch: pytest.MonkeyPatch) -> None:
    spun: list[Any] = []

    def spin(asked: Any) -> None:
        spun.append(asked)
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["rclpy"], "spin", spin, raising=False)
    node.parameters["url"] = "http://scanner:8731"
    main([])
    assert (spun, node.destroyed, list(node.services)) == ([node], True, ["~/scan"])
    node.parameters["url"] = "scanner"
    with pytest.raises(ConfigError, match="scanner"):
        main([])


def test_a_calibration_without_a_projector_has_its_cameras() -> None:
    told = json.loads(json.dumps({**CALIBRATION, "projector": None}))
    assert list(ros_node._devices(told)) == ["left-2"]

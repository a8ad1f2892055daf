"""slrig's node in a real ROS 2: rclpy and Fast DDS on loopback, and another program that scans and reads by them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.e2e.conftest import KEY, SLOW, STOP_LIMIT_S, serving, write_rig
from tests.listening import free_port
from tests.npm import lacking
from tests.ros_readers import colours, library, point_columns, seen_at

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
PEER = Path(__file__).with_name("ros_peer.py")
SUCCEEDED, CANCELLED, ABORTED = 4, 5, 6
"""action_msgs/msg/GoalStatus."""
NODE = "-m", "slrig.extras.ros_node", "--ros-args", "-p"
LATCHED = {
    "/slrig/left/points": "sensor_msgs/msg/PointCloud2",
    "/slrig/left/camera_info": "sensor_msgs/msg/CameraInfo",
    "/slrig/projector/camera_info": "sensor_msgs/msg/CameraInfo",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}


@pytest.fixture
def python() -> str:
    """A Python with rclpy, which `.ci/ros` makes."""
    found = os.environ.get("SLRIG_ROS_PYTHON")
    if found is None:
        lacking("needs a Python with rclpy in SLRIG_ROS_PYTHON: .ci/ros FOLDER makes FOLDER/bin/python")
    if not found:
        pytest.skip("this machine has no Python 3.12, the only one for which there are wheels of ROS")
    return found


class Process:
    """A program in a ROS of this test's own. path : where Python looks first."""

    def __init__(self, python: str, log: Path, *words: str, path: Path = ROOT) -> None:
        environment = {
            **os.environ,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
            "ROS_LOG_DIR": str(log.parent),
            "PYTHONPATH": f"{path}:{ROOT}",
            "SLRIG_API_KEY": KEY,
        }
        self.log = log
        self._unheard: list[dict[str, Any]] = []
        with log.open("wb") as errors:
            self.process = subprocess.Popen(  # noqa: S603 - our own programs
                [python, *words],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env=environment,
                text=True,
            )

    def do(self, what: str, **command: Any) -> None:
        print(json.dumps({"do": what, **command}), file=self.process.stdin, flush=True)

    def hear(self, of: str, **wanted: Any) -> dict[str, Any]:
        """The next message about `of` with these values; each is returned once."""
        assert self.process.stdout is not None
        while True:
            for told in self._unheard:
                if told["of"] == of and wanted.items() <= told.items():
                    self._unheard.remove(told)
                    return told
            line = self.process.stdout.readline()
            assert line, f"{of}: no {wanted}, but {self._unheard}; {self.log.read_text()}"
            self._unheard.append(json.loads(line))

    def asked(self, service: str, kind: str, **request: Any) -> str:
        """What a service answers."""
        self.do("call", service=service, kind=kind, **request)
        return str(self.hear(service)["answer"])

    def ended(self, goal: str, status: int) -> dict[str, Any]:
        return self.hear(goal, ended=status)


@contextmanager
def running(*words: Any, **options: Any) -> Iterator[Process]:
    made = Process(*words, **options)
    try:
        yield made
    finally:
        made.process.terminate()
        made.process.communicate(timeout=STOP_LIMIT_S)


def test_a_program_of_ros_scans_cancels_and_reads_what_was_published(python: str, tmp_path: Path) -> None:
    types = library("rosbags.typesys")
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    unbuilt = tmp_path / "unbuilt"
    (unbuilt / "slrig_interfaces").mkdir(parents=True)
    (unbuilt / "slrig_interfaces" / "__init__.py").touch()
    words = *NODE, f"url:={url}"
    with (
        running(python, tmp_path / "node.log", *words, "-p", "live:=left") as node,
        running(python, tmp_path / "plain.log", *words, "-r", "__node:=plain", path=unbuilt) as plain,
        running(python, tmp_path / "peer.log", str(PEER)) as peer,
    ):
        # Nobody serves yet; the node tells so, and goes on.
        peer.do("goal", name="early")
        early = peer.ended("early", ABORTED)
        assert early["scan_id"] == ""
        assert early["code"] == "service"
        assert f"{url} cannot be reached" in early["message"]
        assert early["message"].endswith("-p url:=http://HOST:8731.")
        with (
            serving(write_rig(tmp_path / "rig", head=SLOW), tmp_path / "data", port=port) as service,
            service.client() as client,
        ):
            client.presets.put("dark", {"scan": {"exposure_s": 1e-5}})
            client.presets.put("long", {"scan": {"exposure_s": 1.0}})
            # Callbacks go on while a scan is captured and one waits.
            peer.do("goal", name="long", preset="long", label="long")
            long = peer.hear("long", stage="capture")
            assert url in peer.asked("/slrig/get_parameters", "rcl_interfaces/srv/GetParameters", names=["url"])
            peer.do("goal", name="refused", queue=False)
            refused = peer.ended("refused", ABORTED)
            assert refused["code"] == "rig-busy"
            assert refused["message"].endswith("A goal with queue: true waits.")
            for name, stage in (("waiting", "queued"), ("long", "capture")):
                if name == "waiting":
                    peer.do("goal", name=name)
                peer.hear(name, stage=stage)
                peer.do("cancel", name=name)
                cancelled = peer.ended(name, CANCELLED)
                assert cancelled["code"] == "scan-cancelled"
                assert client.scans.get(cancelled["scan_id"])["state"] == "cancelled"
            assert long["rig_free"] is False

            peer.do("goal", name="dark", preset="dark")
            dark = peer.ended("dark", ABORTED)
            assert (dark["code"], client.scans.get(dark["scan_id"])["state"]) == ("scan-evidence", "failed")

            # Without the action's package a scan needs no more than ROS has.
            answer = peer.asked("/plain/scan", "std_srvs/srv/Trigger")
            assert "slrig_interfaces is missing: colcon build" in plain.log.read_text()
            peer.do("goal", name="plate", label="plate")
            peer.hear("plate", rig_free=True)
            done = peer.ended("plate", SUCCEEDED)
            assert (done["code"], done["message"]) == ("", "")
            first, last = client.scans.list()["scans"][1::-1]
            assert f"success=True, message='{first['id']}'" in answer
            assert (last["id"], last["label"]) == (done["scan_id"], "plate")

            # Who comes after the publication gets the last of each.
            with running(python, tmp_path / "reader.log", str(PEER)) as reader:
                for number, (topic, kind) in enumerate(LATCHED.items()):
                    reader.do("read", topic=topic, kind=kind, path=str(tmp_path / str(number)))
                for topic in LATCHED:
                    reader.hear(topic)
            store = types.get_typestore(types.Stores.ROS2_JAZZY)
            points, left, projector, transforms = (
                store.deserialize_cdr((tmp_path / str(number)).read_bytes(), kind)
                for number, kind in enumerate(LATCHED.values())
            )
            cloud = client.result(done["scan_id"]).cloud("left")
            columns = point_columns(points)
            measured = cloud.cause == 0
            assert np.count_nonzero(np.isfinite(columns["x"])) == np.count_nonzero(measured) > 10_000
            for place, axis in enumerate("xyz"):
                np.testing.assert_allclose(columns[axis] * 1000, cloud.points_mm[..., place], rtol=1e-6)
                np.testing.assert_array_equal(columns[f"normal_{axis}"], cloud.normals[..., place])
            np.testing.assert_allclose(columns["sigma"] * 1000, cloud.sigma_mm, rtol=1e-6)
            np.testing.assert_array_equal(colours(columns), cloud.colour)
            at = np.stack([columns[axis][measured] for axis in "xyz"], axis=1).astype(np.float64)
            rows, cols = np.nonzero(measured)
            np.testing.assert_allclose(seen_at(transforms, left, at), np.stack([cols, rows], axis=1), atol=0.01)
            lit_by = seen_at(transforms, projector, at)
            assert ((lit_by > -0.5) & (lit_by < [projector.width, projector.height])).all()
            assert [each.header.frame_id for each in (points, left)] == ["world", "left_optical_frame"]

            # Live depth begins with who subscribes to it.
            with running(python, tmp_path / "live.log", str(PEER)) as viewer:
                path, cloud_kind = str(tmp_path / "live"), LATCHED["/slrig/left/points"]
                viewer.do("read", topic="/slrig/left/live", kind=cloud_kind, path=path, latched=False)
                viewer.hear("/slrig/left/live")
            shown = store.deserialize_cdr(Path(path).read_bytes(), cloud_kind)
            assert (shown.header.frame_id, shown.width, shown.height) == ("left_optical_frame", 80, 64)
            assert 0.4 < np.nanmedian(point_columns(shown)["z"]) < 0.8

            # A node that is ended cancels what it began, and tells who waits for it.
            peer.do("goal", name="last", preset="long")
            peer.hear("last", stage="capture")
            node.process.send_signal(signal.SIGINT)
            last = peer.ended("last", ABORTED)
            assert last["code"] == "scan-cancelled"
            assert client.scans.get(last["scan_id"])["state"] == "cancelled"
            assert node.process.wait(STOP_LIMIT_S) == 0
        log = node.log.read_text()
        assert "Traceback" not in log
        assert all(each["message"] in log for each in (early, refused, dark, last))


def test_a_node_that_cannot_begin_says_why_and_ends(python: str, tmp_path: Path) -> None:
    with running(python, tmp_path / "node.log", *NODE, "url:=scanner") as node:
        assert node.process.wait(STOP_LIMIT_S) == 1
    assert "'scanner' is not a URL of a service" in node.log.read_text()

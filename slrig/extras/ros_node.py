"""A ROS 2 node that scans when its service is called, and publishes the result.

`python -m slrig.extras.ros_node --ros-args -p url:=http://scanner:8731` where ROS is set up. All types are ROS's own:
an action for scans would need a package of interfaces that is built first.
"""

from __future__ import annotations

import array
import importlib
import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.client import Client, ScanResult
from slrig.errors import SlrigError
from slrig.ros_messages import PROJECTOR, TF_STATIC, WORLD, Device, Messages, topic

NODE = "slrig"


class ScanNode:
    """What the node does. node : rclpy's, whose service and publishers these are. world : the frame of the points."""

    def __init__(self, node: Any, client: Client, *, world: str = WORLD) -> None:
        self._node = node
        self._client = client
        self._world = world
        self._publishers: dict[str, Any] = {}
        node.create_service(_class_of("std_srvs/srv/Trigger"), "~/scan", self.scan)

    def scan(self, _request: Any, response: Any) -> Any:
        """Scan, publish, and answer with the scan's id, or with what went wrong. Waits while the rig is held."""
        try:
            result = self._client.scan()
            self.publish(result)
        except SlrigError as error:
            self._node.get_logger().error(str(error))
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, result.id
        return response

    def publish(self, result: ScanResult) -> None:
        """Publish where the devices stand, how each sees, and the points of each camera, stamped with the time at which
        the scan began. Raises ServiceError.
        """
        devices = _devices(json.loads(self._client.scans.file(result.id, "calibration.json")))
        seconds = datetime.fromisoformat(result.scan["started_at"]).timestamp()
        messages = Messages(class_of=_class_of, sequence=_sequence, seconds=seconds, world=self._world)
        self._send(TF_STATIC, messages.transforms(devices))
        for name, device in devices.items():
            self._send(topic(name, "camera_info", under="~"), messages.camera_info(name, device))
            if f"points-{name}.npz" in result.files:
                self._send(topic(name, "points", under="~"), messages.points(result.cloud(name)))

    def _send(self, where: str, message: Any) -> None:
        if where not in self._publishers:
            from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

            # Latched: scans are rare, and who subscribes between two of them gets the last.
            latched = QoSProfile(
                depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
            )
            self._publishers[where] = self._node.create_publisher(type(message), where, latched)
        self._publishers[where].publish(message)


def _devices(calibration: Mapping[str, Any]) -> dict[str, Device]:
    """The devices in a calibration.json, cameras first."""
    found = dict(calibration["cameras"])
    if calibration.get("projector") is not None:
        found[PROJECTOR] = calibration["projector"]
    names = "matrix", "distortion", "rotation", "translation_mm"
    return {
        name: Device(*told["size_px"], *(np.array(told[each], dtype=np.float64) for each in names))
        for name, told in found.items()
    }


def _class_of(kind: str) -> Any:
    package, sort, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{sort}"), name)


def _sequence(numbers: NDArray[Any]) -> array.array[Any]:
    # Anything else is looked at number by number in Python, which takes seconds of a cloud.
    found = array.array(numbers.dtype.char)
    found.frombytes(numbers.tobytes())
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the node until ROS is shut down. The key is in SLRIG_API_KEY: everybody may read a node's parameters."""
    import rclpy
    from rclpy.executors import ExternalShutdownException

    rclpy.init(args=arguments)
    node = rclpy.create_node(NODE)
    try:
        url = node.declare_parameter("url", "").value
        world = node.declare_parameter("world", WORLD).value
        with Client(url or None) as client:
            ScanNode(node, client, world=world)
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

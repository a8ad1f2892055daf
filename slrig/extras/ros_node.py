"""A ROS 2 node that scans for an action or a service, and publishes the result.

`python -m slrig.extras.ros_node --ros-args -p url:=http://scanner:8731` where ROS is set up. No action among ROS's own
has the goal, feedback and result of a scan, so `~/scan` is a `slrig_interfaces/action/Scan` where the package next to
this file was built. As a `std_srvs/srv/Trigger`, which has neither progress nor cancel, `~/scan` needs no build.
"""

from __future__ import annotations

import array
import importlib
import json
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.client import Captured, Client, Progress, ScanJob, ScanResult, StateChange
from slrig.client.errors import ConflictError, NotFoundError
from slrig.errors import ExtraMissingError, ScanCancelledError, SlrigError
from slrig.ros_messages import PROJECTOR, TF_STATIC, WORLD, Device, Messages, topic

NODE = "slrig"
_THREADS = 32
"""More than scans that wait in the service's line (`queue_length`, 16), so that none keeps another callback waiting."""
_CHECK_S = 0.25
"""Interval of checks of goals: rclpy marks one as to be cancelled only after it has asked whether it may be."""
_AGAIN_S = 2.0
"""Until live depth that ended is begun again."""
_ADVICE = {
    "rig-busy": " A goal with queue: true waits.",
    "service": " To this node an address is given by -p url:=http://HOST:8731.",
}
"""Advice added to an error for users of this node, by its code."""


@dataclass(eq=False, slots=True)
class _Run:
    """A scan of one goal or request. is_unwanted : whether its client gave it up. job : None until it was begun."""

    is_unwanted: Callable[[], bool]
    job: ScanJob | None = None
    is_cancelled: bool = False


class ScanNode:
    """The node's services. node : rclpy's, which offers them. world : the frame of the points. live : a camera with
    live depth published while `~/CAMERA/live` has subscribers; empty for none.

    Raises
    ------
    ExtraMissingError
        One of ROS's packages of messages is missing.
    """

    def __init__(self, node: Any, client: Client, *, world: str = WORLD, live: str = "") -> None:
        from rclpy.action import ActionServer, CancelResponse
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.task import Future

        self._node = node
        self._client = client
        self._world = world
        self._publishers: dict[str, Any] = {}
        self._runs: set[_Run] = set()
        self._publishing = Lock()
        self._stopping = Event()
        self.stopped = Future()
        for kind in ("sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"):
            _class_of(kind)
        if live:
            Thread(target=self._show_live, args=(live,), name="slrig-live", daemon=True).start()
        concurrent = ReentrantCallbackGroup()
        node.create_service(_class_of("std_srvs/srv/Trigger"), "~/scan", self.answer, callback_group=concurrent)
        node.create_timer(_CHECK_S, self._check, callback_group=concurrent)
        try:
            self._action = _class_of("slrig_interfaces/action/Scan")
        except ExtraMissingError as error:
            node.get_logger().warning(f"Scans are without progress and cancel, by a service: {error}")
            return
        accept = CancelResponse.ACCEPT
        ActionServer(
            node, self._action, "~/scan", self.execute, callback_group=concurrent, cancel_callback=lambda _: accept
        )

    def answer(self, _request: Any, response: Any) -> Any:
        """Scan, publish, and answer with the scan's id, or with what went wrong. Waits while the rig is held."""
        try:
            with self._scan(lambda: False) as job:
                self.publish(job.result())
        except SlrigError as error:
            response.success, response.message = False, self._fault(error)
        else:
            response.success, response.message = True, job.id
        return response

    def execute(self, goal: Any) -> Any:
        """Scan as a goal says, send feedback, publish, and return the action's result."""
        request, result, feedback = goal.request, self._action.Result(), self._action.Feedback()
        try:
            names = {"label": request.label or None, "preset": request.preset or None}
            busy = "queue" if request.queue else "reject"
            with self._scan(lambda: goal.is_cancel_requested, if_busy=busy, **names) as job:
                result.scan_id = job.id
                for event in job:
                    if isinstance(event, Progress):
                        feedback.stage, feedback.fraction = event.stage, event.fraction
                    elif isinstance(event, StateChange):
                        feedback.stage = event.state
                    feedback.rig_free |= isinstance(event, Captured)
                    goal.publish_feedback(feedback)
                self.publish(job.result())
        except SlrigError as error:
            result.code, result.message = error.code, self._fault(error)
            if isinstance(error, ScanCancelledError) and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        else:
            goal.succeed()
        return result

    @contextmanager
    def _scan(self, is_unwanted: Callable[[], bool], **options: Any) -> Iterator[ScanJob]:
        run = _Run(is_unwanted)
        self._runs.add(run)
        try:
            run.job = self._client.start_scan(**options)
            yield run.job
        except ScanCancelledError as error:
            if run.job is None or not run.is_cancelled:
                raise
            message = f"Scan {run.job.id} was cancelled by this node, because its goal was or because the node ends."
            raise ScanCancelledError(message) from error
        finally:
            self._runs.discard(run)

    def stop(self) -> None:
        """Cancel all scans. `stopped` is done when they have ended."""
        self._stopping.set()

    def _check(self) -> None:
        for run in list(self._runs):
            if run.job and not run.is_cancelled and (self._stopping.is_set() or run.is_unwanted()):
                run.is_cancelled = True
                try:
                    run.job.cancel()
                except SlrigError as error:
                    self._fault(error)
        if self._stopping.is_set() and not self._runs:
            self.stopped.set_result(None)

    def _fault(self, error: SlrigError) -> str:
        """Message of an error for users of this node."""
        message = f"{error}{_ADVICE.get(error.code, '')}"
        self._node.get_logger().error(message)
        return message

    def publish(self, result: ScanResult) -> None:
        """Publish the poses of the devices, on a robot too where known, their camera models, and the points of each
        camera, stamped with the time at which the scan began. Raises ServiceError.
        """
        calibration = json.loads(self._client.scans.file(result.id, "calibration.json"))
        devices, robot = _devices(calibration), _robot(self._client, (calibration.get("solved") or {}).get("id"))
        seconds = datetime.fromisoformat(result.scan["started_at"]).timestamp()
        messages = Messages(class_of=_class_of, sequence=_sequence, seconds=seconds, world=self._world)
        with self._publishing:
            self._send(TF_STATIC, messages.transforms(devices, robot))
            for name, device in devices.items():
                self._send(topic(name, "camera_info", under="~"), messages.camera_info(name, device))
                if f"points-{name}.npz" in result.files:
                    self._send(topic(name, "points", under="~"), messages.points(result.cloud(name)))

    def _show_live(self, camera: str) -> None:
        """Publish live depth while there are subscribers. On a thread of its own."""
        where = topic(camera, "live", under="~")
        publisher = self._node.create_publisher(_class_of("sensor_msgs/msg/PointCloud2"), where, 1)
        while not self._stopping.is_set():
            self._stopping.wait(_CHECK_S)
            if not publisher.get_subscription_count():
                continue
            try:
                self._client.live.start(camera)
                for frame in self._client.live.watch():
                    if self._stopping.is_set() or not publisher.get_subscription_count():
                        break
                    seconds = self._node.get_clock().now().nanoseconds / 1e9
                    messages = Messages(class_of=_class_of, sequence=_sequence, seconds=seconds, world=self._world)
                    publisher.publish(messages.live_points(camera, frame.points_mm, frame.sigma_mm, frame.grey))
            except SlrigError as error:
                self._fault(error)
                self._stopping.wait(_AGAIN_S)

    def _send(self, where: str, message: Any) -> None:
        if where not in self._publishers:
            from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

            # Latched: scans are rare, and a later subscriber gets the last.
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
        name: Device(*stated["size_px"], *(np.array(stated[each], dtype=np.float64) for each in names))
        for name, stated in found.items()
    }


def _robot(client: Client, calibration: str | None) -> tuple[str, NDArray[np.float64]] | None:
    """The robot's frame with the rig's hand-eye calibration, and the rig's pose in it, (4, 4), mm; None without one.
    calibration : identifier of the scan's, for the frame of the points, if it has one.
    """
    try:
        found = client.hand_eye.get()
    except (NotFoundError, ConflictError):
        return None
    if calibration not in (None, found["calibration"]):
        return None
    frame = found["flange_frame"] if found["kind"] == "in-hand" else found["base_frame"]
    return frame, np.array(found["rig"], dtype=np.float64)


def _class_of(kind: str) -> Any:
    package, sort, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{sort}"), name)
    except ModuleNotFoundError as cause:
        folder = Path(__file__).parent / package
        from_ros = f"apt install ros-$ROS_DISTRO-{package.replace('_', '-')}"
        message = f"{package} is missing: {f'colcon build --paths {folder}' if folder.is_dir() else from_ros}"
        raise ExtraMissingError(message) from cause


def _sequence(numbers: NDArray[Any]) -> array.array[Any]:
    # Anything else is converted number by number in Python, which takes seconds of a cloud.
    found = array.array(numbers.dtype.char)
    found.frombytes(numbers.tobytes())
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM. The key is in SLRIG_API_KEY: everybody may read a node's parameters."""
    try:
        import rclpy
    except ModuleNotFoundError:
        sys.exit(
            "rclpy is missing: the node runs in ROS 2. Run 'source /opt/ros/jazzy/setup.bash' first, and the node with "
            "the Python of that ROS."
        )
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    # With rclpy's own, a goal that is under way would get no result.
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(NODE)
    executor = MultiThreadedExecutor(_THREADS)
    executor.add_node(node)
    try:
        url = node.declare_parameter("url", "").value
        world = node.declare_parameter("world", WORLD).value
        with Client(url or None) as client:
            scans = ScanNode(node, client, world=world, live=node.declare_parameter("live", "").value)

            def stop(number: int, _frame: object) -> None:
                # Once more ends it at once.
                signal.signal(number, signal.SIG_DFL)
                scans.stop()

            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, stop)
            executor.spin_until_future_complete(scans.stopped)
    except SlrigError as error:
        node.get_logger().fatal(str(error))
        return 1
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""A program of ROS 2 beside slrig's node: plain rclpy, which knows nothing of slrig but its action.

Does what a line of JSON says, such as {"goal": "a", "label": "cup"}, and prints a line for each message that comes.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_FOUND_S = 30.0
_LIMIT_S = 300


def fields(message: Any) -> dict[str, Any]:
    return {name: getattr(message, name) for name in message.get_fields_and_field_types()}


def tell(name: str, **told: Any) -> None:
    print(json.dumps({"of": name, **told}), flush=True)  # noqa: T201


def class_of(kind: str) -> Any:
    package, sort, last = kind.split("/")
    return getattr(import_module(f"{package}.{sort}"), last)


class Peer:
    """A method is a command."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("peer")
        self.goals: dict[str, Any] = {}
        scan = class_of("slrig_interfaces/action/Scan")
        self.action, self.asked = ActionClient(self.node, scan, "/slrig/scan"), scan.Goal

    def goal(self, name: str, **goal: Any) -> None:
        assert self.action.wait_for_server(_FOUND_S)

        def accepted(future: Any) -> None:
            self.goals[name] = future.result()
            tell(name, accepted=self.goals[name].accepted)
            self.goals[name].get_result_async().add_done_callback(
                lambda ended: tell(name, ended=ended.result().status, **fields(ended.result().result))
            )

        self.action.send_goal_async(
            self.asked(**goal), feedback_callback=lambda message: tell(name, **fields(message.feedback))
        ).add_done_callback(accepted)

    def cancel(self, name: str) -> None:
        self.goals[name].cancel_goal_async().add_done_callback(
            lambda future: tell(name, cancelling=len(future.result().goals_canceling))
        )

    def call(self, service: str, kind: str, **request: Any) -> None:
        found = class_of(kind)
        client = self.node.create_client(found, service)
        assert client.wait_for_service(_FOUND_S)
        client.call_async(found.Request(**request)).add_done_callback(
            lambda future: tell(service, answer=str(future.result()))
        )

    def read(self, topic: str, kind: str, path: str, *, latched: bool = True) -> None:
        def came(message: Any) -> None:
            Path(path).write_bytes(serialize_message(message))
            tell(topic)

        self.node.create_subscription(class_of(kind), topic, came, LATCHED if latched else 1)


# Ends, so that a test does not wait without end.
signal.alarm(_LIMIT_S)
rclpy.init()
peer = Peer()
spinning = threading.Thread(target=rclpy.spin, args=[peer.node])
spinning.start()
for line in sys.stdin:
    command = json.loads(line)
    getattr(peer, command.pop("do"))(**command)
rclpy.try_shutdown()
spinning.join()

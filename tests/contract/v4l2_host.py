"""A process in which the real V4L2 driver runs, below which umockdev stands: `umockdev-wrapper` must load first.

    umockdev-wrapper python -m tests.contract.v4l2_host ADDRESS

The test talks to the cameras in it through proxies; errors come back as they were raised.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Mapping
from multiprocessing.managers import BaseManager, BaseProxy
from pathlib import Path
from typing import Any, cast

from drivers import v4l2
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, FoundDevice, Trigger
from slrig.model import Frame

AUTHKEY = b"bench"


class HostedCamera:
    """A camera in the host, asked by method calls only."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera

    def ask(self, method: str, *arguments: Any) -> Any:
        return getattr(self._camera, method)(*arguments)

    def tell(self, attribute: str) -> Any:
        return getattr(self._camera, attribute)


class Driver:
    """The driver's entry points. Errors come back as they were only from methods, so these are."""

    def open_camera(self, name: str, options: Mapping[str, object]) -> HostedCamera:
        return HostedCamera(v4l2.open_camera(name, options, Path()))

    def find_devices(self) -> tuple[FoundDevice, ...]:
        return v4l2.find_devices()


class CameraProxy(BaseProxy):
    """Implements `Camera` by asking a hosted one."""

    _exposed_ = ("ask", "tell")

    def _ask(self, method: str, *arguments: Any) -> Any:
        return self._callmethod("ask", (method, *arguments))

    @property
    def info(self) -> CameraInfo:
        return cast("CameraInfo", self._callmethod("tell", ("info",)))

    @property
    def period_ns(self) -> int:
        return cast("int", self._callmethod("tell", ("period_ns",)))

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        return cast("AppliedSettings", self._ask("configure", settings))

    def arm(self, count: int, trigger: Trigger) -> None:
        self._ask("arm", count, trigger)

    def trigger(self) -> None:
        self._ask("trigger")

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        return cast("Frame", self._ask("read", after_ns, timeout_s))

    def disarm(self) -> None:
        self._ask("disarm")

    def close(self) -> None:
        self._ask("close")


class Host(BaseManager):
    """Both ends of the line."""


Host.register("camera", proxytype=CameraProxy, exposed=CameraProxy._exposed_, create_method=False)
Host.register(
    "driver",
    Driver,
    exposed=("open_camera", "find_devices"),
    method_to_typeid={"open_camera": "camera"},
)


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    # The classes that travel must be those of the importable module, not of `__main__`.
    from tests.contract import v4l2_host

    server = v4l2_host.Host(address=sys.argv[1], authkey=AUTHKEY).get_server()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    server.serve_forever()

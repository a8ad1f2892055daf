"""The OpenCV driver on a kernel's fake video device, through OpenCV's own V4L2 code (umockdev).

Three processes: Debian's Python serves the device's requests (`v4l2_server`), this module, run as a program, hosts the
unmodified driver in the test bed, and the test holds the light. `umockdev-wrapper` must load before OpenCV does. Needs
the Debian packages umockdev, gir1.2-umockdev-1.0 and python3-gi.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.managers import BaseManager, BaseProxy
from pathlib import Path
from typing import Any, Self, cast

import pytest

from drivers import opencv
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, Trigger
from slrig.model import Frame
from tests.contract.bench_head import BenchHead
from tests.contract.stage import StagedProjector
from tests.contract.suite import Bench, sequence_for
from tests.contract.v4l2_bench import CAMERA, DEBIAN_PYTHON, PROJECTOR, ROOT, Faked, staged, why_not
from tests.contract.v4l2_sensor import SensorService

AUTHKEY = b"bench"
GREY: dict[str, object] = {"fourcc": "GREY", "size_px": [CAMERA.width_px, CAMERA.height_px], "frame_rate_hz": 50}


# ---- the host


class HostedCamera:
    """A camera in the host, asked by method calls only: from these, errors come back as they were raised."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera

    def ask(self, method: str, *arguments: Any) -> Any:
        return getattr(self._camera, method)(*arguments)

    def tell(self, attribute: str) -> Any:
        return getattr(self._camera, attribute)


class Driver:
    """The driver's entry point."""

    def open_camera(self, name: str, options: Mapping[str, object]) -> HostedCamera:
        return HostedCamera(opencv.open_camera(name, options, Path()))


class CameraProxy(BaseProxy):
    """Implements `Camera` by asking a hosted one."""

    _exposed_ = ("ask", "tell")

    def _ask(self, method: str, *arguments: Any) -> Any:
        return self._callmethod("ask", (method, *arguments))

    @property
    def info(self) -> CameraInfo:
        return cast("CameraInfo", self._callmethod("tell", ("info",)))

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
Host.register("driver", Driver, exposed=("open_camera",), method_to_typeid={"open_camera": "camera"})


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(0)


# ---- the test's side


class UmockdevDevice:
    """A fake video device in a umockdev test bed, and the process beside it that hosts the driver. A context manager.

    Skips the test where umockdev is missing.
    """

    def __init__(self, folder: Path, faked: Faked, code: str = "GREY") -> None:
        if why_not():
            pytest.skip(why_not())
        self.stage = stage = staged(code, noise_dn=1.0)
        self.faults = folder / "faults"
        self.faults.mkdir(exist_ok=True)
        # Socket paths may have 107 characters, and those of test folders have more.
        self._short = tempfile.TemporaryDirectory(prefix="slrig-video-")
        short = Path(self._short.name)
        self.sensor = SensorService(short / "light", stage, readout_s=faked.readout_s, bands=faked.bands)
        config = folder / "device.json"
        config.write_text(json.dumps(faked.config(short / "light", self.faults)))
        self._processes: list[subprocess.Popen[str]] = []
        try:
            server = self._start([str(DEBIAN_PYTHON), "-m", "tests.contract.v4l2_server", str(config)], {})
            address = str(short / "host")
            self._start([sys.executable, "-m", "tests.contract.opencv_umockdev", address], {"UMOCKDEV_DIR": server})
            host = cast("Any", Host(address=address, authkey=AUTHKEY))
            host.connect()
            self._driver = host.driver()
        except BaseException:
            self.close()
            raise
        atexit.register(self.close)

    def open_camera(self, **options: object) -> Camera:
        """Open a camera through the driver, in its host."""
        camera: Camera = self._driver.open_camera("left", {"device": "/dev/video0", **GREY, **options})
        return camera

    def fault(self, name: str, on: bool = True) -> None:
        """Begin or end a fault: unplugged, dead, busy, silent, no bandwidth."""
        if on:
            (self.faults / name).touch()
        else:
            (self.faults / name).unlink(missing_ok=True)

    def controls_set(self) -> dict[str, int]:
        """Every control that was set since the camera was plugged in, and to what last."""
        lines = (self.faults / "controls.txt").read_text().splitlines()
        return {name: int(value) for name, value in (line.split(" = ") for line in lines)}

    def close(self) -> None:
        """Unplug, and end both processes. Idempotent."""
        atexit.unregister(self.close)
        for process in self._processes:
            with suppress(OSError):
                process.communicate(timeout=10)
        if self._processes:
            self._processes.clear()
            self.sensor.close()
            self._short.cleanup()

    def _start(self, command: list[str], environment: Mapping[str, str]) -> str:
        process = subprocess.Popen(  # noqa: S603 - our own programs
            ["umockdev-wrapper", *command],  # noqa: S607 - found by why_not
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={**os.environ, **environment},
        )
        self._processes.append(process)
        assert process.stdout is not None
        words = process.stdout.readline().split(maxsplit=1)
        assert words, f"{command} ended early"
        assert words[0] == "ready"
        return words[1].strip() if len(words) > 1 else ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def bench(folder: Path) -> Bench:
    """A camera of the kernel's, by its stamps."""
    device = UmockdevDevice(folder, Faked())

    def open_head() -> BenchHead:
        return BenchHead({"left": device.open_camera()}, StagedProjector(device.stage))

    return Bench(open_head, sequence_for(PROJECTOR), device.close)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    # The classes that travel must be those of the importable module, not of `__main__`.
    from tests.contract import opencv_umockdev

    server = opencv_umockdev.Host(address=sys.argv[1], authkey=AUTHKEY).get_server()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    server.serve_forever()

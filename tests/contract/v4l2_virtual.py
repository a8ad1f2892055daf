"""The V4L2 driver on a fake kernel in this process, on virtual time: its requests are answered, not sent."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import threading
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self
from unittest import mock

from drivers.v4l2 import kernel, open_camera
from drivers.v4l2.camera import V4L2Camera
from drivers.v4l2.finding import Node
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.contract.v4l2_bench import PROJECTOR, Faked, staged
from tests.contract.v4l2_kernel import MOST_BUFFERS, Device, Refused
from tests.contract.v4l2_sensor import GAIN_UNITS, Sensor
from tests.virtual_clock import VirtualClock

NODE = Path("/dev/video0")
_NEVER = threading.Event()


class _Mapped:
    """A buffer, mapped."""

    def __init__(self, memory: bytearray, offset: int, length: int) -> None:
        self._memory = memoryview(memory)[offset : offset + length]

    def __getitem__(self, part: slice) -> bytes:
        return bytes(self._memory[part])

    def close(self) -> None:
        self._memory.release()


class _Kernel(Device):
    """The kernel's side of the node, with faults that are on or off, and the controls that were set."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.faults: set[str] = set()
        self.controls_set: dict[str, int] = {}

    def told(self, fault: str) -> bool:
        return fault in self.faults

    def was_set(self, control: str, value: int) -> None:
        self.controls_set[control] = value


class VirtualDevice:
    """A fake camera that is plugged in, and the driver before it. A context manager, which closes what was opened."""

    def __init__(self, stage: Stage, faked: Faked) -> None:
        assert isinstance(stage.clock, VirtualClock)
        self.stage, self.clock = stage, stage.clock
        self.sensor = Sensor(
            stage, readout_s=faked.readout_s, bands=faked.bands, noise_when_corrupt=faked.noise_when_corrupt
        )
        config = faked.config(Path(), Path())
        own = config["nodes"]["video0"]
        self.kernel = _Kernel({**config, **own}, self.sensor, self.clock.now_ns)
        self.kernel.memory = bytearray(MOST_BUFFERS * own["most_bytes"])
        self._leaving = ExitStack()

    def open_camera(self, **options: object) -> V4L2Camera:
        camera = open_camera("left", {"device": str(NODE), **options}, Path())
        assert isinstance(camera, V4L2Camera)
        self._leaving.callback(camera.close)
        return camera

    def fault(self, name: str, on: bool = True) -> None:
        """Begin or end a fault: unplugged, dead, busy, silent, no bandwidth."""
        (self.kernel.faults.add if on else self.kernel.faults.discard)(name)

    def __enter__(self) -> Self:
        times = SimpleNamespace(monotonic_ns=self.clock.now_ns)
        for target, stand_in in {
            "kernel.open_node": self._opened,
            "kernel.ask": self._ask,
            "camera.resolved": lambda device: Node(Path(device), device, "Bench camera", "S123"),
            "camera.time": times,
            "stream.time": times,
            "stream.mmap": SimpleNamespace(mmap=self._mapped, MAP_SHARED=0, PROT_READ=0),
            "stream.select": SimpleNamespace(poll=lambda: _Poll(self), POLLIN=select.POLLIN),
        }.items():
            self._leaving.enter_context(mock.patch(f"drivers.v4l2.{target}", stand_in))
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving.close()

    def _opened(self, node: Path) -> int:
        self.path = node
        return os.open(os.devnull, os.O_RDWR)

    def _mapped(self, handle: int, length: int, *_: int, offset: int) -> _Mapped:
        del handle
        return _Mapped(self.kernel.memory, offset, length)

    def _ask(self, handle: int, request: int, argument: Any) -> None:
        if self.path != NODE:
            raise OSError(errno.ENOTTY, "no device of this kind")
        # The value of a long control lies behind a pointer.
        answer = argument.controls[0] if request == kernel.G_EXT_CTRLS else argument
        data = bytearray(answer)
        try:
            wait_until_ns = self.kernel.answer(request, data, handle)
        except Refused as refused:
            raise OSError(refused.number, str(refused)) from refused
        if wait_until_ns is not None:
            raise BlockingIOError(errno.EAGAIN, "no frame yet")
        ctypes.memmove(ctypes.addressof(answer), bytes(data), len(data))


class _Poll:
    """What `select.poll` gives: waits for a frame on the camera's time, or for the driver's own pipe."""

    def __init__(self, device: VirtualDevice) -> None:
        self._device = device
        self._handles: list[int] = []

    def register(self, handle: int, events: int) -> None:
        del events
        self._handles.append(handle)

    def poll(self, timeout_ms: float) -> list[tuple[int, int]]:
        node, waker = self._handles
        device, camera = self._device, self._device.kernel
        until_ns = device.clock.now_ns() + round(timeout_ms * 1e6)
        while not select.select([waker], [], [], 0)[0]:
            now_ns = device.clock.now_ns()
            camera.fill_until(now_ns)
            if camera.filled or not camera.faults.isdisjoint({"dead", "unplugged"}):
                return [(node, select.POLLIN)]
            if now_ns >= until_ns:
                return []
            coming = camera.sensor.coming if camera.streaming else None
            device.clock.wait_until(until_ns if coming is None else min(coming.done_ns, until_ns), _NEVER)
        return [(waker, select.POLLIN)]


def virtually(**stage: Any) -> Stage:
    """The light before a fake camera, on virtual time."""
    return staged(**stage, clock=VirtualClock())


def bench(folder: Path) -> Bench:
    """The driver on a fake webcam that stamps the start of exposure."""
    del folder
    device = VirtualDevice(virtually(noise_dn=1.0), Faked())
    device.__enter__()

    def open_head() -> BenchHead:
        camera = device.open_camera(frame_rate_hz=50, gain_unity=GAIN_UNITS)
        return BenchHead({"left": camera}, StagedProjector(device.stage), clock=device.clock)

    return Bench(open_head, sequence_for(PROJECTOR), device.__exit__)

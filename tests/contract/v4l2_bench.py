"""Fake video devices for the fake kernel (`v4l2_kernel`), the light before them, and the driver in this process."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import shutil
import subprocess
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self
from unittest import mock

from drivers.v4l2 import kernel, open_camera
from drivers.v4l2.camera import V4L2Camera
from drivers.v4l2.finding import CameraNode
from slrig.devices import Clock
from slrig.model import Size
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.contract.v4l2_kernel import MOST_BUFFERS, STAMP_FLAGS, Device, Refused
from tests.contract.v4l2_sensor import BIT_DEPTHS, GAIN_UNITS, Sensor
from tests.unit.capture.fake_rig import Scene
from tests.virtual_clock import VirtualClock

ROOT = Path(__file__).resolve().parents[2]
DEBIAN_PYTHON = Path("/usr/bin/python3")
CAMERA = Size(80, 60)
PROJECTOR = Size(32, 24)
STAMPS = tuple(STAMP_FLAGS)
"""What a fake camera may stamp a frame with."""


@cache
def why_not() -> str:
    """Why the fake device cannot stand here; "" if it can."""
    if shutil.which("umockdev-wrapper") is None:
        return "umockdev is not installed: apt install umockdev gir1.2-umockdev-1.0 python3-gi"
    probe = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    if subprocess.run([DEBIAN_PYTHON, "-c", probe], capture_output=True, check=False).returncode:  # noqa: S603
        return "UMockdev's bindings are not installed: apt install gir1.2-umockdev-1.0 python3-gi"
    return ""


_USB = "/devices/pci0000:00/0000:00:14.0/usb1/1-2"
TREE = (
    f"P: {_USB}\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\nA: idVendor=1234\\n\nA: idProduct=abcd\\n\n"
    # "=00" makes a plain file, which can be mapped; without it, umockdev makes a terminal.
    f"A: serial=S123\\n\n\nP: {_USB}/1-2:1.0/video4linux/video0\nN: video0=00\nE: DEVNAME=/dev/video0\n"
    "E: SUBSYSTEM=video4linux\nA: dev=81:0\\n\nA: index=0\\n\nA: name=Bench camera\\n\n\n"
)
"""The device tree of a USB camera, as umockdev reads it."""


def control(number: int, name: str, minimum: int, maximum: int, default: int, **more: object) -> dict[str, Any]:
    ranges = {"minimum": minimum, "maximum": maximum, "step": 1, "default": default}
    return {"id": number, "name": name, **ranges, **more}


CONTROLS = (
    control(0x00980900, "Brightness", -64, 64, 0),
    control(0x00980901, "Contrast", 0, 64, 32),
    control(0x0098090C, "White Balance, Automatic", 0, 1, 1),
    control(0x00980910, "Gamma", 72, 500, 220),
    control(0x00980913, "Gain", GAIN_UNITS, 8 * GAIN_UNITS, 2 * GAIN_UNITS),
    control(0x00980918, "Power Line Frequency", 0, 2, 1),
    control(0x0098091B, "Sharpness", 0, 6, 3),
    control(0x0098091C, "Backlight Compensation", 0, 2, 1),
    # Aperture priority: the exposure is the device's own until it is told otherwise.
    control(0x009A0901, "Auto Exposure", 0, 3, 3),
    control(0x009A0902, "Exposure Time, Absolute", 1, 400, 156),
    control(0x009A0903, "Exposure, Dynamic Framerate", 0, 1, 1),
    control(0x009A090A, "Focus, Absolute", 0, 250, 0),
    control(0x009A090C, "Focus, Automatic Continuous", 0, 1, 1),
)


@dataclass(frozen=True)
class Faked:
    """A fake camera. Times in seconds; `stamp`, `lost` and their like as in `v4l2_kernel`.

    rates_of : times per frame of one format and size ("YUYV 160 x 120"), in place of `rates`. line_s : what a unit of
    its exposure in lines lasts. first_frame_s : from the start of the stream to its first frame. A control may have
    `kind`, `flags`, `insists_on`, `takes` (the only values that it does not refuse), `stalls` (the requests
    "describe", "get", "set" that it answers with `errno`), and `long`, a 64-bit value. Whatever its driver says, its
    value may be `really_at_most` so much, be the default from the start of the stream until it is set again
    (`forgets_at_start`), and move by up to so many units (`creeps`).
    """

    formats: Mapping[str, list[tuple[int, int]]] = field(
        default_factory=lambda: {"GREY": [(CAMERA.width_px, CAMERA.height_px)]}
    )
    rates: tuple[tuple[int, int], ...] = ((1, 50), (1, 200), (1, 400), (1, 25))
    rates_of: Mapping[str, tuple[tuple[int, int], ...]] = field(default_factory=dict)
    controls: tuple[dict[str, Any], ...] = CONTROLS
    driver: str = "uvcvideo"
    line_s: float = 0.0
    stamp: str = "start"
    readout_s: float = 0.0
    rolling: bool = False
    sharp_at: int = 0
    jitter_s: float = 0.0
    lost: float = 0.0
    corrupt: float = 0.0
    flags_corrupt: bool = True
    noise_when_corrupt: bool = True
    tells_rate: bool = True
    stretches: bool = True
    padding_bytes: int = 0
    first_frame_s: float = 0.0
    seed: int = 0
    nodes: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: {"video0": {}})

    def config(self, light: Path, faults: Path) -> dict[str, Any]:
        keys = (
            *("rates_of", "driver", "line_s"),
            *("formats", "rates", "controls", "stamp", "readout_s", "jitter_s", "lost", "corrupt"),
            *("flags_corrupt", "tells_rate", "stretches", "padding_bytes", "seed", "first_frame_s"),
        )
        most = max(width * height for sizes in self.formats.values() for width, height in sizes)
        usual = {"card": "Bench camera", "bus": "usb-0000:00:14.0-2", "capabilities": 0x04200001}
        room = {"most_bytes": 2 * most + 3 * 4096}
        return {
            **{key: getattr(self, key) for key in keys},
            "tree": TREE,
            "light": str(light),
            "faults": str(faults),
            "nodes": {name: {**usual, **room, **own} for name, own in self.nodes.items()},
        }


def staged(code: str = "GREY", *, noise_dn: float = 0.0, clock: Clock | None = None) -> Stage:
    """The light before a fake camera of this pixel format."""
    scene = Scene(
        camera=CAMERA,
        bit_depth=BIT_DEPTHS[code],
        projector=PROJECTOR,
        first_column_px=1.0,
        columns_per_px=0.33,
        rows_per_px=0.33,
        blur_px=0.7,
        noise_dn=noise_dn,
    )
    return Stage(scene, latency_s=0.002, clock=clock)


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

    def has_fault(self, fault: str) -> bool:
        return fault in self.faults

    def was_set(self, control: str, value: int) -> None:
        self.controls_set[control] = value


class VirtualDevice:
    """A fake camera that is plugged in, and the driver before it. A context manager, which closes what was opened."""

    def __init__(self, stage: Stage, faked: Faked) -> None:
        self.stage, self.clock = stage, stage.clock
        self.sensor = Sensor(
            stage,
            readout_s=faked.readout_s,
            rolling=faked.rolling,
            sharp_at=faked.sharp_at,
            noise_when_corrupt=faked.noise_when_corrupt,
        )
        config = faked.config(Path(), Path())
        own = config["nodes"]["video0"]
        self.kernel = _Kernel({**config, **own}, self.sensor, self.clock.now_ns)
        self.kernel.memory = bytearray(MOST_BUFFERS * own["most_bytes"])
        self._leaving = ExitStack()

    def open_camera(self, **options: object) -> V4L2Camera:
        names = {each["name"] for each in self.kernel.config["controls"]}
        lens = {"focus": 0} if "Focus, Absolute" in names else {}
        camera = open_camera("left", {"device": str(NODE), **lens, **options}, Path())
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
            "kernel.ioctl": self._ask,
            "camera.resolve_node": lambda device: CameraNode(Path(device), device, "Bench camera", "S123"),
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

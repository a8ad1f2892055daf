"""The screen driver on Xorg's dummy outputs, as a bench, and a camera that photographs an output's pixels."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import screen
from drivers.screen.guard import release_guard
from slrig.devices import CameraSettings, SystemClock, Trigger
from slrig.model import Frame, PatternSequence, Pixels, Size
from tests.contract.screen_server import DummyServer, OutputPixels
from tests.contract.stage import Stage
from tests.contract.suite import Bench, BenchHead, whole_scan
from tests.contract.wired_camera import Exposure, WiredCamera
from tests.unit.capture.fake_rig import Scene

PROJECTOR = Size(96, 72)
CAMERA = Size(120, 90)
REFERENCE_EXPOSURE_S = 0.01


def photographed(pixels: Pixels, scene: Scene, *, exposure_s: float, gain: float) -> NDArray[np.float64]:
    """What a sensor reads while these pixels are shown, DN without noise; `scene` tells which pixel it sees where."""
    sharp = pixels.astype(np.float32) / 255
    light = cv2.GaussianBlur(sharp, (0, 0), scene.blur_px, borderType=cv2.BORDER_REPLICATE)
    columns, rows = (np.asarray(at, np.float32) for at in np.broadcast_arrays(scene.column_px, scene.row_px))
    seen = cv2.remap(light, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    level = scene.albedo * (scene.ambient + scene.white * np.asarray(seen, np.float64))
    return np.asarray(scene.format.full_scale * level * gain * exposure_s / REFERENCE_EXPOSURE_S)


class ShownPixels(Protocol):
    """What an output shows now."""

    def grey(self) -> Pixels:
        """(H, W) uint8."""
        ...

    def close(self) -> None: ...


class ScreenCamera(WiredCamera):
    """A camera without a wire that photographs an output: software trigger, global shutter.

    It looks again and again during an exposure: if the picture changes meanwhile, its frame is a mixture.
    """

    LOOKS = 6

    def __init__(self, name: str, pixels: ShownPixels, scene: Scene) -> None:
        exposures_s, gains = (0.002, 0.1), (1.0, 8.0)
        super().__init__(name, Stage(scene), usual_s=REFERENCE_EXPOSURE_S, exposures_s=exposures_s, gains=gains)
        self.info = replace(self.info, triggers=frozenset({Trigger.SOFTWARE}))
        self._pixels, self._scene = pixels, scene
        self._rng = np.random.default_rng(0)
        self._never = threading.Event()
        self._sensor = ThreadPoolExecutor(1)
        self._seen: dict[int, Future[tuple[NDArray[np.float64], int]]] = {}

    def close(self) -> None:
        super().close()
        self._sensor.shutdown()
        self._pixels.close()

    def _expose(self, begun_ns: int) -> None:
        number = self._number
        super()._expose(begun_ns)
        if self._number > number:
            self._seen[number] = self._sensor.submit(self._looked, begun_ns, self._settings)

    def _looked(self, begun_ns: int, settings: CameraSettings) -> tuple[NDArray[np.float64], int]:
        """What the sensor reads, and how long after its exposure the last look was, ns."""
        read, exposure_ns = np.zeros(self._scene.format.size.shape), round(settings.exposure_s * 1e9)
        SystemClock().wait_until(begun_ns, self._never)
        for look in range(self.LOOKS):
            part_s = settings.exposure_s / self.LOOKS
            read += photographed(self._pixels.grey(), self._scene, exposure_s=part_s, gain=settings.gain)
            SystemClock().wait_until(begun_ns + exposure_ns * (look + 1) // self.LOOKS, self._never)
        return read, max(time.monotonic_ns() - begun_ns - exposure_ns, 0)

    def _frame(self, exposure: Exposure) -> Frame:
        read, late_ns = self._seen.pop(exposure.number).result()
        read += self._scene.noise_dn * self._rng.standard_normal(read.shape)
        image = np.clip(np.rint(read), 0, self._scene.format.full_scale).astype(np.uint8)
        return replace(super()._frame(exposure), image=image, t_err_ns=late_ns)


def scene() -> Scene:
    return Scene(camera=CAMERA, projector=PROJECTOR, noise_dn=1.0)


def sequence(size: Size = PROJECTOR) -> PatternSequence:
    return whole_scan(size, period_px=8, line_width_px=1, rows=True)


def rig_options(output: str, size: Size, **options: object) -> dict[str, object]:
    """A `[projector]` table for a dummy output, whose light is there as soon as its pixels are."""
    exact = {"latency_s": 0.0, "latency_error_s": 0.0, "dark_after_s": 0.0}
    return {"output": output, "native_px": [size.width_px, size.height_px], **exact, **options}


def bench_on(server: DummyServer, output: str, *, backend: str) -> Bench:
    """The driver on one of a server's two outputs, the right one; the left one is the desktop's."""
    places = server.arrange(**dict.fromkeys(("DUMMY0", "DUMMY1"), PROJECTOR))

    def open_head() -> BenchHead:
        options = rig_options(output, PROJECTOR, backend=backend)
        projector = screen.open_projector(options, Path())
        pixels = OutputPixels(server.display, places[output], PROJECTOR)
        return BenchHead({"eye": ScreenCamera("eye", pixels, scene())}, projector)

    return Bench(open_head, sequence())


def let_go(*outputs: str) -> None:
    """End the guards that this process has set on outputs of the environment's server."""
    for output in outputs:
        with suppress(OSError):
            release_guard(None, output)

"""The screen driver on Xorg's dummy outputs, as a bench, and a camera that photographs an output's pixels."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import screen
from drivers.screen import guarding
from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import Frame, PatternSequence, Pixels, Size
from slrig.patterns.sequence import encode, scan_patterns
from tests.contract.bench_head import BenchHead
from tests.contract.screen_server import DummyServer, OutputPixels
from tests.contract.suite import Bench
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


class ScreenCamera:
    """Implements `slrig.devices.Camera` by photographing an output: software trigger, global shutter.

    It looks again and again during an exposure: if the picture changes meanwhile, its frame is a mixture.
    """

    LOOKS = 6

    def __init__(self, name: str, pixels: ShownPixels, scene: Scene) -> None:
        self._pixels, self._scene = pixels, scene
        self._rng = np.random.default_rng(0)
        triggers = frozenset({Trigger.SOFTWARE})
        self._info = CameraInfo(name, "screen camera", "1", scene.format, triggers, (0.002, 0.1), (1.0, 8.0))
        self._settings = CameraSettings(REFERENCE_EXPOSURE_S)
        self._changed = threading.Condition()
        self._triggers: list[CameraSettings] = []
        self._frames: list[Frame] = []
        self._state, self._count, self._turn = CameraState(name), 0, 0
        self._never = threading.Event()
        self._thread = threading.Thread(target=self._expose_all, name=f"camera {name}", daemon=True)
        self._thread.start()

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`."""
        with self._changed:
            self._state.check_settings(settings, self._info)
            self._settings = settings
            return AppliedSettings(settings.exposure_s, settings.gain)

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`."""
        with self._changed:
            self._state.check_arming(count, trigger, self._info)
            self._state.armed = trigger
            self._turn += 1

    def trigger(self) -> None:
        """See `Camera`."""
        with self._changed:
            self._state.require_armed()
            self._triggers.append(self._settings)
            self._changed.notify_all()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`."""
        until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        with self._changed:
            self._state.require_armed()
            while True:
                while self._frames:
                    frame = self._frames.pop(0)
                    if frame.t_start_ns >= after_ns:
                        return frame
                left_s = (until_ns - time.monotonic_ns()) / 1e9
                if left_s <= 0 or not self._changed.wait(left_s):
                    message = f"no frame that begins after {after_ns} ns came in {timeout_s} s; trigger one"
                    raise FrameTimeoutError(message)
                self._state.require_armed()

    def disarm(self) -> None:
        """See `Camera`."""
        with self._changed:
            self._state.armed = None
            self._triggers.clear()
            self._frames.clear()
            self._changed.notify_all()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        with self._changed:
            self._state.close()
            self._changed.notify_all()
        self._thread.join(10)
        self._pixels.close()

    def _expose_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._triggers or self._state.closed.is_set())
                if self._state.closed.is_set():
                    return
                settings, turn = self._triggers.pop(0), self._turn
            frame = self._exposed(settings)
            with self._changed:
                if self._state.armed and turn == self._turn:
                    self._frames.append(frame)
                    self._changed.notify_all()

    def _exposed(self, settings: CameraSettings) -> Frame:
        start_ns = time.monotonic_ns()
        exposure_ns = round(settings.exposure_s * 1e9)
        form, read = self._scene.format, np.zeros(self._scene.format.size.shape)
        for look in range(self.LOOKS):
            part = photographed(
                self._pixels.grey(), self._scene, exposure_s=settings.exposure_s / self.LOOKS, gain=settings.gain
            )
            read += part
            left_ns = start_ns + exposure_ns * (look + 1) // self.LOOKS - time.monotonic_ns()
            self._never.wait(max(left_ns, 0) / 1e9)
        end_ns = time.monotonic_ns()
        read += self._scene.noise_dn * self._rng.standard_normal(read.shape)
        image = np.clip(np.rint(read), 0, form.full_scale).astype(np.uint8)
        self._count += 1
        return Frame(
            self._info.name,
            image,
            start_ns,
            start_ns + exposure_ns,
            max(end_ns - start_ns - exposure_ns, 0),
            self._count,
            0,
            settings.exposure_s,
            settings.gain,
        )


def scene() -> Scene:
    return Scene(camera=CAMERA, projector=PROJECTOR, noise_dn=1.0)


def sequence(size: Size = PROJECTOR) -> PatternSequence:
    patterns = scan_patterns(
        size, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=True
    )
    return encode(patterns, size)


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
            guarding.release(None, output)

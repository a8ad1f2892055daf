"""picamera2 without a Raspberry Pi: the calls that the driver makes, as version 0.3.38 answers them, before a stage."""

from __future__ import annotations

import sys
import threading
import types
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from drivers.picamera2 import PiCamera, PiCameraOptions
from tests.contract.stage import Stage

BUFFERS = 6
_NEVER = threading.Event()
LINE_US = 20
LEAST_LINES = 4
BLANK_US = 600
CONTROLS: Mapping[str, tuple[object, object, object]] = {
    "AeEnable": (False, True, True),
    "AwbEnable": (False, True, True),
    "AnalogueGain": (1.0, 16.0, 1.0),
    "Contrast": (0.0, 32.0, 1.0),
    "ExposureTime": (0, 66_666, 20_000),
    "FrameDurationLimits": (8_333, 120_000, 33_333),
    "NoiseReductionMode": (0, 4, 0),
    "Sharpness": (0.0, 16.0, 1.0),
}


@dataclass
class Pi:
    """A Raspberry Pi with one camera: what it sees, what is wrong with it, and what was asked of it."""

    stage: Stage
    identity: str = "/base/axi/pcie@120000/rp1/i2c@88000/ov9281@60"
    model: str = "ov9281"
    raw_format: str = "R10"
    controls: dict[str, tuple[Any, Any, Any]] = field(default_factory=lambda: dict(CONTROLS))
    held_elsewhere: bool = False
    lost: float = 0.0
    damaged: float = 0.0
    stamp_offset_ns: int = 0
    stamps_start: bool = False
    frozen: bool = False
    gives: dict[str, Any] = field(default_factory=dict)
    asked: dict[str, Any] = field(default_factory=dict)
    exposures: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=10_000))
    held: int = 0
    pulses: deque[tuple[int, int]] | None = None
    """Exposures by XTR that are still to come: begin and end. None for a sensor that runs freely."""
    look: Callable[[], object] = lambda: None
    """Called before it looks for pulses."""

    @contextmanager
    def connected(self) -> Iterator[None]:
        library = types.SimpleNamespace(Picamera2=self._library())
        with mock.patch.dict(sys.modules, {"picamera2": library}):
            yield

    def opened(self, **options: object) -> PiCamera:
        with self.connected():
            table = PiCameraOptions.model_validate({"device": self.identity, **options})
            return PiCamera("left", table, clock=self.stage.clock)

    def _library(self) -> type:
        pi = self

        class Library(FakePicamera2):
            def __init__(self, camera_num: int = 0) -> None:
                super().__init__(pi, camera_num)

            @staticmethod
            def global_camera_info() -> list[dict[str, Any]]:
                return [{"Id": pi.identity, "Model": pi.model, "Num": 0, "Location": 2, "Rotation": 0}]

        return Library


class Job:
    """What `capture_request` gives that does not wait."""

    request: FakeRequest | None = None


class FakeRequest:
    """A `CompletedRequest`."""

    def __init__(self, camera: FakePicamera2, data: NDArray[np.uint8], metadata: dict[str, Any]) -> None:
        self._camera, self._data, self._metadata = camera, data, metadata
        self._released = False

    def get_metadata(self) -> dict[str, Any]:
        return dict(self._metadata)

    def make_buffer(self, name: str) -> NDArray[np.uint8]:
        assert not self._released
        assert name == self._camera.read_stream
        return self._data.copy()

    def release(self) -> None:
        assert not self._released
        self._released = True
        # The memory is the camera's again.
        self._data[:] = 0xAA
        self._camera.pi.held -= 1


class FakePicamera2:
    """A `Picamera2`."""

    def __init__(self, pi: Pi, camera_num: int) -> None:
        assert camera_num == 0
        if pi.held_elsewhere:
            message = "Camera __init__ sequence did not complete."
            raise RuntimeError(message) from RuntimeError("Failed to acquire camera: Device or resource busy")
        self.pi = pi
        self._clock = pi.stage.clock
        self._config: dict[str, Any] = {}
        self._pending: dict[str, Any] = {}
        self._jobs: deque[Job] = deque()
        self._buffers = BUFFERS
        self._kept: FakeRequest | None = None
        self._running = False
        self._rng = np.random.default_rng(5)
        self.read_stream = ""
        self.is_open = True

    @property
    def camera_controls(self) -> dict[str, tuple[Any, Any, Any]]:
        return self.pi.controls

    @property
    def sensor_modes(self) -> list[dict[str, Any]]:
        size = self.pi.stage.format.size
        modes = [(size.width_px, size.height_px), (size.width_px // 2, size.height_px // 2)]
        return [{"size": mode, "unpacked": self.pi.raw_format, "bit_depth": 10, "fps": 120.0} for mode in modes]

    def create_video_configuration(self, **table: Any) -> dict[str, Any]:
        self._buffers = table.get("buffer_count", BUFFERS)
        config: dict[str, Any] = {
            "main": {"format": "XBGR8888", "size": (1280, 720)},
            "raw": {"format": self.pi.raw_format},
        }
        for stream in ("main", "raw"):
            config[stream] |= table.get(stream, {})
        return {
            **config,
            "controls": {"NoiseReductionMode": 1, "FrameDurationLimits": (33_333, 33_333)} | table["controls"],
        }

    def configure(self, config: dict[str, Any]) -> None:
        assert not self._running
        self._config = config
        self.read_stream = "main" if config["main"]["format"] == "YUV420" else "raw"
        stream = config[self.read_stream]
        stream |= self.pi.gives
        deep = 1 if stream["format"].endswith(("8", "YUV420")) else 2
        # Rows end where a transfer of 32 bytes does.
        stream["stride"] = -(-stream["size"][0] * deep // 32) * 32
        self._pending |= config["controls"]

    def camera_configuration(self) -> dict[str, Any]:
        return self._config

    def set_controls(self, controls: dict[str, Any]) -> None:
        unknown = set(controls) - set(self.pi.controls)
        if unknown:
            message = f"Control {unknown} is not advertised by libcamera"
            raise RuntimeError(message)
        self._pending |= controls

    def start(self) -> None:
        assert not self._running
        self.pi.asked |= self._pending
        asked = self.pi.asked
        self._exposure_us = max(round(asked["ExposureTime"] / LINE_US), LEAST_LINES) * LINE_US
        self._gain = round(asked["AnalogueGain"] * 16) / 16
        least_us, most_us = asked["FrameDurationLimits"]
        self._duration_us = min(max(least_us, self._exposure_us + BLANK_US), most_us)
        self._next_ns = self._clock.now_ns()
        self._running = True

    def stop(self) -> None:
        assert not self._jobs, "stop waits for the jobs before it"
        self._running = False
        self._keep(None)

    def close(self) -> None:
        self.stop()
        self.is_open = False

    def capture_request(self, wait: bool | None = None) -> Job:
        assert wait is False
        job = Job()
        self._jobs.append(job)
        self._run()
        return job

    def wait(self, job: Job, timeout: float) -> FakeRequest:
        until_ns = self._clock.now_ns() + round(timeout * 1e9)
        while job.request is None and self._clock.now_ns() < until_ns:
            # Nobody knows when pulses come.
            end_ns = self._clock.now_ns() + 1_000_000 if self.pi.pulses is not None else self._next()[1]
            self._clock.wait_until(until_ns if self.pi.frozen else min(end_ns, until_ns), _NEVER)
            self._run()
        if job.request is None:
            raise TimeoutError
        return job.request

    def cancel_all_and_flush(self) -> None:
        self._jobs.clear()

    def _keep(self, request: FakeRequest | None) -> None:
        if self._kept is not None:
            self._kept.release()
        self._kept = request

    def _next(self) -> tuple[int, int]:
        """When the next exposure begins and ends."""
        if self.pi.pulses is None:
            return self._next_ns, self._next_ns + self._exposure_us * 1000
        self.pi.look()
        return self.pi.pulses[0] if self.pi.pulses else (0, sys.maxsize)

    def _run(self) -> None:
        """Make the frames that have ended by now, each for the job that has waited longest; else the last is kept."""
        while not self.pi.frozen and self._next()[1] <= self._clock.now_ns():
            start_ns, end_ns = self._next()
            if self.pi.pulses is None:
                self._next_ns += self._duration_us * 1000
            else:
                self.pi.pulses.popleft()
            self.pi.exposures.append((start_ns, end_ns))
            if self._rng.random() < self.pi.lost + self.pi.damaged or self.pi.held >= self._buffers:
                continue
            metadata = {
                "SensorTimestamp": (start_ns if self.pi.stamps_start else end_ns) + self.pi.stamp_offset_ns,
                "ExposureTime": self._exposure_us,
                "AnalogueGain": self._gain,
                "FrameDuration": self._duration_us,
            }
            self.pi.held += 1
            self._keep(FakeRequest(self, self._seen(start_ns, end_ns, self._gain), metadata))
            self._serve()
        self._serve()

    def _serve(self) -> None:
        if self._jobs and self._kept is not None:
            self._jobs.popleft().request, self._kept = self._kept, None

    def _seen(self, start_ns: int, end_ns: int, gain: float) -> NDArray[np.uint8]:
        stream = self._config[self.read_stream]
        width, height = stream["size"]
        image = self.pi.stage.exposed(start_ns, end_ns, gain=gain)[:height, :width]
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(height, -1)
        padded = np.full((height, stream["stride"]), 0x55, np.uint8)
        padded[:, : rows.shape[1]] = rows
        colours = height * stream["stride"] // 2 if stream["format"] == "YUV420" else 0
        return np.concatenate([padded.ravel(), np.full(colours, 128, np.uint8)])

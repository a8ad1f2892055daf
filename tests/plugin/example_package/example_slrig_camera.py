"""A camera that looks at a test chart: a slrig driver of one module, which needs no hardware and leaves nothing out.

`ChartSensor` stands where a vendor's library stands: it exposes by itself, keeps its last frames in four buffers,
stamps them when their exposure ends, and knows nothing of slrig. `ChartCamera` is the driver. `open_camera` and
`find_devices` are what the package's entry points name.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, CameraState, FoundDevice, Trigger
from slrig.errors import (
    DeviceBusyError,
    DeviceGoneError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import CameraFormat, Frame, Pixels, Size

CHARTS = {"chart-0": "soft squares", "chart-1": "soft stripes"}
EXPOSURE_RANGE_S = (0.0005, 0.1)
GAIN_RANGE = (1.0, 4.0)
BIT_DEPTH = 8

_BUFFERS = 4
_TICK_S = 1e-5
_READ_OUT_NS = 1_000_000
_STAMP_ERROR_NS = 20_000
_FULL_SCALE_S = 1 / 40
_AS_ASKED = 0.01
_BLUR_PX = 0.6


class Options(BaseModel):
    """The keys of a `[[camera]]` table that belong to this driver."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    device: str = Field(default="chart-0", description="A chart.")
    size_px: tuple[int, int] = Field(default=(320, 240), description="[width, height].")
    light: str | None = Field(
        default=None,
        description="A file, from the rig file's folder, that says what lights the chart since when; else there is the "
        "room's light only.",
    )
    speed_px_s: float = Field(default=0.0, description="How fast the chart moves to the right.")


@dataclass(frozen=True, slots=True)
class Buffer:
    """What the sensor gives: a frame's number since it was started, when its exposure ended (CLOCK_MONOTONIC), and
    the samples, (H, W) uint8.
    """

    number: int
    end_ns: int
    image: Pixels


class Lamp:
    """What lights the chart: lines of JSON that somebody appends to a file, `{"t_ns": …, "rows": [[…], …]}`.

    From `t_ns` (CLOCK_MONOTONIC) on, the chart is lit by these rows of 8-bit samples, spread over all of it.
    """

    def __init__(self, path: Path, size: Size) -> None:
        self._path, self._size = path, size
        self._read_bytes = 0
        self._changes: list[tuple[int, NDArray[np.float64]]] = [(0, np.zeros((1, 1)))]

    def light(self, start_ns: int, end_ns: int) -> NDArray[np.float64]:
        """(H, W) float64, 0 to 1: the mean light on each pixel from one instant to another that has passed."""
        self._look()
        total = np.zeros(self._size.shape)
        for index, (from_ns, seen) in enumerate(self._changes):
            until_ns = self._changes[index + 1][0] if index + 1 < len(self._changes) else end_ns
            total += seen * max(0, min(until_ns, end_ns) - max(from_ns, start_ns)) / (end_ns - start_ns)
        # What ended before this exposure began is over for those that follow as well.
        while len(self._changes) > 1 and self._changes[1][0] <= start_ns:
            del self._changes[0]
        return total

    def _look(self) -> None:
        with self._path.open("rb") as file:
            file.seek(self._read_bytes)
            lines = file.read().split(b"\n")
        # The last line is empty, or still being written.
        for line in lines[:-1]:
            self._read_bytes += len(line) + 1
            change = json.loads(line)
            self._changes.append((change["t_ns"], _spread(np.asarray(change["rows"], np.float64) / 255, self._size)))


class ChartSensor:
    """A free-running sensor before a chart, as a library for it would present it."""

    def __init__(self, chart: str, size: Size, lamp: Lamp | None, speed_px_s: float) -> None:
        self._size, self._lamp, self._speed_px_s = size, lamp, speed_px_s
        y, x = np.mgrid[: size.height_px, : size.width_px]
        across = np.sin(y / 23) if chart == "chart-0" else 1.0
        self._albedo = 0.75 + 0.2 * np.sin(x / 31) * across
        self._noise = np.random.default_rng()
        self._stopped = threading.Event()
        self._stopped.set()
        self.exposure_s, self.gain = 0.01, 1.0
        self._begun_ns, self._next = 0, 0

    def set(self, exposure_s: float, gain: float) -> None:
        """Set what the next start uses. The sensor counts exposures in ticks of 10 µs, and the gain in eighths."""
        self.exposure_s = max(round(exposure_s / _TICK_S), 1) * _TICK_S
        self.gain = round(gain * 8) / 8

    def start(self) -> None:
        """Begin to expose, back to back."""
        self._begun_ns, self._next = time.monotonic_ns(), 0
        self._stopped.clear()

    def stop(self) -> None:
        """Stop exposing, and give up on `wait`. From any thread, and any number of times."""
        self._stopped.set()

    def wait(self, timeout_s: float) -> Buffer | None:
        """The next frame: the oldest in the buffers, else the one being exposed. None if none comes in time."""
        exposure_ns = round(self.exposure_s * 1e9)
        period_ns = exposure_ns + _READ_OUT_NS
        now_ns = time.monotonic_ns()
        give_up_ns = now_ns + round(timeout_s * 1e9)
        number = max(self._next, (now_ns - self._begun_ns) // period_ns - _BUFFERS)
        there_ns = self._begun_ns + (number + 1) * period_ns
        while (left_ns := min(there_ns, give_up_ns) - time.monotonic_ns()) > 0:
            if self._stopped.wait(left_ns / 1e9):
                break
        if self._stopped.is_set() or there_ns > give_up_ns:
            return None
        self._next = number + 1
        end_ns = there_ns - _READ_OUT_NS
        return Buffer(number, end_ns, self._exposed(end_ns - exposure_ns, end_ns))

    def _exposed(self, start_ns: int, end_ns: int) -> Pixels:
        light = 0.02 + (0.0 if self._lamp is None else self._lamp.light(start_ns, end_ns))
        albedo = np.roll(self._albedo, round(self._speed_px_s * start_ns / 1e9), axis=1)
        level = albedo * light * self.gain * (end_ns - start_ns) / 1e9 / _FULL_SCALE_S
        samples = 255 * level + self._noise.standard_normal(level.shape)
        image: Pixels = np.clip(np.rint(samples), 0, 255).astype(np.uint8)
        return image


class ChartCamera:
    """Implements `slrig.devices.Camera`."""

    def __init__(self, name: str, device: str, sensor: ChartSensor, size: Size) -> None:
        self._info = CameraInfo(
            name=name,
            model="test chart camera",
            serial=device,
            format=CameraFormat(size, BIT_DEPTH),
            triggers=frozenset({Trigger.FREE}),
            exposure_range_s=EXPOSURE_RANGE_S,
            gain_range=GAIN_RANGE,
        )
        self._sensor = sensor
        self._applied = AppliedSettings(sensor.exposure_s, sensor.gain)
        self._state = CameraState(name)
        self._last, self._dropped = -1, 0

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. What is returned was read back; where it is not what was asked, within 1 %, it is refused."""
        self._state.check_settings(settings, self._info)
        self._sensor.set(settings.exposure_s, settings.gain)
        taken = ((settings.exposure_s, self._sensor.exposure_s), (settings.gain, self._sensor.gain))
        for asked, got in taken:
            if abs(got - asked) > _AS_ASKED * asked:
                before = self._applied
                self._sensor.set(before.exposure_s, before.gain)
                message = f"camera '{self._info.name}': asked {asked:g}, it gives {got:g}; write that into the rig file"
                raise UnsupportedByDeviceError(message)
        self._applied = AppliedSettings(self._sensor.exposure_s, self._sensor.gain)
        return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. The sensor starts afresh: its buffers hold nothing from before."""
        self._state.check_arming(count, trigger, self._info)
        self._last, self._dropped = -1, 0
        self._sensor.start()
        self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. There is nothing to trigger."""
        self._state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`."""
        self._state.require_armed()
        exposure_s = self._applied.exposure_s
        give_up_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while (left_ns := give_up_ns - time.monotonic_ns()) > 0:
            buffer = self._sensor.wait(left_ns / 1e9)
            if buffer is None:
                break
            # Numbers that are missing are frames that nobody fetched in time: lost.
            self._dropped += buffer.number - self._last - 1
            self._last = buffer.number
            # The stamp is that of the end, and not exact: the exposure may have begun a little earlier.
            start_ns = buffer.end_ns - round(exposure_s * 1e9)
            if start_ns - _STAMP_ERROR_NS >= after_ns:
                return Frame(
                    camera=self._info.name,
                    image=buffer.image,
                    t_start_ns=start_ns,
                    t_end_ns=buffer.end_ns,
                    t_err_ns=_STAMP_ERROR_NS,
                    sequence_number=buffer.number,
                    dropped_count=self._dropped,
                    exposure_s=exposure_s,
                    gain=self._applied.gain,
                )
        # Another thread may have closed the camera while this one waited.
        self._state.require_armed()
        message = (
            f"camera '{self._info.name}': no frame that began after {after_ns} ns came within {timeout_s:g} s "
            f"(exposure {exposure_s:g} s, last frame number {self._last}); wait longer, or look at the camera"
        )
        raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        self._sensor.stop()
        self._state.armed = None

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        if self._state.close():
            _held.discard(self._info.serial)


_held: set[str] = set()
"""Charts that a camera looks at: each lets one camera do so at a time."""


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open the camera of a chart. slrig makes one ConfigError of all faults that the model finds in the options.

    Raises
    ------
    DeviceGoneError
        There is no such chart, or nothing lights it.
    DeviceBusyError
        Another camera looks at it.
    """
    table = Options.model_validate(dict(options))
    if table.device not in CHARTS:
        message = f"camera '{name}': there is no '{table.device}'; found {', '.join(CHARTS)}; correct device"
        raise DeviceGoneError(message)
    size = Size(*table.size_px)
    lamp = None
    if table.light is not None:
        path = folder / table.light
        if not path.is_file():
            message = f"camera '{name}': {path} is not there; open the projector that writes it first"
            raise DeviceGoneError(message)
        lamp = Lamp(path, size)
    if table.device in _held:
        message = f"camera '{name}': another camera looks at '{table.device}'; close it first"
        raise DeviceBusyError(message)
    _held.add(table.device)
    return ChartCamera(name, table.device, ChartSensor(table.device, size, lamp, table.speed_px_s), size)


def find_devices() -> tuple[FoundDevice, ...]:
    """Every chart. A finder opens nothing, and takes no longer than it must."""
    return tuple(FoundDevice("example_chart", device, f"test chart, {label}") for device, label in CHARTS.items())


def _spread(rows: NDArray[np.float64], size: Size) -> NDArray[np.float64]:
    """Rows of light as a lens throws them on an extent: stretched, and a little out of focus."""
    spread: NDArray[np.float64] = _lens(size.height_px, rows.shape[0]) @ rows @ _lens(size.width_px, rows.shape[1]).T
    return spread


def _lens(extent_px: int, count: int) -> NDArray[np.float64]:
    """(extent_px, count) float64: how much each pixel of the sensor sees of each of the lamp's."""
    # Pixel p of the sensor's looks at (p + ½) count / extent − ½ of the lamp's.
    at = (np.arange(extent_px) + 0.5) * count / extent_px - 0.5
    share = np.exp(-0.5 * ((at[:, np.newaxis] - np.arange(count)) / _BLUR_PX) ** 2)
    seen: NDArray[np.float64] = share / share.sum(axis=1, keepdims=True)
    return seen

"""A Raspberry Pi's camera through picamera2.

A free-running sensor is read until a frame comes whose exposure began late enough. One that is triggered by wire (XTR
of an IMX296) exposes for as long as the pulse lasts, so its frames state the exposure that was requested, and all of
them are kept. Settings are written while it is
stopped: then the first frame has them. Each frame's metadata contain its exposure, its gain and the time from the frame
before; a longer time between two stamps means that frames were lost or not fetched.
"""

from __future__ import annotations

import importlib
import math
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import TimeoutError as JobTimeoutError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.libraries import loading
from drivers.v4l2.formats import PixelLayout, SamplePacking, colour_image, grey_image
from slrig.bundle import Strict, validate
from slrig.devices import (
    AppliedSettings,
    Camera,
    CameraInfo,
    CameraSettings,
    CameraState,
    Clock,
    FoundDevice,
    SystemClock,
    Trigger,
)
from slrig.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import CameraFormat, Frame, Pixels, Size

PixelExtent = Annotated[int, Field(ge=16, le=16384)]


class PiCameraOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "picamera2"` (in addition to name, exposure_s and gain)."""

    device: Annotated[str, Field(min_length=1)]
    """The camera's id, as `slrig devices` lists it."""

    pixels: Literal["raw", "luma"] = "raw"
    """The sensor's own samples, which are proportional to light, or the luma that the image processor makes of them,
    with its gamma."""

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)] | None = None
    """[width, height] of one of the sensor's modes; else its largest."""

    focus_dioptres: Annotated[float, Field(ge=0, le=32)] | None = None
    """Focus of a motorised lens, 1/m: 2 is half a metre away. Required for a camera with such a lens."""

    global_shutter: bool = False
    """True if the sensor exposes all rows together (IMX296, OV9281), which libcamera does not report."""

    external_trigger: bool = False
    """Each pulse of a trigger box on XTR is one exposure, as long as the pulse (IMX296, the global-shutter camera)."""

    time_stamp: Literal["readout", "exposure"] = "readout"
    """Meaning of a time stamp: the start of the first row's readout, which is the end of its exposure (Raspberry Pi's
    receivers stamp the start of a frame on the wire), or the start of its exposure, as in libcamera's documentation."""


INSTALL = (
    "sudo apt install python3-libcamera python3-kms++ libcap-dev && pip install --upgrade simplejpeg 'slrig[picamera2]'"
)

_UNPACKED = re.compile(r"^(S(?P<bayer>[RGB]{4})|R)(?P<depth>8|10|12|14|16)$")
_MIN_MAIN_SIZE = (64, 64)
"""Size of the main stream that picamera2 always makes, where only the raw one is read."""
FIXED: Mapping[str, object] = {
    "AeEnable": False,
    "AwbEnable": False,
    "ColourGains": (1.0, 1.0),
    "NoiseReductionMode": 0,
    "HdrMode": 0,
    "Sharpness": 0.0,
    "Contrast": 1.0,
    "Brightness": 0.0,
}
"""Values that switch automatic and image processing controls off; set where the camera has the control."""
MAX_EXPOSURE_S = 1.0
"""Longest exposure declared: some sensors allow minutes, too long for any check to wait."""
_BLANK_US = 5_000
"""Frame duration allowed beyond the exposure; libcamera uses no more of it than the sensor needs."""
_ERROR_NS = 1_000_000
"""Delay with which the kernel may notice the start of a frame on the wire."""
_SETTING_TOLERANCE = 0.01
_SETTLING_FRAMES = 12
_WAIT_SLICE_S = 0.05
_FRAME_TIMEOUT_S = 3.0
TRIGGER_MODE = Path("/sys/module/imx296/parameters/trigger_mode")
"""The kernel's switch of all IMX296: 1 for exposures by XTR."""
_TRIGGERED_SENSOR = "imx296"
_WIRED_BUFFERS = 12
_WIRED_AHEAD = 10
"""Frames that may wait for `read` while pulses continue."""
_SHORTEST_PULSE_S = 50e-6
_SUSPENDED_NS = 1_000_000


def load_library() -> Any:
    """Return the class `Picamera2`.

    Raises
    ------
    LibraryMissingError
        picamera2 or libcamera is not installed.
    """
    library = "picamera2 and the system's libcamera"
    where = " (in a virtual environment that was made with --system-site-packages)"
    # The system's own simplejpeg is built for numpy 1.
    with loading("picamera2", library, install=INSTALL, packages="simplejpeg picamera2", where=where):
        return importlib.import_module("picamera2").Picamera2


def list_cameras() -> tuple[dict[str, Any], ...]:
    """Return libcamera's description of each camera, in picamera2's order: Id, Model, Num and more."""
    return tuple(load_library().global_camera_info())


@contextmanager
def translate_errors(name: str, action: str) -> Iterator[None]:
    """Turn the library's RuntimeErrors within the block into slrig's errors.

    Raises
    ------
    DeviceBusyError
        Another program has acquired the camera.
    DeviceError
        Anything else.
    """
    try:
        yield
    except RuntimeError as error:
        causes = " ".join(filter(None, (str(error), str(error.__cause__ or ""))))
        failure = f"camera '{name}', {action}: {causes}"
        if "busy" in causes.lower() or "in use" in causes.lower():
            raise DeviceBusyError(f"{failure}; another program uses the camera: close that program") from error
        raise DeviceError(f"{failure}; check the camera's cable, and try rpicam-hello --list-cameras") from error


def find_devices() -> tuple[FoundDevice, ...]:
    """Return every camera that libcamera finds; opens none.

    Raises
    ------
    LibraryMissingError
        picamera2 is not installed.
    """
    return tuple(FoundDevice("picamera2", each["Id"], f"{each['Model']} (libcamera)") for each in list_cameras())


@dataclass(frozen=True, slots=True)
class PiStream:
    """The configured stream that is read."""

    name: str
    layout: PixelLayout
    size: Size
    stride_bytes: int

    def colour(self, data: NDArray[np.uint8]) -> Callable[[], Pixels] | None:
        """Return a function that converts a buffer to (H, W, 3), blue, green and red; None without colour."""
        if not self.layout.has_colour:
            return None
        return partial(colour_image, data, self.layout, self.size, stride_bytes=self.stride_bytes)

    def image(self, data: NDArray[np.uint8]) -> Pixels:
        """Return the grey image of a buffer, (H, W). Raises ValueError if the buffer is too short."""
        return grey_image(data, self.layout, self.size, stride_bytes=self.stride_bytes)


def require_trigger_mode(name: str, model: str, *, external: bool) -> None:
    """Raise UnsupportedByDeviceError unless the sensor is in the requested mode: pulses on XTR, or none."""
    if model != _TRIGGERED_SENSOR:
        if external:
            message = (
                f"camera '{name}': requested external_trigger, which sensor {_TRIGGERED_SENSOR} has, and this is "
                f"{model}; leave external_trigger out"
            )
            raise UnsupportedByDeviceError(message)
        return
    waits = TRIGGER_MODE.is_file() and TRIGGER_MODE.read_text(encoding="ascii").strip() == "1"
    if waits != external:
        found = "waits for pulses on XTR" if waits else "runs freely"
        message = (
            f"camera '{name}': requested external_trigger = {str(external).lower()}, and the kernel's driver {found}; "
            f"echo {int(external)} | sudo tee {TRIGGER_MODE}, or write external_trigger = {str(waits).lower()}"
        )
        raise UnsupportedByDeviceError(message)


def configure_stream(
    camera: Any, name: str, *, raw: bool, size_px: tuple[int, int] | None, buffers: int | None = None
) -> PiStream:
    """Configure the camera for a stream and read the result back. buffers : as many as the library makes if None.

    Raises
    ------
    UnsupportedByDeviceError
        The sensor has no such mode, or libcamera gives another size or an unknown format.
    """
    modes = [mode for mode in camera.sensor_modes if "size" in mode]
    sizes = sorted({tuple(mode["size"]) for mode in modes}, key=lambda size: size[0] * size[1])
    wanted = sizes[-1] if size_px is None and sizes else size_px
    offered = ", ".join(f"{width} x {height}" for width, height in sizes) or "none with a size"
    if wanted not in sizes:
        message = f"camera '{name}': requested size_px {wanted}, its sensor has the modes {offered}; choose one of them"
        raise UnsupportedByDeviceError(message)
    mode = max((mode for mode in modes if tuple(mode["size"]) == wanted), key=lambda mode: mode["bit_depth"])
    sensor = {"output_size": wanted, "bit_depth": mode["bit_depth"]}
    table: dict[str, Any]
    if raw:
        table = {"raw": {"format": mode["unpacked"], "size": wanted}, "main": {"size": _MIN_MAIN_SIZE}}
    else:
        table = {"main": {"format": "YUV420", "size": wanted}}
    if buffers is not None:
        table["buffer_count"] = buffers
    camera.configure(camera.create_video_configuration(**table, sensor=sensor, controls={}, display=None, encode=None))
    which = "raw" if raw else "main"
    got = camera.camera_configuration()[which]
    layout = _layout(got["format"])
    if layout is None or tuple(got["size"]) != wanted:
        message = (
            f"camera '{name}': requested {table[which]}, libcamera gives {got['format']}, {got['size']}; "
            f'write pixels = "{"luma" if raw else "raw"}", or another size_px (the sensor has {offered})'
        )
        raise UnsupportedByDeviceError(message)
    return PiStream(which, layout, Size(*wanted), got["stride"])


def _layout(form: str) -> PixelLayout | None:
    """Return the layout of a format of libcamera; None if it is unknown.

    >>> _layout("SRGGB10").bayer, _layout("R8").packing.name, _layout("RGGB16_PISP_COMP1")
    ('RGGB', 'BYTES', None)
    """
    if form == "YUV420":
        # Planes: all luma first, then the colours, which are not used.
        return PixelLayout(8, SamplePacking.BYTES)
    found = _UNPACKED.match(form)
    if found is None:
        return None
    depth = int(found["depth"])
    return PixelLayout(depth, SamplePacking.BYTES if depth == 8 else SamplePacking.WORDS, found["bayer"])


class PiCamera:
    """Implements `slrig.devices.Camera`.

    Parameters
    ----------
    name
        Its name in the rig file.
    options
        Checked options.
    clock
        CLOCK_MONOTONIC; in tests the clock of the stand-in.

    Raises
    ------
    LibraryMissingError
        picamera2 is not installed.
    DeviceGoneError
        No such camera is connected.
    DeviceBusyError
        Another program uses it.
    UnsupportedByDeviceError
        It cannot do what an option requests.
    """

    def __init__(self, name: str, options: PiCameraOptions, *, clock: Clock | None = None) -> None:
        self._name, self._options = name, options
        self._clock = clock or SystemClock()
        self._state = CameraState(name)
        known = list_cameras()
        numbers = [number for number, each in enumerate(known) if each["Id"] == options.device]
        if not numbers:
            found = ", ".join(each["Id"] for each in known) or "none"
            message = f"camera '{name}': camera '{options.device}' is not connected; found: {found}; check its cable"
            raise DeviceGoneError(message)
        self._jobs: deque[Any] = deque()
        self._applied: AppliedSettings | None = None
        wired = self._wired = options.external_trigger
        require_trigger_mode(name, str(known[numbers[0]]["Model"]), external=wired)
        with translate_errors(name, "opening it"):
            self._camera = load_library()(numbers[0])
        try:
            with translate_errors(name, "configuring it"):
                raw = options.pixels == "raw"
                self._stream: PiStream = configure_stream(
                    self._camera, name, raw=raw, size_px=options.size_px, buffers=_WIRED_BUFFERS if wired else None
                )
                self._controls = self._camera.camera_controls
                self._camera.set_controls(self._fixed_controls())
            self._info = self._describe(known[numbers[0]])
        except BaseException:
            self._camera.close()
            raise

    @property
    def info(self) -> CameraInfo:
        """See `Camera`. The gain is the sensor's own, as a factor."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. Runs the camera until a frame with these settings comes, unless it waits for pulses.

        Raises
        ------
        FrameTimeoutError
            The camera delivers no frame.
        """
        self._state.check_settings(settings, self._info)
        if self._wired:
            fastest_us = self._set_exposure(settings.exposure_s, settings.gain)
            # The sensor is read out before the next exposure begins.
            period_s = settings.exposure_s + fastest_us / 1e6
            self._applied = AppliedSettings(settings.exposure_s, settings.gain, period_s)
            return self._applied
        metadata = self._run_until_applied(settings.exposure_s, settings.gain, _SETTLING_FRAMES)
        got = _applied_settings(metadata)
        if not _is_applied(metadata, settings.exposure_s, settings.gain):
            message = (
                f"camera '{self._name}': requested exposure_s {settings.exposure_s:g} and gain {settings.gain:g}, it "
                f"gives {got.exposure_s:g} and {got.gain:g}; use these values"
            )
            raise UnsupportedByDeviceError(message)
        return got

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. Starts the camera again: no frame of an earlier arming can come."""
        self._state.check_arming(count, trigger, self._info)
        self._last_ns = self._number = self._dropped = 0
        with translate_errors(self._name, "starting it"):
            self._camera.start()
            self._request(_WIRED_AHEAD if self._wired else 0)
        self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. libcamera has no software trigger."""
        self._state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. Allows for the error of time stamps."""
        self._state.require_armed()
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        skipped = 0
        while True:
            left_s = (until_ns - self._clock.now_ns()) / 1e9
            with translate_errors(self._name, "waiting for a frame"):
                request = self._next(max(min(left_s, _WAIT_SLICE_S), 0.0))
            if request is not None:
                try:
                    self._state.require_armed()  # another thread may have closed it meanwhile
                    frame = self._frame(request, after_ns)
                finally:
                    request.release()
                if frame is not None:
                    return frame
                skipped += 1
            self._state.require_armed()
            if left_s <= 0:
                message = (
                    f"camera '{self._name}': no frame that began after {after_ns} ns came in {timeout_s:g} s "
                    f"({skipped} that began earlier were skipped); check "
                    + ("the wire to XTR, its level, and R11" if self._wired else "its cable, and that the Pi keeps up")
                )
                raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        if self._state.armed is not None:
            self._state.armed = None
            self._stop()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        if self._state.close():
            self._camera.close()

    def _run_until_applied(self, exposure_s: float, gain: float, max_frames: int) -> Mapping[str, Any]:
        """Run the camera and return the metadata of its first frame with these settings, or of the last one.

        Raises
        ------
        FrameTimeoutError
            It delivers no frame.
        """
        with translate_errors(self._name, "setting exposure and gain"):
            self._set_exposure(exposure_s, gain)
            self._camera.start()
            try:
                while True:
                    request = self._next(exposure_s + _FRAME_TIMEOUT_S)
                    if request is None:
                        message = f"camera '{self._name}' delivers no frame at {exposure_s:g} s; check its cable"
                        raise FrameTimeoutError(message)
                    metadata: Mapping[str, Any] = request.get_metadata()
                    request.release()
                    max_frames -= 1
                    if _is_applied(metadata, exposure_s, gain) or max_frames <= 0:
                        return metadata
            finally:
                self._stop()

    def _set_exposure(self, exposure_s: float, gain: float) -> int:
        """Set exposure and gain for the next start; return the shortest frame duration, µs."""
        exposure_us = round(exposure_s * 1e6)
        fastest_us = int(self._controls["FrameDurationLimits"][0])
        limits = (fastest_us, max(fastest_us, exposure_us + _BLANK_US))
        with translate_errors(self._name, "setting exposure and gain"):
            self._camera.set_controls(
                {"ExposureTime": exposure_us, "AnalogueGain": gain, "FrameDurationLimits": limits}
            )
        return fastest_us

    def _request(self, ahead: int) -> None:
        """Request the next frames, `ahead` of them."""
        while len(self._jobs) < ahead:
            self._jobs.append(self._camera.capture_request(wait=False))

    def _next(self, timeout_s: float) -> Any:
        """Return the next complete request, to be released by the caller; None after `timeout_s`."""
        self._request(_WIRED_AHEAD if self._wired else 1)
        try:
            request = self._camera.wait(self._jobs[0], timeout=timeout_s)
        except (JobTimeoutError, TimeoutError):
            return None
        self._jobs.popleft()
        return request

    def _stop(self) -> None:
        if self._jobs:
            with suppress(JobTimeoutError, TimeoutError):
                while self._wired and self._jobs:
                    # What came and was not read; the first that did not come ends this.
                    self._camera.wait(self._jobs[0], timeout=0).release()
                    self._jobs.popleft()
            # Stopping waits for earlier jobs, and so would not end if no frame comes.
            self._camera.cancel_all_and_flush()
            self._jobs.clear()
        with translate_errors(self._name, "stopping it"):
            self._camera.stop()

    def _frame(self, request: Any, after_ns: int) -> Frame | None:
        """Return the frame of a request; None if it began before `after_ns`."""
        metadata = request.get_metadata()
        now_ns = self._clock.now_ns()
        exposure_ns = round(metadata["ExposureTime"] * 1e3)
        stamp_ns = _monotonic(metadata["SensorTimestamp"], now_ns)
        if self._wired:
            exposure_ns = self._exposure_by_wire_ns(metadata)
            self._number += 1
        elif self._last_ns:
            steps = max(round((stamp_ns - self._last_ns) / (metadata["FrameDuration"] * 1e3)), 1)
            self._number += steps
            self._dropped += steps - 1
        self._last_ns = stamp_ns
        start_ns = stamp_ns - (exposure_ns if self._options.time_stamp == "readout" else 0)
        if start_ns - _ERROR_NS < after_ns:
            return None
        # All rows are read out within a frame of the fastest mode, and before the frame arrived.
        skew_ns = (
            0 if self._options.global_shutter or self._wired else round(self._controls["FrameDurationLimits"][0] * 1e3)
        )
        skew_ns = max(min(skew_ns, now_ns - start_ns - exposure_ns), 0)
        data = request.make_buffer(self._stream.name)
        return Frame(
            camera=self._name,
            image=self._stream.image(data),
            t_start_ns=start_ns,
            t_end_ns=start_ns + exposure_ns + skew_ns,
            t_err_ns=_ERROR_NS,
            sequence_number=self._number,
            dropped_count=self._dropped,
            exposure_s=exposure_ns / 1e9,
            gain=float(metadata["AnalogueGain"]),
            shutter_skew_s=skew_ns / 1e9,
            colour=self._stream.colour(data),
        )

    def _exposure_by_wire_ns(self, metadata: Mapping[str, Any]) -> int:
        """Return the expected length of the pulse. Raises UnsupportedByDeviceError if the gain is another one."""
        if self._applied is None:
            message = f"camera '{self._name}' exposes as long as its pulses, which were not set; configure it first"
            raise DeviceStateError(message)
        if not _is_close(metadata["AnalogueGain"], self._applied.gain):
            message = (
                f"camera '{self._name}': requested gain {self._applied.gain:g}, it gives "
                f"{metadata['AnalogueGain']:g}; use this value"
            )
            raise UnsupportedByDeviceError(message)
        return round(self._applied.exposure_s * 1e9)

    def _describe(self, known: Mapping[str, Any]) -> CameraInfo:
        min_gain, max_gain = self._controls["AnalogueGain"][:2]
        # libcamera reports a maximum of 0 for some sensors (IMX296).
        longest_s = min((self._controls["ExposureTime"][1] or math.inf) / 1e6, MAX_EXPOSURE_S)
        if self._wired:
            shortest_s = _SHORTEST_PULSE_S
        else:
            # It may report 0 for "automatic": the metadata of a frame have the sensor's minimum.
            shortest = self._run_until_applied(
                max(self._controls["ExposureTime"][0], 1) / 1e6, max(float(min_gain), 1.0), 1
            )
            shortest_s = shortest["ExposureTime"] / 1e6
        return CameraInfo(
            name=self._name,
            model=str(known["Model"]),
            serial=self._options.device,
            format=CameraFormat(self._stream.size, self._stream.layout.bit_depth),
            triggers=frozenset({Trigger.HARDWARE if self._wired else Trigger.FREE}),
            exposure_range_s=(shortest_s, longest_s),
            gain_range=(max(float(min_gain), 1.0), float(max_gain)),
            colour=self._stream.layout.has_colour,
            exposed_by_pulse=self._wired,
        )

    def _fixed_controls(self) -> dict[str, object]:
        """Return the controls to set once. Raises UnsupportedByDeviceError if lens and option do not match."""
        fixed = {control: value for control, value in FIXED.items() if control in self._controls}
        focus = self._options.focus_dioptres
        if ("LensPosition" in self._controls) != (focus is not None):
            message = (
                f"camera '{self._name}' has a motorised lens; write focus_dioptres, 1 / the distance in m"
                if focus is None
                else f"camera '{self._name}': requested focus_dioptres {focus:g}, its lens is fixed; leave that out"
            )
            raise UnsupportedByDeviceError(message)
        return fixed if focus is None else {**fixed, "AfMode": 0, "LensPosition": focus}


def _applied_settings(metadata: Mapping[str, Any]) -> AppliedSettings:
    exposure_s, period_s = metadata["ExposureTime"] / 1e6, metadata["FrameDuration"] / 1e6
    return AppliedSettings(exposure_s, float(metadata["AnalogueGain"]), period_s)


def _is_applied(metadata: Mapping[str, Any], exposure_s: float, gain: float) -> bool:
    return _is_close(metadata["ExposureTime"], exposure_s * 1e6) and _is_close(metadata["AnalogueGain"], gain)


def _is_close(got: float, wanted: float) -> bool:
    return abs(got - wanted) <= max(_SETTING_TOLERANCE * wanted, 1e-3)


def _monotonic(stamp_ns: int, now_ns: int) -> int:
    """Convert a time stamp to CLOCK_MONOTONIC.

    libcamera documents CLOCK_BOOTTIME, which also counts the time that the machine was suspended; the receivers of a
    Raspberry Pi stamp by CLOCK_MONOTONIC. Where the two differ, the clock nearer to the present is the stamp's.
    """
    suspended_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
    if suspended_ns > _SUSPENDED_NS and abs(stamp_ns - suspended_ns - now_ns) < abs(stamp_ns - now_ns):
        return stamp_ns - suspended_ns
    return stamp_ns


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a Raspberry Pi's camera from its `[[camera]]` table (without `name`, `driver` and settings).

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    LibraryMissingError, DeviceGoneError, DeviceBusyError, UnsupportedByDeviceError, DeviceError
        See `PiCamera`.
    """
    del folder
    return PiCamera(name, validate(PiCameraOptions, options, f"the [[camera]] table '{name}'"))

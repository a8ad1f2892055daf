"""Interface of the driver to a GenICam library (Aravis or a GenTL producer): features, frames and connection."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self

from pydantic import Field, model_validator

from slrig.bundle import Strict
from slrig.devices import CameraState
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size

StampMeaning = Literal["exposure", "exposure_start", "exposure_end", "none"]

_MIN_PACKET_BYTES = 576
_MAX_PACKET_BYTES = 16_000


OWN_FEATURES = frozenset(
    {
        "AcquisitionMode",
        "AcquisitionStart",
        "AcquisitionStop",
        "ExposureAuto",
        "ExposureMode",
        "ExposureTime",
        "ExposureTimeAbs",
        "Gain",
        "GainAuto",
        "GainRaw",
        "Height",
        "OffsetX",
        "OffsetY",
        "PixelFormat",
        "TriggerMode",
        "TriggerSelector",
        "TriggerSoftware",
        "TriggerSource",
        "Width",
    }
)


class SensorRegion(Strict, use_attribute_docstrings=True):
    """Part of the sensor, px. The calibration holds for the region it was made with."""

    x_px: int = Field(default=0, ge=0)
    """First column."""

    y_px: int = Field(default=0, ge=0)
    """First row."""

    width_px: int = Field(ge=1)
    """Number of columns."""

    height_px: int = Field(ge=1)
    """Number of rows."""


class GenICamCameraOptions(Strict, use_attribute_docstrings=True):
    """Options of a GenICam camera, common to both libraries."""

    device: str = Field(min_length=1)
    """As listed by `slrig devices`."""

    pixel_format: str = Field(default="Mono8", min_length=1)
    """PFNC name: Mono8, Mono10, Mono12, Mono16, their packed variants, Bayer…, RGB8, BGR8."""

    region: SensorRegion | None = None
    """Part of the sensor; default: all of it."""

    trigger_line: str | None = Field(default=None, min_length=1)
    """Input of a hardware trigger; default: the first line."""

    trigger_activation: str = Field(default="RisingEdge", min_length=1)
    """Edge of a hardware trigger, by its GenICam name."""

    user_set: str | None = Field(default=None, min_length=1)
    """Stored settings of the camera that are loaded first, by their GenICam name (Default, UserSet1); default: none is
    loaded."""

    features: Mapping[str, bool | int | float | str] = Field(default_factory=dict)
    """Further GenICam features, set in this order when the camera is opened, and read back. Gamma, sharpening, binning,
    mirroring and limits of the frame rate are off before: name what enables a feature first."""

    time_stamp: StampMeaning = "exposure"
    """Instant that the camera's time stamps mean: "exposure" is some instant within it, "none" ignores them (for
    cameras that stamp a frame when it is sent)."""

    transfer_s: float = Field(default=0.1, gt=0, le=10)
    """Longest time from the end of an exposure to the arrival of the frame's first packet; used only if the camera's
    clock cannot be related to the host's."""

    answer_s: float = Field(default=0.5, gt=0, le=10)
    """Longest time from a software trigger to the arrival of its frame, beyond the exposure; the next trigger waits for
    it."""

    @model_validator(mode="after")
    def _check_features(self) -> Self:
        """Refuse features that the driver sets itself."""
        own = sorted(set(self.features) & OWN_FEATURES)
        if own:
            message = (
                f"features names {', '.join(own)}, which the driver sets itself; use exposure_s, gain, pixel_format, "
                "region and trigger_line instead"
            )
            raise ValueError(message)
        return self


class GenicamOptions(GenICamCameraOptions, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "genicam"` (in addition to name, exposure_s and gain)."""

    device: str = Field(min_length=1)
    """Aravis' id (vendor-model-serial, as `slrig devices` lists it), or the IP address of a GigE camera."""

    packet_size_bytes: int | None = Field(default=None, ge=_MIN_PACKET_BYTES, le=_MAX_PACKET_BYTES)
    """GigE: packet size; default: the largest size that arrives complete, determined automatically."""

    packet_delay_ns: int | None = Field(default=None, ge=0)
    """GigE: the camera's pause between packets; default: the camera's setting."""

    packet_resend: bool = True
    """GigE: request lost packets again."""

    packet_socket: bool = False
    """GigE: read the network card directly (less load; needs CAP_NET_RAW, and does not work on a loopback
    interface)."""


class GentlOptions(GenICamCameraOptions, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "gentl"` (in addition to name, exposure_s and gain)."""

    device: str = Field(min_length=1)
    """The producer's id of the camera (as `slrig devices` lists it), or its serial number."""

    producer: str | None = Field(default=None, min_length=1)
    """The vendor's GenTL producer, a .cti file, relative to the rig file's folder; default: all in the folders of the
    variable GENICAM_GENTL64_PATH."""


_READ = ("boolean", "integer", "float")

TOLERANCE = 0.01
"""Allowed relative difference of a number from the requested one: cameras round to their steps."""


class Features:
    """Features of a device by name: set, read back and compared. Each call may raise the errors of
    `GenICamConnection.access`.

    name : for messages. access : gives the `Aravis.Camera` for one request; its registers must not be cached, so that
    values read back come from the camera. feature_type : returns the type of a feature, see `GenICamConnection`.
    """

    def __init__(
        self, name: str, access: Callable[[str], AbstractContextManager[Any]], feature_type: Callable[[str], str]
    ) -> None:
        self._name = name
        self._access_camera = access
        self._feature_type = feature_type

    def has(self, feature: str) -> bool:
        """True if the device has the feature and currently offers it."""
        with self._access(feature) as camera:
            return bool(camera.is_feature_available(feature))

    def choices(self, feature: str) -> tuple[str, ...]:
        """Return the currently available entries of an enumeration."""
        with self._access(feature) as camera:
            return tuple(camera.dup_available_enumerations_as_strings(feature) or ())

    def text(self, feature: str) -> str:
        """Return the value of an enumeration or a string."""
        with self._access(feature) as camera:
            return str(camera.get_string(feature))

    def integer(self, feature: str) -> int:
        """Return the value of an integer."""
        with self._access(feature) as camera:
            return int(camera.get_integer(feature))

    def number(self, feature: str) -> float:
        """Return the value of a float."""
        with self._access(feature) as camera:
            return float(camera.get_float(feature))

    def execute(self, feature: str) -> None:
        """Execute a command."""
        with self._access(feature) as camera:
            camera.execute_command(feature)

    def choose(self, feature: str, entry: str) -> None:
        """Set an enumeration. Raises UnsupportedByDeviceError if it has no such entry, or another is read back."""
        offered = self.choices(feature)
        if entry not in offered:
            raise self._refusal(
                feature, entry, f"it offers {', '.join(offered) or 'nothing now'}", "choose one of these"
            )
        if self.text(feature) == entry:
            # Some cameras offer a single, read-only entry.
            return
        with self._access(feature) as camera:
            camera.set_string(feature, entry)
        self._require_equal(feature, entry, self.text(feature))

    def set_integer(self, feature: str, value: int) -> None:
        """Set an integer. Raises UnsupportedByDeviceError if it is out of range or between steps, or another is read
        back.
        """
        with self._access(feature) as camera:
            least, most = camera.get_integer_bounds(feature)
            step = camera.get_integer_increment(feature)
        if not least <= value <= most or (step > 1 and (value - least) % step):
            steps = f" in steps of {step}" if step > 1 else ""
            raise self._refusal(feature, value, f"it takes {least} to {most}{steps}", "request such a value")
        with self._access(feature) as camera:
            camera.set_integer(feature, value)
        self._require_equal(feature, value, self.integer(feature))

    def neutralise(self, feature: str, number: int) -> None:
        """Switch a feature off; if it is a number, set the nearest to `number` that it takes. Raises as `set_any`."""
        got = self.value(feature)
        wanted: bool | float | str
        match got:
            case bool():
                wanted = False
            case str():
                wanted = "Off"
            case _:
                kind = "integer" if isinstance(got, int) else "float"
                with self._access(feature) as camera:
                    least, most = getattr(camera, f"get_{kind}_bounds")(feature)
                wanted = type(got)(min(max(number, least), most))
        # Some cameras offer a single, read-only value.
        if got != wanted:
            self.set_any(feature, wanted)

    def value(self, feature: str) -> bool | int | float | str:
        """Return the value of a feature of any type."""
        kind = self._feature_type(feature).lower()
        with self._access(feature) as camera:
            value: bool | int | float | str = getattr(camera, f"get_{kind if kind in _READ else 'string'}")(feature)
        return bool(value) if kind == "boolean" else value

    def set_any(self, feature: str, value: bool | int | float | str) -> None:
        """Set a feature of any type. Raises UnsupportedByDeviceError if it is missing, of another type, or not
        accepted.
        """
        if not self.has(feature):
            message = (
                f"camera '{self._name}' has no feature {feature}, or does not offer it in its current state; remove it "
                "from features, or set what enables it before"
            )
            raise UnsupportedByDeviceError(message)
        match value, self._feature_type(feature):
            case bool(), "Boolean":
                with self._access(feature) as camera:
                    camera.set_boolean(feature, value)
                    got = bool(camera.get_boolean(feature))
                self._require_equal(feature, value, got)
            case str(), "Enumeration":
                self.choose(feature, value)
            case str(), "String":
                with self._access(feature) as camera:
                    camera.set_string(feature, value)
                self._require_equal(feature, value, self.text(feature))
            case int(), "Integer" if not isinstance(value, bool):
                self.set_integer(feature, value)
            case int() | float(), "Float" if not isinstance(value, bool):
                self._set_number(feature, float(value))
            case _, kind:
                raise self._refusal(feature, value, f"the feature is of type {kind}", "write a value of that type")

    def _set_number(self, feature: str, value: float) -> None:
        with self._access(feature) as camera:
            least, most = camera.get_float_bounds(feature)
        if not least <= value <= most:
            raise self._refusal(feature, value, f"it takes {least:g} to {most:g}", "request such a value")
        with self._access(feature) as camera:
            camera.set_float(feature, value)
            got = float(camera.get_float(feature))
        if differs(got, value):
            raise self._refusal(feature, value, f"it gives {got:g}", "request a value that it can give")

    def _require_equal(self, feature: str, requested: object, got: object) -> None:
        if got != requested:
            raise self._refusal(feature, requested, f"it gives {got}", "request a value that it can give")

    def _refusal(self, feature: str, requested: object, found: str, remedy: str) -> UnsupportedByDeviceError:
        return UnsupportedByDeviceError(f"camera '{self._name}': requested {feature} {requested}, {found}; {remedy}")

    def _access(self, feature: str) -> AbstractContextManager[Any]:
        return self._access_camera(f"feature {feature}")


def differs(got: float, requested: float) -> bool:
    """True if a number that was read back is not the requested one.

    >>> differs(0.01001, 0.01), differs(0.0, 0.0), differs(2.0, 1.5)
    (False, False, True)
    """
    return abs(got - requested) > TOLERANCE * abs(requested) + 1e-12


@dataclass(frozen=True, slots=True)
class RawImage:
    """Image in memory; `padding_bytes` follow each row."""

    data: bytes
    size: Size
    padding_bytes: int


@dataclass(frozen=True, slots=True)
class RawFrame:
    """Frame as delivered by a library.

    block_id : the camera's number of it. arrived_ns : upper bound of its arrival, CLOCK_MONOTONIC. stamp_ns : the
    camera's own time, 0 if none. image : None if it is incomplete.
    """

    block_id: int
    arrived_ns: int
    stamp_ns: int
    image: RawImage | None


class GenICamStream(Protocol):
    """A running acquisition."""

    def take(self, max_s: float) -> RawFrame | None:
        """Return the next frame, waiting at most `max_s`; None if none arrived."""
        ...

    def end(self) -> None:
        """Stop, in any state of the camera. Frames not yet taken are dropped."""
        ...


class GenICamConnection(ABC):
    """An open device. Used by one thread; a thread of the library may report its loss. name : for messages."""

    _camera: Any
    """`Aravis.Camera`, or an object with the same methods."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.state = CameraState(name)
        self._lost = threading.Event()
        self.features = Features(name, self.access, self.feature_type)

    @property
    def is_lost(self) -> bool:
        """True if the device was lost since it was opened."""
        return self._lost.is_set()

    @contextmanager
    def access(self, doing: str) -> Iterator[Any]:
        """Provide the camera, with the interface of `Aravis.Camera`, for the block.

        Raises DeviceStateError if it was closed, DeviceGoneError if it is lost, before or during the block, and the
        errors of `translate_errors`.
        """
        self.state.require_open()
        if self._lost.is_set():
            raise self.gone_error(doing)
        try:
            with self.translate_errors(doing):
                yield self._camera
        except DeviceGoneError:
            self._lost.set()
            raise

    def gone_error(self, doing: str) -> DeviceGoneError:
        """Return the error of a lost device."""
        message = f"camera '{self.name}' is gone ({doing}); check its cable and power, and open the rig again"
        return DeviceGoneError(message)

    def latch(self) -> tuple[int, int, int] | None:
        """Return host time before, device time, host time after, ns; None if the clock cannot be latched."""
        command, value = "TimestampLatch", "TimestampLatchValue"
        try:
            if not (self.features.has(command) and self.features.has(value)):
                return None
            before_ns = time.monotonic_ns()
            self.features.execute(command)
            after_ns = time.monotonic_ns()
            return before_ns, self.features.integer(value), after_ns
        except UnsupportedByDeviceError:
            return None

    @property
    def has_stamps(self) -> bool:
        """True if frames may carry the device's own time."""
        return True

    @abstractmethod
    def translate_errors(self, doing: str) -> AbstractContextManager[None]:
        """Translate the library's errors within the block into slrig's."""

    @abstractmethod
    def feature_type(self, feature: str) -> str:
        """Return Boolean, Enumeration, String, Integer, Float, or the library's own name of the type of a feature."""

    @abstractmethod
    def prepare_link(self) -> None:
        """Set up what carries the frames."""

    @property
    @abstractmethod
    def is_usb(self) -> bool:
        """True if the device is on USB."""

    @abstractmethod
    def start(self, buffers: int) -> GenICamStream:
        """Start the acquisition with this number of buffers. It delivers no frame of an earlier one."""

    @abstractmethod
    def close(self) -> None:
        """Close the device. Idempotent; works after it is lost."""

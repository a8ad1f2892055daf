"""Options of a GenICam camera in the rig file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field, model_validator

from slrig.bundle.validation import Strict

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

    features: Mapping[str, bool | int | float | str] = Field(default_factory=dict)
    """Further GenICam features, set in this order when the camera is opened, and read back."""

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

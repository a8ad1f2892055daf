"""What a rig file says about a GenICam camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field, ValidationError, model_validator

from slrig.bundle.faults import Strict, explain, keys_of
from slrig.errors import ConfigError

Stamp = Literal["exposure", "exposure_start", "exposure_end", "none"]

_LEAST_PACKET_BYTES = 576
_MOST_PACKET_BYTES = 16_000


class Region(Strict):
    """Part of the sensor, px. The calibration holds for the region it was made with."""

    x_px: int = Field(default=0, ge=0)
    y_px: int = Field(default=0, ge=0)
    width_px: int = Field(ge=1)
    height_px: int = Field(ge=1)


class GenicamOptions(Strict):
    """The `[[camera]]` table of a GenICam camera.

    device : Aravis' id (vendor-model-serial, as `slrig devices` lists it), or the IP address of a GigE camera.
    pixel_format : PFNC name: Mono8, Mono10, Mono12, Mono16, their packed kinds, Bayer…, RGB8, BGR8.
    region : part of the sensor; all of it where absent.
    trigger_line, trigger_activation : the input and edge of a hardware trigger; the first line where absent.
    features : further GenICam features, set in this order when the camera is opened, and read back.
    time_stamp : which instant the camera's time stamps mean; "exposure", the default, is some instant within it,
        "none" distrusts them (cameras that stamp a frame when it is sent).
    transfer_s : the longest time from the end of an exposure to the arrival of the frame's first packet; believed only
        where the camera's clock cannot be tied to the host's.
    answer_s : how long a frame may take from its software trigger to that arrival, beyond the exposure; so long the
        next trigger waits for it.
    packet_size_bytes : GigE; the largest that arrives whole is found out where absent. packet_delay_ns : GigE, the
        camera's pause between packets. packet_resend : ask for lost packets again. packet_socket : read the network
        card directly (less load; needs CAP_NET_RAW, and receives nothing on a loopback interface).
    """

    device: str = Field(min_length=1)
    pixel_format: str = Field(default="Mono8", min_length=1)
    region: Region | None = None
    trigger_line: str | None = Field(default=None, min_length=1)
    trigger_activation: str = Field(default="RisingEdge", min_length=1)
    features: Mapping[str, bool | int | float | str] = Field(default_factory=dict)
    time_stamp: Stamp = "exposure"
    transfer_s: float = Field(default=0.1, gt=0, le=10)
    answer_s: float = Field(default=0.5, gt=0, le=10)
    packet_size_bytes: int | None = Field(default=None, ge=_LEAST_PACKET_BYTES, le=_MOST_PACKET_BYTES)
    packet_delay_ns: int | None = Field(default=None, ge=0)
    packet_resend: bool = True
    packet_socket: bool = False

    @model_validator(mode="after")
    def _set_once(self) -> Self:
        """Refuse features that the driver sets itself: two masters for one register."""
        own = sorted(set(self.features) & OWN_FEATURES)
        if own:
            message = (
                f"features names {', '.join(own)}, which the driver sets itself; use exposure_s, gain, pixel_format, "
                "region and trigger_line instead"
            )
            raise ValueError(message)
        return self


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


def options_of(name: str, table: Mapping[str, object]) -> GenicamOptions:
    """Check a camera's table.

    Raises
    ------
    ConfigError
        The table has faults, all of them in one message.
    """
    try:
        return GenicamOptions.model_validate(dict(table))
    except ValidationError as error:
        known = explain(error, table, keys_of(GenicamOptions))
        message = f"the [[camera]] table of '{name}' (driver genicam) is wrong:\n{known}"
        raise ConfigError(message) from error

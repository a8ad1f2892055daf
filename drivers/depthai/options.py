"""Options of an OAK camera in the rig file, and the resulting stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from slrig.bundle.validation import Strict
from slrig.model import Size

DEFAULT_FPS = 20.0

Socket = Literal["CAM_A", "CAM_B", "CAM_C", "CAM_D", "CAM_E", "CAM_F", "CAM_G", "CAM_H"]
PixelExtent = Annotated[int, Field(ge=16, le=16384)]


class OakOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "depthai"` (in addition to name, exposure_s and gain)."""

    device: Annotated[str, Field(min_length=1)]
    """The device's id as `slrig devices` lists it, or its address or USB port. Several tables may name the same device:
    it is opened once, and its cameras are synchronised frame by frame."""

    socket: Socket
    """Camera of the device. On an OAK-D, CAM_A is the colour camera, CAM_B the left and CAM_C the right mono camera."""

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)] | None = None
    """[width, height] of the frames; default: the sensor's size."""

    fps: Annotated[float, Field(ge=1, le=240, json_schema_extra={"unit": "Hz"})] = DEFAULT_FPS
    """Frame rate of the sensor; it limits the exposure. The same for all cameras of a device."""

    focus: Annotated[int, Field(ge=0, le=255)] | None = None
    """Lens position of a camera with autofocus (which is switched off); default: the position of the factory
    calibration."""

    colour_temperature_k: Annotated[int, Field(ge=1000, le=12000)] = 5000
    """Fixed white balance of a colour camera."""

    external_trigger: bool = False
    """A rising edge on the pin FSIN starts each exposure. The same for all cameras of a device."""


@dataclass(frozen=True, slots=True)
class OakStream:
    """Stream of one camera: options, completed with the device's properties.

    focus : None for a camera without autofocus. colour : frames are NV12, else GRAY8.
    """

    socket: str
    size: Size
    fps: float
    colour: bool
    focus: int | None
    colour_temperature_k: int
    external_trigger: bool

    @property
    def period_ns(self) -> int:
        """Frame period, ns."""
        return round(1e9 / self.fps)

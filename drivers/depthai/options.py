"""What a rig file says about an OAK camera."""

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
    """The keys of a `[[camera]]` table with `driver = "depthai"` (beside name, exposure_s and gain)."""

    device: Annotated[str, Field(min_length=1)]
    """The device's id, as `slrig devices` lists it; its address or USB port will do, too. Several tables may name one
    device: it is opened once, and its cameras are paired frame by frame."""

    socket: Socket
    """Which camera of it. On an OAK-D, CAM_A is the colour camera, CAM_B the left and CAM_C the right mono one."""

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)] | None = None
    """[width, height] of the frames; else the sensor's own."""

    fps: Annotated[float, Field(ge=1, le=240, json_schema_extra={"unit": "Hz"})] = DEFAULT_FPS
    """How many frames the sensor makes per second; the longest exposure follows from it. One for all of a device."""

    focus: Annotated[int, Field(ge=0, le=255)] | None = None
    """Lens position of a camera with autofocus (which is switched off); else the position at which the camera was
    calibrated in the factory."""

    colour_temperature_k: Annotated[int, Field(ge=1000, le=12000)] = 5000
    """White balance of a colour camera, fixed."""

    external_trigger: bool = False
    """A rising edge on the pin FSIN starts each exposure. One for all of a device."""


@dataclass(frozen=True, slots=True)
class OakStream:
    """What one camera of a device is to deliver: options, with what the device told filled in.

    focus : None for a camera without autofocus. colour : the frames are the luminance of NV12, else GRAY8.
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
        """From one frame to the next, ns."""
        return round(1e9 / self.fps)

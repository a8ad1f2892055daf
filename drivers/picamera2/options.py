"""What a rig file says about a Raspberry Pi's camera."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from slrig.bundle.validation import Strict

PixelExtent = Annotated[int, Field(ge=16, le=16384)]


class PiCameraOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "picamera2"` (beside name, exposure_s and gain)."""

    device: Annotated[str, Field(min_length=1)]
    """The camera's id, as `slrig devices` lists it."""

    pixels: Literal["raw", "luma"] = "raw"
    """What is read: the sensor's own samples, which are in proportion to the light, or the luma that the image
    processor makes of them, with its gamma."""

    size_px: Annotated[tuple[PixelExtent, PixelExtent], Field(strict=False)] | None = None
    """[width, height] of one of the sensor's modes; else its largest."""

    focus_dioptres: Annotated[float, Field(ge=0, le=32)] | None = None
    """Where a lens that can be moved is held, 1/m: 2 is half a metre away. Such a camera needs it."""

    global_shutter: bool = False
    """Whether the sensor exposes all rows together (IMX296, OV9281), which libcamera does not tell."""

    time_stamp: Literal["readout", "exposure"] = "readout"
    """What a time stamp means: the start of the first row's readout, which is the end of its exposure (Raspberry Pi's
    receivers stamp the start of a frame on the wire), or the start of its exposure, as libcamera's document says."""

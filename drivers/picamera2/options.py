"""Options of the driver `picamera2`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from slrig.bundle.validation import Strict

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

    time_stamp: Literal["readout", "exposure"] = "readout"
    """Meaning of a time stamp: the start of the first row's readout, which is the end of its exposure (Raspberry Pi's
    receivers stamp the start of a frame on the wire), or the start of its exposure, as in libcamera's documentation."""

"""What a rig file says of any display output."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from slrig.bundle.validation import Strict
from slrig.model import Size

Extent = Annotated[int, Field(ge=1, le=65_535)]
Seconds = Annotated[float, Field(ge=0, le=5)]

UNMEASURED_S = 0.05
"""How late the light of a display is that nobody has measured, ± as much: none of the usual projectors is later."""


class DisplayOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[projector]` table that all drivers of display outputs take."""

    output: Annotated[str, Field(min_length=1, max_length=100, json_schema_extra={"takes": "device"})]
    """The connector, as `slrig devices` names it."""

    native_px: Annotated[tuple[Extent, Extent], Field(strict=False)] | None = None
    """[width, height] of the projector's own raster (its data sheet's "native resolution"), where its EDID prefers
    another size, or none."""

    monitor: Annotated[str, Field(min_length=1)] | None = None
    """The display that must be at that connector, as `slrig devices` calls it; else any is taken."""

    latency_s: Seconds | None = None
    """From the signal of a picture's last row to its light: the display's own delay, as measured. Until then it is
    taken to be 0.05 s, ± as much."""

    latency_error_s: Seconds | None = None
    """± what it varies; else half a refresh."""

    check_pixels: bool = True
    """Whether one picture of each sequence is read back from the frame buffer and compared."""

    dark_after_s: Annotated[float, Field(ge=0, le=86_400)] = 600.0
    """For how long the output is kept black after the process that had opened it ended, however it did."""

    @property
    def native(self) -> Size | None:
        """The projector's own raster, if it is told."""
        return None if self.native_px is None else Size(*self.native_px)

"""Options of the driver `kms`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from drivers.display.projector import DisplayOptions


class KmsOptions(DisplayOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "kms"`. `output` as the kernel names it (HDMI-A-1, DP-2)."""

    refresh_hz: Annotated[float, Field(ge=1, le=1000, json_schema_extra={"unit": "Hz"})] | None = None
    """Pictures per second, within 0.5; else the rate that the display prefers at that size."""

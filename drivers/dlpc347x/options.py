"""Options of a light engine with a DLPC347x in the rig file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from drivers.dlpc347x.bus import ADDRESS
from drivers.pattern_engine.options import LightOptions


class Dlpc347xEngineOptions(LightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc347x"`."""

    device: Annotated[str, Field(pattern="^/")]
    """Bus of the engine, as /dev/i2c-1. It is required, because a bus cannot be searched safely."""

    led: Literal["white", "red", "green", "blue"] = "white"
    """LEDs that light the patterns: white is one after the other within a pattern, and takes at least 0.6 ms."""

    address: Annotated[int, Field(ge=0x08, le=0x77)] = ADDRESS
    """The engine's 7-bit address on the bus. TI's guides include the direction bit: 36h is 27 here."""

    mirror_columns: bool = False
    """Mirror the columns of patterns in the flash, if column 0 is lit on the wrong side."""

    mirror_rows: bool = False
    """The same for rows."""

    start_s: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Longest time from the command to start until a shown pattern is lit. Not documented; `slrig latency`
    measures it."""

    trigger_delay_us: Annotated[int, Field(ge=0, le=7600)] = 0
    """Delay of TRIG_OUT_2 after the light."""

"""What a rig file says of a light engine with a DLPC347x."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from drivers.dlpc347x.bus import ADDRESS
from drivers.pattern_engine.options import LightOptions


class Dlpc347xEngineOptions(LightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc347x"`."""

    device: Annotated[str, Field(pattern="^/")]
    """The bus that the engine is on, as /dev/i2c-1. It is not searched for: a bus cannot be asked what is on it."""

    led: Literal["white", "red", "green", "blue"] = "white"
    """The LEDs that patterns are lit with: white is one after the other within a pattern, and takes 0.6 ms at least."""

    address: Annotated[int, Field(ge=0x08, le=0x77)] = ADDRESS
    """The engine's address on the bus, of 7 bits. TI's guides count the direction's bit in: 36h is 27 here."""

    mirror_columns: bool = False
    """Write patterns into the flash with the columns the other way round: where column 0 is lit on the wrong side."""

    mirror_rows: bool = False
    """The same for rows."""

    start_s: Annotated[float, Field(ge=0, le=1)] = 0.05
    """From the command to start until a shown pattern is lit, at the most. No document states it; `slrig latency`
    measures it."""

    trigger_delay_us: Annotated[int, Field(ge=0, le=7600)] = 0
    """How much later than the light TRIG_OUT_2 changes."""

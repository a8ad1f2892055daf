"""Options of a light engine with a DLPC900 in the rig file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from drivers.dlpc900.engine import TRIGGER_DELAY_RANGE_US
from drivers.pattern_engine.options import UsbLightOptions


class Dlpc900EngineOptions(UsbLightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc900"`."""

    start_s: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Longest time from the engine's report that its sequencer runs until a shown pattern is lit. Not documented;
    `slrig latency` measures it."""

    trigger_delay_us: Annotated[int, Field(ge=TRIGGER_DELAY_RANGE_US[0], le=TRIGGER_DELAY_RANGE_US[1])] = 0
    """Delay of TRIG_OUT_1 after the light."""

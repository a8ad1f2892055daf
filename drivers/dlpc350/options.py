"""What a rig file says of a light engine with a DLPC350."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from drivers.pattern_engine.options import UsbLightOptions


class Dlpc350EngineOptions(UsbLightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc350"`."""

    patterns: Annotated[str, Field(min_length=1)]
    """A folder with the list of the pictures in the engine's flash (`images.json`) and these pictures, from the rig
    file's own. There need not be one yet: a scan then writes the pictures that it lacks into `to_flash` there."""

    led_current_inverted: bool | None = None
    """True where 255 switches an LED off and 0 gives it the most current, with the polarity register at "normal": so
    TI's own program for the LightCrafter 4500 has it; false on boards that are built as the manual says. `slrig doctor`
    finds it out. Until it is written here, light is 5 % of the board's most at the most, on average and whichever it
    is, and sequences are not played."""

    image_load_s: Annotated[float, Field(ge=0, le=1)] = 0.2
    """From the command to start until light, at the most, where the engine loads a picture from its flash: TI's worst
    case; TI's program tells that of each picture ("Image Load Time")."""

    image_kept_s: Annotated[float, Field(ge=0, le=1)] | None = None
    """The same where the pattern before was in the same picture. Absent: as long as image_load_s, since no document
    says that the engine does not load it again; `slrig latency`, which flashes two patterns of one picture, tells."""

    trigger_delay_us: Annotated[float, Field(ge=-20.05, le=2.78)] = 0.0
    """How much later than the light TRIG_OUT_1 changes."""

    standby: bool = False
    """Put the engine into standby when it is closed; it is woken when opened, in any case."""

    def load_s(self, *, kept: bool) -> float:
        """From the command to start until light, at the most. kept : the picture is that of the pattern before."""
        return self.image_kept_s if kept and self.image_kept_s is not None else self.image_load_s

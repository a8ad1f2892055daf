"""Options of a light engine with a DLPC350 in the rig file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from drivers.pattern_engine.options import UsbLightOptions


class Dlpc350EngineOptions(UsbLightOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "dlpc350"`."""

    patterns: Annotated[str, Field(min_length=1)]
    """Folder with the list of the pictures in the engine's flash (`images.json`) and these pictures, relative to the
    rig file's folder. It need not exist: a scan then writes the missing pictures into its folder `to_flash`."""

    led_current_inverted: bool | None = None
    """True if 255 switches an LED off and 0 gives it the maximum current, with the polarity register at "normal", as in
    TI's own program for the LightCrafter 4500; false on boards built according to the manual. `slrig doctor` determines
    it. Until it is set, the average light is at most 5 % of the board's maximum for either polarity, and nothing is
    played."""

    image_load_s: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Maximum time from the command to start until light when the engine loads a picture from its flash. Default: TI's
    worst case; TI's program shows it for each picture ("Image Load Time")."""

    image_kept_s: Annotated[float, Field(ge=0, le=1)] | None = None
    """The same if the previous pattern was in the same picture. Default: image_load_s, since no document excludes that
    the engine loads it again; `slrig latency`, which shows two patterns of one picture, measures it."""

    trigger_delay_us: Annotated[float, Field(ge=-20.05, le=2.78)] = 0.0
    """Delay of TRIG_OUT_1 after the light."""

    standby: bool = False
    """Put the engine into standby when it is closed; it is woken when opened."""

    def load_s(self, *, same_picture: bool) -> float:
        """Return the maximum time from start to light. same_picture : the previous pattern is in the same picture."""
        return self.image_kept_s if same_picture and self.image_kept_s is not None else self.image_load_s

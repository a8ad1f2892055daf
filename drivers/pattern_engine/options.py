"""Options for the light of a pattern engine in the rig file."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from slrig.bundle import Strict
from slrig.model import Pattern, Primary

Share = Annotated[float, Field(gt=0, le=1)]


class LedColour(IntEnum):
    """LEDs of a pattern, as in the pattern table: bit 0 red, 1 green, 2 blue."""

    RED = 1
    GREEN = 2
    YELLOW = 3
    BLUE = 4
    MAGENTA = 5
    CYAN = 6
    WHITE = 7


class LightOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[projector]` table common to all pattern engines."""

    device: Annotated[str, Field(min_length=1)] | None = None
    """A name as listed by `slrig devices`, or a path; default: the only engine that is plugged in."""

    led: Literal["white", "red", "green", "blue", "yellow", "cyan", "magenta"] = "white"
    """LEDs that light the patterns."""

    led_current: Share = 0.3
    """Current of these LEDs, as a fraction of the board's maximum."""

    led_current_limit: Share = 0.5
    """Upper limit of led_current."""

    duty_limit: Share = 1.0
    """Largest fraction of the time with light while a sequence is played."""

    hold_s: Annotated[float, Field(ge=2, le=200)] = 30.0
    """A shown pattern is held for this long, and is dark at most 2 s later, also after its host has failed."""

    light_margin_s: Annotated[float, Field(ge=0, le=1)] = 0.0005
    """In a played sequence, the light exceeds the exposure by this time."""

    trigger_polarity: Literal["high", "low"] = "high"
    """Level of the trigger output when the pattern's light begins: "high" rises, "low" falls."""

    @model_validator(mode="after")
    def _check_current(self) -> Self:
        if self.led_current > self.led_current_limit:
            message = (
                f"led_current is {self.led_current:g}, led_current_limit allows {self.led_current_limit:g}; lower the "
                "current, or raise the limit if eyes and LEDs are safe with it"
            )
            raise ValueError(message)
        return self

    @property
    def colour(self) -> LedColour:
        """LEDs that light the patterns."""
        return LedColour[self.led.upper()]

    def led_colour(self, pattern: Pattern) -> LedColour:
        """Return the LEDs of a pattern."""
        return LedColour[pattern.colour.upper()] if isinstance(pattern, Primary) else self.colour


class UsbLightOptions(LightOptions, use_attribute_docstrings=True):
    """The keys common to engines with a USB port."""

    led_current_inverted: bool | None = None
    """True if 255 switches an LED off and 0 gives it the maximum current, with the polarity register at "normal"; false
    on boards built according to TI's guides. `slrig doctor` determines it. Until it is set, led_current is not used:
    the average light is at most 5 % of the board's maximum for either polarity, and nothing is played."""

    @property
    def current_byte(self) -> int:
        """Current in 255ths of the maximum."""
        return round(self.led_current * 255)

"""What a rig file says of the light of a pattern engine."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from slrig.bundle.validation import Strict
from slrig.model import Pattern, Primary

Share = Annotated[float, Field(gt=0, le=1)]


class LedColour(IntEnum):
    """LEDs of a pattern, as the pattern table has them: bit 0 red, 1 green, 2 blue."""

    RED = 1
    GREEN = 2
    YELLOW = 3
    BLUE = 4
    MAGENTA = 5
    CYAN = 6
    WHITE = 7


class LightOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[projector]` table that pattern engines have in common."""

    device: Annotated[str, Field(min_length=1)] | None = None
    """What `slrig devices` lists, or a path; else the only engine that is plugged in."""

    led: Literal["white", "red", "green", "blue", "yellow", "cyan", "magenta"] = "white"
    """The LEDs that patterns are lit with."""

    led_current: Share = 0.3
    """Current of these LEDs, as a share of the board's most."""

    led_current_limit: Share = 0.5
    """No more current than this, whatever led_current says."""

    duty_limit: Share = 1.0
    """Light is on for no more than this share of the time while a sequence is played."""

    hold_s: Annotated[float, Field(ge=2, le=200)] = 30.0
    """A shown pattern is held for this long, and dark 2 s later at the latest; so it is after its host has died."""

    light_margin_s: Annotated[float, Field(ge=0, le=1)] = 0.0005
    """In a played sequence, light lasts this much longer than the exposure."""

    trigger_polarity: Literal["high", "low"] = "high"
    """Which way the trigger output goes as the pattern's light begins: high, it rises; low, it falls."""

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
        """The LEDs that patterns are lit with."""
        return LedColour[self.led.upper()]

    def led_colour(self, pattern: Pattern) -> LedColour:
        """The LEDs that a pattern is lit with."""
        return LedColour[pattern.colour.upper()] if isinstance(pattern, Primary) else self.colour


class UsbLightOptions(LightOptions, use_attribute_docstrings=True):
    """The same, of engines with a USB port."""

    led_current_inverted: bool | None = None
    """True where 255 switches an LED off and 0 gives it the most current, with the polarity register at "normal"; false
    on boards that are built as TI's guides say. `slrig doctor` finds it out. Until it is written here, led_current is
    not used: light is 5 % of the board's most at the most, on average and whichever it is, and nothing is played."""

    @property
    def current_byte(self) -> int:
        """The current in 255ths of the most."""
        return round(self.led_current * 255)

"""Options of the driver `screen`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from drivers.display.projector import DisplayOptions


class ScreenOptions(DisplayOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "screen"`. `output` is named as `xrandr` does (HDMI-1, DP-2)."""

    backend: Literal["auto", "sdl", "x11"] = "auto"
    """x11 presents through X itself, which reports when each picture was flipped; sdl presents through SDL, on every
    system; auto is x11 where there is an X server with the Present extension."""

    trust_compositor: bool = False
    """True to show through a compositor, which may scale, tint or delay pictures."""

    display: Annotated[str, Field(min_length=1)] | None = None
    """The X server, as in DISPLAY; else that of the environment."""

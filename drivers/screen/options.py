"""What a rig file says of a screen."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from drivers.display.options import DisplayOptions


class ScreenOptions(DisplayOptions, use_attribute_docstrings=True):
    """The keys of a `[projector]` table with `driver = "screen"`. `output` is named as `xrandr` does (HDMI-1, DP-2)."""

    backend: Literal["auto", "sdl", "x11"] = "auto"
    """x11 presents through X itself and is told when each picture was flipped; sdl presents through SDL (extra
    `screen`), everywhere; auto is x11 where there is an X server with the Present extension."""

    trust_compositor: bool = False
    """True to show through a compositor, which may scale, tint or delay what it is given."""

    display: Annotated[str, Field(min_length=1)] | None = None
    """The X server, as in DISPLAY; else that of the environment."""

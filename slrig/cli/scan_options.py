"""Options of `slrig scan` alone, as a group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer


@dataclass(frozen=True, slots=True)
class ColourOptions:
    """What the command line says of a scan's colour; None where it says nothing."""

    colour: Annotated[
        bool | None, typer.Option(help="Keep white and black frames in colour. Default: where a camera has it.")
    ] = None
    coloured_light: Annotated[
        bool | None,
        typer.Option(
            help="Play white in red, green and blue too, for cameras without colour. Default: the rig file's."
        ),
    ] = None

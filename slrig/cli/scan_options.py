"""Options of `slrig scan` alone, as a group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """What the command line says of the object and of colour; None where it says nothing."""

    preset: Annotated[str | None, typer.Option(help="Options by name: see slrig preset list.")] = None
    assist: Annotated[
        bool, typer.Option("--assist", help="Look at the object first, and expose as it needs; within --budget-s.")
    ] = False
    budget_s: Annotated[float | None, typer.Option(help="With --assist: the most that capture may take, seconds.")] = (
        None
    )
    colour: Annotated[
        bool | None, typer.Option(help="Keep white and black frames in colour. Default: where a camera has it.")
    ] = None
    coloured_light: Annotated[
        bool | None,
        typer.Option(
            help="Play white in red, green and blue too, for cameras without colour. Default: the rig file's."
        ),
    ] = None

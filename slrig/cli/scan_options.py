"""Options of `slrig scan` alone, as a group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from slrig.cli.options import given


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """What the command line says of the object, of its stage and of colour; None where it says nothing."""

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
    turn_deg: Annotated[
        float | None,
        typer.Option(help="Angle of the turntable that the object is shot at; the rig's turntable turns there first."),
    ] = None
    manual: Annotated[
        bool, typer.Option("--manual", help="With --turn-deg: the object was turned by hand; nothing moves.")
    ] = False

    def asked(self) -> dict[str, Any]:
        """What was given of it, as a request says it."""
        return given(
            preset=self.preset,
            colour=self.colour,
            coloured_light=self.coloured_light,
            turn_deg=self.turn_deg,
            turned_by="hand" if self.manual else None,
        )

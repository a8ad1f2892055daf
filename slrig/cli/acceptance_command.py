"""`slrig accept` and its options. Loads nothing heavy: `slrig --help` reads this file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from slrig.cli.options import AsJson, RigFile, grouped


@dataclass(frozen=True, slots=True)
class Asked:
    """What the command line says of artefacts and limits; None where it says nothing. Lengths in mm."""

    sphere_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--sphere",
            metavar="MM MM",
            help="Certified diameter of the sphere and its expanded uncertainty (k = 2), mm.",
        ),
    ] = None
    bar_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--bar",
            metavar="MM MM",
            help="Certified distance of the ball bar's centres and its expanded uncertainty, mm.",
        ),
    ] = None
    plane_mm: Annotated[
        tuple[float, float] | None, typer.Option("--plane", metavar="MM MM", help="Length and width of the plane, mm.")
    ] = None
    ball_mm: Annotated[float | None, typer.Option(help="Diameter of the bar's balls. Default: the sphere's.")] = None
    sphere_form_mm: Annotated[
        float | None, typer.Option(help="By how much the sphere itself is out of round, from its certificate.")
    ] = None
    plane_form_mm: Annotated[
        float | None, typer.Option(help="By how much the plane itself is out of flat, from its certificate.")
    ] = None
    volume_mm: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--volume",
            metavar="X Y Z X Y Z",
            help="Working volume in the world: x y z of its least corner, then of its greatest, mm. "
            "Default: that of the calibration.",
        ),
    ] = None
    spacing_limit_mm: Annotated[
        float | None, typer.Option(help="Limit of sphere spacing. Default: 1/10000 of the volume's diagonal.")
    ] = None
    form_limit_mm: Annotated[
        float | None, typer.Option(help="Limit of probing form. Default: 6.5 standard deviations of a point.")
    ] = None
    size_limit_mm: Annotated[float | None, typer.Option(help="Limit of probing size. Default: as of form.")] = None
    flatness_limit_mm: Annotated[float | None, typer.Option(help="Limit of flatness. Default: as of form.")] = None
    repeats: Annotated[
        int, typer.Option(min=1, max=50, help="Captures of the first position of each artefact, for the scatter.")
    ] = 3
    exposure_s: Annotated[float | None, typer.Option(help="Exposure of every camera. Default: the rig file's.")] = None
    certificate: Annotated[str, typer.Option(help="Numbers of the artefacts' certificates, for the report.")] = ""
    temperature_c: Annotated[float | None, typer.Option(help="Temperature of the room, for the report.")] = None
    notes: Annotated[str, typer.Option(help="Free text for the report.")] = ""


@grouped
def accept(
    *,
    rig: RigFile,
    output: Annotated[Path, typer.Option(help="New folder for report.html, report.json and the points.")],
    scripted: Annotated[
        bool, typer.Option("--scripted", help="The rig's positioner places the artefacts; a rendered rig always can.")
    ] = False,
    asked: Asked,
    as_json: AsJson = False,
) -> None:
    """Test a rig with a sphere, a ball bar and a plane.

    In the manner of VDI/VDE 2634-2. Exit code 1 unless it passes.
    """
    from slrig.cli.accept import accept as test

    if not test(rig, asked, output=output, scripted=scripted, as_json=as_json):
        raise typer.Exit(1)

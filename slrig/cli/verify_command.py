"""The options of `slrig verify`. Light: what does the work is loaded when it is called."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slrig.cli.calibrate import Corners, Dictionary, Kind, MarkerMm, SquareMm, chosen_board
from slrig.cli.options import AsJson


def verify(
    source: Annotated[
        Path,
        typer.Argument(metavar="SOURCE", help="A recorded pose of the board, a bundle; or a rig file to shoot one."),
    ],
    kind: Kind = None,
    corners: Corners = None,
    square_mm: SquareMm = None,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration to verify. Default: the bundle's, or the rig file's.")
    ] = None,
    position: Annotated[int | None, typer.Option(min=0, help="Pose of the rig's positioner, by number.")] = None,
    as_json: AsJson = False,
) -> None:
    """Look at the board once: does the calibration still hold?

    Exit code 1 if it is stale.
    """
    from slrig.cli.verify import verify as look

    board = chosen_board(kind, corners, square_mm, marker_mm, dictionary)
    if not look(source, board, calibration, position=position, as_json=as_json):
        raise typer.Exit(1)

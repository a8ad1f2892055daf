"""`slrig calibrate board`: a calibration board to print."""

from __future__ import annotations

from pathlib import Path

import typer

from slrig.bundle.storage import refusals_of, write_file
from slrig.calibration.board import Board
from slrig.errors import CalibrationError


def write_board(board: Board, output: Path, *, page: str) -> None:
    """Write the page with the board as PDF or SVG, by the name of the file, and say how to use it.

    Raises
    ------
    CalibrationError
        The file's name ends in neither .pdf nor .svg, or the board does not fit on the page.
    StorageError
        The file cannot be written.
    """
    from slrig.calibration.boards.printing import board_pdf, board_svg, solve_command

    kind = output.suffix.lower()
    if kind not in (".pdf", ".svg"):
        message = f"--output: expected a name that ends in .pdf or .svg, found {output}"
        raise CalibrationError(message)
    content = board_pdf(board, page=page) if kind == ".pdf" else board_svg(board, page=page).encode()
    with refusals_of(output.parent):
        output.parent.mkdir(parents=True, exist_ok=True)
    write_file(output, content)
    typer.echo(f"written   {output}: {board.description}")
    typer.echo("Print it at 100 % (actual size), glue it on something flat and stiff, and check both of its scales.")
    typer.echo(f"Then:     {solve_command(board)}")

"""Calibration boards: the one that a command's options describe, and the page to print of `slrig calibrate board`."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import typer

from slrig.bundle import write_file
from slrig.calibration import DEFAULT_BOARD, Board, BoardKind
from slrig.cli.options import BoardArguments
from slrig.disk import storage_errors
from slrig.errors import CalibrationError


def chosen_board(asked: BoardArguments) -> Board:
    """The board that a command's options describe; without any, the usual one, which is then told on stderr.

    The usual board may be named in part, so that a print that measures 11.94 mm is `--square-mm 11.94`. Any other board
    is named whole: a square's side that is guessed would scale every scan.

    Raises
    ------
    CalibrationError
        The options describe no board, or another than the usual one and not the whole of it.
    """
    needed = {"--board": asked.kind, "--corners": asked.corners, "--square-mm": asked.square_mm}
    missing = [name for name, value in needed.items() if value is None]
    if not missing:
        return _as_printed(
            board_option(
                str(asked.kind), str(asked.corners), float(asked.square_mm or 0), asked.marker_mm, asked.dictionary
            ),
            asked,
        )
    usual = (DEFAULT_BOARD.columns, DEFAULT_BOARD.rows)
    if asked.kind not in (None, DEFAULT_BOARD.kind) or (asked.corners is not None and _counted(asked.corners) != usual):
        message = (
            f"Which board? Missing: {', '.join(missing)}. Name all of it, as --board chessboard --corners 9x6 "
            f"--square-mm 20, or nothing for the usual one: {DEFAULT_BOARD.description}"
        )
        raise CalibrationError(message)
    square_mm = DEFAULT_BOARD.square_mm if asked.square_mm is None else asked.square_mm
    corners = f"{DEFAULT_BOARD.columns}x{DEFAULT_BOARD.rows}"
    board = _as_printed(board_option(DEFAULT_BOARD.kind, corners, square_mm, asked.marker_mm, asked.dictionary), asked)
    typer.echo(f"board     {board.description} (--board, --corners and --square-mm name another)", err=True)
    return board


def _as_printed(board: Board, asked: BoardArguments) -> Board:
    """The board with what was said of the size of its print."""
    if asked.square_sigma is not None:
        board = replace(board, square_sigma=asked.square_sigma)
    return (
        board if asked.measured_mm is None else board.as_measured(*asked.measured_mm, square_sigma=asked.square_sigma)
    )


def board_option(
    kind: str, corners: str, square_mm: float, marker_mm: float | None = None, dictionary: str | None = None
) -> Board:
    """The board of a command's options. kind : of `BoardKind`; corners : COLUMNSxROWS, `11x8`.

    Raises
    ------
    CalibrationError
        The options describe no board, with all that is wrong, or one that OpenCV has no markers for.
    """
    faults = []
    counted = _counted(corners)
    if counted is None:
        faults.append(
            f"--corners: expected COLUMNSxROWS, 11x8 for one (inner corners, where four squares meet; of circles those "
            f"in a row, then rows), found {corners!r}"
        )
    if not square_mm > 0:
        faults.append(f"--square-mm: expected a length in mm, found {square_mm:g}")
    if faults or counted is None:
        raise CalibrationError("; ".join(faults))
    board = Board(BoardKind(kind), *counted, square_mm, marker_mm, dictionary)
    if board.kind is BoardKind.CHARUCO:
        # OpenCV knows whether there is such a dictionary, with markers enough. Late, for it takes a while to load.
        from slrig.calibration.printing import charuco_board

        charuco_board(board)
    return board


def _counted(corners: str) -> tuple[int, int] | None:
    """Columns and rows of `11x8`; None where the text is none such."""
    found = re.fullmatch(r"\s*(\d{1,4})\s*[xX×]\s*(\d{1,4})\s*", corners)
    return None if found is None else (int(found[1]), int(found[2]))


def write_board(board: Board, output: Path, *, page: str) -> None:
    """Write the page with the board as PDF or SVG, by the name of the file, and say how to use it.

    Raises
    ------
    CalibrationError
        The file's name ends in neither .pdf nor .svg, or the board does not fit on the page.
    StorageError
        The file cannot be written.
    """
    from slrig.calibration.printing import board_pdf, board_svg, solve_command

    kind = output.suffix.lower()
    if kind not in (".pdf", ".svg"):
        message = f"--output: expected a name that ends in .pdf or .svg, found {output}"
        raise CalibrationError(message)
    content = board_pdf(board, page=page) if kind == ".pdf" else board_svg(board, page=page).encode()
    with storage_errors(output.parent):
        output.parent.mkdir(parents=True, exist_ok=True)
    write_file(output, content)
    typer.echo(f"written   {output}: {board.description}")
    typer.echo("Print it at 100 % (actual size), glue it on something flat and stiff, and check both of its scales.")
    typer.echo(f"Then:     {solve_command(board)}")

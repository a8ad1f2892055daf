"""The board that a command is told of: --board, --corners, --square-mm, --marker-mm, --dictionary."""

from __future__ import annotations

import re

import typer

from slrig.calibration.board import USUAL_BOARD, Board, BoardKind
from slrig.errors import CalibrationError


def chosen_board(
    kind: str | None,
    corners: str | None,
    square_mm: float | None,
    marker_mm: float | None,
    dictionary: str | None,
) -> Board:
    """The board that a command's options describe; without any, the usual one, which is then told on stderr.

    The usual board may be named in part, so that a print that measures 11.94 mm is `--square-mm 11.94`. Any other board
    is named whole: a square's side that is guessed would scale every scan.

    Raises
    ------
    CalibrationError
        The options describe no board, or another than the usual one and not the whole of it.
    """
    if kind is not None and corners is not None and square_mm is not None:
        return board_option(kind, corners, square_mm, marker_mm, dictionary)
    usual = (USUAL_BOARD.columns, USUAL_BOARD.rows)
    if kind not in (None, USUAL_BOARD.kind) or (corners is not None and _counted(corners) != usual):
        given = {"--board": kind, "--corners": corners, "--square-mm": square_mm}
        missing = ", ".join(name for name, value in given.items() if value is None)
        message = (
            f"Which board? Missing: {missing}. Name all of it, as --board chessboard --corners 9x6 --square-mm 20, or "
            f"nothing for the usual one: {USUAL_BOARD.description}"
        )
        raise CalibrationError(message)
    square_mm = USUAL_BOARD.square_mm if square_mm is None else square_mm
    board = board_option(str(USUAL_BOARD.kind), f"{usual[0]}x{usual[1]}", square_mm, marker_mm, dictionary)
    typer.echo(f"board     {board.description} (--board, --corners and --square-mm name another)", err=True)
    return board


def board_option(
    kind: str,
    corners: str,
    square_mm: float,
    marker_mm: float | None = None,
    dictionary: str | None = None,
) -> Board:
    """The board of a command's options.

    kind : charuco, chessboard or circles; corners : COLUMNSxROWS, `11x8`. All that is wrong is in one message.

    Raises
    ------
    CalibrationError
        The options describe no board, or one that OpenCV has no markers for.
    """
    faults = []
    known = [each.value for each in BoardKind]
    if kind not in known:
        faults.append(f"--board: expected {', '.join(known[:-1])} or {known[-1]}, found {kind!r}")
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
        from slrig.calibration.boards.artwork import charuco_board

        charuco_board(board)
    return board


def _counted(corners: str) -> tuple[int, int] | None:
    """Columns and rows of `11x8`; None where the text is none such."""
    found = re.fullmatch(r"\s*(\d{1,4})\s*[xX×]\s*(\d{1,4})\s*", corners)
    return None if found is None else (int(found[1]), int(found[2]))

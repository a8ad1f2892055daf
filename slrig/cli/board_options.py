"""The board that a command is told of: --board, --corners, --square-mm, --marker-mm, --dictionary."""

from __future__ import annotations

import re

from slrig.calibration.board import Board, BoardKind
from slrig.errors import CalibrationError


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
    given = re.fullmatch(r"\s*(\d{1,4})\s*[xX×]\s*(\d{1,4})\s*", corners)
    if given is None:
        faults.append(
            f"--corners: expected COLUMNSxROWS, 11x8 for one (inner corners, where four squares meet; of circles those "
            f"in a row, then rows), found {corners!r}"
        )
    if not square_mm > 0:
        faults.append(f"--square-mm: expected a length in mm, found {square_mm:g}")
    if faults or given is None:
        raise CalibrationError("; ".join(faults))
    board = Board(BoardKind(kind), int(given[1]), int(given[2]), square_mm, marker_mm, dictionary)
    if board.kind is BoardKind.CHARUCO:
        # OpenCV knows whether there is such a dictionary, with markers enough. Late, for it takes a while to load.
        from slrig.calibration.boards.artwork import charuco_board

        charuco_board(board)
    return board

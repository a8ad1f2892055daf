"""What a schedule may say of its task: checked when the schedule is made, so that no run fails for a misspelt word."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import Field, ValidationError

from slrig.accept.asking import AcceptanceRequest
from slrig.bundle.faults import Strict, explain, keys_of
from slrig.calibration.board import Board, BoardKind
from slrig.errors import CalibrationError, ScheduleError

ExposureSeconds = Annotated[float, Field(gt=0, le=60)]
Position = Annotated[int, Field(ge=0, le=10_000)]


class BoardOptions(Strict):
    """The board, as POST /calibration has it."""

    kind: Annotated[BoardKind, Field(strict=False)]
    corners: Annotated[list[int], Field(min_length=2, max_length=2)]
    square_mm: float
    marker_mm: float | None = None
    dictionary: str | None = None

    def board(self) -> Board:
        """The board that is meant. Raises CalibrationError."""
        columns, rows = self.corners
        return Board(self.kind, columns, rows, self.square_mm, self.marker_mm, self.dictionary)


class VerificationOptions(Strict):
    """Of a verification. board None : that of the calibration in use. position None : the board stays where it is."""

    board: BoardOptions | None = None
    position: Position | None = None
    exposure_s: ExposureSeconds | None = None


class CalibrationOptions(Strict):
    """Of a full set of poses with its solve. positions none : all of them. activate : have scans use what came of it,
    unless its verdict is not to use it.
    """

    board: BoardOptions
    positions: Annotated[list[Position | str], Field(max_length=1000)] = Field(default_factory=list)
    exposure_s: ExposureSeconds | None = None
    activate: bool = False


Options = TypeVar("Options", VerificationOptions, CalibrationOptions, AcceptanceRequest)


def checked(model: type[Options], given: Mapping[str, Any], *, task: str) -> Options:
    """The options of a task.

    Raises
    ------
    ScheduleError
        One is unknown or wrong: all faults in one message, and the options that there are.
    """
    there_are = f"options of {task} are: {', '.join(model.model_fields)}"
    try:
        options = model.model_validate(dict(given))
    except ValidationError as error:
        faults = "; ".join(line.strip() for line in explain(error, dict(given), keys_of(model)).splitlines())
        message = f"options: {faults}. The {there_are}"
        raise ScheduleError(message) from error
    board = getattr(options, "board", None)
    if isinstance(board, BoardOptions):
        try:
            board.board()
        except CalibrationError as error:
            message = f"options: {error}"
            raise ScheduleError(message) from error
    return options

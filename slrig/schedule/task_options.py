"""What a schedule may say of its task: checked when the schedule is made, so that no run fails for a misspelt word."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeVar

from pydantic import Field, ValidationError

from slrig.bundle import FreeText, Strict, describe_errors, model_keys
from slrig.calibration import PRINT_SIGMA, Board, BoardKind
from slrig.errors import ScheduleError
from slrig.rig.session import RigFacts

ExposureSeconds = Annotated[float, Field(gt=0, le=60)]
Position = Annotated[int, Field(ge=0, le=10_000)]


class ScheduledBoard(Strict):
    """The board, as POST /calibration has it."""

    kind: Annotated[BoardKind, Field(strict=False)]
    corners: Annotated[list[int], Field(min_length=2, max_length=2)]
    square_mm: float
    marker_mm: float | None = None
    dictionary: str | None = None
    square_sigma: Annotated[float, Field(gt=0, le=0.05)] | None = None
    aspect: Annotated[float, Field(gt=0.9, lt=1.1)] = 1.0
    measured_mm: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None

    def board(self) -> Board:
        """The board that is meant. Raises CalibrationError."""
        columns, rows = self.corners
        sigma = PRINT_SIGMA if self.square_sigma is None else self.square_sigma
        board = Board(
            self.kind, columns, rows, self.square_mm, self.marker_mm, self.dictionary, sigma, self.aspect
        )  # fmt: skip
        return (
            board if self.measured_mm is None else board.as_measured(*self.measured_mm, square_sigma=self.square_sigma)
        )


class VerificationOptions(Strict):
    """Of a verification. board None : that of the calibration in use. position None : the board stays where it is."""

    board: ScheduledBoard | None = None
    position: Position | None = None
    exposure_s: ExposureSeconds | None = None


class CalibrationOptions(Strict):
    """Of a full set of poses with its solve. positions none : all of them. activate : have scans use what came of it,
    unless its verdict leaves that to a person.
    """

    board: ScheduledBoard
    positions: Annotated[list[Position | FreeText], Field(max_length=1000)] = Field(default_factory=list)
    exposure_s: ExposureSeconds | None = None
    activate: bool = False


Options = TypeVar("Options", bound=Strict)


def checked(model: type[Options], given: Mapping[str, Any], *, task: str) -> Options:
    """The options of a task.

    Raises
    ------
    ScheduleError
        One is unknown or wrong: all faults in one message, and the options that there are.
    """
    try:
        return model.model_validate(dict(given))
    except ValidationError as error:
        faults = "; ".join(line.strip() for line in describe_errors(error, dict(given), model_keys(model)).splitlines())
        message = f"options: {faults}. The options of {task} are: {', '.join(model.model_fields)}"
        raise ScheduleError(message) from error


def require_positions(facts: RigFacts | None, asked: Sequence[int | str]) -> None:
    """Refuse work that needs a positioner where the rig has none, or not those positions.

    facts None : the rig is not open, and nobody knows; a run is refused then. asked : by number from 0 or by name.

    Raises
    ------
    ScheduleError
        No run could be done with this rig.
    """
    if facts is None:
        return
    names = facts.positions
    if not names:
        message = (
            "this rig has no positioner, and nobody is there to move anything when a schedule is due: schedule a "
            "verification of a board that stays in view, and calibrate or test by hand (slrig calibrate run, slrig "
            "accept)"
        )
        raise ScheduleError(message)
    missing = [each for each in asked if each not in names and each not in range(len(names))]
    if missing:
        message = (
            f"options: this rig's positioner has no {', '.join(map(repr, missing))}; it has 0 to {len(names) - 1}: "
            f"{', '.join(names)}"
        )
        raise ScheduleError(message)

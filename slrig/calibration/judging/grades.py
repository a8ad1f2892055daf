"""Good, usable, or not to be used: grades, the limits of figures, and what one of them is told with."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class Grade(StrEnum):
    """What to do with a calibration."""

    GOOD = "good"
    USABLE = "usable"
    DO_NOT_USE = "do_not_use"

    @property
    def words(self) -> str:
        """As a sentence has it."""
        return "do not use" if self is Grade.DO_NOT_USE else str(self.value)

    @property
    def badness(self) -> int:
        """For sorting: the worst has the most."""
        return list(Grade).index(self)


@dataclass(frozen=True, slots=True)
class Limit:
    """Up to `good` nothing is said of a figure, beyond it a remark is made. Beyond `most` the calibration is not to be
    used: the figure says that what is stated in millimetres cannot be believed. most is infinite where all that the
    figure does is in the millimetres already. source : where the numbers come from.
    """

    good: float
    most: float
    source: str

    def grade(self, value: float) -> Grade:
        """Return what a figure makes of the calibration. One that is NaN, not measured, leaves it usable."""
        if np.isnan(value):
            return Grade.USABLE
        return Grade.GOOD if value <= self.most else Grade.DO_NOT_USE


@dataclass(frozen=True, slots=True)
class Judgement:
    """One thing that was judged. figure : its name in `slrig.calibration.judging.verdict.LIMITS`, "error", "poses",
    "scale", "stretch" or "odd_even"; device : which one, None for all together. words : what was found, what is usual,
    and what to do. remarkable : worth a person's look, though the grade is good.
    """

    grade: Grade
    figure: str
    device: str | None
    value: float
    words: str
    remarkable: bool = False

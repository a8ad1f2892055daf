"""What an examination found: a result per check, and a score."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from slrig.conformance.expectation import Failure


class Outcome(StrEnum):
    """How a check ended. Not run: the examination was stopped before; it counts against the rig."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"
    NOT_RUN = "not run"


@dataclass(frozen=True, slots=True)
class Result:
    """One check's outcome. `failure` says what is wrong; `reason` why it does not apply or was not run."""

    name: str
    title: str
    outcome: Outcome
    seconds: float
    failure: Failure | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """Every check's result, in order, and how long all took. `stopped` says why the examination ended early, if so."""

    rig: str
    results: tuple[Result, ...]
    seconds: float
    stopped: str | None = None

    def count(self, outcome: Outcome) -> int:
        """How many checks ended so."""
        return sum(result.outcome is outcome for result in self.results)

    @property
    def applicable(self) -> int:
        """How many checks ask something of this rig."""
        return len(self.results) - self.count(Outcome.NOT_APPLICABLE)

    @property
    def score(self) -> float:
        """Passed checks over applicable ones, 0 to 1."""
        return self.count(Outcome.PASSED) / self.applicable if self.applicable else 0.0

    @property
    def percent(self) -> int:
        """The score in whole percent, rounded down: 100 only if every check that applies has passed."""
        return math.floor(100 * self.score)

    @property
    def conforms(self) -> bool:
        """Whether every check that applies has passed."""
        return self.applicable > 0 and self.count(Outcome.PASSED) == self.applicable

    def document(self) -> dict[str, Any]:
        """The report as JSON can hold it."""
        return {
            "rig": self.rig,
            "conforms": self.conforms,
            "score": self.score,
            "passed": self.count(Outcome.PASSED),
            "applicable": self.applicable,
            "seconds": self.seconds,
            "stopped": self.stopped,
            "checks": [asdict(result) for result in self.results],
        }

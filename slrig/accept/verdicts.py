"""What an acceptance test comes to: the verdict on each quantity, and the result of the whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from slrig.accept.evaluation import Reading, errors_by_step
from slrig.accept.plan import AcceptancePlan, Quantity
from slrig.accept.scale import Scale, scale_by_bar
from slrig.accept.uncertainty import ErrorUncertainty, error_uncertainty
from slrig.calibration import Decision, decide
from slrig.model import Calibration


@dataclass(frozen=True, slots=True)
class QuantityVerdict:
    """One quantity over all positions. error_mm : of the reading with the largest, which is that of `step`, `take`.
    scatter_mm : the standard deviation of repeated captures, NaN where none were made; repeats : captures that tell it.
    It is told and decides nothing: the rig's own scatter is in its errors.
    """

    quantity: Quantity
    error_mm: float
    limit_mm: float
    step: str
    take: int
    uncertainty: ErrorUncertainty
    scatter_mm: float
    repeats: int
    decision: Decision


@dataclass(frozen=True, slots=True)
class AcceptanceResult:
    """A test that was done. readings : every capture in order. verdicts : by quantity."""

    rig: str
    begun: datetime
    ended: datetime
    plan: AcceptancePlan
    calibration: Calibration
    readings: tuple[Reading, ...]
    verdicts: tuple[QuantityVerdict, ...]

    @property
    def decision(self) -> Decision:
        """Fails if any quantity fails, passes if all pass."""
        told = {verdict.decision for verdict in self.verdicts}
        for worst in (Decision.FAILS, Decision.UNDECIDED):
            if worst in told:
                return worst
        return Decision.PASSES

    @property
    def scale(self) -> Scale | None:
        """Whether everything measures too long or too short; None where the bar was not measured, or in few places."""
        return scale_by_bar(self.readings, self.plan.artefacts)

    @property
    def complete(self) -> bool:
        """Whether every position was measured as often as planned."""
        return len(self.readings) == len(self.plan.takes)


def verdicts(readings: Sequence[Reading], plan: AcceptancePlan) -> tuple[QuantityVerdict, ...]:
    """What is decided of each quantity that was measured."""
    told = {quantity for each in readings for quantity in each.errors_mm}
    return tuple(_verdict(quantity, readings, plan) for quantity in Quantity if quantity in told)


def _verdict(quantity: Quantity, readings: Sequence[Reading], plan: AcceptancePlan) -> QuantityVerdict:
    having = [each for each in readings if quantity in each.errors_mm]
    worst = max(having, key=lambda each: abs(each.errors_mm[quantity]))
    error, limit = worst.errors_mm[quantity], plan.limits.limit_mm(quantity)
    uncertainty = error_uncertainty(quantity, plan.artefacts)
    return QuantityVerdict(
        quantity, error, limit, worst.step, worst.take, uncertainty, *_scatter(quantity, having),
        decide(error, limit, uncertainty.expanded_mm),
    )  # fmt: skip


def _scatter(quantity: Quantity, readings: Sequence[Reading]) -> tuple[float, int]:
    """Standard deviation of repeated captures of one position, mm, and how many they were; NaN and 0 without any."""
    repeated = [np.array(errors) for errors in errors_by_step(readings, quantity).values() if len(errors) > 1]
    if not repeated:
        return float("nan"), 0
    count = sum(len(errors) for errors in repeated)
    squares = sum(float(((errors - errors.mean()) ** 2).sum()) for errors in repeated)
    return float(np.sqrt(squares / (count - len(repeated)))), count

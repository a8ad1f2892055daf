"""The scheduled acceptance test: every prescribed position measured by the rig's positioner, and the decision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from slrig.model import Calibration
from slrig.scan.faults import fault_of
from slrig.scan.work import Holder
from slrig.scheduling.naming import NamedLender
from slrig.scheduling.task_options import AcceptanceOptions, ArtefactOptions, checked
from slrig.scheduling.waiting import error_of, until
from slrig.sessions.acceptance_desk import AcceptanceDesk, AcceptanceState
from slrig.sessions.acceptance_plan import (
    AcceptancePlan,
    Artefacts,
    Certified,
    Limits,
    exact_artefacts,
    usual_limits,
)
from slrig.sessions.acceptance_positions import acceptance_plan, rig_volume_mm


class AcceptanceTask:
    """Implements `slrig.scheduling.tasks.Task`. The rig is held for the whole of the test."""

    def __init__(self, lender: NamedLender, desk: AcceptanceDesk) -> None:
        self._lender = lender
        self._desk = desk

    def check(self, options: Mapping[str, Any], /) -> None:
        """See `Task`."""
        _options(options)

    def do(self, holder: Holder, options: Mapping[str, Any], /, *, cancelled: Callable[[], bool]) -> Mapping[str, Any]:
        """See `Task`. A rig that fails the test is a run that succeeded."""
        asked = _options(options)
        test = self._desk.open(lambda calibration: plan_of(asked, calibration)).id
        try:
            with self._lender.named(holder):
                self._desk.measure(test, wait=False, scripted=True)
        except BaseException:
            self._desk.cancel(test)
            raise
        until(
            lambda: self._desk.get(test).state is not AcceptanceState.MEASURING,
            cancelled,
            cancel=lambda: self._desk.cancel(test),
        )
        record = self._desk.get(test)
        if record.result is None:
            self._desk.cancel(test)
            raise error_of(fault_of(record.error or RuntimeError("the test ended without a result")))
        return {
            "acceptance": str(test),
            "decision": str(record.result.decision),
            "quantities": {
                str(each.quantity): {
                    "error_mm": each.error_mm,
                    "limit_mm": each.limit_mm,
                    "uncertainty_mm": each.uncertainty_mm,
                    "position": each.step,
                    "decision": str(each.decision),
                }
                for each in record.result.verdicts
            },
        }


def plan_of(asked: AcceptanceOptions, calibration: Calibration) -> AcceptancePlan:
    """The test that the options ask for. Raises InvalidInputError."""
    volume = rig_volume_mm(calibration) if asked.volume_mm is None else np.array(asked.volume_mm, dtype=np.float64)
    rendered, limits = asked.artefacts is None, asked.limits
    usual_mm = usual_limits(volume, rendered=rendered).spacing_mm
    return acceptance_plan(
        calibration,
        volume,
        exact_artefacts(volume) if asked.artefacts is None else _artefacts(asked.artefacts),
        rendered=rendered,
        limits=Limits(limits.spacing_mm or usual_mm, limits.form_mm, limits.size_mm, limits.flatness_mm),
        repeats=asked.repeats,
        exposure_s=asked.exposure_s,
        notes=asked.notes,
    )


def _artefacts(given: ArtefactOptions) -> Artefacts:
    return Artefacts(
        Certified(given.sphere.value_mm, given.sphere.uncertainty_mm),
        Certified(given.bar.value_mm, given.bar.uncertainty_mm),
        given.plane_mm,
        given.ball_mm,
        given.sphere_form_mm,
        given.plane_form_mm,
        given.certificate,
        given.temperature_c,
    )


def _options(given: Mapping[str, Any]) -> AcceptanceOptions:
    return checked(AcceptanceOptions, given, task="acceptance")

"""An acceptance test as one page of HTML, and as JSON for machines: the decision first, then what it stands on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from slrig.accept.charts import error_map, volume_view
from slrig.accept.evaluation import BORDER_RINGS, Evidence, Reading
from slrig.accept.plan import Artefact
from slrig.accept.store import HTML, JSON, kept_points, points_file
from slrig.accept.verdicts import FORMULA, AcceptanceResult
from slrig.bundle.storage import write_file
from slrig.calibration.artefacts import REJECTED_SHARE
from slrig.calibration.segmentation import STEEPEST_DEG
from slrig.reports.drawing import legend
from slrig.reports.page import filled, jpeg_uri
from slrig.scan.artefacts import write_report

FORMAT = "slrig-acceptance"
MANNER = "In the manner of VDI/VDE 2634 part 2 and ISO 10360-13. No conformity with either is claimed."
RULE = "passes if |error| <= MPE - U, fails if |error| > MPE + U, undecided between"
_QUALITY = 88


def write_reports(result: AcceptanceResult, folder: Path) -> None:
    """Write report.html and, when that is there, report.json, beside the captures' points. Raises StorageError."""
    page = report_html(result, lambda reading: kept_points(folder, reading.step, reading.take))
    write_file(folder / HTML, page.encode())
    write_report(document(result), folder / JSON)


def document(result: AcceptanceResult) -> dict[str, object]:
    """The test as JSON values."""
    plan = result.plan
    artefacts = plan.artefacts
    return {
        "format": FORMAT,
        "version": 1,
        "manner": MANNER,
        "rig": result.rig,
        "rendered": plan.rendered,
        "begun_at": result.begun.isoformat(timespec="seconds"),
        "ended_at": result.ended.isoformat(timespec="seconds"),
        "calibration": result.calibration.digest,
        "decision": result.decision.value,
        "complete": result.complete,
        "rule": RULE,
        "uncertainty": FORMULA,
        "volume_mm": plan.volume_mm,
        "volume_diagonal_mm": plan.diagonal_mm,
        "artefacts": artefacts,
        "notes": plan.notes,
        "rules": {
            "steepest_deg": STEEPEST_DEG,
            "border_rings": BORDER_RINGS,
            "rejected_share_at_most": REJECTED_SHARE,
            "form_sigmas": plan.limits.form_sigmas,
            "repeats": plan.repeats,
        },
        "quantities": [
            {
                "quantity": each.quantity.value,
                "words": each.quantity.words,
                "error_mm": each.error_mm,
                "limit_mm": each.limit_mm,
                "certificate_uncertainty_mm": each.certificate_mm,
                "scatter_mm": each.scatter_mm,
                "repeated_captures": each.repeats,
                "expanded_uncertainty_mm": each.uncertainty_mm,
                "decision": each.decision.value,
                "position": each.step,
                "capture": each.take + 1,
            }
            for each in result.verdicts
        ],
        "positions": [
            {
                "name": step.name,
                "artefact": step.artefact.value,
                "centre_mm": step.centre_mm,
                "axis": None if step.artefact is Artefact.SPHERE else step.axis,
                "words": step.words,
                "captures": [_capture(each) for each in result.readings if each.step == step.name],
            }
            for step in plan.steps
        ],
    }


def _capture(reading: Reading) -> dict[str, object]:
    return {
        "capture": reading.take + 1,
        "errors_mm": {quantity.value: error for quantity, error in reading.errors_mm.items()},
        "limits_mm": {quantity.value: limit for quantity, limit in reading.limits_mm.items()},
        "noise_mm": reading.noise_mm,
        "sigma_mm": reading.sigma_mm,
        "dispersion_95_mm": reading.dispersion_mm,
        "points_on_artefact": reading.on_artefact,
        "points_too_oblique": reading.steep,
        "points_at_border": reading.at_border,
        "points_used": reading.used,
        "rejected_share": reading.rejected_share,
        "points_file": points_file(reading.step, reading.take),
    }


def report_html(result: AcceptanceResult, evidence_of: Callable[[Reading], Evidence]) -> str:
    """The page. `evidence_of` is asked for the points of one reading at a time: all at once are large."""
    plan = result.plan
    camera = next(iter(result.calibration.cameras.values()))
    artefact_of = {step.name: step.artefact for step in plan.steps}
    readings = {kind: [each for each in result.readings if artefact_of[each.step] is kind] for kind in Artefact}

    def picture(reading: Reading, most_mm: float) -> str:
        return jpeg_uri(error_map(evidence_of(reading), camera, most_mm=most_mm), _QUALITY)

    return filled(
        "acceptance.html",
        result=result,
        title=f"Acceptance test of {result.rig}",
        manner=MANNER,
        rule=RULE,
        formula=FORMULA,
        sides_mm=tuple(plan.volume_mm[1] - plan.volume_mm[0]),
        steepest_deg=STEEPEST_DEG,
        border_rings=BORDER_RINGS,
        rejected_share=REJECTED_SHARE,
        words={step.name: step.words for step in plan.steps},
        # Of each artefact that was measured: its readings, and the error of the brightest colour of its pictures.
        measured={
            kind: (own, 3 * float(np.median([reading.sigma_mm for reading in own])))
            for kind, own in readings.items()
            if own
        },
        volume_view=partial(volume_view, plan),
        picture=picture,
        legend=legend,
    )

"""An acceptance test as one page of HTML, and as JSON for machines: the decision first, then its grounds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from slrig.accept.evaluation import FORMULA, AcceptanceResult, Reading, ReadingPoints
from slrig.accept.plan import AcceptancePlan, Artefact, Step, turn_deg
from slrig.accept.store import HTML, JSON, kept_points, points_file
from slrig.bundle import write_file
from slrig.calibration import MAX_REJECTED_FRACTION
from slrig.model import FloatArray, Pinhole, Pixels
from slrig.reports.page import WIDTH, drawing, filled, jpeg_uri, legend, path, polygon, ramp, shape
from slrig.scan.artefacts import write_report

FORMAT = "slrig-acceptance"
MANNER = "In the manner of VDI/VDE 2634 part 2 and ISO 10360-13. No conformity with either is claimed."
RULE = "passes if |error| <= MPE - U, fails if |error| > MPE + U, undecided between"
_QUALITY = 88
_MAP_PX = (240, 180)
_MARGIN_SHARE = 0.06
_PAPER = (240, 236, 233)  # blue, green, red
_MARGIN = 26.0
_NUMBER_LIFT = 3.5
_MOST_CELL_PX = 12


def write_reports(result: AcceptanceResult, folder: Path) -> None:
    """Write report.html and, when that is there, report.json, next to the captures' points. Raises StorageError."""
    page = report_html(result, lambda reading: kept_points(folder, reading.step, reading.take))
    write_file(folder / HTML, page.encode())
    write_report(document(result), folder / JSON)


def document(result: AcceptanceResult) -> dict[str, object]:
    """The test as JSON values."""
    plan = result.plan
    artefacts = plan.artefacts
    return {
        "format": FORMAT,
        "version": 2,
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
            "rejected_share_at_most": MAX_REJECTED_FRACTION,
            "repeats": plan.repeats,
        },
        "quantities": [
            {
                "quantity": each.quantity.value,
                "words": each.quantity.words,
                "error_mm": each.error_mm,
                "limit_mm": each.limit_mm,
                "certificate_uncertainty_mm": each.uncertainty.certificate_mm,
                "form_uncertainty_mm": each.uncertainty.form_mm,
                "temperature_uncertainty_mm": each.uncertainty.temperature_mm,
                "fixture_uncertainty_mm": each.uncertainty.fixture_mm,
                "expanded_uncertainty_mm": each.uncertainty.expanded_mm,
                "scatter_mm": each.scatter_mm,
                "repeated_captures": each.repeats,
                "decision": each.decision.value,
                "position": each.step,
                "capture": each.take + 1,
            }
            for each in result.verdicts
        ],
        "scale": result.scale,
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
        "noise_mm": reading.noise_mm,
        "sigma_mm": reading.sigma_mm,
        "dispersion_95_mm": reading.dispersion_mm,
        "points_used": reading.used,
        "points_turned": reading.turned,
        "rejected_share": reading.rejected_share,
        "points_file": points_file(reading.step, reading.take),
    }


def report_html(result: AcceptanceResult, evidence_of: Callable[[Reading], ReadingPoints]) -> str:
    """The page. `evidence_of` gives the points of one reading at a time: all at once are large."""
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
        rejected_share=MAX_REJECTED_FRACTION,
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


def error_map(evidence: ReadingPoints, camera: Pinhole, *, most_mm: float) -> Pixels:
    """An artefact as the camera sees it, coloured by how far its points lie off the fit: (H, W, 3) uint8, BGR.

    Dark blue is most_mm inwards (below), yellow as much outwards.
    """
    on = np.flatnonzero(evidence.artefact > 0)
    in_camera = evidence.points_mm[on] @ camera.rotation.T + camera.translation_mm
    flat = in_camera[:, :2] / in_camera[:, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    width, height = _MAP_PX
    scale = (1 - 2 * _MARGIN_SHARE) / max((high - low)[0] / width, (high - low)[1] / height, 1e-12)
    # Cells are so wide that each holds a point or more.
    cell = int(np.clip(np.ceil(scale * np.sqrt(np.prod(high - low) / max(len(on), 1)) * 1.6), 1, _MOST_CELL_PX))
    grid = (-(-height // cell), -(-width // cell))
    places = ((flat - (low + high) / 2) * scale + np.array(_MAP_PX) / 2) / cell
    columns, rows = np.clip(places.astype(int), 0, np.array(grid)[::-1] - 1).T
    picture = np.full((*grid, 3), _PAPER, np.uint8)
    keys = rows * grid[1] + columns
    count = np.bincount(keys, minlength=grid[0] * grid[1])
    total = np.bincount(keys, weights=evidence.distances_mm[on], minlength=grid[0] * grid[1])
    filled = np.flatnonzero(count)
    shares = np.clip(0.5 + total[filled] / count[filled] / (2 * most_mm), 0, 1)
    picture.reshape(-1, 3)[filled] = ramp(shares)[:, ::-1]
    large = cv2.resize(picture, None, fx=cell, fy=cell, interpolation=cv2.INTER_NEAREST)
    return np.asarray(large[:height, :width])


def volume_view(plan: AcceptancePlan, artefact: Artefact, *, aside: bool) -> Markup:
    """The working volume to scale with every position of one artefact, numbered; from the front, or from the side."""
    axes = [2, 1] if aside else [0, 1]
    low, high = plan.volume_mm[:, axes]
    # Both views in one scale, that in which the wider fills its half of the page.
    scale = (WIDTH - 2 * _MARGIN) / float((plan.volume_mm[1] - plan.volume_mm[0])[:2].max())
    size = scale * (high - low)
    corner = np.array([(WIDTH - size[0]) / 2, _MARGIN])
    ball_mm = plan.artefacts.ball_mm if artefact is Artefact.BAR else plan.artefacts.diameter.value_mm
    parts = [shape("rect", x=corner[0], y=corner[1], width=size[0], height=size[1], class_="volume")]
    # Numbers in one spot are printed together.
    spots: dict[tuple[int, int], list[str]] = {}
    for step in plan.steps:
        if step.artefact is not artefact:
            continue
        *marks, at = (np.vstack([_marks_mm(step, plan), _number_mm(step, plan)])[:, axes] - low) * scale + corner
        spots.setdefault((round(at[0]), round(at[1])), []).append(step.name.rpartition("-")[2])
        if artefact is Artefact.PLANE:
            parts.append(polygon(np.array(marks), "board"))
            continue
        if artefact is Artefact.BAR:
            line = path(np.array(marks))
            parts.append(shape("path", d=line, class_="arrow", stroke="currentColor", stroke_opacity=0.5))
        parts += [shape("circle", cx=x, cy=y, r=scale * (ball_mm / 2), class_="board") for x, y in marks]
    parts += [
        shape("text", ", ".join(names), x=float(x), y=y + _NUMBER_LIFT, class_="label")
        for (x, y), names in spots.items()
    ]
    view = "from the side, the rig to the left" if aside else "as the rig sees it"
    return drawing(WIDTH, float(size[1]) + 2 * _MARGIN, f"positions of the {artefact}, {view}", parts)


def _marks_mm(step: Step, plan: AcceptancePlan) -> FloatArray:
    """(n, 3) the corners of a plane in a position, its length across; else the centres of the balls."""
    if step.artefact is Artefact.PLANE:
        corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * [*plan.artefacts.plane_mm, 0] / 2
        turn = Rotation.from_euler("xyz", turn_deg(step), degrees=True)
        return np.asarray(step.centre_mm + turn.apply(corners))
    along_mm = np.array([-1, 1]) * plan.artefacts.distance.value_mm / 2
    return step.centre_mm + along_mm[:, None] * step.axis if step.artefact is Artefact.BAR else step.centre_mm[None]


def _number_mm(step: Step, plan: AcceptancePlan) -> FloatArray:
    """(3,) the place of a position's number: at one end of a bar, since the middles of all diagonals are one."""
    return _marks_mm(step, plan)[1] if step.artefact is Artefact.BAR else step.centre_mm

"""An acceptance test as one page of HTML, and as JSON for machines: the decision first, then what it stands on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from slrig.bundle.storage import write_file
from slrig.calibration.artefacts import REJECTED_SHARE, Decision
from slrig.calibration.segmentation import STEEPEST_DEG
from slrig.scan.artefacts import write_report
from slrig.sessions.acceptance.charts import error_map, volume_view
from slrig.sessions.acceptance.evaluation import BORDER_RINGS, Evidence, Reading
from slrig.sessions.acceptance.plan import Artefact, Quantity
from slrig.sessions.acceptance.points import kept_points, points_file
from slrig.sessions.acceptance.store import HTML, JSON
from slrig.sessions.acceptance.verdicts import FORMULA, AcceptanceResult, Verdict
from slrig.sessions.calibration.charts import legend
from slrig.sessions.markup import Markup, joined, picture_uri, tag
from slrig.sessions.report_style import report_page

FORMAT = "slrig-acceptance"
MANNER = "In the manner of VDI/VDE 2634 part 2 and ISO 10360-13. No conformity with either is claimed."
RULE = "passes if |error| <= MPE - U, fails if |error| > MPE + U, undecided between"
_UM = 1000.0
_LOOKS = {Decision.PASSES: "good", Decision.UNDECIDED: "usable", Decision.FAILS: "do_not_use"}
_WORDS = {Decision.PASSES: "Passes", Decision.UNDECIDED: "Undecided", Decision.FAILS: "Fails"}
_TITLES = {Artefact.SPHERE: "Sphere", Artefact.BAR: "Ball bar", Artefact.PLANE: "Plane"}


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
    title = f"Acceptance test of {result.rig}"
    sections = [
        _head(result, title),
        _verdict(result),
        tag("div", *(_tile(each, result) for each in result.verdicts), class_="tiles"),
        _rules(result),
        *(_artefact(artefact, result, evidence_of) for artefact in Artefact),
        tag("footer", f"Written by slrig. {MANNER} Calibration {result.calibration.digest}."),
    ]
    return report_page(title, sections)


def _head(result: AcceptanceResult, title: str) -> Markup:
    plan = result.plan
    sides = " × ".join(f"{side:.0f}" for side in plan.volume_mm[1] - plan.volume_mm[0])
    facts = [
        result.begun.isoformat(sep=" ", timespec="seconds"),
        f"volume {sides} mm, L0 {plan.diagonal_mm:.1f} mm",
        f"{len(result.readings)} captures of {len(plan.steps)} positions",
        "rendered rig: true sizes are known exactly" if plan.rendered else "",
        f"certificate {plan.artefacts.certificate}" if plan.artefacts.certificate else "",
        "" if plan.artefacts.temperature_c is None else f"{plan.artefacts.temperature_c:g} °C",
        plan.notes,
    ]
    told = " · ".join(each for each in facts if each)
    return tag("header", tag("h1", title), tag("p", told, class_="facts"), tag("p", MANNER, class_="facts"))


def _verdict(result: AcceptanceResult) -> Markup:
    lines = [
        tag(
            "li",
            f"{each.quantity.words[:1].upper()}{each.quantity.words[1:]} ({each.quantity}) ",
            tag("b", each.decision.value),
            f": {_um(each.error_mm)} µm, limit {_um(each.limit_mm)} µm, U {_um(each.uncertainty_mm)} µm, at "
            f"{each.step}.",
        )
        for each in result.verdicts
    ]
    part = None if result.complete else tag("p", "Not every position was measured: this is no whole test.")
    return tag(
        "section",
        tag("div", _WORDS[result.decision], class_="word", data_figure="decision"),
        part,
        tag("ul", *lines),
        class_=f"card verdict {_LOOKS[result.decision]}",
    )


def _tile(verdict: Verdict, result: AcceptanceResult) -> Markup:
    share = ""
    if verdict.quantity is Quantity.SPACING and verdict.error_mm != 0:
        share = f" That is 1 : {result.plan.diagonal_mm / abs(verdict.error_mm):,.0f} of the volume's diagonal."
    note = (
        f"The worst of all positions, at {verdict.step}; limit {_um(verdict.limit_mm)} µm, "
        f"U {_um(verdict.uncertainty_mm)} µm: {verdict.decision}.{share}"
    )
    return tag(
        "div",
        tag("div", f"{verdict.quantity}: {verdict.quantity.words}", class_="name"),
        tag("div", _um(verdict.error_mm), tag("small", " µm"), class_="value", data_figure=verdict.quantity.value),
        tag("div", note, class_="note"),
        class_="tile",
    )


def _rules(result: AcceptanceResult) -> Markup:
    plan = result.plan
    rows = [
        tag(
            "tr",
            tag("td", f"{each.quantity}"),
            tag("td", "not told" if each.certificate_mm is None else _um(each.certificate_mm)),
            tag("td", "not measured" if math.isnan(each.scatter_mm) else _um(each.scatter_mm)),
            tag("td", str(each.repeats)),
            tag("td", _um(each.uncertainty_mm)),
            tag("td", each.decision.value),
        )
        for each in result.verdicts
    ]
    names = ("", "certificate's U, µm", "scatter s, µm", "repeated captures", "U, µm", "decision")
    told = (
        f"{FORMULA} with k = 2; what is not known is left out. A quantity {RULE}. Limits of form are "
        f"{plan.limits.form_sigmas:g} standard deviations of a point, as the scan states them, unless a limit was "
        f"given. Points seen more than {STEEPEST_DEG:.0f}° off their normal by any device, or within {BORDER_RINGS} "
        f"steps of a border of the mesh, do not count; of the others at most {100 * REJECTED_SHARE:.1f} % are left out "
        "of a fit, those furthest off. Fits are by least squares, radii free."
    )
    return joined(
        tag("h2", "How it was decided"),
        tag("p", told, class_="lead"),
        tag("section", _table(names, rows), class_="card"),
    )


def _artefact(
    artefact: Artefact, result: AcceptanceResult, evidence_of: Callable[[Reading], Evidence]
) -> Markup | None:
    steps = {step.name: step for step in result.plan.steps if step.artefact is artefact}
    chosen = [each for each in result.readings if each.step in steps]
    if not chosen:
        return None
    camera = next(iter(result.calibration.cameras.values()))
    most_mm = 3 * float(np.median([reading.sigma_mm for reading in chosen]))

    def _map(reading: Reading) -> bytes:
        return error_map(evidence_of(reading), camera, most_mm=most_mm)

    figures = [
        tag(
            "figure",
            tag("img", src=picture_uri(_map(reading)), alt=reading.step, loading="lazy"),
            tag("figcaption", tag("b", f"{reading.step}. "), steps[reading.step].words, " ", _errors(reading)),
        )
        for reading in chosen
        if reading.take == 0
    ]
    views = [
        tag("figure", volume_view(result.plan, artefact, aside=aside), tag("figcaption", words))
        for aside, words in (
            (False, "The volume as the rig sees it, with every position."),
            (True, "From the side: the rig is to the left."),
        )
    ]
    quantities = list(chosen[0].errors_mm)
    rows = [_row(reading, quantities) for reading in chosen]
    names = (
        "position",
        *(f"{each}, µm" for each in quantities),
        *(f"limit of {each}" for each in quantities),
        "noise, µm",
        "rms, µm",
        "D95, µm",
        "points used",
        "too oblique",
        "at a border",
        "rejected",
    )
    return joined(
        tag("h2", f"{_TITLES[artefact]}: {_certified(artefact, result)}"),
        tag("section", tag("div", *views, class_="row"), class_="card"),
        tag("section", _table(names, rows), class_="card"),
        tag(
            "section",
            tag("div", *figures, class_="row narrow"),
            legend(-_UM * most_mm, _UM * most_mm, "µm off the fit"),
            tag("p", "Grey: on the artefact, and not counted.", class_="dim"),
            class_="card",
        ),
    )


def _certified(artefact: Artefact, result: AcceptanceResult) -> str:
    artefacts = result.plan.artefacts
    if artefact is Artefact.PLANE:
        return f"{artefacts.plane_mm[0]:g} × {artefacts.plane_mm[1]:g} mm"
    value = artefacts.diameter if artefact is Artefact.SPHERE else artefacts.distance
    told = "" if value.uncertainty_mm is None else f" ± {_um(value.uncertainty_mm)} µm (k = 2)"
    return f"{value.value_mm:g} mm{told}"


def _row(reading: Reading, quantities: Sequence[Quantity]) -> Markup:
    beyond = any(abs(reading.errors_mm[each]) > reading.limits_mm[each] for each in quantities)
    name = reading.step if reading.take == 0 else f"{reading.step}, again"
    return tag(
        "tr",
        tag("td", name),
        *(
            tag("td", _um(reading.errors_mm[each]), data_figure=f"{reading.step}.{reading.take + 1}.{each}")
            for each in quantities
        ),
        *(tag("td", _um(reading.limits_mm[each])) for each in quantities),
        tag("td", _um(reading.noise_mm)),
        tag("td", _um(reading.sigma_mm)),
        tag("td", _um(reading.dispersion_mm)),
        *(tag("td", f"{count:,}") for count in (reading.used, reading.steep, reading.at_border)),
        tag("td", f"{100 * reading.rejected_share:.2f} %"),
        class_="outlier" if beyond else None,
    )


def _errors(reading: Reading) -> str:
    return ", ".join(f"{quantity} {_um(error)} µm" for quantity, error in reading.errors_mm.items()) + "."


def _table(names: Sequence[str], rows: Sequence[Markup]) -> Markup:
    head = tag("tr", *(tag("th", name) for name in names))
    return tag("div", tag("table", tag("thead", head), tag("tbody", *rows)), class_="table")


def _um(value_mm: float) -> str:
    return f"{_UM * value_mm:.1f}"

"""`slrig accept`: an acceptance test, step by step with a person, or by script on a rig that moves the artefacts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from slrig.accept.plan import (
    STEEL_PER_K,
    AcceptancePlan,
    Artefacts,
    Certified,
    Limits,
    Step,
    exact_artefacts,
    usual_limits,
)
from slrig.accept.positions import acceptance_plan, rig_volume_mm
from slrig.accept.report import document
from slrig.accept.running import Place, required_calibration, run_acceptance
from slrig.accept.scene import scripted_config
from slrig.accept.store import HTML, JSON
from slrig.accept.verdicts import AcceptanceResult
from slrig.calibration import Decision
from slrig.cli.display import answered, progress_shown
from slrig.cli.options import AcceptanceOptions
from slrig.config import RigConfig, read_rig
from slrig.devices import Rig
from slrig.discovery import open_rig
from slrig.errors import InvalidInputError, ScanCancelledError, SlrigError
from slrig.logs import set_up_console_logs
from slrig.reports.page import begun

_COLOURS = {Decision.PASSES: "green", Decision.UNDECIDED: "yellow", Decision.FAILS: "bold red"}


def plan_for(asked: AcceptanceOptions, rig: Rig) -> AcceptancePlan:
    """The test of an open rig. Raises CalibrationError, InvalidInputError."""
    calibration = required_calibration(rig)
    rendered = rig.truth() is not None
    volume = rig_volume_mm(calibration) if asked.volume_mm is None else np.array(asked.volume_mm).reshape(2, 3)
    return acceptance_plan(
        calibration,
        volume,
        _artefacts(asked, exact_artefacts(volume) if rendered else None),
        rendered=rendered,
        limits=_limits(asked, usual_limits(volume, asked.tolerance_mm)),
        repeats=asked.repeats,
        exposure_s=asked.exposure_s,
        notes=asked.notes,
    )


def _limits(asked: AcceptanceOptions, usual: Limits) -> Limits:
    told = {
        "form_mm": asked.form_limit_mm,
        "size_mm": asked.size_limit_mm,
        "spacing_mm": asked.spacing_limit_mm,
        "flatness_mm": asked.flatness_limit_mm,
    }
    return replace(usual, **{name: limit for name, limit in told.items() if limit is not None})


def _artefacts(asked: AcceptanceOptions, made: Artefacts | None) -> Artefacts:
    if made is not None and (asked.sphere_mm, asked.bar_mm, asked.plane_mm) == (None, None, None):
        return replace(made, temperature_c=asked.temperature_c)
    if asked.sphere_mm is None or asked.bar_mm is None or asked.plane_mm is None:
        message = (
            "an acceptance test needs --sphere DIAMETER U, --bar DISTANCE U and --plane LENGTH WIDTH: values and "
            "expanded uncertainties (k = 2) from the certificates, in mm"
        )
        raise InvalidInputError(message)
    exact = None if made is None else 0.0
    return Artefacts(
        Certified(*asked.sphere_mm),
        Certified(*asked.bar_mm),
        asked.plane_mm,
        asked.ball_mm,
        exact if asked.sphere_form_mm is None else asked.sphere_form_mm,
        exact if asked.plane_form_mm is None else asked.plane_form_mm,
        asked.certificate,
        asked.temperature_c,
        asked.expansion_per_k if asked.expansion_per_k is not None else STEEL_PER_K if made is None else 0.0,
        asked.fixture_mm,
    )


def accept(rig_file: Path, asked: AcceptanceOptions, *, output: Path, scripted: bool, as_json: bool) -> bool:
    """Do the test, print what was decided, and return whether the rig passes.

    Raises
    ------
    SlrigError
        As `run_acceptance`, or the rig file is wrong or the rig cannot be opened.
    """
    set_up_console_logs()
    config = read_rig(rig_file)
    if asked.tolerance_mm is None:
        asked = replace(asked, tolerance_mm=config.tolerance_mm)
    console = Console(stderr=as_json)
    with TemporaryDirectory(prefix="slrig-acceptance-") as scratch:
        if scripted:
            config = moving(config, asked, Path(scratch))
        with open_rig(config) as rig:
            plan = plan_for(asked, rig)
            result = _tested(rig, plan, output, scripted=scripted, console=console)
    if as_json:
        typer.echo((output / JSON).read_text(encoding="utf-8"), nl=False)
    else:
        tell(result, console)
        console.print(f"report: {output / HTML}", markup=False, style="dim")
    return result.decision is Decision.PASSES


def moving(config: RigConfig, asked: AcceptanceOptions, folder: Path) -> RigConfig:
    """The rig by which the artefacts are moved: itself if its positioner knows the positions, else, of a rendered rig,
    one with a scene of artefacts in place of its own, which is written into `folder`.
    """
    with open_rig(config) as rig:
        plan = plan_for(asked, rig)
        known = () if rig.positioner is None else tuple(rig.positioner.poses)
    if all(step.name in known for step in plan.steps):
        return config
    return scripted_config(config, plan, folder)


def placed_by_hand(plan: AcceptancePlan, console: Console, *, ask: Callable[[str], str] | None = None) -> Place:
    """A `Place` that tells a person what to do and waits for Enter; q ends the test (ScanCancelledError)."""
    names = [step.name for step in plan.steps]

    def place(_rig: Rig, step: Step, /) -> None:
        number = names.index(step.name) + 1
        console.print(Text.assemble((f"\n{number} of {len(names)}  ", "bold"), step.words))
        x, y, z = (float(each) for each in step.centre_mm)
        console.print(f"Its middle about x {x:.0f}, y {y:.0f}, z {z:.0f} mm. Keep it still.", style="dim")
        if answered(ask or console.input, "[bold]Enter[/bold] measure   [bold]q[/bold] leave > ") == "q":
            message = f"the acceptance test was left before {step.name}; the points of what was measured are kept"
            raise ScanCancelledError(message)

    return place


def tell(result: AcceptanceResult, console: Console) -> None:
    """Print what was decided."""
    table = Table(box=None, title=f"Acceptance test of '{result.rig}'", title_justify="left")
    for name in ("", "worst error", "limit", "U (k = 2)", "position", "decision"):
        table.add_column(name, justify="left" if name in {"", "position", "decision"} else "right")
    for each in result.verdicts:
        table.add_row(
            f"{each.quantity} {each.quantity.words}",
            *(f"{1000 * value:.1f} µm" for value in (each.error_mm, each.limit_mm, each.uncertainty.expanded_mm)),
            each.step,
            Text(each.decision.value, style=_COLOURS[each.decision]),
        )
    console.print(table)
    figures = document(result)
    console.print(f"L0 {result.plan.diagonal_mm:.1f} mm. {figures['manner']}", markup=False, style="dim")
    if result.scale is not None and result.scale.words is not None:
        console.print(Text(f"{begun(result.scale.words)}.", style=_COLOURS[Decision.FAILS]))
    console.print(Text(f"The rig {result.decision.value}.", style=_COLOURS[result.decision]))


def _tested(rig: Rig, plan: AcceptancePlan, output: Path, *, scripted: bool, console: Console) -> AcceptanceResult:
    if scripted:
        with progress_shown() as display:
            return run_acceptance(rig, plan, output, progress=display, cancelled=lambda: False)
    console.print(f"An acceptance test of {len(plan.steps)} positions, {len(plan.takes)} captures.", markup=False)

    def again(step: Step, error: SlrigError) -> bool:
        console.print(Text(f"{step.name}: {error}", style="red"))
        return True

    manual = placed_by_hand(plan, console)
    return run_acceptance(rig, plan, output, progress=_quiet, cancelled=lambda: False, place=manual, again=again)


def _quiet(_stage: str, _fraction: float, _detail: str, /) -> None:
    """Prompts and a moving bar do not go together."""

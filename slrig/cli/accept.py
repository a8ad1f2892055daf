"""`slrig accept`: an acceptance test, step by step with a person, or by script on a rig that moves the artefacts."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from slrig.accept.evaluation import AcceptanceResult
from slrig.accept.job import AcceptanceTests, PositionJob, required_calibration, scripted_config
from slrig.accept.plan import (
    STEEL_PER_K,
    AcceptancePlan,
    Artefacts,
    Certified,
    Limits,
    Step,
    acceptance_plan,
    exact_artefacts,
    rig_volume_mm,
    usual_limits,
)
from slrig.accept.report import document
from slrig.accept.store import HTML, JSON, POSITIONS, AcceptanceState
from slrig.calibration import Decision
from slrig.cli.display import answered, progress_shown
from slrig.cli.local import followed, local_manager
from slrig.cli.options import AcceptanceOptions
from slrig.config import RigConfig, read_rig
from slrig.devices import Rig
from slrig.discovery import open_rig
from slrig.disk import storage_errors
from slrig.errors import InvalidInputError, NothingToReconstructError, ScanCancelledError, ScanEvidenceError, SlrigError
from slrig.failure import error_of
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Holder
from slrig.logs import set_up_console_logs
from slrig.reports.page import begun

_HOLDER = Holder("acceptance", "the plan of an acceptance test", None)
_COLOURS = {Decision.PASSES: "green", Decision.UNDECIDED: "yellow", Decision.FAILS: "bold red"}


def plan_for(options: AcceptanceOptions, rig: Rig) -> AcceptancePlan:
    """The test of an open rig. Raises CalibrationError, InvalidInputError."""
    calibration = required_calibration(rig)
    rendered = rig.truth() is not None
    volume = rig_volume_mm(calibration) if options.volume_mm is None else np.array(options.volume_mm).reshape(2, 3)
    return acceptance_plan(
        calibration,
        volume,
        _artefacts(options, exact_artefacts(volume) if rendered else None),
        rendered=rendered,
        limits=_limits(options, usual_limits(volume, options.tolerance_mm)),
        repeats=options.repeats,
        exposure_s=options.exposure_s,
        notes=options.notes,
    )


def _limits(options: AcceptanceOptions, usual: Limits) -> Limits:
    given = {
        "form_mm": options.form_limit_mm,
        "size_mm": options.size_limit_mm,
        "spacing_mm": options.spacing_limit_mm,
        "flatness_mm": options.flatness_limit_mm,
    }
    return replace(usual, **{name: limit for name, limit in given.items() if limit is not None})


def _artefacts(options: AcceptanceOptions, made: Artefacts | None) -> Artefacts:
    if made is not None and (options.sphere_mm, options.bar_mm, options.plane_mm) == (None, None, None):
        return replace(made, temperature_c=options.temperature_c)
    if options.sphere_mm is None or options.bar_mm is None or options.plane_mm is None:
        message = (
            "an acceptance test needs --sphere DIAMETER U, --bar DISTANCE U and --plane LENGTH WIDTH: values and "
            "expanded uncertainties (k = 2) from the certificates, in mm"
        )
        raise InvalidInputError(message)
    exact = None if made is None else 0.0
    return Artefacts(
        Certified(*options.sphere_mm),
        Certified(*options.bar_mm),
        options.plane_mm,
        options.ball_mm,
        exact if options.sphere_form_mm is None else options.sphere_form_mm,
        exact if options.plane_form_mm is None else options.plane_form_mm,
        options.certificate,
        options.temperature_c,
        options.expansion_per_k if options.expansion_per_k is not None else STEEL_PER_K if made is None else 0.0,
        options.fixture_mm,
    )


def accept(rig_file: Path, options: AcceptanceOptions, *, output: Path, scripted: bool, as_json: bool) -> bool:
    """Do the test, print the decision, and return whether the rig passes.

    Raises
    ------
    SlrigError
        As `measure_positions`, or the rig file is wrong or the rig cannot be opened.
    """
    set_up_console_logs()
    config = read_rig(rig_file)
    if options.tolerance_mm is None:
        options = replace(options, tolerance_mm=config.tolerance_mm)
    _require_free(output)
    console = Console(stderr=as_json)
    with TemporaryDirectory(prefix="slrig-acceptance-") as scratch:
        if scripted:
            config = moving(config, options, Path(scratch))
        with local_manager(config, PositionJob) as manager:
            plan = manager.lend(_HOLDER, lambda rig, _: plan_for(options, rig.open()))
            if scripted:
                with progress_shown() as display:
                    result = measure_positions(manager, plan, output, Listener(report=display))
            else:
                count = f"{len(plan.steps)} positions, {len(plan.takes)} captures"
                console.print(f"An acceptance test of {count}.", markup=False)
                result = measure_positions(manager, plan, output, person=Person(plan, console))
    if as_json:
        typer.echo((output / JSON).read_text(encoding="utf-8"), nl=False)
    else:
        print_result(result, console)
        console.print(f"report: {output / HTML}", markup=False, style="dim")
    return result.decision is Decision.PASSES


def moving(config: RigConfig, options: AcceptanceOptions, folder: Path) -> RigConfig:
    """The rig by which the artefacts are moved: itself if its positioner knows the positions, else, of a rendered rig,
    one with a scene of artefacts in place of its own, which is written into `folder`.
    """
    with open_rig(config) as rig:
        plan = plan_for(options, rig)
        known = () if rig.positioner is None else tuple(rig.positioner.poses)
    if all(step.name in known for step in plan.steps):
        return config
    return scripted_config(config, plan, folder)


class Person:
    """A person who places the artefacts of a plan, guided by a console."""

    def __init__(self, plan: AcceptancePlan, console: Console) -> None:
        self._names = [step.name for step in plan.steps]
        self._console = console

    def place(self, step: Step) -> None:
        """Print what to place, and wait for Enter; q ends the test (ScanCancelledError)."""
        number = self._names.index(step.name) + 1
        self._console.print(Text.assemble((f"\n{number} of {len(self._names)}  ", "bold"), step.words))
        x, y, z = (float(each) for each in step.centre_mm)
        self._console.print(f"Its middle about x {x:.0f}, y {y:.0f}, z {z:.0f} mm. Keep it still.", style="dim")
        if answered("[bold]Enter[/bold] measure   [bold]q[/bold] leave > ", self._console) == "q":
            message = f"the acceptance test was left before {step.name}; the points of what was measured are kept"
            raise ScanCancelledError(message)

    def read(self, step: Step, error: SlrigError) -> None:
        """Print why an artefact has to be placed again."""
        self._console.print(Text(f"{step.name}: {error}", style="red"))


def measure_positions(
    manager: JobManager,
    plan: AcceptancePlan,
    output: Path,
    listener: Listener = SILENT,
    *,
    person: Person | None = None,
) -> AcceptanceResult:
    """Measure every position of a plan with the rig of a manager, and bring reports and points into `output`. What was
    measured before an error is there, too.

    person : places the artefacts, once more where one was not found or a frame contradicted its pattern; None has the
    rig's positioner do it.

    Raises CalibrationError: the rig has none; UnsupportedByDeviceError: it has no positioner, or one that does not know
    a position; NothingToReconstructError, ScanEvidenceError, DeviceError, StorageError, ScanCancelledError.
    """
    tests = AcceptanceTests(manager)
    test = tests.open(lambda *_: plan).id
    names = [step.name for step in plan.steps]
    try:
        if person is None:
            tests.measure(test, wait=True, scripted=True)
        while (record := tests.get(test).from_first_take()).state is not AcceptanceState.FINISHED:
            step = (record.next_take or plan.takes[-1])[0]
            if person is not None:
                person.place(step)
                tests.measure(test, wait=True, scripted=False)
            job = manager.store.of(test)[-1]
            ended = followed(manager, job.id, listener.part(names.index(step.name), len(names)))
            if ended.fault is not None:
                error = error_of(ended.fault)
                if person is None or not isinstance(error, (NothingToReconstructError, ScanEvidenceError)):
                    raise error
                person.read(step, error)
        return tests.result(test)
    finally:
        measured = tests.folder(test)
        for found in (*measured.glob(f"{POSITIONS}/*/*.npz"), *measured.glob(HTML), *measured.glob(JSON)):
            place_of = output / found.relative_to(measured)
            with storage_errors(output):
                place_of.parent.mkdir(parents=True, exist_ok=True)
                shutil.move(found, place_of)


def _require_free(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        message = f"{folder}: the results of an acceptance test go into a new folder, and this one is not empty"
        raise InvalidInputError(message)


def print_result(result: AcceptanceResult, console: Console) -> None:
    """Print the decision."""
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

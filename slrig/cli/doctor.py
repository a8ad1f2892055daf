"""`slrig doctor`: a rig examined, every finding in words with its remedy, and a rig file with the values found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from slrig.api.logs import set_up_logs_for_a_person
from slrig.api.schemas import ScanRequest, scan_plan
from slrig.cli.display import print_json, progress_shown
from slrig.config import RigConfig, read_rig
from slrig.devices import FoundDevice, Rig
from slrig.discovery import found_devices, installed_drivers, open_rig
from slrig.doctor.doctor import Diagnosis, examine
from slrig.doctor.findings import Severity
from slrig.doctor.rig_file import refuse_existing, write_rig_file
from slrig.scan.plan_check import pattern_sequence

_COLOURS = {Severity.OK: "green", Severity.NOTE: "yellow", Severity.FAULT: "bold red"}


def doctor(rig_file: Path, *, output: Path | None, force: bool, search_s: float, as_json: bool) -> bool:
    """Examine the rig, print what was found, write the new rig file, and return whether there is no fault.

    Raises
    ------
    SlrigError
        The rig file is wrong, the rig cannot be opened, or the new rig file cannot be written.
    """
    set_up_logs_for_a_person()
    config = read_rig(rig_file)
    if output is not None:
        refuse_existing(output, force=force)
    with progress_shown() as display:
        display("looking for displays", 0.0, "")
        displays = found_displays()
        display("opening the rig", 0.0, "")
        with open_rig(config) as rig:
            plan, projector = scan_plan(ScanRequest(), config.scan).patterns, rig.projector.info
            diagnosis = examine(
                _as_scanned(rig, config),
                own_sequence=pattern_sequence(
                    plan, projector.size, rig.calibration, rig.cameras, recorded=projector.recorded
                ),
                displays=displays,
                period_px=plan.line_shift_period_px,
                search_s=search_s,
                told=display,
            )
    if output is not None:
        write_rig_file(diagnosis, rig_file, output, force=force)
    if as_json:
        print_json(diagnosis.document())
    else:
        tell(diagnosis, Console(), rig_file=rig_file, output=output)
    return diagnosis.healthy


def found_displays() -> tuple[FoundDevice, ...]:
    """What the finders of projector drivers find: light engines, trigger boxes, and outputs with a display."""
    drivers = {driver.name for driver in installed_drivers() if driver.kind == "projector"}
    return tuple(device for device in found_devices().devices if device.driver in drivers)


def tell(diagnosis: Diagnosis, console: Console, *, rig_file: Path, output: Path | None) -> None:
    """Print a diagnosis for people: faults first, each finding with its remedy."""
    table = Table(box=None, title=f"Rig '{escape(diagnosis.rig)}'", title_justify="left", show_header=False)
    table.add_column(no_wrap=True)
    table.add_column()
    for finding in diagnosis.findings:
        told = f"{escape(finding.subject)}: {escape(finding.found)}"
        if finding.remedy:
            told += f"\n[bold]do[/bold] {escape(finding.remedy)}"
        colour = _COLOURS[finding.severity]
        table.add_row(f"[{colour}]{finding.severity}[/{colour}]", f"{told}  [dim]({finding.name})[/dim]")
    console.print(table)
    faults, notes = len(diagnosis.of(Severity.FAULT)), len(diagnosis.of(Severity.NOTE))
    console.print(f"\n[bold]{_counted(faults, 'fault')}, {_counted(notes, 'note')}[/bold]")
    if output is not None:
        console.print(f"A rig file with these values: {escape(str(output))}")
    elif diagnosis.exposures:
        console.print(f"For a rig file with these values: slrig doctor {escape(str(rig_file))} --output FILE.toml")


def _as_scanned(rig: Rig, config: RigConfig) -> Rig:
    """The rig with the exposure that scans use, where the rig file gives one for all of them."""
    exposure_s = config.scan.exposure_s
    if exposure_s is None:
        return rig
    settings = {name: replace(each, exposure_s=exposure_s) for name, each in rig.settings.items()}
    return replace(rig, settings=settings)


def _counted(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'s' * (count != 1)}"

"""`slrig doctor`, `slrig conform`, `slrig latency`: a rig examined, and every finding told in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from slrig.api.schemas import ScanRequest, scan_plan
from slrig.capture import STEADY_TOLERANCE, CameraLatency, measure_latency
from slrig.cli.display import print_json, progress_shown
from slrig.cli.options import given
from slrig.config import RigConfig, read_rig, read_settings
from slrig.conformance import CheckOutcome, ConformanceReport, run_checks
from slrig.devices import Rig, Synchronisation, Trigger
from slrig.discovery import discover_devices, installed_drivers, open_rig
from slrig.doctor import Diagnosis, Severity, examine, refuse_existing, write_rig_file
from slrig.errors import StorageError
from slrig.jobs.examinations import keep
from slrig.logs import set_up_console_logs
from slrig.model import PatternSequence
from slrig.scan.plan import PatternPlan
from slrig.scan.plan_check import pattern_sequence

_COLOURS = {
    Severity.OK: "green",
    Severity.NOTE: "yellow",
    Severity.FAULT: "bold red",
    CheckOutcome.PASSED: "green",
    CheckOutcome.FAILED: "bold red",
    CheckOutcome.NOT_APPLICABLE: "dim",
    CheckOutcome.NOT_RUN: "yellow",
}


def doctor(
    rig_file: Path, *, output: Path | None, force: bool, search_s: float, data: Path | None, as_json: bool
) -> bool:
    """Examine the rig, print what was found, keep it in the data folder, write the new rig file, and return whether
    there is no fault.

    Raises SlrigError where a rig file is wrong or cannot be written, or the rig cannot be opened.
    """
    set_up_console_logs()
    config = read_rig(rig_file)
    lines = _own_plan(config).named
    if output is not None:
        refuse_existing(output, force=force)
    with progress_shown() as display:
        display("looking for displays", 0.0, "")
        # Light engines, trigger boxes, and outputs with a display.
        projectors = {driver.name for driver in installed_drivers() if driver.kind == "projector"}
        displays = tuple(device for device in discover_devices().devices if device.driver in projectors)
        display("opening the rig", 0.0, "")
        with open_rig(config) as rig:
            diagnosis = examine(
                _as_scanned(rig, config),
                own_sequence=_own_sequence(rig, config),
                displays=displays,
                period_px=lines.period_px,
                steps=lines.steps or lines.period_px,
                sines=lines.sines,
                search_s=search_s,
                progress=display,
            )
    if output is not None:
        write_rig_file(diagnosis, rig_file, output, force=force)
    _keep(data, "doctor", diagnosis.document())
    if as_json:
        print_json(diagnosis.document())
    else:
        _tell_diagnosis(diagnosis, Console(), rig_file=rig_file, output=output)
    return diagnosis.healthy


def conform(rig: Path, *, data: Path | None, as_json: bool) -> bool:
    """Examine the rig by the driver contract, print the report, keep it in the data folder, and return whether every
    check that applies has passed.

    Raises SlrigError where the rig file is wrong, or the rig cannot be opened.
    """
    set_up_console_logs()
    config = read_rig(rig)
    with progress_shown() as display:
        display("opening the rig", 0.0, "")
        with open_rig(config) as opened:
            sequence = _own_sequence(opened, config)
        report = run_checks(lambda: open_rig(config), sequence, progress=display)
    _keep(data, "conform", report.document())
    if as_json:
        print_json(report.document())
    else:
        _tell_report(report, Console())
    return report.conforms


def _keep(data: Path | None, command: str, found: Mapping[str, Any]) -> None:
    """Keep what was found where a service shows it. An examination that cannot be kept is told all the same."""
    folder = read_settings(None, **given(data_dir=data)).data_dir
    try:
        there = keep(folder, command, found)
    except StorageError as error:
        typer.echo(f"the service will not show this: {error}", err=True)
        return
    if not there and data is not None:
        typer.echo(f"the service will not show this: {folder} is no data folder of slrig serve", err=True)


def tell_latency(
    rig_file: Path, *, trials: int, search_s: float, exposure_s: float | None, trigger: str | None, as_json: bool
) -> None:
    """Measure a rig's latency, and print it in words with the table for its rig file, or as JSON."""
    set_up_console_logs()
    kind = None if trigger is None else Trigger(trigger)
    with open_rig(read_rig(rig_file)) as rig, progress_shown() as display:
        measured = measure_latency(
            rig, trials=trials, search_s=search_s, exposure_s=exposure_s, trigger=kind, on_progress=display
        )
    if as_json:
        # JSON knows no NaN.
        cameras = {
            camera: {name: None if math.isnan(value) else value for name, value in asdict(found).items()}
            for camera, found in measured.cameras.items()
        }
        print_json({"synchronisation": asdict(measured.synchronisation), "cameras": cameras})
        return
    typer.echo("\n\n".join(f"camera {name}\n{_latency_words(found)}" for name, found in measured.cameras.items()))
    typer.echo(
        f"\nPut this into {rig_file}, in place of a table of that name:\n\n{_rig_table(measured.synchronisation)}"
    )


def _own_plan(config: RigConfig) -> PatternPlan:
    """The patterns of a scan on this rig as its file describes it."""
    return scan_plan(ScanRequest(), config.scan).patterns


def _own_sequence(rig: Rig, config: RigConfig) -> PatternSequence:
    projector = rig.projector.info
    return pattern_sequence(
        _own_plan(config), projector.size, rig.calibration, rig.cameras, recorded=projector.recorded
    )


def _as_scanned(rig: Rig, config: RigConfig) -> Rig:
    """The rig with the exposure that scans use, where the rig file gives one for all of them."""
    exposure_s = config.scan.exposure_s
    if exposure_s is None:
        return rig
    return replace(rig, settings={name: replace(each, exposure_s=exposure_s) for name, each in rig.settings.items()})


def _tell_diagnosis(diagnosis: Diagnosis, console: Console, *, rig_file: Path, output: Path | None) -> None:
    """Print a diagnosis for people: faults first, each finding with its remedy."""
    table = Table(
        Column(no_wrap=True), Column(), box=None, title=f"Rig '{escape(diagnosis.rig)}'", title_justify="left",
        show_header=False,
    )  # fmt: skip
    for finding in diagnosis.findings:
        told = f"{escape(finding.subject)}: {escape(finding.found)}"
        if finding.remedy:
            told += f"\n[bold]do[/bold] {escape(finding.remedy)}"
        table.add_row(_coloured(finding.severity), f"{told}  [dim]({finding.name})[/dim]")
    console.print(table)
    faults, notes = len(diagnosis.with_severity(Severity.FAULT)), len(diagnosis.with_severity(Severity.NOTE))
    console.print(f"\n[bold]{_counted(faults, 'fault')}, {_counted(notes, 'note')}[/bold]")
    if output is not None:
        console.print(f"A rig file with these values: {escape(str(output))}")
    elif diagnosis.exposures:
        console.print(f"For a rig file with these values: slrig doctor {escape(str(rig_file))} --output FILE.toml")


def _tell_report(report: ConformanceReport, console: Console) -> None:
    """Print a report for people: a row per check, then what is wrong, then the score."""
    heads = (Column("result", no_wrap=True), Column("s", justify="right", no_wrap=True), Column("check"))
    table = Table(*heads, box=None, title=f"Conformance of rig '{escape(report.rig)}'", title_justify="left")
    for result in report.results:
        told = escape(result.title)
        if result.outcome is CheckOutcome.NOT_APPLICABLE:
            told += f"\n[dim]{escape(result.reason or '')}[/dim]"
        table.add_row(_coloured(result.outcome), f"{result.seconds:.1f}", told)
    console.print(table)
    for result in report.results:
        if (failure := result.failure) is not None:
            console.print(f"\n[bold red]{escape(result.title)}[/bold red]  ({result.name})")
            for label in ("where", "expected", "found", "remedy"):
                if text := getattr(failure, label):
                    console.print(f"  {label:<8}  {escape(text)}")
    if report.stopped is not None:
        console.print(f"\n[bold red]stopped[/bold red]  {escape(report.stopped)}")
    passed, not_applicable = report.count(CheckOutcome.PASSED), report.count(CheckOutcome.NOT_APPLICABLE)
    console.print(
        f"\n[bold]{report.percent} %[/bold]: {passed} of {report.applicable} checks that apply passed, "
        f"{not_applicable} do not apply; {report.seconds:.0f} s"
    )


def _coloured(kind: Severity | CheckOutcome) -> str:
    return f"[{_COLOURS[kind]}]{kind}[/{_COLOURS[kind]}]"


def _counted(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'s' * (count != 1)}"


def _rig_table(synchronisation: Synchronisation) -> str:
    """The `[synchronisation]` table of a rig file."""
    lines = [
        "[synchronisation]",
        f"latency_s = {_number(synchronisation.latency_s)}",
        f"latency_error_s = {_number(synchronisation.latency_error_s)}",
    ]
    if synchronisation.earliest_s is not None:
        lines.append(f"earliest_s = {_number(synchronisation.earliest_s)}")
    if synchronisation.line_time_s:
        lines += ["", "[synchronisation.line_time_s]"]
        lines += [f"{name} = {_number(line_s, digits=9)}" for name, line_s in synchronisation.line_time_s.items()]
    return "\n".join(lines)


def _number(value: float, *, digits: int = 6) -> str:
    """A TOML float, as many digits after the point as matter: µs, and ns of a row."""
    return np.format_float_positional(value, digits, unique=False, trim="0")


def _latency_words(found: CameraLatency) -> str:
    ms = {name: f"{seconds * 1e3:.2f} ms" for name, seconds in asdict(found).items() if name.endswith("_s")}
    line = f"{found.line_time_s * 1e6:.2f} ± {found.line_time_error_s * 1e6:.2f} µs from row to row"
    if found.rolling:
        shutter = f"rolling shutter: {line}, {ms['skew_s']} from the first row to the last"
    elif found.scanned:
        shutter = f"the projector builds up its picture row by row: {line}, as the camera sees it"
    else:
        shutter = f"global shutter: {line}, not told from 0"
    said = [
        f"light comes {ms['latency_s']} ± {ms['standard_error_s']} after the instant the projector states",
        f"it varies by {ms['jitter_s']} (standard deviation), 95 % come within {ms['latency_p95_s']}; "
        f"to white {ms['rise_s']}, to black {ms['fall_s']}",
        f"it begins to change {ms['earliest_s']} after that instant at the earliest, and is stable {ms['latest_s']} "
        f"after it at the latest, {ms['settle_s']} of it to settle",
        shutter,
        f"from {found.flashes_used} of {found.flashes} flashes, {found.rows_used} rows that fit to {ms['residual_s']}",
    ]
    if found.flicker > STEADY_TOLERANCE:
        said.append(f"steady white flickers by {found.flicker:.0%}: make the exposure a multiple of the refresh period")
    return "\n".join(f"  {line}" for line in said)

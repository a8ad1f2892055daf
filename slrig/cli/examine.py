"""`slrig doctor`, `slrig conform`, `slrig latency`: a rig examined by a manager of jobs in this process, or by the
running service.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from slrig.api.schemas import ScanRequest, scan_plan
from slrig.capture.latency import STEADY_TOLERANCE, CameraLatency
from slrig.cli.display import print_json, progress_shown
from slrig.cli.local import run_job
from slrig.cli.options import given
from slrig.client import Client
from slrig.config import RigConfig, read_rig, read_settings
from slrig.conformance import CheckOutcome, ConformanceJob, ConformanceReport
from slrig.devices import Synchronisation, Trigger
from slrig.doctor import (
    Diagnosis,
    DoctorJob,
    LatencyJob,
    Severity,
    keep,
    known_stamp_errors_s,
    latency_from_document,
    refuse_existing,
    write_rig_file,
)
from slrig.errors import ConfigError, StorageError
from slrig.jobs.job import Job
from slrig.jobs.listener import Listener
from slrig.jobs.records import JobKind
from slrig.logs import set_up_console_logs

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
    rig_file: Path | None,
    client: Client,
    *,
    output: Path | None,
    force: bool,
    search_s: float,
    data: Path | None,
    as_json: bool,
) -> bool:
    """Examine a rig, print the findings, write the new rig file, and return whether there is no fault.

    rig_file : of the rig, which is opened here, with its findings kept in the data folder; None for the rig of the
    service. Raises SlrigError: a rig file is wrong or cannot be written, or the rig cannot be opened; ServiceError.
    """
    set_up_console_logs()
    if output is not None:
        if rig_file is None:
            message = "--output: the new rig file is the old one with the measured values. Name the old one, too."
            raise ConfigError(message)
        refuse_existing(output, force=force)
    found, _ = _examined(rig_file, client, data, DoctorJob.kind, {"search_s": search_s})
    diagnosis = Diagnosis.from_document(found)
    if output is not None and rig_file is not None:
        write_rig_file(diagnosis, rig_file, output, force=force)
    if as_json:
        print_json(found)
    else:
        _print_diagnosis(diagnosis, Console(), rig_file=rig_file, output=output)
    return diagnosis.healthy


def conform(rig_file: Path | None, client: Client, *, data: Path | None, as_json: bool) -> bool:
    """Examine a rig by the driver contract, print the report, and return whether every check that applies has passed.

    rig_file, Raises : as `doctor`.
    """
    set_up_console_logs()
    found, fault = _examined(rig_file, client, data, ConformanceJob.kind, {})
    report = ConformanceReport.from_document(found)
    if as_json:
        print_json(found)
    else:
        _print_report(report, Console())
    if fault is not None:
        typer.echo(fault, err=True)
    return report.conforms


def latency(
    rig_file: Path | None,
    client: Client,
    *,
    flashes: int,
    search_s: float,
    exposure_s: float | None,
    trigger: str | None,
    data: Path | None,
    as_json: bool,
) -> None:
    """Measure a rig's latency, and print it as text with the table for its rig file, or as JSON. See `doctor`."""
    set_up_console_logs()
    options = given(flashes=flashes, search_s=search_s, exposure_s=exposure_s, trigger=trigger)
    found, _ = _examined(rig_file, client, data, LatencyJob.kind, options)
    if as_json:
        print_json(found)
        return
    synchronisation, cameras = latency_from_document(found)
    typer.echo("\n\n".join(f"camera {name}\n{_latency_text(each)}" for name, each in cameras.items()))
    place = "the rig file" if rig_file is None else rig_file
    typer.echo(f"\nPut this into {place}, in place of a table of that name:\n\n{_rig_table(synchronisation)}")


def _examined(
    rig_file: Path | None, client: Client, data: Path | None, kind: JobKind, options: Mapping[str, Any]
) -> tuple[dict[str, Any], str | None]:
    """Summary of an examination, here or by the service, and why it ended before it was whole; None where it did not.

    options : as POST /rig/KIND takes them. Ctrl-C ends the examination.
    """
    with progress_shown() as display:
        if rig_file is None:
            return examined_by(client, kind, options, Listener(report=display))
        config = read_rig(rig_file)
        display("opening the rig", 0.0, "")
        record = run_job(config, _job(kind, config, options), Listener(report=display))
    found = dict(record.summary or {})
    _keep(data, kind, found)
    return found, None if record.fault is None else record.fault.message


def examined_by(
    client: Client, kind: JobKind, options: Mapping[str, Any], listener: Listener
) -> tuple[dict[str, Any], str | None]:
    """See `_examined`: by the service of a client. Raises ServiceError, ExaminationFailedError."""
    job = client.post(f"/rig/{kind}", options)
    try:
        job = client.examinations.wait(job["id"], listener.report)
    except KeyboardInterrupt:
        client.examinations.cancel(job["id"])
        raise
    return job["summary"], None if job["error"] is None else job["error"]["detail"]


def _job(kind: JobKind, config: RigConfig, options: Mapping[str, Any]) -> Job:
    patterns = scan_plan(ScanRequest(), config.scan).patterns
    if kind is JobKind.DOCTOR:
        return DoctorJob(patterns, config.scan.exposure_s, **options)
    if kind is JobKind.CONFORMANCE:
        return ConformanceJob(patterns)
    trigger = None if "trigger" not in options else Trigger(options["trigger"])
    return LatencyJob(options["flashes"], options["search_s"], options.get("exposure_s"), trigger)


def _keep(data: Path | None, kind: JobKind, found: Mapping[str, Any]) -> None:
    """Keep what was found where a service shows it. What cannot be kept is printed all the same."""
    folder = read_settings(None, **given(data_dir=data)).data_dir
    try:
        there = keep(folder, kind, found)
    except StorageError as error:
        typer.echo(f"the service will not show this: {error}", err=True)
        return
    if not there and data is not None:
        typer.echo(f"the service will not show this: {folder} is not a data folder of slrig serve", err=True)


def _print_diagnosis(diagnosis: Diagnosis, console: Console, *, rig_file: Path | None, output: Path | None) -> None:
    """Print a diagnosis for people: faults first, each finding with its remedy."""
    table = Table(
        Column(no_wrap=True), Column(), box=None, title=f"Rig '{escape(diagnosis.rig)}'", title_justify="left",
        show_header=False,
    )  # fmt: skip
    for finding in diagnosis.findings:
        text = f"{escape(finding.subject)}: {escape(finding.found)}"
        if finding.remedy:
            text += f"\n[bold]do[/bold] {escape(finding.remedy)}"
        table.add_row(_coloured(finding.severity), f"{text}  [dim]({finding.name})[/dim]")
    console.print(table)
    faults, notes = len(diagnosis.with_severity(Severity.FAULT)), len(diagnosis.with_severity(Severity.NOTE))
    console.print(f"\n[bold]{_counted(faults, 'fault')}, {_counted(notes, 'note')}[/bold]")
    if output is not None:
        console.print(f"A rig file with these values: {escape(str(output))}")
    elif diagnosis.exposures:
        source = "RIG.toml" if rig_file is None else rig_file
        console.print(f"For a rig file with these values: slrig doctor {escape(str(source))} --output FILE.toml")


def _print_report(report: ConformanceReport, console: Console) -> None:
    """Print a report for people: a row per check, then what is wrong, then the score."""
    heads = (Column("result", no_wrap=True), Column("s", justify="right", no_wrap=True), Column("check"))
    table = Table(*heads, box=None, title=f"Conformance of rig '{escape(report.rig)}'", title_justify="left")
    for result in report.results:
        text = escape(result.title)
        if result.outcome is CheckOutcome.NOT_APPLICABLE:
            text += f"\n[dim]{escape(result.reason or '')}[/dim]"
        table.add_row(_coloured(result.outcome), f"{result.seconds:.1f}", text)
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
    if synchronisation.trigger_period_s is not None:
        lines.append(f"trigger_period_s = {_number(synchronisation.trigger_period_s)}")
    if synchronisation.line_time_s:
        lines += ["", "[synchronisation.line_time_s]"]
        lines += [f"{name} = {_number(line_s, digits=9)}" for name, line_s in synchronisation.line_time_s.items()]
    if errors_s := known_stamp_errors_s(synchronisation):
        lines += ["", "[synchronisation.stamp_error_s]"]
        lines += [f"{name} = {_number(error_s)}" for name, error_s in errors_s.items()]
    return "\n".join(lines)


def _number(value: float, *, digits: int = 6) -> str:
    """A TOML float, as many digits after the point as matter: µs, and ns of a row."""
    return np.format_float_positional(value, digits, unique=False, trim="0")


def _latency_text(found: CameraLatency) -> str:
    ms = {name: f"{seconds * 1e3:.2f} ms" for name, seconds in asdict(found).items() if name.endswith("_s")}
    line = f"{found.line_time_s * 1e6:.2f} ± {found.line_time_error_s * 1e6:.2f} µs from row to row"
    if found.rolling:
        shutter = f"rolling shutter: {line}, {ms['skew_s']} from the first row to the last"
    elif found.scanned:
        shutter = f"the projector builds up its picture row by row: {line}, as the camera sees it"
    else:
        shutter = f"global shutter: {line}, not distinguishable from 0"
    said = [
        f"light comes {ms['latency_s']} ± {ms['standard_error_s']} after the instant the projector states",
        f"it varies by {ms['jitter_s']} (standard deviation), 95 % come within {ms['latency_p95_s']}; "
        f"to white {ms['rise_s']}, to black {ms['fall_s']}",
        f"it begins to change {ms['earliest_s']} after that instant at the earliest, and is stable {ms['latest_s']} "
        f"after it at the latest, {ms['settle_s']} of it to settle",
        shutter,
        f"from {found.flashes_used} of {found.flashes} flashes, {found.rows_used} rows that fit to {ms['residual_s']}",
    ]
    if found.late:
        said.append(found.late_words)
    if found.halfway_s:
        said.append(f"between white and black it is halfway for {ms['halfway_s']}: interpolated pictures")
    if found.flicker > STEADY_TOLERANCE:
        said.append(f"steady white flickers by {found.flicker:.0%}: make the exposure a multiple of the refresh period")
    return "\n".join(f"  {line}" for line in said)

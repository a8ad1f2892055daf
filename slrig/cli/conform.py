"""`slrig conform`: a rig examined by the driver contract, with a score."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from slrig.api.logs import set_up_logs_for_a_person
from slrig.api.schemas import ScanRequest, scan_plan
from slrig.cli.display import print_json, progress_shown
from slrig.config import RigConfig, read_rig
from slrig.conformance import Outcome, Report, run
from slrig.discovery import open_rig
from slrig.model import PatternSequence
from slrig.scan.plan_check import pattern_sequence

_COLOURS = {
    Outcome.PASSED: "green",
    Outcome.FAILED: "bold red",
    Outcome.NOT_APPLICABLE: "dim",
    Outcome.NOT_RUN: "yellow",
}


def conform(rig: Path, *, as_json: bool) -> bool:
    """Examine the rig, print the report, and return whether every check that applies has passed.

    Raises
    ------
    SlrigError
        The rig file is wrong, or the rig cannot be opened.
    """
    set_up_logs_for_a_person()
    config = read_rig(rig)
    with progress_shown() as display:
        display("opening the rig", 0.0, "")
        sequence = _sequence(config)
        report = run(lambda: open_rig(config), sequence, progress=display)
    if as_json:
        print_json(report.document())
    else:
        tell(report, Console())
    return report.conforms


def tell(report: Report, console: Console) -> None:
    """Print a report for people: a row per check, then what is wrong, then the score."""
    table = Table(box=None, title=f"Conformance of rig '{escape(report.rig)}'", title_justify="left")
    table.add_column("result", no_wrap=True)
    table.add_column("s", justify="right", no_wrap=True)
    table.add_column("check")
    for result in report.results:
        colour = _COLOURS[result.outcome]
        told = escape(result.title)
        if result.outcome is Outcome.NOT_APPLICABLE:
            told += f"\n[dim]{escape(result.reason or '')}[/dim]"
        table.add_row(f"[{colour}]{result.outcome}[/{colour}]", f"{result.seconds:.1f}", told)
    console.print(table)
    for result in report.results:
        if result.failure is not None:
            failure = result.failure
            console.print(f"\n[bold red]{escape(result.title)}[/bold red]  ({result.name})")
            if failure.where:
                console.print(f"  where  {escape(failure.where)}")
            console.print(f"  asked  {escape(failure.asked)}")
            console.print(f"  found  {escape(failure.found)}")
            console.print(f"  do     {escape(failure.do)}")
    if report.stopped is not None:
        console.print(f"\n[bold red]stopped[/bold red]  {escape(report.stopped)}")
    console.print(
        f"\n[bold]{report.percent} %[/bold]: {report.count(Outcome.PASSED)} of {report.applicable} checks that apply "
        f"passed, {report.count(Outcome.NOT_APPLICABLE)} do not apply; {report.seconds:.0f} s"
    )


def _sequence(config: RigConfig) -> PatternSequence:
    """The patterns of a scan on this rig as its file describes it."""
    with open_rig(config) as rig:
        patterns = scan_plan(ScanRequest(), config.scan).patterns
        projector = rig.projector.info
        return pattern_sequence(patterns, projector.size, rig.calibration, rig.cameras, recorded=projector.recorded)

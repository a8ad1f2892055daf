"""`slrig calibrate list`, `show`, `compare`, `activate`, `export`, `import`: the calibrations that a service keeps."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from slrig.bundle import read_calibration, write_calibration
from slrig.cli.calibration_screen import refused, tell_result
from slrig.cli.client import ServiceClient
from slrig.cli.coverage_screen import coverage_picture, tell_next
from slrig.errors import CalibrationNotFoundError, ConfigError, ServiceError

FILES = {
    ".json": "calibration.json",
    ".yml": "calibration.yml",
    ".yaml": "calibration.yml",
    ".xml": "calibration.xml",
    ".html": "report.html",
}
"""What a file to be exported holds, by its ending."""


def whole_id(client: ServiceClient, beginning: str) -> str:
    """The id of the one calibration whose id begins so. Raises CalibrationNotFoundError."""
    ids = [str(each["id"]) for each in client.get("/calibration?limit=200")["calibrations"]]
    found = [each for each in ids if each.startswith(beginning)]
    if len(found) == 1:
        return found[0]
    what = "no calibration's" if not found else f"{len(found)} calibrations'"
    known = ", ".join(each[:8] for each in ids[:10]) or "none; open one with: slrig calibrate run"
    message = f"'{beginning}' is the beginning of {what} id. There are: {known}"
    raise CalibrationNotFoundError(message)


def list_calibrations(client: ServiceClient, *, as_json: bool) -> None:
    """Print the calibrations from new to old, and which one scans use."""
    found = client.get("/calibration")
    if as_json:
        _print_json(found)
        return
    if not found["calibrations"]:
        typer.echo("no calibrations; shoot one with: slrig calibrate run")
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    for head in ("id", "", "when", "poses", "label"):
        table.add_column(head, no_wrap=True)
    table.add_column("verdict")
    for each in found["calibrations"]:
        told = Text(each["verdict"] or ("imported" if each["imported"] else each["state"]))
        poses = "" if each["imported"] else str(each["poses"])
        mark = Text("in use", style="green") if each["active"] else Text("")
        when = _clock(each["solved_at"] or each["created_at"])
        table.add_row(each["id"][:8], mark, when, poses, Text(each["label"] or ""), told)
    console = Console()
    console.print(table)
    if found["active"] is None:
        console.print("Scans use the rig's own calibration.", style="dim")


def show_calibration(client: ServiceClient, beginning: str, *, as_json: bool) -> None:
    """Print one calibration: its result, or what it covers and what to do next."""
    session = client.get(f"/calibration/{whole_id(client, beginning)}")
    if as_json:
        _print_json(session)
        return
    console = Console()
    board = "imported" if session["board"] is None else session["board"]["title"]
    heading = [session["id"], session["label"], f"rig '{session['rig']}'", board, session["state"]]
    console.print(Text(" · ".join(each for each in heading if each), style="bold"))
    if session["active"]:
        console.print("Scans use it.", style="green")
    if session["result"] is not None:
        console.print()
        tell_result({**session["result"], "refused": refused(session)}, console)
    if session["error"] is not None:
        console.print(Text(session["error"]["detail"], style="red"))
    if session["coverage"] is not None and session["state"] != "solved":
        console.print()
        console.print(coverage_picture(session["coverage"], session["next_move"], {}))
        tell_next(session["next_move"], console)


def compare_calibrations(client: ServiceClient, first: str, second: str, *, as_json: bool) -> None:
    """Print what the second calibration says otherwise than the first."""
    found = client.get(f"/calibration/compare?first={whole_id(client, first)}&second={whole_id(client, second)}")
    if as_json:
        _print_json(found)
        return
    console = Console()
    for words in found["words"]:
        table = Table.grid(padding=(0, 1))
        table.add_row(" ·", Text(words))
        console.print(table)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("second − first")
    for name in found["devices"]:
        table.add_column(Text(name), justify="right")
    rows = (
        ("focal length, %", "focal_percent"),
        ("principal point, px", "principal_px"),
        ("turned, °", "rotation_deg"),
        ("baseline, mm", "baseline_mm"),
    )
    for words, key in rows:
        table.add_row(words, *(_difference(device[key]) for device in found["devices"].values()))
    console.print()
    console.print(table)


def export_calibration(client: ServiceClient, beginning: str, file: Path) -> None:
    """Write a calibration, or its report, into a file of the kind that its ending names.

    Raises
    ------
    ConfigError
        No such ending.
    ServiceError
        It has no such file: it was not solved yet.
    """
    name = FILES.get(file.suffix.lower())
    if name is None:
        message = (
            f"{file}: expected a name that ends in .json (slrig's own), .yml or .xml (OpenCV's) or .html (the report), "
            f"found '{file.suffix}'"
        )
        raise ConfigError(message)
    session = client.get(f"/calibration/{whole_id(client, beginning)}")
    offered = session["links"]["files"]
    if name not in offered:
        has = f"It has: {', '.join(offered)}." if offered else f"It is {session['state']}; solve it first."
        message = f"Calibration {session['id'][:8]} has no {name}. {has}"
        raise ServiceError(message)
    client.fetch(offered[name], file)
    typer.echo(f"{'written':<10}{file}")


def import_calibration(client: ServiceClient, file: Path, *, label: str | None) -> None:
    """Send a calibration file to the service. It is looked at here first, so that faults are told by the file's name.

    Raises
    ------
    CalibrationError
        It holds no valid calibration.
    """
    calibration = read_calibration(file)
    # One form travels, whichever the file has.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibration.json"
        write_calibration(path, calibration)
        document: dict[str, Any] = json.loads(path.read_bytes())
    query = "" if label is None else f"?{urlencode({'label': label})}"
    found = client.post(f"/calibration/import{query}", document)
    typer.echo(f"{'imported':<10}{found['id']}")
    typer.echo(f"To have scans use it: slrig calibrate activate {found['id'][:8]}")


def _difference(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "–"
    if found["sigma"] is None:
        return f"{found['value']:+.4f}"
    return f"{found['value']:+.4f} ± {found['sigma']:.4f} ({found['sigmas']:.1f} σ)"


def _clock(stamp: str) -> str:
    return f"{datetime.fromisoformat(stamp).astimezone():%Y-%m-%d %H:%M}"


def _print_json(document: Mapping[str, Any]) -> None:
    typer.echo(json.dumps(document, indent=1, ensure_ascii=False))

"""`slrig fleet`: the rigs that share a catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from slrig.cli.options import AsJson, ServiceOptions, given, grouped


@grouped
def fleet(
    catalogue: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Ask this database itself, postgresql://HOST:PORT/DATABASE."),
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="TOML file with its settings, as a service has them.")] = None,
    *,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """List the rigs that share a catalogue.

    How each is, its health, its last scan and its backlog. Asks a service, or the catalogue itself where that is named,
    here or as SLRIG_CATALOGUE.
    """
    from slrig.cli.display import print_json, print_table

    found = _of_catalogue(catalogue, settings)
    if found is None:
        with service.client() as client:
            found = client.system.fleet()
    if as_json:
        print_json(found)
    elif not found["rigs"]:
        typer.echo(f"no rig writes to {found['catalogue']} yet; name it in the settings of their services: catalogue")
    else:
        heads = ("rig", "state", "seen", "health", "backlog", "last scan", "of 24 h", "why")
        print_table(heads, map(_row, found["rigs"]))


def _of_catalogue(address: str | None, settings: Path | None) -> Mapping[str, Any] | None:
    """What the catalogue of the settings says; None where they name none."""
    from pydantic import TypeAdapter

    from slrig.catalogue.fleet import Fleet
    from slrig.catalogue.store import catalogue_of
    from slrig.config import read_settings

    catalogue = catalogue_of(read_settings(settings, **given(catalogue=address)))
    if catalogue is None:
        return None
    try:
        catalogue.open()
        document: Mapping[str, Any] = TypeAdapter(Fleet).dump_python(catalogue.fleet(), mode="json")
    finally:
        catalogue.close()
    return document


def _row(rig: Mapping[str, Any]) -> tuple[str, ...]:
    last, failed = rig["last_scan"], rig["failed_of_day"]
    backlog = "?" if rig["waiting"] is None else str(rig["waiting"] + rig["computing"])
    if rig["uncopied"]:
        backlog += f", {rig['uncopied']} to copy"
    ended = "none" if last is None else f"{datetime.fromisoformat(last['finished_at']).astimezone():%Y-%m-%d %H:%M}"
    return (
        rig["name"],
        rig["state"],
        _ago(rig["seen_s"]),
        rig["health"] or "?",
        backlog,
        ended if last is None or last["state"] == "succeeded" else f"{ended} {last['state']}",
        f"{rig['scans_of_day']}" + (f", {failed} failed" if failed else ""),
        rig["words"] if rig["state"] != "ready" else rig["health_message"] if rig["health"] != "good" else "",
    )


def _ago(seconds: float) -> str:
    """How long ago something was.

    >>> _ago(8.2), _ago(200.0), _ago(7200.0), _ago(300000.0)
    ('8 s ago', '3 min ago', '2 h ago', '3 days ago')
    """
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size or (size == 60 and seconds >= size):
            return f"{seconds // size:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"

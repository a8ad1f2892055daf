"""`slrig preset`: named options of scans that a running service knows."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from slrig.cli.options import AsJson, ServiceOptions, grouped
from slrig.errors import ConfigError

app = typer.Typer(no_args_is_help=True, help="Options of scans by name: for dark objects, for shiny ones.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the preset.")]
MOST_BYTES = 2**20


@app.command(name="list")
@grouped
def list_presets(service: ServiceOptions, as_json: AsJson = False) -> None:
    """List presets, and where they come from."""
    from slrig.cli.display import print_json, print_table

    with service.client() as client:
        found = client.presets.list()
    if as_json:
        print_json(found)
        return
    rows = [(each["name"], each["source"], each["fault"] or each["description"] or "") for each in found["presets"]]
    print_table(("preset", "from", "for"), rows)


@app.command()
@grouped
def export(name: Name, service: ServiceOptions) -> None:
    """Print a preset as JSON, for a file that another rig imports."""
    from slrig.cli.display import print_json

    with service.client() as client:
        print_json(client.presets.get(name))


@app.command(name="import")
@grouped
def import_preset(
    name: Name,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A file that export wrote; - is standard input.")],
    service: ServiceOptions,
) -> None:
    """Have the service keep a preset by this name."""
    from slrig.bundle import read_text

    document = sys.stdin.read(MOST_BYTES) if str(file) == "-" else read_text(file, MOST_BYTES, ConfigError)
    with service.client() as client:
        client.presets.put(name, document)


@app.command()
@grouped
def delete(name: Name, service: ServiceOptions) -> None:
    """Delete a preset that was imported."""
    with service.client() as client:
        client.presets.delete(name)

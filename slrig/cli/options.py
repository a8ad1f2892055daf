"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

USUAL_URL = "http://127.0.0.1:8731"

Url = Annotated[str, typer.Option(envvar="SLRIG_URL", help="Where the service is.")]
KeyFile = Annotated[
    Path | None, typer.Option(help="File that holds the service's API key. Default: the variable SLRIG_API_KEY.")
]
RigFile = Annotated[Path, typer.Argument(metavar="RIG", help="Rig file; examples are in config/rigs.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def client_of(url: str, key_file: Path | None) -> Any:
    """A client of the service that the options name. Raises ConfigError."""
    from slrig.cli.client import ServiceClient, read_key

    return ServiceClient(url, read_key(key_file))
